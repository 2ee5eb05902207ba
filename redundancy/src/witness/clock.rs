//! The witness of the clocks: how far this system's clock has drifted from the vehicle's and from
//! the other system's. Of three clocks, the one that differs from two is wrong.
//!
//! Each frame carries the time of sending on the sender's clock. The difference to the local clock
//! is the offset of the two clocks minus the transmission time. A late frame only lowers the
//! difference, so the largest difference of a window is the offset, and a stall of any of the three
//! does not count as drift.

use crate::ClockOwner;
use tandem_board::{Duration, Instant};

/// A clock is wrong if it has drifted by more than this beyond the permitted drift, µs. Half of the
/// vehicle's tolerance, so that a system leaves before its frames seem late.
const WRONG_US: i32 = 20_000;
/// The largest difference within this time is the offset. Ten control periods.
const WINDOW: Duration = Duration::from_ms(100);
/// Permitted drift, µs in each window: 0.1 %, ten times that of a quartz.
const PERMITTED_US: i32 = 100;
/// This many windows at the beginning determine the initial offset.
const SETTLING_WINDOWS: u8 = 2;
/// A larger step of the offset means that the clock was set or has restarted, µs.
const SET_US: i32 = 1_000_000;

/// The offset of one other clock.
#[derive(Clone, Copy, Debug)]
struct Offset {
    /// The assumed offset, µs; wraps around. Follows the permitted drift.
    reference: u32,
    /// The largest difference of this window, beyond the reference, µs, and when the window began.
    largest: i32,
    began: Instant,
    heard: Instant,
    settled: u8,
    /// Drift of the offset, µs; above zero if the local clock falls behind.
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

    /// Takes the difference between the other clock at sending and the local clock at `at`, µs.
    /// Returns how much longer than usual the frame took, µs.
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

/// Compares this system's clock with both others.
#[derive(Clone, Debug, Default)]
pub(crate) struct Clocks {
    vehicle: Option<Offset>,
    peer: Option<Offset>,
    /// The vehicle's clock, µs, and the last eight bits of its milliseconds.
    vehicle_us: u32,
    vehicle_ms: u8,
    /// The result of the comparison, and since when it holds.
    found: Option<(ClockOwner, Instant)>,
    is_reported: bool,
}

const fn us(at: Instant) -> u32 {
    (at.as_ns() / 1_000) as u32
}

/// Updates one offset. `other` is the offset of the third clock: both restart together, so that
/// both cover the same time.
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
    /// Handles the vehicle's clock when it sent the frame that arrived at `at`: the last eight bits
    /// of its milliseconds.
    pub(crate) fn on_vehicle(&mut self, at: Instant, sent_ms: u8) {
        let passed = sent_ms.wrapping_sub(core::mem::replace(&mut self.vehicle_ms, sent_ms));
        self.vehicle_us = self.vehicle_us.wrapping_add(u32::from(passed) * 1_000);
        let _delay = update(&mut self.vehicle, &mut self.peer, at, self.vehicle_us);
    }

    /// Handles the other system's clock when it sent the report that arrived at `at`, µs; wraps
    /// around. Returns how much longer than usual the report took.
    pub(crate) fn on_peer(&mut self, at: Instant, sent_us: u32) -> Duration {
        let late = update(&mut self.peer, &mut self.vehicle, at, sent_us);
        Duration::from_us(late.max(0) as u64)
    }

    /// Forgets the other system's clock, because it has restarted.
    pub(crate) fn forget_peer(&mut self) {
        self.peer = None;
    }

    /// Returns whose clock is wrong, once for each finding; `None` with fewer than three clocks.
    pub(crate) fn judge(&mut self, now: Instant) -> Option<ClockOwner> {
        let fresh = |offset: &Option<Offset>| {
            let heard = |it: &Offset| now.since(it.heard) <= WINDOW;
            offset.filter(heard).map(|it| it.drifted)
        };
        let (vehicle, peer) = fresh(&self.vehicle).zip(fresh(&self.peer))?;
        let clock = match (vehicle.abs() > WRONG_US, peer.abs() > WRONG_US) {
            // Both others have drifted in the same direction, by about the same amount.
            (true, true) if (vehicle - peer).abs() <= vehicle.abs().max(peer.abs()) / 2 => {
                Some(ClockOwner::Own)
            }
            (true, false) if peer.abs() <= WRONG_US / 2 => Some(ClockOwner::Vehicle),
            (false, true) if vehicle.abs() <= WRONG_US / 2 => Some(ClockOwner::Peer),
            _ => None,
        };
        if self.found.map(|(before, _)| before) != clock {
            self.found = clock.map(|clock| (clock, now));
            self.is_reported = false;
        }
        // The two offsets become known at different times: wait for both.
        let (clock, since) = self.found?;
        let holds = clock == ClockOwner::Own || now.since(since) >= WINDOW.times(2);
        (holds && !core::mem::replace(&mut self.is_reported, true)).then_some(clock)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::vec::Vec;

    const START_US: u32 = 7_000_000;

    fn at(ms: u32) -> Instant {
        Instant::from_ns(u64::from(ms) * 1_000_000)
    }

    /// Of three clocks the one that differs from both others is wrong, and is reported once. A
    /// drift of 0.05 % is permitted.
    #[test]
    fn the_clock_that_differs_from_both_others_is_wrong() {
        for (peer, vehicle, expected) in [
            (0, 0, None),
            (5, -5, None),
            (100, -100, None),
            (100, 80, Some(ClockOwner::Own)),
            (100, 100, Some(ClockOwner::Own)),
            (-100, -100, Some(ClockOwner::Own)),
            (100, 0, Some(ClockOwner::Peer)),
            (-100, 0, Some(ClockOwner::Peer)),
            (0, 100, Some(ClockOwner::Vehicle)),
            (0, -100, Some(ClockOwner::Vehicle)),
        ] {
            let mut clocks = Clocks::default();
            // Hundredths of a percent.
            let us = |ms: u32, drift: i32| (ms * 1_000).wrapping_add_signed(ms as i32 * drift / 10);
            let mut reported = Vec::new();
            for ms in (0..60_000).step_by(10) {
                if expected.is_some() && ms > 5_000 {
                    break;
                }
                clocks.on_vehicle(at(ms), (us(ms, vehicle) / 1_000) as u8);
                let _late = clocks.on_peer(at(ms), START_US + us(ms, peer));
                reported.extend(clocks.judge(at(ms)));
            }
            assert_eq!(reported, Vec::from_iter(expected), "{peer} {vehicle}");
        }
    }

    /// The first windows find the offset: a first report that was late does not count as drift.
    #[test]
    fn a_late_first_report_is_no_drift() {
        let mut clocks = Clocks::default();
        for ms in (0..2_000).step_by(10) {
            let late_us = if ms == 0 { 30_000 } else { 0 };
            clocks.on_vehicle(at(ms), ms as u8);
            let _late = clocks.on_peer(at(ms), START_US + ms * 1_000 - late_us);
            assert_eq!(clocks.judge(at(ms)), None, "after {ms} ms");
        }
    }

    /// If this system's clock is ahead of both others, one window is enough to find it: the first
    /// one after those that determine the offsets.
    #[test]
    fn a_clock_that_is_ahead_is_found_after_one_window() {
        let mut clocks = Clocks::default();
        let found = (0..1_000).step_by(10).find(|&ms| {
            let ahead = if ms >= 200 { 40 } else { 0 };
            clocks.on_vehicle(at(ms + ahead), ms as u8);
            let _late = clocks.on_peer(at(ms + ahead), START_US + ms * 1_000);
            clocks.judge(at(ms + ahead)) == Some(ClockOwner::Own)
        });
        assert_eq!(found, Some(300));
    }

    /// After more than a window without a report, the comparison of the clocks starts again.
    #[test]
    fn a_clock_that_paused_is_compared_anew() {
        const LATE_US: u32 = 50_000;
        for (pause_ms, expected_us) in [(100, LATE_US), (101, 0)] {
            let mut clocks = Clocks::default();
            let mut hear = |ms, late_us| clocks.on_peer(at(ms), START_US + ms * 1_000 - late_us);
            for ms in (0..=400).step_by(10) {
                assert_eq!(hear(ms, 0), Duration::ZERO);
            }
            let late = hear(400 + pause_ms, LATE_US);
            assert_eq!(late, Duration::from_us(expected_us.into()), "{pause_ms} ms");
        }
    }
}
