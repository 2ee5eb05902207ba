//! Where the kernel's and the port's trace events go.

use crate::port;
use crate::trace::{Event, EventKind, TraceSink};
use core::cell::UnsafeCell;
use core::ffi::c_void;
use core::ptr;
use core::sync::atomic::{AtomicPtr, Ordering};

struct Sink(UnsafeCell<Option<&'static dyn TraceSink>>);

// SAFETY: written while no scheduler runs, read on the core's thread only.
unsafe impl Sync for Sink {}

static SINK: Sink = Sink(UnsafeCell::new(None));

/// The kernel's C code calls only if this is not null.
#[unsafe(no_mangle)]
static tandem_trace_sink: AtomicPtr<c_void> = AtomicPtr::new(ptr::null_mut());

/// Sets or takes away the sink. The caller holds the kernel, and no scheduler runs.
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

fn record(kind: EventKind, subject: u32) {
    // SAFETY: written only while no scheduler runs.
    if let Some(sink) = unsafe { *SINK.0.get() } {
        sink.record(Event {
            at_ns: port::timestamp_ns(),
            kind,
            subject,
        });
    }
}

/// An event of a task.
#[unsafe(no_mangle)]
extern "C" fn tandem_trace(kind: u32, task: u32) {
    if let Some(kind) = EventKind::from_number(kind) {
        record(kind, task);
    }
}

pub(crate) fn interrupt_entered(number: u32) {
    record(EventKind::InterruptEntered, number);
}

pub(crate) fn interrupt_left(number: u32) {
    record(EventKind::InterruptLeft, number);
}

/// The kernel's counter for the time that tasks run.
#[unsafe(no_mangle)]
extern "C" fn tandem_run_time() -> u64 {
    port::run_time()
}
