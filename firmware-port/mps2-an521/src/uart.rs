//! The log: UART 0, written by polling.

use core::fmt::{self, Write};
use core::ptr::{read_volatile, write_volatile};

use crate::log::write_line;

const UART: usize = 0x5020_0000;
const DATA: *mut u32 = UART as *mut u32;
const STATE: *const u32 = (UART + 0x4) as *const u32;
const CONTROL: *mut u32 = (UART + 0x8) as *mut u32;
const BAUD_DIVIDER: *mut u32 = (UART + 0x10) as *mut u32;
const TRANSMIT_FULL: u32 = 1;
const TRANSMIT_ENABLE: u32 = 1;

struct Uart;

impl Write for Uart {
    fn write_str(&mut self, text: &str) -> fmt::Result {
        for byte in text.bytes() {
            // SAFETY: the UART's registers; `write_line` excludes the other processor.
            unsafe {
                while read_volatile(STATE) & TRANSMIT_FULL != 0 {}
                write_volatile(DATA, byte.into());
            }
        }
        Ok(())
    }
}

/// Switches the transmitter on. Processor 0 calls this.
pub(crate) fn start() {
    // SAFETY: the UART's registers, before any processor writes to it.
    unsafe {
        // The smallest divider that the UART accepts; there is no real line.
        write_volatile(BAUD_DIVIDER, 16);
        write_volatile(CONTROL, TRANSMIT_ENABLE);
    }
}

/// Writes a line. Blocks; task context.
pub fn print(line: fmt::Arguments<'_>) {
    write_line(&mut Uart, core::hint::spin_loop, line);
}

/// Writes a line without waiting for the other processor: for a message that ends the program.
pub(crate) fn print_now(line: fmt::Arguments<'_>) {
    let _ = writeln!(Uart, "{line}");
}
