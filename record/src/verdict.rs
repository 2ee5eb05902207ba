//! The rules for a good run: each is defined once, with its bound and the effect of a finding.
//!
//! A run, its report, a campaign of faults and a judged scenario apply the same rules. The table in
//! `docs/verdict.md` is generated from [`RULES`].

pub mod figures;
pub mod modes;

use core::fmt::{self, Write as _};

use Bound::{AtMost, Given};
use InRun::{Campaign, Fails, Reported};
use serde::{Deserialize, Serialize};
use tandem_board::Duration;
use tandem_redundancy::Config;

pub use crate::required_limits::{self, Limits};
pub use figures::{Beside, Figures};

/// The effect of a finding on a run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum InRun {
    /// The run fails: exit status 1.
    Fails,
    /// The verdict reports it.
    Reported,
    /// Only campaigns apply the rule, because they know the faults. A finding fails the campaign.
    Campaign,
}

/// The bound of a rule.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Bound {
    /// The largest permitted figure, with its unit.
    AtMost(f64, &'static str),
    /// A bound in words. Its value follows from the run.
    Given(&'static str),
}

/// The row of a rule in the table.
#[derive(Clone, Copy, Debug)]
pub struct Row {
    /// The rule.
    pub rule: Rule,
    /// The finding in words, if the rule is broken.
    pub words: &'static str,
    /// The bound.
    pub bound: Bound,
    /// The fields of `metrics.json` that the rule reads; empty if it has none.
    pub fields: &'static str,
    /// The effect of a finding on a run.
    pub in_run: InRun,
}

/// If the vehicle is this far from the centre of its lane, m, one of its sides reaches the line.
/// This holds for a lane of 3.5 m and a vehicle of 1.8 m.
pub const LATERAL_ERROR_MAX_M: f64 = 0.85;
/// The longest permitted median control period, ms: 10 ms, plus a tenth for clocks and timers.
pub const CONTROL_PERIOD_MAX_MS: f64 = 11.0;
/// A wrong mode may last this long, s: the master detects a standby that falls silent on CAN after
/// 0.35 s, and a standby that has returned counts again after 1 s.
pub const WRONG_MODE_MAX_S: f64 = 1.5;
/// The smallest permitted time gap to the vehicle ahead, s: the one that planning keeps at more
/// than 60 km/h.
pub const HEADWAY_MIN_S: f64 = 1.6;

/// Defines the enum of the rules and their table from one list. A rule says what must not happen.
macro_rules! rules {
    ($($rule:ident, $fields:literal, $bound:expr, $in_run:expr, $words:literal;)+) => {
        /// A rule. Its position in the list is its code in the files of a campaign.
        #[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
        #[serde(rename_all = "kebab-case")]
        pub enum Rule {
            $(#[doc = concat!("Broken if ", $words, ".")] $rule,)+
        }

        /// All rules, in the order of their codes.
        pub const RULES: &[Row] = &[$(Row {
            rule: Rule::$rule,
            words: $words,
            bound: $bound,
            fields: $fields,
            in_run: $in_run,
        },)+];
    };
}

rules! {
    NoControl, "control_frames", Given("1 frame"), Fails, "no control frame was ever accepted";
    CutShort, "complete", Given("the end"), Fails, "the run did not reach its end";
    Collision, "collisions", AtMost(0.0, ""), Fails, "the vehicle touched another one";
    LeftLane, "excursion_max_m", AtMost(0.0, "m"), Fails,
        "a corner of the vehicle left all lanes of its direction by more than 0.1 m";
    LateralError, "lateral_error_max_m", AtMost(LATERAL_ERROR_MAX_M, "m"), Reported,
        "a side of the vehicle crossed the line of its lane outside a lane change";
    OutsideDomain, "outside_domain_s", AtMost(0.0, "s"), Fails,
        "the vehicle drove where its operational design domain has ended";
    Stopped, "standing_s", AtMost(0.0, "s"), Fails, "the vehicle stopped without a reason";
    Gap, "gaps", Given("by the sign that ended it"), Fails,
        "no system drove for longer than the bound, also up to the end";
    TwoMasters, "two_masters_ms", AtMost(0.0, "ms"), Fails, "two systems drove at once";
    BothTransmitted, "both_transmitted_ms", Given("`hand_over_ms`"), Fails,
        "both systems transmitted as master for longer than the hand-overs permit";
    StaleFrames, "stale_frames", AtMost(0.0, ""), Fails,
        "control frames after a takeover were too old to act";
    Needless, "false_takeovers", AtMost(0.0, ""), Fails,
        "a system took over from a master that had not failed";
    SlowControl, "control_period_p50_ms", AtMost(CONTROL_PERIOD_MAX_MS, "ms"), Fails,
        "the control period was too long throughout";
    WrongMode, "wrong_mode_s", AtMost(WRONG_MODE_MAX_S, "s"), Fails,
        "the mode did not match the redundancy that was left";
    Limits, "gap_bound_ms", Given("that of the profile"), Fails,
        "the product's limits permit more than the requirement";
    Leftovers, "leftovers", AtMost(0.0, ""), Fails, "a file or a process was left";
    NoStandby, "redundancy_lost_s", Given("never"), Reported,
        "redundancy was lost to the end: no system that could drive stood by";
    TakeoverAsked, "takeover_asked_s", Given("never"), Reported,
        "the function asked the driver to take over";
    SafeStop, "safe_stop_s", Given("never"), Reported, "the function made its minimal-risk stop";
    NotParked, "soc", Given("never"), Reported, "the SoC did not park the vehicle";
    NoneObeyed, "", Given("at the end"), Campaign,
        "the vehicle obeyed no system, though one could drive";
    BothSuspended, "", Given("at the end"), Campaign, "both systems had suspended themselves";
    ObeysNoMaster, "", Given("at the end"), Campaign,
        "the vehicle obeyed a system without the role of master";
    Unsteady, "", Given("in the last 200 ms"), Campaign,
        "frames were late or refused, or the driver changed twice";
    OldTerm, "", Given("never"), Campaign,
        "a frame of an old term acted, or one term belonged to both systems";
    Changes, "", Given("2 for each fault, and 1"), Campaign,
        "the driver changed more often than the faults explain";
    StateLost, "", Given("never"), Campaign, "a record was gone that no fault had destroyed";
    FlashWorn, "", Given("12 for each fault, and 12"), Campaign,
        "the flash was programmed more often than the faults explain";
    Panic, "", Given("never"), Campaign, "a core panicked, or the cores woke each other for ever";
    TooClose, "", Given("1.6 s behind it"), Campaign,
        "the vehicle came too close to the one in front";
    Chatters, "", Given("never"), Campaign, "a system that was no master sent a control frame";
    SoundDrives, "", Given("20 ms after the finding"), Campaign,
        "a sound system did not drive, or not for good";
    Untold, "", Given("never"), Campaign,
        "a wrong or missing value changed the drive, and no system told it";
    DriverSuspended, "", Given("never"), Campaign,
        "a system that could drive was suspended by the fault of another";
    OffLane, "", Given("0.1 m beyond the line"), Campaign,
        "a side of the vehicle was off its lane outside a lane change";
}

impl Rule {
    /// Returns all rules, in the order of their codes.
    pub fn all() -> impl DoubleEndedIterator<Item = Self> + Clone {
        RULES.iter().map(|row| row.rule)
    }

    /// Returns its row in the table.
    #[must_use]
    pub const fn row(self) -> &'static Row {
        &RULES[self as usize]
    }

    /// Returns the finding if the figure exceeds the rule's bound; `None` if it does not, or if
    /// the bound is not a number.
    #[must_use]
    pub fn exceeded(self, measured: f64) -> Option<Finding> {
        let Row { words, bound, .. } = self.row();
        match *bound {
            AtMost(most, unit) if measured > most => {
                let figure = match unit {
                    "" => format!("{words}: {measured:.0}"),
                    _ if most > 0.0 => {
                        format!("{words}: {measured:.2} {unit} (bound {most} {unit})")
                    }
                    _ => format!("{words}: {measured:.2} {unit}"),
                };
                Some(Finding::new(self, [measured, most], figure))
            }
            _ => None,
        }
    }
}

/// Writes the name of the rule as it appears in files, for example `two-masters`.
impl fmt::Display for Rule {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.serialize(f)
    }
}

/// A rule that was broken.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Finding {
    /// The rule.
    pub rule: Rule,
    /// Scenario time in s; `None` if the finding does not belong to one time.
    pub at_s: Option<f64>,
    /// The figure.
    pub measured: f64,
    /// The largest permitted figure.
    pub bound: f64,
    /// What was found, in words.
    pub words: String,
    /// What stalled at that time, in words; empty if nothing stalled.
    pub evidence: String,
    /// Whether the stall explains the whole excess over the bound.
    pub excused: bool,
}

impl Finding {
    /// Creates a finding from `[measured, bound]`.
    #[must_use]
    pub fn new(rule: Rule, [measured, bound]: [f64; 2], words: impl Into<String>) -> Self {
        Self {
            rule,
            at_s: None,
            measured,
            bound,
            words: words.into(),
            evidence: String::new(),
            excused: false,
        }
    }

    /// Returns the findings of a product whose own limits permit more than these.
    pub fn of_limits(limits: Limits, product: &Config) -> impl Iterator<Item = Self> + use<> {
        limits.exceeded_by(product).map(move |(what, here, most)| {
            let [here, most] = [here, most].map(Duration::as_ms_f64);
            let words = format!(
                "the product's limits permit a {what} of {here} ms; profile {} permits {most} ms",
                limits.profile
            );
            Self::new(Rule::Limits, [here, most], words)
        })
    }

    /// Returns a finding that is described with the words of the rule.
    #[must_use]
    pub fn of(rule: Rule) -> Self {
        Self::new(rule, [1.0, 0.0], rule.row().words)
    }

    /// Returns the finding with this scenario time, s.
    #[must_use]
    pub fn at(self, at_s: f64) -> Self {
        Self {
            at_s: Some(at_s),
            ..self
        }
    }

    /// Adds to the finding the stall at that time, and whether this stall excuses the finding.
    #[must_use]
    pub fn beside(self, evidence: String, excused: bool) -> Self {
        Self {
            evidence,
            excused,
            ..self
        }
    }

    /// Returns whether the finding fails a run.
    #[must_use]
    pub fn fails_run(&self) -> bool {
        self.rule.row().in_run != Reported && !self.excused
    }
}

impl fmt::Display for Finding {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self {
            words, evidence, ..
        } = self;
        match (self.excused, evidence.is_empty()) {
            (true, _) => write!(f, "machine stalled (evidence: {evidence}): {words}"),
            (false, false) => write!(f, "{words}; {evidence} does not explain it"),
            (false, true) => f.write_str(words),
        }
    }
}

/// How stalls of the machine were observed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Watch {
    /// They were not observed: time is virtual, so nothing stalls.
    #[default]
    Virtual,
    /// Threads with a higher priority than the run observed them. A late thread is evidence.
    Urgent,
    /// Threads of ordinary priority observed them. A late thread is not evidence.
    Ordinary,
}

/// The result of judging a run.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Outcome {
    /// No finding fails the run.
    UnderControl,
    /// A finding fails the run.
    Failed,
    /// The run had no real-time priority, so the machine may have delayed a frame.
    NotJudged,
}

/// The verdict on a run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Verdict {
    /// The result.
    pub outcome: Outcome,
    /// The broken rules.
    pub findings: Vec<Finding>,
}

/// At most this many findings of one rule are printed; `metrics.json` has all.
const SHOWN: usize = 5;
const ALL_WELL: &str = "The vehicle was under control from start to end";

impl Verdict {
    /// Returns the verdict that follows from these findings.
    #[must_use]
    pub fn new(findings: Vec<Finding>, watch: Watch) -> Self {
        let is_timing = |rule| {
            let needs_time = [
                Rule::Gap,
                Rule::StaleFrames,
                Rule::Needless,
                Rule::BothTransmitted,
            ];
            needs_time.contains(&rule) || matches!(rule, Rule::SlowControl)
        };
        let mut failing = findings.iter().filter(|it| it.fails_run()).peekable();
        let fails = failing.peek().is_some();
        let only_timing = failing.all(|it| is_timing(it.rule));
        let outcome = match watch {
            Watch::Ordinary if only_timing => Outcome::NotJudged,
            _ if fails => Outcome::Failed,
            _ => Outcome::UnderControl,
        };
        Self { outcome, findings }
    }

    /// Returns the findings that fail the run, in words; empty if the run is good.
    #[must_use]
    pub fn objections(&self) -> Vec<String> {
        self.shown(|it| it.fails_run())
    }

    /// Returns all parts of the verdict in words, each with its grade. A part without a finding
    /// says that all was well, or that the run was not judged.
    #[must_use]
    pub fn parts(&self) -> Vec<(Grade, String)> {
        let bad = self.objections().into_iter().map(|part| (Grade::Bad, part));
        let reported = self.shown(|it| !it.fails_run()).into_iter();
        let mut parts: Vec<_> = bad
            .chain(reported.map(|part| (Grade::Reported, part)))
            .collect();
        match self.outcome {
            Outcome::NotJudged if self.objections().is_empty() => {
                let kept = format!(
                    "not judged: no real time; every bound was kept all the same: {ALL_WELL}"
                );
                parts.insert(0, (Grade::Reported, kept));
            }
            Outcome::NotJudged => {
                parts.insert(0, (Grade::Bad, "not judged: no real time".to_owned()))
            }
            Outcome::UnderControl if parts.is_empty() => {
                parts.push((Grade::Good, ALL_WELL.to_owned()))
            }
            Outcome::UnderControl | Outcome::Failed => {}
        }
        parts
    }

    /// Returns the findings that `which` selects, in words: the first few of each rule.
    fn shown(&self, which: impl Fn(&Finding) -> bool) -> Vec<String> {
        let mut parts = Vec::new();
        for rule in Rule::all() {
            let of_rule: Vec<_> = self
                .findings
                .iter()
                .filter(|it| it.rule == rule && which(it))
                .collect();
            parts.extend(of_rule.iter().take(SHOWN).map(ToString::to_string));
            if let Some(more @ 1..) = of_rule.len().checked_sub(SHOWN) {
                parts.push(format!("and {more} more: {rule}"));
            }
        }
        parts
    }
}

/// How a part of a verdict is shown.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Grade {
    /// Nothing is wrong.
    Good,
    /// It must be reported, but does not fail the run.
    Reported,
    /// It fails the run.
    Bad,
}

/// Returns the table of the rules in `docs/verdict.md`.
#[must_use]
pub fn table() -> String {
    let mut text = String::from(
        "| rule | a run or campaign in which | bound | field of `metrics.json` | does to a run |\n\
         |---|---|---|---|---|\n",
    );
    for row in RULES {
        let bound = match row.bound {
            AtMost(most, "") => most.to_string(),
            AtMost(most, unit) => format!("{most} {unit}"),
            Given(words) => words.to_owned(),
        };
        let fields = match row.fields {
            "" => "·".to_owned(),
            fields => format!("`{fields}`"),
        };
        let does = match row.in_run {
            Fails => "fails",
            Reported => "is reported",
            Campaign => "only campaigns",
        };
        // Writing to a string cannot fail.
        let _ = writeln!(
            text,
            "| `{}` | {} | {bound} | {fields} | {does} |",
            row.rule, row.words
        );
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_rule_has_its_own_row() {
        for (place, row) in RULES.iter().enumerate() {
            assert_eq!(row.rule as usize, place, "{}", row.rule);
        }
        assert_eq!(Rule::TwoMasters.to_string(), "two-masters");
    }

    /// The table in the docs agrees with the rules; `UPDATE_DOCS=1` updates it.
    #[test]
    fn the_table_of_the_docs_is_that_of_the_rules() {
        let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../docs/verdict.md");
        let (begin, end) = ("<!-- rules:begin -->\n", "<!-- rules:end -->");
        let page = std::fs::read_to_string(path).unwrap();
        let (before, rest) = page.split_once(begin).unwrap();
        let (found, after) = rest.split_once(end).unwrap();
        if std::env::var_os("UPDATE_DOCS").is_some() {
            std::fs::write(path, format!("{before}{begin}{}{end}{after}", table())).unwrap();
        } else {
            let how = "docs/verdict.md is out of date: UPDATE_DOCS=1 cargo test -p tandem-record";
            assert_eq!(found, table(), "{how}");
        }
    }

    #[test]
    fn a_finding_fails_a_run_by_its_rule_and_unless_a_stall_excuses_it() {
        let gap = || Finding::new(Rule::Gap, [40.0, 20.0], "no system drove for 40 ms");
        let outcome = |findings: &[Finding], watch| Verdict::new(findings.to_vec(), watch).outcome;
        assert_eq!(outcome(&[], Watch::Urgent), Outcome::UnderControl);
        assert_eq!(outcome(&[gap()], Watch::Urgent), Outcome::Failed);
        let excused = gap().beside("CPU 0 gone for 30.0 ms".to_owned(), true);
        assert_eq!(
            outcome(std::slice::from_ref(&excused), Watch::Urgent),
            Outcome::UnderControl
        );
        let lost = Finding::of(Rule::NoStandby);
        assert_eq!(
            outcome(std::slice::from_ref(&lost), Watch::Urgent),
            Outcome::UnderControl
        );
        let shown = Verdict::new(vec![excused, lost], Watch::Urgent).parts();
        assert!(
            shown.iter().all(|(grade, _)| *grade == Grade::Reported),
            "{shown:?}"
        );
        assert!(
            shown[0]
                .1
                .starts_with("machine stalled (evidence: CPU 0 gone"),
            "{shown:?}"
        );
    }

    /// Without real-time priority a late frame proves nothing, but a collision fails the run.
    #[test]
    fn without_real_time_only_times_are_not_judged() {
        let gap = Finding::new(Rule::Gap, [40.0, 20.0], "no system drove for 40 ms");
        let verdict = |findings: &[Finding]| Verdict::new(findings.to_vec(), Watch::Ordinary);
        let late = verdict(std::slice::from_ref(&gap));
        assert_eq!(late.outcome, Outcome::NotJudged);
        assert_eq!(late.objections(), ["no system drove for 40 ms"]);
        assert_eq!(late.parts()[0].1, "not judged: no real time");
        let kept = verdict(&[]);
        assert!(kept.objections().is_empty());
        assert!(
            kept.parts()[0]
                .1
                .starts_with("not judged: no real time; every bound was kept")
        );
        let hit = verdict(&[gap, Rule::Collision.exceeded(1.0).unwrap()]);
        assert_eq!(hit.outcome, Outcome::Failed);
    }

    /// A product that waits 400 ms too long for a control frame breaks the rule `limits`.
    #[test]
    fn a_product_with_longer_limits_is_found() {
        let product = Config {
            control_margin: Duration::from_ms(400),
            ..Config::rt()
        };
        let found: Vec<Finding> = Finding::of_limits(Limits::RT, &product).collect();
        let mute = |finding: &Finding| finding.words.contains("mute master of 412 ms");
        assert!(found.iter().any(mute), "{found:?}");
        assert!(found.iter().all(Finding::fails_run));
    }

    #[test]
    fn a_figure_is_held_against_the_bound_of_its_rule() {
        assert_eq!(Rule::LateralError.exceeded(0.85), None);
        let beyond = Rule::LateralError.exceeded(0.9).unwrap();
        assert_eq!(
            beyond.words,
            "a side of the vehicle crossed the line of its lane outside a lane change: 0.90 m (bound 0.85 m)"
        );
        assert!(Rule::SlowControl.exceeded(20.0).is_some());
        assert!(Rule::Collision.exceeded(0.0).is_none());
    }
}
