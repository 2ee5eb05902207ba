//! Compares the command of the system that drives with the command that the other system would
//! give. T-RED-9
//!
//! Two channels cannot vote. A difference that lasts is reported, and a system that finds itself
//! wrong leaves. If neither does, the vehicle is stopped. The rule and its reasons are in
//! `docs/decisions/0020-two-systems-that-disagree.md`.

use crate::driving::types::Command;
use crate::driving::vehicle::WHEELBASE_M;
use tandem_board::{Duration, Instant};
pub(super) use tandem_bus::AgreementCode as Stage;
use tandem_redundancy::Phase;

/// Two systems are compared after both have run the same functions for this long: a system that has
/// just joined does not yet track every object that the other one tracks.
const WARM_UP: Duration = Duration::from_ms(1000);
/// A system that finds itself wrong leaves within this time. A disagreement that lasts longer has a
/// cause that neither system can find in itself.
const RESOLVE: Duration = Duration::from_ms(300);
/// After this many cycles without a command of the other system, there is nothing to compare.
const ABSENT_CYCLES: u8 = 10;
/// The other system asks for a stop if it reports [`Stage::Unresolved`] this many times in a row.
const UNRESOLVED_REPORTS: u8 = 3;
/// Period of the comparison, s.
const PERIOD_S: f32 = 0.01;

/// Limits of one axis of the comparison.
pub(super) struct Limits {
    /// Difference of the accelerations that is always tolerated, m/s².
    pub(super) tolerance: f32,
    /// Limit of the accumulated excess over the tolerance, m/s.
    limit: f32,
}

/// Lateral: two healthy systems differ by up to 0.47 m/s² for 30 ms, which adds up to 0.001 m/s. A
/// wheel that is stuck with an error of 0.01 rad at 25 m/s exceeds the limit after 50 ms.
pub(super) const LATERAL: Limits = Limits {
    tolerance: 0.4,
    limit: 0.1,
};
/// Longitudinal: two healthy systems may begin to brake hard at different times. The
/// accumulated excess is then at most 2.0 m/s.
pub(super) const LONGITUDINAL: Limits = Limits {
    tolerance: 1.5,
    limit: 4.0,
};

/// The excess of one axis, m/s, in both directions: the cumulative sum test of E. S. Page,
/// "Continuous Inspection Schemes", Biometrika 41 (1954).
#[derive(Clone, Copy, Debug, Default)]
struct Excess {
    up: f32,
    down: f32,
}

impl Excess {
    /// Adds a difference of accelerations, m/s². Returns the share of the limit that is used, 0 to
    /// 1.
    fn add(&mut self, difference: f32, limits: &Limits) -> f32 {
        let add = |sum: f32, by: f32| {
            // One wrong opinion uses at most half of the limit.
            let excess = ((by - limits.tolerance) * PERIOD_S).min(limits.limit / 2.0);
            let sum = sum + excess;
            // NaN counts as disagreement.
            if sum < limits.limit {
                sum.max(0.0)
            } else {
                limits.limit
            }
        };
        self.up = add(self.up, difference);
        self.down = add(self.down, -difference);
        self.up.max(self.down) / limits.limit
    }
}

/// The difference of two commands.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Deviation {
    /// Difference of the lateral accelerations that they ask for, m/s².
    pub(super) lateral: f32,
    /// Difference of the longitudinal accelerations, m/s².
    pub(super) longitudinal: f32,
}

impl Deviation {
    /// `speed`: of the vehicle, m/s.
    pub(super) fn of(command: &Command, other: &Command, speed: f32) -> Self {
        let angle = command.steering_angle - other.steering_angle;
        Self {
            lateral: angle * speed * speed / WHEELBASE_M,
            longitudinal: command.acceleration - other.acceleration,
        }
    }
}

/// Compares the commands of both systems and decides the stage.
#[derive(Clone, Debug)]
pub(super) struct Agreement {
    stage: Stage,
    lateral: Excess,
    longitudinal: Excess,
    /// The phase of this system, and the time from which the systems can be compared in it.
    phase: Option<Phase>,
    since: Option<Instant>,
    disagreed: Instant,
    absent: u8,
    /// Successive reports of the other system with [`Stage::Unresolved`].
    reports: u8,
    /// The largest share of a limit that was traced, in tenths.
    worst_tenths: u8,
}

/// A change to trace: the stage, and the share of the limits that is used, %.
pub(super) type Change = (Stage, u8);

impl Agreement {
    pub(super) const fn new() -> Self {
        Self {
            stage: Stage::Agreed,
            lateral: Excess { up: 0.0, down: 0.0 },
            longitudinal: Excess { up: 0.0, down: 0.0 },
            phase: None,
            since: None,
            disagreed: Instant::ORIGIN,
            absent: 0,
            reports: 0,
            worst_tenths: 0,
        }
    }

    pub(super) const fn stage(&self) -> Stage {
        self.stage
    }

    /// Returns whether this system has run its functions for long enough for its command to count.
    pub(super) fn is_warm(&self, now: Instant) -> bool {
        self.since.is_some_and(|since| now.since(since) >= WARM_UP)
    }

    /// Takes the result of one control cycle in this phase; `None` if there was nothing to compare.
    /// Must be called every 10 ms.
    pub(super) fn cycle(
        &mut self,
        now: Instant,
        phase: Phase,
        deviation: Option<Deviation>,
    ) -> Option<Change> {
        if self.phase.replace(phase) != Some(phase) {
            // After a takeover the command still moves from the other system's to this system's.
            self.forget();
        }
        let Some(deviation) = deviation else {
            self.absent = self.absent.saturating_add(1);
            return (self.absent == ABSENT_CYCLES)
                .then(|| self.forget())
                .flatten();
        };
        self.absent = 0;
        self.since.get_or_insert(now);
        if !self.is_warm(now) {
            return None;
        }
        let used = self
            .lateral
            .add(deviation.lateral, &LATERAL)
            .max(self.longitudinal.add(deviation.longitudinal, &LONGITUDINAL));
        let percent = (used * 100.0) as u8;
        let stage = match self.stage {
            Stage::Agreed if used >= 1.0 => {
                self.disagreed = now;
                Stage::Disagreed
            }
            Stage::Disagreed if used == 0.0 => Stage::Agreed,
            Stage::Disagreed if now.since(self.disagreed) >= RESOLVE => Stage::Unresolved,
            stage => stage,
        };
        let is_worst = percent / 10 > self.worst_tenths;
        self.worst_tenths = self.worst_tenths.max(percent / 10);
        let is_new = stage != self.stage;
        self.stage = stage;
        (is_new || is_worst).then_some((stage, percent))
    }

    /// Takes the stage that the other system reports. Either system may ask for the stop: neither
    /// can judge the reasons of the other.
    pub(super) fn on_stage_of_peer(&mut self, stage: Stage) -> Option<Change> {
        self.reports = if stage == Stage::Unresolved {
            self.reports.saturating_add(1)
        } else {
            0
        };
        if self.reports < UNRESOLVED_REPORTS || self.stage == Stage::Unresolved {
            return None;
        }
        self.stage = Stage::Unresolved;
        Some((self.stage, 100))
    }

    /// Called when there is no other system to compare with. A requested stop remains in force.
    fn forget(&mut self) -> Option<Change> {
        let ends = self.stage == Stage::Disagreed;
        *self = Self {
            stage: if ends { Stage::Agreed } else { self.stage },
            absent: self.absent,
            phase: self.phase,
            worst_tenths: self.worst_tenths,
            ..Self::new()
        };
        ends.then_some((Stage::Agreed, 0))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::vec::Vec;

    const SPEED: f32 = 25.0;

    fn at(cycle: u64) -> Instant {
        Instant::from_ns(cycle * 10_000_000)
    }

    /// Returns the deviation of commands whose accelerations differ by these values, m/s².
    fn apart(lateral: f32, longitudinal: f32) -> Option<Deviation> {
        let command = Command {
            steering_angle: lateral / SPEED / SPEED * WHEELBASE_M,
            acceleration: longitudinal,
        };
        Some(Deviation::of(&command, &Command::default(), SPEED))
    }

    /// Runs cycles from the end of the warm-up. Returns the cycle in which each stage began.
    fn stages(deviations: impl Iterator<Item = Option<Deviation>>) -> Vec<(u64, Stage)> {
        let mut agreement = Agreement::new();
        for cycle in 0..100 {
            assert_eq!(
                agreement.cycle(at(cycle), Phase::Standby, apart(9.0, 9.0)),
                None
            );
        }
        let mut stages: Vec<(u64, Stage)> = Vec::new();
        for (cycle, deviation) in deviations.enumerate() {
            let cycle = cycle as u64;
            let change = agreement.cycle(at(100 + cycle), Phase::Standby, deviation);
            let before = stages.last().map_or(Stage::Agreed, |(_, stage)| *stage);
            if agreement.stage() != before {
                assert_eq!(change.map(|(stage, _)| stage), Some(agreement.stage()));
                stages.push((cycle, agreement.stage()));
            }
        }
        stages
    }

    /// T-RED-9: one opinion, however wrong, is not a disagreement.
    #[test]
    fn one_wrong_opinion_is_no_disagreement() {
        for wrong in [
            apart(300.0, 20.0),
            apart(-300.0, -20.0),
            apart(f32::NAN, f32::NAN),
        ] {
            let after = (0..200).map(|_| apart(0.2, 0.5));
            assert_eq!(stages([wrong].into_iter().chain(after)), []);
        }
    }

    /// T-RED-9: a tolerated difference never adds up. A larger one, of either sign, is reported;
    /// the larger it is, the sooner. It leads to a stop if no system leaves.
    #[test]
    fn a_difference_that_lasts_is_told_and_then_stops_the_vehicle() {
        use Stage::{Disagreed, Unresolved};
        let always = |lateral, longitudinal| (0..1000).map(move |_| apart(lateral, longitudinal));
        assert_eq!(stages(always(0.39, 1.49)), []);
        for sign in [-1.0, 1.0] {
            let stuck = stages(always(sign * 2.4, 0.0));
            assert_eq!(stuck, [(5, Disagreed), (35, Unresolved)]);
            let brakes = stages(always(0.0, sign * 6.6));
            assert_eq!(brakes, [(78, Disagreed), (108, Unresolved)]);
        }
        let no_number = stages(always(f32::NAN, 0.0));
        assert_eq!(no_number, [(1, Disagreed), (31, Unresolved)]);
    }

    /// T-RED-9: a disagreement ends when the systems agree again or one has left; a stop remains.
    #[test]
    fn a_disagreement_ends_with_its_cause_and_a_stop_does_not() {
        use Stage::{Agreed, Disagreed, Unresolved};
        let short = (0..100).map(|cycle| apart(if cycle < 4 { 3.0 } else { 0.0 }, 0.0));
        assert_eq!(stages(short), [(3, Disagreed), (28, Agreed)]);
        let left = |from| (0..100).map(move |cycle| (cycle < from).then(|| apart(3.0, 0.0))?);
        assert_eq!(stages(left(15)), [(3, Disagreed), (24, Agreed)]);
        assert_eq!(stages(left(50)), [(3, Disagreed), (33, Unresolved)]);
    }

    /// T-RED-9: the other system may ask for the stop, if it does so repeatedly.
    #[test]
    fn the_other_system_may_ask_for_the_stop() {
        let mut agreement = Agreement::new();
        for stage in [Stage::Unresolved, Stage::Unresolved, Stage::Disagreed] {
            assert_eq!(agreement.on_stage_of_peer(stage), None);
        }
        let changes: Vec<_> = (0..4)
            .filter_map(|_| agreement.on_stage_of_peer(Stage::Unresolved))
            .collect();
        assert_eq!(changes, [(Stage::Unresolved, 100)]);
        assert_eq!(agreement.stage(), Stage::Unresolved);
    }
}
