//! The report of a made-up run.

use super::*;
use crate::metrics::Surroundings;
use crate::stall_watch::Seen;
use crate::timeline::Timeline;
use crate::{metrics, synthetic, timeline};
use tandem_record::gap::Bounds;
use tandem_record::run_log::{ControlFrame, Stall, Stood};
use tandem_vehicle::Ruling;

fn synthetic_page() -> String {
    let log = synthetic::with_takeover(60.0);
    let around = Surroundings {
        granted: "SCHED_FIFO, memory locked, CPUs 0 and 1".into(),
        timing: "rt".into(),
        detection_bound_ms: Some(3.2),
        bounds: Bounds {
            silent_ms: 20.0,
            power_ms: 14.5,
            mute_ms: 20.0,
            ..Bounds::default()
        },
        ..Surroundings::default()
    };
    let moment = takeovers(&log)[0].at_ns;
    let timeline = timeline::tests::around(moment);
    let metrics = metrics::compute(&log, &timeline, &around);
    page(&log, &timeline, &metrics)
}

/// Writes the page to `TANDEM_REPORT_SAMPLE`, if that is set, for a look at it.
#[test]
fn the_page_needs_nothing_from_outside() {
    let page = synthetic_page();
    if let Some(path) = std::env::var_os("TANDEM_REPORT_SAMPLE") {
        std::fs::write(path, &page).unwrap();
    }
    for outside in ["http:", "https:", "<link", "<script", "<img", "url("] {
        assert!(!page.contains(outside), "{outside}");
    }
}

#[test]
fn the_cores_are_on_the_page_with_their_tasks_and_signals() {
    let page = synthetic_page();
    for part in [
        "The cores around the takeover",
        "One pass through the chain",
        "<title>planning: ",
        "killed",
        "Signals from core to core",
        "<svg class=\"spark\"",
    ] {
        assert!(page.contains(part), "{part}");
    }
}

#[test]
fn a_log_without_a_single_record_still_makes_a_page_that_says_what_is_wrong() {
    let (log, around) = (RunLog::default(), Surroundings::default());
    let page = page(
        &log,
        &Timeline::default(),
        &metrics::compute(&log, &Timeline::default(), &around),
    );
    assert!(page.contains("no control frame was ever accepted"));
    assert!(!page.contains("NaN"));
}

#[test]
fn what_is_said_again_and_again_is_counted() {
    let row = |at_s: f64, what: &str| (at_s, "A0".to_owned(), what.to_owned());
    let rows = merged(vec![row(1.0, "x"), row(2.0, "x"), row(3.0, "y")]);
    assert_eq!(rows, [row(1.0, "x (2 times)"), row(3.0, "y")]);
}

#[test]
fn names_from_a_scenario_file_are_text_and_no_markup() {
    let mut log = synthetic::with_takeover(4.0);
    log.header.scenario = "<script>alert(1)</script>".into();
    let around = Surroundings::default();
    let page = page(
        &log,
        &Timeline::default(),
        &metrics::compute(&log, &Timeline::default(), &around),
    );
    assert!(!page.contains("<script>"));
}

/// A run in which both systems lose power in the middle, and what its report says.
fn nobody_drives(machine: Seen) -> (metrics::Metrics, String) {
    let mut log = synthetic::with_takeover(8.0);
    let middle_ns = log.start_ns.unwrap() + 4_000_000_000;
    log.control.retain(|frame| frame.at_ns < middle_ns);
    let bounds = Bounds {
        silent_ms: 20.0,
        power_ms: 16.0,
        mute_ms: 19.0,
        ..Bounds::default()
    };
    let around = Surroundings {
        bounds,
        machine,
        ..Surroundings::default()
    };
    let metrics = metrics::compute(&log, &Timeline::default(), &around);
    let page = page(&log, &Timeline::default(), &metrics);
    (metrics, page)
}

#[test]
fn a_run_in_which_nobody_drives_fails() {
    let (metrics, page) = nobody_drives(Seen::default());
    let objections = objections(&metrics);
    assert_eq!(objections.len(), 1, "{objections:?}");
    assert!(
        objections[0].contains("no system drove for 4"),
        "{objections:?}"
    );
    assert!(
        objections[0].contains("no stall explains it"),
        "{objections:?}"
    );
    assert!(page.contains(&objections[0]) && !page.contains("under control from start"));
}

/// A stall of the machine is no fault of the product, and not "all well" either.
#[test]
fn a_gap_that_a_stall_explains_is_told_with_its_evidence() {
    let start_ns = synthetic::with_takeover(8.0).start_ns.unwrap();
    let stall = |from_ms: u64, to_ms: u64| Seen {
        stalls: vec![Stall {
            of: Stood::Cpu(1),
            from_ns: start_ns + from_ms * 1_000_000,
            to_ns: start_ns + to_ms * 1_000_000,
        }],
        watched_by: "a test".into(),
    };
    let (metrics, page) = nobody_drives(stall(4_000, 8_000));
    assert!(
        objections(&metrics).is_empty(),
        "{:?}",
        objections(&metrics)
    );
    assert!(metrics.gaps[0].explained && metrics.stalls.count == 1);
    let said = &machine_stalled(&metrics)[0];
    assert!(
        said.starts_with("machine stalled (evidence: CPU 1 gone for 4000.0 ms"),
        "{said}"
    );
    assert!(page.contains(said.as_str()) && !page.contains("under control from start"));
    let (metrics, _) = nobody_drives(stall(4_000, 6_000));
    let said = objections(&metrics);
    assert!(
        said[0].ends_with("gone for 2000.0 ms at 4.000 s does not explain it"),
        "{said:?}"
    );
}

/// A stall longer than the tolerated one costs a takeover that was not needed: the run does not
/// fail by it, and does not say that all was well.
#[test]
fn a_takeover_that_was_not_needed_is_told_with_the_stall_before_it() {
    let mut log = synthetic::with_takeover(8.0);
    let (first, last) = {
        let takeover = takeovers(&log)[0];
        (takeover.at_ns, takeover.from_ns)
    };
    // The old master sends on, so it had not failed.
    let of_old = log.control.iter().position(|frame| frame.at_ns == last);
    let sent_on = ControlFrame {
        at_ns: last + 10_000_000,
        verdict: Ruling::Fenced,
        ..log.control[of_old.unwrap()]
    };
    log.control.push(sent_on);
    log.control.sort_by_key(|frame| frame.at_ns);
    let compute = |stalled_ms: u64| {
        let (from_ns, to_ns) = (
            first - 1_000_000 - stalled_ms * 1_000_000,
            first - 1_000_000,
        );
        let of = Stood::Bus;
        let around = Surroundings {
            bounds: Bounds {
                silent_ms: 20.0,
                ..Bounds::default()
            },
            tolerated_ms: 3.0,
            machine: Seen {
                stalls: vec![Stall { of, from_ns, to_ns }],
                watched_by: "a test".into(),
            },
            ..Surroundings::default()
        };
        metrics::compute(&log, &Timeline::default(), &around)
    };
    let needless = compute(2);
    assert_eq!(needless.false_takeovers, 1);
    let said = objections(&needless);
    assert!(
        said[0].contains("from a master that had not failed"),
        "{said:?}"
    );
    let unneeded = compute(4);
    assert!(unneeded.takeovers[0].is_false && unneeded.false_takeovers == 0);
    assert_eq!(objections(&unneeded), Vec::<String>::new());
    let said = machine_stalled(&unneeded);
    assert!(
        said[0].contains("process gone for 4.0 ms") && said.len() == 1,
        "{said:?}"
    );
}
