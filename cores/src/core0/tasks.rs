//! The bodies of core 0's tasks: each does all due work and returns when it is due next.

use super::alive::Alive;
use super::{Core0Task, Executor, SharedState, TaskBody, TaskSet, frames};
use crate::doorbell::DOORBELL_DISTANCE;
use crate::driving::types::{Scene, Trajectory};
use crate::layout::{
    CONTROL_STEP, ControllerMap, KNOWLEDGE, MAILBOX_2_TO_0, SCENE, TRAJECTORY, TRAJECTORY_READY,
    age_ns,
};
use crate::release::{Cycles, Grid, Release};
use crate::tester_desk::DeskPort;
use crate::trace::{Begin, Event};
use crate::{Config, RETRY};
use tandem_board::{
    Board, Can, CanErrors, CanState, CoreId, Duration, Instant, OutputDiagnosis, Supply,
    watchdog_answer,
};
use tandem_bus::Message;
use tandem_redundancy::{FailureMode, Phase};
use tandem_shm::mailbox;
use tandem_shm::newest::Reader;

/// Begins a job of a periodic task. Traces the earlier releases that were missed.
pub(super) fn released(board: &impl Board, task: Core0Task, release: Release) -> Begin {
    if release.missed > 0 {
        let (task, missed) = (task.info().code, release.missed);
        board.trace(Event::DeadlineMiss { task, missed }.encode());
    }
    Begin::Released {
        late_ns: age_ns(board.now(), release.at),
        missed: release.missed,
    }
}

/// Heartbeats, what has arrived from the other system, and the roles.
pub struct RolesTask<'b, B>(pub(super) &'b B);

impl<'b, B: Board> TaskBody<'b, B> for RolesTask<'b, B> {
    const ID: Core0Task = Core0Task::Roles;

    fn poll(&mut self, executor: &impl Executor<'b, B>) -> Instant {
        let (tasks, due) = executor.shared(|shared| {
            let now = self.0.now();
            let due = shared.redundancy.due();
            let begin = if now < due {
                Begin::Goes
            } else {
                let late_ns = age_ns(now, due);
                let missed = late_ns / Self::ID.info().period.as_ns() as u32;
                let polls = &mut shared.counters.missed_polls;
                *polls = polls.saturating_add(missed);
                Begin::Released { late_ns, missed }
            };
            executor.begins(Self::ID, begin);
            // Read everything that has arrived before the lines are judged: otherwise the
            // redundancy sees silence while evidence waits in a buffer.
            let tasks = shared.read_bus();
            let tasks = tasks | shared.poll_redundancy(executor.held_back());
            (tasks, shared.redundancy.due())
        });
        executor.release(tasks);
        executor.ends(Self::ID);
        due
    }
}

/// The command is wrong after this many wrong steps in succession. Core 2 checks every 50 ms.
const WRONG_STEPS: u32 = 2;

/// The window and functional watchdog, and the cores' alive counters.
pub struct MonitoringTask<'b, B> {
    board: &'b B,
    config: Config,
    grid: Grid,
    map: Option<ControllerMap<'b>>,
    alive: Alive,
    /// How many polls in a row found a fault of the outputs.
    output_faults: u8,
    /// State of the CAN controller at the last poll.
    can_errors: CanErrors,
    overruns: u32,
    /// The CAN controller was bus-off, and has not been error-active since.
    was_bus_off: bool,
    /// The silent core, so that a system that continues to drive traces it only once.
    silent: Option<CoreId>,
    control: Progress,
    /// Set when this system stops servicing the watchdog, which then resets it.
    withholds: bool,
    last_service: Option<Instant>,
}

/// Logical supervision of the control task, which must complete cycles. The monitoring counts time
/// in its own polls, so a control task does not count as hung if its whole core was held up.
#[derive(Default)]
struct Progress {
    cycles: u32,
    polls_without: u8,
}

impl Progress {
    /// The control task hangs if this many polls, 5 ms apart, see no cycle: four control periods.
    const HUNG_POLLS: u8 = 8;

    /// `cycles`: running count of the control cycles that have ended.
    fn poll(&mut self, cycles: u32) {
        self.polls_without = if core::mem::replace(&mut self.cycles, cycles) == cycles {
            self.polls_without.saturating_add(1)
        } else {
            0
        };
    }

    const fn is_hung(&self) -> bool {
        self.polls_without >= Self::HUNG_POLLS
    }
}

/// The number of polls in a row that must find a fault of the outputs.
const OUTPUT_FAULT_POLLS: u8 = 3;

impl<'b, B: Board> MonitoringTask<'b, B> {
    pub(super) fn new(board: &'b B, config: Config) -> Self {
        let started = board.now();
        Self {
            board,
            config,
            grid: Grid::new(started, Core0Task::Monitoring.info().period),
            map: None,
            alive: Alive::new(started, config.boot_limit, |_| 0),
            silent: None,
            output_faults: 0,
            can_errors: CanErrors::default(),
            overruns: 0,
            was_bus_off: false,
            control: Progress::default(),
            withholds: false,
            last_service: None,
        }
    }

    fn attach(&mut self) {
        self.map = ControllerMap::attach(self.board).ok();
        if let Some(map) = &self.map {
            let first = self.config.boot_limit;
            self.alive = Alive::new(self.board.now(), first, |core| map.cycles(core));
        }
    }

    /// Services the watchdog if the window is open and this system may continue.
    fn service_watchdog(&mut self) {
        if self.withholds {
            return;
        }
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
        // Read the clock again: if this core was held up since the first reading, the next service
        // would seem due while the window is still closed.
        self.last_service = Some(self.board.now());
    }

    /// Reports a control task that hangs: such a standby cannot take over. While it hangs or the
    /// command is wrong, the watchdog is not serviced, so it resets a system that has not left.
    fn supervise_control(&mut self, executor: &impl Executor<'b, B>) {
        let tasks = executor.shared(|shared| {
            self.control.poll(shared.counters.control_cycles);
            self.withholds = self.control.is_hung() || shared.check.is_wrong();
            self.control.is_hung().then(|| shared.on_hung_control())
        });
        if let Some(tasks) = tasks {
            executor.release(tasks);
        }
    }

    /// Reports a fault of the output driver that [`OUTPUT_FAULT_POLLS`] polls in a row found. A
    /// switch that is just opening or closing has no fault.
    fn supervise_outputs(&mut self, executor: &impl Executor<'b, B>) {
        let found = self.board.output_diagnosis();
        self.output_faults = match found {
            OutputDiagnosis::Good => 0,
            OutputDiagnosis::OpenLoad | OutputDiagnosis::ShortCircuit => {
                self.output_faults.saturating_add(1)
            }
        };
        if self.output_faults >= OUTPUT_FAULT_POLLS {
            let is_new = self.output_faults == OUTPUT_FAULT_POLLS;
            let tasks = executor.shared(|shared| shared.on_output_fault(found, is_new));
            executor.release(tasks);
        }
    }

    /// Reads the state of the CAN controller. After bus-off it has sent nothing for several control
    /// cycles: that is a fault of this system until its counters are good again.
    fn supervise_can(&mut self, executor: &impl Executor<'b, B>) {
        let can = self.board.can();
        let (errors, overruns) = (can.errors(), can.overruns());
        let count = overruns.wrapping_sub(core::mem::replace(&mut self.overruns, overruns));
        if count > 0 {
            self.board.trace(Event::FramesLost { count }.encode());
        }
        let before = core::mem::replace(&mut self.can_errors, errors);
        let was_off = errors.bus_offs != before.bus_offs;
        if was_off || errors.state() != before.state() {
            self.board.trace(Event::CanErrors { errors }.encode());
        }
        self.was_bus_off = was_off || self.was_bus_off && errors.state() != CanState::ErrorActive;
        if self.was_bus_off {
            let tasks = executor.shared(|shared| shared.on_bus_off(was_off));
            executor.release(tasks);
        }
    }

    /// Reports a scene or a trajectory that was found wrong, for as long as this system runs.
    fn supervise_scene(&self, executor: &impl Executor<'b, B>) {
        let tasks = executor.shared(|shared| {
            let is_wrong = shared.scene_check.found().is_some() || shared.is_plan_wrong;
            is_wrong.then(|| shared.on_wrong_scene())
        });
        if let Some(tasks) = tasks {
            executor.release(tasks);
        }
    }

    /// Compares the alive counters with their limit.
    fn supervise(&mut self, executor: &impl Executor<'b, B>) {
        let Some(map) = &self.map else { return };
        if map.wrong_steps() >= WRONG_STEPS {
            map.judge_control(true);
            let tasks = executor.shared(|shared| shared.on_wrong_command(1));
            executor.release(tasks);
        }
        let (now, limit) = (self.board.now(), self.config.alive_limit);
        let silent = self.alive.silent(now, limit, |core| map.cycles(core));
        let all_seen = self.alive.all_seen();
        let is_new = core::mem::replace(&mut self.silent, silent) != silent;
        let tasks = executor.shared(|shared| {
            shared.redundancy.ready.cores_run = all_seen;
            map.show_role(shared.phase().is_some_and(Phase::sends_heartbeats));
            let core = silent?;
            if is_new {
                shared.trace(Event::CoreSilent {
                    core: core.index() as u8,
                });
            }
            Some(shared.on_dead_core(if core == CoreId::PERCEPTION {
                FailureMode::PerceptionCore
            } else {
                FailureMode::PlanningCore
            }))
        });
        if let Some(tasks) = tasks {
            executor.release(tasks);
        }
    }
}

impl<'b, B: Board> TaskBody<'b, B> for MonitoringTask<'b, B> {
    const ID: Core0Task = Core0Task::Monitoring;

    fn start(&mut self, at: Instant) {
        self.grid.restart(at);
    }

    fn shift(&mut self, _: &impl Executor<'b, B>, by_ns: i64) {
        self.grid.shift(by_ns);
    }

    fn poll(&mut self, executor: &impl Executor<'b, B>) -> Instant {
        if self.map.is_none() {
            self.attach();
            if let Some(lmu) = &self.map {
                let (map, incarnation) = (&lmu.map, lmu.incarnation);
                let steps = CONTROL_STEP.writer(map, incarnation).ok();
                let received = KNOWLEDGE.writer(map, incarnation).ok();
                let desk = DeskPort::attach(lmu);
                executor.shared(|shared| {
                    (shared.check.steps, shared.transfer.received) = (steps, received);
                    shared.desk = desk;
                });
            }
        }
        if let Some(release) = self.grid.release(self.board.now()) {
            executor.begins(Self::ID, released(self.board, Self::ID, release));
            self.supervise_control(executor);
            self.supervise_outputs(executor);
            self.supervise_can(executor);
            self.service_watchdog();
            self.supervise_scene(executor);
            self.supervise(executor);
            executor.ends(Self::ID);
        }
        match self.map {
            Some(_) => self.grid.next(),
            None => self.grid.next().min(self.board.now() + RETRY),
        }
    }
}

/// The parts of the LMU that core 0 uses for driving.
struct Lmu<'b> {
    from_planning: mailbox::Receiver<'b>,
    scenes: Reader<'b, Scene>,
    trajectories: Reader<'b, Trajectory>,
}

impl<'b> Lmu<'b> {
    fn attach<B: Board>(board: &'b B) -> Option<Self> {
        let ControllerMap {
            map, incarnation, ..
        } = ControllerMap::attach(board).ok()?;
        Some(Self {
            from_planning: MAILBOX_2_TO_0.receiver(&map, incarnation).ok()?,
            scenes: SCENE.reader(&map).ok()?,
            trajectories: TRAJECTORY.reader(&map).ok()?,
        })
    }
}

/// Core 2 is wrong after this many trajectories that are no values.
const REFUSED: u8 = 3;
const UNREADABLE: Event = Event::WrongTrajectory {
    what: 1,
    percent: u32::MAX,
};

/// Fetches what cores 1 and 2 have published.
pub struct TrajectoryInputTask<'b, B> {
    board: &'b B,
    lmu: Option<Lmu<'b>>,
    cycles: Cycles,
    /// Trajectories in succession that were no values.
    refused: u8,
}

impl<'b, B: Board> TrajectoryInputTask<'b, B> {
    pub(super) fn new(board: &'b B) -> Self {
        Self {
            board,
            lmu: None,
            cycles: Cycles::default(),
            refused: 0,
        }
    }

    fn trace(&self, event: Event) {
        self.board.trace(event.encode());
    }
}

impl<'b, B: Board> TaskBody<'b, B> for TrajectoryInputTask<'b, B> {
    const ID: Core0Task = Core0Task::TrajectoryInput;

    fn poll(&mut self, executor: &impl Executor<'b, B>) -> Instant {
        if self.lmu.is_none() {
            self.lmu = Lmu::attach(self.board);
        }
        let Some(lmu) = &mut self.lmu else {
            return self.board.now() + RETRY;
        };
        lmu.from_planning.awake();
        let mut signalled = false;
        lmu.from_planning
            .poll(|open| signalled |= open.task == TRAJECTORY_READY);
        if signalled {
            executor.begins(Self::ID, Begin::Goes);
        }
        let (scene, trajectory) = (lmu.scenes.fetch(), lmu.trajectories.fetch());
        let asleep = lmu.from_planning.prepare_sleep();
        let now = self.board.now();
        // The trajectory is checked against the scene for which it was planned.
        match scene {
            Ok(Some(mut scene)) => {
                let tasks = executor.shared(|shared| {
                    let tasks = shared.on_scene(&mut scene);
                    shared.counters.tracks = scene.objects.len() as u8;
                    tasks
                });
                executor.release(tasks);
                executor.drive(|drive| drive.on_scene(scene));
            }
            Ok(None) => {}
            Err(_) => self.trace(Event::Refused { id: 0 }),
        }
        match trajectory {
            Ok(Some(trajectory)) => {
                let missed = self.cycles.missed(trajectory.cycle);
                if missed > 0 {
                    let task = Self::ID.info().code;
                    self.trace(Event::DeadlineMiss { task, missed });
                }
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
                self.refused = 0;
                let event = executor.drive(|drive| drive.on_trajectory(trajectory));
                let tasks = executor.shared(|shared| {
                    shared.follow_trajectory();
                    event.map_or(TaskSet::NONE, |event| shared.on_checked_trajectory(event))
                });
                executor.release(tasks);
            }
            Ok(None) => {}
            Err(_) => {
                self.trace(Event::Refused { id: 0 });
                self.refused += u8::from(signalled && self.refused < REFUSED);
                if signalled && self.refused == REFUSED {
                    let tasks = executor.shared(|shared| shared.on_checked_trajectory(UNREADABLE));
                    executor.release(tasks);
                }
            }
        }
        if signalled {
            executor.ends(Self::ID);
        }
        if asleep {
            Instant::NEVER
        } else {
            // A signal has just arrived. Core 2 does not ring while this core is awake.
            self.board.now() + DOORBELL_DISTANCE
        }
    }
}

/// The status frame.
pub struct StatusTask<'b, B> {
    board: &'b B,
    grid: Grid,
}

impl<'b, B: Board> StatusTask<'b, B> {
    pub(super) fn new(board: &'b B) -> Self {
        Self {
            board,
            grid: Grid::new(board.now(), Core0Task::Status.info().period),
        }
    }
}

impl<'b, B: Board> TaskBody<'b, B> for StatusTask<'b, B> {
    const ID: Core0Task = Core0Task::Status;

    fn start(&mut self, at: Instant) {
        self.grid.restart(at);
    }

    fn shift(&mut self, _: &impl Executor<'b, B>, by_ns: i64) {
        self.grid.shift(by_ns);
    }

    fn poll(&mut self, executor: &impl Executor<'b, B>) -> Instant {
        if let Some(release) = self.grid.release(self.board.now()) {
            executor.begins(Self::ID, released(self.board, Self::ID, release));
            executor.shared(|shared| shared.send_status());
            executor.ends(Self::ID);
        }
        self.grid.next()
    }
}

impl<B: Board> SharedState<'_, B> {
    fn send_status(&mut self) {
        let Some(redundancy) = self.redundancy.running() else {
            return;
        };
        let counters = &mut self.counters;
        let missed = core::mem::take(&mut counters.missed_polls);
        // Sends the redundancy's mode: a master that reported a safe stop here would resign.
        let status = tandem_bus::Status {
            agreement: self.check.stage(),
            ..frames::status(redundancy, counters.tracks, counters.deadline_misses)
        };
        if missed > 0 {
            let task = Core0Task::Roles.info().code;
            self.trace(Event::DeadlineMiss { task, missed });
        }
        let message = Message::Status {
            system: self.system.index() as u8,
            status,
        };
        let encoded = self.can.transmitter.encode(&message);
        let _full = frames::send_encoded(self.board, &encoded);
    }
}
