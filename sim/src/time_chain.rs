//! The chain of time in virtual time, and how far each of its links is from the truth.
//!
//! Nothing here reads a time base: the truth is the grandmaster's clock, and what is measured are
//! traces of core 0 and frames on the bus.

use tandem_board::{Board as _, CanId, CoreId, Duration, Instant, SystemId};
use tandem_board_sim::{Clock, Config, Poller, SimBoard};
use tandem_bus::{Message, TimeStateCode};
use tandem_cores::task_table::TaskCode;
use tandem_cores::trace::{Begin, Event};

use crate::drive::Drive;
use crate::grandmaster::{Grandmaster, GrandmasterClock};
use crate::timed;
use crate::timing::Time;

/// How often the grandmaster works.
const TURN: Duration = Duration::from_ms(1);
/// How often the traces are fetched.
const FETCH: Duration = Duration::from_ms(500);
/// Time in cables and the switch.
const WIRE: Duration = Duration::from_us(5);

/// What a chain consists of.
#[derive(Clone, Copy, Debug)]
pub struct ChainConfig {
    /// Seed of all noise.
    pub seed: u64,
    /// How long jobs, wires and frames take.
    pub time: Time,
    /// The crystals of A and B, ppb.
    pub drift_ppb: [i32; 2],
    /// The clock that all follow; `None`: there is no Ethernet.
    pub grandmaster: Option<GrandmasterClock>,
}

impl Default for ChainConfig {
    /// Crystals at opposite limits of what the standards permit, and a right grandmaster.
    fn default() -> Self {
        Self {
            seed: 1,
            time: Time::Typical,
            drift_ppb: [100_000, -100_000],
            grandmaster: Some(GrandmasterClock::RIGHT),
        }
    }
}

/// Both systems with a vehicle, and the grandmasters of its network.
pub struct Chain {
    /// Systems and vehicle.
    pub drive: Drive,
    /// Who gives the time; more may be added.
    pub grandmasters: Vec<Grandmaster>,
    truth: GrandmasterClock,
    /// When each list was sent, and its stamp in global time, µs; `None` on the sensor's own clock.
    stamps: Vec<(Instant, Option<u32>)>,
}

/// Creates a core of this board, whose jobs take `time`.
#[must_use]
pub fn poller(board: &SimBoard, time: Time) -> Poller {
    let config = tandem_cores::Config::rt();
    if time == Time::Ideal {
        return crate::drive::poller(board, config);
    }
    // A reset ends the core but not this process, so each incarnation leaks one board.
    let board: &'static SimBoard = Box::leak(Box::new(board.clone()));
    match board.identity().core {
        CoreId::CONTROL => timed::core_0(board, config, time),
        CoreId::PERCEPTION => timed::core_1(board, time),
        _ => timed::core_2(board, time),
    }
}

impl Chain {
    /// Powers both systems on in an embedded scenario.
    ///
    /// # Panics
    /// If there is no embedded scenario of this name.
    #[must_use]
    pub fn new(scenario: &str, config: ChainConfig) -> Self {
        Self::with(scenario, config, move |board| poller(board, config.time))
    }

    /// Like [`Chain::new`]; `core` creates each incarnation of a core.
    ///
    /// # Panics
    /// If there is no embedded scenario of this name.
    pub fn with(
        scenario: &str,
        config: ChainConfig,
        core: impl FnMut(&SimBoard) -> Poller + 'static,
    ) -> Self {
        let offsets = [1_000_000, 7_000_000_000];
        let clocks = [0, 1].map(|of| Clock {
            offset_ns: offsets[of],
            drift_ppb: config.drift_ppb[of],
        });
        let board = Config {
            seed: config.seed,
            clocks,
            wires: config.time.wires(),
            network: config.grandmaster.map(|_| WIRE),
            ..Config::default()
        };
        let mut drive = Drive::on_board(scenario, board, core);
        let join = |clock| Grandmaster::join(&mut drive.pair, 1, clock);
        let grandmasters = config.grandmaster.map(join).into_iter().collect();
        Self {
            drive,
            grandmasters,
            truth: config.grandmaster.unwrap_or(GrandmasterClock::RIGHT),
            stamps: vec![],
        }
    }

    /// Drives on.
    pub fn run_for(&mut self, span: Duration) {
        let until = self.drive.pair.now() + span;
        let mut fetched = self.drive.pair.now();
        while self.drive.pair.now() < until {
            let now = self.drive.pair.now();
            for grandmaster in &mut self.grandmasters {
                grandmaster.turn(now);
            }
            if now.since(fetched) >= FETCH {
                fetched = now;
                self.keep_stamps();
                self.drive.run_for(TURN);
            } else {
                self.drive.pair.run_for(TURN);
            }
        }
        self.keep_stamps();
        self.drive.run_for(TURN);
    }

    fn keep_stamps(&mut self) {
        for on_bus in self.drive.pair.take_bus_log() {
            let CanId::Standard(id) = on_bus.frame.id() else {
                continue;
            };
            let message = Message::decode(id.into(), on_bus.frame.data());
            if let Ok(Message::SensorHeader(_, header)) = message {
                let is_global = header.time_state != TimeStateCode::OwnClock;
                // The vehicle sends at whole milliseconds, and a header waits less for the bus.
                let tick = TURN.as_ns();
                let sent = Instant::from_ns(on_bus.at.as_ns() / tick * tick);
                self.stamps
                    .push((sent, is_global.then_some(header.measured_at)));
            }
        }
    }

    /// Returns how much later than the truth a system's time was, ns, each time that it was traced
    /// since `from`.
    #[must_use]
    pub fn offsets(&self, of: SystemId, from: Instant) -> Vec<(Instant, i64)> {
        let events = self.drive.events.iter();
        let events = events.filter(|(at, system, ..)| *system == of && *at >= from);
        let offset = |(at, _, _, event): &(Instant, SystemId, CoreId, Event)| match event {
            Event::Time { global_ns, .. } => Some((*at, self.later(*at, *global_ns))),
            _ => None,
        };
        events.filter_map(offset).collect()
    }

    /// Returns how much later than the truth a low word of time is, ns.
    fn later(&self, at: Instant, low_ns: u32) -> i64 {
        let truth = self.truth.at(at).as_ns() as u32;
        low_ns.wrapping_sub(truth).cast_signed().into()
    }

    /// Returns how much later than the truth the stamps of the sensors' lists were, ns, since
    /// `from`; and how many lists had no stamp in global time. The stamps count microseconds. The
    /// sensors of this chain send without delay.
    #[must_use]
    pub fn stamps(&self, from: Instant) -> (Vec<(Instant, i64)>, usize) {
        let (mut later, mut own) = (vec![], 0);
        for (sent, stamp) in self.stamps.iter().filter(|(sent, _)| *sent >= from) {
            let truth = (self.truth.at(*sent).as_ns() / 1_000) as u32;
            match stamp {
                Some(us) => {
                    let by_us = us.wrapping_sub(truth).cast_signed();
                    later.push((*sent, i64::from(by_us) * 1_000));
                }
                None => own += 1,
            }
        }
        (later, own)
    }

    /// Returns the times between the starts of the control cycles of both systems, ns, since
    /// `from`.
    #[must_use]
    pub fn skews(&self, from: Instant) -> Vec<i64> {
        let starts = |of: SystemId| -> Vec<u64> {
            let events = self.drive.events.iter();
            let events = events.filter(|(at, system, ..)| *system == of && *at >= from);
            let release = |(at, _, _, event): &(Instant, SystemId, CoreId, Event)| match event {
                Event::TaskIn {
                    task: TaskCode::CONTROL | TaskCode::DEGRADED,
                    begin: Begin::Released { late_ns, .. },
                } => Some(at.as_ns() - u64::from(*late_ns)),
                _ => None,
            };
            events.filter_map(release).collect()
        };
        let (a, b) = (starts(SystemId::A), starts(SystemId::B));
        let nearest = |at: &u64| {
            let behind = b.partition_point(|other| other < at);
            let near = b.get(behind.saturating_sub(1)..(behind + 1).min(b.len()))?;
            let apart = near
                .iter()
                .map(|other| at.cast_signed() - other.cast_signed());
            apart.min_by_key(|apart| apart.abs())
        };
        a.iter().filter_map(nearest).collect()
    }
}

/// Percentiles of the magnitude of deviations, ns.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Spread {
    /// Median.
    pub p50: u64,
    /// 99th percentile.
    pub p99: u64,
    /// Largest.
    pub max: u64,
    /// How many there are.
    pub count: usize,
}

impl Spread {
    /// Returns the percentiles; `None` of nothing.
    #[must_use]
    pub fn of(deviations: impl IntoIterator<Item = i64>) -> Option<Self> {
        let mut sizes: Vec<_> = deviations.into_iter().map(i64::unsigned_abs).collect();
        sizes.sort_unstable();
        let at = |permille: usize| sizes[(sizes.len() - 1) * permille / 1_000];
        (!sizes.is_empty()).then(|| Self {
            p50: at(500),
            p99: at(990),
            max: at(1_000),
            count: sizes.len(),
        })
    }
}
