//! Core 0 as tasks of FreeRTOS, over any board: one kernel task for each row of the task table.
//!
//! [`start`] is the whole interface. The board's clock must be the one that drives the kernel's
//! tick: CLOCK_MONOTONIC on the host, `mtime` on riscv32. Waits end with a tick, so releases lie on
//! ticks. All memory is taken from the heap before the kernel starts.
#![no_std]
#![forbid(unsafe_code)]

extern crate alloc;

mod trace;

use alloc::boxed::Box;
use core::cell::Cell;
use core::convert::Infallible;
use core::fmt;
use core::sync::atomic::{AtomicBool, AtomicU32, Ordering::Relaxed};
use tandem_board::{Board, Duration, Instant};
use tandem_cores::Config;
use tandem_cores::core0::{
    Core0Task, Driving, Executor, Parts, SharedState, TaskBody, TaskSet, Tasks,
};
use tandem_cores::doorbell::{DoorbellThrottle, RingOutcome};
use tandem_cores::release::TickGrid;
use tandem_cores::trace::{Begin, Event, Leaves};
use tandem_rtos::{
    HandlerError, Interrupt, InterruptContext, InterruptPriority, Kernel, Mutex, Priority,
    SpawnError, StartError, TaskContext, TaskHandle, TaskOptions, TickSource, Ticks,
};

/// A tick of the kernel.
const TICK: Duration = Duration::from_ms(1);
/// The longest wait, limited so that sums of ticks cannot overflow.
const LONGEST: Ticks = Ticks::from_millis(1000);
/// Time between two reports of a task about itself.
const REPORT_PERIOD: Duration = Duration::from_ms(1000);
/// Priority of the doorbell's interrupt: above the tick's.
const DOORBELL_PRIORITY: InterruptPriority = InterruptPriority::new(10);

/// When the doorbell has rung too early, this task waits until the least distance has passed. The
/// doorbell's other task, the roles, runs at every tick.
const DOORBELL_WAITER: Core0Task = Core0Task::TrajectoryInput;

/// Options that depend on the machine.
#[derive(Clone, Copy, Debug)]
pub struct RuntimeOptions {
    /// Bytes of each task's stack.
    pub stack_bytes: usize,
    /// Counts the rings that the machine holds back before they reach this core; wraps around.
    pub held_back: &'static AtomicU32,
    /// An overload, for tests.
    pub overload: Option<Overload>,
}

/// Makes some jobs longer than they should be, to test the other tasks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Overload {
    /// The task that is overloaded.
    pub task: Core0Task,
    /// Every `every`-th job is longer. At least 1.
    pub every: u32,
    /// How long the extra work takes, in CPU time of the task.
    pub span: core::time::Duration,
}

/// Core 0 does not run under the kernel.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RuntimeError {
    /// A task cannot be created.
    Spawn(Core0Task, SpawnError),
    /// The doorbell has another handler.
    Doorbell(HandlerError),
    /// The kernel does not start.
    Start(StartError),
    /// A task has stopped the kernel.
    Stopped,
}

impl fmt::Display for RuntimeError {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Spawn(task, error) => write!(out, "the task {}: {error}", task.info().name),
            Self::Doorbell(error) => write!(out, "the handler of the doorbell: {error}"),
            Self::Start(error) => error.fmt(out),
            Self::Stopped => out.write_str("the kernel has stopped"),
        }
    }
}

impl core::error::Error for RuntimeError {}

/// The state that all tasks share.
struct Runtime<B: Board + 'static> {
    board: &'static B,
    shared: Mutex<SharedState<'static, B>>,
    drive: Mutex<Driving>,
    /// Indexed by [`Core0Task`].
    states: [TaskState; Core0Task::ALL.len()],
    doorbell: DoorbellThrottle,
    options: RuntimeOptions,
}

/// A task's state for the trace, which distinguishes switches within a job from those between jobs.
#[derive(Default)]
struct TaskState {
    /// The kernel's number of the task.
    number: AtomicU32,
    in_job: AtomicBool,
    waits_for_lock: AtomicBool,
    /// The longest time for which it held a lock, ns.
    held_ns: AtomicU32,
}

impl<B: Board> Runtime<B> {
    fn state(&self, task: Core0Task) -> &TaskState {
        &self.states[task as usize]
    }

    fn trace(&self, event: Event) {
        self.board.trace(event.encode());
    }
}

/// Handles of the tasks created so far, indexed by [`Core0Task`].
type Handles = [Option<TaskHandle>; Core0Task::ALL.len()];

/// The executor of one task.
struct OfTask<'a, B: Board + 'static> {
    ctx: &'a TaskContext,
    runtime: &'static Runtime<B>,
    task: Core0Task,
    /// Handles of all less urgent tasks.
    below: Handles,
    /// Jobs until the next overloaded one.
    jobs_left: Cell<u32>,
}

impl<B: Board + Sync> OfTask<'_, B> {
    fn locked<T: Send, R>(&self, mutex: &Mutex<T>, body: impl FnOnce(&mut T) -> R) -> R {
        let (runtime, state) = (self.runtime, self.runtime.state(self.task));
        state.waits_for_lock.store(true, Relaxed);
        loop {
            // Without a limit the wait cannot time out; if it did, wait again.
            if let Ok(mut guard) = mutex.lock(self.ctx, Ticks::FOREVER) {
                state.waits_for_lock.store(false, Relaxed);
                let since = runtime.board.now();
                let result = body(&mut guard);
                drop(guard);
                let held = runtime.board.now().since(since);
                let held_ns = u32::try_from(held.as_ns()).unwrap_or(u32::MAX);
                if held_ns > state.held_ns.load(Relaxed) {
                    state.held_ns.store(held_ns, Relaxed);
                }
                return result;
            }
        }
    }

    /// Overruns this job if the overload selects it.
    fn overload(&self) {
        if let Some(overload) = self.runtime.options.overload
            && overload.task == self.task
        {
            let left = self.jobs_left.get();
            self.jobs_left.set(left.saturating_sub(1));
            if left == 0 {
                self.jobs_left.set(overload.every.saturating_sub(1));
                self.ctx.burn(overload.span);
            }
        }
    }
}

impl<B: Board + Sync> Executor<'static, B> for OfTask<'_, B> {
    fn shared<R>(&self, body: impl FnOnce(&mut SharedState<'static, B>) -> R) -> R {
        self.locked(&self.runtime.shared, body)
    }

    fn drive<R>(&self, body: impl FnOnce(&mut Driving) -> R) -> R {
        self.locked(&self.runtime.drive, body)
    }

    fn release(&self, tasks: TaskSet) {
        for (task, handle) in Core0Task::ALL.into_iter().zip(&self.below) {
            if let (true, Some(handle)) = (tasks.contains(task), handle) {
                // Fails only for a task that has ended, and this one never ends.
                let _ = handle.notify(self.ctx);
            }
        }
    }

    fn held_back(&self) -> u32 {
        let by_machine = self.runtime.options.held_back.load(Relaxed);
        by_machine.wrapping_add(self.runtime.doorbell.held_back())
    }

    fn begins(&self, task: Core0Task, begin: Begin) {
        self.ctx.critical(|| {
            let code = task.info().code;
            self.runtime.trace(Event::TaskIn { task: code, begin });
            self.runtime.state(self.task).in_job.store(true, Relaxed);
        });
    }

    fn ends(&self, task: Core0Task) {
        self.overload();
        self.ctx.critical(|| {
            let (task, leaves) = (task.info().code, Leaves::Done);
            self.runtime.trace(Event::TaskOut { task, leaves });
            self.runtime.state(self.task).in_job.store(false, Relaxed);
        });
    }
}

/// Returns for how many ticks a task waits until its deadline; `None` if that has passed. `count`
/// is the kernel's count of ticks, `ticks` are those with which the deadline was computed.
fn ticks_until(
    task: Core0Task,
    ticks: &TickGrid,
    count: Ticks,
    now: Instant,
    deadline: Instant,
) -> Option<Ticks> {
    if deadline.since(now) > Duration::from_ms(LONGEST.0.into()) {
        return Some(LONGEST);
    }
    // The kernel's count may be behind the clock, or beyond the due tick if the machine was stopped
    // since the clock was read. The count and the due tick wrap around after 49 days.
    let due = Ticks(ticks.number).after(Ticks(task.wakes(ticks, deadline) as u32));
    let left = count.until(due);
    match task {
        Core0Task::Roles => Some(left.max(Ticks(1))),
        _ => (deadline > now).then_some(left),
    }
}

/// Waits for a notification, but no longer than until the tick at which the kernel wakes the task
/// for `deadline`.
fn wait<B: Board + Sync>(executor: &OfTask<'_, B>, ticks: &TickGrid, deadline: Instant) {
    let (ctx, now) = (executor.ctx, executor.runtime.board.now());
    if let Some(left) = ticks_until(executor.task, ticks, ctx.now(), now, deadline) {
        ctx.take_notifications(left);
    }
}

/// Reads the ticks.
fn read_ticks(ctx: &TaskContext) -> TickGrid {
    let last = ctx.last_tick();
    TickGrid {
        number: last.count.0,
        origin: Instant::from_ns(last.due_ns),
        period: TICK,
    }
}

/// Moves the next tick and all later ones as the shared state wants.
fn steer<B: Board + Sync>(executor: &OfTask<'_, B>, ticks: TickGrid) {
    let by_ns = executor.shared(|shared| shared.tick_correction(ticks));
    if by_ns != 0 {
        // Refused if this task is late; the correction after the next tick makes up for it.
        let _is_moved = executor.ctx.shift_ticks(by_ns);
    }
}

/// Traces how much of its stack the task has used, and the longest time for which it held a lock.
fn report<B: Board + Sync>(executor: &OfTask<'_, B>) {
    let state = executor.runtime.state(executor.task);
    let longest_ns = state.held_ns.load(Relaxed);
    let free_bytes = u32::try_from(executor.ctx.unused_stack_bytes()).unwrap_or(u32::MAX);
    let task = executor.task.info().code;
    executor.runtime.trace(Event::Stack { task, free_bytes });
    executor.runtime.trace(Event::Held { task, longest_ns });
}

/// The loop of a task.
fn run<B: Board + Sync>(executor: &OfTask<'_, B>, task: &mut impl TaskBody<'static, B>) {
    let board = executor.runtime.board;
    let mut ticks = read_ticks(executor.ctx);
    task.start(ticks.floor(board.now()));
    if executor.task == Core0Task::Control {
        executor.shared(|shared| shared.set_ticks(ticks));
    }
    let mut report_at = board.now() + REPORT_PERIOD;
    let mut is_new_tick = true;
    loop {
        let deadline = task.poll(executor);
        if executor.task == Core0Task::Roles && is_new_tick {
            steer(executor, ticks);
        }
        let now = board.now();
        if now >= report_at {
            report_at = now + REPORT_PERIOD;
            report(executor);
        }
        wait(executor, &ticks, deadline);
        if executor.task == DOORBELL_WAITER {
            wait_for_doorbell(executor);
        }
        let before = core::mem::replace(&mut ticks, read_ticks(executor.ctx));
        is_new_tick = ticks.number != before.number;
        let moved_ns = before.moved_ns(&ticks);
        if moved_ns != 0 {
            task.shift(executor, moved_ns);
        }
    }
}

/// If a ring is held back, waits until it passes.
fn wait_for_doorbell<B: Board + Sync>(executor: &OfTask<'_, B>) {
    let (doorbell, board) = (&executor.runtime.doorbell, executor.runtime.board);
    loop {
        // The handler of the doorbell uses the throttle too.
        let due = executor.ctx.critical(|| {
            doorbell.pass_if_due(board.now());
            doorbell.due()
        });
        if due == Instant::NEVER {
            return;
        }
        wait(executor, &read_ticks(executor.ctx), due);
    }
}

/// Creates a task. All less urgent tasks already exist.
fn spawn<B, T>(
    kernel: &Kernel,
    runtime: &'static Runtime<B>,
    made: &mut Handles,
    body: T,
) -> Result<(), RuntimeError>
where
    B: Board + Sync + 'static,
    T: TaskBody<'static, B> + Send + 'static,
{
    let task = T::ID;
    let info = task.info();
    let options = TaskOptions::new(info.name, Priority::new(info.priority))
        .stack_bytes(runtime.options.stack_bytes);
    let below = made.clone();
    // On the heap: a body that the entry owned would be copied to the task's stack.
    let mut body = Box::new(body);
    let entry = move |ctx: &TaskContext| {
        let executor = OfTask {
            ctx,
            runtime,
            task,
            below,
            jobs_left: Cell::new(runtime.options.overload.map_or(0, |it| it.every)),
        };
        run(&executor, &mut *body);
    };
    let handle = kernel.spawn(&options, entry);
    let handle = handle.map_err(|error| RuntimeError::Spawn(task, error))?;
    let number = handle.number(kernel).unwrap_or(0);
    runtime.state(task).number.store(number, Relaxed);
    made[task as usize] = Some(handle);
    Ok(())
}

/// Runs core 0 under the kernel. Returns only if it cannot start, or stops.
///
/// `on_doorbell` is called in each interrupt of the doorbell, before anything else.
///
/// # Errors
/// [`RuntimeError`]
pub fn start<B: Board + Sync>(
    kernel: Kernel,
    board: &'static B,
    config: Config,
    options: RuntimeOptions,
    mut on_doorbell: impl FnMut() + Send + 'static,
) -> Result<Infallible, RuntimeError> {
    let Parts {
        shared,
        drive,
        tasks,
    } = Parts::new(board, config);
    let runtime: &'static Runtime<B> = Box::leak(Box::new(Runtime {
        board,
        shared: Mutex::new(&kernel, shared),
        drive: Mutex::new(&kernel, drive),
        states: Default::default(),
        doorbell: DoorbellThrottle::default(),
        options,
    }));
    let Tasks {
        roles,
        monitoring,
        control,
        degraded,
        trajectory_input,
        status,
        time,
        topics,
    } = tasks;
    // The least urgent first: a task releases only less urgent ones.
    let mut made = Handles::default();
    spawn(&kernel, runtime, &mut made, topics)?;
    spawn(&kernel, runtime, &mut made, time)?;
    spawn(&kernel, runtime, &mut made, status)?;
    spawn(&kernel, runtime, &mut made, trajectory_input)?;
    spawn(&kernel, runtime, &mut made, degraded)?;
    spawn(&kernel, runtime, &mut made, control)?;
    spawn(&kernel, runtime, &mut made, monitoring)?;
    spawn(&kernel, runtime, &mut made, roles)?;
    let interrupt = move |ctx: &InterruptContext| {
        on_doorbell();
        let outcome = runtime.doorbell.ring(board.now());
        for (task, handle) in Core0Task::ALL.into_iter().zip(&made) {
            let released = match outcome {
                RingOutcome::Passes => task.info().is_for_interrupts(),
                RingOutcome::HeldBack => task == DOORBELL_WAITER,
                RingOutcome::Merged => false,
            };
            if let (true, Some(handle)) = (released, handle) {
                // Fails only for a task that has ended, and this one never ends.
                let _ = handle.notify(ctx);
            }
        }
    };
    kernel
        .attach(Interrupt::DOORBELL, DOORBELL_PRIORITY, interrupt)
        .map_err(RuntimeError::Doorbell)?;
    kernel.trace(runtime);
    kernel
        .start(TickSource::Wall)
        .map_err(RuntimeError::Start)?;
    Err(RuntimeError::Stopped)
}

#[cfg(test)]
mod tests;
