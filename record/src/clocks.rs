//! The vehicle's time in a recording: whom each clock followed, and how far apart both systems'
//! clocks and control cycles were. S-1, S-5

use tandem_board::{CoreId, Traced};
use tandem_bus::{Message, SensorId, TimeStateCode};
use tandem_cores::task_table::TaskCode;
use tandem_cores::trace::{Begin, Event};

use crate::file::Entry;
use crate::log::{ClockSample, ClockState, SocTime, VehicleRecord};

/// Two states of clocks belong together if they are not further apart, ns. Each is traced ten times
/// a second.
const TOGETHER_NS: u64 = 150_000_000;
/// A system has the clock of the run if it reads the time so shortly before its trace record, ns.
const SAME_CLOCK_NS: u32 = 10_000_000;
/// Two control cycles belong together if they are not further apart: half a period, ns.
const HALF_CYCLE_NS: u64 = 5_000_000;

/// A clock that shows the vehicle's time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ChainClock {
    /// Core 0 of system A.
    A,
    /// Core 0 of system B.
    B,
    /// The ADAS computer.
    Soc,
}

impl ChainClock {
    /// All, in the order of their indices.
    pub const ALL: [Self; 3] = [Self::A, Self::B, Self::Soc];

    /// Returns its name.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::A => "A",
            Self::B => "B",
            Self::Soc => "SoC",
        }
    }
}

/// A leap of the clock that is followed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ClockLeap {
    /// The run's clock, ns.
    pub at_ns: u64,
    /// The time has followed it. Before that, the leap is told.
    pub followed: bool,
    /// How far, µs.
    pub by_us: i32,
}

/// The time of one clock over a run.
#[derive(Clone, Debug, Default)]
pub struct ClockLog {
    /// Its states, in order.
    pub states: Vec<ClockState>,
    /// What it heard, in order.
    pub samples: Vec<ClockSample>,
    /// The leaps that it found.
    pub leaps: Vec<ClockLeap>,
    /// When it began or ceased to follow the grandmaster, ns, and why not: as in
    /// [`Event::GrandmasterTime`].
    pub grandmaster: Vec<(u64, u8)>,
}

impl ClockLog {
    fn take(&mut self, at_ns: u64, event: Event) {
        match event {
            Event::Time {
                source,
                status,
                global_ns,
                local_ns,
                rate_ppb,
            } => {
                let is_same = (at_ns as u32).wrapping_sub(local_ns) < SAME_CLOCK_NS;
                let local_ns = if is_same { local_ns } else { at_ns as u32 };
                self.states.push(ClockState {
                    at_ns,
                    source,
                    status,
                    ahead_ns: global_ns.wrapping_sub(local_ns),
                    rate_ppb,
                });
            }
            Event::TimeSample {
                source,
                offset_ns,
                delay_ns,
                error_ns,
            } => self.samples.push(ClockSample {
                at_ns,
                source,
                offset_ns,
                delay_ns,
                error_ns,
            }),
            Event::TimeLeap {
                followed, by_us, ..
            } => self.leaps.push(ClockLeap {
                at_ns,
                followed,
                by_us,
            }),
            Event::GrandmasterTime { why } => self.tell(at_ns, why),
            _ => {}
        }
    }

    /// Notes whether the grandmaster is followed, if that has changed.
    fn tell(&mut self, at_ns: u64, why: u8) {
        if self.grandmaster.last().is_none_or(|last| last.1 != why) {
            self.grandmaster.push((at_ns, why));
        }
    }

    fn forget(&mut self, before_ns: u64) {
        self.states.retain(|it| it.at_ns >= before_ns);
        self.samples.retain(|it| it.at_ns >= before_ns);
    }

    /// Returns when this clock was how much later than one that is `ahead_ns` ahead of the run's
    /// clock, ns.
    pub fn later_than(&self, ahead_ns: u64) -> impl Iterator<Item = (u64, i32)> {
        let low = ahead_ns as u32;
        let later = move |it: &ClockState| (it.at_ns, it.ahead_ns.wrapping_sub(low).cast_signed());
        self.states.iter().map(later)
    }
}

/// The time of all clocks over a run, and what is done by it.
#[derive(Clone, Debug, Default)]
pub struct TimeLog {
    clocks: [ClockLog; ChainClock::ALL.len()],
    /// When the control cycles of A and B began, ns.
    starts: [Vec<u64>; 2],
    /// When each sensor's newest list was on the bus, ns, and by which clock it was stamped.
    sensors: [Option<(u64, TimeStateCode)>; SensorId::ALL.len()],
}

impl TimeLog {
    /// Takes an entry of a recording.
    pub fn push(&mut self, entry: &Entry) {
        match entry {
            Entry::Trace(traced) => self.push_trace(traced),
            Entry::Frame(frame) => {
                if let Some(Message::SensorHeader(sensor, header)) = frame.message() {
                    self.sensors[sensor.index()] = Some((frame.at.as_ns(), header.time_state));
                }
            }
            Entry::Vehicle(record) => {
                if let VehicleRecord::SocTime(soc) = &**record {
                    self.push_soc(soc);
                }
            }
            Entry::Supply(..) => {}
        }
    }

    fn push_trace(&mut self, traced: &Traced) {
        if traced.core != CoreId::CONTROL {
            return;
        }
        let (at_ns, index) = (traced.at.as_ns(), traced.system.index());
        match Event::decode(traced.record) {
            Some(event) if begins_control_cycle(event) => self.starts[index].push(at_ns),
            Some(event) => self.clocks[index].take(at_ns, event),
            None => {}
        }
    }

    fn push_soc(&mut self, soc: &SocTime) {
        let clock = &mut self.clocks[ChainClock::Soc as usize];
        clock.states.extend(soc.state);
        let newest = clock.samples.last().map(|it| it.at_ns);
        clock
            .samples
            .extend(soc.sample.filter(|it| Some(it.at_ns) != newest));
        clock.tell(soc.at_ns, soc.why);
    }

    /// Sorts by time, because the entries reached the recording through several buffers.
    pub(crate) fn sort(&mut self) {
        for clock in &mut self.clocks {
            clock.states.sort_by_key(|it| it.at_ns);
            clock.samples.sort_by_key(|it| it.at_ns);
        }
        self.starts.iter_mut().for_each(|of| of.sort_unstable());
    }

    /// Forgets states, samples and cycles before this time, ns. For a live view.
    pub fn forget(&mut self, before_ns: u64) {
        self.clocks.iter_mut().for_each(|it| it.forget(before_ns));
        for starts in &mut self.starts {
            starts.retain(|at_ns| *at_ns >= before_ns);
        }
    }

    /// Returns the time of one clock.
    #[must_use]
    pub const fn clock(&self, of: ChainClock) -> &ClockLog {
        &self.clocks[of as usize]
    }

    /// Returns by which clock each sensor stamped its newest list, if that was since `from_ns`.
    #[must_use]
    pub fn sensors(&self, from_ns: u64) -> [Option<TimeStateCode>; SensorId::ALL.len()] {
        let newest = |it: Option<(u64, TimeStateCode)>| it.filter(|it| it.0 >= from_ns);
        self.sensors.map(|it| newest(it).map(|it| it.1))
    }

    /// Returns when the time of A was how much later than that of B, ns.
    #[must_use]
    pub fn apart(&self) -> Vec<(u64, i32)> {
        let [a, b] = [ChainClock::A, ChainClock::B].map(|of| &self.clock(of).states);
        let at: Vec<_> = b.iter().map(|it| it.at_ns).collect();
        let apart = |it: &ClockState| {
            let other = b.get(nearest(&at, it.at_ns, TOGETHER_NS)?)?;
            let by = it.ahead_ns.wrapping_sub(other.ahead_ns);
            Some((it.at_ns, by.cast_signed()))
        };
        a.iter().filter_map(apart).collect()
    }

    /// Returns when the control cycles of A began how much later than those of B, ns.
    #[must_use]
    pub fn skews(&self) -> Vec<(u64, i64)> {
        let [a, b] = &self.starts;
        let skew = |at_ns: &u64| {
            let other = b[nearest(b, *at_ns, HALF_CYCLE_NS)?];
            Some((*at_ns, at_ns.cast_signed() - other.cast_signed()))
        };
        a.iter().filter_map(skew).collect()
    }
}

/// Returns whether a control cycle begins with this event of core 0.
#[inline] // into an optimised crate
#[must_use]
pub const fn begins_control_cycle(event: Event) -> bool {
    matches!(
        event,
        Event::TaskIn {
            task: TaskCode::CONTROL | TaskCode::DEGRADED,
            begin: Begin::Released { .. },
        }
    )
}

/// Returns the index of the time, of `times` in order, that is nearest to `at_ns` and at most
/// `most_ns` away.
fn nearest(times: &[u64], at_ns: u64, most_ns: u64) -> Option<usize> {
    let behind = times.partition_point(|other| *other < at_ns);
    let near = [behind.checked_sub(1), Some(behind)].into_iter().flatten();
    let apart = |index: &usize| Some(times.get(*index)?.abs_diff(at_ns));
    let near = near.filter(|it| apart(it).is_some_and(|ns| ns <= most_ns));
    near.min_by_key(apart)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::description::{no_grandmaster, time_source};
    use tandem_board::{CanFrame, CanId, Instant, SystemId};
    use tandem_bus::{FrameTransmitter, SensorHeader};
    use tandem_cores::core0::TimeSource;
    use tandem_timesync::gptp::Why;
    use tandem_vehicle::LoggedFrame;

    const MS: u64 = 1_000_000;

    fn traced(system: SystemId, at_ns: u64, event: Event) -> Entry {
        Entry::Trace(Traced {
            at: Instant::from_ns(at_ns),
            system,
            core: CoreId::CONTROL,
            record: event.encode(),
        })
    }

    fn state(system: SystemId, at_ns: u64, local_ns: u64, ahead_ns: u32) -> Entry {
        let event = Event::Time {
            source: TimeSource::Grandmaster as u8,
            status: 8,
            global_ns: (local_ns as u32).wrapping_add(ahead_ns),
            local_ns: local_ns as u32,
            rate_ppb: 0,
        };
        traced(system, at_ns, event)
    }

    fn cycle(system: SystemId, at_ns: u64) -> Entry {
        let begin = Begin::Released {
            late_ns: 0,
            missed: 0,
        };
        let task = TaskCode::CONTROL;
        traced(system, at_ns, Event::TaskIn { task, begin })
    }

    fn log(entries: &[Entry]) -> TimeLog {
        let mut log = TimeLog::default();
        entries.iter().for_each(|entry| log.push(entry));
        log.sort();
        log
    }

    /// S-1: both times are compared although they are traced at different times, and although the
    /// low words of a time wrap around between them.
    #[test]
    fn two_times_are_compared_where_they_are_traced_together() {
        let (from, ahead) = (u64::from(u32::MAX) - 20 * MS, u32::MAX - 500);
        let log = log(&[
            state(SystemId::A, from + 900, from, ahead),
            state(
                SystemId::A,
                from + 100 * MS + 900,
                from + 100 * MS,
                ahead.wrapping_add(1_500),
            ),
            // B is silent at the time of the last state of A.
            state(SystemId::A, from + 900 * MS, from + 900 * MS, ahead),
            state(SystemId::B, from + 40 * MS + 100, from + 40 * MS, ahead),
            state(SystemId::B, from + 110 * MS + 100, from + 110 * MS, ahead),
        ]);
        let apart: Vec<_> = log.apart().iter().map(|(_, by_ns)| *by_ns).collect();
        assert_eq!(apart, [0, 1_500]);
        let later: Vec<_> = log
            .clock(ChainClock::A)
            .later_than(u64::from(ahead) + 7)
            .collect();
        assert_eq!(later[1], (from + 100 * MS + 900, 1_493));
    }

    /// A system with a clock of its own has told when it is traced, on the clock of the run.
    #[test]
    fn the_time_of_a_system_with_another_clock_is_compared_on_the_clock_of_the_run() {
        let at_ns = 7_000 * MS;
        let log = log(&[state(SystemId::A, at_ns, 90_000 * MS, 11)]);
        let global_ns = (90_000 * MS) as u32 + 11;
        let state = log.clock(ChainClock::A).states[0];
        assert_eq!(state.ahead_ns, global_ns.wrapping_sub(at_ns as u32));
    }

    /// S-1: each cycle of A has the nearest one of B; without one nearby it does not count.
    #[test]
    fn skews_are_between_the_nearest_cycles() {
        let log = log(&[
            cycle(SystemId::A, 100 * MS),
            cycle(SystemId::A, 110 * MS),
            cycle(SystemId::A, 120 * MS),
            cycle(SystemId::B, 110 * MS - 4_000),
            cycle(SystemId::B, 100 * MS + 9_000),
        ]);
        assert_eq!(log.skews(), [(100 * MS, -9_000), (110 * MS, 4_000)]);
    }

    /// A live view keeps the newest only.
    #[test]
    fn what_is_old_is_forgotten() {
        let mut log = log(&[
            state(SystemId::A, 10 * MS, 10 * MS, 0),
            state(SystemId::A, 20 * MS, 20 * MS, 0),
            cycle(SystemId::A, 10 * MS),
            cycle(SystemId::B, 10 * MS),
        ]);
        log.forget(15 * MS);
        assert_eq!(log.clock(ChainClock::A).states.len(), 1);
        assert!(log.skews().is_empty());
    }

    /// S-4: the newest list of each sensor says by which clock it was stamped.
    #[test]
    fn sensors_tell_by_which_clock_they_stamp() {
        let header = SensorHeader {
            time_state: TimeStateCode::Holdover,
            ..SensorHeader::default()
        };
        let message = Message::SensorHeader(SensorId::CameraFront, header);
        let encoded = FrameTransmitter::new().encode(&message);
        let frame = CanFrame::new(CanId::Standard(encoded.id), true, encoded.data()).unwrap();
        let at = Instant::from_ns(30 * MS);
        let log = log(&[Entry::Frame(LoggedFrame {
            at,
            sent: at,
            frame,
            ruling: None,
        })]);
        let camera = SensorId::CameraFront.index();
        assert_eq!(log.sensors(0)[camera], Some(TimeStateCode::Holdover));
        assert_eq!(log.sensors(31 * MS), [None; 6]);
    }

    /// S-1: the SoC tells its newest sample more than once; it counts once. Each change of what it
    /// says of the grandmaster counts.
    #[test]
    fn what_the_soc_tells_again_counts_once() {
        let told = |at_ns, why| {
            let sample = ClockSample {
                at_ns: 5,
                ..ClockSample::default()
            };
            Entry::from(VehicleRecord::SocTime(SocTime {
                at_ns,
                state: Some(ClockState::default()),
                sample: Some(sample),
                why,
            }))
        };
        let log = log(&[told(10, 0), told(20, 0), told(30, 1)]);
        let soc = log.clock(ChainClock::Soc);
        assert_eq!((soc.states.len(), soc.samples.len()), (3, 1));
        assert_eq!(soc.grandmaster, [(10, 0), (30, 1)]);
    }

    /// Codes of the trace are told in words.
    #[test]
    fn each_source_and_each_reason_has_a_text() {
        for source in [TimeSource::Own, TimeSource::Grandmaster, TimeSource::Pulse] {
            assert_ne!(time_source(source as u8), time_source(99));
        }
        for code in 1..=Why::DelayAboveThreshold as u8 + 1 {
            assert_ne!(no_grandmaster(code), no_grandmaster(0), "{code}");
        }
    }
}
