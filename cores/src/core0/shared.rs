//! The state that the tasks of core 0 share, one part for each subject.
//!
//! A task holds it for microseconds; no command is computed here. This file handles everything that
//! concerns more than one part: an input from the bus goes to the redundancy, the checks and the
//! drive.

use super::ability::AbilityCheck;
use super::agreement::{Change, Stage};
use super::can_port::CanPort;
use super::command_check::CommandCheck;
use super::control_grid::{ControlGrid, off_millisecond};
use super::datagram::MAX_WORDS;
use super::knowledge_transfer::KnowledgeTransfer;
use super::limits::{CAN_FRAMES, Floods, LINK_DATAGRAMS};
use super::read_back::Verdict;
use super::redundancy_port::{Outcome, RedundancyPort};
use super::scene_check::{SceneCheck, Suspect};
use super::time::TimeShare;
use super::topics::{FollowedSoc, Heard};
use super::{Core0Task, TaskSet, frames};
use crate::driving::perception::ego_of;
use crate::driving::types::Scene;
use crate::release::TickGrid;
use crate::tester_desk::DeskPort;
use crate::trace::Event;
use crate::{Config, ReceivedFrame, read_can};
use tandem_board::{
    Board, Can, CanFrame, CoreId, DeskAction, Instant, Lines, Link, OutputDiagnosis, ResetRequest,
    Supply, SystemId,
};
use tandem_bus::Message;
use tandem_redundancy::{
    ControlHeader, FailureMode, Input, LineSnapshot, LinkReport, Mode, Phase, Redundancy, Term,
};

/// The ticks of an RTOS are moved by no less, ns: a crystal is 0.1 µs off after a tick, and two
/// systems start their cycles within 20 µs.
const TICK_STEP_NS: u64 = 1_000;

/// Counters for the status frame and the supervision of the control task.
#[derive(Default)]
pub(super) struct Counters {
    pub(super) deadline_misses: u32,
    /// Polls of the roles that did not run since the last status frame.
    pub(super) missed_polls: u32,
    /// Control cycles that have ended; wraps around.
    pub(super) control_cycles: u32,
    pub(super) tracks: u8,
}

/// The state that the tasks of core 0 share.
pub struct SharedState<'b, B: Board> {
    pub(super) board: &'b B,
    pub(super) system: SystemId,
    pub(super) redundancy: RedundancyPort<'b, B>,
    pub(super) can: CanPort,
    pub(super) heard: Heard,
    pub(super) followed: FollowedSoc,
    pub(super) check: CommandCheck<'b>,
    pub(super) scene_check: SceneCheck,
    /// Core 2 was found wrong in this incarnation.
    pub(super) is_plan_wrong: bool,
    ability: AbilityCheck,
    pub(super) transfer: KnowledgeTransfer<'b>,
    pub(super) time: TimeShare,
    pub(super) grid: ControlGrid,
    pub(super) counters: Counters,
    floods: Floods,
    /// `None` until the LMU is attached.
    pub(super) desk: Option<DeskPort<'b>>,
}

impl<'b, B: Board> SharedState<'b, B> {
    /// Starts the core's incarnation: reads the state from the data flash (bounded time).
    pub(super) fn new(board: &'b B, config: Config) -> Self {
        let started = board.now();
        let identity = board.identity();
        let generation = identity.generation.0;
        let redundancy = RedundancyPort::new(board, config);
        let cause = board.supply().reset_cause() as u8;
        board.trace(Event::Started { generation, cause }.encode());
        Self {
            board,
            system: identity.system,
            redundancy,
            can: CanPort::new(),
            heard: Heard::default(),
            followed: FollowedSoc::default(),
            check: CommandCheck::new(),
            scene_check: SceneCheck::new(),
            is_plan_wrong: false,
            ability: AbilityCheck::default(),
            transfer: KnowledgeTransfer::new(started, generation),
            time: TimeShare::new(),
            grid: ControlGrid::new(started),
            counters: Counters::default(),
            floods: Floods::new(started),
            desk: None,
        }
    }

    /// Sets the ticks of an RTOS: its waits end at a tick, so releases lie on ticks from now on.
    /// The executor passes the copy of the ticks with which [`Core0Task::Control`] begins.
    pub fn set_ticks(&mut self, ticks: TickGrid) {
        self.grid.set_ticks(ticks, self.board.now());
    }

    /// Returns the phase of this system, once the start protocol has begun.
    pub(super) fn phase(&self) -> Option<Phase> {
        self.redundancy.phase()
    }

    /// Returns the SoC that the other system follows while that one drives; 0 if none.
    pub(super) fn soc_of_master(&self) -> u16 {
        let theirs = self.followed.theirs(self.board.now());
        if self.redundancy.is_driving() {
            0
        } else {
            theirs
        }
    }

    /// Returns the mode that the redundancy and the agreement permit.
    pub(super) fn mode(&self) -> Option<Mode> {
        let mode = self.redundancy.running()?.mode();
        Some(self.check.permits(mode))
    }

    /// Reads what has arrived over CAN and the link, up to the limits, and passes it on.
    pub(super) fn read_bus(&mut self) -> TaskSet {
        let mut released = TaskSet::NONE;
        let mut left = CAN_FRAMES;
        while let Some((at, frame)) = self.next_frame(&mut left) {
            released |= match frame {
                ReceivedFrame::Valid(message) => self.on_message(at, message),
                ReceivedFrame::WrongCounter(message) => self.on_stale_message(at, message),
                ReceivedFrame::ForDesk(frame) => {
                    self.pass_to_desk(&frame);
                    TaskSet::NONE
                }
            };
        }
        if left == 0 {
            self.floods.can(self.board.can().overruns());
        }
        if self.heard.is_waiting() {
            released |= TaskSet::of(Core0Task::Topics);
        }
        if let Some(report) = self.newest_report() {
            released |= self.notify(Input::LinkReport(report));
        }
        if self.time.has_transfer() {
            released |= TaskSet::of(Core0Task::Time);
        }
        released |= self.follow_cycles();
        released | self.serve_desk()
    }

    fn next_frame(&mut self, left: &mut u32) -> Option<(Instant, ReceivedFrame)> {
        let (receiver, heard) = (&mut self.can.receiver, &mut self.heard);
        read_can(self.board, receiver, left, |received| heard.push(received))
    }

    /// Returns the newest report that has arrived over the link, even if other datagrams follow it.
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
            } else if let Some(theirs) = self.check.on_datagram(self.board.now(), words) {
                if let Some(scene) = theirs.scene {
                    self.scene_check.on_peer(scene);
                }
                // A standby takes the master's command from its control frame.
                if self.redundancy.is_driving() {
                    self.check.on_peer_command(theirs.command, theirs.mode);
                }
                self.on_peer_stage(theirs.stage);
                self.followed.on_peer(self.board.now(), theirs.soc);
                self.time.on_peer_cycle(theirs.next_cycle);
            } else if !self.time.on_datagram(self.board.now(), words) {
                let (now, redundancy) = (self.board.now(), self.redundancy.running());
                let transfer = &mut self.transfer;
                transfer.on_datagram(now, words, redundancy, self.system);
            }
        }
        self.floods.link();
        newest
    }

    fn on_message(&mut self, at: Instant, message: Message) -> TaskSet {
        let is_of_system = matches!(
            message,
            Message::Control { .. } | Message::Status { .. } | Message::TimeSync { .. }
        );
        let third_party = &mut self.can.third_party_frames;
        *third_party = third_party.wrapping_add(u32::from(!is_of_system));
        let own = self.system.index();
        match message {
            Message::GateEcho(echo) => {
                self.can.vehicle_clock.on_echo(at, echo.sent_at);
                let on_the_way = self.board.now().since(at);
                let obeyed = frames::received_echo(&echo, on_the_way);
                let mut released = self.notify(Input::VehicleTerm(obeyed));
                if let Some(redundancy) = self.redundancy.running() {
                    match self.check.on_echo(redundancy, &echo) {
                        Verdict::Right => {}
                        Verdict::Wrong => released |= self.on_wrong_command(0),
                        Verdict::EchoWrong => self.trace(Event::WrongEcho),
                    }
                }
                // The vehicle may still obey the system that drove before, and refuse a command
                // that jumps from that.
                let own_term = self.redundancy.running().map(|it| it.term().bits());
                let obeys_other = own_term != Some(echo.term);
                if echo.term != 0 && (obeys_other || !self.redundancy.is_driving()) {
                    let mut obeyed = frames::obeyed(&echo);
                    if let Some(measured) = self.check.read_back.wheel.contradicts_echo() {
                        obeyed.steering_angle = measured;
                    }
                    self.can.on_obeyed(obeyed);
                }
                return released;
            }
            Message::DriverRequest(request) => self.can.on_driver(&request),
            Message::EgoMotion(motion) => {
                self.redundancy.ready.ego_seen = true;
                self.ability.on_motion(at);
                self.can.on_body(&motion);
                let ego = ego_of(&motion);
                self.scene_check.on_ego(at, ego);
                self.check.read_back.wheel.on_measured(ego.steering_angle);
                if !self.scene_check.is_deceived() {
                    self.can.on_ego(at, self.scene_check.corrected(ego));
                }
            }
            Message::CameraLanes(lanes) => self.scene_check.on_lanes(at, &lanes),
            Message::SensorHeader(of, header) => self.scene_check.on_header(at, of, &header),
            Message::SensorObject(of, object) => self.scene_check.on_object(of, &object),
            Message::Control { system, control } if usize::from(system) != own => {
                if let Some(frame) = frames::received_control(system, &control) {
                    let vehicle_ms = self.can.vehicle_clock.at(at);
                    if vehicle_ms.is_some_and(|now_ms| !control.is_fresh(now_ms)) {
                        // The vehicle refuses it as well, so it takes no role from anybody.
                        return TaskSet::NONE;
                    }
                    let released = self.notify(Input::ControlFrame(frame));
                    if self.is_of_master(frame) {
                        let command = frames::command(&control);
                        self.check.on_peer_command(command, control.mode);
                    }
                    return released;
                }
            }
            Message::Status { system, status } if usize::from(system) != own => {
                self.on_peer_stage(status.agreement);
                if let Some(report) = frames::received_status(&status) {
                    return self.notify(Input::StatusFrame(report));
                }
            }
            _ => {}
        }
        TaskSet::NONE
    }

    /// Takes a frame with a right CRC and a wrong counter. Uses only the term of a control frame,
    /// and what an echo contradicts.
    fn on_stale_message(&mut self, at: Instant, message: Message) -> TaskSet {
        match message {
            Message::GateEcho(echo) => {
                self.can.vehicle_clock.on_stale_echo(at, echo.sent_at);
                self.notify(Input::StaleEcho(Term::from_bits(echo.term)))
            }
            Message::Control { system, control } if usize::from(system) != self.system.index() => {
                frames::received_control(system, &control)
                    .map_or(TaskSet::NONE, |frame| self.notify(Input::StaleFrame(frame)))
            }
            _ => TaskSet::NONE,
        }
    }

    /// Passes a tester's frame to the desk on core 2, which checks signatures and the flash.
    fn pass_to_desk(&mut self, frame: &CanFrame) {
        if self.desk.as_mut().is_some_and(|desk| desk.pass(frame)) {
            self.board.ring(CoreId::PLANNING);
        }
    }

    /// Does what the desk wants, one wish in each poll.
    fn serve_desk(&mut self) -> TaskSet {
        match self.desk.as_mut().and_then(DeskPort::wish) {
            None => TaskSet::NONE,
            Some(DeskAction::Send(frame)) => {
                // If the controller's buffer is full, the tester asks again.
                let _unsent = self.board.can().try_send(&frame);
                TaskSet::NONE
            }
            Some(DeskAction::ConfirmStart) => {
                self.board.supply().confirm_start();
                TaskSet::NONE
            }
            Some(DeskAction::Leave(request)) => self.leave_if_spared(request),
        }
    }

    /// Resets this system if the vehicle does not need it: the other one is a master without a
    /// fault, or the vehicle stands. A master first hands over; the desk asks again. T-BOOT-1
    fn leave_if_spared(&mut self, request: ResetRequest) -> TaskSet {
        let Some(redundancy) = self.redundancy.running() else {
            return TaskSet::NONE;
        };
        // A release is given up only if the other system drives.
        let may = self.can.stands && request == ResetRequest::Download;
        if may || redundancy.may_leave(self.board.now()) {
            self.board.supply().request_reset(request);
            return TaskSet::NONE;
        }
        self.notify(Input::HandOver)
    }

    /// Returns whether this frame, which the redundancy has received, is of a master other than
    /// this system.
    fn is_of_master(&self, frame: ControlHeader) -> bool {
        self.redundancy.running().is_none_or(|redundancy| {
            !redundancy.phase().is_driving() && frame.term == redundancy.highest_term()
        })
    }

    fn on_peer_stage(&mut self, stage: Stage) {
        let change = self.check.on_peer_stage(stage);
        self.trace_agreement(change);
    }

    pub(super) fn trace_agreement(&self, change: Option<Change>) {
        if let Some((stage, percent)) = change {
            let stage = stage as u8;
            self.trace(Event::Agreement { stage, percent });
        }
    }

    /// Gives one input to the redundancy; returns the tasks to run for it. Each input is processed
    /// separately: in a flood, the last frame counts as much as the first.
    fn notify(&mut self, input: Input) -> TaskSet {
        let outcome = self.redundancy.on(input);
        self.after(outcome)
    }

    fn after(&mut self, outcome: Outcome) -> TaskSet {
        match outcome {
            Outcome::Done => TaskSet::NONE,
            Outcome::RestartControl => {
                self.grid.restart(self.board.now());
                TaskSet::of(Core0Task::Control)
            }
        }
    }

    /// Passes the lines to the redundancy, which judges them. `held_back`: running count of the
    /// interrupts that came too early.
    pub(super) fn poll_redundancy(&mut self, held_back: u32) -> TaskSet {
        let lines = self.board.lines();
        let received = |line, edge| lines.received(line, edge);
        let snapshot =
            LineSnapshot::new(received, lines.peer_powered(), self.can.third_party_frames);
        self.floods.lines(self.board.now(), &snapshot);
        self.judge_ability();
        let offered = self.redundancy.offers_role();
        let outcome = self.redundancy.poll(snapshot);
        let released = self.after(outcome);
        if !offered && self.redundancy.offers_role() {
            self.redundancy.report();
        }
        self.floods.doorbells(held_back);
        for event in self.floods.events(self.board.now()) {
            self.trace(event);
        }
        released
    }

    /// Tells the redundancy how well this system can drive.
    fn judge_ability(&mut self) {
        let Some(told) = self.redundancy.running().map(Redundancy::ability) else {
            return;
        };
        let (ability, event) = self.ability.poll(self.board.now());
        if let Some(event) = event {
            self.trace(event);
        }
        if ability != told {
            // The next poll acts on it.
            let _done = self.redundancy.on(Input::Ability(ability));
        }
    }

    /// Moves the control cycles of a system that drives to whole milliseconds of the vehicle's
    /// time.
    pub(super) fn align_cycles(&mut self) {
        if let Some(conversion) = self.time.conversion.as_ref()
            && self.redundancy.is_driving()
        {
            self.grid.align(conversion);
        }
    }

    /// Called when a trajectory has arrived. The control cycles follow trajectories, unless they
    /// follow those of the system that drives.
    pub(super) fn follow_trajectory(&mut self) {
        if self.redundancy.is_driving() || self.time.conversion.is_none() {
            self.grid.on_trajectory(self.board.now());
        }
    }

    /// Releases the next control cycle at the global instant that the system which drives has told.
    /// Returns the control task if that is earlier than it waits for.
    fn follow_cycles(&mut self) -> TaskSet {
        let told = self.time.take_peer_cycle();
        let (Some(told), Some(conversion)) = (told, &self.time.conversion) else {
            return TaskSet::NONE;
        };
        if self.redundancy.is_driving() || !self.grid.follow(told, conversion) {
            return TaskSet::NONE;
        }
        TaskSet::of(Core0Task::Control)
    }

    /// Returns by how much the executor is to move its next tick and all later ones, ns; later if
    /// positive: they are to lie on the milliseconds of the vehicle's time. Called once after each
    /// tick that the roles see. `ticks`: with the last tick.
    ///
    /// The executor may move them by less, or not at all; the next call sees what it did.
    #[must_use]
    pub fn tick_correction(&self, ticks: TickGrid) -> i32 {
        let conversion = self.time.conversion.as_ref();
        let by = conversion.map_or(0, |it| off_millisecond(it, ticks.origin));
        // Smaller steps would move the releases of all tasks at each tick.
        if by.unsigned_abs() < TICK_STEP_NS {
            0
        } else {
            by as i32
        }
    }

    /// Called when this system's command is wrong. It stops sending and leaves; the other system
    /// drives.
    pub(super) fn on_wrong_command(&mut self, witness: u8) -> TaskSet {
        if !self.check.on_wrong() {
            return TaskSet::NONE;
        }
        self.trace(Event::WrongCommand { witness });
        self.notify(Input::OwnFault(FailureMode::WrongCommand))
    }

    /// Checks a new scene, and corrects it if it is wrong. Returns the tasks to run.
    pub(super) fn on_scene(&mut self, scene: &mut Scene) -> TaskSet {
        let state = self.redundancy.running().map(Redundancy::state);
        let suspect = state.and_then(|state| match state {
            _ if state.cpsys_failure => Some(Suspect::Peer),
            _ if state.wrong_in_a_row > 0 => Some(Suspect::Own),
            _ => None,
        });
        self.ability.on_scene(scene, self.scene_check.is_lied_to());
        self.redundancy.ready.lanes_seen = scene.lanes.is_some();
        let heard_by_scene = self.scene_check.heard_by_scene(scene);
        let was_right = self.scene_check.found().is_none();
        if let Some(event) = self.scene_check.on_scene(scene, suspect) {
            self.trace(event);
        }
        if let Some(ego) = heard_by_scene {
            self.can.on_ego(scene.at, self.scene_check.corrected(ego));
        }
        match self.scene_check.found() {
            Some(_) if was_right => self.on_wrong_scene(),
            _ => TaskSet::NONE,
        }
    }

    /// Takes what the check of a trajectory says. Returns the tasks to run.
    pub(super) fn on_checked_trajectory(&mut self, event: Event) -> TaskSet {
        // Core 2 plans by the scene that the sensor made wrong; nothing follows its trajectory.
        if self.scene_check.is_lied_to() {
            return TaskSet::NONE;
        }
        self.trace(event);
        if !matches!(event, Event::WrongTrajectory { .. }) {
            return TaskSet::NONE;
        }
        self.is_plan_wrong = true;
        self.on_wrong_scene()
    }

    /// Called while the scene or the trajectory is known to be wrong.
    pub(super) fn on_wrong_scene(&mut self) -> TaskSet {
        self.notify(Input::OwnFault(FailureMode::WrongScene))
    }

    /// Called when the control task no longer completes its cycles. Before the start protocol only
    /// the watchdog acts on this: it resets the system.
    pub(super) fn on_hung_control(&mut self) -> TaskSet {
        self.notify(Input::OwnFault(FailureMode::Deadline))
    }

    /// Called when the driver of the outputs has a fault. `is_new`: the fault was not reported yet.
    pub(super) fn on_output_fault(&mut self, found: OutputDiagnosis, is_new: bool) -> TaskSet {
        if is_new {
            let found = found as u8;
            self.trace(Event::OutputFault { found });
        }
        self.notify(Input::OwnFault(FailureMode::IoModule))
    }

    /// Called while the CAN controller is not yet error-active after bus-off. `again`: a new
    /// bus-off. The vehicle receives nothing from this system, so the other is notified at once.
    pub(super) fn on_bus_off(&mut self, again: bool) -> TaskSet {
        let released = self.notify(Input::OwnFault(FailureMode::CanBusOff));
        if again {
            self.redundancy.report();
        }
        released
    }

    /// Called when core 1 or 2 is dead.
    pub(super) fn on_dead_core(&mut self, fault: FailureMode) -> TaskSet {
        let outcome = self.redundancy.on_dead_core(fault);
        self.after(outcome)
    }

    pub(super) fn trace(&self, event: Event) {
        self.board.trace(event.encode());
    }
}
