//! The host port: all tasks of the core in one thread, interrupts as signals to it.

mod exclusive;
mod fault;
mod interrupts;
#[cfg(target_env = "gnu")]
mod malloc;
mod stack;
mod state;
mod switch;
mod tick;

pub use exclusive::{Output, TaskAllocator, deferred, print};
pub use interrupts::raise;
pub use tick::{TickStatistics, elapsed_ns, now_ns, observe as observe_ticks, statistics};
pub(crate) use tick::{run_time, run_time_span, timestamp_ns, virtual_work};

pub(crate) use interrupts::attach;
pub(crate) use stack::{MIN_STACK_WORDS, Stack, idle};
pub(crate) use state::{assert_may_block, epoch, in_task};

use crate::kernel::{Clock, StartError};
use crate::sys::{self, ffi};
use core::fmt::{self, Write};

/// Before the first task is made.
pub(crate) fn prepare() {}

/// Runs the scheduler until a task stops it.
pub(crate) fn start(clock: Clock) -> Result<(), StartError> {
    if !exclusive::is_installed() {
        return Err(StartError::Allocator);
    }
    fault::name_panics();
    let before = fault::begin().map_err(StartError::System)?;
    let ran = run(clock).map_err(StartError::System);
    fault::end(&before);
    ran
}

fn run(clock: Clock) -> Result<(), i32> {
    tick::prepare(clock)?;
    if let Err(errno) = interrupts::begin() {
        tick::end();
        return Err(errno);
    }
    // SAFETY: called once for each life of the kernel: `Kernel::start` consumes the kernel.
    unsafe { ffi::vTaskStartScheduler() };
    interrupts::end();
    tick::end();
    Ok(())
}

/// Ends the scheduler from within a task.
pub(crate) fn stop() -> ! {
    state::leave()
}

/// After the scheduler, or without one.
pub(crate) fn tear_down() {
    sys::task::abandon_all();
    interrupts::detach_all();
    state::reset();
}

/// Runs `body` and leaves `errno` as it was: tasks share it, since they share their thread.
fn keeping_errno<R>(body: impl FnOnce() -> R) -> R {
    // SAFETY: the address of this thread's errno; all tasks are on this thread.
    let errno = unsafe { *libc::__errno_location() };
    let result = body();
    // SAFETY: as above.
    unsafe { *libc::__errno_location() = errno };
    result
}

fn errno() -> i32 {
    // SAFETY: the address of this thread's errno.
    unsafe { *libc::__errno_location() }
}

/// Bytes of a message without an allocator, with its line end; more is cut.
const LAST_WORDS: usize = 512;

/// Text without an allocator, for the last words of a process.
struct LastWords {
    text: [u8; LAST_WORDS],
    length: usize,
}

impl Write for LastWords {
    fn write_str(&mut self, part: &str) -> fmt::Result {
        let part = part.as_bytes();
        let taken = part.len().min(self.text.len() - 1 - self.length);
        self.text[self.length..][..taken].copy_from_slice(&part[..taken]);
        self.length += taken;
        Ok(())
    }
}

/// Prints a line without allocating or locking.
fn print_raw(descriptor: i32, message: fmt::Arguments<'_>) {
    let mut words = LastWords {
        text: [0; LAST_WORDS],
        length: 0,
    };
    let _ = words.write_fmt(message);
    words.text[words.length] = b'\n';
    // SAFETY: writes from a valid buffer; async-signal-safe.
    unsafe { libc::write(descriptor, words.text.as_ptr().cast(), words.length + 1) };
}

/// Ends the process with a message. Callable from everywhere, handlers of signals included.
pub(crate) fn fatal(message: fmt::Arguments<'_>) -> ! {
    state::mask_for_good();
    print_raw(2, format_args!("tandem-rtos: {message}"));
    // SAFETY: ends the process; nothing of it goes on.
    unsafe { libc::abort() }
}
