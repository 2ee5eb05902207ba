//! Both systems and a vehicle in virtual time, with faults applied to them.

use crate::bend::{self, Bends, Trajectories};
use crate::outside::{ALONE_SPEED, OutsideVehicle, POISON, another_command};
use crate::timing::Time;
use crate::{drive, timed};
use std::cell::RefCell;
use std::rc::Rc;
use tandem_board::{
    Board, Can, CoreId, Duration, Generation, HardwareFault, Instant, ResetCause, RoleLamp,
    SupplyEvent, SystemId, Traced,
};
use tandem_board_sim::{
    BusFault, Clock, Config as BoardConfig, Poller, Power, SimBoard, SimPair, SystemEvent,
    SystemEventKind, Wire,
};
use tandem_cores::Config;
use tandem_cores::driving::perception::Perception;
use tandem_cores::driving::types::Lanes;
use tandem_cores::layout::{ControllerMap, SCENE};
use tandem_cores::trace::Event;
use tandem_faults::{
    BusFaults, CannotSuffer, DriveRoad, Effect, Fault, Kind, Site, Suffer, effects,
};
use tandem_record::log::VehicleRecord;
use tandem_record::verdict::Limits;
use tandem_record::{Entry, RunLog, description};
use tandem_vehicle::LoggedFrame;
use tandem_vehicle::gate::Acceptance;

/// Which cores run the real software, and what surrounds them.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Around {
    /// Core 0 only. Cores 1 and 2 only count cycles, the former sees an empty lane, and no vehicle
    /// moves.
    #[default]
    Core0,
    /// All cores, and a vehicle in its lane on this road.
    ClosedLoop(DriveRoad),
}

impl Around {
    /// The road of all campaigns but that of wrong values.
    pub const CLOSED_LOOP: Self = Self::ClosedLoop(DriveRoad::StopAndGo);
}

/// The simulated machine of a sequence.
#[derive(Clone, Copy, Debug)]
pub struct Profile {
    /// Limits of the redundancy.
    pub limits: tandem_redundancy::Config,
    /// How long jobs, wires and frames take.
    pub time: Time,
    /// Which cores run the real software, and what surrounds them.
    pub around: Around,
}

impl From<tandem_redundancy::Config> for Profile {
    fn from(limits: tandem_redundancy::Config) -> Self {
        Self {
            limits,
            time: Time::Ideal,
            around: Around::Core0,
        }
    }
}

impl Profile {
    /// Returns the limits of the requirement for this configuration.
    #[must_use]
    pub fn bounds(&self) -> Limits {
        Limits::of_profile(&self.limits)
    }

    /// Returns the limits of both systems, with short waiting times at the start.
    fn config(&self) -> Config {
        let boot_limit = match self.around {
            // The cores need not wait for sensors.
            Around::Core0 => Duration::from_ms(60),
            Around::ClosedLoop(_) => Config::rt().boot_limit,
        };
        Config {
            redundancy: tandem_redundancy::Config {
                start_limit: Duration::from_ms(300),
                ..self.limits
            },
            boot_limit,
            ..Config::rt()
        }
    }
}

/// Creates the software of the core of this board. A [`POISON`] frame ends core 1.
fn poller(
    board: &SimBoard,
    config: Config,
    (time, around): (Time, Around),
    trajectories: &Trajectories,
) -> Poller {
    // A reset ends the core but not this process, so each incarnation leaks one board.
    let board: &'static SimBoard = Box::leak(Box::new(board.clone()));
    match (board.identity().core, around) {
        (CoreId::CONTROL, _) if time != Time::Ideal => timed::core_0(board, config, time),
        (CoreId::PERCEPTION, Around::ClosedLoop(_)) => {
            let mut core = timed::core_1(board, time);
            let mut dead = false;
            Box::new(move |_| {
                dead |= board.has_received(POISON);
                if dead { Instant::NEVER } else { core(board) }
            })
        }
        (CoreId::PLANNING, Around::ClosedLoop(_)) => {
            let core = timed::core_2(board, time);
            bend::planner(board, core, Rc::clone(trajectories))
        }
        (core, Around::Core0) if core != CoreId::CONTROL => counter(board),
        _ => drive::poller(board, config),
    }
}

/// Without a vehicle, core 1 sees its lane this long after its start.
const SEES_AFTER: Duration = Duration::from_ms(50);

/// Creates a core that counts cycles. Core 1 also sees an empty straight lane, without which no
/// system would be able to drive.
fn counter(board: &'static SimBoard) -> Poller {
    let core = board.identity().core;
    let (mut map, mut scenes, mut dead) = (None, None, false);
    let sees_at = board.now() + SEES_AFTER;
    let mut scene = Perception::new().scene().clone();
    scene.ego.speed = ALONE_SPEED;
    scene.lanes = Some(Lanes::alone(3.5, 80.0));
    Box::new(move |_| {
        while let Some(received) = board.can().try_receive() {
            dead |= received.frame.id() == POISON && core == CoreId::PERCEPTION;
        }
        if dead {
            return Instant::NEVER;
        }
        map = map.take().or_else(|| ControllerMap::attach(board).ok());
        let Some(attached) = &map else {
            return board.now() + Duration::from_ms(1);
        };
        if core == CoreId::PERCEPTION && board.now() >= sees_at {
            (scene.at, scene.measured) = (board.now(), board.now());
            scene.cycle = scene.cycle.wrapping_add(1);
            scenes = scenes
                .take()
                .or_else(|| SCENE.writer(&attached.map, attached.incarnation).ok());
            if let Some(scenes) = &mut scenes {
                scenes.publish(&scene);
                board.ring(CoreId::CONTROL);
            }
        }
        attached.count_cycle();
        board.now() + Duration::from_ms(50)
    })
}

/// Time of a datagram in cables and switch.
const NETWORK: Duration = Duration::from_us(100);
/// Interval at which the roles are checked while a bench heals.
const HEAL_STEP: Duration = Duration::from_ms(25);
/// A bench is healed after master and standby were stable for this long; longer than `STEADY`.
const HEALED: Duration = Duration::from_ms(300);

/// The state of a system that a fault hits.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SequenceState {
    /// It has no power.
    Off,
    /// The supply holds it in reset.
    Reset,
    /// Its lamp shows this role.
    Shows(RoleLamp),
}

impl SequenceState {
    /// All states. A system that its supply has suspended counts as [`RoleLamp::Suspended`].
    pub const ALL: [Self; 7] = [
        Self::Off,
        Self::Reset,
        Self::Shows(RoleLamp::Starting),
        Self::Shows(RoleLamp::Master),
        Self::Shows(RoleLamp::DegradedMaster),
        Self::Shows(RoleLamp::Standby),
        Self::Shows(RoleLamp::Suspended),
    ];

    fn of(pair: &SimPair, system: SystemId) -> Self {
        match (pair.power(system), pair.lamp(system)) {
            (Power::Off, _) => Self::Off,
            (Power::Suspended, _) => Self::Shows(RoleLamp::Suspended),
            (_, Some(lamp)) => Self::Shows(lamp),
            (_, None) => Self::Reset,
        }
    }
}

/// Both systems and one vehicle in virtual time.
pub struct Bench {
    /// The machine.
    pub pair: SimPair,
    /// The vehicle's log so far.
    pub vehicle: Rc<RefCell<OutsideVehicle>>,
    /// The limits of both systems.
    pub config: Config,
    /// The profile from which the bench was made.
    pub profile: Profile,
    /// Each kind of fault that was applied, with the state of the system that it hit.
    pub(crate) covered: Vec<(Kind, SequenceState)>,
    /// The changes made so far, with their times; `None`: everything was restored.
    applied: Vec<(Instant, Option<Effect>)>,
    /// The trace records read so far.
    traced: Vec<Traced>,
    bus: BusFaults,
    bends: Bends,
    /// The time at which the run began.
    pub(crate) born: Instant,
}

impl Bench {
    /// Creates two systems without power. `seed` seeds the machine's random numbers.
    /// `keeps_events`: whether to keep the events of the cores.
    #[must_use]
    pub fn new(profile: impl Into<Profile>, seed: u64, keeps_events: bool) -> Self {
        Self::with(profile.into(), seed, [keeps_events; 2], None)
    }

    /// Like [`Bench::new`], with a network if one of these faults needs it: then the topics task
    /// works too.
    pub(crate) fn suffering(profile: Profile, faults: &[Fault], seed: u64, keeps: bool) -> Self {
        let is_cut = faults.iter().any(|fault| fault.kind == Kind::NetworkCut);
        Self::with(profile, seed, [keeps; 2], is_cut.then_some(NETWORK))
    }

    /// Like [`Bench::new`], but always keeps the events of the cores. `keeps_frames`: whether to
    /// keep each frame.
    pub(crate) fn tracing(profile: Profile, seed: u64, keeps_frames: bool) -> Self {
        Self::with(profile, seed, [keeps_frames, true], None)
    }

    fn with(
        profile: Profile,
        seed: u64,
        [keeps_frames, keeps_events]: [bool; 2],
        network: Option<Duration>,
    ) -> Self {
        let (config, Profile { time, around, .. }) = (profile.config(), profile);
        // Start far from zero, so that a clock can run behind.
        let clock = |offset_s: u64, of| Clock {
            offset_ns: offset_s * 1_000_000_000,
            drift_ppb: time.drift_ppb(of),
        };
        let board_config = BoardConfig {
            seed,
            clocks: [clock(1_000, SystemId::A), clock(77_000, SystemId::B)],
            wires: time.wires(),
            network,
            trace_records: if keeps_events { 1 << 20 } else { 0 },
            ..BoardConfig::default()
        };
        let bends = Bends::default();
        let trajectories = Rc::clone(&bends.trajectories);
        let mut pair = SimPair::new(board_config, move |board| {
            poller(board, config, (time, around), &trajectories)
        });
        let born = pair.now();
        let road = match around {
            Around::Core0 => None,
            Around::ClosedLoop(road) => Some(road),
        };
        let vehicle = OutsideVehicle::new(road, keeps_frames);
        let vehicle = Rc::new(RefCell::new(vehicle));
        let shared = Rc::clone(&vehicle);
        pair.set_world(move |tick| shared.borrow_mut().tick(tick));
        Self {
            pair,
            vehicle,
            config,
            profile,
            bus: BusFaults::default(),
            bends,
            born,
            covered: Vec::new(),
            applied: Vec::new(),
            traced: Vec::new(),
        }
    }

    /// Creates a bench in dual operation, in which A drives.
    ///
    /// # Panics
    /// If the systems do not reach dual operation.
    #[must_use]
    pub fn dual(profile: impl Into<Profile>, seed: u64, keeps_events: bool) -> Self {
        let mut bench = Self::new(profile, seed, keeps_events);
        bench.reach_dual();
        bench
    }

    /// Powers both systems on, and runs until A drives and B stands by.
    ///
    /// # Panics
    /// If the systems do not reach dual operation.
    pub(crate) fn reach_dual(&mut self) {
        self.power_on();
        self.pair.run_for(match self.profile.around {
            Around::Core0 => Duration::from_ms(300),
            Around::ClosedLoop(_) => Duration::from_ms(700),
        });
        let roles = SystemId::ALL.map(|system| self.pair.lamp(system));
        let dual = [RoleLamp::Master, RoleLamp::Standby].map(Some);
        assert_eq!(roles, dual, "no dual operation");
    }

    /// Powers both systems on.
    pub fn power_on(&mut self) {
        let mut on = |system| self.pair.power_on(system);
        SystemId::ALL.into_iter().for_each(&mut on);
    }

    /// Runs for `span`. The faults, whose times count from now, begin and end during that time.
    /// Then everything is restored, and both systems have power.
    ///
    /// # Panics
    /// If the simulator cannot apply one of the faults.
    pub fn suffer(&mut self, faults: &[Fault], span: Duration) {
        let begin = self.pair.now();
        let mut hits: Vec<&Fault> = faults.iter().collect();
        hits.sort_by_key(|fault| fault.at);
        let mut hits = hits.into_iter().peekable();
        for (at, change) in effects(faults, span, SystemId::A) {
            self.pair.run_until(begin + at.min(span));
            while let Some(fault) = hits.next_if(|fault| fault.at <= at) {
                let states = fault
                    .way
                    .systems()
                    .map(|of| SequenceState::of(&self.pair, of));
                self.covered.extend(states.map(|state| (fault.kind, state)));
            }
            let applied = self.apply(change);
            applied.expect("a fault that the simulator can suffer");
        }
        self.pair.run_until(begin + span);
        self.restore();
    }

    /// Runs until master and standby were stable for [`HEALED`], at most for
    /// [`settles_within`](Self::settles_within). `whole`: always run for that time.
    pub(crate) fn heal(&mut self, whole: bool) {
        let until = self.pair.now() + self.settles_within();
        let mut sound_since = self.pair.now();
        while self.pair.now() < until {
            self.pair
                .run_until((self.pair.now() + HEAL_STEP).min(until));
            let mut lamps = SystemId::ALL.map(|system| self.pair.lamp(system));
            lamps.sort_by_key(|lamp| *lamp != Some(RoleLamp::Master));
            let sound = lamps == [Some(RoleLamp::Master), Some(RoleLamp::Standby)];
            if !sound {
                sound_since = self.pair.now();
            }
            if !whole && self.pair.now().since(sound_since) >= HEALED {
                return;
            }
        }
    }

    /// Returns the time limit from the restoration until a system drives; covers a start of both.
    #[must_use]
    pub fn settles_within(&self) -> Duration {
        let limits = &self.config.redundancy;
        self.config.boot_limit
            + limits.start_limit
            + limits.stagger.times(4)
            + limits.no_master_limit(SystemId::B)
            + Duration::from_ms(300)
    }

    /// Returns how many systems have suspended themselves.
    pub(crate) fn suspended(&self) -> usize {
        let suspended = |system: &SystemId| self.pair.power(*system) == Power::Suspended;
        SystemId::ALL.into_iter().filter(suspended).count()
    }

    /// Returns every frame so far, if the cores' events are kept.
    #[must_use]
    pub fn frames(&self) -> Vec<LoggedFrame> {
        self.vehicle.borrow().frames()
    }

    /// Forgets the events so far.
    pub(crate) fn forget_trace(&mut self) {
        self.trace();
        self.traced.clear();
    }

    pub(crate) fn trace(&mut self) -> &[Traced] {
        self.traced.extend(self.pair.take_trace().0);
        &self.traced
    }

    /// Returns the recording so far, without the motion of the vehicle.
    #[must_use]
    pub fn recording(&mut self) -> RunLog {
        let mut log = RunLog::default();
        for frame in self.frames() {
            log.push(Entry::Frame(frame));
        }
        for traced in self.trace() {
            log.push(Entry::Trace(*traced));
        }
        for SystemEvent { at, system, kind } in self.pair.events() {
            let (core, generation) = (CoreId::CONTROL, Generation(1));
            let event = match kind {
                SystemEventKind::Started(_) => SupplyEvent::CoreStarted { core, generation },
                SystemEventKind::Reset(cause) => SupplyEvent::Reset(cause),
                SystemEventKind::Suspended => SupplyEvent::Suspended,
                SystemEventKind::CoreDied(core) => SupplyEvent::CoreDied { core, signal: 0 },
                _ => continue,
            };
            log.push(Entry::Supply(at, system, event));
        }
        for (at, change) in &self.applied {
            for record in hand(*at, *change) {
                log.push(Entry::Vehicle(Box::new(record)));
            }
        }
        let at_ns = self.vehicle.borrow().accepted.first().map(|it| it.at_ns);
        let start = at_ns.map(|at_ns| VehicleRecord::Start { at_ns });
        let at_ns = self.pair.now().as_ns();
        let end = VehicleRecord::End {
            at_ns,
            lost_trace: 0,
            stalled_ms: 0.0,
        };
        for record in start.into_iter().chain([end]) {
            log.push(Entry::Vehicle(Box::new(record)));
        }
        log.sort();
        log
    }

    /// Returns one line for each notable event so far, of the cores, the supplies and the vehicle.
    #[must_use]
    pub fn story(&mut self) -> Vec<String> {
        let mut lines: Vec<(Instant, String)> = Vec::new();
        for traced in self.trace() {
            let event = Event::decode(traced.record);
            let tells = event.filter(|event| !description::is_routine(event));
            let (system, core) = (traced.system, traced.core);
            lines.extend(tells.map(|event| (traced.at, format!("{system}{core} {event:?}"))));
        }
        for event in self.pair.events() {
            if !matches!(event.kind, SystemEventKind::Lamp(_)) {
                lines.push((event.at, format!("{} {:?}", event.system, event.kind)));
            }
        }
        let vehicle = self.vehicle.borrow();
        let mut last: Option<Acceptance> = None;
        for frame in &vehicle.accepted {
            let at = Instant::from_ns(frame.at_ns);
            let gap_ns = last.map_or(0, |last| frame.at_ns - last.at_ns);
            let other =
                last.is_none_or(|last| (last.system, last.term) != (frame.system, frame.term));
            if other || gap_ns > 12_000_000 {
                let gap = gap_ns as f64 * 1e-6;
                let (of, term) = (frame.system, frame.term);
                lines.push((
                    at,
                    format!("vehicle obeys {of}, term {term}, after {gap:.1} ms"),
                ));
            }
            last = Some(*frame);
        }
        if let Some(world) = vehicle.world() {
            let (drive, speed) = (world.metrics(), world.snapshot().speed);
            let text = format!(
                "vehicle at {speed:.1} m/s after {:.1} m, at least {:.2} s behind the next one; \
                 {} collisions, {:.2} m beside its lanes",
                drive.distance_m, vehicle.headway_s, drive.collisions, drive.excursion_max_m,
            );
            lines.push((self.pair.now(), text));
        }
        lines.sort_by_key(|(at, _)| *at);
        let line =
            |(at, text): (Instant, String)| format!("{:9.2} ms {text}", at.as_ns() as f64 * 1e-6);
        lines.into_iter().map(line).collect()
    }
}

/// Returns the records of an injected fault, or of the restoration of both systems.
fn hand(at: Instant, change: Option<Effect>) -> impl Iterator<Item = VehicleRecord> {
    let of = move |system: SystemId, what: String| VehicleRecord::Hand {
        at_ns: at.as_ns(),
        system: system.index() as u8,
        what,
        cuts: 0,
    };
    let record = match change {
        Some(Effect::Fault(kind, system, true)) => {
            Some(of(system, format!("fault begins: {kind}")))
        }
        Some(Effect::Fault(kind, system, false)) => Some(of(system, format!("fault ends: {kind}"))),
        Some(Effect::Edge(from, line, edge)) => {
            let what = format!("its {line:?} line has a stray edge: {edge:?}");
            Some(of(from, what))
        }
        None => None,
    };
    let restored = SystemId::ALL
        .into_iter()
        .filter(move |_| change.is_none())
        .map(move |system| of(system, "everything is restored".to_owned()));
    record.into_iter().chain(restored)
}

impl Suffer for Bench {
    type Error = CannotSuffer;

    fn apply(&mut self, change: Effect) -> Result<(), CannotSuffer> {
        let pair = &mut self.pair;
        self.applied.push((pair.now(), Some(change)));
        let (kind, of, on) = match change {
            Effect::Fault(kind, of, on) => (kind, of, on),
            Effect::Edge(from, line, edge) => {
                pair.stray_edge(from.peer(), line, edge);
                return Ok(());
            }
        };
        if let Some(fault) = self.bus.follow(kind, of, on) {
            pair.disturb_bus(of, fault);
            return Ok(());
        }
        if self.bends.follow(pair, kind, of, on) {
            return Ok(());
        }
        match kind {
            Kind::Cut { wire } if on => pair.cut(wire, of),
            Kind::Cut { wire } => pair.restore(wire, of),
            Kind::LevelLow => pair.hold_level_low(of, on),
            Kind::PowerLoss if on => pair.power_off(of),
            Kind::PowerLoss => pair.power_on(of),
            Kind::ResetByWatchdog => pair.reset(of, ResetCause::Watchdog),
            Kind::ResetBySoftware => pair.reset(of, ResetCause::Software),
            Kind::ResetByTrap => pair.reset(of, ResetCause::Trap),
            Kind::Hang(amount) if on => pair.freeze(of, amount.ms()),
            // The freeze has ended by itself, or a later fault still stops the cores.
            Kind::Hang(_) => {}
            Kind::CoreHangs(amount) => {
                // Longer than any sequence: another change ends the freeze.
                let span = if on {
                    Duration::from_ms(3_600_000)
                } else {
                    Duration::ZERO
                };
                pair.freeze_core(of, amount.core(), span);
            }
            Kind::CoreDies(amount) => pair.kill_core(of, amount.core()),
            Kind::Slow(amount) => {
                let rest = if on { amount.ms() } else { Duration::ZERO };
                pair.rest_core(of, CoreId::CONTROL, rest);
            }
            Kind::Clock(amount) => {
                let permille = if on { amount.get() } else { 0 };
                pair.set_clock_rate(of, permille * 1_000_000 + self.profile.time.drift_ppb(of));
            }
            Kind::ClockJumps(amount) => pair.jump_clock(of, amount.get()),
            Kind::WrongResults => pair.tamper(of, on.then_some(another_command)),
            Kind::Scribble => pair.scribble(of, 0x5EED),
            Kind::FlashHangs => pair.hang_flash(of, on),
            Kind::NetworkCut => pair.set_fault(of, HardwareFault::Network, on),
            Kind::FlashLost => pair.edit_flash(of, |bytes| bytes.fill(0x5A)),
            Kind::Forged(forged) => self.vehicle.borrow_mut().forge(forged, on),
            Kind::Poison => self.vehicle.borrow_mut().poison = on,
            Kind::VehicleSilent => self.vehicle.borrow_mut().silent = on,
            _ => {
                let site = Site::Simulator;
                return Err(CannotSuffer { kind, site });
            }
        }
        Ok(())
    }

    fn restore(&mut self) {
        self.applied.push((self.pair.now(), None));
        self.bus = BusFaults::default();
        self.vehicle.borrow_mut().poison = false;
        self.vehicle.borrow_mut().silent = false;
        self.vehicle.borrow_mut().forged.clear();
        self.bends.clear(&mut self.pair);
        let pair = &mut self.pair;
        for of in SystemId::ALL {
            Wire::ALL
                .into_iter()
                .for_each(|wire| pair.restore(wire, of));
            pair.hold_level_low(of, false);
            pair.disturb_bus(of, BusFault::default());
            pair.rest_core(of, CoreId::CONTROL, Duration::ZERO);
            pair.freeze(of, Duration::ZERO);
            pair.set_clock_rate(of, self.profile.time.drift_ppb(of));
            pair.tamper(of, None);
            pair.hang_flash(of, false);
            pair.set_fault(of, HardwareFault::Network, false);
            pair.power_on(of);
        }
    }
}
