//! Core 0: control every 10 ms, and all that its system says to the other one. T-CHIP-3, T-CHIP-7
//!
//! After a reset it first lets cores 1 and 2 come up, silently; then the start protocol begins.
//! From then on each poll hands what has come to the redundancy, does what that answers, and
//! releases the tasks that are due.

mod alive;
mod drive;
mod frames;

use crate::activity::TaskCode;
use crate::driving::perception::ego_of;
use crate::driving::types::{Command, Scene, Trajectory};
use crate::layout::{ControllerMap, FOLLOW, Reader, age_ns};
use crate::schedule::{Release, Schedule};
use crate::trace::{Begin, Event, Leaves};
use crate::{Config, Core, RETRY, read_can};
use alive::Alive;
use drive::Drive;
use tandem_board::{
    Board, CoreId, DataFlash, Duration, Instant, Lines, Link, ResetRequest, Supply, SystemId,
    watchdog_answer,
};
use tandem_bus::{Message, Transmitter};
use tandem_redundancy::{
    Actions, ControlFrame, FailureMode, Geometry, Input, Loaded, Mode, PeerReport, Phase,
    Redundancy, Snapshot, StateStore,
};
use tandem_shm::mailbox::Receiver;

/// The tasks of core 0.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Task {
    /// Motion control and the control frame.
    Control,
    /// Window and functional watchdog, and the cores' alive counters.
    Supervise,
    /// The status frame.
    Status,
}

/// Period of the control task.
pub const CONTROL_PERIOD: Duration = Duration::from_ms(10);
pub(crate) const SUPERVISE_PERIOD: Duration = Duration::from_ms(5);
pub(crate) const STATUS_PERIOD: Duration = Duration::from_ms(100);
/// While the start protocol waits for cores 1 and 2, core 0 looks this often.
const BOOT_POLL: Duration = Duration::from_ms(1);

/// Tasks in falling order of priority.
fn tasks(start: Instant) -> Schedule<Task, 3> {
    Schedule::new(
        start,
        [
            (Task::Control, CONTROL_PERIOD),
            (Task::Supervise, SUPERVISE_PERIOD),
            (Task::Status, STATUS_PERIOD),
        ],
    )
}

/// What core 0 has of the LMU.
struct Lmu<'b> {
    map: ControllerMap<'b>,
    from_planning: Receiver<'b>,
    scenes: Reader<'b, Scene>,
    trajectories: Reader<'b, Trajectory>,
}

impl<'b> Lmu<'b> {
    fn attach<B: Board>(board: &'b B) -> Option<Self> {
        let map = ControllerMap::attach(board).ok()?;
        Some(Self {
            map,
            from_planning: Receiver::attach(map.mailbox_2_to_0()).ok()?,
            scenes: map.scene_reader()?,
            trajectories: map.trajectory_reader()?,
        })
    }
}

/// The control core.
pub struct Core0<'b, B: Board> {
    board: &'b B,
    config: Config,
    system: SystemId,
    started: Instant,
    lmu: Option<Lmu<'b>>,
    alive: Alive,
    receiver: tandem_bus::Receiver,
    transmitter: Transmitter,
    /// Valid frames received on CAN, of whatever kind; wraps around.
    can_frames: u32,
    drive: Drive,
    store: StateStore,
    loaded: Loaded,
    /// `None` until cores 1 and 2 carry the drive.
    redundancy: Option<Redundancy>,
    redundancy_due: Instant,
    shown: Option<(Phase, Mode, u32)>,
    schedule: Schedule<Task, 3>,
    last_service: Option<Instant>,
    deadline_misses: u32,
    tracks: u8,
}

impl<'b, B: Board> Core0<'b, B> {
    /// Starts the core's life on this board: reads the state from the data flash (bounded time).
    #[must_use]
    pub fn new(board: &'b B, config: Config) -> Self {
        let started = board.now();
        let identity = board.identity();
        let cause = board.supply().reset_cause();
        let (store, loaded) = StateStore::load(Geometry::of::<B::Flash>(), |offset, into| {
            board.flash().read(offset, into)
        });
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
            lmu: None,
            alive: Alive::new(started, config.boot_limit, |_| 0),
            receiver: tandem_bus::Receiver::new(),
            transmitter: Transmitter::new(),
            can_frames: 0,
            drive: Drive::new(),
            store,
            loaded,
            redundancy: None,
            redundancy_due: started,
            shown: None,
            schedule: tasks(started),
            last_service: None,
            deadline_misses: 0,
            tracks: 0,
        }
    }

    /// The phase of this system, once the start protocol has begun.
    #[must_use]
    pub fn phase(&self) -> Option<Phase> {
        self.redundancy.as_ref().map(Redundancy::phase)
    }

    fn attach(&mut self) {
        self.lmu = Lmu::attach(self.board);
        if let Some(Lmu { map, .. }) = &self.lmu {
            self.alive = Alive::new(self.board.now(), self.config.boot_limit, |core| {
                map.cycles(core)
            });
        }
    }

    /// Fetches what cores 1 and 2 have published.
    fn read_lmu(&mut self) {
        let Some(lmu) = &mut self.lmu else { return };
        lmu.from_planning.awake();
        let mut signalled = false;
        lmu.from_planning
            .poll(|open| signalled |= open.task == FOLLOW);
        let task = TaskCode::FOLLOW;
        if signalled {
            let begin = Begin::Goes;
            self.board.trace(Event::TaskIn { task, begin }.encode());
        }
        let (scene, trajectory) = (lmu.scenes.fetch(), lmu.trajectories.fetch());
        let now = self.board.now();
        match trajectory {
            Ok(Some(trajectory)) => {
                let latency_ns = age_ns(now, trajectory.at);
                if signalled {
                    self.trace(Event::Woken {
                        core: CoreId::PLANNING,
                        flow: trajectory.cycle,
                    });
                    self.trace(Event::Chain {
                        latency_ns,
                        cycle: trajectory.cycle,
                    });
                }
                self.drive.on_trajectory(trajectory);
            }
            Ok(None) => {}
            Err(_) => self.trace(Event::Refused { id: 0 }),
        }
        match scene {
            Ok(Some(scene)) => {
                self.tracks = scene.objects.len() as u8;
                self.drive.on_scene(scene);
            }
            Ok(None) => {}
            Err(_) => self.trace(Event::Refused { id: 0 }),
        }
        if signalled {
            self.done(task);
        }
    }

    /// Fetches all that came over CAN and the link, and hands it on.
    fn read_bus(&mut self) {
        while let Some((at, message)) = read_can(self.board, &mut self.receiver) {
            self.can_frames = self.can_frames.wrapping_add(1);
            self.hear(at, message);
        }
        let mut words = [0; PeerReport::WORDS];
        while let Some(length) = self.board.link().try_receive(&mut words) {
            let report = words.get(..length).and_then(PeerReport::from_words);
            if let Some(report) = report {
                self.tell(Input::LinkReport(report));
            }
        }
    }

    fn hear(&mut self, at: Instant, message: Message) {
        match message {
            Message::EgoMotion(motion) => self.drive.on_ego(at, ego_of(&motion)),
            Message::Control {
                system: from,
                control,
            } if usize::from(from) != self.system.index() => {
                let Some(frame) = frames::heard_control(from, &control) else {
                    return;
                };
                self.tell(Input::ControlFrame(frame));
                if self.is_of_master(frame) {
                    self.drive.on_command_of_master(Command {
                        steering_angle: control.steering_angle,
                        acceleration: control.acceleration,
                    });
                }
            }
            Message::Status {
                system: from,
                status,
            } if usize::from(from) != self.system.index() => {
                if let Some(report) = frames::heard_status(&status) {
                    self.tell(Input::StatusFrame(report));
                }
            }
            _ => {}
        }
    }

    /// Whether the vehicle obeys this frame of the other system, which was told to the redundancy.
    /// A stale frame of a master that was held up is none to go on from.
    fn is_of_master(&self, frame: ControlFrame) -> bool {
        self.redundancy.as_ref().is_none_or(|redundancy| {
            !redundancy.phase().is_driving() && frame.term == redundancy.highest_term()
        })
    }

    /// Tells the redundancy what has come, and does what it answers. Each by itself: of a flood,
    /// the last frame counts as much as the first.
    fn tell(&mut self, input: Input) {
        let now = self.board.now();
        if let Some(redundancy) = &mut self.redundancy {
            let actions = redundancy.on(now, input);
            self.act(actions);
        }
    }

    /// Begins the start protocol when the chain of cores 1, 2 and 0 runs, or cannot be waited for.
    fn start_redundancy(&mut self) {
        let now = self.board.now();
        let waited = now.since(self.started);
        let ready = self.alive.all_seen() && self.drive.is_ready();
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

    /// Whether a poll comes because the redundancy wants to be asked, and how late.
    fn begin_of_poll(&self) -> Begin {
        let now = self.board.now();
        if now < self.redundancy_due {
            return Begin::Goes;
        }
        Begin::Released {
            late_ns: age_ns(now, self.redundancy_due),
            missed: 0,
        }
    }

    fn poll_redundancy(&mut self) {
        let snapshot = Snapshot::read(self.board.lines(), self.can_frames);
        let Some(redundancy) = &mut self.redundancy else {
            return self.start_redundancy();
        };
        let actions = redundancy.on(self.board.now(), Input::Poll(snapshot));
        self.act(actions);
    }

    /// Does what the redundancy asks for.
    fn act(&mut self, actions: Actions) {
        for (line, edge) in actions.edges() {
            self.board.lines().send(line, edge);
        }
        if let Some(state) = actions.persist {
            self.store.request(state);
        }
        for event in actions.events.iter() {
            self.trace(event.into());
        }
        if actions.synchronised {
            // Both systems begin their control cycle on the sync edge.
            self.schedule.restart(Task::Control, self.board.now());
        }
        if actions.transmit_now {
            // A takeover does not wait for the grid of the cycle: it begins a new one.
            let at = self.board.now();
            self.schedule.restart(Task::Control, at + CONTROL_PERIOD);
            self.run(Release {
                task: Task::Control,
                at,
                missed: 0,
            });
        }
        self.redundancy_due = actions.deadline;
        self.store.drive(self.board.flash());
        if let Some(request) = actions.reset
            && self.store.is_settled()
        {
            self.board.supply().request_reset(request);
        }
        self.show();
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
            role: phase.role().code(),
            mode: mode.code(),
            term,
        });
    }

    fn run(&mut self, release: Release<Task>) {
        let task = match release.task {
            Task::Control => TaskCode::CONTROL,
            Task::Supervise => TaskCode::MONITORING,
            Task::Status => TaskCode::STATUS,
        };
        let begin = Begin::Released {
            late_ns: age_ns(self.board.now(), release.at),
            missed: release.missed,
        };
        self.trace(Event::TaskIn { task, begin });
        match release.task {
            Task::Control => self.control(release),
            Task::Supervise => self.supervise(),
            Task::Status => self.send_status(),
        }
        self.done(task);
    }

    /// The running task's job is done.
    fn done(&self, task: TaskCode) {
        let leaves = Leaves::Done;
        self.trace(Event::TaskOut { task, leaves });
    }

    fn control(&mut self, release: Release<Task>) {
        let begin = self.board.now();
        if release.missed > 0 {
            self.deadline_misses = self.deadline_misses.saturating_add(release.missed);
            self.trace(Event::DeadlineMiss {
                missed: release.missed,
            });
        }
        let Some(redundancy) = &mut self.redundancy else {
            return;
        };
        let mode = redundancy.mode();
        let degraded = mode == Mode::DegradedL2;
        let task = TaskCode::DEGRADED;
        if degraded {
            let begin = Begin::Released {
                late_ns: 0,
                missed: 0,
            };
            self.board.trace(Event::TaskIn { task, begin }.encode());
        }
        let output = self.drive.cycle(begin, mode);
        if degraded {
            let leaves = Leaves::Done;
            self.board.trace(Event::TaskOut { task, leaves }.encode());
        }
        let report = redundancy.link_report();
        // A full link means that the other does not fetch: it will miss this report and get the
        // next.
        let _full = self.board.link().try_send(&report.to_words());
        let transmitted = redundancy.may_transmit(self.board.now()) && {
            let control = frames::control(redundancy, &output);
            let message = Message::Control {
                system: self.system.index() as u8,
                control,
            };
            frames::send(self.board, &mut self.transmitter, &message)
        };
        let execution_ns = age_ns(self.board.now(), begin);
        let lateness_ns = age_ns(begin, release.at);
        self.trace(Event::ControlCycle {
            lateness_ns,
            execution_ns,
            transmitted,
        });
    }

    fn supervise(&mut self) {
        self.service_watchdog();
        let Some(Lmu { map, .. }) = &self.lmu else {
            return;
        };
        let now = self.board.now();
        let limit = self.config.alive_limit;
        let Some(core) = self.alive.silent(now, limit, |core| map.cycles(core)) else {
            return;
        };
        self.trace(Event::CoreSilent {
            core: core.index() as u8,
        });
        let fault = if core == CoreId::PERCEPTION {
            FailureMode::PerceptionCore
        } else {
            FailureMode::PlanningCore
        };
        match &mut self.redundancy {
            Some(redundancy) => {
                let actions = redundancy.on(now, Input::OwnFault(fault));
                self.act(actions);
            }
            None => self.board.supply().request_reset(ResetRequest::CoreDead),
        }
    }

    /// Services the watchdog unless the window is not yet open.
    fn service_watchdog(&mut self) {
        let now = self.board.now();
        // 1 ms after the window opens: the supply's clock may run slower than this one.
        let opens = Duration::from_us(u64::from(B::Supply::WINDOW_OPENS_US) + 1000);
        if self
            .last_service
            .is_some_and(|last| now.since(last) < opens)
        {
            return;
        }
        let supply = self.board.supply();
        supply.service_watchdog(watchdog_answer(supply.watchdog_question()));
        // Looked at anew: had this core been held up since the look above, the next service would
        // seem to be due while the window is still closed.
        self.last_service = Some(self.board.now());
    }

    fn send_status(&mut self) {
        let Some(redundancy) = &self.redundancy else {
            return;
        };
        let status = frames::status(redundancy, self.tracks, self.deadline_misses);
        let message = Message::Status {
            system: self.system.index() as u8,
            status,
        };
        frames::send(self.board, &mut self.transmitter, &message);
    }

    fn trace(&self, event: Event) {
        self.board.trace(event.encode());
    }
}

impl<B: Board> Core for Core0<'_, B> {
    fn poll(&mut self) -> Instant {
        let task = TaskCode::REDUNDANCY;
        self.trace(Event::TaskIn {
            task,
            begin: self.begin_of_poll(),
        });
        if self.lmu.is_none() {
            self.attach();
        }
        self.read_lmu();
        // Everything that has come is handed on before the lines are judged: else the redundancy
        // would be told of silence while evidence waits in a buffer.
        self.read_bus();
        self.poll_redundancy();
        self.store.drive(self.board.flash());
        self.done(task);
        while let Some(release) = self.schedule.release(self.board.now()) {
            self.run(release);
        }
        let next = self.schedule.next().min(self.redundancy_due);
        let Some(lmu) = &mut self.lmu else {
            return next.min(self.board.now() + RETRY);
        };
        if lmu.from_planning.prepare_sleep() {
            next
        } else {
            self.board.now()
        }
    }
}
