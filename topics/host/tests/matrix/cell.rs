//! One cell: a process in a network of its own, with a watchdog.

use crate::peer::Vendor;
use std::fs::OpenOptions;
use std::io::Write as _;
use std::process::Command;
use std::time::Duration;

/// Set in the process that runs a cell.
const INSIDE: &str = "TANDEM_MATRIX_INSIDE";
/// Names a file to which each cell adds a line: name, result, figure.
const RESULTS: &str = "TANDEM_MATRIX_RESULTS";
/// If it is 1, no cell may be skipped because a peer is not installed.
const REQUIRE: &str = "TANDEM_REQUIRE_CYCLONEDDS";
/// A line with this begins a measured figure.
const FIGURE: &str = "FIGURE: ";
/// The longest time of a cell. On an idle machine it takes up to 7 s.
const WATCHDOG: Duration = Duration::from_secs(300);
/// Makes a network with a loopback device that has multicast, and runs a program in it.
const NETWORK: &str =
    "ip link set lo up multicast on && ip route add 224.0.0.0/4 dev lo && exec \"$@\"";

/// Two peers: the writer, and the reader.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Pair(pub(crate) Vendor, pub(crate) Vendor);

/// Runs a cell. Its test has the name `KIND::WRITER_to_READER`.
pub(crate) fn cell(kind: &str, pair: Pair, body: fn(Pair)) {
    let name = format!("{kind}::{}_to_{}", pair.0.name(), pair.1.name());
    if std::env::var_os(INSIDE).is_some() {
        std::thread::spawn(move || {
            std::thread::sleep(WATCHDOG);
            println!("{name}: the watchdog ends it after {WATCHDOG:?}");
            std::process::exit(1);
        });
        body(pair);
        return;
    }
    let peer = pair.0.missing().or_else(|| pair.1.missing());
    let required = std::env::var_os(REQUIRE).is_some_and(|one| one == "1");
    assert!(
        !required || peer.is_none(),
        "{name}: {REQUIRE} is 1: {peer:?}"
    );
    if let Some(missing) = no_networks().or(peer) {
        println!("SKIPPED: {name}: {missing}");
        note(&name, "skipped", &missing);
        return;
    }
    // When the first process of a namespace ends, the kernel ends all others in it.
    let output = Command::new("unshare")
        .args(["-rnpf", "--kill-child", "sh", "-c", NETWORK, "sh"])
        .arg(std::env::current_exe().unwrap())
        .args(["--exact", &name, "--nocapture"])
        .env(INSIDE, "1")
        .output()
        .unwrap();
    let said = String::from_utf8_lossy(&output.stdout);
    print!("{said}{}", String::from_utf8_lossy(&output.stderr));
    let mut lines = said.lines().rev();
    let figure = lines.find_map(|line| line.strip_prefix(FIGURE));
    let has_passed = output.status.success() && said.contains("1 passed");
    let result = if has_passed { "passed" } else { "failed" };
    note(&name, result, figure.unwrap_or_default());
    assert!(has_passed, "{name}: {}", output.status);
}

/// Prints a measured figure of this cell; the last one counts.
pub(crate) fn figure(text: &str) {
    // The harness has not ended its line.
    println!("\n{FIGURE}{text}");
}

/// Returns what this machine lacks to make a network.
fn no_networks() -> Option<String> {
    let works = |program: &str, arguments: &[&str]| {
        let output = Command::new(program).args(arguments).output();
        output.is_ok_and(|output| output.status.success())
    };
    if !works("unshare", &["-rnpf", "--kill-child", "true"]) {
        return Some("no `unshare -rnpf --kill-child`".to_owned());
    }
    (!works("ip", &["-V"])).then(|| "no `ip`, of iproute2".to_owned())
}

/// Adds the result of a cell to the file that `TANDEM_MATRIX_RESULTS` names.
fn note(name: &str, result: &str, text: &str) {
    let Some(path) = std::env::var_os(RESULTS) else {
        return;
    };
    let mut file = OpenOptions::new()
        .append(true)
        .create(true)
        .open(path)
        .unwrap();
    file.write_all(format!("{name}\t{result}\t{text}\n").as_bytes())
        .unwrap();
}
