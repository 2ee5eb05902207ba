//! The state that the tasks of core 0 share: the redundancy and all that goes over the bus.
//!
//! A task holds it for microseconds; nothing here computes a command.

use super::agreement::{self, Agreement, Deviation, Stage};
use super::drive::Output;
use super::follow::{Follow, GRID_STEP};
use super::hand_over::{CHUNKS_PER_CYCLE, Giver, MAX_WORDS, Taker};
use super::limits::{CAN_FRAMES, Floods, LINK_DATAGRAMS};
use super::peer_link::{Opinion, PeerLink};
use super::read_back::ReadBack;
use super::{CONTROL_PERIOD, Drive, TaskId, TaskSet, frames, state_flash};
use crate::driving::function::Driver;
use crate::driving::knowledge::Knowledge;
use crate::driving::perception::ego_of;
use crate::driving::types::{Command, ControlStep, Ego};
use crate::schedule::{Grid, Release, TickGrid};
use crate::trace::Event;
use crate::{Config, Heard, read_can};
use heapless::Deque;
use tandem_board::{
    Board, Can, Duration, Instant, Lines, Link, OutputDiagnosis, ResetRequest, Supply, SystemId,
};
use tandem_bus::{FrameTransmitter, Message};
use tandem_redundancy::{
    Action, Actions, ControlHeader, FailureMode, Input, LineSnapshot, LinkReport, Loaded, Mode,
    Phase, Redundancy, StateStore, Term,
};
use tandem_shm::newest::Writer;

/// A state that is not in flash after this time will not be: erasing a sector and programming a
/// record take less.
const FLASH_HANGS: Duration = Duration::from_ms(100);
/// The other system's command holds for this long: five control cycles.
const OTHER_MAX_AGE: Duration = Duration::from_ms(50);
/// While the start protocol waits for cores 1 and 2, core 0 looks this often.
const BOOT_POLL: Duration = Duration::from_ms(1);
/// A vehicle that is slower stands still, m/s: the noise of the measured speed stays below.
const STANDSTILL: f32 = 0.1;
/// For this many control cycles of its redundancy, 300 ms, a system asks what the other knows.
const YOUNG_CONTROL_CYCLES: u32 = 30;
/// Motions of the chassis that come between two control cycles: three, and as many again.
const MOTIONS: usize = 6;

/// What has come over CAN for the function that drives, since it ran last.
#[derive(Default)]
pub(super) struct Inbox {
    motions: Deque<(Instant, Ego), MOTIONS>,
    /// What the vehicle obeys, unless this system drives.
    obeyed: Option<Command>,
    driver: Option<Driver>,
}

impl Inbox {
    fn on_ego(&mut self, at: Instant, ego: Ego) {
        if self.motions.is_full() {
            let _oldest = self.motions.pop_front();
        }
        let _ = self.motions.push_back((at, ego));
    }

    /// Tells the drive, in the order in which it came.
    pub(super) fn empty_into(self, drive: &mut Drive) {
        for (at, ego) in &self.motions {
            drive.on_ego(*at, *ego);
        }
        if let Some(command) = self.obeyed {
            drive.on_obeyed(command);
        }
        if let Some(driver) = self.driver {
            drive.on_driver(driver);
        }
    }
}

/// The redundancy with its ends to the world, and what tasks tell each other.
pub struct Shared<'b, B: Board> {
    pub(super) board: &'b B,
    pub(super) config: Config,
    pub(super) system: SystemId,
    started: Instant,
    receiver: tandem_bus::FrameReceiver,
    pub(super) transmitter: FrameTransmitter,
    /// Valid frames received on CAN from third parties; wraps around.
    can_frames: u32,
    floods: Floods,
    store: StateStore,
    loaded: Loaded,
    /// `None` until cores 1 and 2 carry the drive.
    pub(super) redundancy: Option<Redundancy>,
    pub(super) redundancy_due: Instant,
    /// When the redundancy first asked for a reset.
    reset_asked: Option<Instant>,
    shown: Option<(Phase, Mode, u32)>,
    ticks: TickGrid,
    /// Releases of the control task.
    pub(super) control: Grid,
    /// When that grid moves.
    follow: Follow,
    /// A control cycle that the degraded task is to do.
    pub(super) handed_over: Option<Release>,
    pub(super) inbox: Inbox,
    /// The other system's command since the last control cycle, and the function that gave it.
    pub(super) heard: Option<(Command, tandem_bus::ModeCode)>,
    /// The last of these, and when it was compared.
    other: Option<(Instant, Command)>,
    pub(super) agreement: Agreement,
    pub(super) peer_link: PeerLink,
    giver: Giver,
    taker: Taker,
    /// Control cycles of the redundancy in which this system has asked what the other knows.
    asks: u32,
    /// Where cores 1 and 2 find what was told; `None` until the LMU is there.
    pub(super) told: Option<Writer<'b, Knowledge>>,
    pub(super) read_back: ReadBack,
    /// This system's command was found wrong: it sends none any more.
    pub(super) wrong_command: bool,
    /// Where core 2 finds what to compute again; `None` until the LMU is there.
    pub(super) steps: Option<Writer<'b, ControlStep>>,
    /// What this system would have commanded in its last control cycle.
    pub(super) last_output: Option<Output>,
    /// Cores 1 and 2 have both passed through a cycle.
    pub(super) all_seen: bool,
    ego_seen: bool,
    /// The vehicle does not move.
    stands: bool,
    /// The latest scene has lanes.
    pub(super) lanes_seen: bool,
    pub(super) deadline_misses: u32,
    /// Polls of the roles that did not run since the last status frame.
    pub(super) missed_polls: u32,
    /// Control cycles that have ended; wraps around.
    pub(super) control_cycles: u32,
    pub(super) tracks: u8,
}

impl<'b, B: Board> Shared<'b, B> {
    /// Starts the core's incarnation: reads the state from the data flash (bounded time).
    pub(super) fn new(board: &'b B, config: Config) -> Self {
        let started = board.now();
        let identity = board.identity();
        let cause = board.supply().reset_cause();
        let (store, loaded) = state_flash::load(board.flash());
        let generation = identity.generation.0;
        board.trace(
            Event::Started {
                generation,
                cause: cause as u8,
            }
            .encode(),
        );
        Self {
            board,
            config,
            system: identity.system,
            started,
            receiver: tandem_bus::FrameReceiver::new(),
            transmitter: FrameTransmitter::new(),
            can_frames: 0,
            floods: Floods::new(started),
            store,
            loaded,
            redundancy: None,
            redundancy_due: started,
            reset_asked: None,
            shown: None,
            ticks: TickGrid::EXACT,
            control: Grid::new(started, CONTROL_PERIOD),
            follow: Follow::default(),
            handed_over: None,
            inbox: Inbox::default(),
            heard: None,
            other: None,
            agreement: Agreement::new(),
            peer_link: PeerLink::new(),
            giver: Giver::new(),
            // The generation alone begins anew when the power returns.
            taker: Taker::new((started.as_ns() / 1_000) as u32 ^ generation << 24),
            asks: 0,
            told: None,
            read_back: ReadBack::new(),
            wrong_command: false,
            steps: None,
            last_output: None,
            all_seen: false,
            ego_seen: false,
            stands: false,
            lanes_seen: false,
            deadline_misses: 0,
            missed_polls: 0,
            control_cycles: 0,
            tracks: 0,
        }
    }

    /// Releases happen at ticks from now on: those of an RTOS, whose waits end there.
    pub fn set_ticks(&mut self, ticks: TickGrid) {
        self.ticks = ticks;
        self.control.restart(ticks.floor(self.board.now()));
    }

    /// A trajectory has come in. It shall not wait long for the control task: while it does, the
    /// grid moves earlier, a tick at a time.
    pub(super) fn on_trajectory(&mut self) {
        let wait = self.control.next().since(self.board.now());
        self.follow.on_trajectory(wait);
    }

    /// The release of the control task that is due at `now`.
    pub(super) fn release_control(&mut self, now: Instant) -> Option<Release> {
        let release = self.control.release(now)?;
        if self.follow.moves() {
            self.control.advance(GRID_STEP);
        }
        Some(release)
    }

    /// The phase of this system, once the start protocol has begun.
    pub(super) fn phase(&self) -> Option<Phase> {
        self.redundancy.as_ref().map(Redundancy::phase)
    }

    /// Fetches what has arrived over CAN and the link, up to the limits, and tells the redundancy.
    pub(super) fn read_bus(&mut self) -> TaskSet {
        let mut released = TaskSet::NONE;
        let mut left = CAN_FRAMES;
        while let Some((at, heard)) = read_can(self.board, &mut self.receiver, &mut left) {
            released |= match heard {
                Heard::Valid(message) => {
                    let of_systems =
                        matches!(message, Message::Control { .. } | Message::Status { .. });
                    self.can_frames = self.can_frames.wrapping_add(u32::from(!of_systems));
                    self.hear(at, message)
                }
                Heard::WrongCounter(message) => self.hear_stale(message),
                Heard::Download(system) => self.on_host(system),
            };
        }
        if left == 0 {
            self.floods.can(self.board.can().overruns());
        }
        if let Some(report) = self.newest_report() {
            released |= self.tell(Input::LinkReport(report));
        }
        released
    }

    /// The newest report that has arrived over the link. Datagrams that are none do not hide it.
    fn newest_report(&mut self) -> Option<LinkReport> {
        let mut newest = None;
        let mut words = [0; MAX_WORDS];
        for _ in 0..LINK_DATAGRAMS {
            let Some(length) = self.board.link().try_receive(&mut words) else {
                return newest;
            };
            let words = words.get(..length).unwrap_or_default();
            if let Some(report) = LinkReport::from_words(words) {
                newest = Some(report);
            } else if let Some(opinion) = self.peer_link.on_datagram(words) {
                self.hear_opinion(opinion);
            } else {
                self.hear_knowledge(words);
            }
        }
        self.floods.link();
        newest
    }

    /// What the system knows that drives. That of an earlier term is refused, and so is any while
    /// this system drives.
    fn hear_knowledge(&mut self, words: &[u32]) {
        let now = self.board.now();
        if self.phase().is_some_and(Phase::is_driving) {
            self.giver.on_datagram(now, words);
            return;
        }
        let Some((term, told)) = self.taker.on_datagram(now, words) else {
            return;
        };
        let term = Term::from_bits(term);
        let known = self.redundancy.as_ref().map(Redundancy::highest_term);
        if term.system() == self.system || known.is_some_and(|known| term < known) {
            return;
        }
        if let Some(cells) = &mut self.told {
            cells.publish(&told);
        }
    }

    /// Whether this system is to tell the other one what it knows.
    pub(super) fn wants_to_tell(&self) -> bool {
        self.phase().is_some_and(Phase::is_driving) && self.giver.wants(self.board.now())
    }

    /// Each control cycle: asks while this system is young, and tells if it was asked. Bounded.
    pub(super) fn hand_over(&mut self, knowledge: Option<&Knowledge>) {
        let Some(redundancy) = self
            .redundancy
            .as_ref()
            .filter(|it| it.phase().is_driving())
        else {
            // Before the redundancy starts, cores 1 and 2 may be long in coming.
            if self.asks < YOUNG_CONTROL_CYCLES {
                self.asks += u32::from(self.redundancy.is_some());
                let _full = self.board.link().try_send(&self.taker.ask());
            }
            return;
        };
        if let Some(knowledge) = knowledge {
            let term = redundancy.term().bits();
            self.giver.begin(self.board.now(), term, knowledge);
        }
        for chunk in core::iter::from_fn(|| self.giver.chunk()).take(CHUNKS_PER_CYCLE) {
            // A lost chunk costs the transfer.
            let _full = self.board.link().try_send(&chunk);
        }
    }

    /// What the other system would command. For the one that drives this is what to compare with.
    fn hear_opinion(&mut self, opinion: Opinion) {
        if self.phase().is_some_and(Phase::is_driving) {
            self.heard = Some((opinion.command, opinion.mode));
        }
        self.hear_stage(opinion.stage);
    }

    fn hear_stage(&mut self, stage: Stage) {
        let change = self.agreement.on_stage_of_peer(stage);
        self.tell_agreement(change);
    }

    fn tell_agreement(&self, change: Option<agreement::Change>) {
        if let Some((stage, percent)) = change {
            let stage = stage as u8;
            self.trace(Event::Agreement { stage, percent });
        }
    }

    /// Compares this system's command with the other's. `output`: of this cycle.
    pub(super) fn compare(&mut self, now: Instant, output: Output) {
        let last = self.last_output.replace(output);
        let heard = self.heard.take();
        self.other = heard.map(|(theirs, _)| (now, theirs)).or(self.other);
        let own = match self.phase() {
            Some(Phase::Standby) => Some((output.opinion, output.mode)),
            // The other's opinion is a cycle old.
            Some(Phase::Master | Phase::DegradedMaster) => {
                last.map(|last| (last.command, last.mode))
            }
            _ => None,
        };
        let deviation = heard
            .zip(own)
            .and_then(|((theirs, their_mode), (own, mode))| {
                let drives = !matches!(mode, Mode::None | Mode::SafeStop);
                let alike = drives && frames::bus_mode(mode) == their_mode;
                alike.then(|| Deviation::of(&own, &theirs, output.speed))
            });
        let phase = self.phase().unwrap_or(Phase::Starting);
        let change = self.agreement.cycle(now, phase, deviation);
        self.tell_agreement(change);
    }

    /// The other system's command, if both disagree without a known cause.
    pub(super) fn other_command(&self, now: Instant) -> Option<Command> {
        let unresolved = self.agreement.stage() == Stage::Unresolved;
        let sound = self.redundancy.as_ref()?.mode() != Mode::SafeStop;
        let (at, command) = self.other?;
        (unresolved && sound && now.since(at) <= OTHER_MAX_AGE).then_some(command)
    }

    /// The mode that the redundancy and the agreement permit; [`Drive`] may do less.
    pub(super) fn mode(&self) -> Option<Mode> {
        let mode = self.redundancy.as_ref()?.mode();
        let stops = mode != Mode::None && self.agreement.stage() == Stage::Unresolved;
        Some(if stops { Mode::SafeStop } else { mode })
    }

    /// The vehicle's speed, m/s, while this system stops it because no reset has cured its command.
    fn stops_at(&self) -> Option<f32> {
        let stops = self
            .redundancy
            .as_ref()
            .is_some_and(Redundancy::stops_for_its_command);
        self.last_output.filter(|_| stops).map(|last| last.speed)
    }

    /// This system's command is wrong. It sends none any more and leaves, and the other drives.
    pub(super) fn on_wrong_command(&mut self, witness: u8) -> TaskSet {
        if core::mem::replace(&mut self.wrong_command, true) {
            return TaskSet::NONE;
        }
        self.trace(Event::WrongCommand { witness });
        self.tell(Input::OwnFault(FailureMode::WrongCommand))
    }

    /// Tells of floods. `held_back`: running count of the interrupts that came too early.
    pub(super) fn tell_floods(&mut self, held_back: u32) {
        self.floods.doorbells(held_back);
        for event in self.floods.told(self.board.now()) {
            self.trace(event);
        }
    }

    /// A frame with a right CRC and a wrong counter: of a control frame the term counts.
    fn hear_stale(&mut self, message: Message) -> TaskSet {
        match message {
            Message::Control {
                system: from,
                control,
            } if usize::from(from) != self.system.index() => frames::heard_control(from, &control)
                .map_or(TaskSet::NONE, |frame| self.tell(Input::StaleFrame(frame))),
            _ => TaskSet::NONE,
        }
    }

    /// A host asks for the bootloader of a system. A system goes only if the vehicle does not need
    /// it: beside a master that drives without a fault, or at standstill. A master hands over
    /// first; the host asks again. T-BOOT-1
    fn on_host(&mut self, of: SystemId) -> TaskSet {
        let Some(redundancy) = self.redundancy.as_ref().filter(|_| of == self.system) else {
            return TaskSet::NONE;
        };
        if self.stands || redundancy.may_leave(self.board.now()) {
            self.board.supply().request_reset(ResetRequest::Download);
            return TaskSet::NONE;
        }
        self.tell(Input::HandOver)
    }

    fn hear(&mut self, at: Instant, message: Message) -> TaskSet {
        match message {
            Message::GateEcho(echo) => {
                let on_the_way = self.board.now().since(at);
                let mut released =
                    self.tell(Input::VehicleTerm(frames::heard_echo(&echo, on_the_way)));
                if echo.term != 0 && !self.phase().is_some_and(Phase::is_driving) {
                    self.inbox.obeyed = Some(Command {
                        steering_angle: echo.steering_angle,
                        acceleration: echo.acceleration,
                    });
                }
                let term = self.redundancy.as_ref().map(|it| it.term().bits());
                let stops_at = self.stops_at();
                if term.is_some_and(|term| self.read_back.on_echo(term, &echo, stops_at)) {
                    released |= self.on_wrong_command(0);
                }
                released
            }
            Message::DriverRequest(request) => {
                self.inbox.driver = Some(frames::driver(&request));
                TaskSet::NONE
            }
            Message::EgoMotion(motion) => {
                self.ego_seen = true;
                self.stands = motion.speed.abs() < STANDSTILL;
                self.inbox.on_ego(at, ego_of(&motion));
                TaskSet::NONE
            }
            Message::Control {
                system: from,
                control,
            } if usize::from(from) != self.system.index() => {
                let Some(frame) = frames::heard_control(from, &control) else {
                    return TaskSet::NONE;
                };
                let released = self.tell(Input::ControlFrame(frame));
                if self.is_of_master(frame) {
                    let command = Command {
                        steering_angle: control.steering_angle,
                        acceleration: control.acceleration,
                    };
                    self.heard = Some((command, control.mode));
                }
                released
            }
            Message::Status {
                system: from,
                status,
            } if usize::from(from) != self.system.index() => {
                self.hear_stage(status.agreement);
                frames::heard_status(&status).map_or(TaskSet::NONE, |report| {
                    self.tell(Input::StatusFrame(report))
                })
            }
            _ => TaskSet::NONE,
        }
    }

    /// Whether this frame of the other system, which was told to the redundancy, is of the one that
    /// drives.
    fn is_of_master(&self, frame: ControlHeader) -> bool {
        self.redundancy.as_ref().is_none_or(|redundancy| {
            !redundancy.phase().is_driving() && frame.term == redundancy.highest_term()
        })
    }

    /// Tells the redundancy what has come, and does what it answers. Each by itself: of a flood,
    /// the last frame counts as much as the first.
    fn tell(&mut self, input: Input) -> TaskSet {
        let now = self.board.now();
        let Some(redundancy) = &mut self.redundancy else {
            return TaskSet::NONE;
        };
        let actions = redundancy.on(now, input);
        self.act(actions)
    }

    /// Begins the start protocol when the chain of cores 1, 2 and 0 runs, or cannot be waited for.
    fn start_redundancy(&mut self) {
        let now = self.board.now();
        let waited = now.since(self.started);
        // The driver asks for automated driving, and there is all that it needs.
        let ready = self.all_seen && self.ego_seen && self.lanes_seen;
        // Without lanes, or without a vehicle at all, there still is a system to run.
        if ready || waited > self.config.boot_limit {
            let cause = self.board.supply().reset_cause();
            let config = self.config.redundancy;
            let redundancy = Redundancy::new(config, self.system, cause, self.loaded, now);
            self.redundancy = Some(redundancy);
            self.redundancy_due = now;
        } else {
            self.redundancy_due = now + BOOT_POLL;
        }
    }

    /// Has the redundancy judge the lines, and does what it answers.
    pub(super) fn poll_redundancy(&mut self) -> TaskSet {
        let lines = self.board.lines();
        let received = |line, edge| lines.received(line, edge);
        let snapshot = LineSnapshot::new(received, lines.peer_powered(), self.can_frames);
        self.floods.lines(self.board.now(), &snapshot);
        let Some(redundancy) = &mut self.redundancy else {
            self.start_redundancy();
            return TaskSet::NONE;
        };
        let actions = redundancy.on(self.board.now(), Input::Poll(snapshot));
        let released = self.act(actions);
        if self.config.redundancy.report_period < CONTROL_PERIOD {
            self.report();
        }
        state_flash::drive(&mut self.store, self.board.flash());
        released
    }

    /// Tells the other system over the link what this one is.
    pub(super) fn report(&mut self) {
        if let Some(redundancy) = &mut self.redundancy {
            let report = redundancy.link_report(self.board.now());
            // A full link means that the other does not fetch: it will miss this report and get
            // the next.
            let _full = self.board.link().try_send(&report.to_words());
        }
    }

    /// The control task does not end its cycles. Without a redundancy there is nothing to tell; the
    /// watchdog resets this system.
    pub(super) fn on_hung_control(&mut self) -> TaskSet {
        self.tell(Input::OwnFault(FailureMode::Deadline))
    }

    /// The driver of the outputs has a fault. `tells`: for the first time.
    pub(super) fn on_output_fault(&mut self, found: OutputDiagnosis, tells: bool) -> TaskSet {
        if tells {
            let found = found as u8;
            self.trace(Event::OutputFault { found });
        }
        self.tell(Input::OwnFault(FailureMode::IoModule))
    }

    /// The CAN controller was bus-off, and has not been error-active since. `again`: it is bus-off
    /// once more. The vehicle hears nothing of this system: the other one learns it at once.
    pub(super) fn on_bus_off(&mut self, again: bool) -> TaskSet {
        let tasks = self.tell(Input::OwnFault(FailureMode::CanBusOff));
        if again {
            self.report();
        }
        tasks
    }

    /// Core 1 or 2 is dead.
    pub(super) fn on_dead_core(&mut self, fault: FailureMode) -> TaskSet {
        let now = self.board.now();
        match &mut self.redundancy {
            Some(redundancy) => {
                let actions = redundancy.on(now, Input::OwnFault(fault));
                self.act(actions)
            }
            None => {
                self.board.supply().request_reset(ResetRequest::CoreDead);
                TaskSet::NONE
            }
        }
    }

    /// Carries out what the redundancy asks for; returns the tasks to run for it.
    #[deny(clippy::wildcard_enum_match_arm, reason = "no action may be forgotten")]
    fn act(&mut self, actions: Actions) -> TaskSet {
        let mut released = TaskSet::NONE;
        let now = self.board.now();
        let mut reset = None;
        for action in actions.iter() {
            match action {
                Action::SendEdge(line, edge) => self.board.lines().send(line, edge),
                Action::DiscardUnsent => self.board.can().discard_unsent(),
                Action::Transmit | Action::AlignControl => {
                    // Both systems begin their control cycle on the sync edge. A takeover does not
                    // wait for the next cycle; it begins a new grid of cycles.
                    self.control.restart(self.ticks.floor(self.board.now()));
                    released |= TaskSet::of(TaskId::Control);
                }
                Action::Persist(state) => self.store.request(state),
                Action::Reset(request) => reset = Some(request),
                Action::Record(event) => self.trace(event.into()),
            }
        }
        self.redundancy_due = actions.deadline();
        state_flash::drive(&mut self.store, self.board.flash());
        if let Some(request) = reset {
            // A flash that hangs must not keep a system that is to be reset.
            let since = *self.reset_asked.get_or_insert(now);
            if self.store.is_settled() || now.since(since) > FLASH_HANGS {
                self.board.supply().request_reset(request);
            }
        }
        self.show();
        released
    }

    /// Shows role and mode, on the outputs and in the trace, when they have changed.
    fn show(&mut self) {
        let Some(redundancy) = &self.redundancy else {
            return;
        };
        let term = redundancy.highest_term().bits();
        let (phase, mode) = (redundancy.phase(), redundancy.mode());
        if self.shown == Some((phase, mode, term)) {
            return;
        }
        self.shown = Some((phase, mode, term));
        self.board.supply().show_role(phase.lamp());
        self.trace(Event::Role {
            role: phase.role() as u8,
            mode: mode as u8,
            term,
        });
    }

    pub(super) fn trace(&self, event: Event) {
        self.board.trace(event.encode());
    }
}
