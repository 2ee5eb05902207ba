//! What a run shows on a terminal, and that it writes no control characters anywhere else.

use std::process::Command;

use crate::fixture::Fixture;

/// Moves to the first column, and clears the line.
const CLEAR: &str = "\r\x1b[2K";

/// On a terminal one line shows the time of the drive and the roles, and is cleared at the end. The
/// first line after it is the verdict.
#[test]
fn a_terminal_shows_the_progress_and_then_the_verdict() {
    if Command::new("script").arg("--version").output().is_err() {
        eprintln!("a_terminal_shows_the_progress_and_then_the_verdict: skipped: no `script`");
        return;
    }
    let fixture = Fixture::new();
    let run = format!("{} run --duration 4 --out report", crate::PROGRAM);
    let output = Command::new("script")
        .args(["-qec", &run, "/dev/null"])
        .current_dir(fixture.folder())
        .output()
        .unwrap();
    let shown = String::from_utf8_lossy(&output.stdout);
    let progress: Vec<&str> = shown.split(CLEAR).skip(1).collect();
    assert!(progress.len() > 20, "{shown}");
    for words in ["  1.", "  3.", "/4 s", "km/h", "master"] {
        assert!(
            progress.iter().any(|it| it.contains(words)),
            "{words}: {shown}"
        );
    }
    let (summary, lines) = progress.split_last().unwrap();
    assert!(lines.iter().all(|it| !it.contains('\n')), "{shown}");
    let first = summary.lines().next().unwrap().trim();
    let (name, verdict) = first.split_once(' ').unwrap();
    assert_eq!(name, "verdict", "{shown}");
    let verdicts = ["good: ", "failed: ", "not judged: "];
    assert!(
        verdicts.iter().any(|it| verdict.trim().starts_with(it)),
        "{first}"
    );
}

/// Without a terminal there is text only.
#[test]
fn without_a_terminal_there_are_no_control_characters() {
    let fixture = Fixture::new();
    let output = fixture.output(&["run", "--duration", "2", "--out", "report"]);
    assert!(output.stdout.starts_with(b"  verdict "));
    for text in [output.stdout, output.stderr] {
        let text = String::from_utf8(text).unwrap();
        let control = text.chars().find(|it| it.is_control() && *it != '\n');
        assert_eq!(control, None, "{text:?}");
    }
}
