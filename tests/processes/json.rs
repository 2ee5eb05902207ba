//! What the commands of `tandem` print with `--json`: documents of the schemas in `docs/schemas`,
//! and nothing else.

use std::fs;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use serde_json::Value;
use tandem_page::command_line::EXIT_STATUS;

use crate::fixture::{Fixture, refuses};
use crate::place::own_place;
use crate::schema::{fits, lines_fit};

/// Runs a command that succeeds, and returns what it prints.
fn printed(fixture: &Fixture, words: &[&str]) -> Vec<u8> {
    let output = fixture.output(words);
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{words:?}: {said}");
    output.stdout
}

/// Commands without a run.
#[test]
fn documents_without_a_run_fit_their_schemas() {
    let fixture = Fixture::new();
    fits("scenarios", &printed(&fixture, &["scenarios", "--json"]));
    fits("ps", &printed(&fixture, &["ps", "--json"]));
    for command in ["show", "init", "show", "clear"] {
        fits("dflash", &printed(&fixture, &["dflash", command, "--json"]));
    }
    fits("boot-demo", &printed(&fixture, &["boot-demo", "--json"]));
    // With FILE the document goes there, and the text stays.
    for (words, schema) in [
        (&["scenarios"][..], "scenarios"),
        (&["ps"], "ps"),
        (&["dflash", "show"], "dflash"),
    ] {
        let text = printed(&fixture, words);
        let with_file = [words, &["--json=x"]].concat();
        assert_eq!(printed(&fixture, &with_file), text, "{words:?}");
        fits(schema, &fs::read(fixture.folder().join("x")).unwrap());
    }
}

/// A run, and the commands that look at it.
#[test]
fn documents_of_a_run_fit_their_schemas() {
    let (fixture, own) = (Fixture::new(), own_place());
    let domain = own.place.domain().to_string();
    let words = ["--soc", "5", "--grandmaster", "--duration", "30", "--quiet"];
    let mut run = fixture.run(&[&["--domain", &domain], &words[..]].concat());
    run.until_dual();
    fits("ps", &printed(&fixture, &["ps", "--json"]));
    let on_domain = |words: &[&str]| {
        let place = ["--json", "--domain", &domain, "--for", "1s"];
        printed(&fixture, &[&["topics"], words, &place].concat())
    };
    fits("topics-list", &on_domain(&["list"]));
    for table in ["rate", "age", "loss"] {
        fits("topics-rate", &on_domain(&[table]));
    }
    lines_fit("topics-echo", &on_domain(&["echo", "vehicle/can"]));
    let name = crate::observers::observer(&run).run().to_string();
    let time = ["time", &name, "--duration", "1s", "--json"];
    fits("time", &printed(&fixture, &time));
    run.end();
    fits("run", run.printed().to_string().as_bytes());
    let report = fixture.folder().join("tandem-report/metrics.json");
    fits("run", &fs::read(report).unwrap());
}

/// A run drives the planning problem that it is told, and its report says which.
#[test]
fn a_run_says_which_planning_problem_it_drives() {
    let fixture = Fixture::new();
    let good = include_str!("../../vehicle/fixtures/commonroad/sign-2020a.xml");
    let (_, problem) = good.split_once("<planningProblem id=\"20\">").unwrap();
    let (problem, _) = problem.split_once("</planningProblem>").unwrap();
    let slow = problem.replacen("<exact>12<", "<exact>6<", 1);
    let slow = format!("<planningProblem id=\"22\">{slow}</planningProblem></commonRoad>");
    let two = good.replace("</commonRoad>", &slow);
    fs::write(fixture.folder().join("two.xml"), two).unwrap();
    let words = [
        "run",
        "--scenario",
        "two.xml",
        "--duration",
        "1",
        "--problem",
    ];
    let output = fixture.output(&[&words[..], &["22", "--json=r.json"]].concat());
    let said = String::from_utf8(output.stderr).unwrap();
    assert!(
        said.contains("two.xml: planning problem 22 (2 of 2) is driven"),
        "{said}"
    );
    let text = String::from_utf8(output.stdout).unwrap();
    assert!(text.contains("planning problem 22 (2 of 2)"), "{text}");
    let figures = fs::read(fixture.folder().join("r.json")).unwrap();
    fits("run", &figures);
    let figures: Value = serde_json::from_slice(&figures).unwrap();
    let distance_m = figures["distance_m"].as_f64().unwrap();
    assert!((4.0..9.0).contains(&distance_m), "{distance_m}");
    refuses(
        &fixture,
        &[&words[..], &["7"]].concat(),
        &["choose one of 20, 22"],
    );
}

/// Processes of a manifest.
#[test]
fn documents_of_a_manifest_fit_their_schemas() {
    let fixture = Fixture::new();
    let manifest = concat!(
        "version = 1\ninitial = \"drive\"\n[[process]]\nname = \"it\"\nprogram = \"/bin/sleep\"\n",
        "arguments = [\"100\"]\nready = \"running\"\n[[target]]\nname = \"drive\"\nprocesses = [\"it\"]\n",
    );
    fs::write(fixture.folder().join("m.toml"), manifest).unwrap();
    // An Ed25519 key in DER (RFC 8410).
    let header = *b"\x30\x2e\x02\x01\x00\x30\x05\x06\x03\x2b\x65\x70\x04\x22\x04\x20";
    let key = [&header[..], &[7; 32]].concat();
    fs::write(fixture.folder().join("key.der"), key).unwrap();
    let sign = ["exec", "sign", "m.toml", "--key", "key.der", "--json"];
    fits("exec-sign", &printed(&fixture, &sign));
    let check = ["exec", "check", "m.toml", "--json"];
    fits("exec-check", &printed(&fixture, &check));
    // The word behind the option is the manifest, and never written.
    let mut command = fixture.command(&["exec", "run", "--json", "m.toml"]);
    let launcher = command.stdout(Stdio::piped()).spawn().unwrap();
    let ps = reached(&fixture);
    fits("exec-ps", &ps);
    crate::fixture::send(launcher.id() as i32, rustix::process::Signal::INT);
    let output = launcher.wait_with_output().unwrap();
    assert_eq!(output.status.code(), Some(130));
    lines_fit("exec-run", &output.stdout);
    assert_eq!(
        fs::read_to_string(fixture.folder().join("m.toml")).unwrap(),
        manifest
    );
    let mut command = fixture.command(&["exec", "run", "m.toml", "--json", "events.json"]);
    let launcher = command.stdout(Stdio::piped()).spawn().unwrap();
    reached(&fixture);
    crate::fixture::send(launcher.id() as i32, rustix::process::Signal::INT);
    let output = launcher.wait_with_output().unwrap();
    assert!(
        serde_json::from_slice::<Value>(&output.stdout).is_err(),
        "{output:?}"
    );
    lines_fit(
        "exec-run",
        &fs::read(fixture.folder().join("events.json")).unwrap(),
    );
}

/// Returns the document of the processes once all of them are ready.
fn reached(fixture: &Fixture) -> Vec<u8> {
    let begin = Instant::now();
    loop {
        assert!(begin.elapsed() < Duration::from_secs(60), "never reached");
        let output = fixture.output(&["exec", "ps", "m.toml", "--json"]);
        let state: Option<Value> = serde_json::from_slice(&output.stdout).ok();
        if state.is_some_and(|it| it["reached"] == true) {
            break output.stdout;
        }
        std::thread::sleep(Duration::from_millis(50));
    }
}

/// A command that fails prints nothing to stdout: the reason is on stderr.
#[test]
fn an_error_is_no_document() {
    let fixture = Fixture::new();
    for words in [
        &["run", "--json", "--scenario", "none"][..],
        &["run", "--json", "x.json", "--scenario", "none"],
        &["time", "none", "--json=x.json"],
        &["time", "none", "--json"],
        &["dflash", "show", "--json", "--folder", "none"],
        &["exec", "ps", "none.toml", "--json"],
    ] {
        let output = fixture.output(words);
        assert!(!output.status.success(), "{words:?}");
        assert!(output.stdout.is_empty(), "{words:?}");
        assert!(!output.stderr.is_empty(), "{words:?}");
        assert!(!fixture.folder().join("x.json").exists(), "{words:?}");
    }
}

/// Each help text of this program has the exit statuses.
#[test]
fn each_help_has_the_exit_statuses() {
    let helps = |words: &[&str]| {
        let output = Command::new(crate::PROGRAM).args(words).output().unwrap();
        let help = String::from_utf8(output.stdout).unwrap();
        assert!(help.contains(EXIT_STATUS), "{words:?}: {help}");
        help
    };
    let whole = helps(&["--help"]);
    for command in [
        "run",
        "ps",
        "grandmaster",
        "cut",
        "mend",
        "power",
        "fault",
        "dflash",
        "scenarios",
        "topics",
        "exec",
        "time",
        "boot-demo",
    ] {
        assert!(whole.contains(&format!("  {command} ")), "{command}");
        helps(&[command, "--help"]);
        helps(&["help", command]);
    }
    helps(&["exec", "check", "--help"]);
    helps(&["topics", "echo", "--help"]);
}
