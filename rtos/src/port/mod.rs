//! What differs between machines: switching, masking, interrupts, the tick.
#![allow(unsafe_code)]

#[cfg(target_os = "linux")]
pub mod host;
#[cfg(target_os = "linux")]
pub(crate) use host::{
    Stack, assert_may_block, attach, deferred as without_others, epoch, fatal, idle, in_task,
    prepare, run_time, run_time_span, start, tear_down, tick_origin_ns, timestamp_ns, virtual_work,
};

#[cfg(target_arch = "riscv32")]
pub mod riscv32;
#[cfg(target_arch = "riscv32")]
pub(crate) use riscv32::{
    Stack, assert_may_block, attach, epoch, fatal, idle, in_task, prepare, run_time, run_time_span,
    start, tear_down, tick_origin_ns, timestamp_ns, virtual_work, without_others,
};

use crate::sys;
use core::time::Duration;

/// Works for a span of the running task's own time.
pub(crate) fn burn(span: Duration) {
    if virtual_work(span) {
        return;
    }
    let begin = sys::task::own_run_time();
    while run_time_span(sys::task::own_run_time().saturating_sub(begin)) < span {
        core::hint::spin_loop();
    }
}
