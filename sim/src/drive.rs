//! The whole controller and a vehicle on the simulated board.

use std::cell::RefCell;
use std::rc::Rc;
use tandem_board::{
    Board, CanFrame, Carried, CoreId, DataFlash, Duration, FlashError, Instant, SystemId,
    VehicleBus,
};
use tandem_board_sim::{Config, Poller, SimBoard, SimPair, WorldTick};
use tandem_cores::Core;
use tandem_cores::core0::Core0;
use tandem_cores::core1::Core1;
use tandem_cores::core2::Core2;
use tandem_cores::trace::Event;
use tandem_record::gap::{Bounds, Gap, both_transmitted_ms, gaps};
use tandem_record::verdict::Limits;
use tandem_record::{Entry, RunLog, Takeover, takeovers};
use tandem_redundancy::{Geometry, Loaded, StateStore, SystemState};
use tandem_vehicle::{Scenario, World};

/// The vehicle's log of a drive.
pub struct Observation {
    /// The vehicle, its traffic and its gate for control frames.
    pub world: World,
    /// The recording so far.
    pub log: RunLog,
    /// Frames that a node other than the systems sends in the next period.
    pub forged: Vec<CanFrame>,
}

/// Both systems and one vehicle in virtual time.
pub struct Drive {
    /// The machine.
    pub pair: SimPair,
    /// The vehicle's log so far.
    pub seen: Rc<RefCell<Observation>>,
    /// The trace events of the cores so far, in order.
    pub events: Vec<(Instant, SystemId, CoreId, Event)>,
}

/// Loads the state from a flash as a starting controller does.
pub(crate) fn newest_record(flash: &[u8]) -> Loaded {
    let read = |offset: u32, into: &mut [u8]| {
        let from = flash.get(offset as usize..);
        let from = from.and_then(|from| from.get(..into.len()));
        into.copy_from_slice(from.ok_or(FlashError::OutOfRange)?);
        Ok(())
    };
    StateStore::load(Geometry::first_sectors(FLASH_SECTOR_BYTES), read).1
}

/// Size of a sector of the simulated flash.
pub(crate) const FLASH_SECTOR_BYTES: u32 = <<SimBoard as Board>::Flash as DataFlash>::SECTOR_BYTES;

/// Creates a new incarnation of this board's core.
#[must_use]
pub fn poller(board: &SimBoard, config: tandem_cores::Config) -> Poller {
    // A reset ends the core but not this process, so each incarnation leaks one board.
    let board: &'static SimBoard = Box::leak(Box::new(board.clone()));
    match board.identity().core {
        CoreId::CONTROL => {
            let mut core = Core0::new(board, config);
            Box::new(move |_| core.poll())
        }
        CoreId::PERCEPTION => {
            let mut core = Core1::new(board);
            Box::new(move |_| core.poll())
        }
        _ => {
            let mut core = Core2::new(board);
            Box::new(move |_| core.poll())
        }
    }
}

fn tick(seen: &mut Observation, tick: &mut WorldTick) {
    let Observation { world, log, forged } = seen;
    world.run_period(tick.at, tick, &mut |frame| log.push(Entry::Frame(frame)));
    for frame in forged.drain(..) {
        let at = tick.broadcast(&frame);
        let sent = at;
        log.push(Entry::Frame(world.hear(at, Carried { frame, sent, at })));
    }
}

impl Drive {
    /// Powers both systems on; a vehicle waits in the named scenario.
    ///
    /// # Panics
    /// If there is no embedded scenario of this name.
    #[must_use]
    pub fn new(scenario: &str, seed: u64) -> Self {
        let config = tandem_cores::Config::rt();
        Self::with(scenario, seed, move |board| poller(board, config))
    }

    /// Like [`Drive::new`]; `core` creates each incarnation of a core.
    ///
    /// # Panics
    /// If there is no embedded scenario of this name.
    pub fn with(
        scenario: &str,
        seed: u64,
        core: impl FnMut(&SimBoard) -> Poller + 'static,
    ) -> Self {
        let board_config = Config {
            seed,
            ..Config::default()
        };
        Self::on_board(scenario, board_config, core)
    }

    /// Like [`Drive::with`], on a board with these settings, of which the seed is also the world's.
    ///
    /// # Panics
    /// If there is no embedded scenario of this name.
    pub fn on_board(
        scenario: &str,
        board_config: Config,
        core: impl FnMut(&SimBoard) -> Poller + 'static,
    ) -> Self {
        let scenario = Scenario::load(scenario).expect("an embedded scenario");
        let seed = board_config.seed;
        let world = World::new(&scenario, tandem_vehicle::WorldConfig { seed });
        let seen = Rc::new(RefCell::new(Observation {
            world,
            log: RunLog::default(),
            forged: vec![],
        }));
        let mut pair = SimPair::new(board_config, core);
        let shared = Rc::clone(&seen);
        pair.set_world(move |now| tick(&mut shared.borrow_mut(), now));
        for system in SystemId::ALL {
            pair.power_on(system);
        }
        Self {
            pair,
            seen,
            events: vec![],
        }
    }

    /// Drives for another `span`, and keeps the trace of the cores.
    ///
    /// # Panics
    /// If the cores trace more in one second than the machine keeps.
    pub fn run_for(&mut self, span: Duration) {
        let until = self.pair.now() + span;
        while self.pair.now() < until {
            // Run in steps of at most 1 s, so that the trace does not overflow.
            let step = until.since(self.pair.now());
            self.pair.run_for(step.min(Duration::from_ms(1000)));
            let (entries, lost) = self.pair.take_trace();
            assert_eq!(lost, 0, "the trace ran over");
            let log = &mut self.seen.borrow_mut().log;
            for traced in entries {
                let event = Event::decode(traced.record);
                self.events
                    .extend(event.map(|event| (traced.at, traced.system, traced.core, event)));
                log.push(Entry::Trace(traced));
            }
            log.sort();
            self.pair.take_bus_log();
        }
    }

    /// Returns all takeovers, as the report lists them.
    ///
    /// # Panics
    /// If a system took over from a master that had not failed.
    #[must_use]
    pub fn takeovers(&self) -> Vec<Takeover> {
        let takeovers = takeovers(&self.seen.borrow().log);
        let false_one = takeovers.iter().find(|takeover| takeover.is_false);
        assert_eq!(false_one, None, "a takeover from a master that drove");
        takeovers
    }

    /// Returns the largest time between two accepted control frames.
    #[must_use]
    pub fn gap_max(&self) -> Duration {
        let seen = self.seen.borrow();
        let last_ns = seen.log.accepted().last().map_or(0, |frame| frame.at_ns);
        Duration::from_ns(seen.log.mastership().gap_max_ns(last_ns))
    }

    /// Returns the state in a system's data flash.
    ///
    /// # Panics
    /// If it holds no valid record.
    #[must_use]
    pub fn state_in_flash(&self, system: SystemId) -> SystemState {
        match newest_record(&self.pair.flash(system)) {
            Loaded::State(state) => state,
            other => panic!("{other:?}"),
        }
    }

    /// Returns the gaps that exceed the bounds for their causes. The bounds assume exact timers.
    #[must_use]
    pub fn gaps_beyond(&self) -> Vec<Gap> {
        // The vehicle receives frames once a millisecond.
        let bounds = Bounds::new(Limits::RT, Duration::from_ms(1), Duration::ZERO);
        gaps(&self.seen.borrow().log, &self.takeovers(), &bounds, &[])
    }

    /// Returns the time in which both systems transmitted as master, whether the vehicle obeyed
    /// them or not, ms.
    #[must_use]
    pub fn both_transmitted_ms(&self) -> f64 {
        both_transmitted_ms(&self.seen.borrow().log)
    }

    /// Returns the time in which both systems drove, ns.
    #[must_use]
    pub fn two_masters_ns(&self) -> u64 {
        self.seen.borrow().log.mastership().two_masters_ns()
    }

    /// Returns the systems in the order in which they drove, without repetition.
    #[must_use]
    pub fn masters(&self) -> Vec<SystemId> {
        self.seen.borrow().log.masters()
    }

    /// Returns how many times the vehicle has hit another vehicle.
    #[must_use]
    pub fn collisions(&self) -> u32 {
        self.seen.borrow().world.metrics().collisions
    }
}
