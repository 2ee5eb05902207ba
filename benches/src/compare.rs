//! `tandem bench compare --against OLD`: what changed between two builds, beyond noise.
//!
//! Both programs measure in pairs of short runs, in alternating order. Each run has new processes
//! with memory at other addresses, so the random effects of a run are part of the noise in the
//! test. A pair gives one number: the logarithm of new over old. It compares the ratio to the floor
//! of the same run if the case has a floor, else the time.
//!
//! If nothing changed, each number is equally likely to be positive or negative. So p is the share
//! of all combinations of signs for which the mean is at least as far from 0 as the measured one
//! (R. A. Fisher, "The Design of Experiments", 1935, section 21). The test is exact and assumes no
//! distribution. A change counts if p is at most [`ALPHA`] after Holm's correction for the number
//! of cases ("A simple sequentially rejective multiple test procedure", 1979), and if it is larger
//! than [`SMALLEST_CHANGE`].

use crate::columns;
use crate::provider::Provider;
use crate::result::{Results, Row, SCHEMA, floor_of};
use anyhow::{Context as _, ensure};
use serde::Serialize;
use std::fmt::Write as _;
use std::io::{BufReader, Seek as _};
use std::path::Path;
use std::process::{Command, Stdio};
use tandem_page::format::{TimeUnit, median};

/// First field of the comparison's JSON.
const COMPARE_SCHEMA: &str = "tandem-bench-compare/2";
/// Permitted share of comparisons of equal builds that show a change.
pub(crate) const ALPHA: f64 = 0.05;
/// A smaller change is not worth acting on, even if it is significant.
pub(crate) const SMALLEST_CHANGE: f64 = 0.02;

/// How a figure has changed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub(crate) enum Trend {
    Faster,
    Slower,
    /// Any difference could be noise.
    NoChange,
}

/// One percentile of one case in both builds.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(crate) struct Change {
    /// Median of the old build's runs, ns.
    pub(crate) old_ns: f64,
    /// Median of the new build's runs, ns.
    pub(crate) new_ns: f64,
    /// New over old minus 1: of the ratio to the floor, or of the time where there is no floor.
    pub(crate) change: f64,
    /// Probability of a difference this large by chance, after Holm's correction; 1 for a floor.
    pub(crate) p: f64,
    pub(crate) verdict: Trend,
}

/// One case in both builds.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(crate) struct Compared {
    pub(crate) name: String,
    /// Shows the state of the machine; its change is not judged.
    pub(crate) is_floor: bool,
    /// A peer, not Tandem: its change does not count.
    pub(crate) is_peer: bool,
    pub(crate) p50: Change,
    pub(crate) p99: Change,
    /// The 99th percentile of a run has too few samples.
    #[serde(skip)]
    p99_is_chance: bool,
}

/// Two builds side by side.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(crate) struct Comparison {
    pub(crate) schema: &'static str,
    pub(crate) pairs: usize,
    /// Cases of Tandem that are slower in the new build.
    pub(crate) slower: Vec<String>,
    /// Cases of Tandem that are faster in the new build.
    pub(crate) faster: Vec<String>,
    /// Peers that are slower or faster although their code has not changed.
    pub(crate) peers_changed: Vec<String>,
    /// The cases that were measured in all runs.
    pub(crate) cases: Vec<Compared>,
}

/// Runs `program bench` with these arguments and returns its figures.
pub(crate) fn figures_of(program: &Path, args: &[String]) -> anyhow::Result<Results> {
    let name = program.display();
    let foreign = || format!("{name} is no `tandem` that can be compared");
    // The file has no name, so the kernel deletes it however this process ends.
    let mut file = tempfile::tempfile()?;
    let mut command = Command::new(program);
    command.args(["bench", "--json=/dev/stdin"]).args(args);
    let command = command.stdin(file.try_clone()?).stdout(Stdio::null());
    let output = command.output();
    let output = output.with_context(|| format!("cannot run {name}"))?;
    let said = String::from_utf8_lossy(&output.stderr);
    let success = output.status.success();
    ensure!(success, "`{name} bench` failed: {}", said.trim());
    file.rewind()?;
    let results: Results = serde_json::from_reader(BufReader::new(file)).with_context(foreign)?;
    let (schema, foreign) = (&results.schema, foreign());
    ensure!(
        schema == SCHEMA,
        "{foreign}: its schema is {schema:?}, not {SCHEMA:?}"
    );
    Ok(results)
}

/// Compares pairs of runs. The old build's run is the first of each pair.
///
/// # Errors
/// If no case is in all runs: then nothing can be compared.
pub(crate) fn compare(pairs: &[[Results; 2]]) -> anyhow::Result<Comparison> {
    let first = pairs.first().map_or(&[][..], |pair| &pair[0].results[..]);
    let mut cases: Vec<Compared> = first.iter().filter_map(|row| case(row, pairs)).collect();
    ensure!(
        !cases.is_empty(),
        "no case was measured in all runs: the machine was too busy, or the builds share none"
    );
    judge(&mut cases);
    let names = |are_peers, verdicts: &[Trend]| {
        let has = |case: &&Compared| {
            let found = [case.p50.verdict, case.p99.verdict];
            case.is_peer == are_peers && found.iter().any(|of| verdicts.contains(of))
        };
        let those = cases.iter().filter(has);
        those.map(|case| case.name.clone()).collect()
    };
    Ok(Comparison {
        schema: COMPARE_SCHEMA,
        pairs: pairs.len(),
        slower: names(false, &[Trend::Slower]),
        faster: names(false, &[Trend::Faster]),
        peers_changed: names(true, &[Trend::Slower, Trend::Faster]),
        cases,
    })
}

/// Returns one case with uncorrected p-values and no trend; `None` if a run lacks the case.
fn case(row: &Row, pairs: &[[Results; 2]]) -> Option<Compared> {
    let is_floor = Provider::of(row) == Provider::Floor;
    let floor = floor_of(&pairs[0][0].results, &row.name, |row| row.name.clone());
    let floor = floor.map_or("", |floor| &floor.name);
    let find = |run: &Results, name: &str, of: fn(&Row) -> f64| {
        let row = run.results.iter().find(|row| row.name == name)?;
        // A time of 0 counts as a picosecond.
        Some(of(row).max(1e-3))
    };
    let change = |of: fn(&Row) -> f64| {
        let (mut times, mut differences) = ([vec![], vec![]], vec![]);
        for [old, new] in pairs {
            let [before, after] = [find(old, &row.name, of)?, find(new, &row.name, of)?];
            let machine = match (find(old, floor, of), find(new, floor, of)) {
                (Some(old), Some(new)) if !is_floor => new / old,
                _ => 1.0,
            };
            times[0].push(before);
            times[1].push(after);
            differences.push((after / before / machine).ln());
        }
        let [old_ns, new_ns] = times.map(|of| median(&of).unwrap_or(0.0));
        Some(Change {
            old_ns,
            new_ns,
            change: median(&differences).unwrap_or(0.0).exp_m1(),
            p: chance(&differences),
            verdict: Trend::NoChange,
        })
    };
    Some(Compared {
        name: row.name.clone(),
        is_floor,
        is_peer: Provider::of(row).is_peer(),
        p50: change(|row| row.p50_ns)?,
        p99: change(|row| row.p99_ns)?,
        p99_is_chance: columns::is_chance(0.01, row),
    })
}

/// Returns the share of all combinations of signs whose mean is at least as far from 0 as the mean
/// of `differences` (16 at most).
fn chance(differences: &[f64]) -> f64 {
    let choices = 1_u32 << differences.len();
    let mean_of = |signs: u32| {
        let signed = differences.iter().enumerate();
        let signed = signed.map(|(at, of)| if signs & 1 << at == 0 { *of } else { -*of });
        signed.sum::<f64>().abs()
    };
    // Sums of the same numbers in the same order: equal means may still differ by rounding.
    let measured = mean_of(0) * (1.0 - 1e-12);
    let as_far = (0..choices).filter(|signs| mean_of(*signs) >= measured);
    as_far.count() as f64 / f64::from(choices)
}

/// Corrects the p-values for their number and sets each trend. Medians and 99th percentiles are
/// separate families, and so are Tandem's cases and the peers.
fn judge(cases: &mut [Compared]) {
    let percentiles: [fn(&mut Compared) -> &mut Change; 2] =
        [|case| &mut case.p50, |case| &mut case.p99];
    for of in percentiles {
        for floor in cases.iter_mut().filter(|case| case.is_floor) {
            of(floor).p = 1.0;
        }
        for peers in [false, true] {
            let family = cases.iter_mut();
            let family = family.filter(|case| !case.is_floor && case.is_peer == peers);
            let mut family: Vec<&mut Change> = family.map(of).collect();
            family.sort_unstable_by(|a, b| a.p.total_cmp(&b.p));
            let (count, mut largest) = (family.len(), 0.0_f64);
            for (smaller, change) in family.into_iter().enumerate() {
                largest = largest.max(change.p * (count - smaller) as f64).min(1.0);
                change.p = largest;
                let is_real = change.p <= ALPHA;
                change.verdict = match change.change.ln_1p() {
                    by if is_real && by > SMALLEST_CHANGE.ln_1p() => Trend::Slower,
                    by if is_real && by < -SMALLEST_CHANGE.ln_1p() => Trend::Faster,
                    _ => Trend::NoChange,
                };
            }
        }
    }
}

impl Comparison {
    /// Returns the table for the terminal, 100 columns wide, and its summary.
    pub(crate) fn table(&self) -> String {
        let group = |case: &Compared| case.name.split('/').next().unwrap_or("").to_owned();
        let mut text = String::new();
        for cases in self.cases.chunk_by(|a, b| group(a) == group(b)) {
            let times: Vec<f64> = cases.iter().map(|case| case.p50.old_ns).collect();
            let unit = TimeUnit::of(&times);
            let head = format!("{} ({})", group(&cases[0]), unit.name());
            // Writing to a string cannot fail.
            let _ = writeln!(
                text,
                "{head:<34} {:>8} {:>8} {:>9} {:>7}  verdict",
                "old", "new", "change", "p"
            );
            for case in cases {
                let name = case.name.split_once('/').map_or("", |(_, name)| name);
                for (name, percentile, of, is_chance) in [
                    (name, "p50", &case.p50, false),
                    ("", "p99", &case.p99, case.p99_is_chance),
                ] {
                    let verdict = match of.verdict {
                        _ if case.is_floor => "(the machine)",
                        Trend::Faster => "FASTER",
                        Trend::Slower => "SLOWER",
                        Trend::NoChange => "no change",
                    };
                    let show = |ns| columns::bracketed(unit.show(ns), is_chance);
                    let (old, new) = (show(of.old_ns), show(of.new_ns));
                    let _ = writeln!(
                        text,
                        "  {name:<27} {percentile:>4} {old:>8} {new:>8} {:>9} {:>7.3}  {verdict}",
                        percent(of.change),
                        of.p,
                    );
                }
            }
            text.push('\n');
        }
        let by_chance = "changed by chance: their code is the same";
        for (names, word) in [
            (&self.slower, "slower"),
            (&self.faster, "faster"),
            (&self.peers_changed, by_chance),
        ] {
            if !names.is_empty() {
                let _ = writeln!(text, "{word}: {}", names.join(", "));
            }
        }
        let _ = writeln!(
            text,
            "(in brackets): fewer than ten samples of a run lie beyond it.\n{} pairs of runs. A change \
             is that of the ratio to the floor. It counts if p <= {ALPHA}\nafter Holm's correction \
             and if it exceeds {:.0} %.",
            self.pairs,
            SMALLEST_CHANGE * 100.0
        );
        text
    }
}

/// Returns a relative change with its sign: `+10.2 %`.
fn percent(change: f64) -> String {
    let percent = change * 100.0;
    let decimals = usize::from(percent.abs() < 99.95);
    // No "-0.0".
    let percent = if percent.abs() < 0.05 { 0.0 } else { percent };
    format!("{percent:+.decimals$} %")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::synthetic::{results, row};
    use chacha20::ChaCha8Rng;
    use chacha20::rand_core::SeedableRng as _;
    use rand_distr::{Distribution as _, Normal};

    #[test]
    fn a_comparison_without_a_case_is_an_error() {
        let run = |name: &str| results(vec![row(name, 100.0)]);
        let common = [[run("spin/floor"), run("spin/floor")]];
        assert!(compare(&common).is_ok());
        // Each case is missing from one of the runs.
        let none = [[run("spin/floor"), run("spin/tandem")]];
        let error = compare(&none).unwrap_err();
        assert!(error.to_string().contains("in all runs"), "{error}");
    }

    /// Compares with values computed by hand.
    #[test]
    fn chance_is_that_of_the_definition() {
        // Of eight combinations of signs only +++ and --- have a mean as far from 0.
        assert_eq!(chance(&[1.0, 2.0, 4.0]), 0.25);
        // |-1 + 2 + 4| = 5 is reached by +++, -++ and their opposites.
        assert_eq!(chance(&[-1.0, 2.0, 4.0]), 0.5);
        assert_eq!(chance(&[0.0; 4]), 1.0);
    }

    const CASES: [&str; 4] = ["floor", "tandem", "tandem-channel", "pipe"];

    /// Pairs of runs on a machine like ours. Each run is fast or slow as a whole, and each case of
    /// a run has its own effect, which all of its batches share.
    fn pairs(random: &mut ChaCha8Rng, count: usize, factor: f64) -> Vec<[Results; 2]> {
        let mood = Normal::new(0.0, 0.3).unwrap();
        let effect = Normal::new(0.0, 0.04).unwrap();
        let mut run = |factor: f64| {
            let mood: f64 = mood.sample(random);
            let time = |name: &str| {
                let ours = if name.contains("tandem") { factor } else { 1.0 };
                let ns = 150.0 * ours * (mood + effect.sample(random)).exp();
                row(&format!("spin/{name}"), ns)
            };
            results(CASES.map(time).to_vec())
        };
        (0..count).map(|_| [run(1.0), run(factor)]).collect()
    }

    /// The error rate holds although each run has an effect that its batches share.
    #[test]
    fn equal_builds_differ_as_rarely_as_promised() {
        let mut random = ChaCha8Rng::seed_from_u64(7);
        let comparisons = 400;
        let errors = (0..comparisons).filter(|_| {
            let found = compare(&pairs(&mut random, 8, 1.0)).unwrap();
            // Medians and 99th percentiles are the same here: one family.
            !found.slower.is_empty() || !found.faster.is_empty()
        });
        // 20 are expected; 3.5 standard deviations of the binomial distribution are 15.
        let errors = errors.count();
        assert!(errors <= 35, "{errors} of {comparisons}");
    }

    #[test]
    fn a_tenth_more_is_found_and_what_is_not_ours_does_not_count() {
        let mut random = ChaCha8Rng::seed_from_u64(8);
        let found = compare(&pairs(&mut random, 12, 1.1)).unwrap();
        assert_eq!(found.slower, ["spin/tandem", "spin/tandem-channel"]);
        assert!(found.faster.is_empty() && found.peers_changed.is_empty());
        assert!((0.03..0.2).contains(&found.cases[1].p50.change));
        let floor = &found.cases[0];
        assert!(floor.is_floor && floor.p50.p == 1.0 && floor.p50.verdict == Trend::NoChange);
        let table = found.table();
        assert!(table.contains("SLOWER") && table.contains("slower: spin/tandem, "));
        let faster = compare(&pairs(&mut random, 12, 0.8)).unwrap();
        assert_eq!(faster.faster, ["spin/tandem", "spin/tandem-channel"]);
    }

    #[test]
    fn a_sure_change_of_a_hundredth_is_no_change() {
        let run = |ns| results(vec![row("lock/free", ns)]);
        let found = compare(&vec![[run(100.0), run(101.0)]; 10]).unwrap();
        assert!(found.cases[0].p50.p < 0.01);
        assert!(found.slower.is_empty() && !found.table().contains("(100"));
        let mut few = run(100.0);
        few.results[0].samples = 500;
        let table = compare(&[[few, run(100.0)]]).unwrap().table();
        assert_eq!(table.matches("(185)").count(), 2, "{table}");
    }

    /// The tick has its own floor: if both take twice as long, the machine is slower, not Tandem.
    #[test]
    fn a_case_is_compared_beside_the_floor_of_its_own() {
        let run = |ns| results(vec![row("rtos/tick-floor", ns), row("rtos/tick", ns)]);
        let found = compare(&vec![[run(100.0), run(200.0)]; 10]).unwrap();
        assert!(found.slower.is_empty(), "{:?}", found.cases);
    }

    #[test]
    fn changes_are_written_with_their_sign() {
        let shown = [0.1023, -0.05, -0.0001, 2.5].map(percent);
        assert_eq!(shown, ["+10.2 %", "-5.0 %", "+0.0 %", "+250 %"]);
    }
}
