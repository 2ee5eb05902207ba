//! `tandem bench compare`: what changed between two runs, beyond noise.
//!
//! A case has one median, and one 99th percentile, for each batch of a run; these are the samples
//! of the test, 20 or 200 to a run. A change counts if all of this holds:
//!
//! - the logarithms of the times differ by Welch's test on trimmed means, and so do those of their
//!   ratios to the floor's batch that ran beside each: a machine in another mood changes times, but
//!   hardly ratios. The larger of the two p-values counts, after Holm's correction for the number
//!   of cases;
//! - times and ratios changed in the same direction, each by more than it drifted between the two
//!   halves of either run, and by more than [`SMALLEST_CHANGE`].
//!
//! Floors get no verdict: where a floor changed, the machine did. Peers get one, but it does not
//! count as ours: their code is the same in both runs, and where one changed, it shows how much the
//! luck of a run makes, such as the addresses of its memory.

mod table;

use crate::provider::Provider;
use crate::result::{Results, Row, SCHEMA};
use crate::stats::{self, Interval};
use serde::{Deserialize, Serialize};
use std::collections::HashSet;
use std::io;
use std::path::{Path, PathBuf};
use tandem_page::format::median;

/// First field of the comparison's JSON.
const COMPARE_SCHEMA: &str = "tandem-bench-compare/1";
/// How often pairs of runs without any change may show one.
pub const ALPHA: f64 = 0.05;
/// Of the intervals.
const CONFIDENCE: f64 = 0.95;
/// Less than this is no change that anybody would act on, however sure it is: another address of
/// the same memory makes as much.
pub const SMALLEST_CHANGE: f64 = 0.02;
/// More batches than this are merged by their medians: the result is the same, and a file that
/// claims millions cannot fill the memory.
const MOST_BATCHES: usize = 400;

/// Why two files cannot be compared.
#[derive(Debug, thiserror::Error)]
pub enum CompareError {
    /// A file cannot be read.
    #[error("cannot read {path}")]
    Read {
        /// The file.
        path: PathBuf,
        /// Why.
        source: io::Error,
    },
    /// A file is no result.
    #[error("{path} is no file of `tandem bench --json`: {why}")]
    Foreign {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        why: String,
    },
    /// The files have no case in common.
    #[error("{a} and {b} have no case in common: the first has {in_a}, the second {in_b}")]
    NothingInCommon {
        /// The first file.
        a: PathBuf,
        /// The second file.
        b: PathBuf,
        /// Groups of the first.
        in_a: String,
        /// Groups of the second.
        in_b: String,
    },
}

/// What became of a figure.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Verdict {
    /// It takes less time.
    Faster,
    /// It takes more time.
    Slower,
    /// Nothing that could not be noise.
    NoChange,
}

/// A relative change, B over A minus 1, with its interval. Without an end, the samples are too few
/// to bound it.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Relative {
    /// The change.
    pub change: f64,
    /// Lower end of the 95 % interval.
    pub low: Option<f64>,
    /// Upper end of the 95 % interval.
    pub high: Option<f64>,
}

/// One percentile of one case in both runs.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Change {
    /// In A, ns.
    pub a_ns: f64,
    /// In B, ns.
    pub b_ns: f64,
    /// Of the time; `None` if a file holds no batches of it.
    pub time: Option<Relative>,
    /// Of the ratio to the floor; `None` without a floor in both runs.
    pub ratio: Option<Relative>,
    /// Probability of a difference of this size by chance, after Holm's correction; 1 for a floor.
    pub p: f64,
    /// Larger than this is more than the machine drifted within either run.
    pub drift: f64,
    /// What became of it.
    pub verdict: Verdict,
}

/// One case in both runs.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Compared {
    /// Group and case.
    pub name: String,
    /// The group.
    pub group: String,
    /// Shown for the machine's sake, without a verdict.
    pub is_floor: bool,
    /// Not Tandem's: its verdict does not count.
    pub is_peer: bool,
    /// Median.
    pub p50: Change,
    /// 99th percentile.
    pub p99: Change,
}

impl Compared {
    /// The two percentiles by name.
    #[must_use]
    pub fn changes(&self) -> [(&'static str, &Change); 2] {
        [("p50", &self.p50), ("p99", &self.p99)]
    }

    fn has(&self, verdict: Verdict) -> bool {
        self.changes()
            .iter()
            .any(|(_, change)| change.verdict == verdict)
    }
}

/// Two runs side by side.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Comparison {
    /// `tandem-bench-compare/1`.
    pub schema: &'static str,
    /// The first file.
    pub a: PathBuf,
    /// The second file.
    pub b: PathBuf,
    /// What to know before reading on: machines that differ, runs that were interrupted.
    pub remarks: Vec<String>,
    /// Cases of Tandem that are slower in B.
    pub slower: Vec<String>,
    /// Cases of Tandem that are faster in B.
    pub faster: Vec<String>,
    /// Peers that are slower or faster in B.
    pub peers_changed: Vec<String>,
    /// The cases that both have, in A's order.
    pub cases: Vec<Compared>,
    /// Cases that only A has.
    pub only_in_a: Vec<String>,
    /// Cases that only B has.
    pub only_in_b: Vec<String>,
}

/// Reads a file of `tandem bench --json`.
///
/// # Errors
/// [`CompareError::Read`], [`CompareError::Foreign`]
pub fn read(path: &Path) -> Result<Results, CompareError> {
    /// Enough to know a file as ours.
    #[derive(Deserialize)]
    struct Marked {
        schema: Option<String>,
    }
    let text = std::fs::read(path).map_err(|source| CompareError::Read {
        path: path.to_owned(),
        source,
    })?;
    let foreign = |why: String| CompareError::Foreign {
        path: path.to_owned(),
        why,
    };
    let marked: Marked = serde_json::from_slice(&text).map_err(|e| foreign(e.to_string()))?;
    match marked.schema.as_deref() {
        Some(SCHEMA) => {}
        Some(other) => return Err(foreign(format!("its schema is {other:?}, not {SCHEMA:?}"))),
        None => return Err(foreign("it has no schema".to_owned())),
    }
    let results: Results = serde_json::from_slice(&text).map_err(|e| foreign(e.to_string()))?;
    sound(&results).map_err(foreign)?;
    Ok(results)
}

/// What a test relies on: names that are unique, times that are times.
fn sound(results: &Results) -> Result<(), String> {
    let mut names = HashSet::new();
    for row in &results.results {
        let name = &row.name;
        if !names.insert(name) {
            return Err(format!("it has {name} twice"));
        }
        let percentiles = [row.p50_ns, row.p99_ns];
        let batches = row.batch_p50_ns.iter().chain(&row.batch_p99_ns);
        if !percentiles
            .iter()
            .chain(batches)
            .all(|ns| (0.0..1e15).contains(ns))
        {
            return Err(format!("{name} holds what is no time"));
        }
    }
    Ok(())
}

/// Compares two files.
///
/// # Errors
/// [`CompareError`]
pub fn files(a: &Path, b: &Path) -> Result<Comparison, CompareError> {
    let comparison = compare((a, &read(a)?), (b, &read(b)?));
    if comparison.cases.is_empty() {
        let groups = |names: &[String]| {
            let mut groups: Vec<&str> = names
                .iter()
                .filter_map(|name| name.split('/').next())
                .collect();
            groups.dedup();
            if groups.is_empty() {
                "none".to_owned()
            } else {
                groups.join(", ")
            }
        };
        return Err(CompareError::NothingInCommon {
            a: a.to_owned(),
            b: b.to_owned(),
            in_a: groups(&comparison.only_in_a),
            in_b: groups(&comparison.only_in_b),
        });
    }
    Ok(comparison)
}

/// Compares two runs, each with the file that it comes from.
#[must_use]
pub fn compare((a_path, a): (&Path, &Results), (b_path, b): (&Path, &Results)) -> Comparison {
    let find = |results: &'_ Results, name: &str| -> Option<usize> {
        results.results.iter().position(|row| row.name == name)
    };
    let mut pairs: Vec<[&Row; 2]> = Vec::new();
    for row_a in &a.results {
        if let Some(at) = find(b, &row_a.name) {
            pairs.push([row_a, &b.results[at]]);
        }
    }
    let mut cases = Vec::new();
    for rows in &pairs {
        let floors = [a, b].map(|run| find(run, &floor_of(rows[0])).map(|at| &run.results[at]));
        cases.push(case(*rows, floors));
    }
    judge(&mut cases);
    let mut remarks = remarks(a, b);
    remarks.extend(too_few(&pairs));
    let missing = |from: &Results, all: &Results| {
        let names = all.results.iter().map(|row| row.name.clone());
        names.filter(|name| find(from, name).is_none()).collect()
    };
    let names = |those: &dyn Fn(&Compared) -> bool| {
        let those = cases.iter().filter(|case| those(case));
        those.map(|case| case.name.clone()).collect()
    };
    let (slower, faster) = (Verdict::Slower, Verdict::Faster);
    Comparison {
        schema: COMPARE_SCHEMA,
        a: a_path.to_owned(),
        b: b_path.to_owned(),
        remarks,
        slower: names(&|case| !case.is_peer && case.has(slower)),
        faster: names(&|case| !case.is_peer && case.has(faster)),
        peers_changed: names(&|case| case.is_peer && (case.has(slower) || case.has(faster))),
        only_in_a: missing(b, a),
        only_in_b: missing(a, b),
        cases,
    }
}

fn floor_of(row: &Row) -> String {
    format!("{}/floor", row.group)
}

/// One case, with p-values that are not yet corrected, and no verdict.
fn case(rows: [&Row; 2], floors: [Option<&Row>; 2]) -> Compared {
    let is_floor = rows[0].is_floor();
    let floors = match floors {
        [Some(a), Some(b)] if !is_floor => Some([a, b]),
        _ => None,
    };
    let change = |total: fn(&Row) -> f64, batches: fn(&Row) -> &[f64]| {
        let ratios =
            floors.map(|floors| [0, 1].map(|i| beside(batches(rows[i]), batches(floors[i]))));
        let times = rows.map(|row| logs(batches(row)));
        change(rows.map(total), times, ratios)
    };
    Compared {
        name: rows[0].name.clone(),
        group: rows[0].group.clone(),
        is_floor,
        is_peer: Provider::of(rows[0]).is_peer(),
        p50: change(|row| row.p50_ns, |row| &row.batch_p50_ns),
        p99: change(|row| row.p99_ns, |row| &row.batch_p99_ns),
    }
}

/// Logarithms of the batches: relative changes become shifts. A time of 0 counts as a picosecond.
fn logs(batches: &[f64]) -> Vec<f64> {
    merged(batches.iter().map(|ns| ns.max(1e-3).ln()).collect())
}

/// The same of the ratios to the floor's batch that ran beside each.
fn beside(batches: &[f64], floor: &[f64]) -> Vec<f64> {
    let pairs = batches.iter().zip(floor);
    merged(
        pairs
            .map(|(ns, floor)| (ns.max(1e-3) / floor.max(1e-3)).ln())
            .collect(),
    )
}

fn merged(values: Vec<f64>) -> Vec<f64> {
    if values.len() <= MOST_BATCHES {
        return values;
    }
    let parts = values.chunks(values.len().div_ceil(MOST_BATCHES));
    parts.filter_map(median).collect()
}

/// Whether the second run lies apart from the first, and by how much; `None` if one of them holds
/// too few batches for that.
fn tested([a, b]: &[Vec<f64>; 2]) -> (f64, Option<Relative>) {
    match stats::difference(a, b, CONFIDENCE) {
        Some((p, shift)) => (p, relative(shift)),
        None => (1.0, None),
    }
}

fn change(total_ns: [f64; 2], times: [Vec<f64>; 2], ratios: Option<[Vec<f64>; 2]>) -> Change {
    let (p, time) = tested(&times);
    let of_ratio = ratios.as_ref().map(tested);
    let tested: Vec<&[Vec<f64>; 2]> = std::iter::once(&times).chain(&ratios).collect();
    let drift = tested
        .iter()
        .flat_map(|runs| runs.iter().map(|run| drift(run)));
    Change {
        a_ns: total_ns[0],
        b_ns: total_ns[1],
        time,
        ratio: of_ratio.and_then(|(_, ratio)| ratio),
        p: of_ratio.map_or(p, |(of_ratio, _)| p.max(of_ratio)),
        drift: drift.fold(0.0, f64::max),
        verdict: Verdict::NoChange,
    }
}

/// By how much the logarithms of a run moved from its first half to its second, as a relative
/// change. 0 if there are too few to tell.
fn drift(run: &[f64]) -> f64 {
    let (first, second) = run.split_at(run.len() / 2);
    match (median(first), median(second)) {
        (Some(first), Some(second)) => (second - first).abs().exp_m1(),
        _ => 0.0,
    }
}

/// A shift of logarithms as a relative change; `None` if it is none.
fn relative(shift: Interval) -> Option<Relative> {
    let bounded = |end: f64| end.is_finite().then(|| end.exp_m1());
    Some(Relative {
        change: bounded(shift.middle)?,
        low: bounded(shift.low),
        high: bounded(shift.high),
    })
}

/// Corrects the p-values for their number, and says what each change is. Medians and 99th
/// percentiles are a family each, and so are Tandem's cases and the peers: the noise of the ones
/// shall not hide what the others show.
fn judge(cases: &mut [Compared]) {
    let percentiles: [fn(&mut Compared) -> &mut Change; 2] =
        [|case| &mut case.p50, |case| &mut case.p99];
    for of in percentiles {
        for peers in [false, true] {
            let family = cases.iter_mut();
            let family = family.filter(|case| !case.is_floor && case.is_peer == peers);
            let mut changes: Vec<&mut Change> = family.map(of).collect();
            let p: Vec<f64> = changes.iter().map(|change| change.p).collect();
            for (change, p) in changes.iter_mut().zip(stats::holm(&p)) {
                change.p = p;
                change.verdict = verdict(change);
            }
        }
        for floor in cases.iter_mut().filter(|case| case.is_floor) {
            of(floor).p = 1.0;
        }
    }
}

fn verdict(change: &Change) -> Verdict {
    let Some(time) = change.time else {
        return Verdict::NoChange;
    };
    let sizes = [Some(time), change.ratio].into_iter().flatten();
    let sizes: Vec<f64> = sizes.map(|relative| relative.change).collect();
    let least = change.drift.max(SMALLEST_CHANGE);
    // As a factor, so that twice as fast and twice as slow are equally large.
    let beyond = |size: &f64| size.ln_1p().abs() > least.ln_1p();
    if change.p > ALPHA || !sizes.iter().all(beyond) {
        Verdict::NoChange
    } else if sizes.iter().all(|size| *size > 0.0) {
        Verdict::Slower
    } else if sizes.iter().all(|size| *size < 0.0) {
        Verdict::Faster
    } else {
        Verdict::NoChange
    }
}

/// Says so if there are cases with a single batch, which shows nothing of its noise.
fn too_few(pairs: &[[&Row; 2]]) -> Option<String> {
    let few = |row: &&Row| row.batch_p50_ns.len() < 2;
    let count = pairs.iter().filter(|rows| rows.iter().any(few)).count();
    (count > 0).then(|| {
        format!(
            "{count} of {} cases have a single batch, which proves no change of any size: measure \
             longer, or fewer groups at a time",
            pairs.len()
        )
    })
}

fn remarks(a: &Results, b: &Results) -> Vec<String> {
    let mut remarks = Vec::new();
    for ((what, in_a), (_, in_b)) in a.machine.facts().into_iter().zip(b.machine.facts()) {
        if in_a != in_b {
            remarks.push(format!("{what}: {in_a} in A, {in_b} in B"));
        }
    }
    for (run, name) in [(a, "A"), (b, "B")] {
        if run.interrupted {
            remarks.push(format!(
                "{name} was interrupted: fewer batches than planned"
            ));
        }
    }
    remarks
}

#[cfg(test)]
mod tests;
