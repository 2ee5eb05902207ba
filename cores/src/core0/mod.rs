//! Core 0: control every 10 ms, and all that its system says to the other one. T-CHIP-3, T-CHIP-7
//!
//! After a reset it first lets cores 1 and 2 come up, silently; then the start protocol begins.
//!
//! Its work is six tasks ([`Task`]). The body of each is a [`Job`] that does what is due and says
//! when it is due next; what they share they reach through a [`Seat`], which whoever runs them
//! provides. [`Core0`] runs them one after the other, each to its end: in the simulator and on
//! machines without an operating system. An RTOS gives each a task of its own ([`Parts`]);
//! `docs/rtos-tasks.md` has the priorities and why they are so.

mod alive;
mod drive;
mod frames;
mod jobs;
mod limits;
mod shared;

use crate::activity::TaskCode;
use crate::trace::{Begin, Event, Leaves};
use crate::{Config, Core};
use core::cell::{Cell, RefCell};
use core::ops::{BitOr, BitOrAssign};
pub use drive::Drive;
pub use jobs::{Control, Degraded, Follow, Monitoring, Roles, Status};
use limits::Throttle;
pub use limits::{CAN_FRAMES, DOORBELL_DISTANCE, EDGES_PER_MS, LINK_DATAGRAMS};
pub use shared::Shared;
use tandem_board::{Board, Duration, Instant};
use tandem_redundancy::Phase;

/// Period of the control task.
pub const CONTROL_PERIOD: Duration = Duration::from_ms(10);
pub(crate) const MONITORING_PERIOD: Duration = Duration::from_ms(5);
pub(crate) const STATUS_PERIOD: Duration = Duration::from_ms(100);

/// The tasks of core 0.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Task {
    /// Heartbeats, what has come from the other system, and the state machine of the roles.
    Roles,
    /// Window and functional watchdog, and the cores' alive counters.
    Monitoring,
    /// Motion control and the control frame.
    Control,
    /// The control cycle of a system that drives alone; [`Task::Control`] hands it over.
    Degraded,
    /// Fetches what cores 1 and 2 have published; core 2's signal releases it.
    Follow,
    /// The status frame.
    Status,
}

impl Task {
    /// All, in falling order of priority.
    pub const ALL: [Self; 6] = [
        Self::Roles,
        Self::Monitoring,
        Self::Control,
        Self::Degraded,
        Self::Follow,
        Self::Status,
    ];

    /// How the trace names it.
    #[must_use]
    pub const fn code(self) -> TaskCode {
        match self {
            Self::Roles => TaskCode::REDUNDANCY,
            Self::Monitoring => TaskCode::MONITORING,
            Self::Control => TaskCode::CONTROL,
            Self::Degraded => TaskCode::DEGRADED,
            Self::Follow => TaskCode::FOLLOW,
            Self::Status => TaskCode::STATUS,
        }
    }

    /// Whether an interrupt releases it: a doorbell, or an edge on a line.
    #[must_use]
    pub const fn is_for_interrupts(self) -> bool {
        matches!(self, Self::Roles | Self::Follow)
    }
}

/// A set of tasks that are to run now.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Woken(u8);

impl Woken {
    /// Nobody.
    pub const NONE: Self = Self(0);

    const fn by(task: Task) -> Self {
        Self(1 << task as u8)
    }

    /// Whether `task` is among them.
    #[must_use]
    pub const fn contains(self, task: Task) -> bool {
        self.0 & Self::by(task).0 != 0
    }
}

impl From<Task> for Woken {
    fn from(task: Task) -> Self {
        Self::by(task)
    }
}

impl BitOr for Woken {
    type Output = Self;

    fn bitor(self, other: Self) -> Self {
        Self(self.0 | other.0)
    }
}

impl BitOrAssign for Woken {
    fn bitor_assign(&mut self, other: Self) {
        self.0 |= other.0;
    }
}

/// What a job needs of whoever runs it.
pub trait Seat<'b, B: Board> {
    /// Runs `body` with what all tasks share; the others wait for it meanwhile. Neither nested nor
    /// within [`Seat::drive`].
    fn shared<R>(&self, body: impl FnOnce(&mut Shared<'b, B>) -> R) -> R;

    /// Runs `body` with the function that drives. Not nested.
    fn drive<R>(&self, body: impl FnOnce(&mut Drive) -> R) -> R;

    /// Releases tasks, all of them below the caller. Not within [`Seat::shared`].
    fn wake(&self, woken: Woken);

    /// How many times it has held back doorbells that rang within [`DOORBELL_DISTANCE`]; wraps
    /// around.
    fn held_back(&self) -> u32;

    /// A job of this task, the caller, begins. For the trace.
    fn begins(&self, task: Task, begin: Begin);

    /// The job is done.
    fn ends(&self, task: Task);
}

/// The body of a task.
pub trait Job<'b, B: Board> {
    /// Which.
    const TASK: Task;

    /// A periodic task's releases begin at `at`.
    fn start(&mut self, _at: Instant) {}

    /// Does what is due, and returns when it is due again at the latest; it may be called earlier.
    /// Blocks only in the seat's locks, never allocates.
    fn poll(&mut self, seat: &impl Seat<'b, B>) -> Instant;
}

/// The jobs of core 0, one of each.
#[allow(missing_docs, reason = "each is documented as its type")]
pub struct Jobs<'b, B: Board> {
    pub roles: Roles<'b, B>,
    pub monitoring: Monitoring<'b, B>,
    pub control: Control<'b, B>,
    pub degraded: Degraded<'b, B>,
    pub follow: Follow<'b, B>,
    pub status: Status<'b, B>,
}

/// Core 0 in parts, for who gives each job a task of its own.
pub struct Parts<'b, B: Board> {
    /// What all jobs share.
    pub shared: Shared<'b, B>,
    /// What the control cycle computes with.
    pub drive: Drive,
    /// The jobs.
    pub jobs: Jobs<'b, B>,
}

impl<'b, B: Board> Parts<'b, B> {
    /// Starts the core's life on this board: reads the state from the data flash (bounded time).
    #[must_use]
    pub fn new(board: &'b B, config: Config) -> Self {
        Self {
            shared: Shared::new(board, config),
            drive: Drive::new(),
            jobs: Jobs {
                roles: Roles(board),
                monitoring: Monitoring::new(board, config),
                control: Control(board),
                degraded: Degraded(board),
                follow: Follow::new(board),
                status: Status::new(board),
            },
        }
    }
}

/// The seat where all jobs run one after the other.
struct OneAtATime<'b, B: Board> {
    board: &'b B,
    shared: RefCell<Shared<'b, B>>,
    drive: RefCell<Drive>,
    woken: Cell<Woken>,
    doorbells: Cell<Throttle>,
}

impl<'b, B: Board> Seat<'b, B> for OneAtATime<'b, B> {
    fn shared<R>(&self, body: impl FnOnce(&mut Shared<'b, B>) -> R) -> R {
        body(&mut self.shared.borrow_mut())
    }

    fn drive<R>(&self, body: impl FnOnce(&mut Drive) -> R) -> R {
        body(&mut self.drive.borrow_mut())
    }

    fn wake(&self, woken: Woken) {
        self.woken.set(self.woken.get() | woken);
    }

    fn held_back(&self) -> u32 {
        self.doorbells.get().held_back()
    }

    fn begins(&self, task: Task, begin: Begin) {
        let task = task.code();
        self.board.trace(Event::TaskIn { task, begin }.encode());
    }

    fn ends(&self, task: Task) {
        let task = task.code();
        let leaves = Leaves::Done;
        self.board.trace(Event::TaskOut { task, leaves }.encode());
    }
}

/// The control core, whose tasks run to completion: of those that are due, that with the highest
/// priority first.
pub struct Core0<'b, B: Board> {
    seat: OneAtATime<'b, B>,
    jobs: Jobs<'b, B>,
    /// When each is due, as in [`Task::ALL`].
    due: [Instant; Task::ALL.len()],
}

impl<'b, B: Board> Core0<'b, B> {
    /// Starts the core's life on this board: reads the state from the data flash (bounded time).
    #[must_use]
    pub fn new(board: &'b B, config: Config) -> Self {
        let Parts {
            shared,
            drive,
            jobs,
        } = Parts::new(board, config);
        Self {
            seat: OneAtATime {
                board,
                shared: RefCell::new(shared),
                drive: RefCell::new(drive),
                woken: Cell::new(Woken::NONE),
                doorbells: Cell::new(Throttle::new(DOORBELL_DISTANCE)),
            },
            jobs,
            due: [board.now(); Task::ALL.len()],
        }
    }

    /// The phase of this system, once the start protocol has begun.
    #[must_use]
    pub fn phase(&self) -> Option<Phase> {
        self.seat.shared.borrow().phase()
    }

    fn run(&mut self, task: Task) -> Instant {
        let (jobs, seat) = (&mut self.jobs, &self.seat);
        match task {
            Task::Roles => jobs.roles.poll(seat),
            Task::Monitoring => jobs.monitoring.poll(seat),
            Task::Control => jobs.control.poll(seat),
            Task::Degraded => jobs.degraded.poll(seat),
            Task::Follow => jobs.follow.poll(seat),
            Task::Status => jobs.status.poll(seat),
        }
    }
}

impl<B: Board> Core for Core0<'_, B> {
    fn poll(&mut self) -> Instant {
        self.seat.woken.set(Woken::NONE);
        let now = self.seat.board.now();
        let for_deadline = self.due.iter().any(|due| *due <= now);
        let mut doorbells = self.seat.doorbells.get();
        let interrupted = doorbells.interrupt(now, !for_deadline);
        self.seat.doorbells.set(doorbells);
        // One pass: jobs release only tasks that stand after them. A call does not say whether an
        // interrupt has caused it, so the tasks of interrupts run at each call that the throttle
        // permits.
        for (index, task) in Task::ALL.into_iter().enumerate() {
            let woken =
                self.seat.woken.get().contains(task) || (interrupted && task.is_for_interrupts());
            if woken || self.due[index] <= self.seat.board.now() {
                self.due[index] = self.run(task);
            }
        }
        // What a later job told the redundancy may have changed when it wants to be asked.
        self.due[0] = self.seat.shared.borrow().redundancy_due;
        let next = self.due.into_iter().min().unwrap_or(Instant::NEVER);
        next.min(doorbells.due())
    }
}
