//! The host port: all tasks of the core in one thread, interrupts as signals to it.

mod exclusive;
mod fault;
mod interrupts;
#[cfg(target_env = "gnu")]
mod malloc;
mod process;
mod scheduler;
mod signals;
mod stack;
mod state;
mod switch;
mod tick;

pub use exclusive::{TaskAllocator, deferred};
pub use interrupts::raise;
pub use tick::{caught_up, elapsed_ns, now_ns, observe as observe_ticks};
pub(crate) use tick::{
    run_time, run_time_span, set_next_tick, tick_times_ns, timestamp_ns, virtual_work,
};

pub(crate) use interrupts::attach;
pub(crate) use process::fatal;
pub(crate) use scheduler::idle;
pub(crate) use stack::Stack;
pub(crate) use state::{assert_may_block, epoch, in_task};

use super::{StartError, TickSource};
use crate::ffi;
use process::errno;
use std::sync::mpsc;
use std::thread;

/// Called before the first task is made.
pub(crate) fn prepare() {}

/// Bytes of the stack of the kernel's thread, which only starts and ends the scheduler.
const THREAD_STACK_BYTES: usize = 64 << 10;

/// Runs the scheduler on a separate thread until all tasks have returned or one stops the
/// scheduler; `none_left` returns whether all have returned.
///
/// An abandoned task may have lent a thread-local of that thread to another thread. The loan ends
/// when the lending call returns, which it never does. Therefore the thread never ends after a
/// stop, and its thread-locals are never dropped.
pub(crate) fn start(clock: TickSource, none_left: fn() -> bool) -> Result<(), StartError> {
    #[cfg(target_env = "gnu")]
    malloc::keep();
    if !exclusive::is_installed() {
        return Err(StartError::Allocator);
    }
    fault::name_panics();
    let (stopped, stop) = mpsc::channel();
    let scheduling = Scheduling::of_this_thread();
    let life = move || {
        scheduling.apply()?;
        run(clock)?;
        if !none_left() {
            let _ = stopped.send(());
            loop {
                thread::park();
            }
        }
        Ok(())
    };
    let thread = thread::Builder::new()
        .name("kernel".into())
        .stack_size(THREAD_STACK_BYTES)
        .spawn(life)
        .map_err(|error| StartError::System(error.raw_os_error().unwrap_or(libc::EAGAIN)))?;
    match stop.recv() {
        Ok(()) => Ok(()),
        // The thread has ended. Its thread-locals are dropped before this call returns.
        Err(mpsc::RecvError) => match thread.join() {
            Ok(ran) => ran.map_err(StartError::System),
            Err(panic) => std::panic::resume_unwind(panic),
        },
    }
}

/// The scheduling of a thread. A new thread does not inherit real-time priority that was claimed
/// with SCHED_RESET_ON_FORK.
#[derive(Clone, Copy)]
struct Scheduling {
    policy: i32,
    param: libc::sched_param,
}

impl Scheduling {
    fn of_this_thread() -> Self {
        let mut param = libc::sched_param { sched_priority: 0 };
        // SAFETY: 0 is the calling thread; the variable is written during the call.
        let policy = unsafe {
            libc::sched_getparam(0, &mut param);
            libc::sched_getscheduler(0)
        };
        Self { policy, param }
    }

    /// Applies this scheduling to the calling thread, if it is a real-time one.
    fn apply(self) -> Result<(), i32> {
        // SAFETY: 0 is the calling thread; the variable is read during the call.
        let refused = self.param.sched_priority > 0
            && unsafe { libc::sched_setscheduler(0, self.policy, &self.param) } != 0;
        if refused { Err(errno()) } else { Ok(()) }
    }
}

fn run(clock: TickSource) -> Result<(), i32> {
    let before = fault::begin()?;
    let ran = run_with_faults_named(clock);
    fault::end(&before);
    ran
}

fn run_with_faults_named(clock: TickSource) -> Result<(), i32> {
    tick::prepare(clock)?;
    if let Err(errno) = interrupts::begin() {
        tick::end();
        return Err(errno);
    }
    // SAFETY: called once for each life of the kernel: `Kernel::start` consumes the kernel.
    unsafe { ffi::vTaskStartScheduler() };
    signals::end();
    tick::end();
    Ok(())
}

/// Ends the scheduler from within a task.
pub(crate) fn stop() -> ! {
    scheduler::leave()
}

/// Called when the scheduler has ended or was never started. Its tasks are abandoned.
pub(crate) fn tear_down() {
    interrupts::detach_all();
    scheduler::reset();
}
