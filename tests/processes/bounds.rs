//! Checks the time bounds of the verdict in runs of processes. A user starts this on an idle
//! machine: `cargo xtask campaign processes`. `tests/tests/simulated/faults.rs` checks the same
//! bounds in virtual time on every machine.

use rustix::process::Signal;

use crate::deaths::{POWER, RESIGNS, SILENT, UNHEARD, dual_master};
use crate::fixture::{Fixture, Run, kill, send, sound, takeovers};
use crate::observers::disturb;

/// A machine's stall above this limit silences a healthy master: docs/redundancy.md, profile rt.
const TOLERATED_STALL_MS: f64 = 5.0;
/// Largest number of runs of one drive: a failed run with a longer stall is repeated.
const TRIES: u32 = 5;

/// A drive of 5 s with one fault of the master, and the signs that may trigger the takeover.
struct Drive {
    name: &'static str,
    fault: fn(&Run, &str),
    signs: &'static [&'static str],
}

const DRIVES: [Drive; 7] = [
    Drive {
        name: "no fault",
        fault: |_, _| (),
        signs: &[],
    },
    Drive {
        name: "observers freeze and die",
        fault: |run, _| disturb(run),
        signs: &[],
    },
    Drive {
        name: "the supply dies",
        fault: |run, _| kill(run.master_supply().pid),
        signs: &[POWER],
    },
    Drive {
        name: "core 0 dies",
        fault: |run, master| kill(run.core(master, 0)),
        signs: &[POWER, SILENT],
    },
    Drive {
        name: "core 1 dies",
        fault: |run, master| kill(run.core(master, 1)),
        signs: &[RESIGNS],
    },
    Drive {
        name: "core 2 dies",
        fault: |run, master| kill(run.core(master, 2)),
        signs: &[RESIGNS],
    },
    Drive {
        name: "core 0 stands still for 60 ms",
        fault: |run, master| {
            let core_0 = run.core(master, 0);
            send(core_0, Signal::STOP);
            std::thread::sleep(std::time::Duration::from_millis(60));
            send(core_0, Signal::CONT);
        },
        signs: &[SILENT, UNHEARD],
    },
];

/// Drives once. Returns the broken expectations, and the longest stall of the machine, ms.
fn unkept(drive: &Drive) -> (Vec<String>, f64) {
    let fixture = Fixture::alone();
    let mut run = fixture.run(&["--duration", "5"]);
    let master = dual_master(&run);
    (drive.fault)(&run, &master);
    let status = run.end();
    let metrics = run.printed();
    sound(&metrics);
    let mut unkept = vec![];
    if !status.success() {
        unkept.push(run.said());
    }
    for name in ["stale_frames", "invalid_frames", "lost_trace"] {
        if metrics[name] != 0 {
            unkept.push(format!("{name}: {}", metrics[name]));
        }
    }
    if metrics["control_frames"].as_u64().unwrap() < 400 {
        unkept.push(format!("{} frames in 5 s", metrics["control_frames"]));
    }
    let found = takeovers(&metrics);
    let is_expected = |sign: &str| drive.signs.contains(&sign);
    let all_expected = found
        .iter()
        .all(|it| it["from"] == *master && it["cause"].as_str().is_some_and(is_expected));
    // A thawed master detects by itself that it was held up.
    let count = found.len() == usize::from(!drive.signs.is_empty());
    let thaws = drive.signs.contains(&UNHEARD);
    if !all_expected || !(count || thaws) {
        unkept.push(format!("takeovers: {found:?}"));
    }
    (unkept, metrics["stalls"]["longest_ms"].as_f64().unwrap())
}

#[test]
#[ignore = "judges real time: cargo xtask campaign processes"]
fn drives_keep_their_bounds_in_real_time() {
    let rounds = std::env::var("TANDEM_PROCESS_ROUNDS").ok();
    let rounds: u32 = rounds.and_then(|it| it.parse().ok()).unwrap_or(1);
    let (mut kept, mut again) = (0, 0);
    for drive in (0..rounds).flat_map(|_| &DRIVES) {
        for tried in 1.. {
            let (unkept, stalled_ms) = unkept(drive);
            if unkept.is_empty() {
                kept += 1;
                break;
            }
            let what = format!("{}: {unkept:#?}", drive.name);
            assert!(stalled_ms > TOLERATED_STALL_MS, "no stall excuses {what}");
            assert!(tried < TRIES, "the machine stalls too often: {what}");
            again += 1;
            println!("tried again, after a stall of {stalled_ms:.1} ms: {what}");
        }
    }
    println!("{kept} drives kept their bounds; tried again {again} times");
}
