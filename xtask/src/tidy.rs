//! The house rules that a program can check.

use crate::rooms::{Rooms, packages};
use crate::{names, sizes};
use anyhow::{Context, Result, bail};
use std::fs;
use std::path::{Path, PathBuf};

/// Which of our crates each crate may depend on, at run time.
const MAY_DEPEND_ON: &[(&str, &[&str])] = &[
    ("tandem-shm", &[]),
    ("tandem-bus", &[]),
    ("tandem-board", &[]),
    (
        "tandem-redundancy",
        &["tandem-shm", "tandem-bus", "tandem-board"],
    ),
    (
        "tandem-cores",
        &[
            "tandem-shm",
            "tandem-bus",
            "tandem-board",
            "tandem-redundancy",
        ],
    ),
    ("tandem-boot", &["tandem-board"]),
    ("tandem-boot-host", &["tandem-board", "tandem-boot"]),
    ("tandem-rtos", &[]),
    (
        "tandem-runtime",
        &["tandem-board", "tandem-cores", "tandem-rtos"],
    ),
    (
        "tandem-capi",
        &["tandem-shm", "tandem-board", "tandem-redundancy"],
    ),
    ("tandem-vehicle", &["tandem-board", "tandem-bus"]),
    ("tandem-page", &[]),
    (
        "tandem-board-host",
        &["tandem-board", "tandem-peripherals", "tandem-shm"],
    ),
    (
        "tandem-benches",
        &[
            "tandem-board",
            "tandem-board-host",
            "tandem-page",
            "tandem-rtos",
            "tandem-shm",
            "tandem-two-cores",
        ],
    ),
    ("tandem-two-cores", &["tandem-shm"]),
    (
        "tandem-golden",
        &[
            "tandem-board",
            "tandem-bus",
            "tandem-cores",
            "tandem-peripherals",
        ],
    ),
    (
        "tandem-record",
        &[
            "tandem-board",
            "tandem-bus",
            "tandem-cores",
            "tandem-redundancy",
            "tandem-vehicle",
        ],
    ),
    (
        "tandem-sim",
        &[
            "tandem-board",
            "tandem-board-sim",
            "tandem-bus",
            "tandem-cores",
            "tandem-record",
            "tandem-redundancy",
            "tandem-vehicle",
        ],
    ),
    ("tandem-board-conformance", &["tandem-board", "tandem-shm"]),
    ("tandem-board-sim", &["tandem-board", "tandem-peripherals"]),
    ("tandem-peripherals", &["tandem-board"]),
    ("tandem-cosim", &["tandem-board", "tandem-peripherals"]),
    (
        "tandem-board-qemu",
        &["tandem-board", "tandem-cosim", "tandem-peripherals"],
    ),
];
/// The top crates: these may depend on all.
const ON_TOP: [&str; 6] = [
    "tandem",
    "tandem-fuzz",
    "tandem-lab",
    "tandem-tests",
    "tandem-top",
    "xtask",
];
/// The only packages that may name iceoryx2: the host board, and the benchmarks, where it is a
/// peer.
const MAY_USE_ICEORYX2: [&str; 2] = ["tandem-board-host", "tandem-benches"];
/// Folders whose code may be unsafe; everything else forbids it.
const MAY_BE_UNSAFE: &[&str] = &[
    "board/host",
    "rtos",
    "benches",
    "tests",
    "capi",
    "firmware-port",
];
/// Folders with lock-free code: each memory order that is not relaxed names its partner there.
const NAMES_PARTNERS: &[&str] = &["shm/src/", "board/host/src/", "rtos/src/"];
const ORDERS: [&str; 4] = ["Acquire", "Release", "AcqRel", "SeqCst"];
/// The partner is named in a comment at most this many lines above.
const PARTNER_WITHIN: usize = 12;
/// No file of code is longer.
const MAX_LINES: usize = 800;
/// No line of code is wider.
const MAX_COLUMNS: usize = 100;

/// Checks everything, prints every finding, and fails if there is one.
///
/// With `save` the table of the rooms' sizes becomes what they are.
pub(crate) fn run(root: &Path, save: bool) -> Result<()> {
    let mut findings = sizes::findings(root, save)?;
    findings.extend(dependencies(root)?);
    let files = rust_files(root)?;
    findings.extend(crate::failure_modes::findings(root, &files)?);
    let mut places = Vec::new();
    for file in files {
        let text = fs::read_to_string(&file).with_context(|| file.display().to_string())?;
        let place = file.strip_prefix(root).unwrap_or(&file);
        let place = place.display().to_string();
        findings.extend(file_findings(&place, &text));
        places.push(place);
    }
    let rooms = Rooms::read(root)?;
    findings.extend(rooms.circles());
    findings.extend(names::findings(root, &rooms.public_types(), &places)?);
    findings.iter().for_each(|finding| println!("{finding}"));
    if !findings.is_empty() {
        bail!("{} findings", findings.len());
    }
    println!("tidy");
    Ok(())
}

fn dependencies(root: &Path) -> Result<Vec<String>> {
    let mut findings = Vec::new();
    for package in packages(root)? {
        let name = package.name.as_str();
        let ours = MAY_DEPEND_ON.iter().find(|(owner, _)| *owner == name);
        if ours.is_none() && !ON_TOP.contains(&name) {
            findings.push(format!("{name}: a crate that tidy does not know"));
        }
        for dependency in &package.dependencies {
            let on = dependency.name.as_str();
            // A build that counts accesses is never a product.
            let is_counting = dependency.target.as_deref() == Some("cfg(stepped)");
            if on.starts_with("iceoryx2") && !MAY_USE_ICEORYX2.contains(&name) {
                findings.push(format!("{name}: only the host board may name {on}"));
            }
            let at_run_time = dependency.kind.is_none() && !is_counting;
            let allowed = ours.is_none_or(|(_, allowed)| allowed.contains(&on));
            if at_run_time && on.starts_with("tandem") && !allowed {
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
    // A machine wrote it.
    let is_generated = place == "bus/src/dbc.rs";
    let lines = text.lines().count();
    if lines > MAX_LINES && !is_generated {
        findings.push(format!("{place}: {lines} lines; split it at {MAX_LINES}"));
    }
    for (number, line) in text.lines().enumerate() {
        // A link, and text in a string, cannot be broken.
        let breaks = !is_generated && !line.contains("http") && !line.contains('"');
        if breaks && line.chars().count() > MAX_COLUMNS {
            findings.push(format!(
                "{place}:{}: wider than {MAX_COLUMNS} columns",
                number + 1
            ));
        }
    }
    // Code that is measured in tests is in a separate module.
    let is_measurement = place.ends_with("/measure.rs");
    let is_lock_free = NAMES_PARTNERS
        .iter()
        .any(|folder| place.starts_with(folder));
    if is_lock_free && !is_measurement {
        findings.extend(orders_without_partner(place, text));
    }
    let is_crate_root = place.ends_with("src/lib.rs") || place.ends_with("src/main.rs");
    let may_be_unsafe = MAY_BE_UNSAFE.iter().any(|folder| place.starts_with(folder));
    if is_crate_root && !may_be_unsafe && !text.contains("#![forbid(unsafe_code)]") {
        findings.push(format!(
            "{place}: a crate outside {MAY_BE_UNSAFE:?} forbids unsafe code"
        ));
    }
    findings
}

/// Memory orders outside of tests without a comment that pairs them with another one, within some
/// lines above or above the item. A `compiler_fence` is exempt: it orders a thread and its own
/// handlers.
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

/// Every Rust file that is tracked by git or not ignored.
pub(crate) fn rust_files(root: &Path) -> Result<Vec<PathBuf>> {
    let output = std::process::Command::new("git")
        .current_dir(root)
        .args([
            "ls-files",
            "--cached",
            "--others",
            "--exclude-standard",
            "*.rs",
        ])
        .output()
        .context("git ls-files")?;
    let text = String::from_utf8(output.stdout).context("git ls-files")?;
    let files = text.lines().map(|line| root.join(line));
    Ok(files.filter(|file| file.exists()).collect())
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
