//! Adds up the results of several machines or processes, each for a range of numbers.

use std::collections::BTreeMap;
use std::fmt;
use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context as _, Result, bail};
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value, json};
use tandem_page::json::JsonOutput;

use super::coverage::Coverage;
use tandem::failure::Failure;
use tandem::print;

/// A range of numbers that were tried.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Range {
    /// Names of the group, the limits and the durations.
    pub(super) name: String,
    pub(super) from: u64,
    /// The end of the range, exclusive.
    pub(super) to: u64,
    pub(super) step: u64,
}

/// The figures of a campaign.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Totals {
    pub(super) seeds: u64,
    pub(super) violations: u64,
    pub(super) simulated_s: f64,
    pub(super) wall_s: f64,
    /// CPU time on all processors, s.
    pub(super) cpu_s: f64,
    pub(super) digest: u64,
}

impl fmt::Display for Totals {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self {
            seeds,
            violations,
            simulated_s,
            wall_s,
            cpu_s,
            digest,
        } = self;
        write!(
            f,
            "{seeds} sequences, {violations} violated; {simulated_s:.0} s simulated in {wall_s:.1} s: \
             {:.0} times real time; for each second of a processor {:.0} s and {:.0} sequences; \
             digest {digest:016x}",
            simulated_s / wall_s,
            simulated_s / cpu_s,
            *seeds as f64 / cpu_s,
        )
    }
}

impl Totals {
    pub(super) fn json(&self, groups: Map<String, Value>, ranges: &[Range]) -> Value {
        json!({
            "seeds": self.seeds, "violations": self.violations, "simulated_s": self.simulated_s,
            "wall_s": self.wall_s, "ratio": self.simulated_s / self.wall_s, "cpu_s": self.cpu_s,
            "digest": format!("{:016x}", self.digest), "ranges": ranges, "groups": groups,
        })
    }
}

/// The output of another run with `--json`.
#[derive(Deserialize)]
struct Part {
    seeds: u64,
    violations: u64,
    simulated_s: f64,
    wall_s: f64,
    cpu_s: f64,
    digest: String,
    ranges: Vec<Range>,
    groups: Map<String, Value>,
}

/// Adds up the results of these files.
pub(super) fn run(files: &[PathBuf], place: JsonOutput) -> Result<(), Failure> {
    let (totals, groups, ranges) = merged(files).map_err(Failure::Usage)?;
    let mut covered = Coverage::default();
    for group in groups.values() {
        covered.add(&Coverage::of_json(&group["covered"]).unwrap_or_default());
    }
    let text = || format!("{}{totals}\n", covered.text(false));
    print(&place.write(&totals.json(groups, &ranges), text)?)?;
    match totals.violations {
        0 => Ok(()),
        count => Err(Failure::Objections(vec![format!(
            "{count} sequences violate what must be so"
        )])),
    }
}

fn merged(files: &[PathBuf]) -> Result<(Totals, Map<String, Value>, Vec<Range>)> {
    let mut totals = Totals::default();
    let mut groups = Map::new();
    let mut ranges: Vec<(Range, &Path)> = Vec::new();
    for path in files {
        let shown = path.display();
        let text = fs::read_to_string(path).with_context(|| shown.to_string())?;
        let part: Part = serde_json::from_str(&text)
            .with_context(|| format!("{shown}: not what `tandem sim --json` wrote"))?;
        for range in part.ranges {
            let twice = ranges.iter().find(|(other, _)| overlap(other, &range));
            if let Some((other, before)) = twice {
                let (name, before) = (&other.name, before.display());
                bail!("{shown}: some numbers of {name} are in {before} too");
            }
            ranges.push((range, path));
        }
        let digest = u64::from_str_radix(&part.digest, 16).with_context(|| shown.to_string())?;
        totals = Totals {
            seeds: totals.seeds + part.seeds,
            violations: totals.violations + part.violations,
            simulated_s: totals.simulated_s + part.simulated_s,
            // Assume that they ran one after the other: the files do not show what ran in
            // parallel.
            wall_s: totals.wall_s + part.wall_s,
            cpu_s: totals.cpu_s + part.cpu_s,
            digest: totals.digest.wrapping_add(digest),
        };
        for (name, group) in part.groups {
            add(groups.entry(name).or_insert(Value::Null), group);
        }
    }
    let ranges = ranges.into_iter().map(|(range, _)| range).collect();
    Ok((totals, groups, ranges))
}

fn overlap(one: &Range, other: &Range) -> bool {
    one.name == other.name && one.from < other.to && other.from < one.to
}

/// Merges figures into `sum`: adds numbers, keeps maxima, and merges tables by their names.
fn add(sum: &mut Value, part: Value) {
    match (sum, part) {
        (sum @ Value::Null, part) => *sum = part,
        (Value::Object(sum), Value::Object(part)) => {
            let part: BTreeMap<String, Value> = part.into_iter().collect();
            for (name, value) in part {
                let sum = sum.entry(name.clone()).or_insert(Value::Null);
                match (name.as_str(), sum.as_f64(), value.as_f64()) {
                    ("gap_max_ms", Some(most), Some(more)) => *sum = json!(most.max(more)),
                    _ => add(sum, value),
                }
            }
        }
        (Value::Array(sum), Value::Array(part)) => {
            sum.iter_mut()
                .zip(part)
                .for_each(|(sum, part)| add(sum, part));
        }
        (sum, part) => *sum = json!(sum.as_u64().unwrap_or(0) + part.as_u64().unwrap_or(0)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn part(from: u64, to: u64, digest: &str, gap: f64) -> String {
        json!({
            "seeds": to - from, "violations": 0, "simulated_s": 1.5, "wall_s": 2.0, "cpu_s": 1.0,
            "digest": digest, "ranges": [{"name": "random rt ideal", "from": from, "to": to, "step": 1}],
            "groups": {"random": {"sequences": to - from, "gap_max_ms": gap, "violations": {},
                "covered": {"mute": [0, 0, 0, to, 0, 0, 0]}}},
        })
        .to_string()
    }

    #[test]
    fn ranges_are_added_and_none_counts_twice() {
        let folder = tempfile::tempdir().unwrap();
        let write = |name: &str, text: String| {
            let path = folder.path().join(name);
            fs::write(&path, text).unwrap();
            path
        };
        let first = write("a", part(0, 10, "ffffffffffffffff", 19.0));
        let second = write("b", part(10, 30, "0000000000000003", 12.0));
        let (totals, groups, ranges) = merged(&[first.clone(), second]).unwrap();
        assert_eq!((totals.seeds, totals.digest, totals.cpu_s), (30, 2, 2.0));
        assert_eq!(groups["random"]["gap_max_ms"], json!(19.0));
        assert_eq!(groups["random"]["covered"]["mute"][3], json!(40));
        assert_eq!(ranges.len(), 2);
        let again = write("c", part(9, 11, "00", 1.0));
        let refused = merged(&[first, again]).unwrap_err().to_string();
        assert!(refused.contains("random rt ideal"), "{refused}");
    }
}
