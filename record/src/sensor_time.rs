//! When the sensors measured: their stamps on the clock of the recording.

use tandem_board::{CanId, Instant, SystemId};
use tandem_bus::{SensorHeader, TimeStateCode, TimeSync};
use tandem_timesync::{Arbitrary, CanTimeCrc, CanTimeSlave};
use tandem_vehicle::LoggedFrame;

/// A stamp that is farther than this from its frame, µs, is of another clock.
const FAR_US: u32 = 1_000_000;

/// Follows the frames of time in the log, as each sensor does: so it knows what a stamp in global
/// time means on the recording's clock.
#[derive(Clone, Debug)]
pub struct SensorTime {
    slave: CanTimeSlave<Arbitrary>,
    /// The newest sample: time of the recording, and global time, µs, which wraps around.
    newest: Option<(Instant, u32)>,
}

impl Default for SensorTime {
    fn default() -> Self {
        Self {
            slave: CanTimeSlave::new(CanTimeCrc::Validated),
            newest: None,
        }
    }
}

impl SensorTime {
    /// Takes a frame of the log, in the order of the bus.
    pub(crate) fn hear(&mut self, logged: &LoggedFrame) {
        let CanId::Standard(id) = logged.frame.id() else {
            return;
        };
        let index = TimeSync::IDS.iter().position(|of_time| *of_time == id);
        let Some(from) = index.and_then(SystemId::from_index) else {
            return;
        };
        if let Ok(Some(heard)) = self.slave.receive(from, logged.at, logged.frame.data()) {
            let global_us = (heard.sample.global.as_ns() / 1_000) as u32;
            self.newest = Some((heard.sample.local, global_us));
        }
    }

    /// Returns when a list was measured whose header was on the bus at `at`, ns on the recording's
    /// clock. A sensor's own clock is taken for that of the recording. If the stamp shows that it
    /// is not, the time on the bus is returned.
    pub(crate) fn measured_ns(&self, at: Instant, header: &SensorHeader) -> u64 {
        let at_us = (at.as_ns() / 1_000) as u32;
        let now_us = match (header.time_state, self.newest) {
            (TimeStateCode::OwnClock, _) => at_us,
            (_, Some((local, global_us))) => {
                let since_us = (at.since(local).as_ns() / 1_000) as u32;
                global_us.wrapping_add(since_us)
            }
            (_, None) => header.measured_at,
        };
        let on_the_way_us = now_us.wrapping_sub(header.measured_at);
        let is_near = on_the_way_us <= FAR_US;
        let on_the_way_ns = if is_near {
            u64::from(on_the_way_us) * 1_000
        } else {
            0
        };
        at.as_ns().saturating_sub(on_the_way_ns)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tandem_board::CanFrame;
    use tandem_timesync::{CanTimeMaster, GlobalTime};

    const MS: u64 = 1_000_000;

    fn at(ms: u64) -> Instant {
        Instant::from_ns(ms * MS)
    }

    /// A stamp in global time is converted by the frames of time before it; one on the recording's
    /// clock is used as it is, and one on neither is not used.
    #[test]
    fn stamps_are_on_the_clock_of_the_recording() {
        let header = |time_state, measured_at| SensorHeader {
            time_state,
            measured_at,
            object_count: 0,
        };
        let mut time = SensorTime::default();
        // 100 s before the global microseconds wrap.
        let ahead_ns = (u64::from(u32::MAX) - 100_000_000) * 1_000;
        let global = |at: Instant| GlobalTime::<Arbitrary>::from_ns(at.as_ns() + ahead_ns);
        let global_us = |at: Instant| (global(at).as_ns() / 1_000) as u32;
        let measured =
            |time: &SensorTime, state, ms, us| time.measured_ns(at(ms), &header(state, us)) / 1_000;
        let early = global_us(at(980));
        assert_eq!(
            measured(&time, TimeStateCode::Global, 1_000, early),
            1_000_000
        );
        assert_eq!(
            measured(&time, TimeStateCode::OwnClock, 1_000, 985_000),
            985_000
        );
        assert_eq!(
            measured(&time, TimeStateCode::OwnClock, 2_000, 985_000),
            2_000_000
        );
        let mut master = CanTimeMaster::new(SystemId::B, true, at(0));
        for ms in 0..200_000 {
            let Some(bytes) = master.poll(at(ms), global(at(ms))) else {
                continue;
            };
            let frame = CanFrame::new(CanId::Standard(TimeSync::IDS[1]), false, &bytes).unwrap();
            time.hear(&LoggedFrame {
                at: at(ms),
                sent: at(ms),
                frame,
                ruling: None,
            });
            master.on_sent(&bytes, at(ms), global(at(ms)), false);
        }
        let (ms, expected) = (200_050, 200_030_000);
        for state in [TimeStateCode::Global, TimeStateCode::Holdover] {
            let found = measured(&time, state, ms, global_us(at(ms - 20)));
            assert!(found.abs_diff(expected) <= 1, "{found}");
        }
    }
}
