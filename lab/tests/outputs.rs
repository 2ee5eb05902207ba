//! Other programs read the files that this program writes.
#![allow(
    clippy::unwrap_used,
    reason = "a test ends where something is not as it must be"
)]

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write as _;
use std::fs;
use std::io::Write as _;
use std::path::Path;
use std::process::{Command, Output};

use tandem_bus::candump::{CandumpFrame, Id};
use tandem_bus::{FrameError, Message};

const DBC: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../bus/dbc/tandem.dbc");
const SCENARIOS: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../vehicle/scenarios");
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

/// Drives 70 s behind another vehicle, all cores and sensors, in virtual time. Returns the log, the
/// content of `report/candump.log`.
fn drive(folder: &Path) -> String {
    let drive = ["sim", "--closed-loop", "--only", "values:1"];
    let driven = tandem(folder, &[&drive[..], &["--out", "report"]].concat());
    let said = String::from_utf8_lossy(&driven.stderr);
    let log = fs::read_to_string(folder.join("report/candump.log"));
    log.unwrap_or_else(|error| panic!("{error}: {said}"))
}

/// Says for `cargo xtask suites` what was compared. The test runner does not capture this output.
fn compared(what: &str) {
    let _ = writeln!(std::io::stderr(), "compared: {what}");
}

/// python-can reads the same frames from ASC and BLF as from the log in candump format: of every
/// kind of frame, and of a whole drive.
#[test]
fn python_can_reads_converted_logs() {
    let test = "python_can_reads_converted_logs";
    if !python_or_skip(test, "can", "TANDEM_REQUIRE_BOOT_ORACLES") {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    fs::write(folder.join("kinds.log"), all_kinds()).unwrap();
    let frames = drive(folder).lines().count();
    for (from, log, to) in [
        ("kinds.log", "kinds.log", "drive.asc"),
        ("kinds.log", "kinds.log", "drive.blf"),
        ("report", "report/candump.log", "drive.asc"),
        ("report", "report/candump.log", "drive.blf"),
    ] {
        let lines = fs::read_to_string(folder.join(log)).unwrap();
        let converted = tandem(folder, &["can-log", from, to]);
        assert!(converted.status.success(), "{converted:?}");
        let count = oracle(folder, &["can", log, to]);
        assert_eq!(count.trim(), lines.lines().count().to_string());
    }
    compared(&format!("{frames} frames of a drive in three formats"));
}

fn hex(digits: &str) -> Vec<u8> {
    let byte = |at| u8::from_str_radix(&digits[at..at + 2], 16).unwrap();
    (0..digits.len()).step_by(2).map(byte).collect()
}

/// Each frame of a whole drive: python-can reads it from the log, cantools decodes it with the DBC
/// to the values that this product decodes, and autosar-e2e finds its protection right. The same of
/// a run with processes, if `TANDEM_DRIVE` names its folder.
#[test]
fn others_decode_each_frame_of_a_drive() {
    let test = "others_decode_each_frame_of_a_drive";
    if !python_or_skip(test, "can, cantools, e2e", "TANDEM_REQUIRE_ORACLES") {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    drive(folder);
    let [frames, ids, values, protected] = decoded_by_others(&folder.join("report"));
    assert!(ids > 20, "{ids} ids");
    compared(&format!(
        "{frames} frames of {ids} ids, {values} values, {protected} frames with protection"
    ));
    if let Some(run) = std::env::var_os("TANDEM_DRIVE") {
        let [frames, ..] = decoded_by_others(Path::new(&run));
        assert!(frames > 0, "no frame");
        compared(&format!("{frames} frames of a run"));
    }
}

/// Compares each frame of the log in this folder with what the others read. Returns the numbers of
/// frames, ids, values, and protected frames.
fn decoded_by_others(folder: &Path) -> [usize; 4] {
    let log = fs::read_to_string(folder.join("candump.log")).unwrap();
    let theirs = oracle(folder, &["decode", "candump.log", DBC]);
    let (frames, count) = (log.lines().count(), theirs.lines().count());
    assert_eq!(frames, count);
    let (mut ids, mut values, mut protected) = (BTreeSet::new(), 0, 0);
    for (line, theirs) in log.lines().zip(theirs.lines()) {
        let (_, frame) = line.rsplit_once(' ').unwrap();
        // Frames of time are classic CAN, `id#data`, the others CAN FD, `id##1data`.
        let (id, data) = frame.split_once('#').unwrap();
        let digits = data.strip_prefix("#1").unwrap_or(data);
        let id = u32::from_str_radix(id, 16).unwrap();
        let mut words = theirs.split(' ');
        let mut word = || words.next().unwrap().to_owned();
        let [their_id, their_data, is_protected] = [word(), word(), word()];
        assert_eq!(u32::from_str_radix(&their_id, 16), Ok(id), "{line}");
        assert_eq!(their_data.to_uppercase(), digits, "{line}");
        let message = match Message::decode(id, &hex(digits)) {
            Ok(message) => message,
            // Such as the bootloader's: it is in no DBC.
            Err(error) => {
                assert_eq!(error, FrameError::UnknownId, "{line}");
                assert_eq!(words.next(), None, "{line}");
                continue;
            }
        };
        let has_e2e = message.frame().has_e2e;
        assert_eq!(is_protected, if has_e2e { "1" } else { "0" }, "{line}");
        let mut read: BTreeMap<&str, f64> = words
            .map(|pair| pair.split_once('=').unwrap())
            .map(|(name, value)| (name, value.parse().unwrap()))
            .collect();
        message.values(|name, value| {
            let theirs = read.remove(name).unwrap();
            // The precision of an `f32`.
            let near = 1e-6 * value.abs().max(theirs.abs());
            let is_near = (value - theirs).abs() <= near;
            assert!(is_near, "{line}: {name} is {theirs} in cantools");
            values += 1;
        });
        let rest: Vec<&str> = read.into_keys().collect();
        let expected: &[&str] = if has_e2e { &["Counter", "Crc"] } else { &[] };
        assert_eq!(rest, expected, "{line}");
        protected += usize::from(has_e2e);
        ids.insert(id);
    }
    [frames, ids.len(), values, protected]
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

/// Makes the embedded scenarios with steps of 0.1 s and a goal after 10 s. With the steps of the
/// shipped files, 0.5 s, the checker's own integration would be too coarse for a hard brake.
fn fine_scenarios(folder: &Path) {
    let script = fs::read_to_string(format!("{SCENARIOS}/generate.py")).unwrap();
    let fine = [
        ("STEP_S = 0.5\n", "STEP_S = 0.1\n"),
        ("timeStepSize=\"0.5\"", "timeStepSize=\"0.1\""),
        (
            "<intervalStart>0</intervalStart><intervalEnd>120<",
            "<intervalStart>100</intervalStart><intervalEnd>600<",
        ),
    ];
    let script = fine.iter().fold(script, |script, (from, to)| {
        assert_eq!(script.matches(from).count(), 1, "{from}");
        script.replace(from, to)
    });
    let place = folder.join("generate.py");
    fs::write(&place, script).unwrap();
    let made = Command::new("python3").arg(&place).output().unwrap();
    assert!(made.status.success(), "{made:?}");
}

/// The drivability checker accepts this text about a drive: solved, from its start to its goal,
/// without a collision, feasible. Returns the benchmark and the number of states.
fn accepted<'a>(test: &str, said: &'a str) -> (&'a str, usize) {
    let [_, benchmark, count, verdict @ ..] = &said.split('\t').collect::<Vec<_>>()[..] else {
        panic!("{said}");
    };
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
    (*benchmark, count.parse().unwrap())
}

/// commonroad-io reads each judged drive as a solution, and the drivability checker finds it
/// feasible, without a collision, and at the goal: of the embedded scenarios, and of those in the
/// folder that `TANDEM_SCENARIOS` names.
#[test]
fn the_drivability_checker_accepts_drives() {
    let test = "the_drivability_checker_accepts_drives";
    if !python_or_skip(test, "commonroad", "TANDEM_REQUIRE_COMMONROAD") {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let files = folder.join("files");
    fs::create_dir(&files).unwrap();
    fine_scenarios(&files);
    let text = include_str!("../../vehicle/scenarios/stop-and-go.xml");
    let no_id = text.replace("<planningProblem id=\"1\"", "<planningProblem");
    fs::write(files.join("none.xml"), no_id).unwrap();
    let judge = |files: &str, to: &str| {
        let options = ["--solutions", to, "--json", "judged.json"];
        let judged = tandem(folder, &[&["judge", files], &options[..]].concat());
        assert!(judged.status.success(), "{judged:?}");
        oracle(folder, &["solutions", files, to])
    };
    let said = judge("files", "solutions");
    for said in said.lines() {
        let (benchmark, states) = accepted(test, said);
        assert!(benchmark.starts_with("ST2:JB1:ZAM_Tandem-"), "{said}");
        assert_eq!(states, 101, "{said}");
    }
    assert_eq!(said.lines().count(), 7, "{said}");
    let figures = fs::read_to_string(folder.join("judged.json")).unwrap();
    assert!(figures.contains("no solution: the planning problem has no id"));
    compared("7 drives of 10 s");

    let Some(recorded) = std::env::var_os("TANDEM_SCENARIOS") else {
        return;
    };
    let said = judge(recorded.to_str().unwrap(), "recorded");
    for said in said.lines() {
        accepted(test, said);
    }
    assert!(!said.is_empty(), "no recorded scenario has a solution");
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
