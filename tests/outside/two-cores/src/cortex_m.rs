//! One Cortex-M4 of QEMU's machine `mps2-an386`: system A, system B and the vehicle in turn.

use core::fmt::Write;
use core::panic::PanicInfo;

use cortex_m::peripheral::syst::SystClkSource;
use cortex_m_semihosting::{debug, hio};
use tandem_redundancy::tandem_board::{Duration, Instant, SystemId};
use tandem_shm::incarnation::Incarnation;
use tandem_shm::map::Map;

use crate::lmu::{LAYOUT, LMU};
use crate::system::System;
use crate::vehicle::Vehicle;
use crate::{CUT_MS, END_MS};

/// Ticks of the processor's clock in a millisecond.
const TICKS_PER_MS: u32 = 25_000;

#[cortex_m_rt::entry]
fn main() -> ! {
    let good = run().unwrap_or(false);
    debug::exit(if good {
        debug::EXIT_SUCCESS
    } else {
        debug::EXIT_FAILURE
    });
    loop {}
}

/// Runs all nodes once each millisecond; `None` if something is not there.
fn run() -> Option<bool> {
    let mut log = hio::hstdout().ok()?;
    let mut timer = cortex_m::Peripherals::take()?.SYST;
    timer.set_clock_source(SystClkSource::Core);
    timer.set_reload(TICKS_PER_MS - 1);
    timer.clear_current();
    timer.enable_counter();
    timer.enable_interrupt();

    let map = Map::format(&LMU.0, LAYOUT).ok()?;
    let core = Incarnation::new(0, 1)?;
    map.incarnations().announce(core).ok()?;
    let mut now = Instant::ORIGIN;
    let mut a = System::attach(SystemId::A, &map, core, now).ok()?;
    let mut b = System::attach(SystemId::B, &map, core, now).ok()?;
    let mut vehicle = Vehicle::attach(&map, core, now).ok()?;
    for ms in 0..END_MS {
        if ms < CUT_MS {
            a.step(now, &mut log);
        } else if ms == CUT_MS {
            let _ = writeln!(log, "{ms:4} ms A: stops");
        }
        b.step(now, &mut log);
        vehicle.step(now);
        while !timer.has_wrapped() {
            cortex_m::asm::wfi();
        }
        now = now + Duration::from_ms(1);
    }
    let good = vehicle.judge(&mut log) & b.is_master() & (a.refused() + b.refused() == 0);
    let _ = writeln!(log, "{}", if good { "PASS" } else { "FAIL" });
    Some(good)
}

/// Ends `wfi`; the loop reads the flag of the timer.
#[cortex_m_rt::exception]
fn SysTick() {}

#[panic_handler]
fn panic(info: &PanicInfo<'_>) -> ! {
    if let Ok(mut log) = hio::hstdout() {
        let _ = writeln!(log, "{info}");
    }
    debug::exit(debug::EXIT_FAILURE);
    loop {}
}
