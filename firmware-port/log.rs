//! Writes whole lines to a log that several processors share. Each board includes this file.

use core::fmt::{self, Write};
use core::sync::atomic::{AtomicBool, Ordering};

static BUSY: AtomicBool = AtomicBool::new(false);

/// Writes a line. While another processor writes one, calls `pause` repeatedly.
pub(crate) fn write_line(uart: &mut impl Write, pause: impl Fn(), line: fmt::Arguments<'_>) {
    // Acquire pairs with the Release below: only one processor writes at a time.
    while BUSY.swap(true, Ordering::Acquire) {
        pause();
    }
    // Writing to the UART cannot fail.
    let _ = writeln!(uart, "{line}");
    BUSY.store(false, Ordering::Release);
}

/// Writes a line to the log.
#[macro_export]
macro_rules! log {
    ($($argument:tt)*) => {
        $crate::uart::print(::core::format_args!($($argument)*))
    };
}
