//! Thresholds with their reasons, and the bounds that follow from them.

use tandem_board::{Duration, ResetCause, SystemId};

/// Time between two echoes of the vehicle while a control frame is overdue. The first such echo is
/// sent when the shortest limit of the third witness in any profile ends.
pub(crate) const OVERDUE_ECHO: Duration = Duration::from_ms(1);

/// The hold-down stops growing after this many changes of the driver, at 32 times the first.
const MAX_CHANGES: u8 = 6;

/// Periods and limits of the redundancy. Both systems must use the same values.
///
/// [`Config::chip`], [`Config::rt`] and [`Config::desktop`] are the profiles; [`Config::check`]
/// checks whether changed values fit together.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Config {
    /// Time between two heartbeats on each line.
    pub heartbeat_period: Duration,
    /// How many heartbeats in a row must be missing before a line counts as silent.
    pub heartbeat_misses: u32,
    /// How late a heartbeat may arrive in addition: lateness of the sender's timer and of the
    /// receiver's poll.
    pub heartbeat_jitter: Duration,
    /// Longest time between two polls in normal operation.
    pub poll_interval: Duration,
    /// The *master* gives up its standby when both lines are silent for this long. This is not
    /// urgent, because control frames continue. May be longer than [`Config::silent_limit`].
    pub standby_limit: Duration,
    /// Period of the control frames.
    pub control_period: Duration,
    /// How late a control frame may arrive: lateness of its sender, time on the bus.
    pub control_margin: Duration,
    /// The number of control periods without a frame from the vehicle after which its last echo is
    /// out of date and this system counts as deaf. If the vehicle sends no echo, a master whose
    /// control frames are missing for this long is mute.
    pub mute_periods: u32,
    /// Time between two handshake edges.
    pub handshake_period: Duration,
    /// How long a system waits at power-on for the other system's handshake.
    pub start_limit: Duration,
    /// How much longer B waits than A wherever both might act at the same time. This is long enough
    /// for B to hear A.
    pub stagger: Duration,
    /// How much longer B waits before its sync edge, so that A's comes first if both claim to be
    /// master.
    pub sync_stagger: Duration,
    /// How long a standby that has heard a handshake waits for the sync edge before it takes the
    /// lead. B waits twice as long.
    pub promote_limit: Duration,
    /// How long heartbeats must have arrived again before the other system counts as recovered.
    pub recover_after: Duration,
    /// Whether dual operation resumes at run time when the other system has recovered. Otherwise it
    /// resumes at the next power cycle, as in the thesis.
    pub reintegrate: bool,
    /// The largest tolerated count of abnormal resets; see [`Config::healthy_after`].
    pub abnormal_limit: u8,
    /// Each period of this length without a reset subtracts one from the count of abnormal resets.
    pub healthy_after: Duration,
    /// If no frame is received on CAN for this long, while the other system reports a live bus,
    /// this system's CAN connection is an open circuit.
    pub can_open_limit: Duration,
    /// Time between two reports over the link.
    pub report_period: Duration,
    /// How long a report of the other system is valid.
    pub report_limit: Duration,
    /// Without a status frame of the standby on CAN for this long, a master has no backup.
    pub status_limit: Duration,
    /// For this long after the first change of the driver, a system that has become standby takes
    /// over only if the vehicle's echo demands it; see [`Config::hold_down_after`].
    pub hold_down: Duration,
}

impl Config {
    /// A line without an edge for longer than this is silent: misses × period + jitter.
    #[must_use]
    pub fn silent_limit(&self) -> Duration {
        self.heartbeat_period.times(self.heartbeat_misses) + self.heartbeat_jitter
    }

    /// A power level that is low for this long, without a heartbeat, means that the other system is
    /// off: a running system would have sent a heartbeat, seen at most one poll later. The level is
    /// only one wire, and must not overrule two other witnesses.
    #[must_use]
    pub fn level_limit(&self) -> Duration {
        self.heartbeat_period + self.heartbeat_jitter.min(self.poll_interval)
    }

    /// A link without a report for longer than this is silent. If both heartbeat lines fell silent
    /// with it, the master has failed. This limit is used only if it is shorter than the third
    /// witness's limit.
    #[must_use]
    pub fn link_limit(&self) -> Duration {
        self.report_period.times(self.heartbeat_misses) + self.heartbeat_jitter
    }

    /// After this time without a control frame, the third witness reports that no system drives.
    #[must_use]
    pub fn witness_limit(&self) -> Duration {
        self.control_period + self.control_margin
    }

    /// How long the vehicle's echo is valid, and how long all third parties must be silent before
    /// this system counts as deaf.
    #[must_use]
    pub fn mute_limit(&self) -> Duration {
        self.control_period.times(self.mute_periods) + self.control_margin
    }

    /// How long a master that hears nothing on CAN may transmit after the other system has taken
    /// over. It learns of the takeover only over the link, and accepts the report after
    /// [`Config::mute_limit`]. Until then the vehicle refuses its frames.
    #[must_use]
    pub fn deaf_hand_over(&self) -> Duration {
        let reports = self
            .mute_limit()
            .as_ns()
            .div_ceil(self.report_period.as_ns()) as u32;
        self.report_period.times(1 + reports) + self.control_period + self.poll_interval
    }

    /// Returns the number of changes of the driver that a starting system assumes. Before a reset
    /// the driver may have changed, and the system no longer has a record of that.
    #[must_use]
    pub fn changes_at_start(cause: ResetCause) -> u8 {
        u8::from(cause != ResetCause::PowerOn)
    }

    /// Returns the number of consecutive changes of the driver after one more change. `ago` is the
    /// time between the last two. See [`Phase::changes_driver`].
    ///
    /// [`Phase::changes_driver`]: crate::Phase::changes_driver
    #[must_use]
    pub fn changes_after(&self, changes: u8, ago: Duration) -> u8 {
        if ago >= self.healthy_after {
            1
        } else {
            changes.saturating_add(1)
        }
    }

    /// Returns the time for which a new standby takes over only if the vehicle's echo demands it.
    /// `changes` is the result of [`Config::changes_after`]. The time doubles with each further
    /// change, up to 32 times the first; without a change there is no hold-down.
    #[must_use]
    pub fn hold_down_after(&self, changes: u8) -> Duration {
        match changes.min(MAX_CHANGES) {
            0 => Duration::ZERO,
            changes => self.hold_down.times(1 << (changes - 1)),
        }
    }

    /// Returns how long a new standby waits for the first control frame of its master: longer than
    /// any possible takeover, and for B longer than for A.
    #[must_use]
    pub fn no_master_limit(&self, system: SystemId) -> Duration {
        self.mute_limit().times(2) + self.stagger_of(system)
    }

    /// Returns how long a system that expects no handshake listens for a running master.
    #[must_use]
    pub fn listen_limit(&self, system: SystemId) -> Duration {
        self.silent_limit().max(self.witness_limit()) + self.stagger_of(system)
    }

    /// The time after a poll for which a master may transmit without the next poll.
    ///
    /// The other system takes over no earlier than [`Config::silent_limit`] after the last
    /// heartbeat. The master sent that heartbeat at most one period before its last poll.
    #[must_use]
    pub fn lease(&self) -> Duration {
        self.silent_limit() - self.heartbeat_period
    }

    /// The longest time between two polls of a running system. If the time is longer, the system
    /// was held up, and silence in that time is not evidence against the other system.
    #[must_use]
    pub fn stall_limit(&self) -> Duration {
        self.poll_interval + self.heartbeat_jitter
    }

    /// Detection bound: from the failure of the other system to the poll that sees both lines
    /// silent. Misses × period + jitter + poll interval.
    #[must_use]
    pub fn detection_bound(&self) -> Duration {
        self.silent_limit() + self.poll_interval
    }

    /// Time from the failure of a master to the takeover, if its heartbeats end, and its control
    /// frames or its link reports end too.
    #[must_use]
    pub fn takeover_bound(&self) -> Duration {
        let third = self.witness_limit().min(self.link_limit());
        self.silent_limit().max(third) + self.poll_interval
    }

    /// Time from the last control frame of a failed master to the first one of the new master, if
    /// the power level did not show the failure. Both times are those of sending. In the worst case
    /// the master fails just before a frame is due.
    #[must_use]
    pub fn gap_bound(&self) -> Duration {
        let third = self
            .witness_limit()
            .min(self.control_period + self.link_limit());
        (self.control_period + self.silent_limit()).max(third) + self.poll_interval
    }

    /// The bound of the gap if the power level falls.
    #[must_use]
    pub fn gap_bound_power(&self) -> Duration {
        self.control_period + self.level_limit() + self.poll_interval
    }

    /// The bound of the gap if the master runs but cannot transmit. The standby takes over at the
    /// first echo that reports no frame for the third witness's limit. While a frame is overdue, an
    /// echo is sent every millisecond.
    #[must_use]
    pub fn gap_bound_mute(&self) -> Duration {
        self.witness_limit() + OVERDUE_ECHO + self.poll_interval
    }

    /// Returns whether the values fit together: each limit makes assumptions about the others.
    #[must_use]
    pub fn check(&self) -> bool {
        let hears_other = self.heartbeat_period.times(4) + self.poll_interval.times(2);
        self.heartbeat_misses >= 2
            && self.poll_interval <= self.heartbeat_period
            && self.standby_limit >= self.silent_limit()
            && self.lease() < self.witness_limit()
            && self.stagger >= hears_other
            && self.sync_stagger >= self.poll_interval.times(4)
            && self.promote_limit > self.sync_stagger + self.poll_interval.times(2)
            && self.can_open_limit > self.mute_limit()
            && self.status_limit > self.mute_limit()
            && self.report_limit > self.link_limit()
            && self.hold_down > self.mute_limit()
            && self.abnormal_limit > 0
    }

    pub(crate) fn stagger_of(&self, system: SystemId) -> Duration {
        self.stagger.times(system.index() as u32)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// T-RED-8: if nothing stalls, the times of the thesis also hold without the level line. They
    /// include the execution up to the first control frame.
    #[test]
    fn a_chip_keeps_the_times_of_the_thesis() {
        let (chip, ms) = (Config::chip(), Duration::from_ms);
        let execution = Duration::from_us(200);
        assert_eq!(chip.takeover_bound() + execution, ms(4));
        assert_eq!(chip.gap_bound() + execution, ms(14));
        assert_eq!(chip.level_limit() + chip.poll_interval + execution, ms(3));
        assert_eq!(chip.gap_bound_power() + execution, ms(13));
        assert_eq!(chip.gap_bound_mute(), ms(13));
        assert_eq!(Config::rt().gap_bound_mute(), ms(19));
        assert_eq!(Config::rt().deaf_hand_over(), ms(51));
    }

    /// T-RED-8: all profiles keep the gap at a takeover below two control periods.
    #[test]
    fn profiles_fit_together_and_keep_the_gap_below_20_ms() {
        for config in [Config::chip(), Config::rt(), Config::desktop()] {
            assert!(config.check());
            assert!(
                config.gap_bound() < Duration::from_ms(20),
                "{:?}",
                config.gap_bound()
            );
            assert!(config.gap_bound_power() < Duration::from_ms(20));
        }
    }

    /// T-RED-2: two systems never act at the same time: B waits longer than A, by the stagger. The
    /// slower of two witnesses determines how long they listen.
    #[test]
    fn b_waits_longer_than_a_by_the_stagger() {
        let (rt, ms) = (Config::rt(), Duration::from_ms);
        let slow_beats = Config {
            heartbeat_period: ms(10),
            ..rt
        };
        for (config, limits) in [(rt, [17, 54]), (slow_beats, [62, 54])] {
            for (system, more) in [(SystemId::A, 0), (SystemId::B, 20)] {
                let found = [config.listen_limit(system), config.no_master_limit(system)];
                assert_eq!(found, limits.map(|limit| ms(limit + more)), "{system:?}");
            }
        }
    }

    /// T-RED-8: after the failure of a master, the gap ends when both lines are silent and either
    /// the control frames are overdue or the link is silent.
    #[test]
    fn the_slowest_witness_that_is_needed_bounds_the_gap() {
        let (rt, ms) = (Config::rt(), Duration::from_ms);
        for (margin_ms, report_ms, takeover_ms, gap_ms) in [
            // Lines 8 ms, third witness 17 ms, link 62 ms.
            (7, 10, 18, 19),
            (20, 10, 31, 31),
            // Link 14 ms.
            (20, 2, 15, 25),
            (20, 1, 9, 19),
        ] {
            let config = Config {
                control_margin: ms(margin_ms),
                report_period: ms(report_ms),
                ..rt
            };
            let bounds = [config.takeover_bound(), config.gap_bound()];
            assert_eq!(
                bounds,
                [takeover_ms, gap_ms].map(ms),
                "{margin_ms} {report_ms}"
            );
        }
    }

    /// A limit is permitted up to its bound; one nanosecond (or one count) more is refused.
    #[test]
    fn check_refuses_limits_that_do_not_fit() {
        let (rt, ms, ns) = (Config::rt(), Duration::from_ms, Duration::from_ns(1));
        let slow = Config {
            standby_limit: ms(18),
            ..rt
        };
        macro_rules! bound {
            ($base:ident, $field:ident, $good:expr, $bad:expr) => {{
                let with = |$field| Config { $field, ..$base }.check();
                (stringify!($field), with($good), with($bad))
            }};
        }
        let (silent, mute) = (rt.silent_limit(), rt.mute_limit());
        let lead = rt.sync_stagger + rt.poll_interval.times(2);
        for result in [
            bound!(rt, heartbeat_misses, 2, 1),
            bound!(rt, poll_interval, rt.heartbeat_period, ms(1) + ns),
            bound!(rt, standby_limit, silent, silent - ns),
            // The lease is below the third witness's limit, 17 ms.
            bound!(slow, heartbeat_jitter, ms(12) - ns, ms(12)),
            bound!(rt, stagger, ms(6), ms(6) - ns),
            bound!(rt, sync_stagger, ms(4), ms(4) - ns),
            bound!(rt, promote_limit, lead + ns, lead),
            bound!(rt, can_open_limit, mute + ns, mute),
            bound!(rt, status_limit, mute + ns, mute),
            bound!(rt, report_limit, rt.link_limit() + ns, rt.link_limit()),
            bound!(rt, hold_down, mute + ns, mute),
            bound!(rt, abnormal_limit, 1, 0),
        ] {
            assert_eq!((result.1, result.2), (true, false), "{}", result.0);
        }
    }

    #[test]
    fn the_hold_down_grows_with_changes_that_follow_each_other() {
        let rt = Config::rt();
        let long = rt.healthy_after;
        assert_eq!(rt.changes_after(3, long - Duration::from_ns(1)), 4);
        assert_eq!(rt.changes_after(3, long), 1);
        assert_eq!(rt.changes_after(u8::MAX, Duration::ZERO), u8::MAX);
        let hold_downs =
            [0, 1, 2, 3, 6, 7, u8::MAX].map(|changes| rt.hold_down_after(changes).as_us() / 1_000);
        assert_eq!(hold_downs, [0, 100, 200, 400, 3200, 3200, 3200]);
    }
}
