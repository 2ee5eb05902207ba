//! When the sensors measured: their stamps on the clock of the recording.

use tandem_board::{CanId, Instant, SystemId};
use tandem_bus::{SensorHeader, TimeStateCode, TimeSync};
use tandem_timesync::{Arbitrary, CanTimeCrc, CanTimeSlave};
use tandem_vehicle::LoggedFrame;

/// A stamp that is farther than this from its frame, µs, is of another clock.
const FAR_US: u32 = 1_000_000;
/// The bus alone takes less than this from a measurement to its frame, µs, at least once in a run.
const BUS_US: u32 = 2_000;

/// Follows the frames of time in the log, as each sensor does: so it knows what a stamp in global
/// time means on the recording's clock.
#[derive(Clone, Debug)]
pub struct SensorTime {
    slave: CanTimeSlave<Arbitrary>,
    /// The newest sample: time of the recording, and global time, µs, which wraps around.
    newest: Option<(Instant, u32)>,
    /// A sensor has stamped in global time.
    is_global: bool,
    /// The shortest time from a measurement on a sensor's own clock to its header, µs.
    shortest_us: Option<u32>,
}

impl Default for SensorTime {
    fn default() -> Self {
        Self {
            slave: CanTimeSlave::new(CanTimeCrc::Validated),
            newest: None,
            is_global: false,
            shortest_us: None,
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
    pub(crate) fn measured_ns(&mut self, at: Instant, header: &SensorHeader) -> u64 {
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
        let is_own = header.time_state == TimeStateCode::OwnClock;
        self.is_global |= !is_own;
        if is_own && is_near {
            let shortest_us = self.shortest_us.unwrap_or(on_the_way_us);
            self.shortest_us = Some(shortest_us.min(on_the_way_us));
        }
        let on_the_way_ns = if is_near {
            u64::from(on_the_way_us) * 1_000
        } else {
            0
        };
        at.as_ns().saturating_sub(on_the_way_ns)
    }

    /// Returns the part of the measurements' age that no controller sees, ns: a delay that all
    /// sensors have, without stamps in global time.
    pub(crate) fn unseen_ns(&self) -> u64 {
        let is_unseen = |us: &u32| !self.is_global && *us >= BUS_US;
        u64::from(self.shortest_us.filter(is_unseen).unwrap_or(0)) * 1_000
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

    fn header(time_state: TimeStateCode, measured_at: u32) -> SensorHeader {
        SensorHeader {
            time_state,
            measured_at,
            object_count: 0,
        }
    }

    /// A stamp in global time is converted by the frames of time before it; one on the recording's
    /// clock is used as it is, and one on neither is not used.
    #[test]
    fn stamps_are_on_the_clock_of_the_recording() {
        let mut time = SensorTime::default();
        // 100 s before the global microseconds wrap.
        let ahead_ns = (u64::from(u32::MAX) - 100_000_000) * 1_000;
        let global = |at: Instant| GlobalTime::<Arbitrary>::from_ns(at.as_ns() + ahead_ns);
        let global_us = |at: Instant| (global(at).as_ns() / 1_000) as u32;
        let measured = |time: &mut SensorTime, state, ms, us| {
            time.measured_ns(at(ms), &header(state, us)) / 1_000
        };
        let early = global_us(at(980));
        assert_eq!(
            measured(&mut time, TimeStateCode::Global, 1_000, early),
            1_000_000
        );
        assert_eq!(
            measured(&mut time, TimeStateCode::OwnClock, 1_000, 985_000),
            985_000
        );
        assert_eq!(
            measured(&mut time, TimeStateCode::OwnClock, 2_000, 985_000),
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
            master.on_sent(at(ms), global(at(ms)), false);
        }
        assert_eq!(time.unseen_ns(), 0, "global stamps show all delays");
        let (ms, expected) = (200_050, 200_030_000);
        for state in [TimeStateCode::Global, TimeStateCode::Holdover] {
            let found = measured(&mut time, state, ms, global_us(at(ms - 20)));
            assert!(found.abs_diff(expected) <= 1, "{found}");
        }
    }

    /// A delay of all sensors' own clocks is the part of the age that no controller sees; the bus
    /// alone is none.
    #[test]
    fn the_shortest_delay_of_own_clocks_is_unseen() {
        for (delays_ms, expected_ms) in [([3, 20, 25], 3), ([20, 20, 45], 20), ([20, 1, 30], 0)] {
            let mut time = SensorTime::default();
            for delay_ms in delays_ms {
                let stamp = header(TimeStateCode::OwnClock, 70_000);
                time.measured_ns(at(70 + delay_ms), &stamp);
            }
            assert_eq!(time.unseen_ns(), expected_ms * MS, "{delays_ms:?}");
        }
    }
}
