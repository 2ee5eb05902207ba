//! Tests of `tandem sim` as a user calls it.
#![forbid(unsafe_code)]
#![allow(clippy::unwrap_used, reason = "a test may panic")]

use std::fs;
use std::path::Path;
use std::process::{Command, Output};

fn sim(arguments: &[&str], folder: &Path) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_tandem-lab"));
    command.arg("sim").args(arguments).current_dir(folder);
    command.output().unwrap()
}

fn said(output: &[u8]) -> String {
    String::from_utf8_lossy(output).into_owned()
}

#[test]
fn a_campaign_ends_with_figures_and_repeats_to_the_nanosecond() {
    let folder = tempfile::tempdir().unwrap();
    let figures = |jobs: &str| {
        let arguments = [
            "--seeds", "24", "--from", "100", "--jobs", jobs, "--json", "f.json",
        ];
        let output = sim(&arguments, folder.path());
        assert!(output.status.success(), "{}", said(&output.stderr));
        let text = fs::read_to_string(folder.path().join("f.json")).unwrap();
        serde_json::from_str::<serde_json::Value>(&text).unwrap()
    };
    let [one, two] = ["1", "2"].map(figures);
    assert_eq!(one["seeds"], 24);
    assert_eq!(one["violations"], 0);
    assert_eq!(one["simulated_s"], two["simulated_s"]);
    assert_eq!(one["groups"], two["groups"]);
}

#[test]
fn a_saved_sequence_is_tried_from_its_file() {
    let folder = tempfile::tempdir().unwrap();
    let reported = sim(
        &["--only", "single:260", "--save", "one.toml"],
        folder.path(),
    );
    assert!(reported.status.success(), "{}", said(&reported.stderr));
    let again = sim(&["--faults", "one.toml", "--only", "260"], folder.path());
    let story = |output: &Output| {
        let text = said(&output.stdout);
        text.lines().skip(1).map(str::to_owned).collect::<Vec<_>>()
    };
    assert!(story(&reported).len() > 3);
    assert_eq!(story(&reported), story(&again));
}

/// The command printed for a violation has all options that are needed to repeat the violation.
#[test]
fn the_printed_line_repeats_a_violation() {
    let folder = tempfile::tempdir().unwrap();
    // Both systems lose power when the vehicle in front begins to brake.
    let off = |of| format!("[[fault]]\nwhat = \"power-loss\"\nof = \"{of}\"\nat-ms = 3000.0\n");
    let faults = format!("mended-at-ms = 12000.0\n{}{}", off("a"), off("b"));
    fs::write(folder.path().join("off.toml"), faults).unwrap();
    let profile = ["--closed-loop", "--timing", "chip", "--time", "worst"];
    let campaign = ["--faults", "off.toml", "--seeds", "1"];
    let reported = sim(&[&campaign[..], &profile].concat(), folder.path());
    let text = said(&reported.stdout);
    let line = text
        .lines()
        .find_map(|line| line.split_once(": tandem sim "));
    let (_, arguments) = line.expect("a line that repeats it");
    let arguments: Vec<&str> = arguments.split(' ').collect();
    let again = sim(&arguments, folder.path());
    assert_eq!(again.status.code(), Some(1), "{}", said(&again.stderr));
    // With only sequence 0, the digest of the campaign is the digest of that sequence.
    let digest = |text: &str| text.trim_end().rsplit(' ').next().unwrap().to_owned();
    assert!(text.contains("TooClose"), "{text}");
    assert_eq!(digest(&said(&again.stdout)), digest(&text), "{arguments:?}");
}

#[test]
fn wrong_arguments_are_refused_before_anything_runs() {
    let folder = tempfile::tempdir().unwrap();
    fs::write(
        folder.path().join("bad.toml"),
        "mended-at-ms = 1.0\nfault = [{}]\n",
    )
    .unwrap();
    for (arguments, reason) in [
        (&["--faults", "bad.toml"][..], "missing field"),
        (&["--faults", "none.toml"], "none.toml"),
        (
            &["--only", "single:99999999"],
            "there is no number 99999999",
        ),
        (&["--only", "triple:1"], "the groups are"),
        (&["--jobs", "0"], "invalid value"),
    ] {
        let output = sim(arguments, folder.path());
        assert_eq!(output.status.code(), Some(2), "{arguments:?}");
        let text = said(&output.stderr);
        assert!(text.contains(reason), "{arguments:?}: {text}");
        assert!(output.stdout.is_empty());
    }
}
