//! Tests that a stall of a CPU is recorded during a run, whether its core 0 is alive or dead.

use std::time::{Duration, Instant};

use tandem_board_host::realtime::{Claim, claim};

use crate::fixture::{Fixture, kill};
use crate::observers::until_driven;

/// The part of a stall that is not recorded, ms: the watching thread sleeps for 2 ms.
const UNSEEN_MS: f64 = 2.0;

/// Takes a CPU from the whole run for `ms`, and returns the measured time, ms. `None` if that is
/// not permitted. `place` selects the CPU in the same way as for a core.
fn take_cpu(place: usize, ms: u64, first: impl FnOnce() + Send) -> Option<f64> {
    let spin = move || {
        let claimed = claim(Claim {
            priority: Some(95),
            cpu: Some(place),
            lock_memory: false,
        });
        claimed.fifo?;
        first();
        let begin = Instant::now();
        while begin.elapsed() < Duration::from_millis(ms) {
            std::hint::spin_loop();
        }
        Some(begin.elapsed().as_secs_f64() * 1e3)
    };
    std::thread::scope(|scope| scope.spawn(spin).join().unwrap())
}

/// T-RED-8: a stall of a CPU is recorded except for its first 2 ms. This holds while a core 0 runs
/// on that CPU and postpones the watching thread's timer, and just after that core 0 is killed.
#[test]
fn a_cpu_that_is_gone_is_named_also_beside_a_core_0_that_died() {
    for (ms, dies) in [(40, false), (60, true)] {
        let fixture = Fixture::alone();
        let mut run = fixture.run(&["--duration", "60"]);
        run.until_dual();
        until_driven(&run);
        let victim = run.core("A", 0);
        let first = || {
            if dies {
                kill(victim);
            }
        };
        let Some(gone_ms) = take_cpu(0, ms, first) else {
            eprintln!("skipped: no priority above the run's is permitted");
            return;
        };
        let metrics = run.interrupt();
        let longest_ms = metrics["stalls"]["longest_ms"].as_f64().unwrap();
        assert!(longest_ms >= gone_ms - UNSEEN_MS - 0.5, "{metrics:#}");
    }
}
