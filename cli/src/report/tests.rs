//! Tests of the report of a synthetic run.

use super::*;
use std::path::Path;
use std::process::Command;

use crate::grandmaster::GrandmasterEnd;
use crate::metrics::Surroundings;
use crate::soc::SocEnd;
use crate::tests::synthetic;
use crate::timeline::Timeline;
use crate::{metrics, timeline};
use serde_json::{Value, json};
use tandem_board::Duration;
use tandem_bus::{AbilityCode, ModeCode, RoleCode};
use tandem_record::gap::Bounds;
use tandem_record::run_log::{ControlFrame, Stall, StatusFrame, Stood};
use tandem_record::verdict::{Beside, Limits, Outcome, Rule, Watch};
use tandem_redundancy::Config;
use tandem_vehicle::Ruling;

fn page(log: &RunLog, timeline: &Timeline, metrics: &metrics::Metrics) -> String {
    super::page(
        log,
        timeline,
        metrics,
        timeline::encode(timeline, log).begin_ns,
    )
}

fn synthetic_page() -> String {
    let log = synthetic::with_takeover(60.0);
    let around = Surroundings {
        granted: "SCHED_FIFO, memory locked, CPUs 0 and 1".into(),
        timing: "rt".into(),
        detection_bound_ms: Some(3.2),
        beside: Beside {
            bounds: Bounds {
                silent_ms: 20.0,
                power_ms: 14.5,
                mute_ms: 20.0,
                ..Bounds::default()
            },
            ..Beside::default()
        },
        ..Surroundings::default()
    };
    let moment = takeovers(&log)[0].at_ns;
    let timeline = timeline::tests::around(moment);
    let metrics = metrics::compute(&log, &timeline, &around);
    page(&log, &timeline, &metrics)
}

/// The page loads no other file. If `TANDEM_REPORT_SAMPLE` is set, writes the page to that path.
#[test]
fn the_page_needs_nothing_from_outside() {
    let page = synthetic_page();
    if let Some(path) = std::env::var_os("TANDEM_REPORT_SAMPLE") {
        std::fs::write(path, &page).unwrap();
    }
    // uPlot names its home in a comment.
    let page = page.replace("https://github.com/leeoniya/uPlot", "");
    for outside in [
        "http:", "https:", "<link", "<img", "url(", " src=", "@import",
    ] {
        assert!(!page.contains(outside), "{outside}");
    }
    assert!(page.contains("default-src 'none'"));
}

/// The plots zoom and show values, a click on an event moves them all, and the page can be read in
/// a narrow window and in dark colours, in Chromium. Skipped without it;
/// `TANDEM_REQUIRE_CHROMIUM=1` requires it. `TANDEM_PICTURES=FOLDER` keeps pictures.
#[test]
fn the_plots_can_be_used_in_chromium() {
    let starts = |program: &str| {
        let output = Command::new(program).arg("--version").output();
        output.is_ok_and(|output| output.status.success())
    };
    let programs = ["python3", "chromium", "chromedriver"];
    if !programs.iter().all(|program| starts(program)) {
        let required = std::env::var_os("TANDEM_REQUIRE_CHROMIUM");
        assert!(
            required.is_none_or(|it| it != "1"),
            "one of {programs:?} is missing"
        );
        eprintln!("skipped: one of {programs:?} is missing");
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("report.html");
    std::fs::write(&path, synthetic_page()).unwrap();
    let log = synthetic::with_takeover(60.0);
    let moment_ns = takeovers(&log)[0].at_ns;
    let timeline = timeline::tests::around(moment_ns);
    let begin_ns = timeline::encode(&timeline, &log).begin_ns;
    // The page tells the time of the takeover's row, rounded to 1 µs.
    let at_us = (log.seconds(moment_ns) * 1e6).round() as u64;
    let in_trace_ns = log.start_ns.unwrap() + at_us * 1_000 - begin_ns;
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("../page/tests/report.py");
    let output = Command::new("python3")
        .arg(script)
        .arg(&path)
        .arg(format!("{:.6}", at_us as f64 * 1e-6))
        .arg(in_trace_ns.to_string())
        .output()
        .unwrap();
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{said}");
}

/// The trace begins with its first event, and the page knows when that was.
#[test]
fn the_page_knows_when_the_trace_begins() {
    let log = synthetic::with_takeover(8.0);
    let timeline = Timeline::default();
    let begin_ns = timeline::encode(&timeline, &log).begin_ns;
    assert!(begin_ns > 0 && begin_ns <= log.start_ns.unwrap());
    let metrics = metrics::compute(&log, &timeline, &Surroundings::default());
    let page = page(&log, &timeline, &metrics);
    let said = format!("data-trace-ns=\"{begin_ns}\"");
    assert!(page.contains(&said), "{said}");
}

/// The page says when one system drove alone: since when, until when, and which one.
#[test]
fn lost_redundancy_is_on_the_page_with_its_times() {
    let mut log = synthetic::with_takeover(8.0);
    let to_the_end = |log: &RunLog| {
        let metrics = metrics::compute(log, &Timeline::default(), &Surroundings::default());
        page(log, &Timeline::default(), &metrics)
    };
    let lost = to_the_end(&log);
    assert!(lost.contains("no redundancy from 4.0 s to the end: B drove alone"));
    assert!(lost.contains("data-at=\"4.000000\""));
    // A stands by again from 6 s on.
    let start_ns = log.start_ns.unwrap();
    for tenth in 60..80 {
        log.status.push(StatusFrame {
            at_ns: start_ns + tenth * 100_000_000,
            system: SystemId::A,
            role: RoleCode::Standby,
            mode: ModeCode::L3,
            ability: AbilityCode::All,
        });
    }
    let back = to_the_end(&log);
    assert!(back.contains("no redundancy from 4.0 s to 6.0 s: B drove alone"));
    assert!(!back.contains("to the end"));
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
fn equal_events_are_counted() {
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
    assert!(!page.contains("<script>alert"));
}

/// Returns the figures and the report of a run in which both systems lose power in the middle.
fn no_system_drives(watch: Watch, stalls: Vec<Stall>) -> (metrics::Metrics, String) {
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
        beside: Beside {
            bounds,
            watch,
            stalls,
            ..Beside::default()
        },
        ..Surroundings::default()
    };
    let metrics = metrics::compute(&log, &Timeline::default(), &around);
    let page = page(&log, &Timeline::default(), &metrics);
    (metrics, page)
}

#[test]
fn a_run_in_which_no_system_drives_fails() {
    let (metrics, page) = no_system_drives(Watch::Urgent, vec![]);
    let objections = metrics.verdict.objections();
    assert_eq!(objections.len(), 1, "{objections:?}");
    assert!(
        objections[0].contains("no system drove for 4"),
        "{objections:?}"
    );
    assert!(page.contains(&objections[0]) && !page.contains("under control from start"));
}

/// A gap that a stall of the machine explains is not a fault of the product, but it is reported. A
/// stall that a thread of ordinary priority recorded is not evidence.
#[test]
fn a_gap_that_a_stall_explains_is_reported_with_its_evidence() {
    let start_ns = synthetic::with_takeover(8.0).start_ns.unwrap();
    // The stall is on the bus, or on the CPU of the standby's core 0.
    let stall = |of, to_ms: u64| Stall {
        of,
        from_ns: start_ns + 4_000 * 1_000_000,
        to_ns: start_ns + to_ms * 1_000_000,
    };
    let bus = stall(Stood::Bus, 8_000);
    let (metrics, page) = no_system_drives(Watch::Urgent, vec![bus]);
    assert_eq!(metrics.verdict.objections(), Vec::<String>::new());
    assert!(metrics.figures.gaps[0].explained && metrics.stalls.count == 1);
    let reported = &metrics.verdict.parts()[0].1;
    assert!(
        reported.starts_with("machine stalled (evidence: the vehicle's process gone for 4000.0 ms"),
        "{reported}"
    );
    assert!(page.contains(reported.as_str()) && !page.contains("under control from start"));
    let (metrics, _) = no_system_drives(Watch::Urgent, vec![stall(Stood::Cpu(3), 6_000)]);
    let objections = metrics.verdict.objections();
    assert!(
        objections[0].ends_with("CPU 3 gone for 2000.0 ms at 4.000 s does not explain it"),
        "{objections:?}"
    );
    let (metrics, page) = no_system_drives(Watch::Ordinary, vec![bus]);
    assert_eq!(metrics.verdict.outcome, Outcome::NotJudged);
    assert_eq!(metrics.verdict.objections().len(), 1);
    assert!(page.contains("not judged: no real time"));
}

/// A stall above the limit, on the bus or in the old master, explains an unnecessary takeover. The
/// takeover is reported, and the run does not fail. Other stalls do not explain it.
#[test]
fn a_takeover_that_was_not_needed_is_reported_with_the_stall_before_it() {
    let mut log = synthetic::with_takeover(8.0);
    let (first, last) = {
        let takeover = takeovers(&log)[0];
        (takeover.at_ns, takeover.from_ns)
    };
    // The old master continues to send, so it has not failed.
    let of_old = log.control.iter().position(|frame| frame.at_ns == last);
    let sent_on = ControlFrame {
        at_ns: last + 10_000_000,
        ruling: Ruling::Fenced,
        ..log.control[of_old.unwrap()]
    };
    log.control.push(sent_on);
    log.control.sort_by_key(|frame| frame.at_ns);
    let compute = |of: Stood, stalled_ms: u64| {
        let (from_ns, to_ns) = (
            first - 1_000_000 - stalled_ms * 1_000_000,
            first - 1_000_000,
        );
        let around = Surroundings {
            beside: Beside {
                bounds: Bounds {
                    silent_ms: 20.0,
                    limits: Limits::DESKTOP,
                    ..Bounds::default()
                },
                watch: Watch::Urgent,
                stalls: vec![Stall { of, from_ns, to_ns }],
                ..Beside::default()
            },
            ..Surroundings::default()
        };
        metrics::compute(&log, &Timeline::default(), &around)
    };
    for needless in [compute(Stood::Bus, 2), compute(Stood::Cpu(3), 4)] {
        assert_eq!(needless.figures.false_takeovers, 1);
        let objections = needless.verdict.objections();
        assert!(
            objections[0].contains("from a master that had not failed"),
            "{objections:?}"
        );
    }
    for unneeded in [compute(Stood::Bus, 4), compute(Stood::Cpu(0), 4)] {
        let takeover = &unneeded.figures.takeovers[0];
        assert!(takeover.is_false && unneeded.figures.false_takeovers == 0);
        assert_eq!(unneeded.verdict.objections(), Vec::<String>::new());
        let reported = &unneeded.verdict.parts()[0].1;
        assert!(reported.contains("gone for 4.0 ms"), "{reported}");
    }
}

/// B loses its power and does not return: the verdict reports it, and the run does not fail.
#[test]
fn redundancy_that_is_lost_to_the_end_is_reported() {
    let log = synthetic::with_takeover(8.0);
    let around = Surroundings::default();
    let metrics = metrics::compute(&log, &Timeline::default(), &around);
    let page = page(&log, &Timeline::default(), &metrics);
    assert!(page.contains("redundancy was lost at 4.0 s to the end: no system that could drive"));
    assert!(!page.contains("under control from start"));
    assert_eq!(metrics.verdict.outcome, Outcome::UnderControl);
}

/// Each figure beyond its bound is a finding of its rule, which fails the run or is reported.
#[test]
fn each_figure_beyond_its_bound_is_a_finding() {
    let found = |change: &dyn Fn(&mut RunLog)| {
        let mut log = synthetic::with_takeover(4.0);
        change(&mut log);
        let around = Surroundings::default();
        let verdict = metrics::compute(&log, &Timeline::default(), &around).verdict;
        verdict
            .findings
            .into_iter()
            .filter(|it| it.rule != Rule::NoStandby)
            .collect::<Vec<_>>()
    };
    assert_eq!(found(&|_| {}), []);
    for (rule, fails, change) in [
        (
            Rule::CutShort,
            true,
            (|log| log.end_ns = None) as fn(&mut RunLog),
        ),
        (Rule::Collision, true, |log| log.figures.collisions = 1),
        (Rule::LeftLane, true, |log| {
            log.figures.excursion_max_m = 0.1
        }),
        (Rule::LateralError, false, |log| {
            log.figures.lateral_error_max_m = 0.9
        }),
        (Rule::OutsideDomain, true, |log| {
            log.figures.outside_domain_s = 0.1
        }),
        (Rule::Stopped, true, |log| log.figures.standing_s = 0.1),
        (Rule::TakeoverAsked, false, |log| {
            log.figures.takeover_asked_s = Some(1.0)
        }),
        (Rule::SlowControl, true, |log| {
            let mut turn = 0;
            log.control.retain(|_| {
                turn += 1;
                turn % 2 == 0
            });
        }),
        (Rule::WrongMode, true, |log| {
            log.control
                .iter_mut()
                .for_each(|frame| frame.mode = ModeCode::L3);
        }),
    ] {
        let findings = found(&change);
        let rules: Vec<Rule> = findings.iter().map(|it| it.rule).collect();
        assert_eq!(rules, [rule], "{findings:?}");
        assert_eq!(findings[0].fails_run(), fails, "{rule}");
    }
    let stops = found(&|log| {
        log.power.clear();
        log.figures.safe_stop_s = Some(1.0);
    });
    assert!(
        stops
            .iter()
            .any(|it| it.rule == Rule::Stopped && it.fails_run()),
        "{stops:?}"
    );
}

/// A run without a fault still fails if the product's own limits permit more than the requirement.
#[test]
fn a_product_with_a_longer_control_margin_fails() {
    let log = synthetic::with_takeover(4.0);
    let with = |control_margin| Surroundings {
        beside: Beside {
            product: Some(Config {
                control_margin,
                ..Config::rt()
            }),
            ..Beside::default()
        },
        ..Surroundings::default()
    };
    let outcome = |around: &Surroundings| {
        metrics::compute(&log, &Timeline::default(), around)
            .verdict
            .outcome
    };
    assert_eq!(
        outcome(&with(Config::rt().control_margin)),
        Outcome::UnderControl
    );
    assert_eq!(outcome(&with(Duration::from_ms(400))), Outcome::Failed);
}

/// D-3: the page shows how the SoC parked and what it heard, in runs with one only.
#[test]
fn the_topics_are_on_the_page_of_a_run_with_an_soc() {
    let log = synthetic::with_takeover(8.0);
    let id = json!({
        "id": "110", "name": "EgoMotion", "period_ms": 10, "frames": 700, "rate_hz": 100.0,
        "longest_ms": 12.5, "age_ms": 3.0, "late": false, "lost": 2, "jumps": 0, "damaged": 0,
        "samples": {"A": 400, "B": 699},
    });
    let phase = |after_ns: u64, phase: &str, driven_m: f32| json!({"at_ns": log.start_ns.unwrap() + after_ns, "phase": phase, "driven_m": driven_m});
    let mut record = json!({
        "way_m": 12.0, "driven_m": 11.5, "is_parked": true, "ids": [id],
        "phases": [phase(0, "approaching", 0.0), phase(6_500_000_000, "parked", 11.5)],
    });
    let shown = |record: &Value| {
        let end = SocEnd {
            record: serde_json::from_value(record.clone()).unwrap(),
            died: None,
        };
        let around = Surroundings::default().with_soc(Some(end));
        let metrics = metrics::compute(&log, &Timeline::default(), &around);
        let table = crate::summary::table(&metrics, &[], Path::new("report.html"));
        (page(&log, &Timeline::default(), &metrics), table)
    };
    let (with, table) = shown(&record);
    for part in [
        "<h2>Topics</h2>",
        "Parked, 11.50 of 12 m driven",
        "6.500 s",
        "EgoMotion",
        "<td class=\"num bad\">2</td>",
        "<td class=\"num\">12.5</td>",
    ] {
        assert!(with.contains(part), "{part}");
    }
    assert!(table.contains("parked at 6.5 s, 11.50 of 12 m"), "{table}");
    assert!(
        table.contains("1 ids, 700 frames, 2 lost; samples: 400 of A"),
        "{table}"
    );
    record["is_parked"] = false.into();
    let (without, table) = shown(&record);
    assert!(without.contains("Not parked: parked, 11.50 of 12 m driven"));
    assert!(
        table.contains("the SoC did not park the vehicle: parked"),
        "{table}"
    );
    assert!(!synthetic_page().contains("<h2>Topics</h2>"));
}

/// S-1: the page and the figures show the time of each clock, in runs with a time only: the
/// deviation from the grandmaster, holdover, leaps, and the skew of the control cycles.
#[test]
fn the_time_is_on_the_page_with_its_figures() {
    let mut log = synthetic::with_takeover(20.0);
    let ahead_ns = 1_790_000_000_000_000_000;
    synthetic::add_time(&mut log, ahead_ns);
    let around = Surroundings {
        grandmaster: Some(GrandmasterEnd {
            ahead_ns: Some(ahead_ns),
            died: Some("signal: 9".to_owned()),
        }),
        ..Surroundings::default()
    };
    let metrics = metrics::compute(&log, &Timeline::default(), &around);
    let figures = serde_json::to_value(&metrics).unwrap()["time"].take();
    let (a, b) = (&figures["clocks"]["A"], &figures["clocks"]["B"]);
    let is = |value: &Value, wanted: f64| {
        let value = value.as_f64().unwrap();
        assert!(
            (value - wanted).abs() < 0.01 * wanted,
            "{value} {wanted}: {figures:#}"
        );
    };
    is(&a["deviation"]["p50_us"], 2.0);
    is(&b["deviation"]["max_us"], 1.0);
    is(&a["offset"]["p99_us"], 2.0);
    is(&a["delay"]["p50_us"], 7.0);
    is(&a["holdover_s"], 4.0);
    is(&figures["apart"]["max_us"], 3.0);
    is(&figures["skew"]["p50_us"], 8.0);
    assert_eq!((&a["leaps"], &b["leaps"]), (&json!(1), &json!(0)));
    let page = page(&log, &Timeline::default(), &metrics);
    for part in [
        "<h2>Time</h2>",
        "The grandmaster's process ended: signal: 9",
        "<h2>Deviation from the grandmaster</h2>",
        "<h2>Rate</h2>",
        "<h2>Skew of the control cycles</h2>",
        "follows a leap of the grandmaster by 3.000 ms",
    ] {
        assert!(page.contains(part), "{part}");
    }
    let without = Surroundings::default();
    let metrics = metrics::compute(&log, &Timeline::default(), &without);
    let page = self::page(&log, &Timeline::default(), &metrics);
    assert!(page.contains("<h2>A and B apart</h2>"));
    assert!(!synthetic_page().contains("<h2>Time</h2>"));
}
