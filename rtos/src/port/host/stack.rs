//! Stacks with a page below them that nobody may touch.

use super::{state, tick};
use crate::sys::task;
use core::ptr;

/// The smallest stack in words: frames of signals with all vector registers (3.7 KiB with AVX-512),
/// of which several lie on each other while interrupts come in quick succession.
pub(crate) const MIN_STACK_WORDS: usize = (64 << 10) / size_of::<usize>();
/// Bytes of a page, and of the guard.
pub(super) const PAGE: usize = 4096;
/// Bytes of the stacks of the idle task and of the timers' task.
const SERVICE_BYTES: usize = 64 << 10;

/// A stack of a task.
pub(crate) struct Stack {
    /// Its lowest word.
    pub(crate) low: *mut usize,
    /// How many words it has.
    pub(crate) words: usize,
    mapped: bool,
}

impl Stack {
    /// Memory of somebody else.
    ///
    /// # Safety
    /// It is used by nobody else as long as this stack is.
    pub(crate) unsafe fn borrowed(low: *mut usize, words: usize) -> Self {
        Self {
            low,
            words,
            mapped: false,
        }
    }

    /// Fresh pages with a guard below them.
    pub(crate) fn allocate(bytes: usize) -> Option<Self> {
        let bytes = bytes
            .checked_next_multiple_of(PAGE)?
            .max(MIN_STACK_WORDS * size_of::<usize>());
        let whole = bytes.checked_add(PAGE)?;
        let flags = libc::MAP_PRIVATE | libc::MAP_ANONYMOUS | libc::MAP_STACK | libc::MAP_NORESERVE;
        let access = libc::PROT_READ | libc::PROT_WRITE;
        // SAFETY: a fresh anonymous mapping, not at a fixed address, touches no other memory.
        let base = unsafe { libc::mmap(ptr::null_mut(), whole, access, flags, -1, 0) };
        if base == libc::MAP_FAILED {
            return None;
        }
        // SAFETY: the first page of the mapping above.
        if unsafe { libc::mprotect(base, PAGE, libc::PROT_NONE) } != 0 {
            // SAFETY: the mapping above, which nobody uses.
            unsafe { libc::munmap(base, whole) };
            return None;
        }
        Some(Self {
            low: base.wrapping_byte_add(PAGE).cast(),
            words: bytes / size_of::<usize>(),
            mapped: true,
        })
    }

    /// For a task of the kernel itself. Kept for the life of the process.
    pub(crate) fn for_service() -> Self {
        match Self::allocate(SERVICE_BYTES) {
            Some(stack) => stack,
            None => super::fatal(format_args!("no memory for the stack of a kernel's task")),
        }
    }
}

impl Drop for Stack {
    fn drop(&mut self) {
        if self.mapped {
            let base = self.low.wrapping_byte_sub(PAGE).cast();
            // SAFETY: the mapping of `allocate`; its task is gone.
            unsafe { libc::munmap(base, self.words * size_of::<usize>() + PAGE) };
        }
    }
}

/// The idle task has nothing to do: ends the scheduler if no task is left, or sleeps until a
/// signal. A signal that came before the call has been handled, and if it woke a task, that one ran
/// first; so none is slept through.
pub(crate) fn idle() {
    if task::none_left() {
        state::leave();
    } else if tick::is_virtual() {
        tick::skip_to_next();
    } else {
        // SAFETY: no descriptors, no time limit, and the signal mask stays as it is.
        unsafe { libc::ppoll(ptr::null_mut(), 0, ptr::null(), ptr::null()) };
    }
}
