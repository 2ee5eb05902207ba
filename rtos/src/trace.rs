//! What the kernel did when, for who wants to see it.
#![allow(unsafe_code)]

pub(crate) fn interrupt_entered(_number: u32) {}
pub(crate) fn interrupt_left(_number: u32) {}

#[unsafe(no_mangle)]
static mut tandem_trace_sink: *mut core::ffi::c_void = core::ptr::null_mut();

#[unsafe(no_mangle)]
extern "C" fn tandem_trace(_kind: u32, _task: u32) {}

#[unsafe(no_mangle)]
extern "C" fn tandem_run_time() -> u64 {
    crate::port::run_time()
}
