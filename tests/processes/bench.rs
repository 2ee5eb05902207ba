//! `tandem bench` as a person uses it: cut short, compared, and asked for what cannot be.

use std::fs;
use std::process::{Child, Stdio};
use std::thread::sleep;
use std::time::Duration;

use rustix::process::{Pid, Signal, kill_process};
use serde_json::Value;

use crate::fixture::Fixture;

/// Presses Ctrl-C on the command, not on what it has started.
fn interrupt(child: &Child) {
    let pid = Pid::from_raw(i32::try_from(child.id()).unwrap()).unwrap();
    kill_process(pid, Signal::INT).unwrap();
}

/// Every time in the batches of this case times `factor`.
fn scaled(results: &Value, case: &str, factor: f64) -> Value {
    let mut results = results.clone();
    for row in results["results"].as_array_mut().unwrap() {
        if row["name"] == case {
            for name in ["batch_p50_ns", "batch_p99_ns"] {
                for ns in row[name].as_array_mut().unwrap() {
                    *ns = (ns.as_f64().unwrap() * factor).into();
                }
            }
        }
    }
    results
}

/// A measurement that is cut short gives what there is, says so everywhere, and can be compared.
#[test]
fn a_measurement_that_is_cut_short_gives_what_there_is() {
    let fixture = Fixture::new();
    let outputs = ["--json", "a.json", "--html", "a.html", "--hgrm", "h"];
    let mut command = fixture.command(&[&["bench", "pool"][..], &outputs].concat());
    let child = command
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    // Time for a turn of four short cases, whatever else the machine does.
    sleep(Duration::from_secs(6));
    assert_eq!(
        fixture.names(),
        Vec::<String>::new(),
        "files before figures"
    );
    interrupt(&child);
    let output = child.wait_with_output().unwrap();
    let said = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(130), "{said}");
    let table = String::from_utf8(output.stdout).unwrap();
    assert!(
        table.contains("take-give") && table.contains("interrupted"),
        "{table}"
    );
    let read = |name: &str| fs::read_to_string(fixture.folder().join(name)).unwrap();
    let mut results: Value = serde_json::from_str(&read("a.json")).unwrap();
    assert_eq!(results["interrupted"], true);
    assert!(read("a.html").contains("Interrupted"));
    let curve = read("h/pool-take-give.hgrm");
    assert!(curve.contains("1/(1-Percentile)") && curve.contains("Interrupted"));

    // However many batches there were: the comparison needs some.
    for row in results["results"].as_array_mut().unwrap() {
        for (of, total) in [("batch_p50_ns", "p50_ns"), ("batch_p99_ns", "p99_ns")] {
            row[of] = vec![row[total].clone(); 12].into();
        }
    }
    let compare = |case: &str, factor: f64| {
        for (name, factor) in [("a.json", 1.0), ("b.json", factor)] {
            let text = scaled(&results, case, factor).to_string();
            fs::write(fixture.folder().join(name), text).unwrap();
        }
        fixture.output(&["bench", "compare", "a.json", "b.json", "--json", "c.json"])
    };
    assert_eq!(compare("pool/take-give", 1.0).status.code(), Some(0));
    assert_eq!(compare("pool/take-give", 0.5).status.code(), Some(0));
    let slower = compare("pool/take-give", 1.2);
    let said = String::from_utf8_lossy(&slower.stderr).into_owned();
    assert_eq!(slower.status.code(), Some(1), "{said}");
    assert!(said.contains("pool/take-give"), "{said}");
    let comparison: Value = serde_json::from_str(&read("c.json")).unwrap();
    assert_eq!(comparison["slower"][0], "pool/take-give");
}

/// What is wrong is said at once, with exit status 2, and leaves nothing behind.
#[test]
fn a_benchmark_that_cannot_be_is_refused_at_once() {
    let fixture = Fixture::new();
    fs::write(fixture.folder().join("other.json"), "{}").unwrap();
    let before = fixture.names();
    for (args, word) in [
        (&["bench", "spni"][..], "possible values: spin"),
        (&["bench", "--json", "no/such/a.json"], "create it first"),
        (&["bench", "--html", "."], "name a file"),
        (&["bench", "--hgrm", "other.json"], "name a folder"),
        (&["bench", "--json", "a", "--html", "./a"], "the same file"),
        (
            &["bench", "compare", "no.json", "no.json"],
            "cannot read no.json",
        ),
        (
            &["bench", "compare", "other.json", "other.json"],
            "other.json is no file of",
        ),
        (&["bench", "compare", "other.json"], "B.json"),
    ] {
        let output = fixture.output(args);
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(2), "{args:?}: {said}");
        assert!(
            said.contains(word),
            "{args:?} does not say {word:?}: {said}"
        );
        assert_eq!(fixture.names(), before, "{args:?} has left something");
    }
}
