//! Core 0 of a run: its jobs as tasks of FreeRTOS, in one thread of the process.
//!
//! The doorbell is a futex, which a thread of its own waits at; it raises the doorbell's interrupt,
//! whose handler wakes the tasks that interrupts release. Waits end with a tick, so releases are
//! laid on ticks.

use std::sync::OnceLock;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering::Relaxed};
use std::thread;

use anyhow::Context as _;
use tandem_board::{Board, Duration, Instant, Wake};
use tandem_board_host::HostBoard;
use tandem_board_host::realtime::{self, Claim, Grant};
use tandem_cores::Config;
use tandem_cores::core0::{
    DOORBELL_DISTANCE, Drive, Executor, Parts, Shared, Task, TaskId, TaskSet, Tasks,
};
use tandem_cores::schedule::TickGrid;
use tandem_cores::task_table::IrqCode;
use tandem_cores::trace::{Begin, Event, Leaves};
use tandem_rtos::{
    Clock, EventKind, Interrupt, InterruptPriority, Kernel, Mutex, Priority, TaskContext,
    TaskHandle, TaskOptions, Ticks, TraceSink, host,
};

type SharedState = Shared<'static, HostBoard>;

/// A tick of the kernel.
const TICK: Duration = Duration::from_ms(1);
/// No wait is longer, so that sums of ticks cannot overflow.
const LONGEST: Ticks = Ticks::from_millis(1000);
/// Bytes of a task's stack.
const STACK_BYTES: usize = 64 << 10;
/// Time between two reports of a task on itself.
const REPORT_PERIOD: Duration = Duration::from_ms(1000);

/// Rate-monotonic: see `docs/rtos-tasks.md`.
const fn priority(task: TaskId) -> Priority {
    Priority::new(match task {
        TaskId::Roles => 12,
        TaskId::Monitoring => 10,
        TaskId::Control => 8,
        TaskId::Degraded => 7,
        TaskId::TrajectoryInput => 5,
        TaskId::Status => 3,
    })
}

const fn name(task: TaskId) -> &'static str {
    match task {
        TaskId::Roles => "roles",
        TaskId::Monitoring => "monitoring",
        TaskId::Control => "control",
        TaskId::Degraded => "degraded",
        TaskId::TrajectoryInput => "trajectory",
        TaskId::Status => "status",
    }
}

/// What all tasks reach.
struct Common {
    board: &'static HostBoard,
    shared: Mutex<SharedState>,
    drive: Mutex<Drive>,
    /// In the order of [`TaskId::ALL`]; complete before the first task runs.
    handles: [OnceLock<TaskHandle>; TaskId::ALL.len()],
    jobs: [JobState; TaskId::ALL.len()],
    /// See [`Executor::held_back`].
    held_back: AtomicU32,
}

/// What the trace has to know of a task, to tell switches within a job from those between jobs.
#[derive(Default)]
struct JobState {
    /// As the kernel numbers it.
    number: AtomicU32,
    under_way: AtomicBool,
    waits_for_lock: AtomicBool,
    /// The longest time in which it held a lock, ns.
    held_ns: AtomicU32,
}

impl Common {
    fn trace(&self, event: Event) {
        self.board.trace(event.encode());
    }
}

/// What the kernel's hooks tell, in the words of the cores' trace. Between two jobs a task only
/// waits for the next, which is no news; the kernel's own tasks are not told.
impl TraceSink for Common {
    fn record(&self, event: tandem_rtos::Event) {
        let irq = if event.subject == u32::from(Interrupt::DOORBELL.number()) {
            IrqCode::DOORBELL
        } else {
            IrqCode::TICK
        };
        match event.kind {
            EventKind::InterruptEntered => return self.trace(Event::IrqIn { irq }),
            EventKind::InterruptLeft => return self.trace(Event::IrqOut { irq }),
            EventKind::SwitchedIn | EventKind::SwitchedOut | EventKind::Ready => {}
        }
        let is_it = |task: &TaskId| {
            let number = self.jobs[*task as usize].number.load(Relaxed);
            number == event.subject
        };
        let Some(of) = TaskId::ALL.into_iter().find(is_it) else {
            return;
        };
        let (job, task) = (&self.jobs[of as usize], of.info().code);
        let under_way = job.under_way.load(Relaxed);
        match event.kind {
            EventKind::SwitchedIn if under_way => {
                let begin = Begin::Goes;
                self.trace(Event::TaskIn { task, begin });
            }
            EventKind::SwitchedOut if under_way => {
                let leaves = if job.waits_for_lock.load(Relaxed) {
                    Leaves::Blocked
                } else {
                    Leaves::Preempted
                };
                self.trace(Event::TaskOut { task, leaves });
            }
            // The signal of core 2 is the release of the other one.
            EventKind::Ready if !under_way && of != TaskId::TrajectoryInput => {
                self.trace(Event::Ready { task });
            }
            _ => {}
        }
    }
}

/// The executor of a task of the kernel.
struct OfTask<'a> {
    ctx: &'a TaskContext,
    common: &'static Common,
    task: TaskId,
}

impl OfTask<'_> {
    fn locked<T: Send, R>(&self, mutex: &Mutex<T>, body: impl FnOnce(&mut T) -> R) -> R {
        let job = &self.common.jobs[self.task as usize];
        job.waits_for_lock.store(true, Relaxed);
        loop {
            // Without a limit it cannot be over; were it so, the wait goes on.
            if let Ok(mut guard) = mutex.lock(self.ctx, Ticks::FOREVER) {
                job.waits_for_lock.store(false, Relaxed);
                let since = host::now_ns();
                let result = body(&mut guard);
                drop(guard);
                let held_ns = u32::try_from(host::now_ns() - since).unwrap_or(u32::MAX);
                if held_ns > job.held_ns.load(Relaxed) {
                    job.held_ns.store(held_ns, Relaxed);
                }
                return result;
            }
        }
    }
}

impl Executor<'static, HostBoard> for OfTask<'_> {
    fn shared<R>(&self, body: impl FnOnce(&mut SharedState) -> R) -> R {
        self.locked(&self.common.shared, body)
    }

    fn drive<R>(&self, body: impl FnOnce(&mut Drive) -> R) -> R {
        self.locked(&self.common.drive, body)
    }

    fn release(&self, woken: TaskSet) {
        for task in TaskId::ALL {
            if woken.contains(task)
                && let Some(handle) = self.common.handles[task as usize].get()
            {
                // It never ends.
                let _ = handle.notify(self.ctx);
            }
        }
    }

    fn held_back(&self) -> u32 {
        self.common.held_back.load(Relaxed)
    }

    fn begins(&self, task: TaskId, begin: Begin) {
        self.ctx.critical(|| {
            let task = task.info().code;
            self.common.trace(Event::TaskIn { task, begin });
            self.common.jobs[self.task as usize]
                .under_way
                .store(true, Relaxed);
        });
    }

    fn ends(&self, task: TaskId) {
        self.ctx.critical(|| {
            let (task, leaves) = (task.info().code, Leaves::Done);
            self.common.trace(Event::TaskOut { task, leaves });
            self.common.jobs[self.task as usize]
                .under_way
                .store(false, Relaxed);
        });
    }
}

/// The kernel's ticks.
fn ticks(ctx: &TaskContext) -> TickGrid {
    TickGrid {
        origin: Instant::from_ns(ctx.tick_origin_ns()),
        period: TICK,
    }
}

/// Waits for a notification, at the longest until the tick at which `deadline` has come.
///
/// The roles are asked at each tick: at the one before, if the deadline lies between two, since a
/// heartbeat is rather asked for in vain than late by a tick.
fn wait(ctx: &TaskContext, ticks: &TickGrid, task: TaskId, deadline: Instant) {
    let now = ticks.before(Instant::from_ns(host::now_ns()));
    let due = match task {
        TaskId::Roles => ticks.before(deadline).max(now + 1),
        _ => ticks.after(deadline),
    };
    let far = due.saturating_sub(now) > u64::from(LONGEST.0);
    // The kernel's count may be behind the clock, and both wrap around after 49 days.
    let left = Ticks(due as u32).since(ctx.now());
    if far {
        ctx.take_notifications(LONGEST);
    } else if due > now {
        ctx.take_notifications(left.min(LONGEST));
    }
}

/// Tells how much of its stack the task needs, and for how long it keeps others waiting.
fn report(ctx: &TaskContext, common: &Common, task: TaskId) {
    let longest_ns = common.jobs[task as usize].held_ns.load(Relaxed);
    let free_bytes = u32::try_from(ctx.unused_stack_bytes()).unwrap_or(u32::MAX);
    let task = task.info().code;
    common.trace(Event::Stack { task, free_bytes });
    common.trace(Event::Held { task, longest_ns });
}

/// The life of a task.
fn run(
    ctx: &TaskContext,
    common: &'static Common,
    mut job: impl Task<'static, HostBoard>,
    task: TaskId,
) {
    let executor = OfTask { ctx, common, task };
    let ticks = ticks(ctx);
    job.start(ticks.floor(common.board.now()));
    if task == TaskId::Roles {
        executor.shared(|shared| shared.set_ticks(ticks));
    }
    let mut report_at = common.board.now() + REPORT_PERIOD;
    loop {
        let deadline = job.poll(&executor);
        let now = common.board.now();
        if now >= report_at {
            report_at = now + REPORT_PERIOD;
            report(ctx, common, task);
        }
        wait(ctx, &ticks, task, deadline);
    }
}

fn spawn<J>(kernel: &Kernel, common: &'static Common, job: J) -> anyhow::Result<()>
where
    J: Task<'static, HostBoard> + Send + 'static,
{
    let task = J::ID;
    let options = TaskOptions::new(name(task), priority(task)).stack_bytes(STACK_BYTES);
    let handle = kernel
        .spawn(&options, move |ctx| run(ctx, common, job, task))
        .with_context(|| format!("the task {}", name(task)))?;
    let number = handle.number(kernel).unwrap_or(0);
    common.jobs[task as usize].number.store(number, Relaxed);
    let _ = common.handles[task as usize].set(handle);
    Ok(())
}

/// Runs core 0 until its supply ends it.
///
/// # Errors
/// If the kernel cannot start.
pub(crate) fn go(board: HostBoard, config: Config, grant: Grant) -> anyhow::Result<()> {
    let board: &'static HostBoard = Box::leak(Box::new(board));
    let kernel = Kernel::take()?;
    let Parts {
        shared,
        drive,
        tasks,
    } = Parts::new(board, config);
    let common: &'static Common = Box::leak(Box::new(Common {
        board,
        shared: Mutex::new(&kernel, shared),
        drive: Mutex::new(&kernel, drive),
        handles: Default::default(),
        jobs: Default::default(),
        held_back: AtomicU32::new(0),
    }));
    let Tasks {
        roles,
        monitoring,
        control,
        degraded,
        trajectory_input,
        status,
    } = tasks;
    spawn(&kernel, common, roles)?;
    spawn(&kernel, common, monitoring)?;
    spawn(&kernel, common, control)?;
    spawn(&kernel, common, degraded)?;
    spawn(&kernel, common, trajectory_input)?;
    spawn(&kernel, common, status)?;
    kernel.attach(
        Interrupt::DOORBELL,
        InterruptPriority::new(10),
        move |ctx| {
            let wanted = TaskId::ALL
                .into_iter()
                .filter(|task| task.info().is_for_interrupts());
            for handle in wanted.filter_map(|task| common.handles[task as usize].get()) {
                // It never ends.
                let _ = handle.notify(ctx);
            }
        },
    )?;
    thread::Builder::new()
        .name("doorbell".to_owned())
        .spawn(move || listen(common, grant))
        .context("the thread at the doorbell")?;
    kernel.trace(common);
    kernel.start(Clock::Wall)?;
    anyhow::bail!("the kernel has stopped")
}

/// Raises the core's interrupt when its doorbell rings, at most once in [`DOORBELL_DISTANCE`].
///
/// This thread is more urgent than the core. It sleeps after each ring, so a doorbell that rings
/// without a pause cannot take the CPU from the core. Rings in that time are merged into one.
fn listen(common: &Common, grant: Grant) -> ! {
    // More urgent than the core, whose task it is to interrupt; the CPU is inherited.
    let _ = realtime::claim(Claim {
        priority: grant.fifo.map(|priority| priority.saturating_add(1)),
        cpu: None,
        lock_memory: false,
    });
    loop {
        common.board.wait(Instant::NEVER);
        loop {
            host::raise(Interrupt::DOORBELL);
            thread::sleep(core::time::Duration::from_nanos(DOORBELL_DISTANCE.as_ns()));
            // Does not wait: the deadline has passed.
            if common.board.wait(Instant::ORIGIN) == Wake::Deadline {
                break;
            }
            common.held_back.fetch_add(1, Relaxed);
        }
    }
}
