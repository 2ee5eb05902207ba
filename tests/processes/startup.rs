//! Tests that kill processes during the start of a run.

use std::time::Duration;

use crate::fixture::{Fixture, kill};

/// Number of starts with a kill, unless `TANDEM_STARTUP_KILLS` gives another number.
const KILLS: u64 = 6;
/// The kill happens within this time after the start, ms. A start takes less time.
const WITHIN_MS: u64 = 300;

/// Returns numbers that look random but are the same in every test (splitmix64).
fn scattered(n: u64) -> u64 {
    let mut z = n.wrapping_mul(0x9E37_79B9_7F4A_7C15);
    z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    z ^ (z >> 31)
}

/// If any process is killed at any moment of a start, the run ends. The next start works, and at
/// the end nothing of the runs remains.
#[test]
fn any_start_may_be_killed() {
    let fixture = Fixture::new();
    let kills = std::env::var("TANDEM_STARTUP_KILLS")
        .ok()
        .and_then(|n| n.parse().ok());
    let mut killed = Vec::new();
    for start in 0..kills.unwrap_or(KILLS) {
        let mut run = fixture.run(&["--duration", "0.2", "--quiet", "--out", "cut-short"]);
        let at_us = scattered(2 * start) % (WITHIN_MS * 1_000);
        std::thread::sleep(Duration::from_micros(at_us));
        let processes = run.processes();
        let choice = scattered(2 * start + 1) as usize % (processes.len() + 1);
        // Select one of the processes, or `tandem run` itself.
        let victim = processes
            .get(choice)
            .map_or(run.launcher_pid(), |process| process.pid);
        kill(victim);
        run.end();
        // If its launcher is killed, a run that drives ends within two seconds.
        run.until_vanished();
        killed.push(run);
    }
    let metrics = fixture.run(&["--duration", "0.2"]).metrics();
    assert_eq!(metrics["leftovers"].as_array().map(Vec::len), Some(0));
    for run in &killed {
        run.left_nothing();
    }
}
