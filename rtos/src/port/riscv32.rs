//! The target: the kernel's own RISC-V port on one hart, with a CLINT.
//!
//! The tick is the machine timer interrupt, the doorbell the machine software interrupt (bit 0 of
//! the hart's `msip`). The trap vector must be the kernel's: [`start`] writes it to `mtvec`.
//! Interrupts do not nest, so a switch that a handler requests happens when the handler returns.

use super::events::{self, KernelEventKind};
use super::{StartError, TickSource};
use crate::context::InterruptContext;
use crate::ffi;
use crate::interrupt::{HandlerError, Interrupt, InterruptPriority};
use crate::time::TICK_NS;
use core::cell::UnsafeCell;
use core::fmt;
use core::ptr;
use core::sync::atomic::{AtomicBool, AtomicI32, AtomicPtr, AtomicU32, AtomicUsize, Ordering};
use core::time::Duration;

/// The smallest stack in words: room for a context and some calls.
const MIN_STACK_WORDS: usize = 128;
/// Words of the stacks of the idle task and of the timers' task.
const SERVICE_WORDS: usize = 1024;
/// The CLINT's software interrupt registers, one word for each hart, as in QEMU's `virt`.
const MSIP: usize = 0x0200_0000;
/// The CLINT's counter, as configMTIME_BASE_ADDRESS.
const MTIME: usize = 0x0200_BFF8;
/// The CLINT's timer registers, two words for each hart, as configMTIMECMP_BASE_ADDRESS.
const MTIMECMP: usize = 0x0200_4000;
const CAUSE_SOFTWARE: u32 = 3;
const CAUSE_EXTERNAL: u32 = 11;
/// The software interrupt's bit in `mie`. The kernel's port sets the timer and external bits.
const MIE_SOFTWARE: usize = 1 << 3;

type Handler = dyn FnMut(&InterruptContext) + Send;

struct Source(UnsafeCell<Option<&'static mut Handler>>);

// SAFETY: written and called with interrupts masked, on the one hart of the kernel.
unsafe impl Sync for Source {}

static SOURCES: [Source; 2] = [const { Source(UnsafeCell::new(None)) }; 2];
/// Called at exceptions and fatal errors; does not return.
static ON_FATAL: AtomicPtr<()> = AtomicPtr::new(ptr::null_mut());

unsafe extern "C" {
    fn freertos_risc_v_trap_handler();
}

/// A stack of a task.
pub(crate) struct Stack {
    /// Its lowest word.
    pub(crate) low: *mut usize,
    /// How many words it has.
    pub(crate) words: usize,
    on_heap: bool,
}

impl Stack {
    fn layout(words: usize) -> Option<core::alloc::Layout> {
        let bytes = words.checked_mul(size_of::<usize>())?;
        core::alloc::Layout::from_size_align(bytes, 16).ok()
    }

    /// Allocates a stack on the heap.
    pub(crate) fn allocate(bytes: usize) -> Option<Self> {
        let words = (bytes / size_of::<usize>()).max(MIN_STACK_WORDS);
        // SAFETY: the size is not zero.
        let low = unsafe { alloc::alloc::alloc(Self::layout(words)?) };
        (!low.is_null()).then_some(Self {
            low: low.cast(),
            words,
            on_heap: true,
        })
    }

    /// Returns the stack of one of the kernel's own tasks: one of two statics.
    pub(crate) fn for_service() -> Self {
        struct Memory(UnsafeCell<[[usize; SERVICE_WORDS]; 2]>, UnsafeCell<usize>);
        // SAFETY: only the kernel's hart uses it, before the scheduler runs.
        unsafe impl Sync for Memory {}
        static MEMORY: Memory =
            Memory(UnsafeCell::new([[0; SERVICE_WORDS]; 2]), UnsafeCell::new(0));
        // SAFETY: called twice, for the idle and the timers' task; each call takes a fresh stack.
        unsafe {
            let taken = *MEMORY.1.get();
            *MEMORY.1.get() = taken + 1;
            assert!(taken < 2, "the kernel has two tasks of its own");
            let low = MEMORY.0.get().cast::<usize>().add(taken * SERVICE_WORDS);
            Self {
                low,
                words: SERVICE_WORDS,
                on_heap: false,
            }
        }
    }
}

impl Drop for Stack {
    fn drop(&mut self) {
        if let (true, Some(layout)) = (self.on_heap, Self::layout(self.words)) {
            // SAFETY: allocated with this layout; its task is gone.
            unsafe { alloc::alloc::dealloc(self.low.cast(), layout) };
        }
    }
}

/// The hart that runs the kernel.
static KERNEL_HART: AtomicUsize = AtomicUsize::new(0);

/// Records the calling hart as the kernel's. Called before the first task is made.
pub(crate) fn prepare() {
    KERNEL_HART.store(hart(), Ordering::Relaxed);
}

/// Sets the trap vector and runs the scheduler. Returns only if the kernel could not start.
pub(crate) fn start(_clock: TickSource, _none_left: fn() -> bool) -> Result<(), StartError> {
    let vector = freertos_risc_v_trap_handler as *const () as usize;
    // SAFETY: the vector is the kernel's, aligned, in direct mode. The software interrupt is
    // enabled here; the first task enables interrupts as a whole.
    unsafe {
        core::arch::asm!("csrci mstatus, 8");
        core::arch::asm!("csrw mtvec, {}", in(reg) vector);
        core::arch::asm!("csrs mie, {}", in(reg) MIE_SOFTWARE);
        ffi::vTaskStartScheduler();
    }
    Ok(())
}

/// Does nothing: a kernel that was taken but not started has nothing to release.
pub(crate) fn tear_down() {}

/// Counts the lives of the kernel.
static EPOCH: AtomicU32 = AtomicU32::new(1);

pub(crate) fn epoch() -> u32 {
    EPOCH.load(Ordering::Relaxed)
}

/// Restores handlers and the scheduler's state to power-on, after a reset of the hart.
///
/// # Safety
/// As [`after_reset`](crate::sys::after_reset).
pub(crate) unsafe fn reset() {
    // SAFETY: by the caller's promise nothing reads or writes what is set here.
    unsafe {
        core::arch::asm!("csrci mstatus, 8");
        for source in &SOURCES {
            *source.0.get() = None;
        }
        ffi::tandem_port_reset();
        ffi::vTaskResetState();
        ffi::vTimerResetState();
    }
    MOVE.1.store(0, Ordering::Relaxed);
    IN_INTERRUPT.store(false, Ordering::Relaxed);
    EPOCH.store(epoch().wrapping_add(1), Ordering::Relaxed);
}

static IN_INTERRUPT: AtomicBool = AtomicBool::new(false);

/// Returns whether the caller is a task of the kernel's hart, and not a handler. Other harts have
/// no context, so they cannot call an object.
pub(crate) fn in_task() -> bool {
    hart() == KERNEL_HART.load(Ordering::Relaxed) && !IN_INTERRUPT.load(Ordering::Relaxed)
}

/// Called when the idle task has nothing to do.
pub(crate) fn idle(_none_left: fn() -> bool) {
    wait();
}

/// Waits for an interrupt.
fn wait() {
    // SAFETY: only waits.
    unsafe { core::arch::asm!("wfi") };
}

/// Reads the fine counter for the run time of tasks: `mtime`.
pub(crate) fn run_time() -> u64 {
    let low = ptr::with_exposed_provenance::<u32>(MTIME);
    let high = ptr::with_exposed_provenance::<u32>(MTIME + 4);
    loop {
        // SAFETY: the CLINT's registers, read as words.
        let (before, count, after) = unsafe {
            (
                high.read_volatile(),
                low.read_volatile(),
                high.read_volatile(),
            )
        };
        if before == after {
            return u64::from(after) << 32 | u64::from(count);
        }
    }
}

/// Nanoseconds of a count of `mtime`: 10 MHz, as configCPU_CLOCK_HZ.
const MTIME_NS: u64 = 100;
const COUNTS_PER_TICK: u64 = TICK_NS / MTIME_NS;

/// Converts a span of [`run_time`] to time.
pub(crate) fn run_time_span(counts: u64) -> Duration {
    Duration::from_nanos(counts * MTIME_NS)
}

/// Returns the time of an event, in nanoseconds of `mtime`.
pub(crate) fn timestamp_ns() -> u64 {
    run_time() * MTIME_NS
}

/// The last move of a tick: the count of ticks when it was made, and by how many counts of `mtime`.
static MOVE: (AtomicU32, AtomicI32) = (AtomicU32::new(0), AtomicI32::new(0));

/// Returns when the last tick was due and when the next one is, in nanoseconds of
/// [`timestamp_ns`]'s clock. Called with interrupts masked.
pub(crate) fn tick_times_ns() -> (u64, u64) {
    let next = next_tick();
    // SAFETY: only reads the count of ticks.
    let is_moved = MOVE.0.load(Ordering::Relaxed) == unsafe { ffi::xTaskGetTickCount() };
    let by = if is_moved {
        MOVE.1.load(Ordering::Relaxed)
    } else {
        0
    };
    let last = next.wrapping_sub_signed(by.into()) - COUNTS_PER_TICK;
    (last * MTIME_NS, next * MTIME_NS)
}

/// Returns the count of `mtime` at the next tick. Called with interrupts masked.
fn next_tick() -> u64 {
    // SAFETY: only the tick's interrupt and `set_next_tick` write it after the start.
    unsafe { (&raw const ffi::ullNextTime).read() - COUNTS_PER_TICK }
}

/// Moves the next tick to this time, and all later ones with it. Called with interrupts masked,
/// while no tick is due.
pub(crate) fn set_next_tick(at_ns: u64) {
    let at = at_ns / MTIME_NS;
    let by = at.wrapping_sub(next_tick()) as i32;
    let register = ptr::with_exposed_provenance_mut::<u32>(MTIMECMP + 8 * hart());
    // SAFETY: the two words of the CLINT's register of this hart, and what the tick's interrupt
    // writes to it. The low word is first the largest, so that no value in between is due.
    unsafe {
        register.write_volatile(u32::MAX);
        register.add(1).write_volatile((at >> 32) as u32);
        register.write_volatile(at as u32);
        (&raw mut ffi::ullNextTime).write(at + COUNTS_PER_TICK);
        MOVE.0.store(ffi::xTaskGetTickCount(), Ordering::Relaxed);
    }
    MOVE.1.store(by, Ordering::Relaxed);
}

/// Returns `false`: there is no virtual time.
pub(crate) fn virtual_work(_span: Duration) -> bool {
    false
}

/// Runs `body`. Nothing has to be deferred here: `task::each` itself stops the other tasks.
pub(crate) fn without_others<R>(body: impl FnOnce() -> R) -> R {
    body()
}

/// Panics if the caller must not block.
pub(crate) fn assert_may_block() {
    let status: usize;
    // SAFETY: reads a register.
    unsafe { core::arch::asm!("csrr {}, mstatus", out(reg) status) };
    assert!(
        status & 8 != 0,
        "a call that may block, in a critical section"
    );
}

pub(crate) fn attach(
    interrupt: Interrupt,
    _priority: InterruptPriority,
    handler: &'static mut Handler,
) -> Result<(), HandlerError> {
    let source = SOURCES
        .get(usize::from(interrupt.number()))
        .ok_or(HandlerError::NoSuchSource)?;
    ffi::critical(|| {
        // SAFETY: interrupts are masked, so no handler runs.
        let place = unsafe { &mut *source.0.get() };
        if place.is_some() {
            return Err(HandlerError::HasHandler);
        }
        *place = Some(handler);
        Ok(())
    })
}

/// Rings the doorbell of a hart. Everything that the caller wrote before is visible to the handler.
pub fn ring(hart: usize) {
    let register = ptr::with_exposed_provenance_mut::<u32>(MSIP + 4 * hart);
    // SAFETY: a register of the CLINT; the fence orders the caller's writes to memory before it.
    unsafe {
        core::arch::asm!("fence rw, ow");
        register.write_volatile(1);
    }
}

/// Sets `report` for exceptions and fatal errors, which otherwise halt the hart.
pub fn on_fatal(report: fn(fmt::Arguments<'_>) -> !) {
    ON_FATAL.store(report as *mut (), Ordering::Relaxed);
}

/// Masks interrupts, reports the message, and does not return.
pub(crate) fn fatal(message: fmt::Arguments<'_>) -> ! {
    // SAFETY: masks interrupts, so that nothing interrupts the last message.
    unsafe { core::arch::asm!("csrci mstatus, 8") };
    let report = ON_FATAL.load(Ordering::Relaxed);
    if !report.is_null() {
        // SAFETY: `on_fatal` stored a function of this type.
        let report: fn(fmt::Arguments<'_>) -> ! = unsafe { core::mem::transmute(report) };
        report(message);
    }
    loop {
        wait();
    }
}

fn hart() -> usize {
    let hart: usize;
    // SAFETY: reads a register.
    unsafe { core::arch::asm!("csrr {}, mhartid", out(reg) hart) };
    hart
}

/// Runs a handler. The kernel's trap handler calls this on the interrupt stack, except at a tick.
#[unsafe(no_mangle)]
extern "C" fn tandem_riscv_interrupt(cause: u32) {
    let number = match cause & 0x7FFF_FFFF {
        CAUSE_SOFTWARE => {
            let register = ptr::with_exposed_provenance_mut::<u32>(MSIP + 4 * hart());
            // SAFETY: this acknowledges before the handler runs, so a later ring interrupts again.
            unsafe {
                register.write_volatile(0);
                core::arch::asm!("fence iorw, iorw");
            }
            Interrupt::DOORBELL
        }
        CAUSE_EXTERNAL => Interrupt::EXTERNAL,
        other => fatal(format_args!("interrupt {other} has no source here")),
    };
    // SAFETY: interrupts are masked in a trap, and `attach` masks them.
    let handler = unsafe { &mut *SOURCES[usize::from(number.number())].0.get() };
    let Some(handler) = handler else {
        if number == Interrupt::DOORBELL {
            return;
        }
        fatal(format_args!("an external interrupt without a handler"));
    };
    let context = InterruptContext::new();
    let subject = u32::from(number.number());
    events::record(KernelEventKind::InterruptEntered, subject, timestamp_ns);
    IN_INTERRUPT.store(true, Ordering::Relaxed);
    handler(&context);
    IN_INTERRUPT.store(false, Ordering::Relaxed);
    events::record(KernelEventKind::InterruptLeft, subject, timestamp_ns);
    if context.has_woken() {
        // SAFETY: called in the trap, whose end restores the task that the kernel has chosen.
        unsafe { ffi::tandem_yield_from_interrupt(1) };
    }
}

/// Reports an exception as a fatal error. A call that yields does not reach this function.
#[unsafe(no_mangle)]
extern "C" fn tandem_riscv_exception(cause: u32) {
    let (place, value): (usize, usize);
    // SAFETY: reads registers.
    unsafe {
        core::arch::asm!("csrr {}, mepc", out(reg) place);
        core::arch::asm!("csrr {}, mtval", out(reg) value);
    }
    let task = ffi::current_name();
    fatal(format_args!(
        "exception {cause} at {place:#010x}, value {value:#x}, in task '{task}'"
    ));
}
