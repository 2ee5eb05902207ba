//! An executor of core 0 that counts locked sections, and can preempt a job between two of them.

use std::cell::{Cell, RefCell};
use tandem_board::{Board, Duration};
use tandem_board_sim::{Poller, SimBoard};
use tandem_cores::Config;
use tandem_cores::core0::{
    Core0Task, Driving, Executor, MonitoringTask, Parts, RolesTask, SharedState, TaskBody, TaskSet,
    Tasks,
};
use tandem_cores::trace::{Begin, Event, Leaves};

/// The urgent tasks do not run for this long before a control job that they preempt.
const PAUSE: Duration = Duration::from_ms(3);

/// The tasks with a higher priority than control.
struct Urgent {
    roles: RolesTask<'static, SimBoard>,
    monitoring: MonitoringTask<'static, SimBoard>,
}

impl Urgent {
    fn poll(&mut self, executor: &OneFlow) {
        self.roles.poll(executor);
        self.monitoring.poll(executor);
    }
}

/// Runs the tasks of core 0 one after the other, every millisecond.
pub(crate) struct OneFlow {
    board: &'static SimBoard,
    shared: RefCell<SharedState<'static, SimBoard>>,
    drive: RefCell<Driving>,
    /// The tasks that others have released in this round.
    pub(crate) released: Cell<TaskSet>,
    /// Number of sections that the running task has begun.
    pub(crate) sections: Cell<u32>,
    /// Whether a job has begun since this was cleared.
    pub(crate) has_begun: Cell<bool>,
    /// The section of the running task before which the urgent tasks must run, and these tasks.
    preempts: RefCell<Option<(u32, Urgent)>>,
}

impl OneFlow {
    /// Starts core 0 with the profile rt. Also returns its tasks.
    pub(crate) fn start(board: &SimBoard) -> (Self, Tasks<'static, SimBoard>) {
        let board: &'static SimBoard = Box::leak(Box::new(board.clone()));
        let Parts {
            shared,
            drive,
            tasks,
        } = Parts::new(board, Config::rt());
        let executor = Self {
            board,
            shared: RefCell::new(shared),
            drive: RefCell::new(drive),
            released: Cell::new(TaskSet::NONE),
            sections: Cell::new(0),
            has_begun: Cell::new(false),
            preempts: RefCell::new(None),
        };
        (executor, tasks)
    }

    /// Counts the section that begins. If the urgent tasks are due before it, runs them first.
    fn section(&self) {
        self.sections.set(self.sections.get() + 1);
        let due = |(before, _): &mut (u32, Urgent)| *before == self.sections.get();
        let urgent = self.preempts.borrow_mut().take_if(due);
        if let Some((before, mut urgent)) = urgent {
            let state = (self.sections.get(), self.has_begun.get());
            urgent.poll(self);
            self.sections.set(state.0);
            self.has_begun.set(state.1);
            *self.preempts.borrow_mut() = Some((before, urgent));
        }
    }
}

impl Executor<'static, SimBoard> for OneFlow {
    fn shared<R>(&self, body: impl FnOnce(&mut SharedState<'static, SimBoard>) -> R) -> R {
        self.section();
        body(&mut self.shared.borrow_mut())
    }

    fn drive<R>(&self, body: impl FnOnce(&mut Driving) -> R) -> R {
        self.section();
        body(&mut self.drive.borrow_mut())
    }

    fn release(&self, tasks: TaskSet) {
        self.released.set(self.released.get() | tasks);
    }

    fn held_back(&self) -> u32 {
        0
    }

    fn begins(&self, task: Core0Task, begin: Begin) {
        self.has_begun.set(true);
        let task = task.info().code;
        self.board.trace(Event::TaskIn { task, begin }.encode());
    }

    fn ends(&self, task: Core0Task) {
        let (task, leaves) = (task.info().code, Leaves::Done);
        self.board.trace(Event::TaskOut { task, leaves }.encode());
    }
}

/// Creates core 0 with the profile rt. `runs` is called before each round, and returns whether the
/// tasks below monitoring run in it. With `preempts`, the urgent tasks run before this section of
/// a control job instead of before the job. `after` is called after each job of the control cycle.
pub(crate) fn core_0(
    board: &SimBoard,
    runs: impl Fn() -> bool + 'static,
    preempts: Option<u32>,
    after: impl Fn(Core0Task, &OneFlow) + 'static,
) -> Poller {
    let (executor, mut tasks) = OneFlow::start(board);
    let board = executor.board;
    let mut control_due = board.now();
    let mut urgent = Some(Urgent {
        roles: tasks.roles,
        monitoring: tasks.monitoring,
    });
    Box::new(move |_| {
        let now = board.now();
        executor.released.set(TaskSet::NONE);
        if let Some(before) = preempts.filter(|_| now >= control_due && runs()) {
            executor
                .preempts
                .replace(urgent.take().map(|it| (before, it)));
        }
        // Pause the urgent tasks before a control job, so that more of their events fall into it.
        let pauses = preempts.is_some() && control_due.since(now) <= PAUSE;
        if let Some(urgent) = urgent.as_mut().filter(|_| !pauses) {
            urgent.poll(&executor);
        }
        if runs() {
            let job = |task, poll: &mut dyn FnMut()| {
                executor.sections.set(0);
                executor.has_begun.set(false);
                poll();
                after(task, &executor);
            };
            job(Core0Task::Control, &mut || {
                control_due = tasks.control.poll(&executor);
            });
            if executor.released.get().contains(Core0Task::Degraded) {
                job(Core0Task::Degraded, &mut || {
                    tasks.degraded.poll(&executor);
                });
            }
            tasks.trajectory_input.poll(&executor);
            tasks.status.poll(&executor);
        }
        if let Some((_, it)) = executor.preempts.take() {
            urgent = Some(it);
        }
        if executor.released.get().contains(Core0Task::Control) {
            control_due = now;
        }
        now + Duration::from_ms(1)
    })
}
