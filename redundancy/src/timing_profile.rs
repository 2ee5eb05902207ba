//! The time budget from which all limits of a profile follow.
//!
//! A limit is as long as the machine needs, and no longer than the goal permits: a takeover on
//! silence within two control periods.

use crate::config::{Config, OVERDUE_ECHO};
use tandem_board::Duration;

const MS: Duration = Duration::from_ms(1);
const CONTROL_PERIOD: Duration = Duration::from_ms(10);
/// The gap after a failed master's last control frame is shorter than this.
const GOAL: Duration = CONTROL_PERIOD.times(2);
/// The smallest standby limit. Losing the standby is not urgent, because control frames continue.
const STANDBY_LIMIT: Duration = Duration::from_ms(8);
/// The smallest stagger. A shorter difference in time must not decide which system drives.
const STAGGER: Duration = Duration::from_ms(20);
const REPORT_LIMIT: Duration = Duration::from_ms(100);
const SYNC_STAGGER: Duration = Duration::from_ms(5);
/// Longest time from the end of the start of cores 1 and 2 to the first handshake.
const AFTER_BOOT: Duration = Duration::from_ms(500);

/// The timing of a machine: its periods, and how long it stalls.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Budget {
    /// Time between two heartbeats on each line.
    pub heartbeat_period: Duration,
    /// Longest time between two polls in normal operation.
    pub poll_interval: Duration,
    /// Time between two reports over the link.
    pub report_period: Duration,
    /// How late a heartbeat may be seen although nothing stalls: its sender's task runs late, and
    /// the observer polls at another phase.
    pub lateness: Duration,
    /// Time between two handshake edges.
    pub handshake_period: Duration,
    /// How long cores 1 and 2, and the sensors, may take to start.
    pub boot_limit: Duration,
    /// The longest time for which a core does not run although it is due and nothing has failed:
    /// late timers, other processes, a hypervisor.
    pub stall: Duration,
}

impl Budget {
    /// Chips: nothing stalls, and link reports are as frequent as heartbeats.
    pub const CHIP: Self = Self {
        report_period: MS,
        // Timers are exact: the observer polls when the limit ends. This leaves 0.2 ms of the third
        // millisecond for the execution up to the first control frame.
        lateness: Duration::from_us(800),
        stall: Duration::ZERO,
        ..Self::RT
    };

    /// Processes under SCHED_FIFO, whose timers are late by 0.2 ms at p99.9.
    pub const RT: Self = Self {
        heartbeat_period: MS,
        poll_interval: MS,
        // Once a control cycle.
        report_period: CONTROL_PERIOD,
        // One tick of the kernel: waits end at a tick.
        lateness: MS,
        handshake_period: Duration::from_ms(5),
        boot_limit: Duration::from_ms(2_000),
        // A virtual machine sometimes loses its CPU for some milliseconds; 6 ms were observed.
        stall: Duration::from_ms(6),
    };

    /// Ordinary processes on a desktop.
    pub const DESKTOP: Self = Self {
        // The same limits of silence as in `RT`, at half the cost.
        heartbeat_period: Duration::from_ms(2),
        handshake_period: Duration::from_ms(10),
        boot_limit: Duration::from_ms(4_000),
        // Under load a process is sometimes held up for tens of milliseconds.
        stall: Duration::from_ms(46),
        ..Self::RT
    };

    /// Returns this budget with a measured stall, in whole milliseconds. A short measurement misses
    /// the longest stalls, so the measured one counts four times, plus a millisecond.
    #[must_use]
    pub const fn measured(self, longest: Duration) -> Self {
        let ms = longest.as_us().div_ceil(250) + 1;
        Self {
            stall: Duration::from_ms(ms),
            ..self
        }
    }

    /// Returns the limit of silence that the machine needs: two periods, lateness, and stall.
    const fn silence_needed(&self) -> Duration {
        let late = self.lateness.as_ns() + self.stall.as_ns();
        Duration::from_ns(self.heartbeat_period.as_ns() * 2 + late)
    }

    /// Returns the limit of silence that the goal permits: two control periods, minus the control
    /// period since the last frame, the poll, and 1 ms of margin.
    const fn silence_permitted(&self) -> Duration {
        let rest = GOAL.as_ns() - CONTROL_PERIOD.as_ns() - MS.as_ns();
        Duration::from_ns(rest - self.poll_interval.as_ns())
    }

    /// Returns the reason if no limits fit this budget.
    const fn impossible(&self) -> Option<&'static str> {
        let (polls, beats) = (self.poll_interval.as_ns(), self.heartbeat_period.as_ns());
        let needed = beats * 2 + self.lateness.as_ns() + polls + MS.as_ns();
        if polls > beats {
            Some("a budget's polls must not be rarer than its heartbeats")
        } else if needed > GOAL.as_ns() - CONTROL_PERIOD.as_ns() {
            Some("two heartbeats, their lateness, a poll and 1 ms must fit in a control period")
        } else {
            None
        }
    }

    const fn refuse_impossible(&self) {
        if let Some(why) = self.impossible() {
            panic!("{}", why);
        }
    }

    /// Returns the longest stall of the master that does not count as a failure. A longer one only
    /// costs an unnecessary takeover.
    ///
    /// # Panics
    /// The same as [`Budget::config`].
    #[must_use]
    pub const fn tolerated_stall(&self) -> Duration {
        self.refuse_impossible();
        let used = self.silence_needed().as_ns() - self.stall.as_ns();
        let permitted = Duration::from_ns(self.silence_permitted().as_ns() - used);
        shorter(permitted, self.stall)
    }

    /// Returns the limits that follow from this budget. [`Config::check`] accepts them.
    ///
    /// # Panics
    /// If no limits fit: polls are rarer than heartbeats, or even without a stall a takeover on
    /// silence takes longer than two control periods. For a constant, the compiler reports this.
    #[must_use]
    pub const fn config(self) -> Config {
        self.refuse_impossible();
        let silence = shorter(self.silence_needed(), self.silence_permitted());
        // Lateness and a short stall must not count as a missing heartbeat. The rest of the silence
        // is a whole number of heartbeats, at least two.
        let jitter = Duration::from_ns(self.lateness.as_ns() + shorter(self.stall, MS).as_ns());
        let beyond_two = Duration::from_ns(silence.as_ns() - self.heartbeat_period.as_ns() * 2);
        let beats = silence.as_ns() - shorter(jitter, beyond_two).as_ns();
        let misses = beats / self.heartbeat_period.as_ns();
        let jitter = Duration::from_ns(silence.as_ns() - misses * self.heartbeat_period.as_ns());

        // The bus and the poll (1 ms together) and a stall delay a control frame. The standby
        // begins to drive one echo and one poll after its limit, and still meets the goal.
        let margin_needed = Duration::from_ns(MS.as_ns() + self.stall.as_ns());
        let after = self.poll_interval.as_ns() + OVERDUE_ECHO.as_ns() + MS.as_ns();
        let margin_permitted = Duration::from_ns(GOAL.as_ns() - CONTROL_PERIOD.as_ns() - after);

        // A system that waits for the other must have time to hear four of its heartbeats, plus two
        // polls and a stall.
        let heard = self.heartbeat_period.as_ns() * 4 + self.poll_interval.as_ns() * 2;
        let tens = (heard + self.stall.as_ns()).div_ceil(10 * MS.as_ns());
        let stagger = longer(STAGGER, Duration::from_ms(10 * tens));
        let quarter = Duration::from_ms(stagger.as_us() / 4_000);
        let link_silence = self.report_period.as_ns() * misses + jitter.as_ns();

        Config {
            heartbeat_period: self.heartbeat_period,
            heartbeat_misses: misses as u32,
            heartbeat_jitter: jitter,
            poll_interval: self.poll_interval,
            standby_limit: longer(
                longer(STANDBY_LIMIT, silence),
                Duration::from_ns(self.heartbeat_period.as_ns() * 2 + self.stall.as_ns()),
            ),
            control_period: CONTROL_PERIOD,
            control_margin: shorter(margin_needed, margin_permitted),
            // One frame may be lost to a bit error; two in a row are a fault.
            mute_periods: 2,
            handshake_period: self.handshake_period,
            // The longest time the other system may take to start and to send its first handshake.
            // The level line immediately shows a system without power.
            start_limit: Duration::from_ns(self.boot_limit.as_ns() + AFTER_BOOT.as_ns()),
            stagger,
            // In this time the other system polls at least three times.
            sync_stagger: longer(longer(SYNC_STAGGER, quarter), self.poll_interval.times(4)),
            promote_limit: stagger,
            recover_after: Duration::from_ms(1000),
            reintegrate: false,
            abnormal_limit: 3,
            // A system that crashes once a minute should be repaired, not suspended.
            healthy_after: Duration::from_ms(60_000),
            // The vehicle's frames arrive every 10 ms; a pause of 25 of them is not normal. Every
            // failed attempt doubles this limit: a loose connector gets seconds to recover.
            can_open_limit: Duration::from_ms(250),
            report_period: self.report_period,
            // Valid until the link counts as silent.
            report_limit: longer(
                REPORT_LIMIT,
                Duration::from_ns(link_silence + self.report_period.as_ns()),
            ),
            // Status frames arrive every 100 ms, so two may be lost in a row.
            status_limit: Duration::from_ms(350),
            // Ten control periods: by then the cause of the change has ended, or the vehicle
            // reports it.
            hold_down: Duration::from_ms(100),
        }
    }
}

impl Config {
    /// The limits of [`Budget::RT`].
    #[must_use]
    pub const fn rt() -> Self {
        Budget::RT.config()
    }

    /// The limits of [`Budget::CHIP`].
    #[must_use]
    pub const fn chip() -> Self {
        Budget::CHIP.config()
    }

    /// The limits of [`Budget::DESKTOP`].
    ///
    /// They do not grow with the stalls of a desktop: longer limits would not permit a takeover
    /// within two control periods. This is safe, because a takeover on silence also requires that
    /// the control frames are missing.
    #[must_use]
    pub const fn desktop() -> Self {
        Budget::DESKTOP.config()
    }
}

const fn shorter(a: Duration, b: Duration) -> Duration {
    if a.as_ns() < b.as_ns() { a } else { b }
}

const fn longer(a: Duration, b: Duration) -> Duration {
    if a.as_ns() < b.as_ns() { b } else { a }
}

#[cfg(test)]
mod tests {
    use super::*;

    const ALL: [Budget; 3] = [Budget::CHIP, Budget::RT, Budget::DESKTOP];

    /// T-RED-8: for any measured stall, the limits fit together, the gap stays below two control
    /// periods, and no limit is shorter than the machine needs unless the goal demands it.
    #[test]
    fn every_measured_stall_gives_limits_that_fit() {
        let polls = |us| Budget {
            poll_interval: Duration::from_us(us),
            ..Budget::DESKTOP
        };
        for base in ALL.into_iter().chain([polls(1_250), polls(2_000)]) {
            let mut last = Duration::ZERO;
            for us in (0..200_000).step_by(130) {
                let budget = base.measured(Duration::from_us(us));
                let config = budget.config();
                assert!(config.check(), "{us} us: {config:?}");
                assert!(config.gap_bound() < GOAL && config.gap_bound_mute() < GOAL);
                let silent = config.silent_limit();
                assert!(silent >= last, "{us} us: a longer stall, a shorter limit");
                last = silent;
                let tolerated = budget.tolerated_stall();
                assert!(tolerated <= budget.stall && budget.stall > Duration::from_us(us));
                let needed = budget.heartbeat_period.times(2) + budget.lateness + tolerated;
                assert_eq!(silent, needed, "{us} us");

                // Each limit is what the machine needs, or the smallest or largest permitted value.
                let need = MS + budget.stall;
                let until_goal = GOAL - config.gap_bound_mute() == MS;
                assert!(
                    config.control_margin == need || config.control_margin < need && until_goal
                );
                let need = budget.heartbeat_period.times(2) + budget.stall;
                assert_eq!(config.standby_limit, need.max(STANDBY_LIMIT));
                let (beats, polls) = (budget.heartbeat_period, budget.poll_interval);
                let need = beats.times(4) + polls.times(2) + budget.stall;
                let tens = (0..).map(|n| Duration::from_ms(10).times(n));
                let stagger = tens.into_iter().find(|it| *it >= need.max(STAGGER));
                assert_eq!(Some(config.stagger), stagger, "{us} us");
                assert_eq!(config.promote_limit, config.stagger);
                let quarter = Duration::from_ms(config.stagger.as_us() / 4_000);
                assert_eq!(config.sync_stagger, quarter.max(polls.times(4)));
            }
        }
    }

    /// Each budget with values set by hand gives limits that fit together, or is impossible.
    #[test]
    fn a_possible_budget_gives_limits_that_fit() {
        let quarters = |n: u64| Duration::from_us(250 * n);
        let mut fitting = 0;
        for (beats, polls) in (1..16).flat_map(|beats| (1..16).map(move |polls| (beats, polls))) {
            for (lateness, reports, stall_ms) in [(1, 4, 0), (4, 40, 6), (4, 40, 50), (12, 4, 1)] {
                let budget = Budget {
                    heartbeat_period: quarters(beats),
                    poll_interval: quarters(polls),
                    lateness: quarters(lateness),
                    report_period: quarters(reports),
                    stall: Duration::from_ms(stall_ms),
                    ..Budget::RT
                };
                let possible = polls <= beats && 2 * beats + lateness + polls + 4 <= 40;
                assert_eq!(budget.impossible().is_none(), possible, "{budget:?}");
                if possible {
                    let config = budget.config();
                    assert!(config.check(), "{budget:?}: {config:?}");
                    assert!(budget.tolerated_stall() <= budget.stall, "{budget:?}");
                    fitting += 1;
                }
            }
        }
        assert!(fitting > 100, "{fitting}");
    }

    #[test]
    #[should_panic(expected = "polls must not be rarer than its heartbeats")]
    fn a_budget_whose_polls_are_rarer_than_heartbeats_is_refused() {
        let rare_polls = Duration::from_ms(2);
        let _ = Budget {
            poll_interval: rare_polls,
            ..Budget::RT
        }
        .config();
    }

    #[test]
    fn profiles_differ_in_these_limits() {
        let limits = ALL.map(|budget| {
            let config = budget.config();
            let (period, start) = (config.handshake_period, config.start_limit);
            [period, config.report_period, start, config.stagger].map(|it| it.as_us() / 1_000)
        });
        let expected = [[5, 1, 2500, 20], [5, 10, 2500, 20], [10, 10, 4500, 60]];
        assert_eq!(limits, expected);
        let stalls = [0, 1, 249, 250, 251, 6_000].map(|us| {
            let budget = Budget::RT.measured(Duration::from_us(us));
            budget.stall.as_us() / 1_000
        });
        assert_eq!(
            stalls,
            [1, 2, 2, 2, 3, 25],
            "four times the longest, and 1 ms"
        );
    }

    /// T-RED-8: a machine that stalls for less gets shorter bounds, down to those of a chip.
    #[test]
    fn a_calm_machine_takes_over_sooner() {
        let gap = |stall_ms| {
            let stall = Duration::from_ms(stall_ms);
            Budget {
                stall,
                ..Budget::RT
            }
            .config()
            .gap_bound()
        };
        let gaps = [0, 1, 2, 3, 4, 5, 6, 7, 40].map(|ms| gap(ms).as_us() / 1_000);
        assert_eq!(gaps, [14, 15, 16, 17, 18, 19, 19, 19, 19]);
        assert_eq!(Budget::RT.tolerated_stall(), Duration::from_ms(5));
        assert_eq!(Budget::DESKTOP.tolerated_stall(), Duration::from_ms(3));
    }
}
