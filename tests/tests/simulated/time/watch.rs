//! A drive whose readers of time are watched at each step.

use tandem_board::{Board as _, CoreId, Duration, Instant, SystemId};
use tandem_board_sim::{Poller, SimBoard};
use tandem_cores::layout::{ControllerMap, VEHICLE_TIME};
use tandem_cores::task_table::TaskCode;
use tandem_cores::trace::{Begin, Event};
use tandem_sim::time_chain::{Chain, ChainConfig};
use tandem_timesync::{Arbitrary, Conversion, TimeReader, TimeReading, TimeStatus};

pub(crate) const S: fn(u64) -> Duration = |seconds| Duration::from_ms(seconds * 1_000);
pub(crate) const MS: fn(u64) -> Duration = Duration::from_ms;

/// How often a reader reads.
const STEP: Duration = Duration::from_ms(5);
/// Two crystals and a correction, ppm.
const MOST_PPM: u64 = 700;
/// A reader may lag by this untold, ns.
const LAG_NS: u64 = 2_100;

/// A control cycle is moved by a tick of 1 ms, and each of its ticks by 5 µs. Crystals differ by
/// 100 ppm.
const CYCLE_NS: core::ops::RangeInclusive<u64> = 8_950_000..=11_060_000;

/// A reader in one system, as core 1 is one.
#[derive(Default)]
struct OneReader {
    reader: TimeReader<Arbitrary>,
    last: Option<(Instant, TimeReading<Arbitrary>)>,
    /// Readings since the start of the system.
    count: u64,
}

/// What a system told of its time.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Told {
    /// Leaps that were told, and such that were followed.
    pub(crate) leaps: u32,
    pub(crate) followed: u32,
    pub(crate) disagrees: u32,
}

pub(crate) struct Watch {
    pub(crate) chain: Chain,
    readers: [OneReader; 2],
    /// What the readers must not see, with the time.
    pub(crate) violations: Vec<(Instant, SystemId, &'static str)>,
}

/// Returns the system that sent the last control frame.
pub(crate) fn driving(chain: &Chain) -> SystemId {
    *chain.drive.masters().last().expect("a system drives")
}

impl Watch {
    pub(crate) fn start(config: ChainConfig) -> Self {
        Self::of(Chain::new("free-lane", config))
    }

    /// `core` creates each core.
    pub(crate) fn with(
        config: ChainConfig,
        core: impl FnMut(&SimBoard) -> Poller + 'static,
    ) -> Self {
        Self::of(Chain::with("free-lane", config, core))
    }

    pub(crate) fn of(chain: Chain) -> Self {
        Self {
            chain,
            readers: <[OneReader; 2]>::default(),
            violations: vec![],
        }
    }

    /// Drives on. Each reader reads every few milliseconds.
    pub(crate) fn run_for(&mut self, span: Duration) {
        let until = self.chain.drive.pair.now() + span;
        while self.chain.drive.pair.now() < until {
            self.chain.run_for(STEP);
            SystemId::ALL.into_iter().for_each(|of| self.read(of));
        }
    }

    /// Returns how a system's clock becomes the vehicle's time.
    pub(crate) fn conversion(&self, of: SystemId) -> Option<Conversion<Arbitrary>> {
        let board = self.chain.drive.pair.board(of, CoreId::PERCEPTION);
        let lmu = ControllerMap::attach(&board).ok()?;
        let shown = VEHICLE_TIME.reader(&lmu.map).ok()?.fetch().ok()??;
        shown.0
    }

    fn read(&mut self, of: SystemId) {
        let pair = &self.chain.drive.pair;
        let local = pair.board(of, CoreId::PERCEPTION).now();
        let seen = &mut self.readers[of.index()];
        if pair.lamp(of).is_none() {
            *seen = OneReader::default();
            return;
        }
        let Some(conversion) = self.conversion(of) else {
            self.readers[of.index()] = OneReader::default();
            return;
        };
        let seen = &mut self.readers[of.index()];
        let reading = seen.reader.read(&conversion, local);
        seen.count += 1;
        if let Some((last_local, last)) = seen.last.replace((local, reading)) {
            let passed = local.as_ns() as i64 - last_local.as_ns() as i64;
            let moved = reading.time.after(last.time);
            let is_told = is_leap(reading.status) || is_leap(last.status);
            let slack = passed.unsigned_abs() * MOST_PPM / 1_000_000 + LAG_NS;
            let what = match () {
                () if moved < 0 => "goes back",
                () if is_told || moved.abs_diff(passed) <= slack => return,
                () if moved > passed => "leaps untold",
                () => "stops untold",
            };
            self.violations
                .push((self.chain.drive.pair.now(), of, what));
        }
    }

    /// Returns what a new reader in a system would see now.
    pub(crate) fn reading(&self, of: SystemId) -> TimeReading<Arbitrary> {
        let local = self.chain.drive.pair.board(of, CoreId::PERCEPTION).now();
        self.conversion(of).expect("a time").reading(local)
    }

    /// Returns how much later than the truth a system's time is now, ns.
    pub(crate) fn off(&self, of: SystemId) -> i64 {
        let now = self.chain.drive.pair.now();
        self.reading(of)
            .time
            .after(self.chain.grandmasters[0].clock.at(now))
    }

    /// Returns the code of the source that a system told last: 0 its own clock, 1 the grandmaster,
    /// 2 pulses.
    pub(crate) fn source(&self, of: SystemId) -> u8 {
        let mut events = self.chain.drive.events.iter().rev();
        let source = events.find_map(|(_, system, _, event)| match event {
            Event::Time { source, .. } if *system == of => Some(*source),
            _ => None,
        });
        source.expect("a time")
    }

    pub(crate) fn told(&self, of: SystemId) -> Told {
        self.told_since(of, super::CONVERGED)
    }

    pub(crate) fn told_since(&self, of: SystemId, from: Instant) -> Told {
        let mut told = Told::default();
        for (at, system, _, event) in &self.chain.drive.events {
            match event {
                _ if *system != of || *at < from => {}
                Event::TimeLeap { followed: true, .. } => told.followed += 1,
                Event::TimeLeap { .. } => told.leaps += 1,
                Event::TimeDisagrees { .. } => told.disagrees += 1,
                _ => {}
            }
        }
        told
    }

    /// Returns the straight line through what a system's time was off the truth, ns, in its traces
    /// from this time on until now: two crystals.
    pub(crate) fn line_of(&self, of: SystemId, from: Instant) -> impl Fn(Instant) -> i64 + use<> {
        let offsets = self.chain.offsets(of, from);
        let (first, last) = (offsets[0], offsets[offsets.len() - 1]);
        move |at| {
            let span = last.0.since(first.0).as_ns() as f64;
            let part = (at.as_ns() as f64 - first.0.as_ns() as f64) / span;
            first.1 + (apart(last.1, first.1) as f64 * part).round() as i64
        }
    }

    /// Returns the releases of the control cycles of a system, ns, each with the time until the
    /// next one, while its phase does not change.
    pub(crate) fn cycles(&self, of: SystemId, from: Instant) -> Vec<(u64, u64)> {
        let events = self.chain.drive.events.iter();
        let events = events.filter(|(at, system, ..)| *system == of && *at >= from);
        let (mut last, mut cycles) = (None, vec![]);
        for (at, _, _, event) in events {
            match event {
                Event::Phase { .. } | Event::Started { .. } => last = None,
                Event::TaskIn {
                    task: TaskCode::CONTROL | TaskCode::DEGRADED,
                    begin: Begin::Released { late_ns, .. },
                } => {
                    let at = at.as_ns() - u64::from(*late_ns);
                    let cycle = last.replace(at).map(|last: u64| (last, at - last));
                    cycles.extend(cycle);
                }
                _ => {}
            }
        }
        cycles
    }

    /// No reader was deceived, the vehicle was driven by these systems in turn, each control cycle
    /// came after 9 to 11 ms, and the vehicle did not leave its lane.
    pub(crate) fn assert_drives_well(&self, masters: &[SystemId]) {
        assert_eq!(self.violations, []);
        self.assert_is_driven(masters);
    }

    pub(crate) fn assert_is_driven(&self, masters: &[SystemId]) {
        let drive = &self.chain.drive;
        assert_eq!(drive.masters(), masters);
        assert_eq!(drive.two_masters_ns(), 0);
        assert_eq!(drive.gaps_beyond(), []);
        let metrics = drive.seen.borrow().world.metrics();
        assert_eq!((metrics.collisions, metrics.excursion_max_m), (0, 0.0));
        for of in SystemId::ALL {
            let cycles = self.cycles(of, Instant::from_ns(6_000_000_000));
            let wrong = |it: &&(u64, u64)| !CYCLE_NS.contains(&it.1);
            assert_eq!(cycles.iter().find(wrong), None, "{of}");
        }
    }
}

/// Returns how much later the first of two deviations is, ns. Both are known modulo 2^32.
pub(crate) const fn apart(by: i64, other: i64) -> i64 {
    by.wrapping_sub(other) as i32 as i64
}

pub(crate) fn is_leap(status: TimeStatus) -> bool {
    status.has(TimeStatus::TIMELEAP_FUTURE) || status.has(TimeStatus::TIMELEAP_PAST)
}
