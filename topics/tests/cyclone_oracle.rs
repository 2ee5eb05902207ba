//! Compares the payloads of this crate with those of Cyclone DDS, an independent implementation.
#![allow(clippy::unwrap_used)]

mod grammar;
mod samples;

use std::fmt::Write as _;
use std::io::Write as _;
use std::process::{Command, Stdio};
use std::{env, thread};

use proptest::strategy::{Strategy as _, ValueTree as _};
use proptest::test_runner::TestRunner;
use samples::{Any, TYPES, any_sample, bytes, hex};

const SCRIPT: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/cyclone_oracle.py");
/// The first four bytes of the payloads of a line: XCDR1 and XCDR2, each in both byte orders.
const REPRESENTATIONS: [&str; 4] = ["00010000", "00000000", "00070000", "00060000"];

/// Returns the interpreter: `python3`, or the one that `TANDEM_PYTHON` names.
fn interpreter() -> String {
    env::var("TANDEM_PYTHON").unwrap_or_else(|_| "python3".to_owned())
}

/// Returns whether cyclonedds is installed. Without it a test passes and prints that it was
/// skipped; with `TANDEM_REQUIRE_CYCLONEDDS=1` it fails.
fn cyclonedds_or_skip(test: &str) -> bool {
    let mut import = Command::new(interpreter());
    let import = import.args(["-c", "import cyclonedds.idl"]).output();
    if import.is_ok_and(|output| output.status.success()) {
        return true;
    }
    const HINT: &str = "cyclonedds is not installed (pip install cyclonedds==11.0.1)";
    let is_required = env::var_os("TANDEM_REQUIRE_CYCLONEDDS").is_some_and(|value| value == "1");
    assert!(!is_required, "{test}: {HINT}");
    // The test runner does not capture this output, so a skipped test is visible.
    let _ = writeln!(std::io::stderr(), "SKIPPED: {test}: {HINT}");
    false
}

/// Runs the script on this input and returns what it prints.
fn oracle(arguments: &[&str], input: String) -> String {
    let mut child = Command::new(interpreter())
        .arg(SCRIPT)
        .args(arguments)
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let mut stdin = child.stdin.take().unwrap();
    // Write in a separate thread, because both pipes may be full at the same time.
    let writer = thread::spawn(move || stdin.write_all(input.as_bytes()));
    let output = child.wait_with_output().unwrap();
    writer.join().unwrap().unwrap();
    assert!(output.status.success(), "{arguments:?}: {}", output.status);
    String::from_utf8(output.stdout).unwrap()
}

/// A sample as Cyclone sees it.
struct Line<'a> {
    type_name: &'a str,
    /// The CRC is right.
    is_protected: bool,
    /// As [`Any::words`].
    words: String,
    /// In the order of [`REPRESENTATIONS`].
    payloads: Vec<Vec<u8>>,
}

impl<'a> Line<'a> {
    fn read(line: &'a str) -> Self {
        let words: Vec<&str> = line.split(' ').collect();
        let payloads = words.len() - 4;
        for (payload, representation) in words[payloads..].iter().zip(REPRESENTATIONS) {
            assert!(payload.starts_with(representation), "{line}");
        }
        Self {
            type_name: words[0],
            is_protected: words[1] == "E2E=1",
            words: words[2..payloads].join(" "),
            payloads: words[payloads..].iter().map(|hex| bytes(hex)).collect(),
        }
    }

    /// Asserts that this crate reads the same values from each payload, writes the same bytes as
    /// the first one, and judges the protection alike.
    fn assert_same(&self) {
        for payload in &self.payloads {
            let read = Any::decode(self.type_name, payload).unwrap();
            assert_eq!(read.words(), self.words);
            assert_eq!(read.is_protected(), self.is_protected, "{}", self.words);
            let written = read.encode().unwrap();
            // Cyclone leaves the options zero and does not pad.
            let len = self.payloads[0].len();
            assert_eq!(written[..2], self.payloads[0][..2]);
            assert_eq!(hex(&written[4..len]), hex(&self.payloads[0][4..]));
            assert_eq!(written.len(), len.next_multiple_of(4));
        }
    }
}

/// Cyclone reads the payloads of this crate to the same values, and this crate reads these values
/// again from the payloads of Cyclone, in each representation. D-2, D-3
#[test]
fn cyclone_reads_our_payloads() {
    if !cyclonedds_or_skip("cyclone_reads_our_payloads") {
        return;
    }
    let mut runner = TestRunner::deterministic();
    let mut samples: Vec<Any> = (0..2000)
        .map(|_| any_sample().new_tree(&mut runner).unwrap().current())
        .collect();
    for (index, sample) in samples.iter_mut().enumerate().step_by(2) {
        sample.protect(index as u8).unwrap();
    }
    let mut input = String::new();
    for sample in &samples {
        let payload = hex(&sample.encode().unwrap());
        writeln!(input, "{} {payload}", sample.type_name()).unwrap();
    }
    let output = oracle(&["decode"], input);
    assert_eq!(output.lines().count(), samples.len());
    for (sample, line) in samples.iter().zip(output.lines()) {
        let line = Line::read(line);
        assert_eq!(line.words, sample.words());
        assert_eq!(line.is_protected, sample.is_protected(), "{sample:?}");
        line.assert_same();
    }
}

/// This crate reads the payloads of Cyclone to the same values, in each representation, and writes
/// the same bytes. D-2, D-3
#[test]
fn we_read_the_payloads_of_cyclone() {
    if !cyclonedds_or_skip("we_read_the_payloads_of_cyclone") {
        return;
    }
    let output = oracle(&["encode", "1", "300"], String::new());
    let lines: Vec<Line<'_>> = output.lines().map(Line::read).collect();
    assert_eq!(lines.len(), 300 * TYPES.len());
    for line in &lines {
        line.assert_same();
    }
    // No type of the IDL is left out.
    let idl = grammar::parse(include_str!("../idl/tandem.idl")).unwrap();
    for one in &idl.structs {
        let name = format!("{}::{}", idl.name, one.name);
        assert!(lines.iter().any(|line| line.type_name == name), "{name}");
    }
}
