//! Tasks: their memory, their life, and the calls that other tasks make about them.

use crate::context::{Context, TaskContext};
use crate::ffi::{self, Tcb, current_name, current_tcb, name_of};
use crate::port;
use crate::task::{SpawnError, TaskOptions};
use crate::time::Ticks;
use alloc::{boxed::Box, sync::Arc};
use core::cell::UnsafeCell;
use core::ffi::{CStr, c_char, c_void};
use core::ptr;
use core::sync::atomic::{AtomicBool, AtomicPtr, AtomicU32, Ordering};
use core::time::Duration;

/// Bytes of a task's name with the closing zero; as configMAX_TASK_NAME_LEN.
pub(crate) const NAME_BYTES: usize = 24;

/// The code of a task.
type Entry = Box<dyn FnOnce(&TaskContext) + Send>;

/// A task in memory. The control block is the first field: the kernel's handle is a pointer to it.
#[repr(C)]
pub(crate) struct Record {
    tcb: UnsafeCell<[usize; ffi::TASK_WORDS]>,
    stack: UnsafeCell<Option<port::Stack>>,
    entry: UnsafeCell<Option<Entry>>,
    /// Whether the task has neither returned nor been abandoned.
    alive: AtomicBool,
    next: AtomicPtr<Record>,
    /// Mutexes that the task holds.
    mutexes: AtomicU32,
}

// SAFETY: the core's one thread writes the cells before the task starts and after it has ended; the
// closure is `Send`, and the task itself takes it.
unsafe impl Send for Record {}
// SAFETY: as above. Through a handle, other code reads `alive`, which is atomic, and passes the
// control block to the kernel, which accesses it only on the core's thread.
unsafe impl Sync for Record {}

/// All tasks of the kernel. Changed only with interrupts masked, because the handler of faults also
/// reads it.
static TASKS: AtomicPtr<Record> = AtomicPtr::new(ptr::null_mut());

impl Record {
    pub(crate) const fn new() -> Self {
        Self {
            tcb: UnsafeCell::new([0; ffi::TASK_WORDS]),
            stack: UnsafeCell::new(None),
            entry: UnsafeCell::new(None),
            alive: AtomicBool::new(false),
            next: AtomicPtr::new(ptr::null_mut()),
            mutexes: AtomicU32::new(0),
        }
    }

    fn handle(&self) -> *mut Tcb {
        self.tcb.get().cast()
    }

    /// Puts this into the list of tasks.
    fn link(&self) {
        ffi::critical(|| {
            self.next
                .store(TASKS.load(Ordering::Relaxed), Ordering::Relaxed);
            TASKS.store(ptr::from_ref(self).cast_mut(), Ordering::Relaxed);
        });
    }

    fn unlink(&self) {
        ffi::critical(|| {
            let mut link = &TASKS;
            loop {
                let at = link.load(Ordering::Relaxed);
                if at.is_null() {
                    return;
                }
                if ptr::eq(at, self) {
                    link.store(self.next.load(Ordering::Relaxed), Ordering::Relaxed);
                    return;
                }
                // SAFETY: the list holds a reference count of each record, so this record is alive.
                link = unsafe { &(*at).next };
            }
        });
    }

    /// Drops the list's reference count.
    ///
    /// # Safety
    /// Called once, after `unlink`; no reference to the record is used afterwards.
    unsafe fn release(record: *const Self) {
        // SAFETY: `spawn` gave one reference count of this Arc to the list.
        drop(unsafe { Arc::from_raw(record) });
    }
}

/// A handle of a task. It may outlive the task; calls then return [`TaskError::Ended`].
#[derive(Clone)]
pub struct TaskHandle {
    record: Arc<Record>,
}

/// The task cannot be reached.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum TaskError {
    /// It has returned, or the scheduler was stopped.
    #[error("the task has ended")]
    Ended,
}

impl TaskHandle {
    /// Returns whether the task has neither returned nor been stopped.
    #[must_use]
    pub fn is_alive(&self) -> bool {
        self.record.alive.load(Ordering::Relaxed)
    }

    /// Runs `body` on the kernel's handle while the task cannot end: no task runs during an
    /// interrupt, and otherwise interrupts are masked.
    pub(crate) fn with<R>(
        &self,
        in_interrupt: bool,
        body: impl FnOnce(*mut Tcb) -> R,
    ) -> Result<R, TaskError> {
        let checked = || match self.is_alive() {
            true => Ok(body(self.record.handle())),
            false => Err(TaskError::Ended),
        };
        if in_interrupt {
            checked()
        } else {
            ffi::critical(checked)
        }
    }
}

/// Makes a task.
pub(crate) fn spawn(options: &TaskOptions<'_>, entry: Entry) -> Result<TaskHandle, SpawnError> {
    let mut name = [0u8; NAME_BYTES];
    let given = options.name.as_bytes();
    if given.is_empty() || given.len() >= NAME_BYTES || given.contains(&0) {
        return Err(SpawnError::BadName);
    }
    name[..given.len()].copy_from_slice(given);
    let stack = port::Stack::allocate(options.stack_bytes).ok_or(SpawnError::NoMemory)?;
    let (low, words) = (stack.low, stack.words);
    let mut record = Record::new();
    record.stack = UnsafeCell::new(Some(stack));
    record.entry = UnsafeCell::new(Some(entry));
    let record = Arc::new(record);
    // This reference count belongs to the list; `release` drops it.
    let parameters = Arc::into_raw(Arc::clone(&record)).cast_mut().cast();
    // A switch between these steps would show an incomplete task to others.
    let _no_switch = NoSwitch::begin();
    // SAFETY: the control block and the stack live until the kernel reports that the task has
    // ended; the name is copied.
    let handle = unsafe {
        ffi::xTaskCreateStatic(
            task_main,
            name.as_ptr().cast(),
            words,
            parameters,
            usize::from(options.priority.level()),
            low,
            record.handle().cast(),
        )
    };
    assert_eq!(
        handle,
        record.handle(),
        "the handle is the control block's address"
    );
    // The task cannot run before this line: `_no_switch` is still held.
    record.alive.store(true, Ordering::Relaxed);
    record.link();
    Ok(TaskHandle { record })
}

/// While this exists, interrupts run but no other task does. Nests. Dropping it may cause a switch.
struct NoSwitch;

impl NoSwitch {
    /// Called by a task, or while no scheduler runs.
    fn begin() -> Self {
        // SAFETY: `drop` ends the suspension. While no scheduler runs, this only counts.
        unsafe { ffi::vTaskSuspendAll() };
        Self
    }
}

impl Drop for NoSwitch {
    fn drop(&mut self) {
        // SAFETY: pairs with `begin`.
        unsafe { ffi::xTaskResumeAll() };
    }
}

/// The first function of every task, on its own stack.
extern "C" fn task_main(parameters: *mut c_void) {
    // SAFETY: `spawn` passed the record, which lives until the task has ended.
    let record = unsafe { &*parameters.cast::<Record>() };
    // SAFETY: only the task itself accesses its entry once it runs.
    if let Some(entry) = unsafe { (*record.entry.get()).take() } {
        entry(&TaskContext::new());
    }
    if record.mutexes.load(Ordering::Relaxed) != 0 {
        // A waiter would boost a deleted task.
        port::fatal(format_args!(
            "task '{}' has ended with a locked mutex",
            current_name()
        ));
    }
    record.alive.store(false, Ordering::Relaxed);
    // SAFETY: null means the caller; nothing on this stack is used any more.
    unsafe { ffi::vTaskDelete(ptr::null_mut()) };
    unreachable!("a deleted task ran");
}

/// Called when the idle task has removed the last pointer to this task from the kernel.
///
/// # Safety
/// Called by the kernel with the control block of a task made by [`spawn`].
#[unsafe(no_mangle)]
unsafe extern "C" fn tandem_task_gone(tcb: *mut c_void) {
    let record = tcb.cast::<Record>().cast_const();
    // SAFETY: the control block is the first field of a record, which the list keeps alive.
    unsafe { retire(&*record) };
    // SAFETY: `retire` unlinked it, and it is not used below.
    unsafe { Record::release(record) };
}

/// Removes a task from the list and frees its stack.
///
/// # Safety
/// The task never runs again.
unsafe fn retire(record: &Record) {
    record.unlink();
    // SAFETY: the task never uses its stack again.
    drop(unsafe { (*record.stack.get()).take() });
}

/// Returns whether every task has returned and its memory is free.
pub(crate) fn none_left() -> bool {
    TASKS.load(Ordering::Relaxed).is_null()
}

/// Called after the scheduler has stopped: no task runs any more. Objects that the tasks own are
/// never freed.
#[cfg(target_os = "linux")]
pub(crate) fn abandon_all() {
    loop {
        let first = TASKS.load(Ordering::Relaxed);
        if first.is_null() {
            return;
        }
        // SAFETY: records in the list live. A task that has returned uses nothing on its stack, and
        // it never runs again.
        unsafe {
            if (*first).alive.swap(false, Ordering::Relaxed) {
                // Another thread may still borrow from its stack, so the stack is never freed.
                core::mem::forget((*(*first).stack.get()).take());
            }
            retire(&*first);
        }
        // SAFETY: unlinked above, and not used below.
        unsafe { Record::release(first) };
    }
}

/// Empties the list of tasks, after a reset of the hart: no task runs any more.
#[cfg(target_arch = "riscv32")]
pub(crate) fn forget_all() {
    TASKS.store(ptr::null_mut(), Ordering::Relaxed);
}

fn current() -> Option<&'static Record> {
    // SAFETY: only this thread changes the pointer. Every task of the kernel was made from a
    // record, whose first field is the control block; the running task's record is not released.
    unsafe { current_tcb().cast::<Record>().as_ref() }
}

/// Counts a mutex that the running task has locked.
pub(crate) fn mutex_taken() {
    if let Some(record) = current() {
        record.mutexes.fetch_add(1, Ordering::Relaxed);
    }
}

/// Counts a mutex that the running task unlocks.
pub(crate) fn mutex_given() {
    if let Some(record) = current() {
        record.mutexes.fetch_sub(1, Ordering::Relaxed);
    }
}

pub(crate) fn now(in_interrupt: bool) -> Ticks {
    // SAFETY: both only read the count of ticks.
    Ticks(unsafe {
        if in_interrupt {
            ffi::xTaskGetTickCountFromISR()
        } else {
            ffi::xTaskGetTickCount()
        }
    })
}

/// The kernel's own tasks: the idle task, and the one that serves the timers.
static IDLE: Record = Record::new();
static TIMERS: Record = Record::new();

/// Passes the memory of one of the kernel's own tasks to the kernel, always with the same stack.
fn give(record: &'static Record, tcb: *mut *mut c_void, stack: *mut *mut usize, words: *mut usize) {
    // SAFETY: the kernel calls this before the task exists, on the core's thread.
    let slot = unsafe { &mut *record.stack.get() };
    let memory = slot.get_or_insert_with(port::Stack::for_service);
    // SAFETY: the kernel passes three valid pointers.
    unsafe {
        *tcb = record.tcb.get().cast();
        *stack = memory.low;
        *words = memory.words;
    }
}

#[unsafe(no_mangle)]
extern "C" fn vApplicationGetIdleTaskMemory(
    tcb: *mut *mut c_void,
    stack: *mut *mut usize,
    words: *mut usize,
) {
    give(&IDLE, tcb, stack, words);
}

#[unsafe(no_mangle)]
extern "C" fn vApplicationGetTimerTaskMemory(
    tcb: *mut *mut c_void,
    stack: *mut *mut usize,
    words: *mut usize,
) {
    give(&TIMERS, tcb, stack, words);
}

#[unsafe(no_mangle)]
extern "C" fn vApplicationIdleHook() {
    port::idle(none_left);
}

/// The kernel calls this at a switch if the end of this task's stack was overwritten.
#[unsafe(no_mangle)]
extern "C" fn vApplicationStackOverflowHook(task: *mut Tcb, _name: *const c_char) {
    port::fatal(format_args!(
        "task '{}' has overflowed its stack",
        name_of(task)
    ));
}

/// Reports a failed assertion of the kernel.
#[unsafe(no_mangle)]
extern "C" fn tandem_assert(file: *const c_char, line: i32) -> ! {
    // SAFETY: a string literal of the C compiler, which ends with a zero.
    let file = unsafe { CStr::from_ptr(file) }.to_str().unwrap_or("?");
    let task = current_name();
    port::fatal(format_args!(
        "the kernel's assertion at {file}:{line} failed in task '{task}'"
    ))
}

/// The kernel's data about a task.
#[derive(Clone, Copy, Debug)]
pub struct TaskStatistics<'a> {
    /// Its name.
    pub name: &'a str,
    /// Its number in traces. Tasks are numbered in the order in which they were made, from 1.
    pub number: u32,
    /// Its priority, including one inherited from tasks that wait for its mutexes. The idle task
    /// has 0, the timers' task 31.
    pub priority: u8,
    /// How long it has run. Includes interrupts that occurred while it ran.
    pub run_time: Duration,
    /// Bytes of its stack.
    pub stack_bytes: usize,
    /// Bytes of its stack that were never used.
    pub unused_stack_bytes: usize,
}

fn statistics(record: &Record) -> TaskStatistics<'_> {
    let mut info = ffi::TaskInfo::default();
    // SAFETY: the task is alive and cannot end here, because no other task runs.
    let (name, words) = unsafe {
        ffi::tandem_task_info(record.handle(), &mut info);
        let stack = &*record.stack.get();
        (
            name_of(record.handle()),
            stack.as_ref().map_or(0, |stack| stack.words),
        )
    };
    TaskStatistics {
        name,
        number: info.number as u32,
        priority: info.priority as u8,
        run_time: port::run_time_span(info.run_time),
        stack_bytes: words * size_of::<usize>(),
        unused_stack_bytes: info.unused_stack_words * size_of::<usize>(),
    }
}

/// Calls `visit` for every task that is alive, the kernel's own ones first. No other task runs
/// until it returns.
pub(crate) fn each(mut visit: impl FnMut(&TaskStatistics<'_>)) {
    let _no_switch = NoSwitch::begin();
    visit(&statistics(&IDLE));
    visit(&statistics(&TIMERS));
    let mut at = TASKS.load(Ordering::Relaxed);
    // SAFETY: records in the list live, and only tasks change the list.
    while let Some(record) = unsafe { at.as_ref() } {
        if record.alive.load(Ordering::Relaxed) {
            visit(&statistics(record));
        }
        at = record.next.load(Ordering::Relaxed);
    }
}

impl TaskHandle {
    /// Returns the task's number in traces.
    ///
    /// # Errors
    /// [`TaskError::Ended`]
    pub fn number<C: Context>(&self, _ctx: &C) -> Result<u32, TaskError> {
        self.with(C::IN_INTERRUPT, |handle| {
            let mut info = ffi::TaskInfo::default();
            // SAFETY: the task is alive.
            unsafe { ffi::tandem_task_info(handle, &mut info) };
            info.number as u32
        })
    }

    /// Increments the task's notification by one and wakes the task if it waits for it.
    ///
    /// # Errors
    /// [`TaskError::Ended`]
    pub fn notify<C: Context>(&self, ctx: &C) -> Result<(), TaskError> {
        let (none, mut woken) = (ptr::null_mut(), 0);
        self.with(C::IN_INTERRUPT, |handle| {
            // SAFETY: the task is alive; only word 0 exists; `woken` is written during the call.
            unsafe {
                if C::IN_INTERRUPT {
                    let increment = ffi::NOTIFY_INCREMENT;
                    ffi::xTaskGenericNotifyFromISR(handle, 0, 0, increment, none, &mut woken);
                } else {
                    ffi::xTaskGenericNotify(handle, 0, 0, ffi::NOTIFY_INCREMENT, none);
                }
            }
        })?;
        ctx.woken(woken != 0);
        Ok(())
    }
}
