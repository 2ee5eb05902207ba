//! Both systems and a vehicle in virtual time, and faults that are done to them.

use super::fault::{Act, BusFaults, Fault, Kind};
use super::plan::Profile;
use super::vehicle::{POISON, Vehicle, another_command};
use crate::timing::Time;
use crate::{drive, timed};
use std::cell::RefCell;
use std::rc::Rc;
use tandem_board::{
    Board, Can, CoreId, Duration, Generation, Instant, Line, RoleLamp, SupplyEvent, SystemId,
    Traced,
};
use tandem_board_sim::{
    Clock, Config as BoardConfig, Poller, Power, SimBoard, SimPair, SystemEvent, SystemEventKind,
    Wire,
};
use tandem_cores::Config;
use tandem_cores::layout::ControllerMap;
use tandem_cores::trace::Event;
use tandem_record::log::VehicleRecord;
use tandem_record::{Entry, RunLog, description};
use tandem_vehicle::LoggedFrame;
use tandem_vehicle::gate::Acceptance;

/// Which cores are the real ones, and what is around them.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Around {
    /// Core 0. Cores 1 and 2 only count cycles, and no vehicle moves.
    #[default]
    Core0,
    /// All cores, and a vehicle in its lane.
    ClosedLoop,
}

/// The core of this board. Core 1 dies of poison.
fn poller(board: &SimBoard, config: Config, time: Time, around: Around) -> Poller {
    // A reset ends the core but not this process: a few boards are leaked.
    let board: &'static SimBoard = Box::leak(Box::new(board.clone()));
    match (board.identity().core, around) {
        (CoreId::CONTROL, _) if time != Time::Ideal => timed::core_0(board, config, time),
        (CoreId::PERCEPTION, Around::ClosedLoop) => {
            let mut core = timed::core_1(board, time);
            let mut dead = false;
            Box::new(move |_| {
                dead |= board.has_received(POISON);
                if dead { Instant::NEVER } else { core(board) }
            })
        }
        (CoreId::PLANNING, Around::ClosedLoop) => timed::core_2(board, time),
        (core, Around::Core0) if core != CoreId::CONTROL => counter(board),
        _ => drive::poller(board, config),
    }
}

/// A core that only counts cycles.
fn counter(board: &'static SimBoard) -> Poller {
    let core = board.identity().core;
    let (mut map, mut dead) = (None, false);
    Box::new(move |_| {
        while let Some(received) = board.can().try_receive() {
            dead |= received.frame.id() == POISON && core == CoreId::PERCEPTION;
        }
        if dead {
            return Instant::NEVER;
        }
        map = map.take().or_else(|| ControllerMap::attach(board).ok());
        let Some(map) = &map else {
            return board.now() + Duration::from_ms(1);
        };
        map.count_cycle();
        board.now() + Duration::from_ms(50)
    })
}

/// While a bench heals, the roles are looked at this often.
const HEAL_STEP: Duration = Duration::from_ms(25);
/// Master and standby for this long are healed. Longer than the time for which the end is judged.
const HEALED: Duration = Duration::from_ms(300);

/// The state of a system that a fault hits.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum State {
    /// Without power.
    Off,
    /// The supply holds it in reset.
    Reset,
    /// It shows this role.
    Shows(RoleLamp),
}

impl State {
    /// All. A supply that holds its system for good counts as [`RoleLamp::Suspended`].
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
    /// The vehicle's log until now.
    pub vehicle: Rc<RefCell<Vehicle>>,
    /// The limits of both systems.
    pub config: Config,
    /// How long things take.
    pub time: Time,
    /// What is around core 0.
    pub around: Around,
    /// What its faults hit: a kind, by its label, and the state of the system.
    pub(super) covered: Vec<(Kind, State)>,
    /// The trace records that were read.
    traced: Vec<Traced>,
    bus: BusFaults,
    /// When the run began.
    pub(super) born: Instant,
}

impl Bench {
    /// Limits of the campaign with core 0 alone: those of `redundancy`, with short waits at the
    /// start.
    #[must_use]
    pub fn config(redundancy: tandem_redundancy::Config) -> Config {
        Self::config_of(redundancy, Around::Core0)
    }

    fn config_of(redundancy: tandem_redundancy::Config, around: Around) -> Config {
        let boot_limit = match around {
            // There are no sensors to wait for.
            Around::Core0 => Duration::from_ms(60),
            Around::ClosedLoop => Config::rt().boot_limit,
        };
        Config {
            redundancy: tandem_redundancy::Config {
                start_limit: Duration::from_ms(300),
                ..redundancy
            },
            boot_limit,
            ..Config::rt()
        }
    }

    /// Two systems without power. `seed`: of what the machine draws. `told`: whether the cores'
    /// events are kept.
    #[must_use]
    pub fn new(config: Config, seed: u64, told: bool) -> Self {
        Self::made(config, Time::Ideal, Around::Core0, seed, told)
    }

    /// Two systems without power, as this profile says.
    #[must_use]
    pub(super) fn of(profile: Profile, told: bool) -> Self {
        let Profile {
            limits,
            time,
            around,
        } = profile;
        Self::made(Self::config_of(limits, around), time, around, 0, told)
    }

    fn made(config: Config, time: Time, around: Around, seed: u64, told: bool) -> Self {
        // Far from zero, so that a clock may slow down.
        let clock = |offset_s: u64, of| Clock {
            offset_ns: offset_s * 1_000_000_000,
            drift_ppb: time.drift_ppb(of),
        };
        let board_config = BoardConfig {
            seed,
            clocks: [clock(1_000, SystemId::A), clock(77_000, SystemId::B)],
            wires: time.wires(),
            trace_records: if told { 1 << 20 } else { 0 },
            ..BoardConfig::default()
        };
        let mut pair = SimPair::new(board_config, move |board| {
            poller(board, config, time, around)
        });
        let born = pair.now();
        let vehicle = Vehicle::new(around == Around::ClosedLoop, told);
        let vehicle = Rc::new(RefCell::new(vehicle));
        let shared = Rc::clone(&vehicle);
        pair.set_world(move |tick| shared.borrow_mut().tick(tick));
        Self {
            pair,
            vehicle,
            config,
            time,
            around,
            bus: BusFaults::default(),
            born,
            covered: Vec::new(),
            traced: Vec::new(),
        }
    }

    /// Both in dual operation, A driving.
    ///
    /// # Panics
    /// If they do not begin.
    #[must_use]
    pub fn dual(config: Config, seed: u64, told: bool) -> Self {
        let mut bench = Self::new(config, seed, told);
        bench.begin();
        bench
    }

    /// Switches both on, and runs until both are in dual operation, A driving.
    ///
    /// # Panics
    /// If they do not begin.
    pub(super) fn begin(&mut self) {
        SystemId::ALL
            .into_iter()
            .for_each(|system| self.pair.power_on(system));
        self.pair.run_for(match self.around {
            Around::Core0 => Duration::from_ms(300),
            Around::ClosedLoop => Duration::from_ms(700),
        });
        let roles = SystemId::ALL.map(|system| self.pair.lamp(system));
        let dual = [RoleLamp::Master, RoleLamp::Standby].map(Some);
        assert_eq!(roles, dual, "no dual operation");
    }

    /// Runs for `span` while these faults, whose times count from now, come and go; then everything
    /// is mended and has power.
    pub fn suffer(&mut self, faults: &[Fault], span: Duration) {
        let begin = self.pair.now();
        let mut acts: Vec<(Duration, Act)> =
            faults.iter().flat_map(|fault| fault.acts(span)).collect();
        acts.sort_by_key(|(at, _)| *at);
        let mut hits: Vec<&Fault> = faults.iter().collect();
        hits.sort_by_key(|fault| fault.at);
        let mut hits = hits.into_iter().peekable();
        for (at, act) in acts {
            self.pair.run_until(begin + at.min(span));
            while let Some(fault) = hits.next_if(|fault| fault.at <= at) {
                let states = fault.way.systems().map(|of| State::of(&self.pair, of));
                self.covered.extend(states.map(|state| (fault.kind, state)));
            }
            self.act(act);
        }
        self.pair.run_until(begin + span);
        self.mend();
    }

    /// Runs until master and standby have driven for a while, and at most for the time within which
    /// a system must drive. `whole`: for all of that time.
    pub(super) fn heal(&mut self, whole: bool) {
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

    fn mend(&mut self) {
        self.act(Act::Poison(false));
        self.act(Act::VehicleSilent(false));
        for system in SystemId::ALL {
            let lines = [Line::Start, Line::Heartbeat1, Line::Heartbeat2].map(Wire::Line);
            for wire in lines
                .into_iter()
                .chain([Wire::Level, Wire::Link, Wire::Can])
            {
                self.act(Act::Cut(wire, system, false));
            }
            for act in [
                Act::LevelLow(system, false),
                Act::LostOut(system, 0),
                Act::LostIn(system, 0),
                Act::Late(system, 0),
                Act::Rest(system, 0),
                Act::Freeze(system, 0),
                Act::Clock(system, 0),
                Act::WrongResults(system, false),
                Act::FlashHangs(system, false),
                Act::Power(system, true),
            ] {
                self.act(act);
            }
        }
    }

    fn act(&mut self, act: Act) {
        let pair = &mut self.pair;
        match act {
            Act::Cut(wire, from, true) => pair.cut(wire, from),
            Act::Cut(wire, from, false) => pair.mend(wire, from),
            Act::LevelLow(of, held) => pair.hold_level_low(of, held),
            Act::Edge(to, line, edge) => pair.stray_edge(to, line, edge),
            Act::LostOut(..) | Act::LostIn(..) | Act::Late(..) => {
                if let Some((of, fault)) = self.bus.follow(act) {
                    pair.disturb_bus(of, fault);
                }
            }
            Act::Power(of, true) => pair.power_on(of),
            Act::Power(of, false) => pair.power_off(of),
            Act::Reset(of, cause) => pair.reset(of, cause),
            Act::Freeze(of, ms) => pair.freeze(of, Duration::from_ms(ms.into())),
            // Longer than any sequence: until the act that ends it.
            Act::FreezeCore(of, core, true) => {
                pair.freeze_core(of, core, Duration::from_ms(3_600_000));
            }
            Act::FreezeCore(of, core, false) => pair.freeze_core(of, core, Duration::ZERO),
            Act::Kill(of, core) => pair.kill_core(of, core),
            Act::Rest(of, ms) => {
                pair.rest_core(of, CoreId::CONTROL, Duration::from_ms(ms.into()));
            }
            Act::Clock(of, permille) => {
                let drift_ppb = i32::from(permille) * 1_000_000 + self.time.drift_ppb(of);
                pair.set_clock_rate(of, drift_ppb);
            }
            Act::ClockJumps(of, by_ms) => pair.jump_clock(of, by_ms.into()),
            Act::WrongResults(of, on) => pair.tamper(of, on.then_some(another_command)),
            Act::Scribble(of) => pair.scribble(of, 0x5EED),
            Act::FlashHangs(of, hangs) => pair.hang_flash(of, hangs),
            Act::FlashLost(of) => pair.edit_flash(of, |bytes| bytes.fill(0x5A)),
            Act::Poison(on) => self.vehicle.borrow_mut().poison = on,
            Act::VehicleSilent(on) => self.vehicle.borrow_mut().silent = on,
            Act::FreezeSupply(..) | Act::FreezeVehicle(_) | Act::FreezeLauncher(_) => {
                unreachable!("Kind::is_for_simulator refused it")
            }
        }
    }

    /// Every frame so far, if the cores' events are kept.
    #[must_use]
    pub fn frames(&self) -> Vec<LoggedFrame> {
        self.vehicle.borrow().frames()
    }

    fn trace(&mut self) -> &[Traced] {
        self.traced.extend(self.pair.take_trace().0);
        &self.traced
    }

    /// The recording so far, as of a run; its world does not move.
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
            let told = match kind {
                SystemEventKind::Started(_) => SupplyEvent::CoreStarted { core, generation },
                SystemEventKind::Reset(cause) => SupplyEvent::Reset(cause),
                SystemEventKind::Suspended => SupplyEvent::Suspended,
                SystemEventKind::CoreDied(core) => SupplyEvent::CoreDied { core, signal: 0 },
                _ => continue,
            };
            log.push(Entry::Supply(at, system, told));
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

    /// What happened so far, a line each: what the cores told, and what the supplies did.
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
            let told = format!(
                "vehicle at {speed:.1} m/s after {:.1} m, at least {:.2} s behind the next one; \
                 {} collisions, {:.2} m beside its lanes",
                drive.distance_m, vehicle.headway_s, drive.collisions, drive.excursion_max_m,
            );
            lines.push((self.pair.now(), told));
        }
        lines.sort_by_key(|(at, _)| *at);
        let line =
            |(at, text): (Instant, String)| format!("{:9.2} ms {text}", at.as_ns() as f64 * 1e-6);
        lines.into_iter().map(line).collect()
    }
}
