//! What is wrong is said before anything starts, and nothing is changed.

use std::fs;
use std::process::Command;

use crate::fixture::Fixture;

/// The command must refuse these arguments and say all of `words`.
fn refuses(fixture: &Fixture, args: &[&str], words: &[&str]) {
    let before = fixture.names();
    let output = fixture.output(args);
    let said = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(2), "{args:?}: {said}");
    for word in words {
        assert!(
            said.contains(word),
            "{args:?} does not say {word:?}: {said}"
        );
    }
    assert!(output.stdout.is_empty(), "{args:?}");
    assert_eq!(fixture.names(), before, "{args:?} has left something");
}

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

/// Long work does not begin if its results would be lost.
#[test]
fn a_result_that_cannot_be_written() {
    let fixture = Fixture::new();
    for command in [
        &["sim", "--seeds", "1000000", "--json"][..],
        &["sim", "--only", "random:1", "--save"],
        &["thesis", "--board", "sim", "--json"],
        &["thesis", "--board", "sim", "--svg"],
    ] {
        refuses(&fixture, &[command, &["."]].concat(), &["it is a folder"]);
        let missing = &[command, &["no/such/file"]].concat();
        refuses(&fixture, missing, &["create it first"]);
    }
    let twice = ["thesis", "--board", "sim", "--json", "x", "--svg", "x"];
    refuses(&fixture, &twice, &["the same file"]);
}

/// The benchmark is a program of its own. Where it is missing, the command says what builds it.
#[test]
fn a_benchmark_that_is_not_built() {
    let fixture = Fixture::new();
    let alone = fixture.folder().join("alone");
    fs::copy(env!("CARGO_BIN_EXE_tandem"), &alone).unwrap();
    let output = Command::new(&alone).args(["bench", "--quick"]).output();
    let output = output.unwrap();
    let said = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(2), "{said}");
    assert!(
        said.contains("cargo build --release -p tandem-benches"),
        "{said}"
    );
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

/// A campaign that cannot be is refused before a run starts.
#[test]
fn a_campaign_that_cannot_be() {
    let fixture = Fixture::new();
    for (name, text) in [
        ("none.toml", "mended-at-ms = 1.0\nfault = [{}]\n"),
        (
            "clock.toml",
            "mended-at-ms = 1.0\n[[fault]]\nwhat = \"clock\"\nof = \"a\"\nat-ms = 0.0\namount = 5\n",
        ),
        (
            "power-on.toml",
            "from-power-on = true\nmended-at-ms = 1.0\nfault = []\n",
        ),
        (
            "supply.toml",
            "mended-at-ms = 1.0\n[[fault]]\nwhat = \"supply-hangs\"\nof = \"a\"\nat-ms = 0.0\n\
             amount = 5\n",
        ),
    ] {
        fs::write(fixture.folder().join(name), text).unwrap();
    }
    for (args, word) in [
        (&["chaos", "--faults", "none.toml"][..], "missing field"),
        (
            &["chaos", "--faults", "clock.toml"],
            "clock: processes cannot suffer it",
        ),
        (&["chaos", "--faults", "power-on.toml"], "only `tandem sim`"),
        (&["chaos", "--matrix", "--only", "99999"], "no cell 99999"),
        (&["chaos", "--count", "0"], "no fault"),
        (&["chaos", "--json", "no/such/c.json"], "no/such"),
        (
            &["sim", "--faults", "supply.toml"],
            "only processes suffer it",
        ),
    ] {
        refuses(&fixture, args, &[word]);
    }
}
