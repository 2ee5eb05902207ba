//! Two cores of QEMU's RISC-V machine `virt`: system A on core 0, system B and the vehicle on 1.

use core::arch::global_asm;
use core::fmt::{self, Write};
use core::panic::PanicInfo;
use core::ptr::{read_volatile, write_volatile};

use tandem_redundancy::tandem_board::{Instant, SystemId};
use tandem_shm::incarnation::Incarnation;
use tandem_shm::lock::Lock;
use tandem_shm::map::Map;
use tandem_shm::sync::spin;

use crate::lmu::{CONSOLE, LAYOUT, LMU};
use crate::system::System;
use crate::vehicle::Vehicle;
use crate::{CUT_MS, END_MS};

const FINISHER: *mut u32 = 0x0010_0000 as *mut u32;
const UART: *mut u8 = 0x1000_0000 as *mut u8;
const SOFTWARE_INTERRUPT: usize = 0x0200_0000;
const TIMER_COMPARE: usize = 0x0200_4000;
const TIMER: usize = 0x0200_BFF8;
/// The timer counts 10 MHz.
const NS_PER_TICK: u64 = 100;
const TICKS_PER_MS: u64 = 10_000;

// Core 1 waits for its software interrupt: core 0 initialises the memory and formats the LMU.
global_asm!(
    ".section .init.mp_hook, \"ax\"",
    ".global _mp_hook",
    "_mp_hook:",
    "beqz a0, 2f",
    "csrsi mie, 8",
    "1: wfi",
    "csrr t0, mip",
    "andi t0, t0, 8",
    "beqz t0, 1b",
    "csrci mie, 8",
    "li a0, 0",
    "ret",
    "2: li a0, 1",
    "ret",
);

#[riscv_rt::entry]
fn main(hart: usize) -> ! {
    let map = match hart {
        0 => Map::format(&LMU.0, LAYOUT).ok(),
        _ => Map::attach(&LMU.0, LAYOUT).ok(),
    };
    let (Some(map), Some(core)) = (map, Incarnation::new(hart, 1)) else {
        panic!("no map");
    };
    if map.incarnations().announce(core).is_err() {
        panic!("a core runs twice");
    }
    if hart == 0 {
        // SAFETY: this register starts core 1, which waits for it.
        unsafe { write_volatile((SOFTWARE_INTERRUPT as *mut u32).add(1), 1) };
    }
    let Ok(lock) = CONSOLE.attach(&map, core) else {
        panic!("no lock");
    };
    let mut log = Console { lock };
    if run(hart, &map, core, &mut log).is_err() {
        panic!("an end of the shared memory is taken");
    }
    // Without power.
    loop {
        // SAFETY: no interrupt is enabled: the core stops.
        unsafe { riscv::register::mie::clear_mtimer() };
        riscv::asm::wfi();
    }
}

/// Runs the nodes of this core, once each millisecond.
fn run(
    hart: usize,
    map: &Map<'static>,
    core: Incarnation,
    log: &mut Console,
) -> Result<(), tandem_shm::region::EndError> {
    // SAFETY: interrupts are off; the timer only ends `wfi`.
    unsafe { riscv::register::mie::set_mtimer() };
    let id = if hart == 0 { SystemId::A } else { SystemId::B };
    let mut system = System::attach(id, map, core, now())?;
    let mut vehicle = match hart {
        0 => None,
        _ => Some(Vehicle::attach(map, core, now())?),
    };
    let mut next = ticks();
    loop {
        let ms = now().as_ns() / 1_000_000;
        if hart == 0 && ms >= CUT_MS {
            let _ = writeln!(log, "{ms:4} ms A: stops");
            return Ok(());
        }
        system.step(now(), log);
        if let Some(vehicle) = &mut vehicle {
            vehicle.step(now());
            if ms >= END_MS {
                let good = vehicle.judge(log) & system.is_master() & (system.refused() == 0);
                let _ = writeln!(log, "{}", if good { "PASS" } else { "FAIL" });
                // SAFETY: QEMU ends: 0x5555 is success, 0x3333 failure with a code.
                unsafe { write_volatile(FINISHER, if good { 0x5555 } else { 0x1_3333 }) };
            }
        }
        next += TICKS_PER_MS;
        sleep_until(hart, next);
    }
}

fn sleep_until(hart: usize, tick: u64) {
    let compare = (TIMER_COMPARE + 8 * hart) as *mut u32;
    // SAFETY: the compare register of this core. The high word is set first to no time at all.
    unsafe {
        write_volatile(compare.add(1), u32::MAX);
        write_volatile(compare, tick as u32);
        write_volatile(compare.add(1), (tick >> 32) as u32);
    }
    while ticks() < tick {
        riscv::asm::wfi();
    }
}

/// Reads the timer, which both cores share.
fn ticks() -> u64 {
    let timer = TIMER as *const u32;
    loop {
        // SAFETY: registers that can always be read.
        let [high, low, again] = unsafe {
            [
                read_volatile(timer.add(1)),
                read_volatile(timer),
                read_volatile(timer.add(1)),
            ]
        };
        if high == again {
            return u64::from(high) << 32 | u64::from(low);
        }
    }
}

fn now() -> Instant {
    Instant::from_ns(ticks() * NS_PER_TICK)
}

/// The serial console of both cores: a lock keeps their lines apart.
struct Console {
    lock: Lock<'static>,
}

impl Write for Console {
    fn write_fmt(&mut self, arguments: fmt::Arguments<'_>) -> fmt::Result {
        let _turn = self.lock.lock(u32::MAX, spin).map_err(|_| fmt::Error)?;
        Uart.write_fmt(arguments)
    }

    fn write_str(&mut self, text: &str) -> fmt::Result {
        self.write_fmt(format_args!("{text}"))
    }
}

struct Uart;

impl Write for Uart {
    fn write_str(&mut self, text: &str) -> fmt::Result {
        for byte in text.bytes() {
            // SAFETY: the transmit register of QEMU's 16550, which is always ready.
            unsafe { write_volatile(UART, byte) };
        }
        Ok(())
    }
}

#[panic_handler]
fn panic(info: &PanicInfo<'_>) -> ! {
    let _ = writeln!(Uart, "{info}");
    // SAFETY: ends QEMU with code 2.
    unsafe { write_volatile(FINISHER, 0x2_3333) };
    loop {}
}
