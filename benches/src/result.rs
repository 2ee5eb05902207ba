//! Percentiles, ratios to the floor, and the machine that they were measured on.

use crate::cases::Case;
use hdrhistogram::Histogram;
use serde::Serialize;
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
    pub p50_ns: u64,
    /// 90th percentile.
    pub p90_ns: u64,
    /// 99th percentile.
    pub p99_ns: u64,
    /// 99.9th percentile.
    pub p99_9_ns: u64,
    /// Largest.
    pub max_ns: u64,
    /// Number of one-way times.
    pub samples: u64,
    /// Median over the floor's median; `None` if the group's floor was not measured.
    pub ratio_to_floor_p50: Option<f64>,
    /// 99.9th percentile over the floor's.
    pub ratio_to_floor_p99_9: Option<f64>,
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
    /// Size of a message.
    pub payload_bytes: u32,
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
            payload_bytes: 4,
        }
    }
}

impl Measured {
    /// The figures of one case, beside those of its group's floor.
    #[must_use]
    pub fn new(case: &Case, times: &Histogram<u64>, floor: Option<&Histogram<u64>>) -> Self {
        let at = |quantile| times.value_at_quantile(quantile);
        let ratio = |quantile| {
            let floor = floor?.value_at_quantile(quantile);
            (floor > 0).then(|| at(quantile) as f64 / floor as f64)
        };
        Self {
            name: format!("{}/{}", case.group.name(), case.name),
            group: case.group.name(),
            what: case.what,
            p50_ns: at(0.5),
            p90_ns: at(0.9),
            p99_ns: at(0.99),
            p99_9_ns: at(0.999),
            max_ns: times.max(),
            samples: times.len(),
            ratio_to_floor_p50: ratio(0.5),
            ratio_to_floor_p99_9: ratio(0.999),
        }
    }
}

impl Results {
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
        let _ = writeln!(
            text,
            "One way, 4 bytes, in ns; ratios to the floor of the same run."
        );
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
