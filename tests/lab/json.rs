//! What the commands of `tandem-lab` print with `--json`: documents of the schemas in
//! `docs/schemas`, and nothing else.

use std::fs;
use std::process::Command;

use tandem_page::command_line::EXIT_STATUS;

use crate::fixture::{Fixture, refuses};
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
    // A word behind the option is the file if it has its suffix; else it is an argument.
    let judge = ["judge", "--json", "scenarios", "--duration", "1"];
    let judged = printed(&fixture, &judge, &[0]);
    fits("judge", &judged);
    let judge = ["judge", "--json", "j.json", "scenarios", "--duration", "1"];
    let text = String::from_utf8(printed(&fixture, &judge, &[0])).unwrap();
    assert!(text.contains("2 files: 1 driven"), "{text}");
    let written = fs::read(fixture.folder().join("j.json")).unwrap();
    assert_eq!(written, judged);
    let two = two_problems(good);
    fs::write(folder.join("two.xml"), &two).unwrap();
    let judge = ["judge", "scenarios", "--duration", "1", "--json"];
    let judged = printed(&fixture, &judge, &[0]);
    fits("judge", &judged);
    let rows: Vec<serde_json::Value> = serde_json::from_slice(&judged).unwrap();
    let row = |it: &serde_json::Value| (it["problem"].as_i64(), it["verdict"].to_string());
    let (driven, refused) = ("\"driven\"".to_owned(), "\"refused\"".to_owned());
    let expected = [
        (None, refused.clone()),
        (Some(20), driven.clone()),
        (Some(20), driven.clone()),
        (Some(21), refused),
        (Some(22), driven),
    ];
    assert_eq!(rows.iter().map(row).collect::<Vec<_>>(), expected);
    let speed = |at: usize| rows[at]["distance_m"].as_f64().unwrap();
    assert!(speed(4) < speed(2) - 2.0, "{} {}", speed(4), speed(2));
    let words = ["judge", "scenarios", "--duration", "1", "--html", "a.html"];
    let words = [&words[..], &["--solutions", "solved"]].concat();
    let text = String::from_utf8(printed(&fixture, &words, &[0])).unwrap();
    assert!(text.contains("\ntwo.xml problem 22 "), "{text}");
    assert!(
        text.contains("3 files, 5 planning problems: 3 driven"),
        "{text}"
    );
    let page = fs::read_to_string(fixture.folder().join("a.html")).unwrap();
    assert!(page.contains("two.xml problem 22<"));
    let solved = fs::read_to_string(fixture.folder().join("solved/solution_two-22.xml")).unwrap();
    assert!(solved.contains("planningProblem=\"22\""), "{solved}");
    let one = "judge scenarios/two.xml --duration 1 --problem 22 --out report --json";
    let one: Vec<&str> = one.split(' ').collect();
    let rows: Vec<serde_json::Value> =
        serde_json::from_slice(&printed(&fixture, &one, &[0])).unwrap();
    assert_eq!(rows.iter().map(row).collect::<Vec<_>>(), expected[4..]);
    let figures = fs::read_to_string(fixture.folder().join("report/metrics.json")).unwrap();
    assert!(figures.contains("planning problem 22 (3 of 3)"));
    for (words, said) in [
        (
            "judge scenarios/two.xml --problem 7",
            "has the planning problems 20, 21, 22",
        ),
        (
            "judge scenarios --problem 20",
            "--problem is for one file; there are 3",
        ),
        (
            "judge scenarios/two.xml --out x",
            "choose one with --problem: 20, 21, 22",
        ),
    ] {
        refuses(&fixture, &words.split(' ').collect::<Vec<_>>(), &[said]);
    }
    let thesis = ["thesis", "--board", "sim", "--json"];
    fits("thesis", &printed(&fixture, &thesis, &[0]));
}

/// Returns a scenario with two further planning problems: 21 begins beside the road, 22 slowly.
fn two_problems(good: &str) -> String {
    let (first, rest) = good.split_once("<planningProblem id=\"20\">").unwrap();
    let (problem, _) = rest.split_once("</planningProblem>").unwrap();
    let beside = problem.replacen("<y>0<", "<y>900<", 1);
    let slow = problem.replacen("<exact>12<", "<exact>6<", 1);
    let further = [("20", problem), ("21", &beside), ("22", &slow)];
    let further =
        further.map(|(id, it)| format!("<planningProblem id=\"{id}\">{it}</planningProblem>"));
    format!("{first}{}</commonRoad>", further.concat())
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
