//! T-RTOS-3 and T-RTOS-4 under QEMU: when the outputs of FreeRTOS tasks change. Needs QEMU and the
//! images, so only `cargo xtask firmware test` runs it.
#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    reason = "all of it is a test"
)]

use std::path::PathBuf;

use tandem_board_qemu::run_to_end;
use tandem_rtos::demo::{COMPLETE, OutputEdge};

/// Tolerance for the path from a tick to an edge: one switch for each earlier task, at 1 ns per
/// instruction. The tests check milliseconds.
const PATH_NS: u64 = 10_000;
const MS_NS: u64 = 1_000_000;
const SPAN_MS: u64 = 360;

fn log() -> String {
    let images = std::env::var_os("TANDEM_IMAGES").expect("cargo xtask firmware test sets it");
    let log = run_to_end(&PathBuf::from(images).join("rtos-demo")).unwrap();
    assert!(log.lines().any(|line| line == COMPLETE), "{log}");
    log
}

/// Returns the times at which this output changed, ns.
fn edges(log: &str, test: usize, output: usize) -> Vec<u64> {
    log.lines()
        .filter_map(OutputEdge::parse)
        .filter(|edge| edge.test == test && edge.output == output)
        .map(|edge| edge.at_ns)
        .collect()
}

/// Fails unless there is exactly one edge at each of these times, in this order.
fn assert_at(edges: &[u64], expected_ms: &[u64], what: &str) {
    assert_eq!(edges.len(), expected_ms.len(), "{what}: {edges:?}");
    for (at, expected) in edges.iter().zip(expected_ms) {
        let off = at.abs_diff(expected * MS_NS);
        assert!(off <= PATH_NS, "{what}: {at} ns, not {expected} ms");
    }
}

/// T-RTOS-3: each output has its period, on the clock of the machine.
#[test]
#[ignore = "needs QEMU and the images: cargo xtask firmware test"]
fn outputs_toggle_every_60_40_and_20_ms() {
    let log = log();
    for (output, period_ms) in [(0, 60), (1, 40), (2, 20)] {
        let edges = edges(&log, 0, output);
        let what = format!("the output of {period_ms} ms");
        let expected: Vec<u64> = (0..SPAN_MS).step_by(period_ms).collect();
        assert_at(&edges, &expected, &what);
        for pair in edges.windows(2) {
            let period = pair[1] - pair[0];
            let off = period.abs_diff(period_ms as u64 * MS_NS);
            assert!(off <= PATH_NS, "{what}: a period of {period} ns");
        }
    }
}

/// T-RTOS-4, on the clock of the machine.
#[test]
#[ignore = "needs QEMU and the images: cargo xtask firmware test"]
fn no_lower_task_toggles_while_the_highest_works() {
    let log = log();
    let [highest, middle, lowest] = [0, 1, 2].map(|output| edges(&log, 1, output));
    let changes: Vec<u64> = (0..SPAN_MS)
        .step_by(30)
        .flat_map(|up| [up, up + 20])
        .collect();
    assert_at(&highest, &changes, "the highest");
    for work in highest.chunks_exact(2) {
        for (lower, edges) in [("the middle", &middle), ("the lowest", &lowest)] {
            let mut within = edges.iter().filter(|at| (work[0]..work[1]).contains(at));
            assert_eq!(within.next(), None, "{lower} toggles within {work:?}");
        }
    }
    // Each release of the lower tasks is served as soon as the task of highest priority sleeps.
    let rests_from = |ms: u64| if ms % 30 < 20 { ms - ms % 30 + 20 } else { ms };
    for (what, edges, period_ms) in [("the middle", &middle, 20), ("the lowest", &lowest, 10)] {
        let expected: Vec<u64> = (0..SPAN_MS).step_by(period_ms).map(rests_from).collect();
        assert_at(edges, &expected, what);
    }
    // After each rest, the middle task must run before the lowest one.
    for from in changes.iter().skip(1).step_by(2).map(|ms| ms * MS_NS) {
        let first = |edges: &[u64]| edges.iter().copied().find(|at| *at >= from);
        assert!(first(&middle) < first(&lowest), "after {from} ns");
    }
}

/// A busy host shifts an emulated timer by some instructions: by 200 ns in one observation.
#[test]
#[ignore = "needs QEMU and the images: cargo xtask firmware test"]
fn outputs_change_at_the_same_times_in_each_run() {
    let [first, second] = [log(), log()];
    assert_eq!(first.lines().count(), second.lines().count());
    for (one, other) in first.lines().zip(second.lines()) {
        let [one_at, other_at] = [one, other].map(|line| {
            let (edge, at) = line.rsplit_once(' ').unwrap_or((line, "0"));
            (edge, at.parse::<u64>().unwrap_or(0))
        });
        assert_eq!(one_at.0, other_at.0);
        assert!(one_at.1.abs_diff(other_at.1) <= 1_000, "{one}, {other}");
    }
}
