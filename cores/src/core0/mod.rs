//! Core 0: control every 10 ms, and all messages of its system to the other one. T-CHIP-3, T-CHIP-7
//!
//! After a reset it first waits silently for cores 1 and 2; then the start protocol begins.
//!
//! Its work is eight tasks ([`Core0Task`]; the table is [`crate::task_table`]). The body of each is
//! a [`TaskBody`] that does all due work and returns when it is due next. It reaches the state that
//! all tasks share through an [`Executor`]. [`Core0`] runs the tasks one after the other, each to
//! its end; the crate `tandem-runtime` gives each a task of FreeRTOS; the simulator has an executor
//! with execution times. `docs/rtos-tasks.md` has the priorities and the reasons for them.

mod ability;
mod agreement;
mod alive;
mod can_port;
mod command_check;
mod control_cycle;
mod control_grid;
mod datagram;
mod driving;
mod frames;
mod knowledge_transfer;
mod limits;
mod peer_command;
mod plan_check;
mod read_back;
mod redundancy_port;
mod run_to_completion;
mod scene_check;
mod shared;
mod state_flash;
mod tasks;
mod time;
mod topics;
mod vehicle_clock;
mod wheel;

use crate::Config;
use crate::release::TickGrid;
use crate::task_table::{CORE_0, TaskCode, TaskInfo};
use crate::trace::Begin;
pub use control_cycle::{ControlTask, DegradedTask};
use core::ops::{BitOr, BitOrAssign};
pub use driving::Driving;
pub use limits::{CAN_FRAMES, EDGES_PER_MS, LINK_DATAGRAMS};
pub use run_to_completion::Core0;
pub use shared::SharedState;
use tandem_board::{Board, CoreId, Duration, Instant};
pub use tasks::{MonitoringTask, RolesTask, StatusTask, TrajectoryInputTask};
pub use time::{TimeSource, TimeTask};
pub use topics::TopicsTask;

/// Period of the control task.
pub const CONTROL_PERIOD: Duration = Core0Task::Control.info().period;

/// The tasks of core 0.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Core0Task {
    /// Heartbeats, what has arrived from the other system, and the state machine of the roles.
    Roles,
    /// Window and functional watchdog, and the cores' alive counters.
    Monitoring,
    /// Motion control and the control frame.
    Control,
    /// The control cycle of a system that drives alone; [`Core0Task::Control`] hands it over.
    Degraded,
    /// Fetches what cores 1 and 2 have published; core 2's signal releases it.
    TrajectoryInput,
    /// The status frame.
    Status,
    /// The time of the vehicle.
    Time,
    /// Topics over DDS, to and from the SoC.
    Topics,
}

impl Core0Task {
    /// All tasks in the order of the table: the highest priority first.
    pub const ALL: [Self; CORE_0.len()] = [
        Self::Roles,
        Self::Monitoring,
        Self::Control,
        Self::Degraded,
        Self::TrajectoryInput,
        Self::Status,
        Self::Time,
        Self::Topics,
    ];

    /// Returns its row of the table.
    #[must_use]
    pub const fn info(self) -> &'static TaskInfo {
        &CORE_0[self as usize]
    }

    /// Returns at which tick after the origin of `ticks` a kernel wakes this task for a deadline
    /// that the task computed with these ticks.
    ///
    /// The roles are polled at each tick. If their deadline lies between two ticks, they are polled
    /// at the earlier one: a wasted poll is cheaper than a late heartbeat.
    #[must_use]
    pub fn wakes(self, ticks: &TickGrid, deadline: Instant) -> u64 {
        match self {
            Self::Roles => ticks.before(deadline).max(1),
            _ => ticks.after(deadline),
        }
    }

    /// The task with this code; `None` if core 0 has none.
    #[must_use]
    pub fn of(code: TaskCode) -> Option<Self> {
        Self::ALL.into_iter().find(|id| id.info().code == code)
    }
}

/// A set of tasks of core 0.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TaskSet(u8);

impl TaskSet {
    /// No task.
    pub const NONE: Self = Self(0);

    const fn of(task: Core0Task) -> Self {
        Self(1 << task as u8)
    }

    /// Returns whether `task` is among them.
    #[must_use]
    pub const fn contains(self, task: Core0Task) -> bool {
        self.0 & Self::of(task).0 != 0
    }
}

impl From<Core0Task> for TaskSet {
    fn from(task: Core0Task) -> Self {
        Self::of(task)
    }
}

impl BitOr for TaskSet {
    type Output = Self;

    fn bitor(self, other: Self) -> Self {
        Self(self.0 | other.0)
    }
}

impl BitOrAssign for TaskSet {
    fn bitor_assign(&mut self, other: Self) {
        self.0 |= other.0;
    }
}

/// The interface that an executor offers to a task.
pub trait Executor<'b, B: Board> {
    /// Runs `body` with the shared state; the other tasks wait for it. Must not be nested, or
    /// called within [`Executor::drive`].
    fn shared<R>(&self, body: impl FnOnce(&mut SharedState<'b, B>) -> R) -> R;

    /// Runs `body` with the function that drives. Must not be nested.
    fn drive<R>(&self, body: impl FnOnce(&mut Driving) -> R) -> R;

    /// Releases tasks, all of them less urgent than the caller. Not within [`Executor::shared`].
    fn release(&self, tasks: TaskSet);

    /// Returns how many times rings of the doorbell were held back, see
    /// [`DoorbellThrottle`](crate::doorbell::DoorbellThrottle); wraps around.
    fn held_back(&self) -> u32;

    /// Reports to the trace that a job of this task, the caller, begins.
    fn begins(&self, task: Core0Task, begin: Begin);

    /// Reports to the trace that the job is done.
    fn ends(&self, task: Core0Task);
}

/// The body of a task.
pub trait TaskBody<'b, B: Board> {
    /// Which task.
    const ID: Core0Task;

    /// Makes the releases of a periodic task begin at `at`.
    fn start(&mut self, _at: Instant) {}

    /// Moves the releases of a periodic task by `by_ns`, later if positive: the ticks on which they
    /// lie were moved.
    fn shift(&mut self, _executor: &impl Executor<'b, B>, _by_ns: i64) {}

    /// Does all due work and returns the latest time of the next call; it may be called earlier.
    /// Blocks only in the executor's locks, never allocates.
    fn poll(&mut self, executor: &impl Executor<'b, B>) -> Instant;
}

/// The tasks of core 0.
#[allow(missing_docs, reason = "each is documented as its type")]
pub struct Tasks<'b, B: Board> {
    pub roles: RolesTask<'b, B>,
    pub monitoring: MonitoringTask<'b, B>,
    pub control: ControlTask<'b, B>,
    pub degraded: DegradedTask,
    pub trajectory_input: TrajectoryInputTask<'b, B>,
    pub status: StatusTask<'b, B>,
    pub time: TimeTask<'b, B>,
    pub topics: TopicsTask<'b, B>,
}

impl<'b, B: Board> Tasks<'b, B> {
    /// Runs this task; see [`TaskBody::poll`].
    pub fn poll(&mut self, task: Core0Task, executor: &impl Executor<'b, B>) -> Instant {
        match task {
            Core0Task::Roles => self.roles.poll(executor),
            Core0Task::Monitoring => self.monitoring.poll(executor),
            Core0Task::Control => self.control.poll(executor),
            Core0Task::Degraded => self.degraded.poll(executor),
            Core0Task::TrajectoryInput => self.trajectory_input.poll(executor),
            Core0Task::Status => self.status.poll(executor),
            Core0Task::Time => self.time.poll(executor),
            Core0Task::Topics => self.topics.poll(executor),
        }
    }

    /// Moves the releases of this task; see [`TaskBody::shift`].
    pub fn shift(&mut self, task: Core0Task, executor: &impl Executor<'b, B>, by_ns: i64) {
        match task {
            Core0Task::Roles => self.roles.shift(executor, by_ns),
            Core0Task::Monitoring => self.monitoring.shift(executor, by_ns),
            Core0Task::Control => self.control.shift(executor, by_ns),
            Core0Task::Degraded => self.degraded.shift(executor, by_ns),
            Core0Task::TrajectoryInput => self.trajectory_input.shift(executor, by_ns),
            Core0Task::Status => self.status.shift(executor, by_ns),
            Core0Task::Time => self.time.shift(executor, by_ns),
            Core0Task::Topics => self.topics.shift(executor, by_ns),
        }
    }
}

/// Core 0 in parts, for an executor.
pub struct Parts<'b, B: Board> {
    /// The state that all tasks share.
    pub shared: SharedState<'b, B>,
    /// The state of the control cycle.
    pub drive: Driving,
    /// The tasks.
    pub tasks: Tasks<'b, B>,
}

impl<'b, B: Board> Parts<'b, B> {
    /// Starts the core's incarnation on this board: releases cores 1 and 2, and reads the state
    /// from the data flash (bounded time).
    #[must_use]
    pub fn new(board: &'b B, config: Config) -> Self {
        // T-BOOT-2. They start while this core reads its state.
        board.release_core(CoreId::PERCEPTION);
        board.release_core(CoreId::PLANNING);
        Self {
            shared: SharedState::new(board, config),
            drive: Driving::new(),
            tasks: Tasks {
                roles: RolesTask(board),
                monitoring: MonitoringTask::new(board, config),
                control: ControlTask(board),
                degraded: DegradedTask,
                trajectory_input: TrajectoryInputTask::new(board),
                status: StatusTask::new(board),
                time: TimeTask::new(board),
                topics: TopicsTask::new(board),
            },
        }
    }
}
