//! Thresholds, each with its reason, and the bounds that follow from them.

use tandem_board::{Duration, SystemId};

/// While a control frame is overdue, the vehicle tells this often which term it obeys. It begins at
/// the shortest third witness's limit of any profile.
pub(crate) const OVERDUE_ECHO: Duration = Duration::from_ms(1);

/// Periods and limits of the redundancy. Both systems must use the same.
///
/// [`Config::chip`], [`Config::rt`] and [`Config::desktop`] are the profiles; [`Config::check`]
/// says whether changed values still fit together.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Config {
    /// Time between two heartbeats on each line.
    pub heartbeat_period: Duration,
    /// How many heartbeats in a row must be missing before a line counts as silent.
    pub heartbeat_misses: u32,
    /// How much later than due a heartbeat may come on top of that: lateness of the sender's timer
    /// and of the receiver's poll.
    pub heartbeat_jitter: Duration,
    /// Longest time between two polls while the system runs as it should.
    pub poll_interval: Duration,
    /// After how long a silence of both lines the *master* gives up its standby. Losing the
    /// standby is not urgent: nothing is missing on the bus. May be longer than
    /// [`Config::silent_limit`].
    pub standby_limit: Duration,
    /// Period of the control frames.
    pub control_period: Duration,
    /// How much later than due a control frame may come: lateness of its sender, time on the bus.
    pub control_margin: Duration,
    /// For how many control periods the vehicle may be unheard before its word is out of date, and
    /// before this system counts as deaf. Without a vehicle that tells, a master whose control
    /// frames are missing for as long is mute.
    pub mute_periods: u32,
    /// Time between two handshake edges.
    pub handshake_period: Duration,
    /// How long a system waits at power-on for the other's handshake.
    pub start_limit: Duration,
    /// How much longer B waits than A wherever both might act at once. Long enough to hear the
    /// other.
    pub stagger: Duration,
    /// How much longer B waits before its sync edge, so that A's comes first if both claim to be
    /// master.
    pub sync_stagger: Duration,
    /// How long a standby that has heard a handshake waits for the sync edge before it takes the
    /// lead itself. B waits twice as long.
    pub promote_limit: Duration,
    /// How long heartbeats must have been back before the other system counts as recovered.
    pub recover_after: Duration,
    /// Whether dual operation resumes at run time when the other system has recovered; else at the
    /// next power cycle, as in the thesis.
    pub reintegrate: bool,
    /// How many abnormal resets in a row are tolerated.
    pub abnormal_limit: u8,
    /// Operation without a reset for this long takes one from the count of abnormal resets.
    pub healthy_after: Duration,
    /// Nothing heard on CAN for this long, while the other system reports a live bus, is an open
    /// circuit.
    pub can_open_limit: Duration,
    /// Time between two reports over the link.
    pub report_period: Duration,
    /// How long a report of the other system holds.
    pub report_limit: Duration,
    /// Without a status frame of the standby on CAN for this long, a master has no backup.
    pub status_limit: Duration,
    /// After a change of the driver, a system that has become standby takes over only on the
    /// vehicle's word for this long. Doubles with every further change.
    pub hold_down: Duration,
}

impl Config {
    /// For systems whose timers are late by far less than a millisecond: firmware, and processes
    /// under SCHED_FIFO (p99.9 of lateness 0.2 ms).
    #[must_use]
    pub const fn rt() -> Self {
        Self {
            heartbeat_period: Duration::from_ms(1),
            // Not a question of lost edges but of stalls: a virtual machine's CPU is taken away for
            // some milliseconds now and then (seen: up to 6), and that is no failure. As lax as a
            // takeover within two control periods permits; losing power is told at once by the
            // level line.
            heartbeat_misses: 6,
            heartbeat_jitter: Duration::from_ms(2),
            poll_interval: Duration::from_ms(1),
            standby_limit: Duration::from_ms(8),
            control_period: Duration::from_ms(10),
            // 1 ms for the bus, 1 ms for the poll of the receiver, and the same stalls.
            control_margin: Duration::from_ms(7),
            // One frame may be lost to a bit error; two in a row are a fault.
            mute_periods: 2,
            handshake_period: Duration::from_ms(5),
            // As long as the other may take to bring up its cores 1 and 2 and its sensors (2 s),
            // before its first handshake. One without power is known at once by its level.
            start_limit: Duration::from_ms(2500),
            stagger: Duration::from_ms(20),
            sync_stagger: Duration::from_ms(5),
            promote_limit: Duration::from_ms(20),
            recover_after: Duration::from_ms(1000),
            reintegrate: false,
            abnormal_limit: 3,
            // A system that crashes once a minute is worth a repair, not a suspension.
            healthy_after: Duration::from_ms(60_000),
            // The frames of the vehicle come every 10 ms; a pause of 25 of them is no regular one.
            // Every failed attempt doubles it: a loose connector gets seconds to come back.
            can_open_limit: Duration::from_ms(250),
            // Once a control cycle.
            report_period: Duration::from_ms(10),
            report_limit: Duration::from_ms(100),
            // Status frames come every 100 ms, so two may be lost in a row.
            status_limit: Duration::from_ms(350),
            // Ten control periods: what led to the change has ended, or the vehicle says so.
            hold_down: Duration::from_ms(100),
        }
    }

    /// For chips: nothing stalls, and the link tells as often as the heartbeat lines.
    #[must_use]
    pub const fn chip() -> Self {
        Self {
            // 1 ms for the phases of sender and poll. Three wires must end within this time: both
            // heartbeat lines and the link.
            heartbeat_misses: 2,
            heartbeat_jitter: Duration::from_ms(1),
            // A frame is at most 0.2 ms late and 0.3 ms on the bus.
            control_margin: Duration::from_ms(1),
            report_period: Duration::from_ms(1),
            ..Self::rt()
        }
    }

    /// For ordinary processes on a desktop, whose timers are late by some milliseconds at p99.9.
    ///
    /// As lax as a takeover within two control periods permits: a heartbeat limit of 12 ms would be
    /// calmer, but 10 ms (control period) + 12 ms misses the goal of 20 ms. It is safe all the
    /// same, because a takeover on silence also needs the control frames to be missing.
    #[must_use]
    pub const fn desktop() -> Self {
        Self {
            heartbeat_period: Duration::from_ms(2),
            // The same 8 ms of silence as in real time, at half the cost.
            heartbeat_misses: 3,
            // Under load a standby process is held up for tens of milliseconds now and then;
            // degrading for that would be a false alarm, and nothing is lost by waiting.
            standby_limit: Duration::from_ms(50),
            handshake_period: Duration::from_ms(10),
            start_limit: Duration::from_ms(4500),
            stagger: Duration::from_ms(60),
            sync_stagger: Duration::from_ms(20),
            promote_limit: Duration::from_ms(60),
            ..Self::rt()
        }
    }

    /// A line without an edge for longer than this is silent: misses × period + jitter.
    #[must_use]
    pub fn silent_limit(&self) -> Duration {
        self.heartbeat_period.times(self.heartbeat_misses) + self.heartbeat_jitter
    }

    /// A power level that is low for this long, without a heartbeat, says that the other system is
    /// off. One heartbeat and one poll: a heartbeat of a system that lives would have come. The
    /// level alone is one wire, and must not overrule two witnesses that say otherwise.
    #[must_use]
    pub fn level_limit(&self) -> Duration {
        self.heartbeat_period + self.poll_interval
    }

    /// A link without a report for longer than this is silent. A witness that the master is dead if
    /// both heartbeat lines ended with it. Counts where it is shorter than the third witness's
    /// limit.
    #[must_use]
    pub fn link_limit(&self) -> Duration {
        self.report_period.times(self.heartbeat_misses) + self.heartbeat_jitter
    }

    /// No control frame for longer than this is the third witness's word that nobody drives.
    #[must_use]
    pub fn witness_limit(&self) -> Duration {
        self.control_period + self.control_margin
    }

    /// The vehicle's word holds for this long, and so does the silence of all third parties before
    /// this system counts as deaf.
    #[must_use]
    pub fn mute_limit(&self) -> Duration {
        self.control_period.times(self.mute_periods) + self.control_margin
    }

    /// How long a new standby waits for the first control frame of its master: longer than any
    /// takeover that may be under way, and B longer than A.
    #[must_use]
    pub fn no_master_limit(&self, system: SystemId) -> Duration {
        self.mute_limit().times(2) + self.stagger_of(system)
    }

    /// How long a system without a handshake to wait for listens for a running master.
    #[must_use]
    pub fn listen_limit(&self, system: SystemId) -> Duration {
        let longer = if self.silent_limit() > self.witness_limit() {
            self.silent_limit()
        } else {
            self.witness_limit()
        };
        longer + self.stagger_of(system)
    }

    /// The time after a poll for which a master may transmit without the next poll.
    ///
    /// The other system takes over no earlier than [`Config::silent_limit`] after the last
    /// heartbeat, and that was sent at most one period before the last poll.
    #[must_use]
    pub fn lease(&self) -> Duration {
        self.silent_limit() - self.heartbeat_period
    }

    /// The longest time between two polls that still counts as running; beyond it the system was
    /// held up, and its own absence is no evidence against the other.
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

    /// From the failure of a master to the takeover, by silence of heartbeats, and of control
    /// frames or the link.
    #[must_use]
    pub fn takeover_bound(&self) -> Duration {
        let third = self.witness_limit().min(self.link_limit());
        self.silent_limit().max(third) + self.poll_interval
    }

    /// From the last control frame of a failed master to the first one of its successor, as both
    /// leave their systems, if the power level did not tell: the master fails just before a frame
    /// is due.
    #[must_use]
    pub fn gap_bound(&self) -> Duration {
        let third = self
            .witness_limit()
            .min(self.control_period + self.link_limit());
        (self.control_period + self.silent_limit()).max(third) + self.poll_interval
    }

    /// The same if the power level falls.
    #[must_use]
    pub fn gap_bound_power(&self) -> Duration {
        self.control_period + self.level_limit() + self.poll_interval
    }

    /// The same if the master is alive but cannot transmit. The vehicle's word decides: the first
    /// echo that tells of no frame for the third witness's limit. While a frame is overdue, an echo
    /// comes every millisecond.
    #[must_use]
    pub fn gap_bound_mute(&self) -> Duration {
        self.witness_limit() + OVERDUE_ECHO + self.poll_interval
    }

    /// Whether the values fit together: what each limit presumes of the others.
    #[must_use]
    pub fn check(&self) -> bool {
        let hears_other = self.heartbeat_period.times(4) + self.poll_interval.times(2);
        self.heartbeat_misses >= 2
            && self.poll_interval <= self.heartbeat_period
            && self.standby_limit >= self.silent_limit()
            && self.lease() < self.witness_limit()
            && self.lease() >= self.poll_interval
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

    /// T-RED-8: where nothing stalls, the times of the thesis hold without the level line too.
    #[test]
    fn a_chip_keeps_the_times_of_the_thesis() {
        let (chip, ms) = (Config::chip(), Duration::from_ms);
        assert_eq!(chip.takeover_bound(), ms(4));
        assert_eq!(chip.gap_bound(), ms(14));
        assert_eq!(chip.level_limit() + chip.poll_interval, ms(3));
        assert_eq!(chip.gap_bound_power(), ms(13));
        assert_eq!(chip.gap_bound_mute(), ms(13));
        assert_eq!(Config::rt().gap_bound_mute(), ms(19));
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

    #[test]
    fn check_refuses_limits_that_do_not_fit() {
        let rt = Config::rt();
        assert!(
            !Config {
                heartbeat_misses: 1,
                ..rt
            }
            .check()
        );
        assert!(
            !Config {
                stagger: Duration::from_ms(1),
                ..rt
            }
            .check()
        );
        assert!(
            !Config {
                poll_interval: Duration::from_ms(5),
                ..rt
            }
            .check()
        );
        assert!(
            !Config {
                standby_limit: Duration::from_ms(1),
                ..rt
            }
            .check()
        );
    }
}
