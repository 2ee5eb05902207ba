//! The longest times without control that the requirement permits, for each timing profile.
//!
//! T-RED-8: a takeover ends before the second control frame is missed. These limits belong to the
//! judge: they do not follow from the limits of the judged product, which are compared with them
//! ([`Limits::exceeded_by`]).

use tandem_board::Duration;
use tandem_redundancy::Config;

const MS: Duration = Duration::from_ms(1);
/// Time between two control frames.
pub const CONTROL_PERIOD: Duration = Duration::from_ms(10);
/// The gap at a takeover must be shorter than this: two control periods.
const TAKEOVER_GOAL: Duration = Duration::from_ms(20);
/// Longest time between two polls of a system.
pub const POLL: Duration = MS;
/// The longest permitted silence of a line: the goal, minus the control period since the last
/// frame, a poll, and 1 ms of margin.
const LINE_MOST: Duration = Duration::from_ms(8);
/// The longest permitted wait of the third witness: the goal, minus an echo, a poll and 1 ms.
const THIRD_MOST: Duration = Duration::from_ms(17);
/// The wait of the third witness if nothing stalls: a control period, and 1 ms on the bus.
const THIRD_LEAST: Duration = Duration::from_ms(11);

/// The needs of a profile. All limits follow from them and from the goal.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Limits {
    /// Name of the profile.
    pub profile: &'static str,
    /// The time of two heartbeats plus their lateness when nothing stalls.
    beats: Duration,
    /// How long the power level must be low, without a heartbeat, before the standby acts on it.
    level: Duration,
    /// How long a master that hears nothing on CAN may transmit after it was replaced.
    pub deaf_hand_over: Duration,
    /// The longest time for which a core that is due does not run, although nothing has failed.
    stall: Duration,
}

impl Limits {
    /// Chips, on which nothing stalls.
    pub const CHIP: Self = Self {
        profile: "chip",
        beats: Duration::from_us(2_800),
        level: Duration::from_us(1_800),
        deaf_hand_over: Duration::from_ms(33),
        stall: Duration::ZERO,
    };
    /// Processes under SCHED_FIFO.
    pub const RT: Self = Self {
        profile: "rt",
        beats: Duration::from_ms(3),
        level: Duration::from_ms(2),
        deaf_hand_over: Duration::from_ms(51),
        stall: Duration::from_ms(6),
    };
    /// Ordinary processes.
    pub const DESKTOP: Self = Self {
        profile: "desktop",
        beats: Duration::from_ms(5),
        level: Duration::from_ms(3),
        stall: Duration::from_ms(46),
        ..Self::RT
    };
    /// All profiles.
    pub const ALL: [Self; 3] = [Self::CHIP, Self::RT, Self::DESKTOP];

    /// Returns the profile of a product. The periods at which its systems communicate determine it.
    #[must_use]
    pub fn of_profile(product: &Config) -> Self {
        match (product.heartbeat_period, product.report_period) {
            (MS, MS) => Self::CHIP,
            (MS, _) => Self::RT,
            _ => Self::DESKTOP,
        }
    }

    /// A change of the driver counts as the first in a row if none preceded it within this time.
    pub const HEALTHY_AFTER: Duration = Duration::from_ms(60_000);

    /// Returns how long a new standby waits for the vehicle's echo after this number of changes of
    /// the driver in a row: 100 ms after the first, doubled by each further change, at most 3.2 s.
    #[must_use]
    pub fn hold_down(changes: u32) -> Duration {
        match changes.min(6) {
            0 => Duration::ZERO,
            changes => Duration::from_ms(100 << (changes - 1)),
        }
    }

    /// Returns the limits on a machine whose stalls last for at most this long.
    #[must_use]
    pub const fn with_stall(self, stall: Duration) -> Self {
        Self { stall, ..self }
    }

    /// Returns the longest stall for which a master must not be replaced.
    #[must_use]
    pub fn tolerated_stall(&self) -> Duration {
        self.stall.min(LINE_MOST - self.beats)
    }

    /// Returns how long both heartbeat lines must be silent before the standby acts.
    fn line(&self) -> Duration {
        self.beats + self.tolerated_stall()
    }

    /// Returns how long control frames must be missing before the third witness reports it.
    fn third(&self) -> Duration {
        (THIRD_LEAST + self.stall).min(THIRD_MOST)
    }

    /// Returns the longest gap when the master falls silent.
    #[must_use]
    pub fn silent(&self) -> Duration {
        CONTROL_PERIOD + self.line() + POLL
    }

    /// Returns the longest gap when the master's power level falls.
    #[must_use]
    pub fn power(&self) -> Duration {
        CONTROL_PERIOD + self.level + POLL
    }

    /// Returns the longest gap when the master runs but its frames do not reach the vehicle. In
    /// such a gap the vehicle repeats its echo each millisecond.
    #[must_use]
    pub fn mute(&self) -> Duration {
        self.third() + MS + POLL
    }

    /// Returns the longest gap at any takeover.
    #[must_use]
    pub fn longest(&self) -> Duration {
        self.silent().max(self.mute())
    }

    /// If the heartbeats were silent for this long when the level fell, the bound for silence
    /// applies, because the heartbeats cannot confirm the fall.
    #[must_use]
    pub fn silent_before(&self) -> Duration {
        self.line() + self.third()
    }

    /// Returns each limit of the product that permits a longer time than the limit here: its name,
    /// the limit of the product, and the limit here.
    pub fn exceeded_by(
        &self,
        product: &Config,
    ) -> impl Iterator<Item = (&'static str, Duration, Duration)> + use<> {
        let pairs = [
            ("control period", product.control_period, CONTROL_PERIOD),
            ("gap of a silent master", product.gap_bound(), self.silent()),
            (
                "gap of a master without power",
                product.gap_bound_power(),
                self.power(),
            ),
            (
                "gap of a mute master",
                product.gap_bound_mute(),
                self.mute(),
            ),
            (
                "hand-over of a deaf master",
                product.deaf_hand_over(),
                self.deaf_hand_over,
            ),
        ];
        pairs.into_iter().filter(|(_, here, most)| here > most)
    }
}

const _: () = {
    assert!(LINE_MOST.as_ns() + CONTROL_PERIOD.as_ns() + 2 * MS.as_ns() == TAKEOVER_GOAL.as_ns());
    assert!(THIRD_MOST.as_ns() + 3 * MS.as_ns() == TAKEOVER_GOAL.as_ns());
};

#[cfg(test)]
mod tests {
    use super::*;
    use tandem_redundancy::Budget;

    /// T-RED-8: the bounds of the judge are those of the requirement.
    #[test]
    fn the_limits_of_each_profile_are_below_two_control_periods() {
        let us = |limits: Limits| {
            [limits.silent(), limits.power(), limits.mute()].map(|bound| bound.as_us())
        };
        assert_eq!(us(Limits::CHIP), [13_800, 12_800, 13_000]);
        assert_eq!(us(Limits::RT), [19_000, 13_000, 19_000]);
        assert_eq!(us(Limits::DESKTOP), [19_000, 14_000, 19_000]);
        assert!(
            Limits::ALL
                .iter()
                .all(|limits| limits.longest() < TAKEOVER_GOAL)
        );
    }

    /// The product's own limits stay within those of the judge, for every measured stall.
    #[test]
    fn the_limits_of_the_product_are_within_those_of_the_judge() {
        let budgets = [Budget::CHIP, Budget::RT, Budget::DESKTOP];
        for (limits, budget) in Limits::ALL.into_iter().zip(budgets) {
            let found: Vec<_> = limits.exceeded_by(&budget.config()).collect();
            assert_eq!(found, [], "{}", limits.profile);
            assert_eq!(Limits::of_profile(&budget.config()), limits);
            // A chip has no stalls to measure.
            let most_us = if budget == Budget::CHIP { 0 } else { 20_000 };
            for us in (0..most_us).step_by(250) {
                let measured = budget.measured(Duration::from_us(us));
                let limits = limits.with_stall(measured.stall);
                assert_eq!(limits.exceeded_by(&measured.config()).count(), 0, "{us} us");
                assert_eq!(
                    limits.tolerated_stall(),
                    measured.tolerated_stall(),
                    "{us} us"
                );
            }
        }
    }
}
