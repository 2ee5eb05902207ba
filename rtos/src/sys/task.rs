//! Tasks: their memory, their life, and the calls that they make about themselves.

use super::ffi::{self, Base, Tcb};
use super::shared::Shared;
use crate::context::{Context, TaskContext, TaskLevel};
use crate::port;
use crate::task::{Priority, SpawnError, TaskOptions};
use crate::time::Ticks;
#[cfg(feature = "alloc")]
use alloc::{boxed::Box, sync::Arc};
use core::cell::UnsafeCell;
use core::ffi::{CStr, c_char, c_void};
use core::ptr;
use core::sync::atomic::{AtomicBool, AtomicPtr, AtomicU8, AtomicU32, Ordering};
use core::time::Duration;

/// Bytes of a task's name with the closing zero; as configMAX_TASK_NAME_LEN.
pub(crate) const NAME_BYTES: usize = 24;

/// What a task runs.
enum Entry {
    None,
    Function(fn(&TaskContext)),
    #[cfg(feature = "alloc")]
    Closure(Box<dyn FnOnce(&TaskContext) + Send>),
}

/// No task: the memory may be used.
const FREE: u8 = 0;
/// The memory is taken, but the kernel does not know the task yet.
const BEING_MADE: u8 = 1;
/// The kernel knows the task.
const ALIVE: u8 = 2;
/// The task has returned; the idle task has yet to free its memory.
const ENDED: u8 = 3;
/// The scheduler was stopped while the task was somewhere in its work. Something may still borrow
/// from its stack, which therefore is never used again.
#[cfg(target_os = "linux")]
const ABANDONED: u8 = 4;

/// A task's place in memory. The control block comes first: a kernel's handle is a pointer to it.
#[repr(C)]
pub(crate) struct Record {
    tcb: UnsafeCell<[usize; ffi::TASK_WORDS]>,
    stack: UnsafeCell<Option<port::Stack>>,
    entry: UnsafeCell<Entry>,
    state: AtomicU8,
    /// The number of the task that is alive here; 0 if none is. A handle to an earlier task does
    /// not reach this one.
    alive: AtomicU32,
    /// How many tasks have been made here.
    made: AtomicU32,
    /// For which life of the kernel the last one was made.
    epoch: AtomicU32,
    next: AtomicPtr<Record>,
    /// Where this is counted, for the count that the list holds.
    on_heap: AtomicBool,
    /// Mutexes that the task holds.
    mutexes: AtomicU32,
}

// SAFETY: the cells are written before the task starts and after it is gone, by the one thread of
// the core; the closure in between is taken by the task itself and is `Send`.
unsafe impl Send for Record {}
// SAFETY: as above; what others reach through a handle is `state`, which is atomic, and the control
// block, which only the kernel touches, on the core's thread.
unsafe impl Sync for Record {}

/// All tasks that the kernel knows. Changed with interrupts masked, read also by the handler of
/// faults.
static TASKS: AtomicPtr<Record> = AtomicPtr::new(ptr::null_mut());

impl Record {
    pub(crate) const fn new() -> Self {
        Self {
            tcb: UnsafeCell::new([0; ffi::TASK_WORDS]),
            stack: UnsafeCell::new(None),
            entry: UnsafeCell::new(Entry::None),
            state: AtomicU8::new(FREE),
            alive: AtomicU32::new(0),
            made: AtomicU32::new(0),
            epoch: AtomicU32::new(0),
            next: AtomicPtr::new(ptr::null_mut()),
            on_heap: AtomicBool::new(false),
            mutexes: AtomicU32::new(0),
        }
    }

    fn handle(&self) -> *mut Tcb {
        self.tcb.get().cast()
    }

    /// Puts this into the list of tasks. The caller has made it [`ALIVE`].
    fn link(&self) {
        super::critical(|| {
            self.next
                .store(TASKS.load(Ordering::Relaxed), Ordering::Relaxed);
            TASKS.store(ptr::from_ref(self).cast_mut(), Ordering::Relaxed);
        });
    }

    fn unlink(&self) {
        super::critical(|| {
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
                // SAFETY: what is in the list is a static or counted for the list, so it lives.
                link = unsafe { &(*at).next };
            }
        });
    }

    /// Gives back the count that the list held.
    ///
    /// # Safety
    /// To be called once, after `unlink`; no reference to the record is used afterwards.
    unsafe fn release(record: *const Self) {
        #[cfg(feature = "alloc")]
        // SAFETY: the list's count still holds the record.
        if unsafe { (*record).on_heap.load(Ordering::Relaxed) } {
            // SAFETY: `create` turned a count of this Arc into the list's.
            drop(unsafe { Arc::from_raw(record) });
        }
        #[cfg(not(feature = "alloc"))]
        let _ = record;
    }
}

/// A place for a task in a static, with a stack of `WORDS` machine words.
///
/// On the host the stack has as many words, but is mapped with a guard page below it: the words
/// here are not touched.
#[repr(C, align(16))]
pub struct TaskMemory<const WORDS: usize> {
    stack: UnsafeCell<[usize; WORDS]>,
    record: Record,
}

// SAFETY: the stack is touched by its task alone, and by the kernel.
unsafe impl<const WORDS: usize> Sync for TaskMemory<WORDS> {}

impl<const WORDS: usize> TaskMemory<WORDS> {
    /// Memory for one task at a time.
    #[must_use]
    #[allow(
        clippy::new_without_default,
        reason = "for statics, where a default is of no use"
    )]
    pub const fn new() -> Self {
        Self {
            stack: UnsafeCell::new([0; WORDS]),
            record: Record::new(),
        }
    }
}

/// Names a task to others. Outlives it: calls say [`TaskError::Ended`] then.
#[derive(Clone)]
pub struct TaskHandle {
    record: Shared<Record>,
    /// The task's number there.
    number: u32,
}

/// A task cannot be reached.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TaskError {
    /// It has returned, or the scheduler was stopped.
    Ended,
}

impl core::fmt::Display for TaskError {
    fn fmt(&self, out: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        match self {
            Self::Ended => out.write_str("the task has ended"),
        }
    }
}

impl core::error::Error for TaskError {}

impl TaskHandle {
    /// Whether the task has neither returned nor been stopped.
    #[must_use]
    pub fn is_alive(&self) -> bool {
        self.record.alive.load(Ordering::Relaxed) == self.number
    }

    /// Runs `body` on the kernel's handle while the task cannot end: in an interrupt no task runs,
    /// and otherwise interrupts are masked.
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
            super::critical(checked)
        }
    }
}

/// Makes a task from memory in a static.
pub(crate) fn spawn_static<const WORDS: usize>(
    memory: &'static TaskMemory<WORDS>,
    options: &TaskOptions<'_>,
    function: fn(&TaskContext),
) -> Result<TaskHandle, SpawnError> {
    if WORDS < port::MIN_STACK_WORDS {
        return Err(SpawnError::StackTooSmall);
    }
    // SAFETY: `create` takes the record first, so no other task uses this stack.
    let stack = unsafe { port::Stack::in_static(memory.stack.get().cast(), WORDS) };
    let stack = stack.ok_or(SpawnError::NoMemory)?;
    let record = Shared::Static(&memory.record);
    create(record, stack, options, Entry::Function(function))
}

/// Makes a task from memory of the heap.
#[cfg(feature = "alloc")]
pub(crate) fn spawn(
    options: &TaskOptions<'_>,
    closure: Box<dyn FnOnce(&TaskContext) + Send>,
) -> Result<TaskHandle, SpawnError> {
    let stack = port::Stack::allocate(options.stack_bytes).ok_or(SpawnError::NoMemory)?;
    let record = Shared::Heap(Arc::new(Record::new()));
    create(record, stack, options, Entry::Closure(closure))
}

fn create(
    record: Shared<Record>,
    stack: port::Stack,
    options: &TaskOptions<'_>,
    entry: Entry,
) -> Result<TaskHandle, SpawnError> {
    let mut name = [0u8; NAME_BYTES];
    let given = options.name.as_bytes();
    if given.is_empty() || given.len() >= NAME_BYTES || given.contains(&0) {
        return Err(SpawnError::BadName);
    }
    name[..given.len()].copy_from_slice(given);
    // A switch between these steps would show a half-made task to others, or, if one of them
    // stopped the scheduler, take the record without a task.
    let _no_switch = NoSwitch::begin();
    if port::A_LIFE_ENDS_ALL && record.epoch.load(Ordering::Relaxed) != port::epoch() {
        record.state.store(FREE, Ordering::Relaxed);
        record.alive.store(0, Ordering::Relaxed);
    }
    // No other thread changes it: the exchange only has to be atomic against handlers.
    let taken =
        record
            .state
            .compare_exchange(FREE, BEING_MADE, Ordering::Relaxed, Ordering::Relaxed);
    taken.map_err(|_| SpawnError::InUse)?;
    record.epoch.store(port::epoch(), Ordering::Relaxed);
    // Never 0.
    let number = record.made.load(Ordering::Relaxed).wrapping_add(1).max(1);
    record.made.store(number, Ordering::Relaxed);
    let (low, words) = (stack.low, stack.words);
    // SAFETY: the record is ours by the exchange, and no task runs on it yet.
    unsafe {
        *record.stack.get() = Some(stack);
        *record.entry.get() = entry;
    }
    #[cfg(feature = "alloc")]
    if let Shared::Heap(counted) = &record {
        record.on_heap.store(true, Ordering::Relaxed);
        // The list's count, given back by `release`.
        let _ = Arc::into_raw(Arc::clone(counted));
    }
    let parameters = ptr::from_ref::<Record>(&record).cast_mut().cast();
    // SAFETY: the control block and the stack live until the kernel says that the task is gone; the
    // name is copied.
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
    // Only now: a handler may hold a handle, and a task runs when `_no_switch` ends.
    record.state.store(ALIVE, Ordering::Relaxed);
    record.alive.store(number, Ordering::Relaxed);
    record.link();
    Ok(TaskHandle { record, number })
}

/// As long as this is, no other task runs; interrupts do. Nests. Its end may switch.
struct NoSwitch;

impl NoSwitch {
    /// By a task, or before the scheduler runs.
    fn begin() -> Self {
        // SAFETY: ended by `drop`. Before the scheduler runs, this only counts.
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

/// Where every task begins, on its own stack.
extern "C" fn task_main(parameters: *mut c_void) {
    // SAFETY: `create` passed the record, which lives until the task is gone.
    let record = unsafe { &*parameters.cast::<Record>() };
    // SAFETY: only the task itself touches its entry once it runs.
    let entry = unsafe { core::mem::replace(&mut *record.entry.get(), Entry::None) };
    let context = TaskContext::new();
    match entry {
        Entry::None => {}
        Entry::Function(function) => function(&context),
        #[cfg(feature = "alloc")]
        Entry::Closure(closure) => closure(&context),
    }
    if record.mutexes.load(Ordering::Relaxed) != 0 {
        // A waiter would boost a deleted task.
        port::fatal(format_args!(
            "task '{}' has ended with a locked mutex",
            current_name()
        ));
    }
    record.state.store(ENDED, Ordering::Relaxed);
    record.alive.store(0, Ordering::Relaxed);
    // SAFETY: null means the caller; nothing on this stack is needed any more.
    unsafe { ffi::vTaskDelete(ptr::null_mut()) };
    unreachable!("a deleted task ran");
}

/// The idle task has taken the last pointer to this task out of the kernel.
///
/// # Safety
/// Called by the kernel with the control block of a task made by [`create`].
#[unsafe(no_mangle)]
unsafe extern "C" fn tandem_task_gone(tcb: *mut c_void) {
    let record = tcb.cast::<Record>().cast_const();
    // SAFETY: the control block is the first field of a record in the list, which holds it.
    unsafe { retire(&*record) };
    // SAFETY: unlinked by `retire`, and not used below.
    unsafe { Record::release(record) };
}

/// Takes a task that has left its stack for good out of the list.
///
/// # Safety
/// It will never run again.
unsafe fn retire(record: &Record) {
    record.unlink();
    // SAFETY: the task has left its stack for good.
    drop(unsafe { (*record.stack.get()).take() });
    record.state.store(FREE, Ordering::Relaxed);
}

/// Whether every task has returned and its memory is free.
#[cfg(target_os = "linux")]
pub(crate) fn none_left() -> bool {
    TASKS.load(Ordering::Relaxed).is_null()
}

/// After the scheduler has stopped: no task runs any more. What they had is never freed.
#[cfg(target_os = "linux")]
pub(crate) fn abandon_all() {
    loop {
        let first = TASKS.load(Ordering::Relaxed);
        if first.is_null() {
            return;
        }
        // SAFETY: what is in the list lives. A task that has returned uses nothing on its stack,
        // and it never runs again.
        unsafe {
            if (*first).state.load(Ordering::Relaxed) == ENDED {
                retire(&*first);
            } else {
                (*first).state.store(ABANDONED, Ordering::Relaxed);
                (*first).alive.store(0, Ordering::Relaxed);
                (*first).unlink();
                core::mem::forget((*(*first).stack.get()).take());
            }
        }
        // SAFETY: unlinked above, and not used below.
        unsafe { Record::release(first) };
    }
}

/// After a reset of the hart: no task runs any more. The memory of those in statics may be used
/// again.
#[cfg(target_arch = "riscv32")]
pub(crate) fn forget_all() {
    TASKS.store(ptr::null_mut(), Ordering::Relaxed);
}

/// The control block of the running task, or null.
pub(crate) fn current_tcb() -> *mut Tcb {
    // SAFETY: the kernel's variable is a pointer, which is all that matters here.
    unsafe { ffi::pxCurrentTCB.load(Ordering::Relaxed) }
}

fn current() -> Option<&'static Record> {
    // SAFETY: only this thread changes the pointer. Every task of the kernel was made from a
    // record, whose first field is the control block; the running one's is not given back.
    unsafe { current_tcb().cast::<Record>().as_ref() }
}

/// The running task has locked a mutex.
pub(crate) fn mutex_taken() {
    if let Some(record) = current() {
        record.mutexes.fetch_add(1, Ordering::Relaxed);
    }
}

/// The running task unlocks a mutex.
pub(crate) fn mutex_given() {
    if let Some(record) = current() {
        record.mutexes.fetch_sub(1, Ordering::Relaxed);
    }
}

/// The stack of the running task, from its lowest word on.
#[cfg(target_os = "linux")]
pub(crate) fn current_stack() -> Option<(usize, usize)> {
    // SAFETY: set before the task runs, and taken after it has left.
    let stack = unsafe { &*current()?.stack.get() };
    stack
        .as_ref()
        .map(|stack| (stack.low as usize, stack.words))
}

/// The name of the running task, for messages.
pub(crate) fn current_name() -> &'static str {
    let current = current_tcb();
    if current.is_null() {
        "none"
    } else {
        name_of(current)
    }
}

fn name_of(tcb: *mut Tcb) -> &'static str {
    // SAFETY: a live task's control block holds its name, closed with a zero; a name is read at
    // once and not kept.
    let name = unsafe { CStr::from_ptr(ffi::pcTaskGetName(tcb)) };
    name.to_str().unwrap_or("not UTF-8")
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

pub(crate) fn yield_now() {
    // SAFETY: called by a task.
    unsafe { ffi::tandem_yield() };
}

pub(crate) fn delay(span: Ticks) {
    port::assert_may_block();
    // SAFETY: called by a task that may block.
    unsafe { ffi::vTaskDelay(span.0.min(Ticks::FOREVER.0 - 1)) };
}

pub(crate) fn delay_until(last_wake: &mut Ticks, period: Ticks) -> bool {
    port::assert_may_block();
    assert!(period.0 > 0, "a period of zero ticks");
    // SAFETY: called by a task that may block; the place is written during the call only.
    unsafe { ffi::xTaskDelayUntil(&mut last_wake.0, period.0) != 0 }
}

/// A task of the kernel itself: its memory, for the two calls below.
struct Service {
    record: Record,
}

static IDLE: Service = Service {
    record: Record::new(),
};
static TIMERS: Service = Service {
    record: Record::new(),
};

impl Service {
    /// Gives the memory to the kernel, and the stack that it was given first.
    fn give(&'static self, tcb: *mut *mut c_void, stack: *mut *mut usize, words: *mut usize) {
        // SAFETY: the kernel calls before the task exists, on the core's thread.
        let slot = unsafe { &mut *self.record.stack.get() };
        let memory = slot.get_or_insert_with(port::Stack::for_service);
        self.record.state.store(ALIVE, Ordering::Relaxed);
        // SAFETY: the kernel's call passes three valid places.
        unsafe {
            *tcb = self.record.tcb.get().cast();
            *stack = memory.low;
            *words = memory.words;
        }
    }
}

#[unsafe(no_mangle)]
extern "C" fn vApplicationGetIdleTaskMemory(
    tcb: *mut *mut c_void,
    stack: *mut *mut usize,
    words: *mut usize,
) {
    IDLE.give(tcb, stack, words);
}

#[unsafe(no_mangle)]
extern "C" fn vApplicationGetTimerTaskMemory(
    tcb: *mut *mut c_void,
    stack: *mut *mut usize,
    words: *mut usize,
) {
    TIMERS.give(tcb, stack, words);
}

#[unsafe(no_mangle)]
extern "C" fn vApplicationIdleHook() {
    port::idle();
}

/// The kernel saw at a switch that the end of this task's stack was overwritten.
#[unsafe(no_mangle)]
extern "C" fn vApplicationStackOverflowHook(task: *mut Tcb, _name: *const c_char) {
    port::fatal(format_args!(
        "task '{}' has overflowed its stack",
        name_of(task)
    ));
}

/// A failed assertion of the kernel.
#[unsafe(no_mangle)]
extern "C" fn tandem_assert(file: *const c_char, line: i32) -> ! {
    // SAFETY: the compiler's name of the file, closed with a zero.
    let file = unsafe { CStr::from_ptr(file) }.to_str().unwrap_or("?");
    let task = current_name();
    port::fatal(format_args!(
        "the kernel's assertion at {file}:{line} failed in task '{task}'"
    ))
}

/// What a notification does to the task's word.
pub(crate) enum Change {
    Increment,
    SetBits(u32),
}

/// Notifies a task; says whether it is more urgent than the interrupted one.
pub(crate) fn notify(
    task: &TaskHandle,
    change: Change,
    in_interrupt: bool,
) -> Result<bool, TaskError> {
    let (value, action) = match change {
        Change::Increment => (0, ffi::NOTIFY_INCREMENT),
        Change::SetBits(bits) => (bits, ffi::NOTIFY_SET_BITS),
    };
    let none = ptr::null_mut();
    let mut woken = 0;
    task.with(in_interrupt, |handle| {
        // SAFETY: the task is alive; only word 0 exists; the place is written during the call.
        unsafe {
            if in_interrupt {
                ffi::xTaskGenericNotifyFromISR(handle, 0, value, action, none, &mut woken);
            } else {
                ffi::xTaskGenericNotify(handle, 0, value, action, none);
            }
        }
    })?;
    Ok(woken != 0)
}

pub(crate) fn take_notification(all: bool, timeout: Ticks) -> u32 {
    port::assert_may_block();
    // SAFETY: called by a task that may block, about its own word 0.
    unsafe { ffi::ulTaskGenericNotifyTake(0, Base::from(all), timeout.0) }
}

pub(crate) fn wait_bits(timeout: Ticks) -> Option<u32> {
    port::assert_may_block();
    let mut bits = 0;
    // SAFETY: as above; the place is written during the call.
    let got = unsafe { ffi::xTaskGenericNotifyWait(0, 0, u32::MAX, &mut bits, timeout.0) };
    (got != 0).then_some(bits)
}

/// What the kernel knows about a task.
#[derive(Clone, Copy, Debug)]
pub struct TaskStatistics<'a> {
    /// Its name.
    pub name: &'a str,
    /// Its number, by which traces call it: the order in which tasks were made, from 1 on.
    pub number: u32,
    /// Its priority, with what it inherits from tasks that wait for its mutexes. 0 is the idle
    /// task's, 31 the timers'.
    pub priority: u8,
    /// How long it has run, with the interrupts in that time.
    pub run_time: Duration,
    /// Bytes of its stack.
    pub stack_bytes: usize,
    /// Bytes of its stack that it never used.
    pub unused_stack_bytes: usize,
}

fn statistics(record: &Record) -> TaskStatistics<'_> {
    let mut info = ffi::TaskInfo::default();
    // SAFETY: the task is alive, and cannot end now: no other task runs.
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

/// Shows every task that is alive, the kernel's own ones first, while no other task runs.
pub(crate) fn each(mut look: impl FnMut(&TaskStatistics<'_>)) {
    let _no_switch = NoSwitch::begin();
    look(&statistics(&IDLE.record));
    look(&statistics(&TIMERS.record));
    let mut at = TASKS.load(Ordering::Relaxed);
    // SAFETY: what is in the list lives, and only tasks change the list.
    while let Some(record) = unsafe { at.as_ref() } {
        if record.state.load(Ordering::Relaxed) == ALIVE {
            look(&statistics(record));
        }
        at = record.next.load(Ordering::Relaxed);
    }
}

/// Bytes of the running task's stack that it never used.
pub(crate) fn own_unused_stack_bytes() -> usize {
    let mut info = ffi::TaskInfo::default();
    // SAFETY: called by a task, which is the current one and lives; only it uses its stack.
    unsafe { ffi::tandem_task_info(current_tcb(), &mut info) };
    info.unused_stack_words * size_of::<usize>()
}

/// The time that the running task has run, in the port's units.
pub(crate) fn own_run_time() -> u64 {
    // SAFETY: null means the caller, a task.
    unsafe { ffi::ulTaskGetRunTimeCounter(ptr::null()) }
}

impl TaskHandle {
    /// The task's number, by which traces call it.
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

    /// Gives the task another priority.
    ///
    /// # Errors
    /// [`TaskError::Ended`]
    pub fn set_priority(&self, _ctx: &impl TaskLevel, priority: Priority) -> Result<(), TaskError> {
        self.with(false, |handle| {
            // SAFETY: the task is alive.
            unsafe { ffi::vTaskPrioritySet(handle, usize::from(priority.level())) };
        })
    }

    /// Keeps the task from running until it is resumed, whatever else it waits for.
    ///
    /// # Errors
    /// [`TaskError::Ended`]
    pub fn suspend(&self, _ctx: &TaskContext) -> Result<(), TaskError> {
        port::assert_may_block();
        self.with(false, |handle| {
            // SAFETY: the task is alive.
            unsafe { ffi::vTaskSuspend(handle) };
        })
    }

    /// Lets a suspended task run again.
    ///
    /// # Errors
    /// [`TaskError::Ended`]
    pub fn resume(&self, _ctx: &TaskContext) -> Result<(), TaskError> {
        self.with(false, |handle| {
            // SAFETY: the task is alive.
            unsafe { ffi::vTaskResume(handle) };
        })
    }
}
