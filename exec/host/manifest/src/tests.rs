//! What the reader of the manifest accepts, and what it says of the rest.

use super::*;

const GOOD: &str = r#"
version = 1
initial = "drive"
fallback = "limp"

[safe-state]
before = ["/bin/true"]
within = "2s"

[[process]]
name = "base"
program = "bin/base"
ready = "running"

[[process]]
name = "fusion"
program = "bin/fusion"
after = ["base"]
restart = { times = 3, pause = "100ms" }
alive = { every = "50ms", least = 1, most = 3, tolerated = 1 }
deadlines = [{ from = 1, to = 2, most = "20ms" }]
logical = { first = [1], next = [[1, 2], [2, 1]] }

[[target]]
name = "drive"
processes = ["fusion"]

[[target]]
name = "limp"
processes = []
"#;

#[test]
fn a_target_holds_what_its_processes_depend_on() {
    let manifest = Manifest::read(GOOD.as_bytes()).unwrap();
    assert_eq!(manifest.targets[manifest.initial()].members, [0, 1]);
    assert_eq!(manifest.fallback(), Some(1));
    let fusion = &manifest.processes[1];
    assert_eq!(fusion.restart.pause, Duration::from_ms(100));
    assert_eq!(fusion.stop_within, Duration::from_ms(1_000));
    assert_eq!(manifest.safe_state.within, Duration::from_ms(2_000));
    assert_eq!(manifest.safe_state.watchdog, Duration::from_ms(5_000));
}

/// E-5: what is wrong in a manifest is named by line and key. Each row is one change of the good
/// manifest, the line of the error, and words of its text.
#[test]
fn an_error_names_line_and_key() {
    let rows = [
        ("version = 1", "version = 2", 2, "expected 1"),
        (
            "initial = \"drive\"",
            "initial = \"dirve\"",
            3,
            "no such run target",
        ),
        (
            "fallback = \"limp\"",
            "fallback = \"x\"",
            4,
            "no such run target",
        ),
        ("before = ", "befor = ", 7, "befor"),
        (
            "within = \"2s\"",
            "within = \"2 hours\"",
            8,
            "ns, us, ms, s or min",
        ),
        (
            "within = \"2s\"",
            "within = \"99999999999999s\"",
            8,
            "ns, us, ms, s or min",
        ),
        ("within = \"2s\"", "within = 2", 8, "string"),
        (
            "ready = \"running\"",
            "ready = \"soon\"",
            13,
            "expected one of",
        ),
        ("ready = \"running\"", "cpus = []", 11, "cpus"),
        ("ready = \"running\"", "priority = 3", 11, "policy"),
        (
            "ready = \"running\"",
            "after = [\"fusion\"]",
            11,
            "waits for itself",
        ),
        ("ready = \"running\"", "color = 3", 13, "color"),
        ("name = \"fusion\"", "name = \"base\"", 16, "twice"),
        ("name = \"fusion\"", "name = \"a/b\"", 16, "letters"),
        (
            "after = [\"base\"]",
            "after = [\"bse\"]",
            18,
            "there are: base, fusion",
        ),
        ("least = 1, most = 3", "least = 4, most = 3", 16, "least"),
        (
            "most = \"20ms\"",
            "least = \"1s\", most = \"20ms\"",
            16,
            "least",
        ),
        (
            "processes = [\"fusion\"]",
            "processes = [\"x\"]",
            26,
            "no such process",
        ),
    ];
    for (right, wrong, line, words) in rows {
        let error = Manifest::read(GOOD.replacen(right, wrong, 1).as_bytes());
        let error = error.map(|_| wrong).unwrap_err().to_string();
        assert!(error.contains(&format!("line {line}")), "{wrong}: {error}");
        assert!(error.contains(words), "{wrong}: {error}");
    }
}

#[test]
fn what_is_no_text_is_refused() {
    assert!(matches!(
        Manifest::read(b"\xff"),
        Err(ManifestError::Text(_))
    ));
    assert!(matches!(Manifest::read(b"["), Err(ManifestError::Toml(_))));
}

#[test]
fn the_manifest_of_the_docs_is_right() {
    let page = include_str!("../../../../docs/execution.md");
    let example = page.split("```toml\n").nth(1).unwrap();
    let example = Manifest::read(example.split("```").next().unwrap().as_bytes()).unwrap();
    assert_eq!(example.processes.len(), 3);
    assert_eq!(example.fallback(), example.target_named("limp-home"));
}
