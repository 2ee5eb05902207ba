//! The start-up code from reset to main: the vector tables, and the start of processor 1.
//!
//! Processor 1 is held in reset at power-on. Processor 0 clears .bss, starts the clock and the
//! UART, and sets the vector table of processor 1. The board releases processor 1 later.

use crate::{cpu, exit, mhu, timers, uart};
use core::arch::{asm, global_asm};
use core::ptr::write_volatile;

/// System control: the address of processor 1's vector table, and the processors held in reset.
const INITSVTOR1: *mut u32 = 0x5002_1114 as *mut u32;
const CPUWAIT: *mut u32 = 0x5002_1118 as *mut u32;

const SYSTEM_VECTORS: usize = 16;
const INTERRUPTS: usize = 32;

type Handler = unsafe extern "C" fn();

unsafe extern "C" {
    static __stack_0: u32;
    static __stack_1: u32;
    fn tandem_reset_0();
    fn tandem_reset_1();
}

/// A vector table in the processor's format.
#[repr(C, align(1024))]
struct Vectors {
    stack: &'static u32,
    reset: Handler,
    system: [Handler; SYSTEM_VECTORS - 2],
    interrupts: [Handler; INTERRUPTS],
}

const fn vectors(stack: &'static u32, reset: Handler) -> Vectors {
    let mut table = Vectors {
        stack,
        reset,
        system: [exit::on_fault; SYSTEM_VECTORS - 2],
        interrupts: [exit::on_fault; INTERRUPTS],
    };
    // Exception 15 is SysTick.
    table.system[13] = timers::on_alarm;
    table.interrupts[6] = mhu::on_interrupt;
    table.interrupts[7] = mhu::on_interrupt;
    table
}

// SAFETY: link.x defines the symbols; only their addresses are used.
#[unsafe(link_section = ".vectors.0")]
#[used]
static VECTORS_0: Vectors = vectors(unsafe { &__stack_0 }, tandem_reset_0);
// SAFETY: as above.
#[unsafe(link_section = ".vectors.1")]
#[used]
static VECTORS_1: Vectors = vectors(unsafe { &__stack_1 }, tandem_reset_1);

global_asm!(
    ".thumb",
    ".section .text.tandem_reset, \"ax\"",
    ".global tandem_reset_0",
    ".global tandem_reset_1",
    ".thumb_func",
    "tandem_reset_0:",
    // Clears .bss word by word, then calls Rust.
    "ldr r0, =__bss_start",
    "ldr r1, =__bss_end",
    "movs r2, #0",
    "0: cmp r0, r1",
    "beq 1f",
    "str r2, [r0], #4",
    "b 0b",
    "1: bl {start_0}",
    "b .",
    ".thumb_func",
    "tandem_reset_1:",
    "bl {start_1}",
    "b .",
    ".ltorg",
    start_0 = sym start_0,
    start_1 = sym start_1,
);

unsafe extern "C" {
    /// Defined by the program: see `entry!`.
    fn tandem_main(cpu: usize) -> !;
}

extern "C" fn start_0() -> ! {
    timers::start();
    uart::start();
    // SAFETY: processor 1 has not run; its table is complete and is never changed.
    unsafe {
        write_volatile(INITSVTOR1, (&raw const VECTORS_1).addr() as u32);
    }
    main()
}

/// Starts processor 1. Has no effect if it already runs.
pub(crate) fn release_second() {
    // SAFETY: its vector table is complete and is never changed; the register only ends its reset.
    unsafe {
        asm!("dsb");
        write_volatile(CPUWAIT, 0);
    }
}

extern "C" fn start_1() -> ! {
    main()
}

fn main() -> ! {
    mhu::enable();
    // SAFETY: the program defines the function with this signature by `entry!`.
    unsafe { tandem_main(cpu::number()) }
}
