//! The comparison: on made-up runs, by simulation, and on files that are wrong.

use super::*;
use crate::synthetic::{results, row};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng as _;
use rand_distr::{Distribution as _, LogNormal};

/// A case whose batches have this median, each with its own noise and that of the machine.
fn noisy(name: &str, p50_ns: f64, mood: &[f64], random: &mut ChaCha8Rng) -> Row {
    let own = LogNormal::new(0.0, 0.02).unwrap();
    let mut row = row(name, p50_ns);
    let mut batch = |at: f64| mood.iter().map(|m| at * m * own.sample(random)).collect();
    row.batch_p50_ns = batch(p50_ns);
    row.batch_p99_ns = batch(row.p99_ns);
    row
}

/// A run of 24 batches on a machine in moods of its own: `factor` slows Tandem down, `machine` all.
fn run(factor: f64, machine: f64, random: &mut ChaCha8Rng) -> Results {
    let moods = LogNormal::new(machine.ln(), 0.04).unwrap();
    let mood: Vec<f64> = (0..24).map(|_| moods.sample(random)).collect();
    let mut rows = vec![noisy("spin/floor", 75.0, &mood, random)];
    rows.push(noisy("spin/tandem", 84.0 * factor, &mood, random));
    for peer in ["a", "b", "c", "d", "e"] {
        rows.push(noisy(
            &format!("spin/iceoryx2-{peer}"),
            350.0,
            &mood,
            random,
        ));
    }
    results(rows)
}

fn compared(a: &Results, b: &Results) -> Comparison {
    compare((Path::new("a.json"), a), (Path::new("b.json"), b))
}

#[test]
fn runs_without_a_change_seldom_show_one() {
    let mut random = ChaCha8Rng::seed_from_u64(21);
    let pairs = 400;
    let mut errors = 0;
    for _ in 0..pairs {
        let (a, b) = (run(1.0, 1.0, &mut random), run(1.0, 1.0, &mut random));
        let comparison = compared(&a, &b);
        let changed = [
            &comparison.slower,
            &comparison.faster,
            &comparison.peers_changed,
        ];
        errors += u32::from(changed.iter().any(|names| !names.is_empty()));
    }
    // Alpha permits 20; the demands on size and direction make it fewer.
    assert!(errors <= 20, "{errors} of {pairs}");
}

/// The same with so few batches that ranks prove nothing.
fn short(mut run: Results) -> Results {
    for row in &mut run.results {
        row.batch_p50_ns.truncate(3);
        row.batch_p99_ns.truncate(3);
    }
    run
}

#[test]
fn short_runs_show_what_is_large_and_nothing_else() {
    let mut random = ChaCha8Rng::seed_from_u64(24);
    let pairs = 200;
    let (mut errors, mut found) = (0, 0);
    for _ in 0..pairs {
        let a = short(run(1.0, 1.0, &mut random));
        let comparison = compared(&a, &short(run(1.0, 1.0, &mut random)));
        let changed = [
            &comparison.slower,
            &comparison.faster,
            &comparison.peers_changed,
        ];
        errors += u32::from(changed.iter().any(|names| !names.is_empty()));
        let doubled = compared(&a, &short(run(2.0, 1.0, &mut random)));
        found += u32::from(doubled.slower == ["spin/tandem"]);
    }
    assert!(errors <= 10, "{errors} of {pairs}");
    assert!(found >= 190, "{found} of {pairs}");
}

#[test]
fn a_machine_in_another_mood_is_no_change() {
    let mut random = ChaCha8Rng::seed_from_u64(22);
    for machine in [0.8, 1.25] {
        let (a, b) = (run(1.0, 1.0, &mut random), run(1.0, machine, &mut random));
        let comparison = compared(&a, &b);
        assert!(comparison.slower.is_empty() && comparison.faster.is_empty());
        let tandem = &comparison.cases[1].p50;
        assert!((tandem.time.unwrap().change - (machine - 1.0)).abs() < 0.06);
        assert!(tandem.ratio.unwrap().change.abs() < 0.03);
    }
}

#[test]
fn a_tenth_more_is_slower_and_the_way_back_is_faster() {
    let mut random = ChaCha8Rng::seed_from_u64(23);
    let pairs = 100;
    let mut found = 0;
    for _ in 0..pairs {
        let (a, b) = (run(1.0, 1.0, &mut random), run(1.1, 1.0, &mut random));
        let there = compared(&a, &b);
        found += u32::from(there.slower == ["spin/tandem"] && there.faster.is_empty());
        assert_eq!(compared(&b, &a).faster, there.slower);
        let interval = there.cases[1].p50.time.unwrap();
        assert!(
            interval.low.unwrap() < interval.change && interval.change < interval.high.unwrap()
        );
    }
    assert!(found >= 95, "{found} of {pairs}");
}

#[test]
fn a_run_that_drifts_proves_no_smaller_change() {
    let drifting = |level: f64| {
        let mut run = results(vec![row("pool/take-give", 50.0 * level)]);
        // A fifth more at the end of each run.
        let batches = (0..20).map(|i| 50.0 * level * (1.0 + 0.01 * f64::from(i)));
        run.results[0].batch_p50_ns = batches.collect();
        run.results[0].batch_p99_ns = run.results[0].batch_p50_ns.clone();
        run
    };
    let comparison = compared(&drifting(1.0), &drifting(1.08));
    assert!(comparison.slower.is_empty());
    assert!(comparison.cases[0].p50.drift > 0.08);
    assert_eq!(
        compared(&drifting(1.0), &drifting(1.5)).slower,
        ["pool/take-give"]
    );
}

#[test]
fn a_change_that_nobody_would_feel_is_none() {
    let still = |p50: f64| results(vec![row("pool/take-give", p50)]);
    assert!(compared(&still(100.0), &still(101.0)).slower.is_empty());
    assert_eq!(
        compared(&still(100.0), &still(105.0)).slower,
        ["pool/take-give"]
    );
}

#[test]
fn a_tail_alone_can_become_slower() {
    let mut b = results(vec![row("pool/take-give", 100.0)]);
    let a = b.clone();
    b.results[0]
        .batch_p99_ns
        .iter_mut()
        .for_each(|ns| *ns *= 2.0);
    let comparison = compared(&a, &b);
    assert_eq!(comparison.cases[0].p50.verdict, Verdict::NoChange);
    assert_eq!(comparison.cases[0].p99.verdict, Verdict::Slower);
    assert_eq!(comparison.slower, ["pool/take-give"]);
}

#[test]
fn a_peer_that_changed_is_shown_and_does_not_count() {
    let (a, b) = (
        results(vec![row("spin/rtrb", 70.0)]),
        results(vec![row("spin/rtrb", 140.0)]),
    );
    let comparison = compared(&a, &b);
    assert!(comparison.slower.is_empty());
    assert_eq!(comparison.peers_changed, ["spin/rtrb"]);
    assert!(comparison.table().contains("luck of a run: spin/rtrb"));
}

#[test]
fn the_floor_gets_no_verdict() {
    let (a, b) = (
        results(vec![row("spin/floor", 70.0)]),
        results(vec![row("spin/floor", 140.0)]),
    );
    let comparison = compared(&a, &b);
    assert!(comparison.slower.is_empty());
    assert!(comparison.table().contains("(the machine)"));
}

#[test]
fn cases_of_one_run_alone_are_named() {
    let a = results(vec![row("spin/tandem", 84.0), row("sleep/pipe", 3e4)]);
    let b = results(vec![row("spin/tandem", 84.0), row("lock/free", 8.0)]);
    let comparison = compared(&a, &b);
    assert_eq!(comparison.only_in_a, ["sleep/pipe"]);
    assert_eq!(comparison.only_in_b, ["lock/free"]);
    let table = comparison.table();
    for part in [
        "only in A: sleep/pipe",
        "only in B: lock/free",
        "spin (ns)",
        "0 slower",
    ] {
        assert!(table.contains(part), "{part}\n{table}");
    }
    assert!(
        table.lines().all(|line| line.chars().count() <= 110),
        "{table}"
    );
}

#[test]
fn too_few_batches_are_said_to_be() {
    let mut a = results(vec![row("spin/tandem", 84.0)]);
    assert!(compared(&a, &a).remarks.is_empty());
    a.results[0].batch_p50_ns.truncate(1);
    let remarks = compared(&a, &a).remarks;
    assert!(remarks[0].contains("a single batch"), "{remarks:?}");
}

#[test]
fn machines_that_differ_are_named() {
    let a = results(vec![row("spin/tandem", 84.0)]);
    let mut b = a.clone();
    b.machine.kernel = "9.9".to_owned();
    b.interrupted = true;
    let remarks = compared(&a, &b).remarks;
    assert!(remarks[0].contains("Linux 9.9 in B"), "{remarks:?}");
    assert!(remarks[1].contains("B was interrupted"), "{remarks:?}");
}

#[test]
fn a_run_without_batches_has_no_verdict_and_is_no_error() {
    let mut a = results(vec![row("spin/tandem", 84.0)]);
    a.results[0].batch_p50_ns.clear();
    let comparison = compared(&a, &a);
    assert_eq!(comparison.cases[0].p50.time, None);
    assert!(comparison.slower.is_empty());
}

#[test]
fn many_batches_are_merged() {
    let values: Vec<f64> = (0..100_000).map(f64::from).collect();
    let merged = merged(values);
    assert!(merged.len() <= MOST_BATCHES);
    assert_eq!(median(&merged), Some(49_999.5));
}

/// Writes two files, compares them, and returns the error.
fn error_of(a: &str, b: &str) -> String {
    let folder = tempfile::tempdir().unwrap();
    let [a, b] = [("a.json", a), ("b.json", b)].map(|(name, text)| {
        let path = folder.path().join(name);
        std::fs::write(&path, text).unwrap();
        path
    });
    files(&a, &b).unwrap_err().to_string()
}

#[test]
fn a_file_that_is_not_ours_is_refused_in_words() {
    let good = serde_json::to_string(&results(vec![row("spin/tandem", 84.0)])).unwrap();
    let mut twice = results(vec![row("spin/tandem", 84.0), row("spin/tandem", 84.0)]);
    let doubled = serde_json::to_string(&twice).unwrap();
    twice.results.truncate(1);
    twice.results[0].batch_p50_ns[3] = -1.0;
    let negative = serde_json::to_string(&twice).unwrap();
    let other = serde_json::to_string(&results(vec![row("sleep/tandem", 84.0)])).unwrap();
    for (bad, why) in [
        ("", "EOF"),
        ("[1, 2]", "b.json is no file of `tandem bench --json`"),
        (
            "{\"schema\": \"tandem-run/1\"}",
            "its schema is \"tandem-run/1\"",
        ),
        ("{\"results\": []}", "it has no schema"),
        ("{\"schema\": \"tandem-bench/1\"}", "missing field"),
        (doubled.as_str(), "spin/tandem twice"),
        (negative.as_str(), "no time"),
        (
            other.as_str(),
            "no case in common: the first has spin, the second sleep",
        ),
    ] {
        let error = error_of(&good, bad);
        assert!(error.contains(why), "{why}: {error}");
    }
    let error = files(Path::new("/no/a.json"), Path::new("/no/b.json")).unwrap_err();
    assert!(
        error.to_string().contains("cannot read /no/a.json"),
        "{error}"
    );
}

#[test]
fn a_file_is_read_as_it_was_written() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.json");
    let run = results(vec![row("spin/floor", 75.0), row("spin/tandem", 84.2)]);
    std::fs::write(&path, serde_json::to_string_pretty(&run).unwrap()).unwrap();
    let back = read(&path).unwrap();
    assert_eq!(back.machine, run.machine);
    for (row, written) in back.results.iter().zip(&run.results) {
        assert_eq!((&row.name, row.samples), (&written.name, written.samples));
        assert_eq!(row.batch_p50_ns, written.batch_p50_ns);
    }
}
