//! The executor without a kernel: one pass runs all due tasks, each to its end.

use super::{Core0Task, Driving, Executor, Parts, SharedState, TaskSet, Tasks};
use crate::doorbell::{DoorbellThrottle, RingOutcome};
use crate::driving::parking::SocSample;
use crate::trace::{Begin, Event, Leaves};
use crate::{Config, Core};
use core::cell::{Cell, RefCell};
use tandem_board::{Board, Duration, Instant};
use tandem_redundancy::Phase;

/// Least distance between two passes that doorbells cause before this system has a role.
const START_DISTANCE: Duration = Duration::from_us(100);
/// Longer than the longest task, trajectory input: 0.3 ms on a core of 1 GHz without floating
/// point.
const LONGEST_TASK: Duration = Duration::from_us(500);

/// The shared state of tasks that run one after the other: no lock is needed.
struct OneFlow<'b, B: Board> {
    board: &'b B,
    shared: RefCell<SharedState<'b, B>>,
    drive: RefCell<Driving>,
    released: Cell<TaskSet>,
    doorbell: DoorbellThrottle,
}

impl<'b, B: Board> Executor<'b, B> for OneFlow<'b, B> {
    fn shared<R>(&self, body: impl FnOnce(&mut SharedState<'b, B>) -> R) -> R {
        body(&mut self.shared.borrow_mut())
    }

    fn drive<R>(&self, body: impl FnOnce(&mut Driving) -> R) -> R {
        body(&mut self.drive.borrow_mut())
    }

    fn release(&self, tasks: TaskSet) {
        self.released.set(self.released.get() | tasks);
    }

    fn held_back(&self) -> u32 {
        self.doorbell.held_back()
    }

    fn begins(&self, task: Core0Task, begin: Begin) {
        let task = task.info().code;
        self.board.trace(Event::TaskIn { task, begin }.encode());
    }

    fn ends(&self, task: Core0Task) {
        let task = task.info().code;
        let leaves = Leaves::Done;
        self.board.trace(Event::TaskOut { task, leaves }.encode());
    }
}

/// The control core without a kernel. Its tasks run to completion: of those that are due, the most
/// urgent first. The longest task delays every other one, but no takeover.
pub struct Core0<'b, B: Board> {
    executor: OneFlow<'b, B>,
    tasks: Tasks<'b, B>,
    /// When the next ring passes before this system has a role.
    start_opens: Instant,
    /// When each task is due, in the order of [`Core0Task::ALL`].
    due: [Instant; Core0Task::ALL.len()],
}

impl<'b, B: Board> Core0<'b, B> {
    /// Starts the core's incarnation on this board: reads the state from the data flash (bounded
    /// time).
    #[must_use]
    pub fn new(board: &'b B, config: Config) -> Self {
        let Parts {
            shared,
            drive,
            tasks,
        } = Parts::new(board, config);
        Self {
            executor: OneFlow {
                board,
                shared: RefCell::new(shared),
                drive: RefCell::new(drive),
                released: Cell::new(TaskSet::NONE),
                doorbell: DoorbellThrottle::default(),
            },
            tasks,
            start_opens: Instant::ORIGIN,
            due: [board.now(); Core0Task::ALL.len()],
        }
    }

    /// Takes a sample of the SoC, as [`Driving::on_soc`].
    pub fn on_soc(&mut self, at: Instant, sample: SocSample) {
        self.executor.drive(|drive| drive.on_soc(at, sample));
    }

    /// Returns until when this task must wait: a long one does not begin when the roles are due, or
    /// shortly before this system may have to take over.
    fn waits_for(&self, task: Core0Task, now: Instant) -> Option<Instant> {
        if task != Core0Task::TrajectoryInput {
            return None;
        }
        let redundancy = &self.executor.shared.borrow().redundancy;
        if redundancy.due() <= now {
            return Some(now);
        }
        let limit = redundancy.next_limit(now);
        (limit <= now + LONGEST_TASK).then_some(limit)
    }

    /// Returns the phase of this system, once the start protocol has begun.
    #[must_use]
    pub fn phase(&self) -> Option<Phase> {
        self.executor.shared.borrow().phase()
    }
}

impl<B: Board> Core for Core0<'_, B> {
    fn poll(&mut self) -> Instant {
        self.executor.released.set(TaskSet::NONE);
        let mut now = self.executor.board.now();
        let for_deadline = self.due.iter().any(|due| *due <= now);
        let doorbell = &self.executor.doorbell;
        let interrupted = if for_deadline {
            doorbell.may_have_rung(now)
        } else {
            doorbell.ring(now) == RingOutcome::Passes
        };
        // An edge of the start protocol is hardly held back: both systems then begin together.
        let is_starting = self.phase() == Some(Phase::Starting);
        let is_early = is_starting && !for_deadline && now < self.start_opens;
        if is_starting && !for_deadline && !is_early {
            self.start_opens = now + START_DISTANCE;
        }
        let interrupted = interrupted || is_starting && !is_early;
        // One pass is enough: tasks release only less urgent ones. A call cannot tell whether an
        // interrupt caused it, so the tasks of interrupts run at each call that the throttle
        // permits.
        for (index, task) in Core0Task::ALL.into_iter().enumerate() {
            let released = self.executor.released.get().contains(task)
                || (interrupted && task.info().is_for_interrupts());
            if released || self.due[index] <= now {
                if let Some(limit) = self.waits_for(task, now) {
                    self.due[index] = limit;
                    continue;
                }
                self.due[index] = self.tasks.poll(task, &self.executor);
                now = self.executor.board.now();
            }
        }
        // A later task may have given the redundancy an input that changes its deadline.
        self.due[0] = self.executor.shared.borrow().redundancy.due();
        let mut next = self.due.into_iter().min().unwrap_or(Instant::NEVER);
        if is_early {
            next = next.min(self.start_opens);
        }
        next.min(self.executor.doorbell.due())
    }
}
