//! Tests `tandem flash` and `tandem bootloader` over CAN on UDP, in a separate network namespace.
#![allow(clippy::unwrap_used)]

#[path = "../../tests/json/schema.rs"]
mod schema;

use std::fs;
use std::io::Write as _;
use std::process::Command;

/// Sets up the network, a key, and a file for each slot, before the script of the test.
const SETUP: &str = "
set -e
ip link set lo up multicast on
ip route add 224.0.0.0/4 dev lo
openssl genpkey -algorithm ed25519 -outform DER -out key.der
openssl pkey -inform DER -in key.der -pubout -outform DER -out key.pub.der
for slot in 0x40100 0x100100; do
    at=\"--change-section-address .data=$slot --set-start $slot\"
    objcopy -I binary -O srec $at app.bin $slot.srec
done
bootloader() { \"$TANDEM\" bootloader --flash a.flash --public key.pub.der \"$@\"; }
flash() { \"$TANDEM\" flash --key key.der --wait 60 \"$@\" 2>&1; }
";

/// Runs the script and returns its output, or `None` if a tool is missing; this is then printed.
fn run(test: &str, script: &str) -> Option<String> {
    for tool in [
        "unshare -rn true",
        "ip -V",
        "openssl version",
        "objcopy --version",
    ] {
        let output = Command::new("sh").args(["-c", tool]).output();
        if !output.is_ok_and(|output| output.status.success()) {
            let _ = writeln!(std::io::stderr(), "{test}: skipped: `{tool}` does not work");
            return None;
        }
    }
    let folder = tempfile::tempdir().unwrap();
    fs::write(folder.path().join("app.bin"), [7; 3000]).unwrap();
    let output = Command::new("unshare")
        .args(["-rn", "sh", "-c", &format!("{SETUP}{script}")])
        .env("TANDEM", env!("CARGO_BIN_EXE_tandem-lab"))
        .current_dir(folder.path())
        .output()
        .unwrap();
    let error = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{error}");
    Some(String::from_utf8(output.stdout).unwrap())
}

/// T-BOOT-1, T-BOOT-3, U-3: a file is signed, sent, verified and started. It is rolled back unless
/// approved, and a downgrade is refused.
#[test]
fn a_file_is_signed_sent_and_started() {
    let script = "
        flash 0x40100.srec --release 1 & bootloader; wait
        bootloader --approve
        flash 0x100100.srec --release 2 --to A & bootloader --requested; wait
        bootloader
        flash 0x100100.srec --release 0 & bootloader --requested; wait
        echo starts $(bootloader --json)
        $TANDEM flash --info --to A --json >info.json & bootloader --requested >started.txt; wait
        echo holds $(cat info.json)
    ";
    let Some(said) = run("a_file_is_signed_sent_and_started", script) else {
        return;
    };
    let (shown, documents) = said.split_once("starts {").unwrap();
    let count = |text| shown.matches(text).count();
    assert_eq!(count("verified by the bootloader"), 2, "{said}");
    assert_eq!(count("slot A, version 1"), 3, "{said}");
    assert_eq!(count("slot B, version 2, entries 0x100100"), 1, "{said}");
    assert_eq!(count("Downgrade"), 1, "{said}");
    let (starts, holds) = documents.split_once("holds ").unwrap();
    schema::fits("bootloader", format!("{{{starts}").as_bytes());
    schema::fits("flash-info", holds.as_bytes());
}
