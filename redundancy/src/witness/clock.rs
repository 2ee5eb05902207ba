//! The witness of the clocks: how far this system's clock has drifted from the vehicle's and from
//! the other system's. Of three clocks, the one that differs from two is wrong.
//!
//! What the others send tells when it was sent, on the sender's clock. The difference to the own
//! clock is the two clocks' offset, less the time on the way. So a frame that is late only lowers
//! the difference, and the largest one of some time is the offset. A stall of any of the three is
//! no drift.

use crate::Clock;
use tandem_board::{Duration, Instant};

/// A clock that has drifted by more than this beyond what is permitted is wrong, µs. Half of what
/// the vehicle's gate tolerates: a system leaves before its frames look late.
const WRONG_US: i32 = 20_000;
/// The largest difference of this time is the offset. Ten control periods.
const WINDOW: Duration = Duration::from_ms(100);
/// Drift that is permitted for ever, µs in each window: 0.1 %. Ten times what a quartz has.
const PERMITTED_US: i32 = 100;
/// The first windows give the offset to begin with.
const SETTLING_WINDOWS: u8 = 2;
/// A step of the offset beyond this is a clock that was set or begins anew, µs.
const SET_US: i32 = 1_000_000;

/// The offset of one other clock.
#[derive(Clone, Copy, Debug)]
struct Offset {
    /// Where it is taken to be, µs; wraps around. Follows the drift that is permitted.
    reference: u32,
    /// The largest difference of this window, beyond the reference, µs, and when the window began.
    largest: i32,
    began: Instant,
    heard: Instant,
    settled: u8,
    /// How far the offset is from where it was, µs; above zero if the own clock falls behind.
    drifted: i32,
}

impl Offset {
    fn new(at: Instant, difference: u32) -> Self {
        Self {
            reference: difference,
            largest: 0,
            began: at,
            heard: at,
            settled: 0,
            drifted: 0,
        }
    }

    /// The other clock showed something that is so much beyond the own one's `at`, µs. Returns for
    /// how long that was on the way, beyond what is usual, µs.
    fn update(&mut self, at: Instant, difference: u32) -> i32 {
        let beyond = difference.wrapping_sub(self.reference) as i32;
        if at.since(self.heard) > WINDOW || !(-SET_US..SET_US).contains(&beyond) {
            *self = Self::new(at, difference);
            return 0;
        }
        self.heard = at;
        if at.since(self.began) >= WINDOW {
            self.began = at;
            self.end_window();
            self.largest = i32::MIN;
        }
        let beyond = difference.wrapping_sub(self.reference) as i32;
        self.largest = self.largest.max(beyond);
        if self.settled < SETTLING_WINDOWS {
            self.reference = self.reference.wrapping_add(beyond.max(0) as u32);
            self.largest = 0;
        } else {
            self.drifted = self.drifted.max(beyond);
        }
        -beyond
    }

    fn end_window(&mut self) {
        if self.settled < SETTLING_WINDOWS {
            self.settled += 1;
            return;
        }
        self.drifted = self.largest;
        let follows = self.largest.clamp(-PERMITTED_US, PERMITTED_US);
        self.reference = self.reference.wrapping_add(follows as u32);
    }
}

/// Compares the own clock with both others.
#[derive(Clone, Debug, Default)]
pub(crate) struct Clocks {
    vehicle: Option<Offset>,
    peer: Option<Offset>,
    /// The vehicle's clock, µs, and the last eight bits of its milliseconds.
    vehicle_us: u32,
    vehicle_ms: u8,
    /// What the comparison says, and since when.
    found: Option<(Clock, Instant)>,
    is_told: bool,
}

const fn us(at: Instant) -> u32 {
    (at.as_ns() / 1_000) as u32
}

/// `other`: the offset of the third clock. Both begin anew together, so that both tell of the same
/// time.
fn update(
    offset: &mut Option<Offset>,
    other: &mut Option<Offset>,
    at: Instant,
    theirs_us: u32,
) -> i32 {
    let difference = theirs_us.wrapping_sub(us(at));
    let offset = offset.get_or_insert(Offset::new(at, difference));
    let late = offset.update(at, difference);
    if offset.settled == 0 && other.is_some_and(|it| it.settled >= SETTLING_WINDOWS) {
        *other = None;
    }
    late
}

impl Clocks {
    /// The vehicle's clock showed this when it sent what arrived at `at`: milliseconds, the last
    /// eight bits.
    pub(crate) fn on_vehicle(&mut self, at: Instant, sent_ms: u8) {
        let passed = sent_ms.wrapping_sub(core::mem::replace(&mut self.vehicle_ms, sent_ms));
        self.vehicle_us = self.vehicle_us.wrapping_add(u32::from(passed) * 1_000);
        let _delay = update(&mut self.vehicle, &mut self.peer, at, self.vehicle_us);
    }

    /// The other system's clock showed this when it sent what arrived at `at`, µs; wraps around.
    /// Returns for how much longer than usual that was on its way.
    pub(crate) fn on_peer(&mut self, at: Instant, sent_us: u32) -> Duration {
        let late = update(&mut self.peer, &mut self.vehicle, at, sent_us);
        Duration::from_us(late.max(0) as u64)
    }

    /// The other system's clock begins anew.
    pub(crate) fn forget_peer(&mut self) {
        self.peer = None;
    }

    /// Whose clock is wrong, once for each; nothing if there are not three clocks to compare.
    pub(crate) fn judge(&mut self, now: Instant) -> Option<Clock> {
        let fresh = |offset: &Option<Offset>| {
            let heard = |it: &Offset| now.since(it.heard) <= WINDOW;
            offset.filter(heard).map(|it| it.drifted)
        };
        let (vehicle, peer) = fresh(&self.vehicle).zip(fresh(&self.peer))?;
        let clock = match (vehicle.abs() > WRONG_US, peer.abs() > WRONG_US) {
            // Both others have drifted the same way, and about as far.
            (true, true) if (vehicle - peer).abs() <= vehicle.abs().max(peer.abs()) / 2 => {
                Some(Clock::Own)
            }
            (true, false) if peer.abs() <= WRONG_US / 2 => Some(Clock::Vehicle),
            (false, true) if vehicle.abs() <= WRONG_US / 2 => Some(Clock::Peer),
            _ => None,
        };
        if self.found.map(|(before, _)| before) != clock {
            self.found = clock.map(|clock| (clock, now));
            self.is_told = false;
        }
        // The offsets are known one after the other.
        let (clock, since) = self.found?;
        let holds = clock == Clock::Own || now.since(since) >= WINDOW.times(2);
        (holds && !core::mem::replace(&mut self.is_told, true)).then_some(clock)
    }
}
