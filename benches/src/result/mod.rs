//! The results: percentiles, ratios to the floor, and what `tandem bench compare` tests.
//!
//! Times are collected in picoseconds, so that an operation of 8 ns keeps its decimals, and stored
//! in nanoseconds. `Results` is the JSON file, field by field.

use crate::cases::Comparison::{Size, Throughput};
use crate::hardware::Machine;
use crate::measure::Measurement;
use crate::modes::{self, Mode};
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
    /// The median of all samples; if the run met several states of the line, the median of the
    /// batches in one state, which is the same for all cases of the group: see `modes`.
    pub(crate) p50_ns: f64,
    pub(crate) p90_ns: f64,
    pub(crate) p99_ns: f64,
    pub(crate) p99_9_ns: f64,
    pub(crate) max_ns: f64,
    pub(crate) samples: u64,
    /// Ratio to the same percentile of the floor; `None` without a floor in this group, or if no
    /// batch met the state in which the group is compared.
    pub(crate) ratio_to_floor_p50: Option<f64>,
    /// Nine in ten turns had a ratio between these, and a further run's lies there; `None` if fewer
    /// than ten turns measured case and floor in the state that is compared.
    #[serde(default)]
    pub(crate) ratio_range_p50: Option<[f64; 2]>,
    /// The states of the line in which batches were measured, the fastest first; empty if the run
    /// met one state.
    #[serde(default)]
    pub(crate) modes: Vec<InMode>,
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
    /// Time of a bare line before and after each batch; empty if it was not measured.
    #[serde(default)]
    pub(crate) batch_line_ns: Vec<[f64; 2]>,
    /// Time that the hypervisor took during each batch, all CPUs, ms, in steps of 10.
    #[serde(default)]
    pub(crate) batch_steal_ms: Vec<f64>,
    /// Points (quantile, ns) of the distribution, up to the highest quantile that the samples
    /// support.
    pub(crate) curve: Vec<(f64, f64)>,
    pub(crate) facts: BTreeMap<String, f64>,
}

/// A case in one state of the cache line: see [`modes`].
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct InMode {
    /// Time of a bare line in this state.
    pub(crate) line_ns: f64,
    /// Share of the case's batches. What is missing to 1 met a change of the state.
    pub(crate) share: f64,
    /// Median of the medians of these batches.
    pub(crate) p50_ns: f64,
    /// Ratio to the floor's median in the same state.
    pub(crate) ratio_to_floor_p50: Option<f64>,
    /// `p50_ns` and `ratio_to_floor_p50` of the row are those of this state.
    pub(crate) is_compared: bool,
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
        let lines = all
            .iter()
            .flat_map(|one| one.lines_ps.iter().flatten().flatten());
        let lines: Vec<f64> = lines.map(|ps| *ps as f64).collect();
        let states = States(modes::find(&lines));
        let measured = all.iter().filter(|one| !one.times.is_empty());
        let rows =
            measured.map(|one| Row::new(one, floor(one), &states, states.compared(one, all)));
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

/// The states that a run met.
struct States(Vec<Mode>);

impl States {
    /// Returns the median of each batch of this case in state `number`, ps, by turn.
    fn medians(&self, of: &Measurement, number: usize) -> Vec<Option<f64>> {
        let state = |lines: &Option<[u64; 2]>| {
            modes::of_batch(&self.0, lines.map(|lines| lines.map(|ps| ps as f64))?)
        };
        let turns = of.p50_ps.iter().zip(&of.lines_ps);
        let inside = |(ps, lines): (&u64, _)| (state(lines) == Some(number)).then_some(*ps as f64);
        turns.map(inside).collect()
    }

    /// Returns the median of this case in state `number`, ps.
    fn p50(&self, of: &Measurement, number: usize) -> Option<f64> {
        let medians: Vec<f64> = self.medians(of, number).into_iter().flatten().collect();
        median(&medians)
    }

    /// Returns the state in which the group of `of` is compared: the one that most of its cases
    /// met, and of those the one with most batches. `None` if the run met one state.
    fn compared(&self, of: &Measurement, all: &[Measurement]) -> Option<usize> {
        let group: Vec<_> = all
            .iter()
            .filter(|one| one.case.group == of.case.group)
            .collect();
        let met = |number: &usize| {
            let batches = group.iter().map(|one| self.medians(one, *number));
            let batches = batches.map(|of| of.into_iter().flatten().count());
            batches.fold((0, 0), |(cases, sum), of| {
                (cases + usize::from(of > 0), sum + of)
            })
        };
        let states = 0..self.0.len();
        let most = states.max_by_key(met).filter(|number| met(number).1 > 0);
        most.filter(|_| self.0.len() > 1)
    }

    /// Returns what this case did in each state that it met.
    fn row(
        &self,
        of: &Measurement,
        floor: Option<&Measurement>,
        compared: Option<usize>,
    ) -> Vec<InMode> {
        let states = self.0.iter().enumerate();
        let states = states.filter(|_| self.0.len() > 1);
        let met = states.filter_map(|(number, mode)| {
            let p50 = self.p50(of, number)?;
            let batches = self.medians(of, number).into_iter().flatten().count();
            let floor = floor.and_then(|floor| self.p50(floor, number));
            Some(InMode {
                line_ns: rounded(mode.line_ps / 1e3, 10.0),
                share: rounded(batches as f64 / of.batches.len() as f64, 1e3),
                p50_ns: rounded(p50 / 1e3, 10.0),
                ratio_to_floor_p50: floor.map(|floor| rounded(p50 / floor, 1e4)),
                is_compared: compared == Some(number),
            })
        });
        met.collect()
    }
}

impl Row {
    /// The figures of one case, beside those of its group's floor, in this state of the line.
    fn new(
        of: &Measurement,
        floor: Option<&Measurement>,
        states: &States,
        compared: Option<usize>,
    ) -> Self {
        let met = states.row(of, floor, compared);
        let in_state = met.iter().find(|mode| mode.is_compared);
        // With one state, all batches are in it.
        let turns = |one: &Measurement| match compared {
            Some(number) => states.medians(one, number),
            None => one.p50_ps.iter().map(|ps| Some(*ps as f64)).collect(),
        };
        let range = floor.and_then(|floor| modes::range(&turns(of), &turns(floor)));
        let at = |quantile| of.times.value_at_quantile(quantile);
        let ratio = |quantile| {
            let floor = floor.filter(|floor| !floor.times.is_empty())?;
            let floor = floor.times.value_at_quantile(quantile);
            (floor > 0).then(|| rounded(at(quantile) as f64 / floor as f64, 1e4))
        };
        let group = of.case.group;
        let batches = &of.batches;
        let payload_bytes = batches.last().map_or(0, |batch| batch.payload_bytes);
        let p50_ps = in_state.map_or(at(0.5) as f64, |mode| mode.p50_ns * 1e3);
        let rate = (p50_ps > 0.0).then(|| 1e12 / p50_ps);
        let bytes = rate.filter(|_| matches!(group, Throughput | Size) && payload_bytes > 0);
        let rate = rate.filter(|_| group == Throughput);
        let cpu: Vec<f64> = batches
            .iter()
            .filter_map(|b| b.cpu_ns_per_message)
            .collect();
        let ratio_to_floor_p50 = match compared {
            Some(_) => in_state.and_then(|mode| mode.ratio_to_floor_p50),
            None => ratio(0.5),
        };
        let lines = of.lines_ps.iter().flatten();
        Self {
            name: of.case.full_name(),
            group: group.name(),
            what: of.case.what.to_owned(),
            payload_bytes,
            p50_ns: in_state.map_or(ns(at(0.5)), |mode| mode.p50_ns),
            p90_ns: ns(at(0.9)),
            p99_ns: ns(at(0.99)),
            p99_9_ns: ns(at(0.999)),
            max_ns: ns(of.times.max()),
            samples: of.times.len(),
            ratio_to_floor_p50,
            ratio_range_p50: range.map(|ends| ends.map(|end| rounded(end, 1e4))),
            modes: met,
            ratio_to_floor_p99_9: ratio(0.999),
            round_trip: RoundTrip::new(&of.round_trips),
            cpu_ns_per_message: median(&cpu).map(|cpu| rounded(cpu, 10.0)),
            messages_per_second: rate.map(f64::round),
            bytes_per_second: bytes.map(|rate| (rate * payload_bytes as f64).round()),
            batch_p50_ns: of.p50_ps.iter().map(|ps| ns(*ps)).collect(),
            batch_line_ns: lines.map(|lines| lines.map(ns)).collect(),
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
