//! Functions and types of the kernel as the C compiler sees them; `kernel/shim.c` checks the
//! widths. Functions that both ports and objects need have a wrapper here.
#![allow(unsafe_code)]
#![allow(dead_code, reason = "each target uses its part")]

use core::ffi::{CStr, c_char, c_void};
use core::sync::atomic::{AtomicPtr, Ordering};

include!(concat!(env!("OUT_DIR"), "/sizes.rs"));

pub(crate) type Base = isize;
pub(crate) type UBase = usize;
pub(crate) type Tick = u32;

pub(crate) const PASS: Base = 1;
/// A value of `eNotifyAction`.
pub(crate) const NOTIFY_INCREMENT: core::ffi::c_uint = 2;

/// A task control block. Its first field is the task's stack pointer while the task does not run.
#[repr(C)]
pub(crate) struct Tcb {
    #[cfg(target_os = "linux")]
    pub(crate) top_of_stack: *mut usize,
    _opaque: [u8; 0],
}

/// The kernel's data about a task; filled by `kernel/shim.c`.
#[repr(C)]
#[derive(Default)]
pub(crate) struct TaskInfo {
    pub(crate) number: UBase,
    pub(crate) priority: UBase,
    pub(crate) base_priority: UBase,
    pub(crate) unused_stack_words: UBase,
    pub(crate) run_time: u64,
}

unsafe extern "C" {
    /// The running task. The kernel changes it when it chooses a task.
    pub(crate) static pxCurrentTCB: AtomicPtr<Tcb>;

    pub(crate) fn tandem_enter_critical();
    pub(crate) fn tandem_exit_critical();
    pub(crate) fn tandem_yield();
    pub(crate) fn tandem_yield_from_interrupt(woken: Base);
    pub(crate) fn tandem_task_info(task: *mut Tcb, info: *mut TaskInfo);

    /// The time of the tick after the next one. Exists only on riscv32.
    pub(crate) static mut ullNextTime: u64;
    /// Exists only on riscv32.
    pub(crate) fn tandem_port_reset();
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
    pub(crate) fn xTaskGetStaticBuffers(
        task: *mut Tcb,
        stack: *mut *mut usize,
        tcb: *mut *mut c_void,
    ) -> Base;
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

    pub(crate) fn xQueueGenericCreateStatic(
        length: UBase,
        item_bytes: UBase,
        storage: *mut u8,
        queue: *mut c_void,
        kind: u8,
    ) -> *mut c_void;
    pub(crate) fn xQueueCreateCountingSemaphoreStatic(
        max: UBase,
        initial: UBase,
        queue: *mut c_void,
    ) -> *mut c_void;
    pub(crate) fn xQueueCreateMutexStatic(kind: u8, queue: *mut c_void) -> *mut c_void;
    pub(crate) fn xQueueCreateSetStatic(
        length: UBase,
        storage: *mut u8,
        queue: *mut c_void,
    ) -> *mut c_void;
    pub(crate) fn xQueueGenericSend(
        queue: *mut c_void,
        item: *const c_void,
        timeout: Tick,
        place: Base,
    ) -> Base;
    pub(crate) fn xQueueGenericSendFromISR(
        queue: *mut c_void,
        item: *const c_void,
        woken: *mut Base,
        place: Base,
    ) -> Base;
    pub(crate) fn xQueueGiveFromISR(queue: *mut c_void, woken: *mut Base) -> Base;
    pub(crate) fn xQueueReceive(queue: *mut c_void, item: *mut c_void, timeout: Tick) -> Base;
    pub(crate) fn xQueueReceiveFromISR(
        queue: *mut c_void,
        item: *mut c_void,
        woken: *mut Base,
    ) -> Base;
    pub(crate) fn xQueueSemaphoreTake(queue: *mut c_void, timeout: Tick) -> Base;
    pub(crate) fn xQueueGetMutexHolder(queue: *mut c_void) -> *mut Tcb;
    pub(crate) fn xQueueAddToSet(member: *mut c_void, set: *mut c_void) -> Base;
    pub(crate) fn xQueueSelectFromSet(set: *mut c_void, timeout: Tick) -> *mut c_void;

    pub(crate) fn xTimerCreateStatic(
        name: *const c_char,
        period: Tick,
        reload: UBase,
        id: *mut c_void,
        callback: extern "C" fn(*mut c_void),
        timer: *mut c_void,
    ) -> *mut c_void;
    pub(crate) fn pvTimerGetTimerID(timer: *const c_void) -> *mut c_void;
    pub(crate) fn xTimerGenericCommandFromTask(
        timer: *mut c_void,
        command: Base,
        value: Tick,
        woken: *mut Base,
        timeout: Tick,
    ) -> Base;
    pub(crate) fn xTimerGenericCommandFromISR(
        timer: *mut c_void,
        command: Base,
        value: Tick,
        woken: *mut Base,
        timeout: Tick,
    ) -> Base;

    pub(crate) fn vTaskSuspendAll();
    pub(crate) fn xTaskResumeAll() -> Base;
    pub(crate) fn ulTaskGetRunTimeCounter(task: *const Tcb) -> u64;
}

/// Runs `body` with interrupts masked. Calls nest. The masking also ends if `body` unwinds.
pub(crate) fn critical<R>(body: impl FnOnce() -> R) -> R {
    struct End;
    impl Drop for End {
        fn drop(&mut self) {
            // SAFETY: pairs with the entry below.
            unsafe { tandem_exit_critical() };
        }
    }
    // SAFETY: callable from every task, and before the scheduler runs; `End` pairs with it.
    unsafe { tandem_enter_critical() };
    let _end = End;
    body()
}

/// Returns the control block of the running task, or null.
pub(crate) fn current_tcb() -> *mut Tcb {
    // SAFETY: the kernel's variable is a pointer and is read in one access.
    unsafe { pxCurrentTCB.load(Ordering::Relaxed) }
}

/// Returns the name of the running task, for messages.
pub(crate) fn current_name() -> &'static str {
    let current = current_tcb();
    if current.is_null() {
        "none"
    } else {
        name_of(current)
    }
}

/// Returns the name of a live task.
pub(crate) fn name_of(tcb: *mut Tcb) -> &'static str {
    // SAFETY: a live task's control block holds its name, which ends with a zero. The name is read
    // here and not kept.
    let name = unsafe { CStr::from_ptr(pcTaskGetName(tcb)) };
    name.to_str().unwrap_or("not UTF-8")
}
