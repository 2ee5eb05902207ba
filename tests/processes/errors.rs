//! Tests that errors are reported before anything starts, and that nothing is changed.

use std::fs;
use std::process::Command;

use crate::fixture::{Fixture, refuses};

#[test]
fn a_scenario_that_is_none() {
    let fixture = Fixture::new();
    refuses(
        &fixture,
        &["run", "--scenario", "cutin"],
        &["cutin", "did you mean", "cut-in"],
    );
    refuses(
        &fixture,
        &["run", "--scenario", "no/such.xml"],
        &["no/such.xml"],
    );
    for (name, text) in [
        ("empty.xml", ""),
        ("cut.xml", "<commonRoad><lanelet id=\"1\">"),
        ("other.xml", "<html/>"),
        ("binary.xml", "\0\u{1}\u{2}"),
    ] {
        fs::write(fixture.folder().join(name), text).unwrap();
        refuses(&fixture, &["run", "--scenario", name], &[name]);
    }
    refuses(&fixture, &["run", "--scenario", "."], &["."]);
    refuses(
        &fixture,
        &["run", "--scenario", "/dev/null"],
        &["no regular file"],
    );
}

#[test]
fn a_duration_that_is_none() {
    let fixture = Fixture::new();
    for duration in ["0", "-5", "NaN", "inf", "soon", "0s", "1e99", ""] {
        refuses(&fixture, &["run", "--duration", duration], &["--duration"]);
    }
}

#[test]
fn a_folder_that_cannot_take_a_report() {
    let fixture = Fixture::new();
    fs::write(fixture.folder().join("file"), "mine").unwrap();
    fs::create_dir(fixture.folder().join("full")).unwrap();
    fs::write(fixture.folder().join("full/thesis.txt"), "mine").unwrap();
    fs::create_dir(fixture.folder().join("folder")).unwrap();
    for (out, words) in [
        ("file", "it is a file"),
        ("full", "thesis.txt"),
        ("no/such/folder", "create it first"),
        // Not even root can create a folder there.
        ("/proc/report", "cannot write"),
        (".", "current folder"),
        ("/", "root folder"),
        ("/dev/shm/report", "of its own"),
    ] {
        refuses(&fixture, &["run", "--out", out], &["--out", words]);
    }
    assert_eq!(
        fs::read_to_string(fixture.folder().join("full/thesis.txt")).unwrap(),
        "mine"
    );
}

/// Some commands are separate programs. If one is missing, the command names the package to build.
#[test]
fn a_program_that_is_not_built() {
    let fixture = Fixture::new();
    let alone = fixture.folder().join("alone");
    fs::copy(crate::PROGRAM, &alone).unwrap();
    for (args, package) in [
        (&["bench", "--quick"][..], "tandem-benches"),
        (&["sim", "--seeds", "1"], "tandem-lab"),
        (&["run", "--board", "qemu"], "tandem-lab"),
        (&["help", "top"], "tandem-top"),
        (&["web"], "tandem-web"),
    ] {
        let output = Command::new(&alone).args(args).output().unwrap();
        let said = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(2), "{said}");
        let builds = format!("cargo build --release -p {package}");
        assert!(said.contains(&builds), "{said}");
    }
}

#[test]
fn a_machine_that_is_not_there() {
    let fixture = Fixture::new();
    refuses(
        &fixture,
        &["run", "--cpus", "4000"],
        &["--cpus", "4000", "may use"],
    );
    refuses(&fixture, &["run", "--cpus", "one"], &["--cpus"]);
    refuses(
        &fixture,
        &["run", "--dflash", "missing"],
        &["--dflash", "missing"],
    );
    refuses(&fixture, &["run", "--timing", "soon"], &["--timing"]);
    refuses(&fixture, &["drive"], &["drive"]);
}

#[test]
fn a_reader_that_has_seen_enough_is_no_error() {
    let fixture = Fixture::new();
    let mut child = fixture
        .command(&["scenarios"])
        .stdout(std::process::Stdio::piped())
        .spawn()
        .unwrap();
    drop(child.stdout.take());
    assert!(child.wait().unwrap().success());
}
