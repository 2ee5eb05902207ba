//! Functions for the whole process: saving `errno`, and ending the process with a message.

use super::state;
use core::fmt::{self, Write};

/// Runs `body` and restores `errno`, which all tasks share because they share a thread.
pub(super) fn keeping_errno<R>(body: impl FnOnce() -> R) -> R {
    // SAFETY: the address of this thread's errno; all tasks are on this thread.
    let errno = unsafe { *libc::__errno_location() };
    let result = body();
    // SAFETY: as above.
    unsafe { *libc::__errno_location() = errno };
    result
}

pub(super) fn errno() -> i32 {
    // SAFETY: the address of this thread's errno.
    unsafe { *libc::__errno_location() }
}

/// The largest message in bytes, with its line end; longer text is cut.
const LAST_WORDS: usize = 512;

/// The text of a process's last message, built without an allocator.
struct LastWords {
    text: [u8; LAST_WORDS],
    length: usize,
}

impl Write for LastWords {
    fn write_str(&mut self, part: &str) -> fmt::Result {
        let part = part.as_bytes();
        let taken = part.len().min(self.text.len() - 1 - self.length);
        self.text[self.length..][..taken].copy_from_slice(&part[..taken]);
        self.length += taken;
        Ok(())
    }
}

/// Prints a line to standard error without allocating or locking.
fn print_raw(message: fmt::Arguments<'_>) {
    let mut words = LastWords {
        text: [0; LAST_WORDS],
        length: 0,
    };
    let _ = words.write_fmt(message);
    words.text[words.length] = b'\n';
    // SAFETY: writes from a valid buffer; async-signal-safe.
    unsafe { libc::write(2, words.text.as_ptr().cast(), words.length + 1) };
}

/// Ends the process with a message. Callable from anywhere, including signal handlers.
pub(crate) fn fatal(message: fmt::Arguments<'_>) -> ! {
    state::mask_for_good();
    print_raw(format_args!("tandem-rtos: {message}"));
    // SAFETY: ends the process.
    unsafe { libc::abort() }
}
