//! Checks what commands print with `--json` against the schemas in `docs/schemas`, by PyPI's
//! `jsonschema`. Skipped without it; with `TANDEM_REQUIRE_JSONSCHEMA=1` it is required.

use std::io::Write as _;
use std::path::Path;
use std::process::{Command, Stdio};

/// Checks that this text is one JSON document of this schema. An unknown field is an error.
pub(crate) fn fits(schema: &str, text: &[u8]) {
    validate(schema, text, &[]);
}

/// Checks that each line is a JSON document of this schema.
#[allow(dead_code, reason = "not all commands print lines")]
pub(crate) fn lines_fit(schema: &str, text: &[u8]) {
    validate(schema, text, &["--lines"]);
}

fn validate(schema: &str, text: &[u8], options: &[&str]) {
    let found = Command::new("python3")
        .args(["-c", "import jsonschema"])
        .output();
    if !found.is_ok_and(|output| output.status.success()) {
        let required = std::env::var_os("TANDEM_REQUIRE_JSONSCHEMA").is_some_and(|it| it == "1");
        assert!(!required, "jsonschema of PyPI is missing");
        eprintln!("skipped: jsonschema of PyPI is not installed");
        return;
    }
    let mut root = Path::new(env!("CARGO_MANIFEST_DIR")).ancestors();
    let root = root.find(|it| it.join("docs/schemas").exists()).unwrap();
    let mut python = Command::new("python3")
        .arg(root.join("tests/json/validate.py"))
        .args(options)
        .arg(
            root.join("docs/schemas")
                .join(schema)
                .with_extension("json"),
        )
        .stdin(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    python.stdin.take().unwrap().write_all(text).unwrap();
    let output = python.wait_with_output().unwrap();
    let (said, text) = (
        String::from_utf8_lossy(&output.stderr),
        String::from_utf8_lossy(text),
    );
    assert!(output.status.success(), "{schema}: {said}{text}");
}
