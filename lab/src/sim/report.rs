//! The result of a campaign, as text and as figures.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write as _;

use anyhow::Result;
use serde::Serialize;
use serde_json::json;
use tandem_faults::{Group, PHASES, Sequence, known};
use tandem_record::verdict::Rule;
use tandem_sim::Profile;

use super::coverage::Coverage;
use super::outcome::Outcome;
use super::{SimArgs, Source};

/// The most violation classes to print, and the most sequences to shrink for them.
const CLASSES: usize = 12;
const SHRUNK: usize = 40;

/// The figures of a campaign.
#[derive(Default)]
pub(super) struct Summary {
    pub(super) sequences: u64,
    /// Number of sequences with a violation that is not one of the known ones.
    pub(super) violated: u64,
    pub(super) simulated_ns: u64,
    /// Number of sequences that end with a suspended system.
    suspended: u64,
    gap_ns: u64,
    violations: BTreeMap<String, usize>,
    /// Number of known violations, by their reason.
    known: BTreeMap<String, u64>,
    /// Sum of the digests of all sequences, independent of their order.
    pub(super) digest: u64,
    pub(super) covered: Coverage,
    /// What each wrong signal led to.
    signals: BTreeMap<String, OfSignal>,
}

/// What the faults of one signal or frame led to.
#[derive(Default, Serialize)]
struct OfSignal {
    rows: u64,
    violated: u64,
    /// How many were found, and the longest time from the fault to the finding, ms.
    found: u64,
    found_max_ms: f64,
    /// The largest offset from the lane, m.
    aside_max_m: f64,
    gap_max_ms: f64,
}

impl OfSignal {
    fn add(&mut self, outcome: &Outcome, is_violated: bool) {
        self.rows += 1;
        self.violated += u64::from(is_violated);
        self.found += u64::from(outcome.found_ns.is_some());
        let ms = |ns: u64| ns as f64 * 1e-6;
        self.found_max_ms = self.found_max_ms.max(outcome.found_ns.map_or(0.0, ms));
        self.aside_max_m = self.aside_max_m.max(outcome.aside_m.unwrap_or(0.0));
        self.gap_max_ms = self.gap_max_ms.max(ms(outcome.gap_ns));
    }
}

/// Returns what each signal led to. `bad`: the numbers of the violated sequences.
fn signals(
    source: &Source,
    outcomes: &[Outcome],
    bad: &BTreeSet<u64>,
) -> Result<BTreeMap<String, OfSignal>> {
    let mut signals: BTreeMap<String, OfSignal> = BTreeMap::new();
    for outcome in outcomes {
        let sequence = source.sequence(outcome.number)?;
        let label = sequence.faults.first().map(|fault| fault.kind.label());
        let of_signal = signals.entry(label.unwrap_or_default()).or_default();
        of_signal.add(outcome, bad.contains(&outcome.number));
    }
    Ok(signals)
}

fn signal_table(signals: &BTreeMap<String, OfSignal>, text: &mut String) -> Result<()> {
    writeln!(
        text,
        "| fault | rows | violated | found | found after at most ms | aside at most m | gap at most ms |"
    )?;
    writeln!(text, "|---|---|---|---|---|---|---|")?;
    for (label, it) in signals {
        writeln!(
            text,
            "| {label} | {} | {} | {} | {:.0} | {:.2} | {:.1} |",
            it.rows, it.violated, it.found, it.found_max_ms, it.aside_max_m, it.gap_max_ms
        )?;
    }
    Ok(())
}

impl Summary {
    pub(super) fn json(&self) -> serde_json::Value {
        json!({
            "sequences": self.sequences, "violated": self.violated, "suspended": self.suspended,
            "violations": self.violations, "known": self.known,
            "gap_max_ms": self.gap_ns as f64 * 1e-6, "covered": self.covered.json(),
            "signals": self.signals,
        })
    }

    /// Adds the counts of another campaign.
    pub(super) fn add(&mut self, other: &Self) {
        self.sequences += other.sequences;
        self.violated += other.violated;
        self.simulated_ns += other.simulated_ns;
        self.digest = self.digest.wrapping_add(other.digest);
        self.covered.add(&other.covered);
    }
}

/// Returns the text and the figures of a campaign.
pub(super) fn of(
    source: &Source,
    outcomes: &[Outcome],
    arguments: &SimArgs,
) -> Result<(String, Summary)> {
    let profile = arguments.profile();
    let mut text = String::new();
    if matches!(source, Source::Numbered(Group::Single)) {
        table(source, outcomes, profile, &mut text)?;
    }
    let mut summary = Summary {
        sequences: outcomes.len() as u64,
        suspended: outcomes.iter().filter(|it| it.suspended > 0).count() as u64,
        simulated_ns: outcomes.iter().map(|outcome| outcome.simulated_ns).sum(),
        gap_ns: outcomes.iter().map(|it| it.gap_ns).max().unwrap_or(0),
        digest: outcomes.iter().fold(0, mixed),
        covered: Coverage::of(outcomes),
        ..Summary::default()
    };
    let name = source.name();
    let mut bad = BTreeSet::new();
    for rule in Rule::all() {
        let mut new = Vec::new();
        for outcome in outcomes.iter().filter(|it| it.violations.contains(&rule)) {
            let sequence = source.sequence(outcome.number)?;
            match known(&sequence, rule, outcome.aside_m) {
                Some(why) => *summary.known.entry(why.to_owned()).or_insert(0) += 1,
                None => new.push(sequence),
            }
        }
        if !new.is_empty() {
            writeln!(text, "{name}: {rule:?} {}", new.len())?;
            classes(source, rule, &new, arguments, &mut text)?;
            summary.violations.insert(format!("{rule:?}"), new.len());
            bad.extend(new.iter().map(|sequence| sequence.number));
        }
    }
    summary.violated = bad.len() as u64;
    if matches!(source, Source::Numbered(Group::Values)) {
        summary.signals = signals(source, outcomes, &bad)?;
        signal_table(&summary.signals, &mut text)?;
    }
    let (count, suspended) = (summary.sequences, summary.suspended);
    let gap = summary.gap_ns as f64 * 1e-6;
    writeln!(
        text,
        "{name}: {count} sequences, {} violated, {suspended} end with a suspended system, longest gap {gap:.1} ms",
        bad.len()
    )?;
    for (why, count) in &summary.known {
        writeln!(text, "  known: {count} for {why}")?;
    }
    Ok((text, summary))
}

/// Adds the digest of a sequence to `sum`. The result does not depend on the order.
const fn mixed(sum: u64, outcome: &Outcome) -> u64 {
    let own = outcome.digest ^ outcome.number.wrapping_mul(0x9E37_79B9_7F4A_7C15);
    sum.wrapping_add(own)
}

/// Prints which faults lead to a violation, most frequent first, each with a command to repeat it.
fn classes(
    source: &Source,
    rule: Rule,
    sequences: &[Sequence],
    arguments: &SimArgs,
    text: &mut String,
) -> Result<()> {
    let numbered = matches!(
        source,
        Source::Numbered(Group::Single | Group::Pair | Group::Values)
    );
    let mut classes: BTreeMap<String, Vec<u64>> = BTreeMap::new();
    for (index, sequence) in sequences.iter().enumerate() {
        let kinds = match numbered {
            true => sequence.kinds(),
            false if index >= SHRUNK => continue,
            false => arguments.profile().shrunk(sequence, rule).kinds(),
        };
        classes.entry(kinds).or_default().push(sequence.number);
    }
    let mut classes: Vec<_> = classes.into_iter().collect();
    classes.sort_by_key(|(_, numbers)| std::cmp::Reverse(numbers.len()));
    for (kinds, numbers) in classes.iter().take(CLASSES) {
        let (count, repeats) = (numbers.len(), source.repeats(numbers[0], arguments));
        writeln!(text, "  {count:5} {kinds}: {repeats}")?;
    }
    Ok(())
}

/// Prints the bound of each single fault beside the measured gap.
fn table(source: &Source, outcomes: &[Outcome], profile: Profile, text: &mut String) -> Result<()> {
    writeln!(
        text,
        "| fault | loss | bound ms | longest gap ms | violated |"
    )?;
    writeln!(text, "|---|---|---|---|---|")?;
    for outcomes in outcomes.chunk_by(|a, b| a.number / PHASES == b.number / PHASES) {
        let Some(first) = outcomes.first() else {
            continue;
        };
        let sequence = source.sequence(first.number)?;
        let fault = &sequence.faults[0];
        let bound = sequence.bound(&profile.bounds()).map_or_else(
            || "| ".to_owned(),
            |(loss, bound)| {
                let bound = bound + profile.time.allowance();
                format!("{loss:?} | {:.1}", bound.as_ms_f64())
            },
        );
        let gap_ns = outcomes.iter().map(|outcome| outcome.gap_ns).max();
        let gap = gap_ns.unwrap_or(0) as f64 * 1e-6;
        let broken = |rule: &Rule| outcomes.iter().any(|it| it.violations.contains(rule));
        let violations = Rule::all().filter(broken);
        let violations: Vec<String> = violations.map(|it| format!("{it:?}")).collect();
        let count = outcomes
            .iter()
            .filter(|it| !it.violations.is_empty())
            .count();
        let violated = match count {
            0 => String::new(),
            count => format!("{count} of {}: {}", outcomes.len(), violations.join(", ")),
        };
        let (kind, way) = (fault.kind, fault.way);
        writeln!(text, "| {kind} {way:?} | {bound} | {gap:.1} | {violated} |")?;
    }
    Ok(())
}
