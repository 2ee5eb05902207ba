//! The supply of a system: power, reset generator and reset cause. T-CHIP-6
//!
//! | state | level line | it ends when |
//! |---|---|---|
//! | off | low | power on → on |
//! | on | high | watchdog, request, death of core 0, rail, error pin → reset or suspended |
//! | reset | low | the hold is over, all cores have stopped, rails and error pin are good → on |
//! | suspended | low | only power off ends it |
//!
//! Power can be switched off in every state. A rail with too much voltage suspends the system from
//! every state with power, so that the chip is not damaged.

use tandem_board::{Duration, HardwareFault, HardwareFaults, Instant, ResetCause, ResetRequest};

use crate::watchdog::{Watchdog, Window};

/// The configuration of a supply.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Config {
    /// When a service of the watchdog is in time.
    pub window: Window,
    /// Whether a fault of the watchdog resets the system.
    pub watches: bool,
    /// How long a reset holds the system.
    pub hold: Duration,
    /// The hold doubles with each reset up to this limit, so that a program that dies at its start
    /// does not overload the machine.
    pub longest_hold: Duration,
    /// After an incarnation that lasted this long, the hold is short again.
    pub stable: Duration,
}

impl Config {
    /// For hardware cores: every hold lasts 2 ms.
    pub const TARGET: Self = Self {
        window: Window::TARGET,
        watches: true,
        hold: Duration::from_ms(2),
        longest_hold: Duration::from_ms(2),
        stable: Duration::ZERO,
    };
    /// For cores that are processes. During the hold, the bus drops the unsent frames of the dead
    /// cores.
    pub const DESKTOP: Self = Self {
        window: Window::DESKTOP,
        watches: true,
        hold: Duration::from_ms(20),
        longest_hold: Duration::from_ms(1_000),
        stable: Duration::from_ms(3_000),
    };
}

/// The state of a supply.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Power {
    /// No power.
    Off,
    /// The system runs.
    On,
    /// The supply holds the system in reset at least until `until`.
    Reset {
        /// When the hold is over.
        until: Instant,
        /// The cause that the system will read.
        cause: ResetCause,
    },
    /// The supply holds the system in reset until power is switched off and on again.
    Suspended,
}

/// What the board must do after a change of the supply's state. Each change also changes the level
/// line, which interrupts core 0 of the other system.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[must_use]
pub enum Change {
    /// An incarnation of the system begins for this cause: core 0 starts, and releases the others.
    Start(ResetCause),
    /// All cores stop. The supply will start them again.
    Reset(ResetCause),
    /// All cores stop until the next power-on: the system requested it, or a rail has too much
    /// voltage.
    Suspend,
    /// All cores stop: power is lost.
    PowerOff,
}

/// The supply of one system.
#[derive(Clone, Copy, Debug)]
pub struct Supply {
    config: Config,
    state: State,
    /// How long the next reset holds the system.
    next_hold: Duration,
    /// The present faults of the rails and the error pin.
    pins: HardwareFaults,
    /// Incarnations since power-on, or since one of them confirmed its start.
    starts: u8,
}

#[derive(Clone, Copy, Debug)]
enum State {
    Off,
    On {
        since: Instant,
        cause: ResetCause,
        watchdog: Watchdog,
        /// The first request of a core.
        request: Option<ResetRequest>,
    },
    Reset {
        until: Instant,
        cause: ResetCause,
    },
    Suspended,
}

impl Supply {
    /// Makes a supply without power.
    #[must_use]
    pub const fn new(config: Config) -> Self {
        Self {
            config,
            state: State::Off,
            next_hold: config.hold,
            pins: HardwareFaults(0),
            starts: 0,
        }
    }

    /// Returns how many incarnations have begun since power-on or the last
    /// [`Supply::confirm_start`].
    #[must_use]
    pub const fn starts(&self) -> u8 {
        self.starts
    }

    /// Notes that the incarnation works.
    pub const fn confirm_start(&mut self) {
        self.starts = 0;
    }

    /// Returns the state.
    #[must_use]
    pub const fn power(&self) -> Power {
        match self.state {
            State::Off => Power::Off,
            State::On { .. } => Power::On,
            State::Reset { until, cause } => Power::Reset { until, cause },
            State::Suspended => Power::Suspended,
        }
    }

    /// Returns whether the system has power and is out of reset: the level line is high.
    #[must_use]
    pub const fn is_on(&self) -> bool {
        matches!(self.state, State::On { .. })
    }

    /// Returns the reset cause of the current incarnation of the system, or of the next one if the
    /// system does not run.
    #[must_use]
    pub const fn cause(&self) -> ResetCause {
        match self.state {
            State::On { cause, .. } | State::Reset { cause, .. } => cause,
            State::Off | State::Suspended => ResetCause::PowerOn,
        }
    }

    /// Returns the current question of the functional watchdog.
    #[must_use]
    pub const fn question(&self) -> u8 {
        match &self.state {
            State::On { watchdog, .. } => watchdog.question(),
            _ => crate::watchdog::question(0),
        }
    }

    /// Switches power on. No effect if it was on.
    pub fn power_on(&mut self, now: Instant) -> Option<Change> {
        match self.state {
            State::Off => Some(self.start(now, ResetCause::PowerOn)),
            _ => None,
        }
    }

    /// Returns why rails or error pin hold the system in reset; `None` if they are good.
    const fn held_by(&self) -> Option<ResetCause> {
        if self.pins.has(HardwareFault::Undervoltage) {
            Some(ResetCause::Undervoltage)
        } else if self.pins.has(HardwareFault::ErrorPin) {
            Some(ResetCause::ErrorPin)
        } else {
            None
        }
    }

    /// Records the state of the rails and of the error pin.
    pub fn observe(&mut self, now: Instant, pins: HardwareFaults) -> Option<Change> {
        self.pins = pins;
        match self.state {
            State::On { .. } | State::Reset { .. } if pins.has(HardwareFault::Overvoltage) => {
                self.state = State::Suspended;
                Some(Change::Suspend)
            }
            State::On { .. } => self.reset(now, self.held_by()?),
            _ => None,
        }
    }

    /// Switches power off. No effect if it was off.
    pub fn power_off(&mut self) -> Option<Change> {
        match self.state {
            State::Off => None,
            _ => {
                *self = Self {
                    pins: self.pins,
                    ..Self::new(self.config)
                };
                Some(Change::PowerOff)
            }
        }
    }

    /// Requests a reset for a core. [`Supply::poll`] obeys the first request of an incarnation.
    pub fn request(&mut self, asked: ResetRequest) {
        if let State::On { request, .. } = &mut self.state {
            request.get_or_insert(asked);
        }
    }

    /// Services the watchdog for core 0: see [`Watchdog::service`].
    pub fn service(&mut self, now: Instant, at: Instant, answer: Option<u8>) -> Option<Change> {
        let State::On { watchdog, .. } = &mut self.state else {
            return None;
        };
        let fault = watchdog.service(now, at, answer).is_err();
        (fault && self.config.watches).then(|| self.reset(now, ResetCause::Watchdog))?
    }

    /// Records that the supply could not run: see [`Watchdog::was_blind`].
    pub fn was_blind(&mut self, from: Instant, to: Instant) {
        if let State::On { watchdog, .. } = &mut self.state {
            watchdog.was_blind(from, to);
        }
    }

    /// Resets a system that is on.
    pub fn reset(&mut self, now: Instant, cause: ResetCause) -> Option<Change> {
        let State::On { since, .. } = self.state else {
            return None;
        };
        if now.since(since) >= self.config.stable {
            self.next_hold = self.config.hold;
        }
        let until = now + self.next_hold;
        self.state = State::Reset { until, cause };
        self.next_hold = self.next_hold.times(2).min(self.config.longest_hold);
        Some(Change::Reset(cause))
    }

    /// Does everything that is due. `cores_stand`: all cores of earlier incarnations have stopped.
    pub fn poll(&mut self, now: Instant, cores_stand: bool) -> Option<Change> {
        match self.state {
            State::On {
                watchdog, request, ..
            } => match request {
                Some(ResetRequest::Software) => self.reset(now, ResetCause::Software),
                Some(ResetRequest::CoreDead) => self.reset(now, ResetCause::Trap),
                Some(ResetRequest::Download) => self.reset(now, ResetCause::Download),
                Some(ResetRequest::Suspend) => {
                    self.state = State::Suspended;
                    Some(Change::Suspend)
                }
                None if self.config.watches && watchdog.check(now).is_err() => {
                    self.reset(now, ResetCause::Watchdog)
                }
                None => None,
            },
            State::Reset { until, cause }
                if now >= until && cores_stand && self.held_by().is_none() =>
            {
                Some(self.start(now, cause))
            }
            State::Reset { .. } | State::Off | State::Suspended => None,
        }
    }

    /// Returns the time at which [`Supply::poll`] is next due if no other call is made before.
    #[must_use]
    pub fn next(&self) -> Instant {
        match self.state {
            State::On {
                request: Some(_), ..
            } => Instant::ORIGIN,
            State::On { watchdog, .. } if self.config.watches => {
                watchdog.closes() + Duration::from_ns(1)
            }
            State::Reset { until, .. } if self.held_by().is_none() => until,
            State::Reset { .. } | State::On { .. } | State::Off | State::Suspended => {
                Instant::NEVER
            }
        }
    }

    fn start(&mut self, now: Instant, cause: ResetCause) -> Change {
        self.starts = starts_after(self.starts, cause);
        self.state = State::On {
            since: now,
            cause,
            watchdog: Watchdog::new(self.config.window, now),
            request: None,
        };
        Change::Start(cause)
    }
}

/// Returns the number of starts with one more, for this cause.
#[must_use]
pub const fn starts_after(starts: u8, cause: ResetCause) -> u8 {
    match cause {
        ResetCause::PowerOn => 1,
        _ => starts.saturating_add(1),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use HardwareFault::{ErrorPin, Overvoltage, Undervoltage};
    use tandem_board::watchdog_answer;

    const CONFIG: Config = Config {
        window: Window::TARGET,
        watches: true,
        hold: Duration::from_ms(20),
        longest_hold: Duration::from_ms(50),
        stable: Duration::from_ms(3_000),
    };

    fn ms(at: u64) -> Instant {
        Instant::from_ns(at * 1_000_000)
    }

    const ON: fn() -> Supply = || {
        let mut supply = Supply::new(CONFIG);
        assert_eq!(
            supply.power_on(ms(0)),
            Some(Change::Start(ResetCause::PowerOn))
        );
        supply
    };
    const IN_RESET: fn() -> Supply = || {
        let mut supply = ON();
        assert!(supply.reset(ms(0), ResetCause::Trap).is_some());
        supply
    };
    const SUSPENDED: fn() -> Supply = || {
        let mut supply = ON();
        supply.request(ResetRequest::Suspend);
        assert_eq!(supply.poll(ms(0), true), Some(Change::Suspend));
        supply
    };

    type Input = fn(&mut Supply) -> Option<Change>;
    const INPUTS: [(&str, Input); 15] = [
        ("power on", |s| s.power_on(ms(1))),
        ("power off", Supply::power_off),
        ("right service", |s| {
            s.service(ms(1), ms(1), Some(watchdog_answer(s.question())))
        }),
        ("wrong service", |s| s.service(ms(1), ms(1), None)),
        ("no service", |s| s.poll(ms(101), false)),
        ("core 0 died", |s| s.reset(ms(1), ResetCause::Trap)),
        ("asks for a reset", |s| asks(s, ResetRequest::Software)),
        ("reports a dead core", |s| asks(s, ResetRequest::CoreDead)),
        ("asks for a download", |s| asks(s, ResetRequest::Download)),
        ("suspends", |s| asks(s, ResetRequest::Suspend)),
        ("hold is over", |s| s.poll(ms(20), true)),
        ("rails and pin good", |s| sees(s, &[])),
        ("low rail", |s| sees(s, &[Undervoltage])),
        ("high rail", |s| sees(s, &[Undervoltage, Overvoltage])),
        ("error pin", |s| sees(s, &[ErrorPin])),
    ];

    fn sees(supply: &mut Supply, faults: &[HardwareFault]) -> Option<Change> {
        let mut pins = HardwareFaults::default();
        faults.iter().for_each(|fault| pins.set(*fault, true));
        supply.observe(ms(1), pins)
    }

    fn asks(supply: &mut Supply, request: ResetRequest) -> Option<Change> {
        supply.request(request);
        supply.poll(ms(1), false)
    }

    /// T-CHIP-6: each input in each state leads to the right board action and the right state.
    #[test]
    fn every_cell_of_the_table() {
        use Change::{PowerOff, Reset, Start, Suspend};
        use ResetCause::{Download, PowerOn, Software, Trap, Watchdog};
        let held = |until, cause| Power::Reset {
            until: ms(until),
            cause,
        };
        let trap = held(20, Trap);
        type Row = (fn() -> Supply, [(Option<Change>, Power); INPUTS.len()]);
        let off: fn() -> Supply = || Supply::new(CONFIG);
        let rows: [Row; 4] = [
            (off, {
                let stays = (None, Power::Off);
                let mut row = [stays; INPUTS.len()];
                row[0] = (Some(Start(PowerOn)), Power::On);
                row
            }),
            (
                ON,
                [
                    (None, Power::On),
                    (Some(PowerOff), Power::Off),
                    (None, Power::On),
                    (Some(Reset(Watchdog)), held(21, Watchdog)),
                    (Some(Reset(Watchdog)), held(121, Watchdog)),
                    (Some(Reset(Trap)), held(21, Trap)),
                    (Some(Reset(Software)), held(21, Software)),
                    (Some(Reset(Trap)), held(21, Trap)),
                    (Some(Reset(Download)), held(21, Download)),
                    (Some(Suspend), Power::Suspended),
                    (None, Power::On),
                    (None, Power::On),
                    (
                        Some(Reset(ResetCause::Undervoltage)),
                        held(21, ResetCause::Undervoltage),
                    ),
                    (Some(Suspend), Power::Suspended),
                    (
                        Some(Reset(ResetCause::ErrorPin)),
                        held(21, ResetCause::ErrorPin),
                    ),
                ],
            ),
            (IN_RESET, {
                let mut row = [(None, trap); INPUTS.len()];
                row[1] = (Some(PowerOff), Power::Off);
                row[10] = (Some(Start(Trap)), Power::On);
                row[13] = (Some(Suspend), Power::Suspended);
                row
            }),
            (SUSPENDED, {
                let mut row = [(None, Power::Suspended); INPUTS.len()];
                row[1] = (Some(PowerOff), Power::Off);
                row
            }),
        ];
        for (state, cells) in rows {
            for ((input, act), (change, after)) in INPUTS.iter().zip(cells) {
                let mut supply = state();
                let before = supply.power();
                assert_eq!(act(&mut supply), change, "{before:?}: {input}");
                assert_eq!(supply.power(), after, "{before:?}: {input}");
                assert_eq!(supply.is_on(), after == Power::On, "{before:?}: {input}");
            }
        }
    }

    #[test]
    fn a_reset_ends_when_the_hold_is_over_and_no_core_runs() {
        for (now, cores_stand, starts) in [
            (19, true, false),
            (20, false, false),
            (500, false, false),
            (20, true, true),
        ] {
            let change = IN_RESET().poll(ms(now), cores_stand);
            assert_eq!(change.is_some(), starts, "{now} ms, {cores_stand}");
        }
        assert_eq!(IN_RESET().next(), ms(20));
    }

    /// T-CHIP-6: undervoltage and the error pin hold a system in reset for as long as they last.
    /// Overvoltage switches the system off until a power-on without overvoltage.
    #[test]
    fn rails_and_error_pin_hold_a_system() {
        for (fault, cause) in [
            (Undervoltage, ResetCause::Undervoltage),
            (ErrorPin, ResetCause::ErrorPin),
        ] {
            let mut supply = ON();
            assert_eq!(sees(&mut supply, &[fault]), Some(Change::Reset(cause)));
            assert_eq!(supply.next(), Instant::NEVER);
            assert_eq!(supply.poll(ms(500), true), None, "{fault:?} lasts");
            assert_eq!(sees(&mut supply, &[]), None);
            assert_eq!(supply.poll(ms(501), true), Some(Change::Start(cause)));
        }
        let mut supply = ON();
        assert_eq!(sees(&mut supply, &[Overvoltage]), Some(Change::Suspend));
        assert_eq!(sees(&mut supply, &[]), None);
        assert_eq!(supply.poll(ms(500), true), None, "stays off");
        assert!(supply.power_off().is_some());
        assert!(supply.power_on(ms(600)).is_some());
        assert_eq!(supply.cause(), ResetCause::PowerOn);
    }

    /// An incarnation reports its own cause and keeps no state of the previous one.
    #[test]
    fn a_new_incarnation_is_free_of_the_old_one() {
        let mut supply = ON();
        assert_eq!(supply.cause(), ResetCause::PowerOn);
        assert_eq!(supply.service(ms(1), ms(1), Some(watchdog_answer(3))), None);
        assert_ne!(supply.question(), crate::watchdog::question(0));
        supply.request(ResetRequest::Suspend);
        assert!(supply.reset(ms(2), ResetCause::Watchdog).is_some());
        supply.request(ResetRequest::Software);
        assert!(supply.poll(ms(22), true).is_some());
        assert_eq!(supply.cause(), ResetCause::Watchdog);
        assert_eq!(supply.question(), crate::watchdog::question(0));
        assert_eq!(supply.poll(ms(23), true), None, "an old request");
        assert_eq!(supply.poll(ms(22 + 100), true), None, "the first window");
        assert!(supply.poll(ms(22 + 101), true).is_some());
    }

    #[test]
    fn the_first_request_of_a_incarnation_counts() {
        let mut supply = ON();
        supply.request(ResetRequest::CoreDead);
        supply.request(ResetRequest::Suspend);
        assert_eq!(supply.next(), Instant::ORIGIN, "at once");
        assert_eq!(
            supply.poll(ms(1), true),
            Some(Change::Reset(ResetCause::Trap))
        );
    }

    /// The hold doubles up to its limit, and is short again after a stable incarnation or a
    /// power-on.
    #[test]
    fn the_hold_grows_with_each_reset_that_follows_soon() {
        let mut supply = ON();
        let mut now = 0;
        for hold in [20, 40, 50, 50] {
            assert!(supply.reset(ms(now), ResetCause::Trap).is_some());
            assert_eq!(supply.next(), ms(now + hold));
            now += hold;
            assert!(supply.poll(ms(now), true).is_some());
        }
        now += 3_000;
        assert!(supply.reset(ms(now), ResetCause::Trap).is_some());
        assert_eq!(supply.next(), ms(now + 20), "after a stable incarnation");
        assert!(supply.power_off().is_some());
        assert!(supply.power_on(ms(now)).is_some());
        assert!(supply.reset(ms(now), ResetCause::Trap).is_some());
        assert_eq!(supply.next(), ms(now + 20), "after a power-on");
    }

    #[test]
    fn a_supply_that_does_not_watch_resets_for_no_service() {
        let mut supply = Supply::new(Config {
            watches: false,
            ..CONFIG
        });
        assert!(supply.power_on(ms(0)).is_some());
        assert_eq!(supply.service(ms(1), ms(1), None), None);
        assert_eq!(supply.poll(ms(10_000), true), None);
        assert_eq!(supply.next(), Instant::NEVER);
    }

    #[test]
    fn the_time_in_which_the_supply_was_held_up_does_not_count() {
        let mut supply = ON();
        supply.was_blind(ms(1), ms(501));
        assert_eq!(supply.poll(ms(600), true), None);
        assert_eq!(supply.next(), ms(600) + Duration::from_ns(1));
        assert!(supply.poll(ms(601), true).is_some());
    }
}
