//! Ends a program by semihosting: on request, after a panic, or after a fault.

use crate::cpu;
use crate::uart::print_now;
use core::arch::asm;
use core::panic::PanicInfo;

const SYS_EXIT_EXTENDED: u32 = 0x20;
const APPLICATION_EXIT: u32 = 0x2_0026;

/// The status of the emulator if a processor panicked.
pub const PANICKED: u8 = 101;
/// The status of the emulator if a fault or an interrupt without a handler occurred.
pub const FAULT: u8 = 102;

/// Ends the emulator with this status.
pub fn exit(status: u8) -> ! {
    let arguments = [APPLICATION_EXIT, status.into()];
    loop {
        // SAFETY: a call to the emulator, which reads two words and does not return.
        unsafe {
            asm!(
                "bkpt 0xAB",
                inout("r0") SYS_EXIT_EXTENDED => _,
                in("r1") arguments.as_ptr(),
            );
        }
    }
}

#[panic_handler]
fn on_panic(info: &PanicInfo<'_>) -> ! {
    print_now(format_args!("processor {}: {info}", cpu::number()));
    exit(PANICKED)
}

/// Handler of all interrupts that must not occur.
pub(crate) extern "C" fn on_fault() {
    let exception: u32;
    // SAFETY: reads the number of the exception.
    unsafe { asm!("mrs {0}, IPSR", out(reg) exception) };
    let cpu = cpu::number();
    print_now(format_args!("processor {cpu}: exception {exception}"));
    exit(FAULT)
}
