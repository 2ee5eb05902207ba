//! The state of the two systems and of their connections.

use crate::config::{Config, Filter, Tamper};
use crate::digest::Digest;
use crate::event::{OnBus, SystemEvent, SystemEventKind};
use crate::flash_medium::Flash;
use crate::outbox::Output;
use chacha20::ChaCha8Rng;
use chacha20::rand_core::SeedableRng;
use std::collections::VecDeque;
use std::sync::atomic::{AtomicBool, AtomicU32, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use tandem_board::{
    CoreAddress, CoreId, Duration, Edge, Instant, Line, LmuWord, Received, RoleLamp, SystemId,
    TimeEdge, Traced,
};
use tandem_peripherals::network::{Conditions, Ethernet, Network, Station};
use tandem_peripherals::supply::{self, Power, Supply};

/// Words of one LMU: 32 KiB, as on the TC297.
const LMU_WORDS: usize = 8192;

/// How a core gets its interrupts.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Attention {
    /// The pair polls the core when an interrupt is pending.
    Polled,
    /// It sleeps in `wait`.
    Waits,
    /// It runs; interrupts stay pending until it waits.
    Runs,
}

pub(crate) struct Core {
    pub(crate) alive: bool,
    /// Whether core 0 has not yet released this core in this incarnation.
    pub(crate) held: bool,
    pub(crate) generation: u32,
    /// Unique for each incarnation. (The generation restarts at each power-on.)
    pub(crate) incarnation: u64,
    pub(crate) pending: bool,
    pub(crate) attention: Attention,
    pub(crate) deadline_ns: u64,
    pub(crate) frozen_until_ns: u64,
    /// The core is not due for this long after each poll.
    pub(crate) rest: Duration,
    pub(crate) can_fifo: VecDeque<Received>,
    pub(crate) can_wakes: bool,
    pub(crate) overruns: u32,
    /// The mark of the newest stamped frame, and when it was on the bus.
    pub(crate) mark: u32,
    pub(crate) stamp: Option<Instant>,
    /// Whether an interrupt caused the present poll.
    pub(crate) interrupted: bool,
    /// The job to which the core's outputs belong.
    pub(crate) job: Option<u8>,
    /// Outputs that are sent when their job ends.
    pub(crate) outbox: Vec<(u8, Output)>,
}

impl Core {
    fn new() -> Self {
        Self {
            alive: false,
            held: false,
            generation: 0,
            incarnation: 0,
            pending: false,
            attention: Attention::Polled,
            deadline_ns: 0,
            frozen_until_ns: 0,
            rest: Duration::ZERO,
            can_fifo: VecDeque::new(),
            can_wakes: false,
            overruns: 0,
            mark: 0,
            stamp: None,
            interrupted: false,
            job: None,
            outbox: Vec::new(),
        }
    }

    fn start(&mut self, generation: u32, now_ns: u64) {
        let (incarnation, rest) = (self.incarnation + 1, self.rest);
        *self = Self::new();
        self.rest = rest;
        (self.alive, self.generation, self.incarnation) = (true, generation, incarnation);
        self.deadline_ns = now_ns;
    }

    pub(crate) fn is_due(&self, now_ns: u64) -> bool {
        let interrupted = self.pending && self.attention != Attention::Runs;
        self.alive && now_ns >= self.frozen_until_ns && (interrupted || now_ns >= self.deadline_ns)
    }

    /// Returns the time at which the core is next due if nothing happens before.
    pub(crate) fn next_ns(&self) -> u64 {
        let interrupted = self.pending && self.attention != Attention::Runs;
        match (self.alive, interrupted) {
            (false, _) => u64::MAX,
            (true, true) => self.frozen_until_ns,
            (true, false) => self.deadline_ns.max(self.frozen_until_ns),
        }
    }
}

/// A supply and when it next acts, which is asked at each event and changes rarely.
pub(crate) struct ScheduledSupply {
    supply: Supply,
    next: Instant,
}

impl ScheduledSupply {
    fn new(config: supply::Config) -> Self {
        let supply = Supply::new(config);
        let next = supply.next();
        Self { supply, next }
    }

    pub(crate) fn act<R>(&mut self, act: impl FnOnce(&mut Supply) -> R) -> R {
        let result = act(&mut self.supply);
        self.next = self.supply.next();
        result
    }

    pub(crate) fn next(&self) -> Instant {
        debug_assert_eq!(self.next, self.supply.next());
        self.next
    }
}

impl core::ops::Deref for ScheduledSupply {
    type Target = Supply;
    fn deref(&self) -> &Supply {
        &self.supply
    }
}

pub(crate) struct System {
    pub(crate) supply: ScheduledSupply,
    pub(crate) cores: [Core; CoreId::COUNT],
    pub(crate) flash: Flash,
    /// Power fails when the flash has changed this many more bytes.
    pub(crate) flash_bytes_to_live: Option<u64>,
    pub(crate) lamp: RoleLamp,
    pub(crate) tamper: Option<Tamper>,
    /// Changes what each core hears.
    pub(crate) heard: [Option<Filter>; CoreId::COUNT],
    /// Changes what each core sends.
    pub(crate) sent: [Option<Filter>; CoreId::COUNT],
    pub(crate) inbox: VecDeque<Vec<u32>>,
    /// The newest edge of the time line.
    pub(crate) time_edge: Option<TimeEdge>,
}

impl System {
    fn new(supply: supply::Config) -> Self {
        Self {
            supply: ScheduledSupply::new(supply),
            cores: core::array::from_fn(|_| Core::new()),
            flash: Flash::new(),
            flash_bytes_to_live: None,
            lamp: RoleLamp::Starting,
            tamper: None,
            heard: [const { None }; CoreId::COUNT],
            sent: [const { None }; CoreId::COUNT],
            inbox: VecDeque::new(),
            time_edge: None,
        }
    }
}

/// State that cores read often, without the lock. Relaxed: one thread runs at a time, and passing
/// the right to run orders the accesses.
#[derive(Default)]
pub(crate) struct Glance {
    /// Whether a frame may wait in the receiver of each core; false if certainly none waits.
    can: [AtomicBool; CoreAddress::ALL.len()],
    /// Whether a datagram may wait at each system.
    link: [AtomicBool; 2],
    /// Whether a flash operation may be in progress in each system.
    flash: [AtomicBool; 2],
    /// The level line of each system, as its peer sees it.
    level: [AtomicBool; 2],
    /// The time on the clock of each system, ns.
    local_ns: [AtomicU64; 2],
    /// Counts of the edges that each system has received, by line and edge.
    edges: [[[AtomicU32; 2]; Line::ALL.len()]; 2],
}

impl Glance {
    #[inline]
    pub(crate) fn local(&self, system: SystemId) -> Instant {
        Instant::from_ns(self.local_ns[system.index()].load(Ordering::Relaxed))
    }

    pub(crate) fn can(&self, place: CoreAddress) -> &AtomicBool {
        &self.can[place.index()]
    }

    pub(crate) fn link(&self, system: SystemId) -> &AtomicBool {
        &self.link[system.index()]
    }

    pub(crate) fn flash(&self, system: SystemId) -> &AtomicBool {
        &self.flash[system.index()]
    }

    pub(crate) fn level(&self, system: SystemId) -> &AtomicBool {
        &self.level[system.index()]
    }

    pub(crate) fn edges(&self, system: SystemId, line: Line, edge: Edge) -> &AtomicU32 {
        &self.edges[system.index()][line.index()][edge as usize]
    }

    pub(crate) fn forget_edges(&self, system: SystemId) {
        for count in self.edges[system.index()].iter().flatten() {
            count.store(0, Ordering::Relaxed);
        }
    }
}

/// All state that changes, behind one lock.
pub(crate) struct Machine {
    pub(crate) config: Config,
    /// Written only by [`Machine::set_now`].
    pub(crate) now_ns: u64,
    pub(crate) glance: Arc<Glance>,
    pub(crate) systems: [System; 2],
    pub(crate) bus: Vec<OnBus>,
    /// Frames that the world has not yet received.
    pub(crate) unheard: Vec<OnBus>,
    pub(crate) trace: Vec<Traced>,
    pub(crate) trace_lost: u64,
    pub(crate) events: Vec<SystemEvent>,
    /// Counts every start and end of an incarnation.
    pub(crate) incarnations: u64,
    /// The number of stamped frames: the mark of the newest.
    pub(crate) marks: u32,
    pub(crate) noise: ChaCha8Rng,
    pub(crate) network: Network,
    pub(crate) ethernet: Option<Ethernet>,
    pub(crate) digest: Digest,
}

/// Alignment of the LMU, in bytes.
const LINE_BYTES: usize = 64;

/// The machine, shared by the pair and its boards.
pub(crate) struct Shared {
    pub(crate) config: Config,
    lmus: [Vec<LmuWord>; 2],
    pub(crate) glance: Arc<Glance>,
    machine: Mutex<Machine>,
}

impl Shared {
    pub(crate) fn new(config: Config) -> Self {
        let lmu = |_| {
            // One extra line of words, so that `lmu` can start on a line boundary.
            (0..LMU_WORDS + LINE_BYTES / size_of::<LmuWord>())
                .map(|_| LmuWord::new(0xDEAD_BEEF))
                .collect()
        };
        let supply = config.supply();
        let glance = Arc::new(Glance::default());
        let mut machine = Machine {
            config: config.clone(),
            now_ns: 0,
            glance: Arc::clone(&glance),
            systems: [System::new(supply), System::new(supply)],
            bus: Vec::new(),
            unheard: Vec::new(),
            trace: Vec::new(),
            trace_lost: 0,
            events: Vec::new(),
            incarnations: 0,
            marks: 0,
            noise: ChaCha8Rng::seed_from_u64(config.seed),
            network: Network::new(config.wires),
            ethernet: config.network.map(Ethernet::new),
            digest: Digest::new(),
        };
        machine.set_now(0);
        for system in SystemId::ALL {
            machine.show_level(system);
        }
        Self {
            config,
            lmus: SystemId::ALL.map(lmu),
            glance,
            machine: Mutex::new(machine),
        }
    }

    /// Ignores poisoning: a core that panicked under test left the machine in a consistent state.
    pub(crate) fn lock(&self) -> MutexGuard<'_, Machine> {
        self.machine.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub(crate) fn lmu(&self, system: SystemId) -> &[LmuWord] {
        let words = &self.lmus[system.index()];
        &words[words.as_ptr().align_offset(LINE_BYTES)..][..LMU_WORDS]
    }

    pub(crate) fn power_on(&self, system: SystemId) {
        let mut machine = self.lock();
        if machine.systems[system.index()].supply.power() != Power::Off {
            return;
        }
        // Relaxed: the lock orders these stores before the start of the cores.
        for word in self.lmu(system) {
            word.store(0, Ordering::Relaxed);
        }
        machine.power_on(system);
    }
}

impl Machine {
    pub(crate) fn at(&self) -> Instant {
        Instant::from_ns(self.now_ns)
    }

    pub(crate) const fn conditions(&mut self) -> &mut Conditions {
        &mut self.network.conditions
    }

    /// Begins an incarnation of a core, of its CAN controller, and of the port of core 0.
    pub(crate) fn start_core(&mut self, place: CoreAddress, generation: u32) {
        let now_ns = self.now_ns;
        self.core(place).start(generation, now_ns);
        self.network.restart(place);
        if let Some(ethernet) = &mut self.ethernet
            && place.core == CoreId::CONTROL
        {
            ethernet.restart(Station::of(place.system));
        }
    }

    pub(crate) fn core(&mut self, place: CoreAddress) -> &mut Core {
        &mut self.systems[place.system.index()].cores[place.core.index()]
    }

    pub(crate) fn system(&mut self, system: SystemId) -> &mut System {
        &mut self.systems[system.index()]
    }

    pub(crate) fn set_now(&mut self, now_ns: u64) {
        self.now_ns = now_ns;
        for (clock, local) in self.config.clocks.iter().zip(&self.glance.local_ns) {
            local.store(clock.local_ns(now_ns), Ordering::Relaxed);
        }
    }

    /// Moves the clock to the next event of the machine or the world and returns `true`, unless
    /// that event is after `until`. In that case moves the clock to `until` and returns `false`.
    pub(crate) fn advance(&mut self, world: Instant, until: Instant) -> bool {
        let next = Instant::from_ns(self.next_ns()).min(world);
        let goes_on = next <= until && next != Instant::NEVER;
        let to = if goes_on { next } else { until };
        if to != Instant::NEVER {
            self.set_now(self.now_ns.max(to.as_ns()));
        }
        goes_on
    }

    /// Returns the time on a system's clock.
    pub(crate) fn local(&self, system: SystemId) -> Instant {
        self.glance.local(system)
    }

    /// Moves due cores to the front of `places`, keeping their order, and returns their number.
    pub(crate) fn due(&self, places: &mut [CoreAddress]) -> usize {
        let mut count = 0;
        for index in 0..places.len() {
            let CoreAddress { system, core } = places[index];
            if self.systems[system.index()].cores[core.index()].is_due(self.now_ns) {
                places[count] = places[index];
                count += 1;
            }
        }
        count
    }

    pub(crate) fn log(&mut self, system: SystemId, kind: SystemEventKind) {
        let at = self.at();
        let event = SystemEvent { at, system, kind };
        self.digest.event(&event);
        self.events.push(event);
    }

    pub(crate) fn raise(&mut self, place: CoreAddress) {
        let core = self.core(place);
        core.pending = core.alive;
    }

    /// Interrupts core 0 of the other system.
    pub(crate) fn raise_peer(&mut self, system: SystemId) {
        self.raise(CoreAddress {
            system: system.peer(),
            core: CoreId::CONTROL,
        });
    }

    pub(crate) fn ring(&mut self, system: SystemId, to: CoreId) {
        self.raise(CoreAddress { system, core: to });
    }
}
