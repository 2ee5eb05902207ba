//! The kernel's events with their times: switches, wake-ups and interrupts, and their sink.

use core::cell::UnsafeCell;
use core::ffi::c_void;
use core::ptr;
use core::sync::atomic::{AtomicPtr, Ordering};

/// The kind of an event.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum KernelEventKind {
    /// The kernel chose a task, possibly the one that ran before. The task starts or continues.
    SwitchedIn,
    /// The running task is switched out. The kernel may choose the same task again.
    SwitchedOut,
    /// A task became ready: it was woken or made, or its wait has ended.
    Ready,
    /// A handler starts. The subject is the interrupt's number; 63 is the host's tick. The target's
    /// tick is not reported.
    InterruptEntered,
    /// A handler has ended.
    InterruptLeft,
}

/// One event.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct KernelEvent {
    /// Time in nanoseconds: CLOCK_MONOTONIC or virtual time on the host, `mtime` on the target.
    pub at_ns: u64,
    /// The kind.
    pub kind: KernelEventKind,
    /// The task's number (see [`TaskStatistics`](crate::TaskStatistics)), or the interrupt's.
    pub subject: u32,
}

/// Receives the events. Tasks and handlers call it, and a handler may interrupt a call, so it must
/// not block, allocate or lock.
pub trait TraceSink: Sync {
    /// Records an event.
    fn record(&self, event: KernelEvent);
}

struct Sink(UnsafeCell<Option<&'static dyn TraceSink>>);

// SAFETY: written while no scheduler runs, read on the core's thread only.
unsafe impl Sync for Sink {}

static SINK: Sink = Sink(UnsafeCell::new(None));

/// The kernel's C code calls [`record`] only if this is not null.
#[unsafe(no_mangle)]
static tandem_trace_sink: AtomicPtr<c_void> = AtomicPtr::new(ptr::null_mut());

/// Sets or removes the sink. The caller holds the kernel, and no scheduler runs.
pub(crate) fn listen(sink: Option<&'static dyn TraceSink>) {
    let flag = if sink.is_some() {
        SINK.0.get().cast()
    } else {
        ptr::null_mut()
    };
    // SAFETY: no scheduler runs, so nothing reads it.
    unsafe { *SINK.0.get() = sink };
    tandem_trace_sink.store(flag, Ordering::Relaxed);
}

/// Passes an event to the sink, if there is one, with the time that `clock_ns` returns.
pub(crate) fn record(kind: KernelEventKind, subject: u32, clock_ns: fn() -> u64) {
    // SAFETY: written only while no scheduler runs.
    if let Some(sink) = unsafe { *SINK.0.get() } {
        sink.record(KernelEvent {
            at_ns: clock_ns(),
            kind,
            subject,
        });
    }
}
