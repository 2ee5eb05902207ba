//! The state of the driving function: who drives, in which mode, and how automated driving ends.
//! U-1
//!
//! One state machine for all causes that end automated driving: the driver, the loss of the other
//! system, the end of the operational design domain, a fault. [`NEXT`] is its whole table. Its
//! inputs are the permission of the redundancy ([`Mode`]), the scene and the driver's request. Its
//! output is the state, and with it the mode in which core 0 drives.
//!
//! Automated driving that lost a system or its domain ends within [`END_LIMIT`]: with the driver,
//! or at standstill.

use strum::VariantArray;
use tandem_board::{Duration, Instant};
use tandem_redundancy::Mode;

use super::types::{Lanes, Maneuver};

/// How long degraded mode may last before it asks the driver to take over: long enough for a system
/// that was reset to come back.
pub const DEGRADED_LIMIT: Duration = Duration::from_ms(60_000);
/// How long the driver has to answer a takeover request: the ten seconds of UN Regulation 157.
pub const TAKEOVER_LIMIT: Duration = Duration::from_ms(10_000);
/// How long inputs may be missing. During this time, a function that does not need them drives.
pub const BLIND_LIMIT: Duration = Duration::from_ms(2_000);
/// The longest time to standstill in a minimal-risk stop: from 60 m/s at the 2.5 m/s² of the safe
/// stop, and a second to build up the brake.
pub const STOP_LIMIT: Duration = Duration::from_ms(25_000);
/// Automated driving that lost a system or its domain ends within this time: with the driver, or at
/// standstill.
pub const END_LIMIT: Duration =
    Duration::from_us(DEGRADED_LIMIT.as_us() + TAKEOVER_LIMIT.as_us() + STOP_LIMIT.as_us());

/// The driver is asked so early that, after [`TAKEOVER_LIMIT`], the vehicle can still stop with
/// this deceleration, m/s², …
const STOP_BRAKING: f32 = 2.5;
/// … at this distance before the end of the domain, m.
const STANDS_BEFORE_M: f32 = 30.0;
/// Where an adjacent lane continues, a change to it may begin for this long before the driver is
/// asked: a lane that is free needs no driver.
const BEGINS_CHANGE: Duration = Duration::from_ms(1_500);
/// A lane continues if it ends at least this much farther away than the ego lane, m.
pub(crate) const CONTINUES_M: f32 = 50.0;
/// The request ends only beyond this many times the distance at which the driver is asked, because
/// the measured distance is noisy.
const TAKEN_BACK: f32 = 1.3;

/// Whether the vehicle stays within the operational design domain, and in a lane that does not end.
#[derive(Clone, Copy, Debug)]
pub struct Domain {
    stays: bool,
    /// Since when the end is nearer than the driver needs.
    near_since: Option<Instant>,
}

impl Default for Domain {
    fn default() -> Self {
        Self {
            stays: true,
            near_since: None,
        }
    }
}

impl Domain {
    /// Returns whether the vehicle stays there, as of the last cycle.
    #[must_use]
    pub const fn stays(&self) -> bool {
        self.stays
    }

    /// Decides whether a vehicle with this `speed`, m/s, stays there for as long as it takes to ask
    /// the driver and to stop, or leaves its lane in time: `maneuver` is what it carries out.
    pub fn cycle(&mut self, now: Instant, lanes: &Lanes, speed: f32, maneuver: Maneuver) {
        if lanes.own_end == f32::INFINITY {
            *self = Self::default();
            return;
        }
        let continues =
            |lane: Option<f32>, end: f32| lane.is_some() && end > lanes.own_end + CONTINUES_M;
        let left = continues(lanes.left, lanes.left_end);
        let right = continues(lanes.right, lanes.right_end);
        let changes = match maneuver {
            Maneuver::ChangeLeft => left,
            Maneuver::ChangeRight => right,
            Maneuver::Follow | Maneuver::Brake => false,
        };
        let stop_m = STANDS_BEFORE_M + speed * speed / (2.0 * STOP_BRAKING);
        let asked_m = stop_m + speed * TAKEOVER_LIMIT.as_secs_f32();
        let near_m = if self.stays {
            asked_m
        } else {
            TAKEN_BACK * asked_m
        };
        if lanes.own_end > near_m {
            *self = Self::default();
            return;
        }
        // A change that is broken off and begun again gives no new time to begin one.
        let since = *self.near_since.get_or_insert(now);
        let is_early = lanes.own_end > stop_m && now.since(since) < BEGINS_CHANGE;
        self.stays &= changes || (left || right) && is_early;
    }
}

/// State of the driving function.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, VariantArray)]
#[repr(u8)]
pub enum FunctionState {
    /// Inputs are missing: no lanes, or no motion of the chassis.
    #[default]
    Off = 0,
    /// Could drive, but the driver drives.
    Ready = 1,
    /// Drives with both systems.
    Active = 2,
    /// Drives with the functions of one system.
    Degraded = 3,
    /// Continues to drive, and asks the driver to take over.
    TakeoverRequest = 4,
    /// Brings the vehicle to standstill and holds it there.
    MinimalRisk = 5,
    /// Parks as the SoC asks, at walking speed; then holds the vehicle.
    Parking = 6,
}

impl FunctionState {
    /// Returns whether the function drives instead of the driver.
    #[must_use]
    pub const fn is_driving(self) -> bool {
        !matches!(self, Self::Off | Self::Ready)
    }

    /// Returns the longest time for which the state may last; `None` if unlimited.
    #[must_use]
    pub const fn limit(self) -> Option<Duration> {
        match self {
            Self::Degraded => Some(DEGRADED_LIMIT),
            Self::TakeoverRequest => Some(TAKEOVER_LIMIT),
            Self::Off | Self::Ready | Self::Active | Self::MinimalRisk | Self::Parking => None,
        }
    }

    /// Returns the mode in which core 0 drives, within what the redundancy permits. Parking needs
    /// one system only, so it has the mode that is permitted.
    #[must_use]
    pub const fn mode(self, permitted: Mode) -> Mode {
        match (self, permitted) {
            (Self::Off | Self::Ready, _) | (_, Mode::None) => Mode::None,
            (Self::MinimalRisk, _) | (_, Mode::SafeStop) => Mode::SafeStop,
            (Self::Degraded, _) | (_, Mode::DegradedL2) => Mode::DegradedL2,
            (Self::Active | Self::TakeoverRequest | Self::Parking, Mode::L3) => Mode::L3,
        }
    }
}

/// The causes of a change of state, in the order of their columns in [`NEXT`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, VariantArray)]
#[repr(u8)]
pub enum Signal {
    /// The inputs are missing for longer than [`BLIND_LIMIT`].
    Blind = 0,
    /// The inputs are present.
    Sees = 1,
    /// The driver drives: steers or brakes against the function, or switches it off.
    Override = 2,
    /// The driver asks for automated driving.
    Engage = 3,
    /// The redundancy permits no more than a stop: this system drives alone and has a fault.
    Fault = 4,
    /// One system is left.
    Alone = 5,
    /// The vehicle leaves the operational design domain.
    Leaves = 6,
    /// Both systems drive, within the domain.
    Whole = 7,
    /// The time limit of the state has passed.
    Expired = 8,
    /// The driver asks for parking, the SoC commands, and the vehicle is slow.
    Park = 9,
    /// The SoC does not command: a topic is older than its time-out, or disables its control. Not
    /// while gear and parking brake hold the vehicle.
    SocSilent = 10,
}

/// The next state: a row for each state, a column for each signal.
///
/// The driver can always take over. A minimal-risk stop is completed: only the driver ends it.
pub const NEXT: [[FunctionState; Signal::VARIANTS.len()]; FunctionState::VARIANTS.len()] = {
    use FunctionState::{
        Active as Act, Degraded as Deg, MinimalRisk as Mrm, Off, Parking as Prk, Ready as Rdy,
        TakeoverRequest as Req,
    };
    [
        // Blind Sees Override Engage Fault Alone Leaves Whole Expired Park SocSilent
        [Off, Rdy, Off, Off, Off, Off, Off, Off, Off, Off, Off], // off
        [Off, Rdy, Rdy, Act, Rdy, Rdy, Rdy, Rdy, Rdy, Rdy, Rdy], // ready
        [Mrm, Act, Rdy, Act, Mrm, Deg, Req, Act, Act, Prk, Act], // active
        [Mrm, Deg, Rdy, Deg, Mrm, Deg, Req, Act, Req, Deg, Deg], // degraded
        [Mrm, Req, Rdy, Req, Mrm, Req, Req, Act, Mrm, Req, Req], // takeover request
        [Mrm, Mrm, Rdy, Mrm, Mrm, Mrm, Mrm, Mrm, Mrm, Mrm, Mrm], // minimal-risk stop
        [Mrm, Prk, Rdy, Prk, Mrm, Prk, Prk, Prk, Prk, Prk, Mrm], // parking
    ]
};

/// The request of the driver, from the driver's frame.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Driver {
    /// No frame of the driver has arrived.
    #[default]
    Unheard,
    /// Drives, or wants to.
    Drives,
    /// Wants automated driving.
    Engages,
    /// Wants automated driving, and the vehicle parked.
    Parks,
}

/// The inputs of the machine in a cycle.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Inputs {
    /// The permission of the redundancy.
    pub permitted: Mode,
    /// The request of the driver.
    pub driver: Driver,
    /// Lanes and the motion of the chassis are known, and fresh.
    pub sees: bool,
    /// The vehicle is within the operational design domain, and is not about to leave it.
    pub in_domain: bool,
    /// The driver asks for parking, the SoC commands, and the vehicle is slow.
    pub parks: bool,
    /// The SoC does not command, and the vehicle is not parked.
    pub soc_silent: bool,
}

/// The driving function of one system. Both systems run one each, with the same inputs.
#[derive(Clone, Copy, Debug, Default)]
pub struct Function {
    state: FunctionState,
    since: Instant,
    seen: Instant,
}

impl Function {
    /// Returns the state after the last cycle.
    #[must_use]
    pub const fn state(&self) -> FunctionState {
        self.state
    }

    /// Runs one control cycle. The driver's signal is processed first and the time limit's last.
    /// Each signal acts on the state that the previous one produced.
    pub fn cycle(&mut self, now: Instant, inputs: &Inputs) -> FunctionState {
        if inputs.sees {
            self.seen = now;
        }
        let blind = now.since(self.seen) > BLIND_LIMIT;
        let over = |limit| now.since(self.since) >= limit;
        let expired = self.state.limit().is_some_and(over);
        let driver = match inputs.driver {
            Driver::Drives => Some(Signal::Override),
            Driver::Engages | Driver::Parks => Some(Signal::Engage),
            Driver::Unheard => None,
        };
        let permitted = match inputs.permitted {
            Mode::SafeStop => Some(Signal::Fault),
            Mode::DegradedL2 => Some(Signal::Alone),
            Mode::L3 => Some(Signal::Whole).filter(|_| inputs.in_domain),
            Mode::None => None,
        };
        let signals = [
            inputs.sees.then_some(Signal::Sees),
            blind.then_some(Signal::Blind),
            driver,
            permitted,
            (!inputs.in_domain).then_some(Signal::Leaves),
            inputs.parks.then_some(Signal::Park),
            inputs.soc_silent.then_some(Signal::SocSilent),
            expired.then_some(Signal::Expired),
        ];
        let before = self.state;
        for signal in signals.into_iter().flatten() {
            self.state = NEXT[self.state as usize][signal as usize];
        }
        if self.state != before {
            self.since = now;
        }
        self.state
    }
}

#[cfg(test)]
mod tests {
    extern crate std;
    use super::*;
    use std::format;
    use std::vec;
    use std::vec::Vec;

    const DRIVES: Inputs = Inputs {
        permitted: Mode::L3,
        driver: Driver::Engages,
        sees: true,
        in_domain: true,
        parks: false,
        soc_silent: true,
    };
    const MS: fn(u64) -> Instant = |ms| Instant::from_ns(ms * 1_000_000);

    /// U-1: the documentation states the times that the code keeps.
    #[test]
    fn the_times_in_the_docs_are_those_that_run() {
        let docs = include_str!("../../../docs/driving-function.md");
        let seconds = |time: Duration| format!("{} s", time.as_us() / 1_000_000);
        for (state, limit) in [
            ("degraded", DEGRADED_LIMIT),
            ("takeover request", TAKEOVER_LIMIT),
        ] {
            let mut rows = docs.lines().map(|line| line.split('|').map(str::trim));
            let row = rows.find(|row| row.clone().nth(1) == Some(state));
            let cell = row.and_then(|mut row| row.nth(4));
            assert_eq!(cell, Some(seconds(limit).as_str()), "{state}");
        }
        let whole = format!("ends within {}", seconds(END_LIMIT));
        let parts = [
            format!("{} degraded", seconds(DEGRADED_LIMIT)),
            format!("{} of asking", seconds(TAKEOVER_LIMIT)),
            format!("{} of braking", seconds(STOP_LIMIT)),
        ];
        let docs = docs.replace('\n', " ");
        for words in parts.iter().chain([&whole]) {
            assert!(docs.contains(words), "{words}");
        }
    }

    /// The tables in the documentation and in the code are equal, cell by cell.
    #[test]
    fn the_table_in_the_docs_is_the_one_that_runs() {
        let docs = include_str!("../../../docs/driving-function.md");
        let name = |state: FunctionState| match state {
            FunctionState::Off => "off",
            FunctionState::Ready => "ready",
            FunctionState::Active => "active",
            FunctionState::Degraded => "degraded",
            FunctionState::TakeoverRequest => "takeover request",
            FunctionState::MinimalRisk => "minimal-risk stop",
            FunctionState::Parking => "parking",
        };
        for &state in FunctionState::VARIANTS {
            let row = docs
                .lines()
                .find(|line| line.starts_with(&format!("| **{}** |", name(state))));
            let cells: Vec<_> = row.expect("a row").split('|').map(str::trim).collect();
            for &signal in Signal::VARIANTS {
                let next = NEXT[state as usize][signal as usize];
                let shown = if next == state { "·" } else { name(next) };
                assert_eq!(cells[2 + signal as usize], shown, "{state:?} {signal:?}");
            }
        }
    }

    /// Properties that each cell of the table must have.
    #[test]
    fn the_driver_always_gets_the_vehicle_and_a_stop_is_completed() {
        for &state in FunctionState::VARIANTS {
            let next = |signal: Signal| NEXT[state as usize][signal as usize];
            assert!(!next(Signal::Override).is_driving(), "{state:?}");
            // Only the driver makes the function drive.
            for &signal in Signal::VARIANTS {
                let begins = !state.is_driving() && next(signal).is_driving();
                assert!(!begins || signal == Signal::Engage, "{state:?} {signal:?}");
                // While the function drives, only the driver makes it stop.
                let ends = state.is_driving() && !next(signal).is_driving();
                assert!(!ends || signal == Signal::Override, "{state:?} {signal:?}");
                let aborts = state == FunctionState::MinimalRisk && next(signal) != state;
                assert!(!aborts || signal == Signal::Override, "{signal:?}");
                // The SoC commands only where the driver asked for it, and no other function goes
                // on from where the SoC has brought the vehicle.
                let begins =
                    state != FunctionState::Parking && next(signal) == FunctionState::Parking;
                assert!(!begins || signal == Signal::Park, "{state:?} {signal:?}");
                let after = state == FunctionState::Parking && next(signal) != state;
                let ends = [FunctionState::MinimalRisk, FunctionState::Ready];
                assert!(!after || ends.contains(&next(signal)), "{signal:?}");
            }
        }
        let codes = FunctionState::VARIANTS.iter().map(|state| *state as u8);
        assert!(codes.eq(0..7));
    }

    #[test]
    fn no_state_drives_by_more_than_is_permitted() {
        for (state, permitted) in FunctionState::VARIANTS.iter().flat_map(|&state| {
            (0..)
                .map_while(Mode::from_repr)
                .map(move |mode| (state, mode))
        }) {
            let mode = state.mode(permitted);
            assert!(mode == Mode::None || mode as u8 >= permitted as u8);
            let idle = !state.is_driving() || permitted == Mode::None;
            assert_eq!(mode == Mode::None, idle);
        }
    }

    /// U-1: if one system is lost and the driver does not answer, the function asks and stops at
    /// the stated times.
    #[test]
    fn degraded_mode_ends_within_its_limit() {
        let mut function = Function::default();
        assert_eq!(function.cycle(MS(0), &DRIVES), FunctionState::Active);
        let alone = Inputs {
            permitted: Mode::DegradedL2,
            ..DRIVES
        };
        let (lost, mut at) = (1_000, 1_000);
        let mut changes = vec![];
        while changes
            .last()
            .is_none_or(|(_, state)| *state != FunctionState::MinimalRisk)
        {
            let state = function.cycle(MS(at), &alone);
            if changes.last().is_none_or(|(_, last)| *last != state) {
                changes.push((at - lost, state));
            }
            at += 10;
        }
        let degraded = DEGRADED_LIMIT.as_us() / 1_000;
        let expected = [
            (0, FunctionState::Degraded),
            (degraded, FunctionState::TakeoverRequest),
            (
                degraded + TAKEOVER_LIMIT.as_us() / 1_000,
                FunctionState::MinimalRisk,
            ),
        ];
        assert_eq!(changes, expected);
        // Nothing but the driver ends it.
        assert_eq!(function.cycle(MS(at), &DRIVES), FunctionState::MinimalRisk);
        let takes = Inputs {
            driver: Driver::Drives,
            ..DRIVES
        };
        assert_eq!(function.cycle(MS(at + 10), &takes), FunctionState::Ready);
    }

    /// D-3: the SoC's silence stops the vehicle if it parks, and does nothing in any other state.
    /// One system that is left goes on parking.
    #[test]
    fn parking_ends_with_the_driver_or_in_a_stop() {
        let asks = Inputs {
            parks: true,
            soc_silent: false,
            driver: Driver::Parks,
            ..DRIVES
        };
        let alone = Inputs {
            permitted: Mode::DegradedL2,
            in_domain: false,
            ..asks
        };
        let silent = Inputs {
            parks: false,
            soc_silent: true,
            ..alone
        };
        let hands = Inputs {
            driver: Driver::Drives,
            ..asks
        };
        let mut function = Function::default();
        assert_eq!(
            function.cycle(MS(0), &silent),
            FunctionState::TakeoverRequest
        );
        let mut function = Function::default();
        assert_eq!(function.cycle(MS(0), &asks), FunctionState::Parking);
        let engages = Inputs {
            parks: false,
            driver: Driver::Engages,
            ..asks
        };
        for (inputs, expected) in [
            (&alone, FunctionState::Parking),
            (&engages, FunctionState::Parking),
            (&silent, FunctionState::MinimalRisk),
            (&asks, FunctionState::MinimalRisk),
            (&hands, FunctionState::Ready),
            (&asks, FunctionState::Parking),
            (&hands, FunctionState::Ready),
        ] {
            assert_eq!(function.cycle(MS(10), inputs), expected, "{inputs:?}");
        }
        assert_eq!(FunctionState::Parking.mode(Mode::SafeStop), Mode::SafeStop);
    }

    #[test]
    fn a_system_that_comes_back_ends_degraded_mode_and_the_request() {
        let mut function = Function::default();
        function.cycle(MS(0), &DRIVES);
        let leaves = Inputs {
            in_domain: false,
            ..DRIVES
        };
        assert_eq!(
            function.cycle(MS(10), &leaves),
            FunctionState::TakeoverRequest
        );
        assert_eq!(function.state().mode(Mode::L3), Mode::L3);
        assert_eq!(function.cycle(MS(20), &DRIVES), FunctionState::Active);
        let alone = Inputs {
            permitted: Mode::DegradedL2,
            ..DRIVES
        };
        assert_eq!(function.cycle(MS(30), &alone), FunctionState::Degraded);
        assert_eq!(function.cycle(MS(40), &DRIVES), FunctionState::Active);
    }

    /// The request leaves time for an answer and a stop, also where a lane beside continues but has
    /// no gap. A change to it that is under way makes none, and one may begin for 1.5 s. Noise of
    /// the distance does not toggle it.
    #[test]
    fn the_domain_is_left_when_its_end_is_nearer_than_request_and_stop() {
        use Maneuver::{Brake, ChangeLeft, ChangeRight, Follow};
        const FAR: f32 = f32::INFINITY;
        // 20 m/s: 200 m in ten seconds, 80 m to stop, 30 m before the end.
        for (end, left, maneuver, stayed, stays) in [
            (311.0, None, Follow, true, [true, true]),
            (309.0, None, Follow, true, [false, false]),
            (311.0, None, Follow, false, [false, false]),
            (404.0, None, Follow, false, [true, true]),
            // No gap yet, and then too near to wait for one.
            (311.0, Some(FAR), Follow, true, [true, true]),
            (309.0, Some(FAR), Follow, true, [true, false]),
            (311.0, Some(FAR), Follow, false, [false, false]),
            (109.0, Some(FAR), Follow, true, [false, false]),
            (309.0, Some(FAR), Brake, true, [true, false]),
            // A change is under way: to a lane that continues, or to one that does not.
            (309.0, Some(FAR), ChangeLeft, true, [true, true]),
            (40.0, Some(FAR), ChangeLeft, true, [true, true]),
            (40.0, Some(FAR), ChangeLeft, false, [false, false]),
            (309.0, Some(FAR), ChangeRight, true, [true, false]),
            (309.0, Some(330.0), ChangeLeft, true, [false, false]),
            (309.0, None, ChangeLeft, true, [false, false]),
            (FAR, None, Follow, false, [true, true]),
        ] {
            let lanes = Lanes {
                left: left.map(|_| 3.5),
                left_end: left.unwrap_or(FAR),
                own_end: end,
                ..Lanes::alone(3.5, 80.0)
            };
            let mut domain = Domain {
                stays: stayed,
                ..Domain::default()
            };
            let answers = [0, 1_500].map(|ms| {
                domain.cycle(MS(ms), &lanes, 20.0, maneuver);
                domain.stays()
            });
            assert_eq!(answers, stays, "{end} {left:?} {maneuver:?} {stayed}");
        }
        // Changes that are broken off: the driver is asked once, after 1.5 s.
        let mut domain = Domain::default();
        for ms in (0..12_000).step_by(50) {
            let changes = ms % 1_300 < 300;
            let lanes = Lanes {
                left: Some(3.5),
                left_end: FAR,
                own_end: 300.0 - 0.02 * ms as f32,
                ..Lanes::alone(3.5, 80.0)
            };
            let maneuver = if changes { ChangeLeft } else { Follow };
            domain.cycle(MS(ms), &lanes, 20.0, maneuver);
            assert_eq!(domain.stays(), ms < 1_600, "{ms}");
        }
        let near = Lanes {
            own_end: 17.0,
            ..Lanes::alone(3.5, 80.0)
        };
        let mut domain = Domain::default();
        domain.cycle(MS(0), &near, 0.0, Follow);
        assert!(!domain.stays(), "stands");
    }

    #[test]
    fn inputs_that_are_missing_for_long_end_in_a_stop() {
        let mut function = Function::default();
        function.cycle(MS(0), &DRIVES);
        let blind = Inputs {
            sees: false,
            ..DRIVES
        };
        assert_eq!(function.cycle(MS(2_000), &blind), FunctionState::Active);
        assert_eq!(
            function.cycle(MS(2_010), &blind),
            FunctionState::MinimalRisk
        );
    }
}
