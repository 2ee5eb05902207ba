//! The house rules that this program checks.

use crate::rooms::{Rooms, packages};
use crate::{PRESENT, git_files, names, read, sizes};
use anyhow::{Result, bail};
use std::path::Path;

/// Our crates on which each crate may depend at run time; names without `tandem-`.
const MAY_DEPEND_ON: &str = "\
shm:
bus:
board:
redundancy: board
cores: shm bus board redundancy timesync topics
boot: board
boot-host: board boot
rtos:
runtime: board cores rtos
capi: shm board redundancy
topics: board bus shm
topics-host: board board-udp bus qos-profiles shm topics
qos-profiles: topics
timesync: board
timesync-host: board timesync
exec: board shm
exec-host: board board-host boot exec manifest
exec-client: board board-host exec shm
manifest: board
vehicle: board bus timesync
page:
watch: board board-host bus cores observers
board-host: board board-udp peripherals shm
observers: board-host shm
processes: board board-host boot boot-host bus cores page record redundancy rtos runtime vehicle
benches: board board-host board-udp exec exec-client exec-host manifest observers page \
rtos shm topics topics-host two-cores
two-cores: shm
golden: board bus cores peripherals
record: board bus cores redundancy timesync vehicle
faults: board bus peripherals record vehicle
sim: board board-sim bus cores faults record redundancy timesync vehicle
board-conformance: board
board-sim: board peripherals
board-udp: board
peripherals: board
cosim: board peripherals
board-qemu: board board-udp cosim peripherals
";
/// The top crates, which may depend on all others.
const ON_TOP: [&str; 9] = [
    "tandem",
    "tandem-can",
    "tandem-foxglove",
    "tandem-fuzz",
    "tandem-lab",
    "tandem-tests",
    "tandem-top",
    "tandem-web",
    "xtask",
];
/// The only packages that may name iceoryx2: the host board, and the benchmarks, which measure it
/// as a peer.
const MAY_USE_ICEORYX2: [&str; 3] = ["tandem-board-host", "tandem-observers", "tandem-benches"];
/// Folders whose code may be unsafe; everything else forbids it.
const MAY_BE_UNSAFE: &[&str] = &[
    "board/host",
    "rtos",
    "benches",
    "tests",
    "capi",
    "firmware-port",
];
/// The one file of its crate that may have unsafe code. The crate denies it, and no other file may
/// allow it.
const UNSAFE_MODULES: [&str; 1] = ["shm/src/plain.rs"];
/// Folders with lock-free code: comments name the partner of each order that is not relaxed.
const NAMES_PARTNERS: &[&str] = &["shm/src/", "board/host/src/", "rtos/src/"];
const ORDERS: [&str; 4] = ["Acquire", "Release", "AcqRel", "SeqCst"];
/// The partner is named in a comment at most this many lines above.
const PARTNER_WITHIN: usize = 12;
/// Files that a generator writes: from the DBC, and from the IDL.
const GENERATED: [&str; 2] = ["bus/src/dbc.rs", "topics/src/types.rs"];
/// The longest permitted file of code.
const MAX_LINES: usize = 800;
/// The widest permitted line of code.
const MAX_COLUMNS: usize = 100;

/// Checks everything, prints every finding, and fails if there is one.
///
/// With `save` it writes the current sizes of the rooms to their table.
pub(crate) fn run(root: &Path, save: bool) -> Result<()> {
    let mut findings = sizes::findings(root, save)?;
    findings.extend(dependencies(root)?);
    let files = rust_files(root)?;
    findings.extend(crate::failure_modes::findings(&files));
    findings.extend(
        files
            .iter()
            .flat_map(|(place, text)| file_findings(place, text)),
    );
    let rooms = Rooms::read(root)?;
    findings.extend(rooms.circles());
    findings.extend(names::findings(root, &rooms.public_types(), &files)?);
    findings.iter().for_each(|finding| println!("{finding}"));
    if !findings.is_empty() {
        bail!("{} findings", findings.len());
    }
    println!("tidy");
    Ok(())
}

/// Returns the crates on which a crate of the table may depend; `None` if it is not in the table.
fn allowed_for(name: &str) -> Option<Vec<&'static str>> {
    let rows = MAY_DEPEND_ON.lines().filter_map(|row| row.split_once(':'));
    let mut ours = rows.filter(|(owner, _)| name.strip_prefix("tandem-") == Some(owner));
    ours.next()
        .map(|(_, allowed)| allowed.split_whitespace().collect())
}

fn dependencies(root: &Path) -> Result<Vec<String>> {
    let mut findings = Vec::new();
    for package in packages(root)? {
        let name = package.name.as_str();
        let ours = allowed_for(name);
        if ours.is_none() && !ON_TOP.contains(&name) {
            findings.push(format!("{name}: a crate that tidy does not know"));
        }
        for dependency in &package.dependencies {
            let on = dependency.name.as_str();
            // Only a test build counts accesses; it is never a product.
            let is_counting = dependency.target.as_deref() == Some("cfg(stepped)");
            if on.starts_with("iceoryx2") && !MAY_USE_ICEORYX2.contains(&name) {
                findings.push(format!("{name}: only the host board may name {on}"));
            }
            let at_run_time = dependency.kind.is_none() && !is_counting;
            let tandem = on.strip_prefix("tandem-");
            let refused = |on| ours.as_ref().is_some_and(|allowed| !allowed.contains(&on));
            if at_run_time && tandem.is_some_and(refused) {
                findings.push(format!("{name}: must not depend on {on}"));
            }
        }
    }
    Ok(findings)
}

fn file_findings(place: &str, text: &str) -> Vec<String> {
    let mut findings = Vec::new();
    if !text.starts_with("//!") {
        findings.push(format!(
            "{place}:1: a file opens with one `//!` line that says what it is"
        ));
    }
    let is_generated = GENERATED.contains(&place);
    let lines = text.lines().count();
    if lines > MAX_LINES && !is_generated {
        findings.push(format!("{place}: {lines} lines; split it at {MAX_LINES}"));
    }
    for (number, line) in text.lines().enumerate() {
        // Lines with a link or with text in a string may be wider, because these cannot be broken.
        let breaks = !is_generated && !line.contains("http") && !line.contains('"');
        if breaks && line.chars().count() > MAX_COLUMNS {
            findings.push(format!(
                "{place}:{}: wider than {MAX_COLUMNS} columns",
                number + 1
            ));
        }
    }
    // Test code that only measures, in `measure.rs`, need not name partners.
    let is_measurement = place.ends_with("/measure.rs");
    let is_lock_free = NAMES_PARTNERS
        .iter()
        .any(|folder| place.starts_with(folder));
    if is_lock_free && !is_measurement {
        findings.extend(orders_without_partner(place, text));
    }
    let is_crate_root = place.ends_with("src/lib.rs") || place.ends_with("src/main.rs");
    let may_be_unsafe = MAY_BE_UNSAFE.iter().any(|folder| place.starts_with(folder));
    let room = place.split_once("/src/").map(|(room, _)| room);
    let has_module = UNSAFE_MODULES
        .iter()
        .any(|file| file.split_once("/src/").map(|(room, _)| room) == room);
    let lint = match has_module {
        true => "#![deny(unsafe_code)]",
        false => "#![forbid(unsafe_code)]",
    };
    if is_crate_root && !may_be_unsafe && !text.contains(lint) {
        findings.push(format!(
            "{place}: a crate outside {MAY_BE_UNSAFE:?} has `{lint}`"
        ));
    }
    if has_module && !UNSAFE_MODULES.contains(&place) && text.contains("allow(unsafe_code") {
        findings.push(format!(
            "{place}: only {UNSAFE_MODULES:?} may allow unsafe code"
        ));
    }
    findings
}

/// Returns the memory orders outside of tests that no comment pairs with another one. The comment
/// is at most `PARTNER_WITHIN` lines above the order, or directly above its item. A
/// `compiler_fence` is exempt: it orders a thread and its own handlers.
fn orders_without_partner(place: &str, text: &str) -> Vec<String> {
    let mut findings = Vec::new();
    let mut named = None;
    // Whether the comment above the item names a partner: valid for the whole item.
    let mut named_above = false;
    for (number, line) in text.lines().enumerate() {
        if line.starts_with("#[cfg(test)]") {
            break;
        }
        let (code, comment) = line.split_once("//").unwrap_or((line, ""));
        if comment.to_lowercase().contains("pair") {
            named = Some(number);
            named_above |= line.starts_with("//");
        }
        if line.starts_with('}') {
            named_above = false;
        }
        let mut words = code.split(|c: char| !c.is_alphanumeric());
        let has_order = words.any(|word| ORDERS.contains(&word));
        let is_exempt = code.trim_start().starts_with("use ") || code.contains("compiler_fence");
        let is_near = named.is_some_and(|named| number - named <= PARTNER_WITHIN);
        if has_order && !is_exempt && !is_near && !named_above {
            findings.push(format!(
                "{place}:{}: this memory order names no partner (\"pairs with ...\")",
                number + 1
            ));
        }
    }
    findings
}

/// Returns every Rust file that is tracked by git or not ignored, with its text.
pub(crate) fn rust_files(root: &Path) -> Result<Vec<(String, String)>> {
    let files = git_files(root, &[&PRESENT[..], &["*.rs"]].concat())?.into_iter();
    files
        .map(|file| Ok((file.clone(), read(root.join(&file))?)))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_memory_order_without_a_partner_is_found() {
        let found = |text: &str| orders_without_partner("a.rs", text).len();
        assert_eq!(found("fn f() {\n    x.load(Acquire);\n}\n"), 1);
        assert_eq!(
            found("fn f() {\n    // Pairs with `g`.\n    x.load(Acquire);\n}\n"),
            0
        );
        assert_eq!(
            found("fn f() {\n    x.load(Ordering::SeqCst); // pairs with g\n}\n"),
            0
        );
        assert_eq!(found("fn f() {\n    x.load(Relaxed);\n}\n"), 0);
        assert_eq!(
            found("use core::sync::atomic::Ordering::{Acquire, Release};\n"),
            0
        );
        assert_eq!(found("fn f() {\n    compiler_fence(SeqCst);\n}\n"), 0);
        // Too far above.
        let far = "    y();\n".repeat(PARTNER_WITHIN);
        let text = format!("fn f() {{\n    // Pairs with `g`.\n{far}    x.load(Acquire);\n}}\n");
        assert_eq!(found(&text), 1);
        // Valid for the whole item, and not for the next one.
        let item =
            format!("/// All pair with each other.\nimpl X {{\n{far}    x.load(Acquire);\n}}\n");
        assert_eq!(found(&item), 0);
        assert_eq!(
            found(&format!("{item}impl Y {{\n{far}    x.load(Acquire);\n}}\n")),
            1
        );
        // Tests are exempt.
        assert_eq!(
            found("#[cfg(test)]\nmod tests {\n    x.load(SeqCst);\n}\n"),
            0
        );
    }
}
