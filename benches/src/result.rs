//! Percentiles, ratios to the floor, and the machine that they were measured on.

use crate::measure::{BatchSummary, Measurement};
use serde::Serialize;
use std::collections::BTreeMap;
use std::fs;

/// One measured case. Times in nanoseconds.
#[derive(Clone, Debug, Serialize)]
pub struct Measured {
    /// Group and case, as `spin/tandem`.
    pub name: String,
    /// The group.
    pub group: &'static str,
    /// What it is.
    pub what: &'static str,
    /// Median.
    pub p50_ns: f64,
    /// 90th percentile.
    pub p90_ns: f64,
    /// 99th percentile.
    pub p99_ns: f64,
    /// 99.9th percentile.
    pub p99_9_ns: f64,
    /// Largest.
    pub max_ns: f64,
    /// Number of samples.
    pub samples: u64,
    /// Median over the floor's median; `None` if the group's floor was not measured.
    pub ratio_to_floor_p50: Option<f64>,
    /// 99.9th percentile over the floor's.
    pub ratio_to_floor_p99_9: Option<f64>,
    /// Bytes of payload per message.
    pub payload_bytes: u64,
    /// CPU time per message, all ends.
    pub cpu_ns_per_message: Option<f64>,
    /// Memory that the ends used.
    pub memory_bytes: Option<u64>,
    /// Median of each batch, in order.
    pub batch_p50_ns: Vec<f64>,
    /// 99th percentile of each batch.
    pub batch_p99_ns: Vec<f64>,
    /// Further facts by name.
    pub facts: BTreeMap<&'static str, f64>,
}

/// What was measured on.
#[derive(Clone, Debug, Serialize)]
pub struct Machine {
    /// Processor, as it names itself.
    pub cpu: String,
    /// Version of the kernel.
    pub kernel: String,
    /// CPUs that the two ends were pinned to.
    pub pinned_to: [usize; 2],
    /// `release` or `debug`.
    pub build: &'static str,
}

/// A whole run.
#[derive(Clone, Debug, Serialize)]
pub struct Results {
    /// Where.
    pub machine: Machine,
    /// Ended by Ctrl-C: the figures rest on fewer samples than planned.
    pub interrupted: bool,
    /// What was measured, in the order of the cases.
    pub results: Vec<Measured>,
    /// Cases that could not be measured, and why.
    pub skipped: Vec<String>,
}

impl Machine {
    /// This machine.
    #[must_use]
    pub fn this(pinned_to: [usize; 2]) -> Self {
        let read = |path| fs::read_to_string(path).unwrap_or_default();
        let cpu = read("/proc/cpuinfo");
        let cpu = cpu
            .lines()
            .find_map(|line| line.strip_prefix("model name")?.split(": ").nth(1));
        Self {
            cpu: cpu.unwrap_or("unknown").to_owned(),
            kernel: read("/proc/sys/kernel/osrelease").trim().to_owned(),
            pinned_to,
            build: if cfg!(debug_assertions) {
                "debug"
            } else {
                "release"
            },
        }
    }
}

/// Picoseconds as nanoseconds, to a tenth.
fn ns(ps: u64) -> f64 {
    (ps as f64 / 100.0).round() / 10.0
}

impl Measured {
    /// The figures of one case, beside those of its group's floor.
    #[must_use]
    pub fn new(measurement: &Measurement, floor: Option<&Measurement>) -> Self {
        let (case, times) = (measurement.case, &measurement.times);
        let at = |quantile| ns(times.value_at_quantile(quantile));
        let ratio = |quantile| {
            let floor = floor?.times.value_at_quantile(quantile);
            (floor > 0).then(|| times.value_at_quantile(quantile) as f64 / floor as f64)
        };
        let batches = &measurement.batches;
        let middle =
            |of: fn(&BatchSummary) -> Option<f64>| median(batches.iter().filter_map(of).collect());
        let mut facts = BTreeMap::<_, Vec<f64>>::new();
        for (name, value) in batches.iter().flat_map(|batch| &batch.facts) {
            facts.entry(*name).or_default().push(*value);
        }
        let facts = facts.into_iter().filter_map(|(name, values)| {
            let value = if name.starts_with("longest") {
                values.into_iter().reduce(f64::max)
            } else {
                median(values)
            };
            Some((name, value?))
        });
        Self {
            name: case.full_name(),
            group: case.group.name(),
            what: case.what,
            p50_ns: at(0.5),
            p90_ns: at(0.9),
            p99_ns: at(0.99),
            p99_9_ns: at(0.999),
            max_ns: ns(times.max()),
            samples: times.len(),
            ratio_to_floor_p50: ratio(0.5),
            ratio_to_floor_p99_9: ratio(0.999),
            payload_bytes: batches.first().map_or(0, |batch| batch.payload_bytes),
            cpu_ns_per_message: middle(|batch| batch.cpu_ns_per_message),
            memory_bytes: middle(|batch| batch.memory_bytes.map(|bytes| bytes as f64))
                .map(|bytes| bytes as u64),
            batch_p50_ns: batches.iter().map(|batch| ns(batch.p50_ps)).collect(),
            batch_p99_ns: batches.iter().map(|batch| ns(batch.p99_ps)).collect(),
            facts: facts.collect(),
        }
    }
}

fn median(mut values: Vec<f64>) -> Option<f64> {
    values.sort_unstable_by(f64::total_cmp);
    values.get(values.len() / 2).copied()
}

impl Results {
    /// The rows of all cases that were measured.
    #[must_use]
    pub fn new(all: &[Measurement], cpus: [usize; 2], interrupted: bool) -> Self {
        let floor = |of: &Measurement| {
            let is_floor =
                |one: &&Measurement| one.case.group == of.case.group && one.case.is_floor();
            all.iter().find(is_floor)
        };
        let measured = all.iter().filter(|one| !one.times.is_empty());
        let skipped = all.iter().filter_map(|one| {
            let why = one.skipped.as_ref()?;
            Some(format!("{}: {why}", one.case.full_name()))
        });
        Self {
            machine: Machine::this(cpus),
            interrupted,
            results: measured.map(|one| Measured::new(one, floor(one))).collect(),
            skipped: skipped.collect(),
        }
    }

    /// The table for the terminal.
    #[must_use]
    pub fn table(&self) -> String {
        use std::fmt::Write as _;
        let mut text = String::new();
        let Machine {
            cpu,
            kernel,
            pinned_to: [near, far],
            build,
            ..
        } = &self.machine;
        // Writing to a string cannot fail.
        let _ = writeln!(
            text,
            "{cpu}, Linux {kernel}, CPUs {near} and {far}, {build} build"
        );
        let _ = writeln!(text, "Times in ns; ratios to the floor of the same run.");
        let mut group = "";
        for row in &self.results {
            if row.group != group {
                group = row.group;
                let _ = writeln!(
                    text,
                    "\n{:<22} {:>8} {:>8} {:>8} {:>8} {:>10}  {:>6} {:>6}",
                    group, "p50", "p90", "p99", "p99.9", "max", "x p50", "x p99.9"
                );
            }
            let ratio = |ratio: Option<f64>| ratio.map_or("-".into(), |r| format!("{r:.2}"));
            let name = row.name.split('/').nth(1).unwrap_or_default();
            let _ = writeln!(
                text,
                "  {:<20} {:>8} {:>8} {:>8} {:>8} {:>10}  {:>6} {:>6}   {}",
                name,
                row.p50_ns,
                row.p90_ns,
                row.p99_ns,
                row.p99_9_ns,
                row.max_ns,
                ratio(row.ratio_to_floor_p50),
                ratio(row.ratio_to_floor_p99_9),
                row.what
            );
        }
        for skipped in &self.skipped {
            let _ = writeln!(text, "skipped: {skipped}");
        }
        if self.interrupted {
            let _ = writeln!(text, "interrupted: fewer samples than planned");
        }
        text
    }
}
