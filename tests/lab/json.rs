//! What the commands of `tandem-lab` print with `--json`: documents of the schemas in
//! `docs/schemas`, and nothing else.

use std::fs;
use std::process::Command;

use tandem_page::command_line::EXIT_STATUS;

use crate::fixture::Fixture;
use crate::schema::fits;

/// Runs the command; returns what it prints. `statuses` are those that it may end with.
fn printed(fixture: &Fixture, words: &[&str], statuses: &[i32]) -> Vec<u8> {
    let output = fixture.output(words);
    let said = String::from_utf8_lossy(&output.stderr);
    let status = output.status.code().unwrap();
    assert!(statuses.contains(&status), "{words:?}: {status}: {said}");
    output.stdout
}

#[test]
fn documents_in_virtual_time_fit_their_schemas() {
    let fixture = Fixture::new();
    let sim = ["sim", "--seeds", "40", "--json"];
    fits("sim", &printed(&fixture, &sim, &[0]));
    let values = [
        "sim",
        "--group",
        "values",
        "--closed-loop",
        "--every",
        "400",
    ];
    let values = printed(&fixture, &[&values[..], &["--json"]].concat(), &[0, 1]);
    fits("sim", &values);
    fs::write(fixture.folder().join("one.json"), &values).unwrap();
    let merged = ["sim", "--merge", "one.json", "--json=-"];
    fits("sim", &printed(&fixture, &merged, &[0, 1]));
    let folder = fixture.folder().join("scenarios");
    fs::create_dir(&folder).unwrap();
    let good = include_str!("../../vehicle/fixtures/commonroad/sign-2020a.xml");
    for (name, text) in [("good.xml", good), ("broken.xml", "<broken")] {
        fs::write(folder.join(name), text).unwrap();
    }
    // A word behind the option is an argument, as behind any flag; with the file's suffix, the file.
    let judge = ["judge", "--json", "scenarios", "--duration", "1"];
    let judged = printed(&fixture, &judge, &[0]);
    fits("judge", &judged);
    let judge = ["judge", "--json", "j.json", "scenarios", "--duration", "1"];
    let text = String::from_utf8(printed(&fixture, &judge, &[0])).unwrap();
    assert!(text.contains("2 files: 1 driven"), "{text}");
    let written = fs::read(fixture.folder().join("j.json")).unwrap();
    assert_eq!(written, judged);
    let thesis = ["thesis", "--board", "sim", "--json"];
    fits("thesis", &printed(&fixture, &thesis, &[0]));
}

#[test]
fn the_document_of_the_chain_of_time_fits_its_schema() {
    let words = ["time", "--board", "sim", "--json"];
    fits("time-sim", &printed(&Fixture::new(), &words, &[0]));
}

#[test]
fn documents_of_processes_fit_their_schemas() {
    let fixture = Fixture::alone();
    let rtos = ["rtos-demo", "--json"];
    fits("rtos-demo", &printed(&fixture, &rtos, &[0]));
    // On a busy machine a fault may break a bound.
    let chaos = ["chaos", "--count", "2", "--json"];
    fits("chaos", &printed(&fixture, &chaos, &[0, 1]));
}

/// Each help text of this program has the exit statuses.
#[test]
fn each_help_has_the_exit_statuses() {
    for command in [
        "run",
        "can-log",
        "judge",
        "sim",
        "chaos",
        "thesis",
        "time",
        "rtos-demo",
        "boot-demo",
        "flash",
        "bootloader",
        "completions",
        "man",
    ] {
        let mut program = Command::new(crate::PROGRAM);
        let output = program.args([command, "--help"]).output().unwrap();
        let help = String::from_utf8(output.stdout).unwrap();
        assert!(help.contains(EXIT_STATUS), "{command}: {help}");
    }
}
