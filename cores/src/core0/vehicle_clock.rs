//! The vehicle's clock, as its echoes tell it: control frames carry this time, so that the vehicle
//! knows how old they are.

use heapless::HistoryBuf;
use tandem_board::{Duration, Instant};

/// One forged or late echo among this many has no effect.
const ECHOES: usize = 3;

/// How far the vehicle's clock is behind this system's, by the last echoes.
///
/// The echo's way is included. So a frame seems older than it is by that way, and a queue in either
/// direction makes it old.
#[derive(Clone, Debug, Default)]
pub(super) struct VehicleClock {
    /// Differences of the clocks, ms modulo 2^16.
    behind: HistoryBuf<u16, ECHOES>,
    /// When the last echo arrived.
    last: Option<Instant>,
    /// When an echo with a wrong counter said another time: another node sends in the vehicle's
    /// name, and either of them may be right.
    disputed: Option<Instant>,
}

/// Two echoes of one vehicle differ by less, ms: what a queue may add from one to the next.
const SAME_MS: u16 = 20;
/// Without an echo for longer, the time is not known: the vehicle is silent, or this system's clock
/// has jumped.
const SILENCE: Duration = Duration::from_ms(100);

fn ms(at: Instant) -> u16 {
    (at.as_ns() / 1_000_000) as u16
}

impl VehicleClock {
    /// Takes an echo that arrived at `at` and was sent at `sent_ms` on the vehicle's clock.
    pub(super) fn on_echo(&mut self, at: Instant, sent_ms: u16) {
        if !self.is_known(at) {
            self.behind = HistoryBuf::new();
        }
        self.last = Some(at);
        self.behind.write(ms(at).wrapping_sub(sent_ms));
    }

    /// Takes the time of an echo with a right CRC and a wrong counter.
    pub(super) fn on_stale_echo(&mut self, at: Instant, sent_ms: u16) {
        let newest = self.behind.recent().filter(|_| self.is_known(at));
        let apart = |behind: &u16| ms(at).wrapping_sub(*behind).wrapping_sub(sent_ms) as i16;
        let differs = newest.is_some_and(|behind| apart(behind).unsigned_abs() > SAME_MS);
        if differs {
            self.disputed = Some(at);
        }
    }

    fn is_known(&self, now: Instant) -> bool {
        self.last
            .is_some_and(|last| now >= last && now.since(last) <= SILENCE)
    }

    /// Returns the time on the vehicle's clock, ms modulo 2^16; `None` if no echo was heard lately,
    /// or if it was disputed.
    pub(super) fn at(&self, now: Instant) -> Option<u16> {
        let lately = |at: Instant| now >= at && now.since(at) <= SILENCE;
        self.median(now)
            .filter(|_| !self.disputed.is_some_and(lately))
    }

    fn median(&self, now: Instant) -> Option<u16> {
        if !self.is_known(now) {
            return None;
        }
        let newest = *self.behind.recent()?;
        let behind = self.behind.as_slice();
        // The median: differences modulo 2^16 have an order only relative to one of them.
        let mut from_newest = [0; ECHOES];
        for (from, behind) in from_newest.iter_mut().zip(behind) {
            *from = behind.wrapping_sub(newest) as i16;
        }
        let from_newest = from_newest.get_mut(..behind.len())?;
        from_newest.sort_unstable();
        let middle = *from_newest.get(from_newest.len() / 2)?;
        Some(ms(now).wrapping_sub(newest.wrapping_add_signed(middle)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const fn at(ms: u64) -> Instant {
        Instant::from_ns(ms * 1_000_000)
    }

    /// The time is that of the vehicle, also when both clocks wrap around.
    #[test]
    fn the_vehicle_tells_the_time() {
        let mut clock = VehicleClock::default();
        assert_eq!(clock.at(at(5)), None);
        for step in 0..20_000_u64 {
            let now = at(60_000 + step * 10);
            let sent = (step * 10 + 7) as u16;
            clock.on_echo(now, sent);
            assert_eq!(
                clock.at(now + Duration::from_ms(4)),
                Some(sent.wrapping_add(4))
            );
        }
    }

    /// A clock that has jumped says nothing until the next echo, and then the right time.
    #[test]
    fn a_clock_that_jumps_does_not_tell_a_wrong_time() {
        for jumped in [10_540, 9_540] {
            let mut clock = VehicleClock::default();
            for step in 0..4_u16 {
                clock.on_echo(at(10_000 + u64::from(step) * 10), 100 + step * 10);
            }
            assert_eq!(clock.at(at(jumped)), None);
            clock.on_echo(at(jumped), 140);
            assert_eq!(clock.at(at(jumped + 3)), Some(143));
        }
    }

    /// T-RED-9: two nodes that both send in the vehicle's name are found at the first pair of
    /// echoes that differ. The time is not known until one of them has been silent for 100 ms.
    #[test]
    fn echoes_of_two_nodes_are_in_dispute() {
        let mut clock = VehicleClock::default();
        for step in 0..60_u64 {
            let now = at(1_000 + step * 10);
            let right = (100 + step * 10) as u16;
            let forged = (10..30).contains(&step);
            clock.on_echo(now, if forged { 7 } else { right });
            if forged {
                clock.on_stale_echo(now, right);
            }
            let is_disputed = (10..40).contains(&step);
            assert_eq!(clock.at(now), (!is_disputed).then_some(right), "{step}");
            // A frame that is sent twice is no dispute.
            clock.on_stale_echo(now, right.wrapping_sub(10));
        }
    }

    /// T-RED-9: no single echo with a wrong time has an effect, whatever its time is.
    #[test]
    fn one_wrong_echo_has_no_effect() {
        for wrong in [0, 1, 99, 101, 0x7FFF, 0x8000, 0x8064, u16::MAX] {
            let mut clock = VehicleClock::default();
            for step in 0..30_u64 {
                let now = at(1_000 + step * 10);
                let right = (100 + step * 10) as u16;
                clock.on_echo(now, if step % 3 == 2 { wrong } else { right });
                if step >= 2 {
                    assert_eq!(clock.at(now), Some(right), "{wrong} {step}");
                }
            }
        }
    }
}
