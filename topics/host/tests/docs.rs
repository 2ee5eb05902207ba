//! The example of docs/topics.md runs, with Cyclone DDS and a stand-in for the controller.
#![allow(clippy::unwrap_used)]

mod stand_in;

use stand_in::{StandIn, own_place};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

/// An example that takes longer hears nothing.
const PATIENCE: Duration = Duration::from_secs(100);
const PAGE: &str = include_str!("../../../docs/topics.md");

/// D-2: a program of another vendor, as the page shows it, reads frames of the bus.
#[test]
fn the_example_in_python_reads_frames() {
    let python = std::env::var_os("TANDEM_PYTHON").unwrap_or_else(|| "python3".into());
    let has = Command::new(&python)
        .args(["-c", "import cyclonedds"])
        .output();
    if !has.is_ok_and(|output| output.status.success()) {
        let required = std::env::var_os("TANDEM_REQUIRE_CYCLONEDDS").is_some_and(|one| one == "1");
        assert!(!required, "no Python with cyclonedds");
        println!("SKIPPED: no Python with cyclonedds (TANDEM_PYTHON names another one)");
        return;
    }
    let example = PAGE.split("```python\n").nth(1).unwrap();
    let example = example.split("```").next().unwrap();
    let own = own_place();
    let mut process = Command::new(&python)
        .args(["-c", example, &own.place.domain().to_string()])
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let mut stand_in = StandIn::open(own.place);
    let begin = Instant::now();
    while process.try_wait().unwrap().is_none() {
        stand_in.cycle();
        if begin.elapsed() > PATIENCE {
            process.kill().unwrap();
        }
    }
    let output = process.wait_with_output().unwrap();
    let text = String::from_utf8(output.stdout).unwrap();
    assert!(output.status.success(), "{text}");
    let frames = text.lines().filter(|line| line.starts_with("110 "));
    // Counter and CRC, 13 bytes of values.
    assert!(
        frames.clone().count() > 1 && frames.clone().all(|line| line.len() == 4 + 32),
        "{text}"
    );
}
