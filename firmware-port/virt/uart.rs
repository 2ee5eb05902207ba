//! The log: QEMU's 16550, written by polling.

use core::fmt::{self, Write};
use core::ptr::{read_volatile, write_volatile};

use super::log::write_line;

const UART: usize = 0x1000_0000;
const LINE_STATUS: usize = 5;
const TRANSMITTER_EMPTY: u8 = 1 << 5;

struct Uart;

impl Write for Uart {
    fn write_str(&mut self, text: &str) -> fmt::Result {
        for byte in text.bytes() {
            // SAFETY: the registers of the 16550; `write_line` excludes other harts.
            unsafe {
                while read_volatile((UART + LINE_STATUS) as *const u8) & TRANSMITTER_EMPTY == 0 {}
                write_volatile(UART as *mut u8, byte);
            }
        }
        Ok(())
    }
}

/// Writes a line. Blocks; task context.
pub fn print(line: fmt::Arguments<'_>) {
    if cfg!(not(feature = "log")) {
        return;
    }
    // Interrupts are off, so that no reset interrupts this hart while it uses the UART.
    crate::hart::without_interrupts(|| write_line(&mut Uart, crate::hart::yield_turn, line));
}

/// Writes a line without waiting for another hart: for a message that ends the program.
pub(crate) fn print_now(line: fmt::Arguments<'_>) {
    let _ = writeln!(Uart, "{line}");
}
