//! The CAN bus: how many frames a core may put on it, and the fault confinement of its controller.

use tandem_board::{CanErrors, CanState, Duration, Instant};

/// Frames that one core can send in a millisecond. A bus of 1 Mbit/s carries at most 20, and a core
/// without a fault sends 2 in 10 ms. A core that sends without a pause leaves the rest of the bus
/// to the others; its own frames wait in its transmit buffer until that is full.
pub const FRAMES_PER_MS: u32 = 8;

/// How much of its bus share one core has used.
#[derive(Clone, Copy, Debug, Default)]
pub struct TransmitLimit {
    /// The millisecond in which the frames are counted.
    ms: u64,
    /// Frames sent in that millisecond.
    sent: u32,
}

impl TransmitLimit {
    /// Returns whether the core may send a frame at `now`.
    #[must_use]
    pub const fn allows(&self, now: Instant) -> bool {
        self.sent < FRAMES_PER_MS || self.ms != ms(now)
    }

    /// Counts a frame that the core has sent at `now`.
    pub const fn count(&mut self, now: Instant) {
        if self.ms != ms(now) {
            *self = Self {
                ms: ms(now),
                sent: 0,
            };
        }
        self.sent = self.sent.saturating_add(1);
    }
}

const fn ms(now: Instant) -> u64 {
    now.as_ns() / 1_000_000
}

/// A frame that the bus destroyed is repeated after this time, about that of a short frame with its
/// error frame.
pub const REPEATED_AFTER: Duration = Duration::from_us(125);
/// If a try is later than this, the bus was stalled and repeated no frame in that time.
const HELD_UP: Duration = Duration::from_ms(2);
/// 128 times 11 recessive bits on an idle bus of 1 Mbit/s: how long a controller stays bus-off.
pub const RECOVERY: Duration = Duration::from_us(128 * 11);

/// The fault confinement of one CAN controller: its error counters. ISO 11898-1
///
/// A destroyed frame adds 8 to the transmit counter, a sent one subtracts 1. A frame received with
/// an error adds 1 to the receive counter, one without subtracts 1. In this model a bus-off
/// controller still receives, and a missing acknowledgement is not an error.
#[derive(Clone, Copy, Debug, Default)]
pub struct Confinement {
    errors: CanErrors,
    /// When the controller may try to send again; the end of bus-off.
    due: Instant,
}

impl Confinement {
    /// Creates the fault confinement of a controller after a reset.
    #[must_use]
    pub const fn new() -> Self {
        Self {
            errors: CanErrors {
                transmit: 0,
                receive: 0,
                bus_offs: 0,
            },
            due: Instant::ORIGIN,
        }
    }

    /// Returns the counters at `now`.
    pub fn errors(&mut self, now: Instant) -> CanErrors {
        if self.errors.state() == CanState::BusOff && now >= self.due {
            (self.errors.transmit, self.errors.receive) = (0, 0);
        }
        self.errors
    }

    /// Returns the state at the last call.
    #[must_use]
    pub const fn state(&self) -> CanState {
        self.errors.state()
    }

    /// Returns the time at which a frame that could not be sent may be tried again.
    #[must_use]
    pub const fn due(&self) -> Instant {
        self.due
    }

    /// Tries to send a frame at `now`; the bus destroys it if `fails`. Returns whether the frame is
    /// on the bus. If not, the controller tries it again at [`Confinement::due`]. A late call
    /// counts all tries since then.
    pub fn sends(&mut self, now: Instant, fails: bool) -> bool {
        if now.since(self.due) > HELD_UP {
            self.due = now;
        }
        while now >= self.due {
            self.errors(now);
            if !fails {
                self.errors.transmit = self.errors.transmit.saturating_sub(1);
                return true;
            }
            self.errors.transmit += 8;
            self.due += if self.errors.transmit < CanErrors::BUS_OFF {
                REPEATED_AFTER
            } else {
                self.errors.transmit = CanErrors::BUS_OFF;
                self.errors.bus_offs = self.errors.bus_offs.wrapping_add(1);
                RECOVERY
            };
        }
        false
    }

    /// Counts a frame that the controller has received, with an error if `fails`.
    pub const fn hears(&mut self, fails: bool) {
        const PASSIVE: u8 = CanErrors::PASSIVE as u8;
        let count = &mut self.errors.receive;
        *count = match (fails, *count) {
            (true, count) => count.saturating_add(1),
            // A passive receiver becomes active with its first good frame.
            (false, PASSIVE..) => PASSIVE - 1,
            (false, count) => count.saturating_sub(1),
        };
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::vec;

    fn us(us: u64) -> Instant {
        Instant::from_ns(us * 1_000)
    }

    /// ISO 11898-1: 16 destroyed frames make a controller error-passive, 32 bus-off, and 128 times
    /// 11 recessive bits error-active, however often it is polled.
    #[test]
    fn a_controller_that_cannot_send_goes_bus_off_and_recovers() {
        for step in [25, 125, 1_000] {
            let mut controller = Confinement::default();
            let mut seen = vec![];
            for at in (10_000..15_000).step_by(step) {
                assert!(!controller.sends(us(at), true));
                let state = controller.errors(us(at)).state();
                if seen.last().is_none_or(|(_, last)| *last != state) {
                    seen.push((at, state));
                }
            }
            let near = |at: u64, expected: u64| (expected..=expected + step as u64).contains(&at);
            use CanState::{BusOff, ErrorActive, ErrorPassive};
            let expected = [
                (10_000, ErrorActive),
                (10_000 + 15 * 125, ErrorPassive),
                (10_000 + 31 * 125, BusOff),
            ];
            for ((at, state), (expected_at, expected)) in seen.iter().zip(expected) {
                assert_eq!(*state, expected, "{step} us: {seen:?}");
                assert!(near(*at, expected_at), "{step} us: {seen:?}");
            }
            assert_eq!(controller.errors(us(15_000)).bus_offs, 1);
        }
        let mut controller = Confinement::default();
        while controller.errors(us(0)).state() != CanState::BusOff {
            controller.sends(controller.due(), true);
        }
        let over = controller.due();
        let before = Instant::from_ns(over.as_ns() - 1);
        assert!(!controller.sends(before, false), "bus-off sends nothing");
        assert_eq!(controller.errors(before).transmit, CanErrors::BUS_OFF);
        assert_eq!(controller.errors(over).state(), CanState::ErrorActive);
        assert!(controller.sends(over, false));
        assert_eq!(controller.errors(over).bus_offs, 1, "counts for ever");
    }

    #[test]
    fn sent_frames_bring_the_counter_down_by_one_each() {
        let mut controller = Confinement::default();
        for _ in 0..3 {
            assert!(!controller.sends(controller.due(), true));
        }
        let now = controller.due();
        assert_eq!(controller.errors(now).transmit, 24);
        for left in (0..24).rev() {
            assert!(controller.sends(now, false));
            assert_eq!(controller.errors(now).transmit, left);
        }
        assert!(controller.sends(now, false));
        assert_eq!(controller.errors(now), CanErrors::default());
    }

    /// A bus whose process was stopped has repeated nothing.
    #[test]
    fn the_time_in_which_the_bus_was_held_up_does_not_count() {
        let mut controller = Confinement::default();
        assert!(!controller.sends(us(10_000), true));
        assert!(!controller.sends(us(900_000), true));
        assert_eq!(controller.errors(us(900_000)).transmit, 16);
    }

    #[test]
    fn a_receiver_becomes_passive_but_never_bus_off() {
        let mut controller = Confinement::default();
        let state = |controller: &mut Confinement| controller.errors(us(0)).state();
        for heard in 1..400 {
            controller.hears(true);
            let passive = state(&mut controller) == CanState::ErrorPassive;
            assert_eq!(passive, heard >= 128, "{heard} errors");
        }
        controller.hears(false);
        assert_eq!(state(&mut controller), CanState::ErrorActive);
        (0..200).for_each(|_| controller.hears(false));
        assert_eq!(controller.errors(us(0)).receive, 0);
    }

    #[test]
    fn a_core_sends_its_share_of_each_millisecond() {
        let mut limit = TransmitLimit::default();
        for ms in [0, 1, 7] {
            for us in [0, 999] {
                let now = Instant::from_ns(ms * 1_000_000 + us * 1_000);
                assert_eq!(limit.allows(now), us == 0, "{ms} ms {us} us");
                for sent in 0..FRAMES_PER_MS {
                    assert_eq!(limit.allows(now), us == 0, "{ms} ms, {sent} sent");
                    limit.count(now);
                }
            }
        }
    }
}
