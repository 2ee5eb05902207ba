//! Compares the frames of this crate with those of cantools, an independent implementation.
#![allow(clippy::unwrap_used)]

mod frames;

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::io::Write as _;
use std::process::{Command, Stdio};
use std::thread;

use proptest::strategy::{Strategy as _, ValueTree as _};
use proptest::test_runner::TestRunner;
use tandem_bus::candump::{CandumpFrame, Id};
use tandem_bus::{Encoded, FRAMES, FrameTransmitter, Message};

const DBC: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/dbc/tandem.dbc");
const SCRIPT: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/cantools_oracle.py");

/// Returns whether cantools is installed. Without it a test passes and prints that it was skipped;
/// with `TANDEM_REQUIRE_ORACLES=1` it fails.
fn cantools_or_skip(test: &str) -> bool {
    let import = Command::new("python3")
        .args(["-c", "import cantools"])
        .output();
    if import.is_ok_and(|output| output.status.success()) {
        return true;
    }
    let required = std::env::var_os("TANDEM_REQUIRE_ORACLES").is_some_and(|value| value == "1");
    assert!(
        !required,
        "{test}: cantools is required and not installed (pip install cantools)"
    );
    // The test runner does not capture this output, so a skipped test is visible.
    let _ = writeln!(
        std::io::stderr(),
        "{test}: skipped: cantools is not installed (pip install cantools)"
    );
    false
}

/// Runs Python on this input and returns what it prints.
fn python(arguments: &[&str], input: String) -> String {
    let mut child = Command::new("python3")
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
    assert!(
        output.status.success(),
        "python3 {arguments:?}: {}",
        output.status
    );
    String::from_utf8(output.stdout).unwrap()
}

/// Returns messages with random values and running counters; the same ones in each run.
fn random_frames(count: usize) -> Vec<(Message, Encoded)> {
    let mut runner = TestRunner::deterministic();
    let mut transmitter = FrameTransmitter::new();
    let strategy = frames::message();
    (0..count)
        .map(|_| {
            let message = strategy.new_tree(&mut runner).unwrap().current();
            (message, transmitter.encode(&message))
        })
        .collect()
}

/// Parses `name=value` words.
fn pairs<'a>(words: impl Iterator<Item = &'a str>) -> BTreeMap<&'a str, f64> {
    let pair = |word: &'a str| {
        let (name, value) = word.split_once('=').unwrap();
        (name, value.parse().unwrap())
    };
    words.map(pair).collect()
}

fn hex(data: &[u8]) -> String {
    data.iter().fold(String::new(), |mut out, byte| {
        write!(out, "{byte:02x}").unwrap();
        out
    })
}

fn bytes(hex: &str) -> Vec<u8> {
    let byte = |at: usize| u8::from_str_radix(&hex[at..at + 2], 16).unwrap();
    (0..hex.len()).step_by(2).map(byte).collect()
}

/// Asserts that Rust and the oracle read the same values, to the precision of an `f32`.
fn assert_same_values(frame: &Message, oracle: &BTreeMap<&str, f64>) {
    let ours = frames::values(frame);
    // The oracle also decodes Crc and Counter.
    let protection = if frame.frame().has_e2e { 2 } else { 0 };
    assert_eq!(
        ours.len() + protection,
        oracle.keys().filter(|name| **name != "E2E").count()
    );
    for (name, value) in ours {
        let theirs = oracle[name];
        let tolerance = 1e-6 * value.abs().max(theirs.abs());
        assert!(
            (value - theirs).abs() <= tolerance,
            "{frame:?}: {name} is {theirs} in cantools"
        );
    }
}

/// cantools decodes the frames of this crate to the same values, and Python's CRC agrees.
#[test]
fn cantools_decodes_our_frames() {
    if !cantools_or_skip("cantools_decodes_our_frames") {
        return;
    }
    let frames = random_frames(3000);
    let mut input = String::new();
    for (_, frame) in &frames {
        writeln!(input, "{:03x} {}", frame.id, hex(frame.data())).unwrap();
    }
    let output = python(&[SCRIPT, DBC, "decode"], input);
    assert_eq!(output.lines().count(), frames.len());
    for ((_, frame), line) in frames.iter().zip(output.lines()) {
        let oracle = pairs(line.split(' '));
        let held = Message::decode(u32::from(frame.id), frame.data()).unwrap();
        assert_same_values(&held, &oracle);
        if held.frame().has_e2e {
            assert_eq!(oracle["E2E"], 1.0, "{line}");
            assert_eq!(oracle["Counter"], f64::from(frame.bytes[2]));
        }
    }
}

/// This crate decodes the frames of cantools to the same values, and encodes them to the same
/// bytes.
#[test]
fn we_decode_the_frames_of_cantools() {
    if !cantools_or_skip("we_decode_the_frames_of_cantools") {
        return;
    }
    let output = python(&[SCRIPT, DBC, "encode", "1", "150"], String::new());
    assert_eq!(output.lines().count(), 150 * FRAMES.len());
    for line in output.lines() {
        let mut words = line.split(' ');
        let id = u32::from_str_radix(words.next().unwrap(), 16).unwrap();
        let data = bytes(words.next().unwrap());
        let message = Message::decode(id, &data).unwrap();
        assert_same_values(&message, &pairs(words));
        // Compare all bytes except the CRC, which cantools does not compute.
        let from = if message.frame().has_e2e { 2 } else { 0 };
        assert_eq!(
            message.encode(data[2]).data()[from..],
            data[from..],
            "{line}"
        );
    }
}

/// `cantools decode`, as a user would call it, reads a log that this crate wrote.
#[test]
fn cantools_reads_our_logs() {
    if !cantools_or_skip("cantools_reads_our_logs") {
        return;
    }
    let frames = random_frames(500);
    let mut log = String::new();
    for (i, (_, frame)) in frames.iter().enumerate() {
        let record = CandumpFrame {
            at_us: 1_436_509_052_249_713 + 10_007 * i as u64,
            interface: "vcan0",
            id: Id::Standard(frame.id),
            is_fd: true,
            data: frame.data(),
        };
        writeln!(log, "{record}").unwrap();
    }
    let decode = [
        "-m",
        "cantools",
        "decode",
        "--single-line",
        "--no-decode-choices",
        DBC,
    ];
    let output = python(&decode, log.clone());
    assert_eq!(output.lines().count(), frames.len());
    for (((_, frame), logged), line) in frames.iter().zip(log.lines()).zip(output.lines()) {
        // `(time) vcan0 0A0##1… :: ControlA(Crc: 1, …, SteeringAngle: 0.1 rad, …)`
        let (copied, decoded) = line.split_once(" :: ").unwrap();
        assert_eq!(copied.trim(), logged);
        let (name, signals) = decoded.trim_end_matches(')').split_once('(').unwrap();
        assert_eq!(FRAMES.iter().find(|f| f.id == frame.id).unwrap().name, name);
        let signals = signals.split(", ").map(|signal| {
            let (name, value) = signal.split_once(": ").unwrap();
            let number = value.split(' ').next().unwrap();
            (name, number.parse().unwrap())
        });
        let held = Message::decode(u32::from(frame.id), frame.data()).unwrap();
        assert_same_values(&held, &signals.collect());
    }
}
