//! The vehicle's clock, as its echoes tell it: control frames carry this time, so that the vehicle
//! knows how old they are.

use heapless::HistoryBuf;
use tandem_board::Instant;

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
}

fn ms(at: Instant) -> u16 {
    (at.as_ns() / 1_000_000) as u16
}

impl VehicleClock {
    /// Takes an echo that arrived at `at` and was sent at `sent_ms` on the vehicle's clock.
    pub(super) fn on_echo(&mut self, at: Instant, sent_ms: u16) {
        self.behind.write(ms(at).wrapping_sub(sent_ms));
    }

    /// Returns the time on the vehicle's clock, ms modulo 2^16; `None` before the first echo.
    pub(super) fn at(&self, now: Instant) -> Option<u16> {
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
    use tandem_board::Duration;

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
