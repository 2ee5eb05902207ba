//! Functions and types of the kernel as the C compiler sees them; `kernel/shim.c` checks the
//! widths.

#![allow(dead_code, reason = "each target uses its part")]

use core::ffi::{c_char, c_void};

include!(concat!(env!("OUT_DIR"), "/sizes.rs"));

pub(crate) type Base = isize;
pub(crate) type UBase = usize;
pub(crate) type Tick = u32;

pub(crate) const PASS: Base = 1;
/// Values of `eNotifyAction`.
pub(crate) const NOTIFY_SET_BITS: core::ffi::c_uint = 1;
pub(crate) const NOTIFY_INCREMENT: core::ffi::c_uint = 2;

/// The first field of a task control block is the stack pointer of a task that does not run.
#[repr(C)]
pub(crate) struct Tcb {
    #[cfg(target_os = "linux")]
    pub(crate) top_of_stack: *mut usize,
    _opaque: [u8; 0],
}

unsafe extern "C" {
    pub(crate) static pxCurrentTCB: *mut Tcb;

    pub(crate) fn tandem_enter_critical();
    pub(crate) fn tandem_exit_critical();
    pub(crate) fn tandem_yield();
    pub(crate) fn tandem_yield_from_interrupt(woken: Base);
    pub(crate) fn tandem_minimal_stack_words() -> UBase;

    pub(crate) fn vTaskStartScheduler();
    pub(crate) fn vTaskResetState();
    pub(crate) fn vTimerResetState();
    pub(crate) fn vTaskSwitchContext();
    pub(crate) fn xTaskIncrementTick() -> Base;
    pub(crate) fn xTaskCreateStatic(
        code: extern "C" fn(*mut c_void),
        name: *const c_char,
        stack_words: usize,
        parameters: *mut c_void,
        priority: UBase,
        stack: *mut usize,
        tcb: *mut c_void,
    ) -> *mut Tcb;
    pub(crate) fn vTaskDelete(task: *mut Tcb);
    pub(crate) fn vTaskDelay(ticks: Tick);
    pub(crate) fn xTaskDelayUntil(previous: *mut Tick, increment: Tick) -> Base;
    pub(crate) fn xTaskGetTickCount() -> Tick;
    pub(crate) fn xTaskGetTickCountFromISR() -> Tick;
    pub(crate) fn pcTaskGetName(task: *mut Tcb) -> *const c_char;
    pub(crate) fn xTaskGenericNotify(
        task: *mut Tcb,
        index: UBase,
        value: u32,
        action: core::ffi::c_uint,
        previous: *mut u32,
    ) -> Base;
    pub(crate) fn xTaskGenericNotifyFromISR(
        task: *mut Tcb,
        index: UBase,
        value: u32,
        action: core::ffi::c_uint,
        previous: *mut u32,
        woken: *mut Base,
    ) -> Base;
    pub(crate) fn ulTaskGenericNotifyTake(index: UBase, clear: Base, timeout: Tick) -> u32;
    pub(crate) fn xTaskGenericNotifyWait(
        index: UBase,
        clear_on_entry: u32,
        clear_on_exit: u32,
        value: *mut u32,
        timeout: Tick,
    ) -> Base;
}
