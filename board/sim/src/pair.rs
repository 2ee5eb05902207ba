//! Both systems, run in virtual time.

use crate::board::{Poller, SimBoard, SimPort};
use crate::config::{Config, Order};
use crate::event::{OnBus, SystemEvent};
use crate::machine::{Attention, Machine, Shared};
use crate::world::WorldTick;
use chacha20::ChaCha8Rng;
use chacha20::rand_core::SeedableRng;
use rand::seq::SliceRandom;
use std::sync::{Arc, MutexGuard};
use tandem_board::{
    CoreAddress, CoreId, Duration, Generation, Instant, LmuWord, RoleLamp, SystemId, Traced,
};
use tandem_peripherals::supply::Power;

/// The vehicle's function, called every millisecond.
type World = Box<dyn FnMut(&mut WorldTick)>;

/// The period of the world.
const WORLD_PERIOD: Duration = Duration::from_ms(1);
/// More polls than this at one instant are a livelock: the cores wake each other endlessly.
const LIVELOCK_POLLS: u32 = 100_000;

struct Running {
    incarnation: u64,
    board: SimBoard,
    poll: Poller,
}

/// Two systems of three cores and their connections, on one virtual clock.
pub struct SimPair {
    pub(crate) shared: Arc<Shared>,
    factory: Box<dyn FnMut(&SimBoard) -> Poller>,
    cores: [[Option<Running>; CoreId::COUNT]; 2],
    world: Option<World>,
    world_next: Instant,
    order: ChaCha8Rng,
    /// The value of `Machine::incarnations` at the last update of `cores`.
    followed: u64,
}

impl SimPair {
    /// Makes two unpowered systems. `factory` makes the code of a core each time the core starts:
    /// at power-on and after each reset. The board's identity names the core and the incarnation.
    pub fn new(config: Config, factory: impl FnMut(&SimBoard) -> Poller + 'static) -> Self {
        let order = ChaCha8Rng::seed_from_u64(config.seed ^ 0x5EED);
        Self {
            shared: Arc::new(Shared::new(config)),
            factory: Box::new(factory),
            cores: Default::default(),
            world: None,
            world_next: Instant::NEVER,
            order,
            followed: 0,
        }
    }

    /// Makes two powered systems with idle cores, for tests that act through [`SimPair::board`].
    #[must_use]
    pub fn idle(config: Config) -> Self {
        let mut pair = Self::new(config, |_| Box::new(|_| Instant::NEVER));
        SystemId::ALL
            .into_iter()
            .for_each(|system| pair.power_on(system));
        for place in CoreAddress::ALL {
            pair.shared.lock().release(place);
        }
        pair.follow_incarnations();
        pair
    }

    /// Returns the virtual time.
    #[must_use]
    pub fn now(&self) -> Instant {
        self.shared.lock().at()
    }

    /// Returns the board of a core in its present incarnation.
    #[must_use]
    pub fn board(&self, system: SystemId, core: CoreId) -> SimBoard {
        self.board_at(CoreAddress { system, core })
    }

    fn board_at(&self, place: CoreAddress) -> SimBoard {
        let mut machine = self.shared.lock();
        let core = machine.core(place);
        let (generation, incarnation) = (Generation(core.generation), core.incarnation);
        drop(machine);
        let shared = Arc::clone(&self.shared);
        SimBoard::new(SimPort {
            shared,
            place,
            generation,
            incarnation,
            baton: None,
        })
    }

    /// Restarts the random numbers from this seed.
    pub fn reseed(&mut self, seed: u64) {
        self.order = ChaCha8Rng::seed_from_u64(seed ^ 0x5EED);
        self.shared.lock().noise = ChaCha8Rng::seed_from_u64(seed);
    }

    /// Sets the vehicle's function: called at once and then after each millisecond of virtual time.
    pub fn set_world(&mut self, world: impl FnMut(&mut WorldTick) + 'static) {
        self.world = Some(Box::new(world));
        self.world_next = self.now();
    }

    /// Runs for a span of virtual time.
    ///
    /// # Panics
    /// See [`SimPair::run_until`].
    pub fn run_for(&mut self, span: Duration) {
        self.run_until(self.now() + span);
    }

    /// Runs everything that happens until the virtual time `until`, inclusive.
    ///
    /// # Panics
    /// If a core panics, or if the cores wake each other endlessly at one instant.
    pub fn run_until(&mut self, until: Instant) {
        let shared = Arc::clone(&self.shared);
        while self.settle(&shared, |machine, world| machine.advance(world, until)) {}
    }

    /// Runs until `until`, inclusive, but stops after the first instant at which `goes_on` returns
    /// false. Returns whether `goes_on` was still true at the end.
    ///
    /// # Panics
    /// See [`SimPair::run_until`].
    pub fn run_while(&mut self, until: Instant, mut goes_on: impl FnMut(&Self) -> bool) -> bool {
        let shared = Arc::clone(&self.shared);
        loop {
            self.settle(&shared, |_, _| ());
            if !goes_on(self) {
                return false;
            }
            if !shared.lock().advance(self.world_next, until) {
                return true;
            }
        }
    }

    /// Runs everything that happens at this instant, then calls `then` with the machine and the
    /// time of the world's next call.
    fn settle<R>(&mut self, shared: &Shared, then: impl FnOnce(&mut Machine, Instant) -> R) -> R {
        let mut polls = 0;
        // Released only while other code uses the machine: a lock costs as much as a small poll.
        let mut machine = shared.lock();
        loop {
            machine.settle();
            if self.world_next <= machine.at() {
                machine = self.tick_world(shared, machine);
            }
            if machine.incarnations != self.followed {
                drop(machine);
                self.follow_incarnations();
                machine = shared.lock();
            }
            if self.world.is_none() {
                machine.unheard.clear();
            }
            let mut due = CoreAddress::ALL;
            let count = machine.due(&mut due);
            let due = &mut due[..count];
            if due.is_empty() {
                return then(&mut machine, self.world_next);
            }
            if shared.config.order == Order::Shuffled {
                due.shuffle(&mut self.order);
            }
            for place in due {
                polls += 1;
                assert!(
                    polls < LIVELOCK_POLLS,
                    "cores wake each other for ever at {:?}, last core {}{}",
                    machine.at(),
                    place.system,
                    place.core
                );
                machine = self.poll(*place, shared, machine);
            }
        }
    }

    fn tick_world<'a>(
        &mut self,
        shared: &'a Shared,
        mut machine: MutexGuard<'a, Machine>,
    ) -> MutexGuard<'a, Machine> {
        let Some(world) = &mut self.world else {
            return machine;
        };
        let lamp = |system: SystemId| {
            machine
                .is_powered(system)
                .then_some(machine.systems[system.index()].lamp)
        };
        let lamps = SystemId::ALL.map(lamp);
        let mut tick = WorldTick {
            at: machine.at(),
            heard: core::mem::take(&mut machine.unheard),
            lamps,
            sent: Vec::new(),
        };
        drop(machine);
        world(&mut tick);
        self.world_next += WORLD_PERIOD;
        let mut machine = shared.lock();
        for frame in &tick.sent {
            machine.send_from_vehicle(frame);
        }
        machine
    }

    /// Drops the code of cores whose incarnation has ended, and makes the code of cores that have
    /// begun a new incarnation.
    pub(crate) fn follow_incarnations(&mut self) {
        let changes = self.shared.lock().incarnations;
        if core::mem::replace(&mut self.followed, changes) == changes {
            return;
        }
        for place in CoreAddress::ALL {
            let (alive, incarnation) = {
                let mut machine = self.shared.lock();
                let core = machine.core(place);
                (core.alive, core.incarnation)
            };
            let slot = &mut self.cores[place.system.index()][place.core.index()];
            if slot
                .as_ref()
                .is_some_and(|running| !alive || running.incarnation != incarnation)
            {
                *slot = None;
            }
            if alive && slot.is_none() {
                let board = self.board_at(place);
                let poll = (self.factory)(&board);
                let running = Running {
                    incarnation,
                    board,
                    poll,
                };
                self.cores[place.system.index()][place.core.index()] = Some(running);
            }
        }
    }

    fn poll<'a>(
        &mut self,
        place: CoreAddress,
        shared: &'a Shared,
        mut machine: MutexGuard<'a, Machine>,
    ) -> MutexGuard<'a, Machine> {
        let slot = &mut self.cores[place.system.index()][place.core.index()];
        let Some(running) = slot else { return machine };
        let now_ns = machine.now_ns;
        let core = machine.core(place);
        // An earlier poll at this instant may have ended the incarnation.
        if core.incarnation != running.incarnation || !core.is_due(now_ns) {
            return machine;
        }
        if core.attention == Attention::Polled {
            core.interrupted = core::mem::take(&mut core.pending);
        }
        core.deadline_ns = u64::MAX;
        drop(machine);
        let deadline = (running.poll)(&running.board);
        let mut machine = shared.lock();
        let clock = machine.config.clocks[place.system.index()];
        let now_ns = machine.now_ns;
        let core = machine.core(place);
        core.deadline_ns = clock.virtual_ns(deadline.as_ns());
        core.frozen_until_ns = core.frozen_until_ns.max(now_ns + core.rest.as_ns());
        machine
    }
}

/// Observation by tests.
impl SimPair {
    /// Returns the state of a supply.
    #[must_use]
    pub fn power(&self, system: SystemId) -> Power {
        self.shared.lock().systems[system.index()].supply.power()
    }

    /// Returns the role that a system shows; `None` if it does not run.
    #[must_use]
    pub fn lamp(&self, system: SystemId) -> Option<RoleLamp> {
        let machine = self.shared.lock();
        machine
            .is_powered(system)
            .then_some(machine.systems[system.index()].lamp)
    }

    /// Returns the LMU of a system.
    #[must_use]
    pub fn lmu(&self, system: SystemId) -> &[LmuWord] {
        self.shared.lmu(system)
    }

    /// Returns the content of a system's flash, without the effect of an operation in progress.
    #[must_use]
    pub fn flash(&self, system: SystemId) -> Vec<u8> {
        self.shared.lock().systems[system.index()]
            .flash
            .bytes()
            .to_vec()
    }

    /// Returns the events of the systems, oldest first.
    #[must_use]
    pub fn events(&self) -> Vec<SystemEvent> {
        self.shared.lock().events.clone()
    }

    /// Takes the bus log: every frame since the last call, in bus order.
    pub fn take_bus_log(&mut self) -> Vec<OnBus> {
        core::mem::take(&mut self.shared.lock().bus)
    }

    /// Returns a digest of every frame that was on the bus and every event of a system, with their
    /// times. Runs with equal digests were the same.
    #[must_use]
    pub fn digest(&self) -> u64 {
        self.shared.lock().digest.value()
    }

    /// Takes the trace and the number of records that were lost because it was full.
    pub fn take_trace(&mut self) -> (Vec<Traced>, u64) {
        let mut machine = self.shared.lock();
        (
            core::mem::take(&mut machine.trace),
            core::mem::take(&mut machine.trace_lost),
        )
    }
}
