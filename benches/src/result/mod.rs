//! The results: percentiles, ratios to the floor, and what `tandem bench compare` tests.
//!
//! Times are collected in picoseconds, so that an operation of 8 ns keeps its decimals, and stored
//! in nanoseconds. `Results` is the JSON file, field by field.

use crate::cases::Comparison::{Size, Throughput};
use crate::hardware::Machine;
use crate::measure::Measurement;
use hdrhistogram::Histogram;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use tandem_page::format::median;

/// First field of the file; its version rises with each incompatible change.
pub(crate) const SCHEMA: &str = "tandem-bench/1";
/// Largest number of points of a percentile curve.
const CURVE_POINTS: usize = 100;
/// A curve ends where fewer samples than this lie beyond it: fewer are not reliable.
const SAMPLES_BEYOND: f64 = 10.0;

/// A whole run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Results {
    pub(crate) schema: String,
    pub(crate) machine: Machine,
    pub(crate) duration_s: f64,
    /// The requested background load, for example `spin:2`.
    #[serde(default)]
    pub(crate) load: Option<String>,
    /// Ended by Ctrl-C: the figures rest on fewer samples than planned.
    pub(crate) interrupted: bool,
    /// The machine's effect on an idle program: the rows of the group `noise`.
    pub(crate) noise: Vec<Row>,
    pub(crate) results: Vec<Row>,
    pub(crate) skipped: Vec<Skipped>,
}

/// A case that could not be measured.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Skipped {
    pub(crate) name: String,
    pub(crate) why: String,
}

/// One measured case. Times in nanoseconds, rounded to a tenth.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct Row {
    /// Group and case, for example `spin/tandem`.
    pub(crate) name: String,
    pub(crate) group: String,
    pub(crate) what: String,
    pub(crate) payload_bytes: u64,
    pub(crate) p50_ns: f64,
    pub(crate) p90_ns: f64,
    pub(crate) p99_ns: f64,
    pub(crate) p99_9_ns: f64,
    pub(crate) max_ns: f64,
    pub(crate) samples: u64,
    /// Ratio to the same percentile of the floor; `None` without a floor in this group.
    pub(crate) ratio_to_floor_p50: Option<f64>,
    pub(crate) ratio_to_floor_p99_9: Option<f64>,
    pub(crate) round_trip: Option<RoundTrip>,
    /// CPU time of all ends per message, where it applies.
    pub(crate) cpu_ns_per_message: Option<f64>,
    /// Messages per second at the median time per message; throughput only.
    pub(crate) messages_per_second: Option<f64>,
    /// Payload per second at the median time per message; throughput and size only.
    pub(crate) bytes_per_second: Option<f64>,
    /// Median of each batch, in the order of measuring.
    pub(crate) batch_p50_ns: Vec<f64>,
    /// Time that the hypervisor took during each batch, all CPUs, ms, in steps of 10.
    #[serde(default)]
    pub(crate) batch_steal_ms: Vec<f64>,
    /// Points (quantile, ns) of the distribution, up to the highest quantile that the samples
    /// support.
    pub(crate) curve: Vec<(f64, f64)>,
    pub(crate) facts: BTreeMap<String, f64>,
}

/// Percentiles of the round trip.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct RoundTrip {
    pub(crate) p50_ns: f64,
    pub(crate) p99_ns: f64,
    pub(crate) p99_9_ns: f64,
}

impl Row {
    /// Returns the name within the group.
    pub(crate) fn case(&self) -> &str {
        let case = self.name.split_once('/').map(|(_, case)| case);
        case.unwrap_or(&self.name)
    }

    /// Returns whether this is the floor, with which the rest of the group is compared.
    pub(crate) fn is_floor(&self) -> bool {
        self.case() == "floor"
    }

    /// Returns whether the floor's 99.9th percentile is more than ten times its median. It then
    /// shows stalls, not the bare mechanism: a few more or fewer stalls can change the ratio at
    /// 99.9 % from 0.3 to 3.
    pub(crate) fn has_stalled_floor(&self) -> bool {
        let ratios = self.ratio_to_floor_p50.zip(self.ratio_to_floor_p99_9);
        ratios.is_some_and(|(p50, p99_9)| self.p99_9_ns / p99_9 > 10.0 * self.p50_ns / p50)
    }
}

impl Results {
    /// The rows of all cases that have samples, each beside its floor.
    pub(crate) fn new(
        all: &[Measurement],
        cpus: &[usize],
        duration_s: f64,
        interrupted: bool,
    ) -> Self {
        let floor =
            |of: &Measurement| floor_of(all, &of.case.full_name(), |one| one.case.full_name());
        let measured = all.iter().filter(|one| !one.times.is_empty());
        let rows = measured.map(|one| Row::new(one, floor(one)));
        let (noise, results) = rows.partition(|row| row.group == "noise");
        let skipped = all.iter().filter_map(|one| {
            Some(Skipped {
                name: one.case.full_name(),
                why: one.skipped.clone()?,
            })
        });
        Self {
            schema: SCHEMA.to_owned(),
            machine: Machine::this(cpus),
            duration_s: rounded(duration_s, 10.0),
            load: None,
            interrupted,
            noise,
            results,
            skipped: skipped.collect(),
        }
    }

    /// Returns the groups in the order of measuring, each with its rows, which are adjacent.
    pub(crate) fn groups(&self) -> impl Iterator<Item = (&str, &[Row])> {
        let groups = self.results.chunk_by(|a, b| a.group == b.group);
        groups.map(|rows| (&rows[0].group[..], rows))
    }
}

impl Row {
    /// The figures of one case, beside those of its group's floor.
    fn new(of: &Measurement, floor: Option<&Measurement>) -> Self {
        let at = |quantile| of.times.value_at_quantile(quantile);
        let ratio = |quantile| {
            let floor = floor.filter(|floor| !floor.times.is_empty())?;
            let floor = floor.times.value_at_quantile(quantile);
            (floor > 0).then(|| rounded(at(quantile) as f64 / floor as f64, 1e4))
        };
        let group = of.case.group;
        let batches = &of.batches;
        let payload_bytes = batches.last().map_or(0, |batch| batch.payload_bytes);
        let rate = (at(0.5) > 0).then(|| 1e12 / at(0.5) as f64);
        let bytes = rate.filter(|_| matches!(group, Throughput | Size) && payload_bytes > 0);
        let rate = rate.filter(|_| group == Throughput);
        let cpu: Vec<f64> = batches
            .iter()
            .filter_map(|b| b.cpu_ns_per_message)
            .collect();
        Self {
            name: of.case.full_name(),
            group: group.name(),
            what: of.case.what.to_owned(),
            payload_bytes,
            p50_ns: ns(at(0.5)),
            p90_ns: ns(at(0.9)),
            p99_ns: ns(at(0.99)),
            p99_9_ns: ns(at(0.999)),
            max_ns: ns(of.times.max()),
            samples: of.times.len(),
            ratio_to_floor_p50: ratio(0.5),
            ratio_to_floor_p99_9: ratio(0.999),
            round_trip: RoundTrip::new(&of.round_trips),
            cpu_ns_per_message: median(&cpu).map(|cpu| rounded(cpu, 10.0)),
            messages_per_second: rate.map(f64::round),
            bytes_per_second: bytes.map(|rate| (rate * payload_bytes as f64).round()),
            batch_p50_ns: of.p50_ps.iter().map(|ps| ns(*ps)).collect(),
            batch_steal_ms: of.steal_ms.clone(),
            curve: curve(&of.times),
            facts: facts(of),
        }
    }
}

impl RoundTrip {
    /// Returns the percentiles; `None` if there are no samples.
    fn new(times_ps: &Histogram<u64>) -> Option<Self> {
        let at = |quantile| ns(times_ps.value_at_quantile(quantile));
        (!times_ps.is_empty()).then(|| Self {
            p50_ns: at(0.5),
            p99_ns: at(0.99),
            p99_9_ns: at(0.999),
        })
    }
}

/// Returns one value per fact: the median of the batches, or the maximum of a `longest` fact.
fn facts(of: &Measurement) -> BTreeMap<String, f64> {
    let mut all = BTreeMap::<&str, Vec<f64>>::new();
    for (name, value) in of.batches.iter().flat_map(|batch| &batch.facts) {
        all.entry(name).or_default().push(*value);
    }
    let one = |(name, values): (&str, Vec<f64>)| {
        let value = if name.starts_with("longest") {
            values.into_iter().reduce(f64::max)
        } else {
            median(&values)
        };
        Some((name.to_owned(), rounded(value?, 1e4)))
    };
    let mut facts: BTreeMap<_, _> = all.into_iter().filter_map(one).collect();
    if !of.naive.is_empty() {
        let naive = [("p50", 0.5), ("p99", 0.99), ("p99.9", 0.999)];
        facts.extend(naive.map(|(name, quantile)| {
            let name = format!("naive {name}, ns");
            (name, ns(of.naive.value_at_quantile(quantile)))
        }));
        facts.insert("longest naive, ns".to_owned(), ns(of.naive.max()));
    }
    facts
}

fn curve(times_ps: &Histogram<u64>) -> Vec<(f64, f64)> {
    let samples = times_ps.len() as f64;
    // In powers of ten of 1 / (1 - q): 0 is the smallest, 1 is 90 %, 2 is 99 %.
    let end = (samples / SAMPLES_BEYOND).log10();
    if end <= 0.0 {
        return Vec::new();
    }
    let points = (0..CURVE_POINTS).map(|i| {
        let nines = end * i as f64 / (CURVE_POINTS - 1) as f64;
        let quantile = rounded(1.0 - 10.0_f64.powf(-nines), 1e9);
        (quantile, ns(times_ps.value_at_quantile(quantile)))
    });
    points.collect()
}

/// Returns the floor of the case with this name: `floor` of its group, or its own floor, such as
/// `tick-floor` for `tick` and its peers.
pub(crate) fn floor_of<'a, T>(
    all: &'a [T],
    name: &str,
    name_of: fn(&T) -> String,
) -> Option<&'a T> {
    let (group, case) = name.split_once('/')?;
    let is_floor = |of: &&T| {
        let name = name_of(of);
        let what = name
            .strip_prefix(group)
            .and_then(|rest| rest.strip_suffix("floor"));
        let what = what.and_then(|what| what.strip_prefix('/'));
        // All topics are compared with the bare socket.
        let is_of = |what: &str| group == "topics" || case.contains(what.trim_end_matches('-'));
        what.is_some_and(is_of)
    };
    // Prefer a case's own floor, whose name is longer.
    all.iter()
        .filter(is_floor)
        .max_by_key(|of| name_of(of).len())
}

/// Picoseconds in nanoseconds, rounded to a tenth.
fn ns(ps: u64) -> f64 {
    rounded(ps as f64 / 1e3, 10.0)
}

fn rounded(value: f64, steps: f64) -> f64 {
    (value * steps).round() / steps
}

#[cfg(test)]
mod tests;
