//! Other programs read the files that this program writes.
#![allow(
    clippy::unwrap_used,
    reason = "a test ends where something is not as it must be"
)]

use std::fmt::Write as _;
use std::fs;
use std::io::Write as _;
use std::path::Path;
use std::process::{Command, Output};

use tandem_bus::candump::{CandumpFrame, Id};

const SCRIPT: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/outputs.py");

/// Returns whether Python has these packages. Without them a test passes and prints that it was
/// skipped; if the variable is 1 it fails.
fn python_or_skip(test: &str, modules: &str, require: &str) -> bool {
    let import = format!("import {modules}");
    let import = Command::new("python3").args(["-c", &import]).output();
    if import.is_ok_and(|output| output.status.success()) {
        return true;
    }
    let required = std::env::var_os(require).is_some_and(|value| value == "1");
    assert!(!required, "{test}: {modules}: not installed");
    // The test runner does not capture this output, so a skipped test is visible.
    let _ = writeln!(
        std::io::stderr(),
        "{test}: skipped: no Python with {modules}"
    );
    false
}

fn tandem(folder: &Path, arguments: &[&str]) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_tandem-lab"));
    command.args(arguments).current_dir(folder);
    command.output().unwrap()
}

/// Runs the script, and returns what it prints.
fn oracle(folder: &Path, arguments: &[&str]) -> String {
    let mut command = Command::new("python3");
    command.arg(SCRIPT).args(arguments).current_dir(folder);
    // The checker of solutions needs an older commonroad-io than the reader of scenarios.
    if let Some(older) = std::env::var_os("TANDEM_COMMONROAD_CHECKER") {
        command.env("PYTHONPATH", older);
    }
    let output = command.output().unwrap();
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{arguments:?}: {said}");
    String::from_utf8(output.stdout).unwrap()
}

/// A frame of every length and kind, on two buses.
fn all_kinds() -> String {
    let bytes: Vec<u8> = (0..64_u8).map(|it| it.wrapping_mul(37)).collect();
    let mut log = String::new();
    // python-can takes a CAN FD frame without data for a remote frame, which CAN FD does not have.
    let long = (1..=8).chain([12, 16, 20, 24, 32, 48, 64]);
    let kinds = (0..=8)
        .map(|it| (false, it))
        .chain(long.map(|it| (true, it)));
    for (index, (is_fd, length)) in kinds.enumerate() {
        for (bus, interface) in ["can0", "vcan7"].into_iter().enumerate() {
            for (kind, id) in [Id::Standard(0x7FF), Id::Extended(0x7F), Id::Standard(0)]
                .into_iter()
                .enumerate()
            {
                let frame = CandumpFrame {
                    at_us: 1_763_509_052_249_713 + (index * 100_003 + bus * 70 + kind) as u64,
                    interface,
                    id,
                    is_fd,
                    data: &bytes[..length],
                };
                writeln!(log, "{frame}").unwrap();
            }
        }
    }
    log
}

/// python-can reads the same frames from ASC and BLF as from the log in candump format: of every
/// kind of frame, and of a drive in virtual time.
#[test]
fn python_can_reads_converted_logs() {
    let test = "python_can_reads_converted_logs";
    if !python_or_skip(test, "can", "TANDEM_REQUIRE_BOOT_ORACLES") {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    fs::write(folder.join("kinds.log"), all_kinds()).unwrap();
    let drive = ["sim", "--only", "random:1", "--out", "report"];
    let driven = tandem(folder, &drive);
    let said = String::from_utf8_lossy(&driven.stderr);
    assert!(folder.join("report/candump.log").exists(), "{said}");
    for (from, log) in [("kinds.log", "kinds.log"), ("report", "report/candump.log")] {
        let lines = fs::read_to_string(folder.join(log)).unwrap();
        for to in ["drive.asc", "drive.blf"] {
            let converted = tandem(folder, &["can-log", from, to]);
            assert!(converted.status.success(), "{converted:?}");
            let count = oracle(folder, &["can", log, to]);
            assert_eq!(count.trim(), lines.lines().count().to_string());
        }
    }
}

/// A log or a name that is wrong is an error of usage, and no file is written.
#[test]
fn what_is_no_log_is_not_converted() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let good = "(0000000012.000345) can1 0CFF0127#E230\n";
    fs::write(folder.join("good.log"), good).unwrap();
    fs::write(folder.join("bad.log"), format!("{good}(12) can1\n")).unwrap();
    fs::write(folder.join("empty.log"), "\n").unwrap();
    for (arguments, word) in [
        (["good.log", "drive.txt"], ".asc or .blf"),
        (["good.log", "no/drive.asc"], "create it first"),
        (["none.log", "drive.asc"], "none.log"),
        (["bad.log", "drive.asc"], "bad.log: line 2"),
        (["empty.log", "drive.asc"], "no frame"),
        ([".", "drive.asc"], "candump.log"),
    ] {
        let output = tandem(folder, &[&["can-log"], &arguments[..]].concat());
        let said = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(2), "{arguments:?}: {said}");
        assert!(said.contains(word), "{arguments:?}: {said}");
    }
    assert_eq!(fs::read_dir(folder).unwrap().count(), 3);
}

/// commonroad-io reads each drive as a solution, and the drivability checker finds it feasible,
/// without a collision, and at the goal.
#[test]
fn the_drivability_checker_accepts_drives() {
    let test = "the_drivability_checker_accepts_drives";
    if !python_or_skip(test, "commonroad", "TANDEM_REQUIRE_COMMONROAD") {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    fs::create_dir(folder.join("files")).unwrap();
    // Shorter steps, and a goal that is reached after 6 s.
    let text = include_str!("../../vehicle/scenarios/stop-and-go.xml")
        .replace("timeStepSize=\"0.5\"", "timeStepSize=\"0.1\"");
    let (before, goal) = text.split_once("<goalState>").unwrap();
    let start = "<intervalStart>0</intervalStart>";
    let later = goal.replacen(start, "<intervalStart>60</intervalStart>", 1);
    fs::write(
        folder.join("files/later.xml"),
        format!("{before}<goalState>{later}"),
    )
    .unwrap();
    fs::write(
        folder.join("files/none.xml"),
        text.replace("<planningProblem id=\"1\"", "<planningProblem"),
    )
    .unwrap();
    let judge = ["judge", "files", "--duration", "10s"];
    let files = ["--solutions", "solutions", "--json", "judged.json"];
    let judged = tandem(folder, &[&judge[..], &files].concat());
    assert!(judged.status.success(), "{judged:?}");
    let names: Vec<_> = fs::read_dir(folder.join("solutions")).unwrap().collect();
    assert_eq!(names.len(), 1, "{names:?}");
    let figures = fs::read_to_string(folder.join("judged.json")).unwrap();
    assert!(figures.contains("no solution: the planning problem has no id"));

    let arguments = [
        "solution",
        "files/later.xml",
        "solutions/solution_later.xml",
    ];
    let said = oracle(folder, &arguments);
    let lines: Vec<&str> = said.lines().collect();
    let [benchmark, count, verdict @ ..] = &lines[..] else {
        panic!("{said}");
    };
    assert!(benchmark.starts_with("ST2:JB1:ZAM_Tandem-"), "{said}");
    assert_eq!(*count, "61");
    let required = std::env::var_os("TANDEM_REQUIRE_SOLUTION_CHECKER").is_some_and(|it| it == "1");
    match verdict {
        [why] if why.starts_with("checker: ") && !required => {
            let _ = writeln!(std::io::stderr(), "{test}: no verdict: {why}");
        }
        _ => {
            assert_eq!(verdict.len(), 5, "{said}");
            assert!(verdict.iter().all(|it| it.ends_with(": yes")), "{said}");
        }
    }
}

/// bash accepts its completions, which offer the commands and the arguments of those that other
/// programs implement; there is a man page of each.
#[test]
fn bash_completes_the_commands() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    for shell in ["zsh", "fish", "elvish", "powershell"] {
        let printed = tandem(folder, &["completions", shell]);
        assert!(printed.status.success() && !printed.stdout.is_empty());
    }
    assert_eq!(tandem(folder, &["completions", "x"]).status.code(), Some(2));
    let printed = tandem(folder, &["completions", "bash"]);
    fs::write(folder.join("tandem.bash"), &printed.stdout).unwrap();
    let bash = |script: &str| {
        let mut bash = Command::new("bash");
        let output = bash.args(["-c", script]).current_dir(folder).output();
        let output = output.unwrap();
        assert!(output.status.success(), "{script}: {output:?}");
        String::from_utf8(output.stdout).unwrap()
    };
    bash("bash -n tandem.bash");
    for (words, expected) in [
        ("tandem ''", "run"),
        ("tandem ju", "judge"),
        ("tandem judge --so", "--solutions"),
        ("tandem top --r", "--run"),
        ("tandem run --board q", "qemu"),
    ] {
        let script = format!(
            "source tandem.bash; COMP_WORDS=({words}); COMP_CWORD=$((${{#COMP_WORDS[@]}} - 1)); \
             _tandem tandem \"${{COMP_WORDS[COMP_CWORD]}}\" \"${{COMP_WORDS[COMP_CWORD - 1]}}\"; \
             printf '%s\\n' \"${{COMPREPLY[@]}}\""
        );
        let offered = bash(&script);
        assert!(
            offered.lines().any(|it| it == expected),
            "{words}: {offered}"
        );
    }
    assert!(tandem(folder, &["man", "pages"]).status.success());
    let page = |name: &str| fs::read_to_string(folder.join("pages").join(name)).unwrap();
    assert!(page("tandem.1").contains("judge"));
    assert!(page("tandem-judge.1").contains("solutions"));
    assert!(page("tandem-dflash-init.1").contains("master"));
    assert!(!folder.join("pages/tandem-publish.1").exists());
}
