//! The state of the two systems and of what lies between them.

use crate::config::{Config, Defect};
use crate::flash::{Flash, PAGE_BYTES};
use crate::watchdog::{Service, Watchdog};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use std::collections::VecDeque;
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};
use tandem_board::{
    CanFrame, CoreId, FlashError, Instant, Line, Received, ResetCause, ResetRequest, RoleLamp,
    SystemId, TraceRecord, watchdog_answer,
};

/// Words of one LMU: 32 KiB, as on the TC297.
const LMU_WORDS: usize = 8192;

/// A core of a system.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Place {
    pub(crate) system: SystemId,
    pub(crate) core: CoreId,
}

impl Place {
    /// All six, in a fixed order.
    pub(crate) fn all() -> impl Iterator<Item = Self> {
        SystemId::ALL
            .into_iter()
            .flat_map(|system| CoreId::ALL.map(|core| Self { system, core }))
    }
}

/// Who put a frame on the bus.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Sender {
    /// A core of one of the systems.
    Core(SystemId, CoreId),
    /// The vehicle.
    World,
}

/// A frame on the CAN bus.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct OnBus {
    /// When, in virtual time.
    pub at: Instant,
    /// From whom.
    pub sender: Sender,
    /// What.
    pub frame: CanFrame,
}

/// A record of the trace.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TraceEntry {
    /// When, in virtual time.
    pub at: Instant,
    /// The core's system.
    pub system: SystemId,
    /// The core.
    pub core: CoreId,
    /// What the core said.
    pub record: TraceRecord,
}

/// Something that happened to a system.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Event {
    /// When, in virtual time.
    pub at: Instant,
    /// To which system.
    pub system: SystemId,
    /// What.
    pub kind: EventKind,
}

/// What happened to a system.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum EventKind {
    /// Power came, or the supply released the reset: the cores start.
    Started(ResetCause),
    /// Power was lost.
    PowerLost,
    /// A core asked for a reset.
    Requested(CoreId, ResetRequest),
    /// The supply holds the system in reset for this cause.
    Reset(ResetCause),
    /// The supply holds the system in reset for good.
    Suspended,
    /// A core died.
    CoreDied(CoreId),
    /// A single core began a new life.
    CoreRestarted(CoreId),
    /// The system shows another role.
    Lamp(RoleLamp),
}

/// The state of a supply.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Power {
    /// No power.
    Off,
    /// The system runs.
    On,
    /// The supply holds the system in reset until this virtual time.
    Reset {
        /// When the reset is released.
        until: Instant,
        /// The cause that the system will read.
        cause: ResetCause,
    },
    /// The supply holds the system in reset until power is switched off and on.
    Suspended,
}

/// A connection that a test can cut.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Wire {
    /// A line from one system to the other.
    Line(Line),
    /// The level line that shows a system's power to the other; cut, it reads as high.
    Level,
    /// The data link from one system to the other.
    Link,
    /// A system's connection to the CAN bus, in both directions.
    Can,
}

impl Wire {
    const COUNT: usize = 6;

    fn index(self) -> usize {
        match self {
            Self::Line(line) => line.index(),
            Self::Level => 3,
            Self::Link => 4,
            Self::Can => 5,
        }
    }
}

/// How a core takes notice of interrupts.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Attention {
    /// It is called for them.
    Polled,
    /// It sleeps in `wait`.
    Waits,
    /// It runs; interrupts stay pending until it waits.
    Runs,
}

pub(crate) struct Core {
    pub(crate) alive: bool,
    pub(crate) generation: u32,
    /// Differs between any two lives, unlike the generation, which begins anew with the power.
    pub(crate) life: u64,
    pub(crate) pending: bool,
    pub(crate) attention: Attention,
    pub(crate) deadline_ns: u64,
    pub(crate) frozen_until_ns: u64,
    pub(crate) can_fifo: VecDeque<Received>,
    pub(crate) can_wakes: bool,
    pub(crate) overruns: u32,
    looks: u32,
}

impl Core {
    fn new() -> Self {
        Self {
            alive: false,
            generation: 0,
            life: 0,
            pending: false,
            attention: Attention::Polled,
            deadline_ns: 0,
            frozen_until_ns: 0,
            can_fifo: VecDeque::new(),
            can_wakes: false,
            overruns: 0,
            looks: 0,
        }
    }

    fn start(&mut self, generation: u32, now_ns: u64) {
        let life = self.life + 1;
        *self = Self::new();
        (self.alive, self.generation, self.life) = (true, generation, life);
        self.deadline_ns = now_ns;
    }

    pub(crate) fn is_due(&self, now_ns: u64) -> bool {
        let interrupted = self.pending && self.attention != Attention::Runs;
        self.alive && now_ns >= self.frozen_until_ns && (interrupted || now_ns >= self.deadline_ns)
    }

    /// When it will be due if nothing happens.
    fn next_ns(&self) -> u64 {
        let interrupted = self.pending && self.attention != Attention::Runs;
        match (self.alive, interrupted) {
            (false, _) => u64::MAX,
            (true, true) => self.frozen_until_ns,
            (true, false) => self.deadline_ns.max(self.frozen_until_ns),
        }
    }
}

pub(crate) struct System {
    pub(crate) power: Power,
    pub(crate) cause: ResetCause,
    pub(crate) cores: [Core; CoreId::COUNT],
    pub(crate) watchdog: Watchdog,
    pub(crate) flash: Flash,
    /// Power fails when the flash has changed this many bytes more.
    pub(crate) flash_bytes_to_live: Option<u64>,
    pub(crate) lamp: RoleLamp,
    pub(crate) edges: [[u32; 2]; 3],
    pub(crate) inbox: VecDeque<Vec<u32>>,
    request: Option<ResetRequest>,
    cut: [bool; Wire::COUNT],
}

impl System {
    fn new() -> Self {
        Self {
            power: Power::Off,
            cause: ResetCause::PowerOn,
            cores: core::array::from_fn(|_| Core::new()),
            watchdog: Watchdog::start(0),
            flash: Flash::new(),
            flash_bytes_to_live: None,
            lamp: RoleLamp::Starting,
            edges: [[0; 2]; 3],
            inbox: VecDeque::new(),
            request: None,
            cut: [false; Wire::COUNT],
        }
    }

    pub(crate) fn is_cut(&self, wire: Wire) -> bool {
        self.cut[wire.index()]
    }
}

/// Everything that changes, behind one lock.
pub(crate) struct Machine {
    pub(crate) config: Config,
    pub(crate) now_ns: u64,
    pub(crate) systems: [System; 2],
    pub(crate) bus: Vec<OnBus>,
    /// What the world has not heard yet.
    pub(crate) unheard: Vec<OnBus>,
    pub(crate) trace: Vec<TraceEntry>,
    pub(crate) trace_lost: u64,
    pub(crate) events: Vec<Event>,
    pub(crate) noise: ChaCha8Rng,
}

/// The LMU begins at a boundary of this.
const LINE_BYTES: usize = 64;

/// The machine, as the pair and its boards share it.
pub(crate) struct Shared {
    pub(crate) config: Config,
    lmus: Vec<Vec<AtomicU32>>,
    machine: Mutex<Machine>,
}

impl Shared {
    pub(crate) fn new(config: Config) -> Self {
        let lmu = || {
            // One line more than needed, so that `lmu` can begin at a boundary of a line.
            (0..LMU_WORDS + LINE_BYTES / size_of::<AtomicU32>())
                .map(|_| AtomicU32::new(0xDEAD_BEEF))
                .collect()
        };
        let machine = Machine {
            config: config.clone(),
            now_ns: 0,
            systems: [System::new(), System::new()],
            bus: Vec::new(),
            unheard: Vec::new(),
            trace: Vec::new(),
            trace_lost: 0,
            events: Vec::new(),
            noise: ChaCha8Rng::seed_from_u64(config.seed),
        };
        let lmus = Place::all().map(|_| lmu()).collect();
        Self {
            config,
            lmus,
            machine: Mutex::new(machine),
        }
    }

    /// A core that panicked under test leaves the machine as it is: every change is complete.
    pub(crate) fn lock(&self) -> MutexGuard<'_, Machine> {
        self.machine.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub(crate) fn has(&self, defect: Defect) -> bool {
        self.config.defect == Some(defect)
    }

    pub(crate) fn lmu(&self, place: Place) -> &[AtomicU32] {
        let system = if self.has(Defect::OneLmu) {
            SystemId::A
        } else {
            place.system
        };
        let core = if self.has(Defect::PrivateLmu) {
            place.core
        } else {
            CoreId::CONTROL
        };
        let words = &self.lmus[system.index() * CoreId::COUNT + core.index()];
        &words[words.as_ptr().align_offset(LINE_BYTES)..][..LMU_WORDS]
    }

    pub(crate) fn power_on(&self, system: SystemId) {
        let mut machine = self.lock();
        if machine.systems[system.index()].power != Power::Off {
            return;
        }
        for core in CoreId::ALL {
            for (index, word) in self.lmu(Place { system, core }).iter().enumerate() {
                let dirt = u32::from(self.has(Defect::DirtyLmu) && index == LMU_WORDS - 7);
                // Relaxed: the lock orders it before the start of the cores.
                word.store(dirt, Ordering::Relaxed);
            }
        }
        machine.power_on(system);
    }
}

impl Machine {
    pub(crate) fn has(&self, defect: Defect) -> bool {
        self.config.defect == Some(defect)
    }

    pub(crate) fn at(&self) -> Instant {
        Instant::from_ns(self.now_ns)
    }

    pub(crate) fn core(&mut self, place: Place) -> &mut Core {
        &mut self.systems[place.system.index()].cores[place.core.index()]
    }

    pub(crate) fn system(&mut self, system: SystemId) -> &mut System {
        &mut self.systems[system.index()]
    }

    /// The time on a system's clock.
    pub(crate) fn local(&self, system: SystemId) -> Instant {
        Instant::from_ns(self.config.clocks[system.index()].local_ns(self.now_ns))
    }

    /// The time as a core sees it, with the defects of its clock.
    pub(crate) fn look(&mut self, place: Place) -> Instant {
        let now = self.local(place.system);
        let defect = self.config.defect;
        let core = self.core(place);
        core.looks = core.looks.wrapping_add(1);
        let behind_ns = match defect {
            Some(Defect::ClockGoesBack) if core.looks.is_multiple_of(7) => 1_000_000,
            Some(Defect::SkewedCores) => 200_000 * place.core.index() as u64,
            _ => 0,
        };
        Instant::from_ns(now.as_ns().saturating_sub(behind_ns))
    }

    pub(crate) fn log(&mut self, system: SystemId, kind: EventKind) {
        let at = self.at();
        self.events.push(Event { at, system, kind });
    }

    pub(crate) fn raise(&mut self, place: Place) {
        let core = self.core(place);
        core.pending = core.alive;
    }

    /// Interrupts core 0 of the other system.
    pub(crate) fn raise_peer(&mut self, system: SystemId) {
        self.raise(Place {
            system: system.peer(),
            core: CoreId::CONTROL,
        });
    }

    pub(crate) fn ring(&mut self, system: SystemId, to: CoreId) {
        let core = match self.has(Defect::MisdirectedRing) {
            true => CoreId::ALL[(to.index() + 1) % CoreId::COUNT],
            false => to,
        };
        let place = Place { system, core };
        if self.has(Defect::LostRing) && self.core(place).attention == Attention::Runs {
            return;
        }
        self.raise(place);
    }
}

/// Power and reset.
impl Machine {
    pub(crate) fn is_powered(&self, system: SystemId) -> bool {
        self.systems[system.index()].power == Power::On
    }

    /// What the level line shows of `system` to its peer.
    pub(crate) fn level(&self, system: SystemId) -> bool {
        let shown = self.is_powered(system) && !self.has(Defect::LevelStuckLow);
        let stuck = self.has(Defect::LevelStuckHigh);
        shown || stuck || self.systems[system.index()].is_cut(Wire::Level)
    }

    /// Changes the state of a supply; a change of the level line interrupts the other system.
    fn set_power(&mut self, system: SystemId, power: Power) {
        let before = self.level(system);
        self.system(system).power = power;
        if self.level(system) != before && !self.has(Defect::SilentLevel) {
            self.raise_peer(system);
        }
    }

    pub(crate) fn set_cut(&mut self, wire: Wire, from: SystemId, cut: bool) {
        let before = self.level(from);
        self.system(from).cut[wire.index()] = cut;
        if self.level(from) != before {
            self.raise_peer(from);
        }
    }

    fn power_on(&mut self, system: SystemId) {
        let state = self.system(system);
        state.edges = [[0; 2]; 3];
        state.cores.iter_mut().for_each(|core| core.generation = 0);
        self.start(system, ResetCause::PowerOn);
    }

    /// The cores of a system begin a new life.
    fn start(&mut self, system: SystemId, cause: ResetCause) {
        let now_ns = self.now_ns;
        let skipped = u32::from(self.has(Defect::WrongGeneration));
        let state = self.system(system);
        state.cause = cause;
        state.watchdog = Watchdog::start(now_ns);
        state.lamp = RoleLamp::Starting;
        state.request = None;
        // All are dead here, but for a defect.
        for core in state.cores.iter_mut().filter(|core| !core.alive) {
            core.start(core.generation + 1 + skipped, now_ns);
        }
        self.set_power(system, Power::On);
        self.log(system, EventKind::Started(cause));
    }

    /// The cores of a system and what the chip was doing end.
    fn stop(&mut self, system: SystemId, power: Power) {
        let now_ns = self.now_ns;
        let resets = matches!(power, Power::Reset { .. });
        let partial = resets && self.has(Defect::PartialReset);
        let forgets = resets && self.has(Defect::FlashForgets);
        let state = &mut self.systems[system.index()];
        let changed = state.flash.lose_power(now_ns, &mut self.noise);
        state.flash_bytes_to_live = state
            .flash_bytes_to_live
            .map(|left| left - changed.min(left));
        state.inbox.clear();
        if forgets {
            state.flash = Flash::new();
        }
        let reached = if partial { 2 } else { CoreId::COUNT };
        state.cores[..reached]
            .iter_mut()
            .for_each(|core| core.alive = false);
        self.set_power(system, power);
    }

    pub(crate) fn power_off(&mut self, system: SystemId) {
        if self.systems[system.index()].power != Power::Off {
            self.stop(system, Power::Off);
            self.log(system, EventKind::PowerLost);
        }
    }

    pub(crate) fn reset(&mut self, system: SystemId, cause: ResetCause) {
        if self.is_powered(system) {
            let until = self.at() + self.config.reset_hold;
            self.stop(system, Power::Reset { until, cause });
            self.log(system, EventKind::Reset(cause));
        }
    }

    pub(crate) fn kill_core(&mut self, place: Place) {
        if self.core(place).alive {
            self.core(place).alive = false;
            self.log(place.system, EventKind::CoreDied(place.core));
        }
    }

    pub(crate) fn restart_core(&mut self, place: Place) {
        if self.is_powered(place.system) {
            let now_ns = self.now_ns;
            let core = self.core(place);
            core.start(core.generation + 1, now_ns);
            self.log(place.system, EventKind::CoreRestarted(place.core));
        }
    }

    pub(crate) fn request_reset(&mut self, place: Place, request: ResetRequest) {
        self.system(place.system).request.get_or_insert(request);
        self.log(place.system, EventKind::Requested(place.core, request));
    }

    pub(crate) fn service_watchdog(&mut self, system: SystemId, answer: u8) {
        let (now_ns, defect) = (self.now_ns, self.config.defect);
        let watchdog = &mut self.system(system).watchdog;
        let before = *watchdog;
        let answer = match defect {
            Some(Defect::AnyAnswer) => watchdog_answer(before.question()),
            Some(Defect::WatchdogRefuses) if before.question() == 2 => !answer,
            _ => answer,
        };
        let service = watchdog.service(answer, now_ns);
        match defect {
            Some(Defect::SameQuestion) => watchdog.ask_again(&before),
            Some(Defect::WindowIgnored) => watchdog.open(),
            _ => {}
        }
        if service == Service::Refused && self.config.watchdog {
            self.reset(system, ResetCause::Watchdog);
        }
    }

    /// What the supplies and the flash do at this instant.
    pub(crate) fn settle(&mut self) {
        for system in SystemId::ALL {
            self.settle_flash(system);
            if let Some(request) = self.system(system).request.take() {
                self.obey(system, request);
            }
            let sleeps = self.has(Defect::WatchdogSleeps);
            match self.systems[system.index()].power {
                Power::On => {
                    let late = self.now_ns > self.systems[system.index()].watchdog.closes_ns();
                    if late && self.config.watchdog && !sleeps {
                        self.reset(system, ResetCause::Watchdog);
                    }
                }
                Power::Reset { until, cause } if self.at() >= until => {
                    let forgotten = self.has(Defect::CauseForgotten);
                    self.start(
                        system,
                        if forgotten {
                            ResetCause::PowerOn
                        } else {
                            cause
                        },
                    );
                }
                _ => {}
            }
        }
    }

    fn obey(&mut self, system: SystemId, request: ResetRequest) {
        if !self.is_powered(system) || self.has(Defect::RequestIgnored) {
            return;
        }
        match request {
            ResetRequest::Software => self.reset(system, ResetCause::Software),
            ResetRequest::CoreDead => self.reset(system, ResetCause::Trap),
            ResetRequest::Suspend => {
                self.stop(system, Power::Suspended);
                self.log(system, EventKind::Suspended);
            }
        }
    }

    /// When the flash of a system has changed as many bytes as it is allowed to.
    fn flash_dies_ns(&self, system: SystemId) -> Option<u64> {
        let state = &self.systems[system.index()];
        state.flash.changed_ns(state.flash_bytes_to_live?)
    }

    fn settle_flash(&mut self, system: SystemId) {
        let now_ns = self.now_ns;
        if self
            .flash_dies_ns(system)
            .is_some_and(|dies| now_ns >= dies)
        {
            self.power_off(system);
            self.system(system).flash_bytes_to_live = None;
            return;
        }
        let state = self.system(system);
        let changed = state.flash.settle(now_ns);
        state.flash_bytes_to_live = state.flash_bytes_to_live.map(|left| left - changed);
    }

    /// The next virtual time at which something happens by itself.
    pub(crate) fn next_ns(&self) -> u64 {
        let sleeps = self.has(Defect::WatchdogSleeps);
        let of_system = |system: SystemId| {
            let state = &self.systems[system.index()];
            let supply = match state.power {
                Power::On if self.config.watchdog && !sleeps => {
                    state.watchdog.closes_ns().saturating_add(1)
                }
                Power::Reset { until, .. } => until.as_ns(),
                _ => u64::MAX,
            };
            let flash = state.flash.ends_ns().unwrap_or(u64::MAX);
            let cut = self.flash_dies_ns(system).unwrap_or(u64::MAX);
            let cores = state
                .cores
                .iter()
                .map(Core::next_ns)
                .min()
                .unwrap_or(u64::MAX);
            supply.min(flash).min(cut).min(cores)
        };
        of_system(SystemId::A).min(of_system(SystemId::B))
    }
}

/// What core 0 asks of the flash, with the defects of the medium.
impl Machine {
    pub(crate) fn start_erase(&mut self, system: SystemId, sector: u32) -> Result<(), FlashError> {
        let (now_ns, defect) = (self.now_ns, self.config.defect);
        let flash = &mut self.system(system).flash;
        if defect == Some(Defect::NeverBusy) {
            flash.abandon();
        }
        flash.start_erase(sector, now_ns)?;
        if defect == Some(Defect::EraseToZero) {
            flash.spoil(|_, target| target.fill(0));
        }
        Ok(())
    }

    pub(crate) fn start_program(
        &mut self,
        system: SystemId,
        offset: u32,
        data: &[u8],
    ) -> Result<(), FlashError> {
        let (now_ns, defect) = (self.now_ns, self.config.defect);
        let flash = &mut self.system(system).flash;
        if defect == Some(Defect::NeverBusy) {
            flash.abandon();
        }
        let offset = match defect {
            Some(Defect::MisalignedProgram) => offset & !(PAGE_BYTES - 1),
            _ => offset,
        };
        flash.start_program(offset, data, now_ns)?;
        if defect == Some(Defect::ProgramDisturbs) {
            flash.spoil(|behind, _| behind.fill(0));
        }
        Ok(())
    }
}
