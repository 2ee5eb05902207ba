//! Drives both systems without a fault, and fails if one of them finds something wrong.
//! Arguments: hours in all; then scenarios by name or file, without any the embedded ones. `cargo
//! xtask campaign free-drives` runs it.
#![allow(clippy::print_stdout, reason = "its output is its purpose")]

use std::process::ExitCode;
use std::sync::atomic::{AtomicU64, Ordering};
use tandem_board::Duration;
use tandem_sim::drive::Drive;
use tandem_sim::is_finding;
use tandem_vehicle::Scenario;

/// The length of one drive.
const DRIVE: Duration = Duration::from_ms(600_000);

/// Drives a scenario. Returns what was found.
fn drive(scenario: &str, seed: u64) -> Vec<String> {
    let mut drive = Drive::new(scenario, seed);
    drive.run_for(DRIVE);
    let found = drive.events.iter().filter(|it| is_finding(&it.3));
    found
        .map(|(at, system, _, event)| {
            format!("{scenario} seed {seed}: {system} at {at:?}: {event:?}")
        })
        .collect()
}

/// Returns whether this scenario can be driven; prints why not.
fn is_drivable(scenario: &str) -> bool {
    let why_not = match Scenario::load(scenario) {
        Ok(loaded) => loaded.outside_domain().map(str::to_owned),
        Err(error) => Some(error.to_string()),
    };
    if let Some(why) = &why_not {
        println!("{scenario}: skipped: {why}");
    }
    why_not.is_none()
}

fn main() -> ExitCode {
    let mut arguments = std::env::args().skip(1);
    let hours = arguments.next().and_then(|hours| hours.parse().ok());
    let hours: f64 = hours.unwrap_or(8.0);
    let named: Vec<String> = arguments.collect();
    let scenarios: Vec<String> = match named.is_empty() {
        true => Scenario::names().map(str::to_owned).collect(),
        false => named.into_iter().filter(|it| is_drivable(it)).collect(),
    };
    if scenarios.is_empty() {
        println!("no scenario to drive");
        return ExitCode::FAILURE;
    }
    let drives = (hours * 3_600.0 / (DRIVE.as_ms_f64() * 1e-3)).ceil() as u64;
    let (next, found) = (AtomicU64::new(0), AtomicU64::new(0));
    std::thread::scope(|threads| {
        for _ in 0..std::thread::available_parallelism().map_or(1, usize::from) {
            threads.spawn(|| {
                loop {
                    let seed = next.fetch_add(1, Ordering::Relaxed);
                    if seed >= drives {
                        return;
                    }
                    let scenario = &scenarios[seed as usize % scenarios.len()];
                    let findings = drive(scenario, seed);
                    println!("{scenario} seed {seed}: {} findings", findings.len());
                    findings.iter().for_each(|it| println!("{it}"));
                    found.fetch_add(findings.len() as u64, Ordering::Relaxed);
                }
            });
        }
    });
    let found = found.into_inner();
    println!("{drives} drives of 10 minutes: {found} findings");
    ExitCode::from(u8::from(found > 0))
}
