//! Both systems and a vehicle in virtual time, and faults that are done to them.

use super::fault::{Act, Fault, Kind};
use crate::timed;
use crate::timing::Time;
use std::cell::RefCell;
use std::rc::Rc;
use tandem_board::{
    Board, Can, CanFrame, CanId, CoreId, Duration, Generation, Instant, Line, RoleLamp,
    SupplyEvent, SystemId, Traced, VehicleBus,
};
use tandem_board_sim::{
    BusFault, Clock, Config as BoardConfig, Poller, Power, SimBoard, SimPair, SystemEvent,
    SystemEventKind, Wire, WorldTick,
};
use tandem_bus::{EgoMotion, Message, Transmitter};
use tandem_cores::core0::Core0;
use tandem_cores::layout::ControllerMap;
use tandem_cores::trace::Event;
use tandem_cores::{Config, Core};
use tandem_record::log::VehicleRecord;
use tandem_record::{Entry, RunLog};
use tandem_vehicle::LoggedFrame;
use tandem_vehicle::gate::{Acceptance, Gate, Verdict};

/// Ends core 1 of each system that hears it. No frame of the DBC.
const POISON: CanId = CanId::Standard(0x7E0);

/// What is outside the systems: the gate, and the frames that they need to hear.
#[derive(Default)]
pub struct Vehicle {
    gate: Gate,
    transmitter: Option<Transmitter>,
    /// Control frames that acted.
    pub accepted: Vec<Acceptance>,
    /// Control frames of an old term.
    pub fenced: Vec<Acceptance>,
    ticks: u64,
    /// When the frame arrived of which the last echo told, ns.
    echoed: Option<u64>,
    silent: bool,
    poison: bool,
    /// Every frame on the bus, if the cores' events are kept.
    frames: Option<Vec<LoggedFrame>>,
}

impl Vehicle {
    fn tick(&mut self, tick: &mut WorldTick) {
        for on_bus in &tick.heard {
            self.keep(on_bus.at, on_bus.frame, None);
            let CanId::Standard(id) = on_bus.frame.id() else {
                continue;
            };
            let at_ns = on_bus.at.as_ns();
            let judged = self.gate.on_frame(at_ns, id.into(), on_bus.frame.data());
            if let Some(judged) = judged {
                let last = self.frames.as_mut().and_then(|frames| frames.last_mut());
                if let Some(last) = last {
                    last.verdict = Some(judged.acceptance.verdict);
                }
                match judged.acceptance.verdict {
                    Verdict::Accepted => self.accepted.push(judged.acceptance),
                    Verdict::Fenced => self.fenced.push(judged.acceptance),
                    _ => {}
                }
            }
        }
        let at_ns = tick.at.as_ns();
        if !self.silent {
            let motion = EgoMotion {
                speed: 20.0,
                ..EgoMotion::default()
            };
            let cycle = self.ticks.is_multiple_of(10);
            let accepted = self.gate.accepted().map(|last| last.at_ns);
            let news = core::mem::replace(&mut self.echoed, accepted) != accepted;
            let echo = cycle || news || self.gate.is_overdue(at_ns);
            let messages = [
                echo.then(|| Message::GateEcho(self.gate.echo(at_ns))),
                cycle.then_some(Message::EgoMotion(motion)),
            ];
            let transmitter = self.transmitter.get_or_insert_with(Transmitter::new);
            for message in messages.into_iter().flatten() {
                let frame = transmitter.encode(&message);
                tick.broadcast(&frame_of(CanId::Standard(frame.id), frame.data()));
            }
        }
        if self.ticks.is_multiple_of(100) && self.poison {
            tick.broadcast(&frame_of(POISON, &[0; 8]));
        }
        self.ticks += 1;
    }
}

impl Vehicle {
    fn keep(&mut self, at: Instant, frame: CanFrame, verdict: Option<Verdict>) {
        let sent = at;
        let logged = LoggedFrame {
            at,
            sent,
            frame,
            verdict,
        };
        if let Some(frames) = &mut self.frames {
            frames.push(logged);
        }
    }
}

fn frame_of(id: CanId, data: &[u8]) -> CanFrame {
    CanFrame::new(id, true, data).expect("a frame of at most 64 bytes")
}

/// A control frame as it is, but for the steering angle. No receiver can tell.
fn another_command(frame: &CanFrame) -> CanFrame {
    let CanId::Standard(id) = frame.id() else {
        return *frame;
    };
    let Ok(Message::Control {
        system,
        mut control,
    }) = Message::decode(id.into(), frame.data())
    else {
        return *frame;
    };
    // Plausible for the gate: it does not jump.
    control.steering_angle += 0.001;
    let encoded = Transmitter::new().encode(&Message::Control { system, control });
    let mut data = encoded.data().to_vec();
    tandem_bus::e2e::protect(id, frame.data()[2], &mut data);
    frame_of(frame.id(), &data)
}

/// The core of this board: core 0 is the real one; the others count cycles, and core 1 dies of
/// poison.
fn poller(board: &SimBoard, config: Config, time: Time) -> Poller {
    // A reset ends the core but not this process: a few boards are leaked.
    let board: &'static SimBoard = Box::leak(Box::new(board.clone()));
    let core = board.identity().core;
    if core == CoreId::CONTROL && time != Time::Ideal {
        return timed::core_0(board, config, time);
    }
    if core == CoreId::CONTROL {
        let mut core = Core0::new(board, config);
        return Box::new(move |_| core.poll());
    }
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
    /// What its faults hit: a kind, by its label, and the state of the system.
    pub(super) covered: Vec<(Kind, State)>,
    /// The trace records that were read.
    traced: Vec<Traced>,
    bus: [BusFault; 2],
    /// When the run began.
    pub(super) born: Instant,
}

impl Bench {
    /// Limits of the campaign: those of `redundancy`, with short waits at the start.
    #[must_use]
    pub fn config(redundancy: tandem_redundancy::Config) -> Config {
        Config {
            redundancy: tandem_redundancy::Config {
                start_limit: Duration::from_ms(300),
                ..redundancy
            },
            // There are no sensors to wait for.
            boot_limit: Duration::from_ms(60),
            ..Config::rt()
        }
    }

    /// Two systems without power. `seed`: of what the machine draws. `told`: whether the cores'
    /// events are kept.
    #[must_use]
    pub fn new(config: Config, seed: u64, told: bool) -> Self {
        Self::timed(config, Time::Ideal, seed, told)
    }

    /// As [`Bench::new`]; `time`: how long things take.
    #[must_use]
    pub fn timed(config: Config, time: Time, seed: u64, told: bool) -> Self {
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
        let mut pair = SimPair::new(board_config, move |board| poller(board, config, time));
        let born = pair.now();
        let vehicle = Vehicle {
            frames: told.then(Vec::new),
            ..Vehicle::default()
        };
        let vehicle = Rc::new(RefCell::new(vehicle));
        let shared = Rc::clone(&vehicle);
        pair.set_world(move |tick| shared.borrow_mut().tick(tick));
        Self {
            pair,
            vehicle,
            config,
            time,
            bus: [BusFault::default(); 2],
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
        Self::timed_dual(config, Time::Ideal, seed, told)
    }

    /// As [`Bench::dual`]; `time`: how long things take.
    ///
    /// # Panics
    /// If they do not begin.
    #[must_use]
    pub fn timed_dual(config: Config, time: Time, seed: u64, told: bool) -> Self {
        let mut bench = Self::timed(config, time, seed, told);
        SystemId::ALL
            .into_iter()
            .for_each(|system| bench.pair.power_on(system));
        bench.pair.run_for(Duration::from_ms(300));
        let roles = SystemId::ALL.map(|system| bench.pair.lamp(system));
        let dual = [RoleLamp::Master, RoleLamp::Standby].map(Some);
        assert_eq!(roles, dual, "no dual operation");
        bench
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
            Act::LostOut(of, permille) => self.disturb(of, |bus| bus.lost_out = permille),
            Act::LostIn(of, permille) => self.disturb(of, |bus| bus.lost_in = permille),
            Act::Late(of, ms) => self.disturb(of, |bus| bus.late = Duration::from_ms(ms.into())),
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

    fn disturb(&mut self, of: SystemId, change: impl FnOnce(&mut BusFault)) {
        let fault = &mut self.bus[of.index()];
        change(fault);
        self.pair.disturb_bus(of, *fault);
    }

    /// Every frame so far, if the cores' events are kept.
    #[must_use]
    pub fn frames(&self) -> Vec<LoggedFrame> {
        self.vehicle.borrow().frames.clone().unwrap_or_default()
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
            let tells = Event::decode(traced.record).filter(|event| {
                !matches!(
                    event,
                    Event::ControlCycle { .. } | Event::TaskIn { .. } | Event::TaskOut { .. }
                )
            });
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
        lines.sort_by_key(|(at, _)| *at);
        let line =
            |(at, text): (Instant, String)| format!("{:9.2} ms {text}", at.as_ns() as f64 * 1e-6);
        lines.into_iter().map(line).collect()
    }
}
