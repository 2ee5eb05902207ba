//! Two machines, their lines, a CAN bus and a vehicle that fences: small, deterministic, in 0.1 ms
//! steps.

use std::collections::VecDeque;
use tandem_board::{Duration, Edge, Instant, Line, ResetCause, ResetRequest, SystemId};
use tandem_redundancy::{
    Action, Actions, Config, ControlHeader, FailureMode, Input, LineSnapshot, LinkReport, Loaded,
    ObeyedTerm, PeerReport, Phase, Redundancy, RedundancyEvent, Role, SystemState, Takeover, Term,
};

pub(crate) const STEP_US: u64 = 100;
/// Duration of a program operation of the data flash.
const FLASH_US: u64 = 400;
/// How long a reset and the start of the software take.
pub(crate) const RESET_US: u64 = 5_000;

/// Which connections are cut. Each direction of a line is cut separately: the index is its sender.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Cuts {
    pub(crate) beats: [[bool; 2]; 2],
    pub(crate) start: [bool; 2],
    pub(crate) level: [bool; 2],
    pub(crate) can: [bool; 2],
    /// The CAN transmitter, or receiver, of this system is dead; the other direction works.
    pub(crate) can_send: [bool; 2],
    pub(crate) can_hear: [bool; 2],
    /// The systems do not hear each other on CAN; the vehicle hears both, and both hear it.
    pub(crate) deaf_to_each_other: bool,
    pub(crate) link: bool,
}

#[derive(Clone, Copy, Debug)]
enum Frame {
    Control(ControlHeader),
    Status(PeerReport),
    Vehicle,
    VehicleTerm(ObeyedTerm),
}

/// A control frame as the vehicle saw it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Seen {
    pub(crate) at_us: u64,
    pub(crate) system: SystemId,
    pub(crate) term: Term,
}

#[derive(Clone, Debug)]
pub(crate) struct System {
    pub(crate) machine: Option<Redundancy>,
    pub(crate) powered: bool,
    /// Its supply holds it in reset for good.
    pub(crate) held: bool,
    /// The time and the cause of its next start.
    boot: Option<(u64, ResetCause)>,
    pub(crate) frozen_until: u64,
    thawed: bool,
    /// The state in flash; `None` if the flash was never written.
    pub(crate) flash: Option<SystemState>,
    pub(crate) flash_lost: bool,
    writing: Option<(u64, SystemState)>,
    edges: [[u32; 2]; Line::ALL.len()],
    can_frames: u32,
    inbox: VecDeque<Frame>,
    link_inbox: VecDeque<LinkReport>,
    /// Words that it hears at its next poll although no system has sent them.
    pub(crate) forged: Vec<Input>,
    /// Origin of its clock.
    origin_us: u64,
    next_poll: u64,
    next_control: u64,
    next_status: u64,
    peer_level: bool,
    interrupt: bool,
    pub(crate) faults: Vec<FailureMode>,
    /// A fault that lasts until the next reset.
    pub(crate) until_reset: Option<FailureMode>,
    /// How many of a thousand frames do not reach this system.
    pub(crate) misses_permille: u64,
    /// Program operations of its data flash so far.
    pub(crate) programs: u32,
}

#[derive(Clone, Debug)]
pub(crate) struct Pair {
    pub(crate) config: Config,
    pub(crate) now_us: u64,
    pub(crate) cuts: Cuts,
    /// The other system reads this one's power level as low, contrary to the contract of the line.
    pub(crate) level_stuck_low: [bool; 2],
    pub(crate) systems: [System; 2],
    bus: VecDeque<(u64, Option<SystemId>, Frame)>,
    next_vehicle: u64,
    /// When the vehicle sends its next echo: within a millisecond of each frame that it accepts,
    /// and every 10 ms otherwise.
    next_echo: u64,
    /// The vehicle sends nothing, but still obeys.
    pub(crate) vehicle_pauses: bool,
    random: u64,
    pub(crate) accepted: Vec<Seen>,
    pub(crate) fenced: Vec<Seen>,
    /// The last term that the vehicle could not explain, and its frames since one was accepted.
    far: (Term, u8),
    pub(crate) events: Vec<(u64, SystemId, RedundancyEvent)>,
    pub(crate) synchronised: Vec<(u64, SystemId)>,
    /// For how long both outputs have been open while both systems are connected to the bus: now,
    /// and at most so far.
    both_open_us: u64,
    pub(crate) both_open_max_us: u64,
}

impl Pair {
    /// Returns both systems without power, each with its factory state in flash.
    pub(crate) fn new(config: Config, seed: u64) -> Self {
        let system = |id: SystemId| System {
            machine: None,
            powered: false,
            held: false,
            boot: None,
            frozen_until: 0,
            thawed: false,
            flash: Some(SystemState::factory(id)),
            flash_lost: false,
            writing: None,
            // Near their wrap-around, so that they wrap around in every run.
            edges: [[u32::MAX - 40; 2]; Line::ALL.len()],
            can_frames: u32::MAX - 3,
            inbox: VecDeque::new(),
            link_inbox: VecDeque::new(),
            forged: Vec::new(),
            origin_us: [1_000_000, 77_000_000_000][id.index()],
            next_poll: 0,
            next_control: 0,
            next_status: 0,
            peer_level: false,
            interrupt: false,
            faults: Vec::new(),
            until_reset: None,
            misses_permille: 0,
            programs: 0,
        };
        Self {
            config,
            now_us: 0,
            cuts: Cuts::default(),
            level_stuck_low: [false; 2],
            systems: SystemId::ALL.map(system),
            bus: VecDeque::new(),
            next_vehicle: 0,
            next_echo: 0,
            vehicle_pauses: false,
            random: seed.wrapping_mul(2).wrapping_add(1),
            accepted: Vec::new(),
            fenced: Vec::new(),
            far: (Term::NONE, 0),
            events: Vec::new(),
            synchronised: Vec::new(),
            both_open_us: 0,
            both_open_max_us: 0,
        }
    }

    /// Returns a pair that has been in dual operation for some time, A driving.
    pub(crate) fn dual(config: Config, seed: u64) -> Self {
        let mut pair = Self::new(config, seed);
        pair.power_on(SystemId::A);
        pair.power_on(SystemId::B);
        pair.run_ms(300);
        assert_eq!(pair.phases(), [Some(Phase::Master), Some(Phase::Standby)]);
        pair
    }

    /// Forgets the past except the last accepted frame, on which the following steps depend.
    pub(crate) fn forget(&mut self) {
        let past = self.accepted.len().saturating_sub(1);
        self.accepted.drain(..past);
        self.fenced.clear();
        self.events.clear();
        self.synchronised.clear();
        self.both_open_max_us = 0;
    }

    fn random(&mut self, below: u64) -> u64 {
        self.random ^= self.random << 13;
        self.random ^= self.random >> 7;
        self.random ^= self.random << 17;
        self.random % below
    }

    pub(crate) fn power_on(&mut self, id: SystemId) {
        let system = &mut self.systems[id.index()];
        if !system.powered {
            system.powered = true;
            system.boot = Some((self.now_us + RESET_US, ResetCause::PowerOn));
        }
    }

    pub(crate) fn power_off(&mut self, id: SystemId) {
        let system = &mut self.systems[id.index()];
        system.powered = false;
        system.held = false;
        system.machine = None;
        system.boot = None;
        system.frozen_until = 0;
        system.edges = [[u32::MAX - 40; 2]; Line::ALL.len()];
        system.writing = None;
        system.until_reset = None;
    }

    /// Makes the supply reset the system.
    pub(crate) fn reset(&mut self, id: SystemId, cause: ResetCause) {
        let system = &mut self.systems[id.index()];
        if system.powered && !system.held && system.boot.is_none() {
            system.machine = None;
            system.frozen_until = 0;
            system.writing = None;
            system.until_reset = None;
            system.boot = Some((self.now_us + RESET_US, cause));
        }
    }

    /// Freezes the software; what it has already sent still arrives.
    pub(crate) fn freeze_ms(&mut self, id: SystemId, ms: u64) {
        let system = &mut self.systems[id.index()];
        if system.machine.is_some() {
            system.frozen_until = self.now_us + ms * 1_000;
            system.thawed = true;
        }
    }

    pub(crate) fn run_ms(&mut self, ms: u64) {
        self.run_us(ms * 1_000);
    }

    pub(crate) fn run_us(&mut self, us: u64) {
        for _ in 0..us / STEP_US {
            self.step();
        }
    }

    /// Runs until the condition holds, at most `ms` milliseconds; returns the time it took.
    pub(crate) fn run_until(&mut self, ms: u64, condition: impl Fn(&Self) -> bool) -> u64 {
        let from = self.now_us;
        while !condition(self) {
            assert!(
                self.now_us < from + ms * 1_000,
                "not within {ms} ms: {:?}",
                self.phases()
            );
            self.step();
        }
        self.now_us - from
    }

    pub(crate) fn phase(&self, id: SystemId) -> Option<Phase> {
        self.systems[id.index()]
            .machine
            .as_ref()
            .map(Redundancy::phase)
    }

    pub(crate) fn phases(&self) -> [Option<Phase>; 2] {
        SystemId::ALL.map(|id| self.phase(id))
    }

    pub(crate) fn state(&self, id: SystemId) -> SystemState {
        *self.systems[id.index()].machine.as_ref().unwrap().state()
    }

    /// Returns the takeovers since `from_us`.
    pub(crate) fn takeovers(&self, from_us: u64) -> Vec<(u64, SystemId, Takeover)> {
        let takeover = |&(at, id, event)| match event {
            RedundancyEvent::Takeover(takeover) if at >= from_us => Some((at, id, takeover)),
            _ => None,
        };
        self.events.iter().filter_map(takeover).collect()
    }

    /// Returns the longest time without an accepted control frame from `from_us` until now.
    pub(crate) fn longest_gap_us(&self, from_us: u64) -> u64 {
        let before = self
            .accepted
            .iter()
            .rev()
            .find(|seen| seen.at_us <= from_us);
        let mut last = before.map_or(from_us, |seen| seen.at_us);
        let mut longest = 0;
        for seen in self.accepted.iter().filter(|seen| seen.at_us > from_us) {
            longest = longest.max(seen.at_us - last);
            last = seen.at_us;
        }
        longest.max(self.now_us - last)
    }

    /// Returns how often the system that drives changed.
    pub(crate) fn changes_of_driver(&self) -> usize {
        self.accepted
            .windows(2)
            .filter(|pair| pair[0].system != pair[1].system)
            .count()
    }

    fn step(&mut self) {
        self.now_us += STEP_US;
        self.deliver();
        if self.now_us >= self.next_vehicle {
            self.next_vehicle += 10_000;
            if !self.vehicle_pauses {
                self.send(None, Frame::Vehicle);
            }
        }
        if self.now_us >= self.next_echo {
            let age = self.accepted.last().map(|last| self.now_us - last.at_us);
            self.next_echo = self.now_us
                + match age {
                    Some(age @ ..11_000) => (11_000 - age).next_multiple_of(1_000),
                    Some(11_000..100_000) => 1_000,
                    _ => 10_000,
                };
            if !self.vehicle_pauses {
                let obeyed = self.obeyed_term();
                self.send(None, Frame::VehicleTerm(obeyed));
            }
        }
        for id in SystemId::ALL {
            self.power_step(id);
        }
        for id in SystemId::ALL {
            let now = self.now_us;
            let system = &self.systems[id.index()];
            if system.machine.is_some() && now >= system.frozen_until {
                self.system_step(id);
            }
        }
        let open = |system: &System| {
            system
                .machine
                .as_ref()
                .is_some_and(|machine| machine.phase().is_driving())
                && self.now_us >= system.frozen_until
        };
        let both = self.systems.iter().all(open) && self.cuts.can == [false; 2];
        self.both_open_us = if both { self.both_open_us + STEP_US } else { 0 };
        self.both_open_max_us = self.both_open_max_us.max(self.both_open_us);
    }

    fn level(&self, of: SystemId) -> bool {
        let system = &self.systems[of.index()];
        let high = system.powered && !system.held && system.boot.is_none();
        (high || self.cuts.level[of.index()]) && !self.level_stuck_low[of.index()]
    }

    /// Returns what the vehicle reports every control period.
    fn obeyed_term(&self) -> ObeyedTerm {
        let last = self.accepted.last();
        ObeyedTerm {
            term: last.map_or(Term::NONE, |last| last.term),
            age: Duration::from_us(last.map_or(0, |last| self.now_us - last.at_us)),
            sent: Some(((self.now_us / 1_000) as u8, Duration::ZERO)),
        }
    }

    fn power_step(&mut self, id: SystemId) {
        let now = self.now_us;
        let level = self.level(id.peer());
        let (config, jitter) = (self.config, self.random(10) * 1_000);
        let system = &mut self.systems[id.index()];
        if level != system.peer_level {
            system.peer_level = level;
            system.interrupt = true;
        }
        if let Some((at, state)) = system.writing
            && now >= at
        {
            system.flash = Some(state);
            system.writing = None;
        }
        let Some((_, cause)) = system.boot.filter(|&(at, _)| now >= at) else {
            return;
        };
        let loaded = match system.flash {
            _ if system.flash_lost => Loaded::Lost,
            Some(state) => Loaded::State(state),
            None => Loaded::Blank,
        };
        system.boot = None;
        system.flash_lost = false;
        system.inbox.clear();
        system.link_inbox.clear();
        let at = Instant::from_ns((now + system.origin_us) * 1_000);
        system.machine = Some(Redundancy::new(config, id, cause, loaded, at));
        system.next_poll = now;
        system.next_control = now + jitter;
        system.next_status = now + jitter * 10;
    }

    fn system_step(&mut self, id: SystemId) {
        let now = self.now_us;
        let system = &mut self.systems[id.index()];
        if system.thawed {
            // The worst case: it was frozen just before a transmission.
            system.thawed = false;
            self.control_cycle(id);
        }
        let system = &mut self.systems[id.index()];
        if !system.interrupt && now < system.next_poll {
            return;
        }
        system.interrupt = false;
        let at = Instant::from_ns((now + system.origin_us) * 1_000);
        let mut inputs: Vec<Input> = Vec::new();
        for frame in system.inbox.drain(..) {
            let third_party = matches!(frame, Frame::Vehicle | Frame::VehicleTerm(_));
            system.can_frames = system.can_frames.wrapping_add(third_party.into());
            match frame {
                Frame::Control(control) => inputs.push(Input::ControlFrame(control)),
                Frame::Status(report) => inputs.push(Input::StatusFrame(report)),
                Frame::Vehicle => {}
                Frame::VehicleTerm(term) => inputs.push(Input::VehicleTerm(term)),
            }
        }
        inputs.extend(system.link_inbox.drain(..).map(Input::LinkReport));
        inputs.append(&mut system.forged);
        let faults = system.faults.iter().chain(&system.until_reset);
        inputs.extend(faults.copied().map(Input::OwnFault));
        let edges = system.edges;
        let both = |line: Line| edges[line.index()][0].wrapping_add(edges[line.index()][1]);
        inputs.push(Input::Poll(LineSnapshot {
            handshakes: edges[Line::Start.index()][0],
            syncs: edges[Line::Start.index()][1],
            beats: [both(Line::Heartbeat1), both(Line::Heartbeat2)],
            peer_powered: system.peer_level,
            can_frames: system.can_frames,
        }));
        for input in inputs {
            let Some(machine) = &mut self.systems[id.index()].machine else {
                return;
            };
            let actions = machine.on(at, input);
            self.act(id, &actions);
        }
        let late = self.random(4) * 100;
        let system = &mut self.systems[id.index()];
        let interval = self.config.poll_interval.as_us();
        system.next_poll = now / interval * interval + interval + late;
        if now >= system.next_control {
            self.control_cycle(id);
        }
    }

    #[deny(clippy::wildcard_enum_match_arm)]
    fn act(&mut self, id: SystemId, actions: &Actions) {
        assert!(actions.events().count() < Actions::EVENTS, "{actions:?}");
        let now = self.now_us;
        for action in actions.iter() {
            match action {
                Action::SendEdge(line, edge) => self.edge(id, line, edge),
                Action::Transmit => self.control_cycle(id),
                // The worst case: its frames are already on the bus, and no action can stop them.
                Action::DiscardUnsent => {}
                Action::AlignControl => self.synchronised.push((now, id)),
                Action::Persist(state) => {
                    let system = &mut self.systems[id.index()];
                    system.writing = Some((now + FLASH_US, state));
                    system.programs += 1;
                }
                Action::Reset(request) => self.ask_reset(id, request),
                Action::Record(event) => self.events.push((now, id, event)),
            }
        }
    }

    /// Makes the supply reset the system when its state is in flash.
    fn ask_reset(&mut self, id: SystemId, request: ResetRequest) {
        let system = &mut self.systems[id.index()];
        match request {
            _ if system.writing.is_some() => {}
            ResetRequest::Suspend => {
                system.held = true;
                system.machine = None;
            }
            ResetRequest::CoreDead => self.reset(id, ResetCause::Trap),
            ResetRequest::Software | ResetRequest::Download => {
                self.reset(id, ResetCause::Software);
            }
        }
    }

    /// Delivers an edge to the other system, sent by `from` or caused by a disturbance.
    pub(crate) fn edge(&mut self, from: SystemId, line: Line, edge: Edge) {
        let cut = match line {
            Line::Start => self.cuts.start[from.index()],
            Line::Heartbeat1 => self.cuts.beats[0][from.index()],
            Line::Heartbeat2 => self.cuts.beats[1][from.index()],
            Line::Time => false,
        };
        let to = &mut self.systems[from.peer().index()];
        if to.powered && !cut {
            let count = &mut to.edges[line.index()][edge as usize];
            *count = count.wrapping_add(1);
            to.interrupt |= line == Line::Start;
        }
    }

    /// Runs one control cycle: a control frame if permitted, a report over the link, and a status
    /// frame when it is due.
    fn control_cycle(&mut self, id: SystemId) {
        let now = self.now_us;
        let system = &mut self.systems[id.index()];
        let Some(machine) = &mut system.machine else {
            return;
        };
        system.next_control = now + self.config.control_period.as_us();
        let at = Instant::from_ns((now + system.origin_us) * 1_000);
        let control = machine.may_transmit(at).then(|| ControlHeader {
            system: id,
            term: machine.term(),
            role: machine.role(),
            mode: machine.mode(),
        });
        let link = machine.link_report(at);
        let status = now >= system.next_status;
        if status {
            system.next_status = now + 100_000;
        }
        if let Some(control) = control {
            self.send(Some(id), Frame::Control(control));
        }
        if status {
            self.send(Some(id), Frame::Status(link.report));
        }
        let peer = &mut self.systems[id.peer().index()];
        if !self.cuts.link && peer.powered {
            peer.link_inbox.push_back(link);
        }
    }

    fn send(&mut self, from: Option<SystemId>, frame: Frame) {
        let latency = 200 + self.random(9) * 100;
        // In bus order: a frame never overtakes one that was sent before it.
        let at = (self.now_us + latency).max(self.bus.back().map_or(0, |&(at, ..)| at));
        self.bus.push_back((at, from, frame));
    }

    fn deliver(&mut self) {
        while let Some(&(at, from, frame)) = self.bus.front() {
            if at > self.now_us {
                return;
            }
            self.bus.pop_front();
            let silent =
                |from: SystemId| self.cuts.can[from.index()] || self.cuts.can_send[from.index()];
            if from.is_some_and(silent) {
                continue;
            }
            if let Frame::Control(control) = frame {
                self.vehicle_hears(control);
            }
            for to in SystemId::ALL {
                let misses = self.systems[to.index()].misses_permille;
                let lost = misses > 0 && self.random(1_000) < misses
                    || self.cuts.deaf_to_each_other && from.is_some()
                    || self.cuts.can_hear[to.index()];
                let connected = !self.cuts.can[to.index()] && Some(to) != from && !lost;
                let system = &mut self.systems[to.index()];
                if connected && system.powered && system.boot.is_none() {
                    system.inbox.push_back(frame);
                }
            }
        }
    }

    /// The vehicle fences: it refuses every term below the highest accepted one, and one far above
    /// it until no other term acts and its frames repeat.
    pub(crate) fn vehicle_hears(&mut self, frame: ControlHeader) {
        assert_eq!(frame.role, Role::Master);
        let ControlHeader { system, term, .. } = frame;
        let at_us = self.now_us;
        let seen = Seen {
            at_us,
            system,
            term,
        };
        let last = self.accepted.last();
        // The vehicle explains twice as much as the systems.
        let near = |last: Term| {
            last.above(Term::EXPLAINED, term.system())
                .unwrap_or(Term::LAST)
        };
        let is_far = last.is_some_and(|last| term.is_far_from(near(last.term)));
        if last.is_some_and(|last| term < last.term) {
            self.fenced.push(seen);
            return;
        }
        if is_far {
            let count = if self.far.0 == term { self.far.1 } else { 0 };
            self.far = (term, count.saturating_add(1));
            let is_silent = last.is_none_or(|last| at_us - last.at_us >= 100_000);
            if self.far.1 < 5 || !is_silent || term > Term::LAST_UNEXPLAINED {
                return;
            }
        }
        self.far = (Term::NONE, 0);
        self.accepted.push(seen);
        self.next_echo = self.now_us / 1_000 * 1_000 + 1_000;
    }
}

pub(crate) fn us(span: Duration) -> u64 {
    span.as_us()
}
