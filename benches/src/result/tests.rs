//! The results: how the figures are computed, and the names in the file.

use super::*;
use crate::cases;
use crate::harness::Batch;
use serde_json::Value;

/// Returns a measurement of this case: one batch for each list of times, in picoseconds.
fn measured(name: &str, batches: &[Vec<u64>]) -> Measurement {
    let case = cases::all().find(|case| case.full_name() == name).unwrap();
    let mut measurement = Measurement::new(case);
    for samples_ps in batches {
        let batch = Batch {
            samples_ps: samples_ps.clone(),
            payload_bytes: 8,
            cpu_ns_per_message: Some(150.04),
            facts: vec![("longest wait, ns", samples_ps[0] as f64), ("share", 0.5)],
            ..Batch::default()
        };
        measurement.add(batch, 0.0);
    }
    measurement
}

/// Returns 1000 down to 1 times `step` picoseconds.
fn ramp(step: u64) -> Vec<u64> {
    (1..=1000).rev().map(|i| i * step).collect()
}

fn run() -> Results {
    let mut skipped = measured("sleep/tandem", &[]);
    skipped.skipped = Some("no reason".to_owned());
    let mut spinning = measured("spin/tandem", &[ramp(200), ramp(220)]);
    spinning.round_trips = measured("spin/floor", &[ramp(400)]).times;
    let all = [
        measured("spin/floor", &[ramp(100), ramp(100)]),
        spinning,
        measured("throughput/fifo-8B", &[vec![8_000; 100]]),
        measured("noise/cpu0", &[ramp(20)]),
        skipped,
    ];
    Results::new(&all, &[0, 1], 12.34, false)
}

#[test]
fn the_file_has_the_names_that_readers_rely_on() {
    let file = serde_json::to_value(run()).unwrap();
    let names = |value: &Value| -> Vec<String> {
        let mut names: Vec<String> = value.as_object().unwrap().keys().cloned().collect();
        names.sort();
        names
    };
    let run = "duration_s interrupted load machine noise results schema skipped";
    let row = "batch_line_ns batch_p50_ns batch_steal_ms bytes_per_second cpu_ns_per_message curve \
        facts group max_ns messages_per_second modes name p50_ns p90_ns p99_9_ns p99_ns \
        payload_bytes ratio_range_p50 ratio_to_floor_p50 ratio_to_floor_p99_9 round_trip samples what";
    let machine = "cpu cpus pinned_to topology kernel build commit compiler flags versions";
    assert_eq!(names(&file).join(" "), run);
    assert_eq!(names(&file["results"][1]).join(" "), row);
    for name in machine.split(' ') {
        assert!(!file["machine"][name].is_null(), "{name}");
    }
    assert_eq!(file["schema"], SCHEMA);
    assert_eq!(file["results"][1]["name"], "spin/tandem");
    assert_eq!(file["results"][1]["group"], "spin");
    assert_eq!(file["skipped"][0]["name"], "sleep/tandem");
}

#[test]
fn percentiles_and_ratios_are_those_of_all_batches() {
    let run = run();
    let [floor, tandem, fifo] = &run.results[..] else {
        panic!("{:?}", run.results.len());
    };
    // Medians of 50 and 105 ns, within the histogram's three digits and the rounding.
    for (figure, expected) in [
        (floor.p50_ns, 50.0),
        (tandem.p50_ns, 105.0),
        (tandem.ratio_to_floor_p50.unwrap(), 2.1),
        (tandem.max_ns, 220.0),
        (tandem.round_trip.unwrap().p50_ns, 200.0),
        (tandem.batch_p50_ns[0], 100.2),
        (tandem.batch_p50_ns[1], 110.2),
    ] {
        assert!(
            (figure / expected - 1.0).abs() < 0.005,
            "{figure} {expected}"
        );
    }
    assert_eq!((tandem.samples, tandem.batch_p50_ns.len()), (2000, 2));
    assert_eq!(floor.ratio_to_floor_p50, Some(1.0));
    assert_eq!((fifo.ratio_to_floor_p50, floor.round_trip), (None, None));
    assert_eq!(tandem.cpu_ns_per_message, Some(150.0));
    assert_eq!(run.noise[0].name, "noise/cpu0");
}

/// A line takes 70 or 250 ns. Most batches of Tandem met the slow state and most of the floor the
/// fast one, so that the medians of all samples are 3.8 times each other. In each state it is 1.1.
#[test]
fn medians_of_a_group_are_those_of_one_state() {
    let in_states = |name: &str, slow: usize, ratio: f64| {
        let lines = (0..20).map(|turn| if turn < slow { 250_000 } else { 70_000 });
        let lines: Vec<u64> = lines.map(|ps: u64| ps).collect();
        let batches = lines
            .iter()
            .map(|ps| vec![(*ps as f64 * ratio) as u64; 100]);
        let mut of = measured(name, &batches.collect::<Vec<_>>());
        of.lines_ps = lines.iter().map(|ps| Some([*ps; 2])).collect();
        of
    };
    let mut floor = in_states("spin/floor", 3, 1.0);
    // The state changed during this batch.
    floor.lines_ps[19] = Some([70_000, 250_000]);
    let all = [floor, in_states("spin/tandem", 11, 1.1)];
    let run = Results::new(&all, &[0, 1], 1.0, false);
    let [floor, tandem] = &run.results[..] else {
        panic!("{:?}", run.results.len());
    };
    assert_eq!((floor.p50_ns, tandem.p50_ns), (70.0, 77.0));
    assert_eq!(tandem.ratio_to_floor_p50, Some(1.1));
    let states = |row: &Row| -> Vec<(f64, f64, f64, bool)> {
        let modes = row.modes.iter();
        let figures = modes.map(|of| (of.line_ns, of.share, of.p50_ns, of.is_compared));
        figures.collect()
    };
    assert_eq!(
        states(floor),
        [(70.0, 0.8, 70.0, true), (250.0, 0.15, 250.0, false)]
    );
    assert_eq!(
        states(tandem),
        [(70.0, 0.45, 77.0, true), (250.0, 0.55, 275.0, false)]
    );
    // In too few turns both met this state.
    assert_eq!(tandem.ratio_range_p50, None);
}

#[test]
fn throughput_is_a_second_over_the_median() {
    let run = run();
    let fifo = &run.results[2];
    let rate = fifo.messages_per_second.unwrap();
    assert!((rate / 125e6 - 1.0).abs() < 0.002, "{rate}");
    assert!((fifo.bytes_per_second.unwrap() / rate - 8.0).abs() < 1e-6);
    assert_eq!(run.results[0].messages_per_second, None);
}

#[test]
fn facts_are_medians_and_what_is_longest_is_the_longest() {
    let run = run();
    let facts = &run.results[1].facts;
    assert_eq!(facts["share"], 0.5);
    assert_eq!(facts["longest wait, ns"], 220_000.0);
}

#[test]
fn naive_percentiles_are_those_of_all_batches() {
    let mut measurement = measured("rate/tandem", &[]);
    // In one batch of ten the machine stalled: one message in ten was slow.
    for ps in [1_000_000, 1_000].into_iter().chain([1_000; 8]) {
        let naive_ps = vec![ps; 100];
        let batch = Batch {
            naive_ps,
            ..Batch::default()
        };
        measurement.add(batch, 0.0);
    }
    let facts = facts(&measurement);
    assert_eq!(facts["naive p50, ns"], 1.0);
    let shown = ["naive p99, ns", "naive p99.9, ns", "longest naive, ns"].map(|name| facts[name]);
    assert!(
        shown.iter().all(|ns| (ns / 1000.0 - 1.0).abs() < 1e-3),
        "{shown:?}"
    );
}

#[test]
fn a_curve_ends_where_ten_samples_are_left() {
    let curve = &run().results[1].curve;
    assert_eq!(curve.len(), CURVE_POINTS);
    // 2000 samples support a quantile of 99.5 %.
    assert!((curve.last().unwrap().0 - 0.995).abs() < 1e-6);
    assert!(
        curve
            .windows(2)
            .all(|pair| pair[0].0 < pair[1].0 && pair[0].1 <= pair[1].1)
    );
    let few = measured("spin/floor", &[vec![1, 2, 3]]);
    assert!(Row::new(&few, None, &States(vec![]), None).curve.is_empty());
}

/// D-6: the latency of topics is measured beside the bare socket, a peer, and the transports inside
/// a machine. In shared memory no socket is needed: the ratio says how much that saves.
#[test]
fn all_topics_are_compared_with_the_bare_socket() {
    let names = ["udp-floor", "tandem", "ddsperf", "shm", "iceoryx2"];
    let of_topics = cases::all().map(|case| case.full_name());
    let of_topics: Vec<_> = of_topics
        .filter(|name| name.starts_with("topics/"))
        .collect();
    assert_eq!(of_topics, names.map(|name| format!("topics/{name}")));
    let all = names.map(|name| measured(&format!("topics/{name}"), &[ramp(100)]));
    let run = Results::new(&all, &[0, 1], 1.0, false);
    assert_eq!(run.results.len(), names.len());
    for row in &run.results {
        assert_eq!(row.ratio_to_floor_p50, Some(1.0), "{}", row.name);
    }
}
