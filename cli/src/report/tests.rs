//! The report of a made-up run.

use super::*;
use crate::metrics::Surroundings;
use crate::timeline::Timeline;
use crate::{metrics, synthetic, timeline};

fn synthetic_page() -> String {
    let log = synthetic::with_takeover(60.0);
    let around = Surroundings {
        granted: "SCHED_FIFO, memory locked, CPUs 0 and 1".into(),
        timing: "rt".into(),
        detection_bound_ms: Some(3.2),
        gap_bound_ms: Some(14.5),
        leftovers: Vec::new(),
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
