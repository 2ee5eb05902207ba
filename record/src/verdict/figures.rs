//! The figures of a run that the rules read, and the findings that follow from them.

use serde::Serialize;
use tandem_redundancy::Config;
use tandem_vehicle::Ruling;

use super::modes::{self, Stop};
use super::{Finding, Rule, Verdict, Watch};
use crate::gap::{self, Bounds, EndedBy, Gap};
use crate::log::DriveFigures;
use crate::run_log::{Stall, Stood};
use crate::{RunLog, Takeover, description, ms_between, takeovers};

/// Data about a run that the rules need but the recording does not contain.
#[derive(Clone, Debug, Default)]
pub struct Beside {
    /// How long the vehicle may be without control, by cause.
    pub bounds: Bounds,
    /// The limits of the product that drove; `None` if there is no product, as for synthetic runs.
    pub product: Option<Config>,
    /// How stalls of the machine were observed.
    pub watch: Watch,
    /// The times in which a CPU did not run.
    pub stalls: Vec<Stall>,
    /// Files and processes that still existed after the end of the run.
    pub leftovers: Vec<String>,
    /// Why the SoC did not park the vehicle; `None` if it did, or if the run had none.
    pub not_parked: Option<String>,
}

impl Beside {
    /// Returns all stalls that are evidence, of CPUs and of the bus. A stall that a process of
    /// ordinary priority observed is not evidence.
    #[must_use]
    pub fn evidence(&self, log: &RunLog) -> Vec<Stall> {
        match self.watch {
            Watch::Ordinary => vec![],
            Watch::Virtual | Watch::Urgent => [&self.stalls[..], &log.held_up].concat(),
        }
    }
}

/// The figures that the rules read. Scripts rely on the names.
#[derive(Clone, Debug, Serialize)]
pub struct Figures {
    /// Whether the run reached its end.
    pub complete: bool,
    /// Number of control frames that the vehicle obeyed.
    pub control_frames: usize,
    /// Median of the time between two control frames of one mastership, by the sender's clock, ms.
    pub control_period_p50_ms: Option<f64>,
    /// Time in which frames of both systems were accepted, ms.
    pub two_masters_ms: f64,
    /// Time in which both systems transmitted control frames as master, ms, whether or not the
    /// vehicle obeyed them.
    pub both_transmitted_ms: f64,
    /// The part of that time that the hand-overs of this run can explain, ms.
    pub hand_over_ms: f64,
    /// Number of stale control frames after a takeover whose delay no stall explains.
    pub stale_frames: usize,
    /// Times without control beyond the bound of their cause.
    pub gaps: Vec<GapFigures>,
    /// Changes of the system that the vehicle obeys.
    pub takeovers: Vec<TakeoverFigures>,
    /// Number of takeovers from a master that had not failed, and that no stall explains.
    pub false_takeovers: usize,
    /// The longest time in which the mode of the master did not fit the redundancy, s.
    pub wrong_mode_s: f64,
    /// Scenario time since which no system was standby, s; `None` if one was at the end.
    pub redundancy_lost_s: Option<f64>,
    /// Files and processes that still existed after the end.
    pub leftovers: Vec<String>,
}

/// One entry of [`Figures::gaps`].
#[derive(Clone, Debug, Serialize)]
pub struct GapFigures {
    /// Scenario time of the last accepted frame before the gap, s.
    pub at_s: f64,
    /// Length of the gap, ms.
    pub gap_ms: f64,
    /// The longest permitted gap, ms.
    pub bound_ms: f64,
    /// What ended the gap: the evidence of a takeover, the same system, or the end of the run.
    pub ended_by: String,
    /// How much of the gap is excused by stalls of the bus and of the systems that must drive, ms.
    pub stalled_ms: f64,
    /// The stalls that excuse this part, in words; empty if there were none.
    pub evidence: String,
    /// Whether the gap would have kept its bound without the stalls.
    pub explained: bool,
}

impl GapFigures {
    /// Returns the figures of a gap.
    #[must_use]
    pub fn of(log: &RunLog, gap: &Gap) -> Self {
        Self {
            at_s: log.seconds(gap.from_ns),
            gap_ms: gap.ms(),
            bound_ms: gap.bound_ms,
            ended_by: match gap.ended_by {
                EndedBy::SameSystem => "the same system".to_owned(),
                EndedBy::Nothing => "the end of the run".to_owned(),
                EndedBy::Takeover(None) => "a takeover, sign not reported".to_owned(),
                EndedBy::Takeover(Some(sign)) => {
                    format!("a takeover: {}", description::evidence(sign))
                }
            },
            stalled_ms: gap.stalled_ms,
            evidence: words(log, &gap.stalls),
            explained: gap.is_explained(),
        }
    }

    /// Returns the finding of this gap.
    #[must_use]
    pub fn finding(&self) -> Finding {
        let words = format!(
            "no system drove for {:.1} ms from {:.3} s on, up to {} (bound {:.0} ms)",
            self.gap_ms, self.at_s, self.ended_by, self.bound_ms
        );
        Finding::new(Rule::Gap, [self.gap_ms, self.bound_ms], words)
            .at(self.at_s)
            .beside(self.evidence.clone(), self.explained)
    }
}

/// One entry of [`Figures::takeovers`].
#[derive(Clone, Debug, Serialize)]
pub struct TakeoverFigures {
    /// The system that drove before: `A` or `B`.
    pub from: String,
    /// The system that drove after the takeover.
    pub to: String,
    /// Scenario time of the new master's first frame, s.
    pub at_s: f64,
    /// The new master's evidence that the old master had failed.
    pub cause: String,
    /// Time from the old master's last sign of life to the decision, ms.
    pub detected_ms: Option<f64>,
    /// Time from the old master's last accepted frame to the new master's first, ms.
    pub gap_ms: f64,
    /// The longest permitted gap for this evidence, ms.
    pub bound_ms: f64,
    /// Whether the takeover was false: the old master had not failed.
    pub is_false: bool,
    /// Stalls of the old master or the bus that lasted longer than tolerated, in words, if the
    /// takeover is false; otherwise empty.
    pub evidence: String,
    /// Whether the old master later detected that its core was held up: frozen, or not scheduled.
    pub held_up: bool,
}

impl TakeoverFigures {
    fn of(log: &RunLog, takeover: &Takeover, bounds: &Bounds, stalls: &[Stall]) -> Self {
        let tolerated_ns = bounds.limits.tolerated_stall().as_ns();
        let since_ns = takeover
            .at_ns
            .saturating_sub((bounds.silent_ms * 1e6) as u64);
        let cpu = log.control_cpu(takeover.from).map(Stood::Cpu);
        let held_up = |stall: &&Stall| {
            (stall.of == Stood::Bus || Some(stall.of) == cpu)
                && stall.from_ns < takeover.at_ns
                && since_ns < stall.to_ns
                && stall.to_ns - stall.from_ns >= tolerated_ns
        };
        let held_up: Vec<_> = stalls.iter().filter(held_up).copied().collect();
        Self {
            from: takeover.from.to_string(),
            to: takeover.to.to_string(),
            at_s: log.seconds(takeover.at_ns),
            cause: takeover.cause_in_words().to_owned(),
            detected_ms: takeover.detected_ms,
            gap_ms: takeover.gap_ms,
            bound_ms: bounds.of_takeover(log, takeover),
            is_false: takeover.is_false,
            evidence: match takeover.is_false {
                true => words(log, &held_up),
                false => String::new(),
            },
            held_up: takeover.held_up,
        }
    }

    /// Returns whether the old master had not failed and no stall explains the takeover.
    const fn is_needless(&self) -> bool {
        self.is_false && self.evidence.is_empty()
    }
}

/// Returns the findings about the drive, except stops: only a recording contains their reasons.
#[must_use]
pub fn of_drive(drive: &DriveFigures) -> Vec<Finding> {
    let figures = [
        (Rule::Collision, f64::from(drive.collisions)),
        (Rule::LeftLane, drive.excursion_max_m),
        (Rule::LateralError, drive.lateral_error_max_m),
        (Rule::OutsideDomain, drive.outside_domain_s),
    ];
    let figures = figures
        .into_iter()
        .filter_map(|(rule, it)| rule.exceeded(it));
    let ends = [
        (Rule::TakeoverAsked, drive.takeover_asked_s),
        (Rule::SafeStop, drive.safe_stop_s),
    ];
    let ends = ends.into_iter().filter_map(|(rule, at_s)| {
        let at_s = at_s?;
        let words = format!("{} at {at_s:.1} s", rule.row().words);
        Some(Finding::new(rule, [at_s, 0.0], words).at(at_s))
    });
    figures.chain(ends).collect()
}

/// Returns the finding on a run that did not reach its end.
fn cut_short(log: &RunLog) -> Finding {
    let Some(at_s) = log.launcher_died_ns.map(|at_ns| log.seconds(at_ns)) else {
        return Finding::of(Rule::CutShort);
    };
    let words = format!(
        "{}: its `tandem run` was killed at {at_s:.1} s, and the vehicle's process ended it",
        Rule::CutShort.row().words
    );
    Finding::new(Rule::CutShort, [1.0, 0.0], words).at(at_s)
}

/// Returns a finding if both systems transmitted for longer than their hand-overs permit, ms.
#[must_use]
pub fn both_transmitted(both_ms: f64, permitted_ms: f64) -> Option<Finding> {
    let words = format!("both systems transmitted for {both_ms:.1} ms (bound {permitted_ms} ms)");
    (both_ms > permitted_ms)
        .then(|| Finding::new(Rule::BothTransmitted, [both_ms, permitted_ms], words))
}

/// Returns the stalls in words.
fn words(log: &RunLog, stalls: &[Stall]) -> String {
    let each = stalls.iter().map(|stall| {
        let what = match stall.of {
            Stood::Cpu(cpu) => format!("CPU {cpu}"),
            Stood::Bus => "the vehicle's process".to_owned(),
        };
        let (ms, at_s) = (
            ms_between(stall.from_ns, stall.to_ns),
            log.seconds(stall.from_ns),
        );
        format!("{what} gone for {ms:.1} ms at {at_s:.3} s")
    });
    each.collect::<Vec<_>>().join(", ")
}

impl Figures {
    /// Returns the figures of a run, with the median of its control period.
    #[must_use]
    pub fn of(log: &RunLog, beside: &Beside, control_period_p50_ms: Option<f64>) -> Self {
        let (takeovers, stalls) = (takeovers(log), beside.evidence(log));
        let bounds = &beside.bounds;
        let gaps = gap::gaps(log, &takeovers, bounds, &stalls);
        let changes = takeovers
            .iter()
            .map(|it| TakeoverFigures::of(log, it, bounds, &stalls));
        let changes: Vec<_> = changes.collect();
        let accepted = |ruling| log.control.iter().filter(|it| it.ruling == ruling).count();
        Self {
            complete: log.end_ns.is_some(),
            control_frames: accepted(Ruling::Accepted),
            control_period_p50_ms,
            two_masters_ms: log.mastership().two_masters_ns() as f64 * 1e-6,
            both_transmitted_ms: gap::both_transmitted_ms(log),
            hand_over_ms: gap::hand_over_ms(&takeovers),
            stale_frames: gap::stale_frames(log, &takeovers, &stalls),
            gaps: gaps.iter().map(|gap| GapFigures::of(log, gap)).collect(),
            false_takeovers: changes.iter().filter(|it| it.is_needless()).count(),
            takeovers: changes,
            wrong_mode_s: modes::wrong_mode_s(log),
            redundancy_lost_s: modes::redundancy_lost_s(log),
            leftovers: beside.leftovers.clone(),
        }
    }

    /// Returns the verdict on the run that has these figures.
    #[must_use]
    pub fn verdict(&self, log: &RunLog, beside: &Beside) -> Verdict {
        let mut findings = of_drive(&log.figures);
        let figures = [
            (Rule::TwoMasters, self.two_masters_ms),
            (Rule::StaleFrames, self.stale_frames as f64),
            (Rule::SlowControl, self.control_period_p50_ms.unwrap_or(0.0)),
            (Rule::WrongMode, self.wrong_mode_s),
            (Rule::Leftovers, self.leftovers.len() as f64),
        ];
        findings.extend(
            figures
                .into_iter()
                .filter_map(|(rule, it)| rule.exceeded(it)),
        );
        let none = self.control_frames == 0;
        findings.extend(none.then(|| Finding::of(Rule::NoControl)));
        findings.extend((!self.complete).then(|| cut_short(log)));
        findings.extend(both_transmitted(
            self.both_transmitted_ms,
            self.hand_over_ms,
        ));
        findings.extend(self.gaps.iter().map(GapFigures::finding));
        findings.extend(self.takeovers.iter().filter(|it| it.is_false).map(|it| {
            let words = format!(
                "{} took over at {:.3} s from a master that had not failed",
                it.to, it.at_s
            );
            Finding::new(Rule::Needless, [1.0, 0.0], words)
                .at(it.at_s)
                .beside(it.evidence.clone(), !it.evidence.is_empty())
        }));
        let product = beside.product.iter();
        findings
            .extend(product.flat_map(|product| Finding::of_limits(beside.bounds.limits, product)));
        findings.extend(match modes::stop(log) {
            Some(Stop::Standing(for_s)) => Rule::Stopped.exceeded(for_s),
            Some(Stop::SafeStop(at_s)) => {
                let words = format!(
                    "{}: minimal-risk stop at {at_s:.1} s",
                    Rule::Stopped.row().words
                );
                Some(Finding::new(Rule::Stopped, [1.0, 0.0], words).at(at_s))
            }
            None => None,
        });
        findings.extend(self.redundancy_lost_s.map(|at_s| {
            let words = format!(
                "redundancy was lost at {at_s:.1} s to the end: no system that could drive stood by"
            );
            Finding::new(Rule::NoStandby, [at_s, 0.0], words).at(at_s)
        }));
        findings.extend(beside.not_parked.iter().map(|why| {
            let words = format!("{}: {why}", Rule::NotParked.row().words);
            Finding::new(Rule::NotParked, [1.0, 0.0], words)
        }));
        Verdict::new(findings, beside.watch)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gap::HAND_OVER_MS;
    use crate::verdict::{InRun, RULES};
    use tandem_board::Duration;

    /// A run with one takeover, without a finding.
    fn sound() -> (Figures, RunLog, Beside) {
        let takeover = TakeoverFigures {
            from: "A".to_owned(),
            to: "B".to_owned(),
            at_s: 4.0,
            cause: String::new(),
            detected_ms: None,
            gap_ms: 14.0,
            bound_ms: 20.0,
            is_false: false,
            evidence: String::new(),
            held_up: false,
        };
        let figures = Figures {
            complete: true,
            control_frames: 1,
            control_period_p50_ms: Some(11.0),
            two_masters_ms: 0.0,
            both_transmitted_ms: HAND_OVER_MS,
            hand_over_ms: HAND_OVER_MS,
            stale_frames: 0,
            gaps: vec![],
            takeovers: vec![takeover],
            false_takeovers: 0,
            wrong_mode_s: 1.5,
            redundancy_lost_s: None,
            leftovers: vec![],
        };
        let beside = Beside {
            product: Some(Config::rt()),
            ..Beside::default()
        };
        (figures, RunLog::default(), beside)
    }

    type Change = fn(&mut Figures, &mut RunLog, &mut Beside);

    /// For each rule of a run, a change that breaks only this rule.
    const BREAKS: &[(Rule, Change)] = &[
        (Rule::NoControl, |it, _, _| it.control_frames = 0),
        (Rule::CutShort, |it, _, _| it.complete = false),
        (Rule::Collision, |_, log, _| log.figures.collisions = 1),
        (Rule::LeftLane, |_, log, _| {
            log.figures.excursion_max_m = 0.01;
        }),
        (Rule::LateralError, |_, log, _| {
            log.figures.lateral_error_max_m = 0.86;
        }),
        (Rule::OutsideDomain, |_, log, _| {
            log.figures.outside_domain_s = 0.01;
        }),
        (Rule::Stopped, |_, log, _| log.figures.standing_s = 0.01),
        (Rule::Gap, |it, _, _| {
            it.gaps.push(GapFigures {
                at_s: 4.0,
                gap_ms: 20.1,
                bound_ms: 20.0,
                ended_by: String::new(),
                stalled_ms: 0.0,
                evidence: String::new(),
                explained: false,
            });
        }),
        (Rule::TwoMasters, |it, _, _| it.two_masters_ms = 0.01),
        (Rule::BothTransmitted, |it, _, _| {
            it.both_transmitted_ms = HAND_OVER_MS + 0.01;
        }),
        (Rule::StaleFrames, |it, _, _| it.stale_frames = 1),
        (Rule::Needless, |it, _, _| it.takeovers[0].is_false = true),
        (Rule::SlowControl, |it, _, _| {
            it.control_period_p50_ms = Some(11.01);
        }),
        (Rule::WrongMode, |it, _, _| it.wrong_mode_s = 1.51),
        (Rule::Limits, |_, _, beside| {
            let product = beside.product.as_mut().unwrap();
            product.control_margin = Duration::from_ms(400);
        }),
        (Rule::Leftovers, |it, _, _| {
            it.leftovers.push("a file".to_owned());
        }),
        (Rule::NoStandby, |it, _, _| it.redundancy_lost_s = Some(6.0)),
        (Rule::TakeoverAsked, |_, log, _| {
            log.figures.takeover_asked_s = Some(6.0);
        }),
        (Rule::NotParked, |_, _, beside| {
            beside.not_parked = Some("its process ended".to_owned());
        }),
    ];

    #[test]
    fn each_rule_of_a_run_finds_what_breaks_it() {
        let findings = |change: Change| {
            let (mut figures, mut log, mut beside) = sound();
            change(&mut figures, &mut log, &mut beside);
            figures.verdict(&log, &beside).findings
        };
        assert_eq!(findings(|_, _, _| ()), []);
        for (rule, change) in BREAKS {
            let found = findings(*change);
            assert!(found.iter().any(|it| it.rule == *rule), "{rule}: {found:?}");
            assert!(found.iter().all(|it| it.rule == *rule), "{rule}: {found:?}");
        }
        // A minimal-risk stop without a failure is also a stop without a reason.
        let stop = findings(|_, log, _| log.figures.safe_stop_s = Some(6.0));
        let stop: Vec<Rule> = stop.iter().map(|it| it.rule).collect();
        assert_eq!(stop, [Rule::SafeStop, Rule::Stopped]);
        // The list above covers every rule of a run.
        for row in RULES.iter().filter(|row| row.in_run != InRun::Campaign) {
            let is_here = row.rule == Rule::SafeStop || BREAKS.iter().any(|it| it.0 == row.rule);
            assert!(is_here, "{}", row.rule);
        }
    }
}
