//! Ends a program through the emulator's test device: on request, after a panic or an exception.

use crate::uart::print_now;
use core::panic::PanicInfo;
use core::ptr::write_volatile;

const FINISHER: *mut u32 = 0x0010_0000 as *mut u32;
const PASS: u32 = 0x5555;
const FAIL: u32 = 0x3333;

/// Ends the emulator with this status.
pub fn exit(status: u16) -> ! {
    let value = match status {
        0 => PASS,
        code => u32::from(code) << 16 | FAIL,
    };
    // SAFETY: the only register of the test device; the store ends the emulator.
    unsafe { write_volatile(FINISHER, value) };
    crate::hart::park()
}

/// The status of the emulator if a hart panicked.
pub const PANICKED: u16 = 101;
/// The status of the emulator if an exception occurred.
pub const EXCEPTION: u16 = 102;

#[panic_handler]
fn on_panic(info: &PanicInfo<'_>) -> ! {
    if cfg!(feature = "log") {
        print_now(format_args!("hart {}: {info}", crate::hart::number()));
    }
    exit(PANICKED)
}

#[unsafe(no_mangle)]
extern "C" fn tandem_on_exception(cause: usize, at: usize, value: usize) -> ! {
    let hart = crate::hart::number();
    if cfg!(feature = "log") {
        print_now(format_args!(
            "hart {hart}: exception {cause:#x} at {at:#x}, value {value:#x}"
        ));
    }
    exit(EXCEPTION)
}
