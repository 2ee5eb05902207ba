//! Stacks with a page below them that faults when it is touched.

use super::process::fatal;
use core::ptr;

/// The smallest stack in bytes. A frame of a signal with all vector registers takes 3.7 KiB with
/// AVX-512, and several may be on the stack when interrupts follow each other quickly.
const MIN_BYTES: usize = 64 << 10;
/// Bytes of the stacks of the idle task and of the timers' task.
const SERVICE_BYTES: usize = 64 << 10;

/// A stack of a task.
pub(crate) struct Stack {
    /// Its lowest word.
    pub(crate) low: *mut usize,
    /// How many words it has.
    pub(crate) words: usize,
}

/// Returns the size of a page and of the guard, bytes: 4 KiB on x86_64, 4 to 64 KiB on aarch64.
pub(super) fn page() -> usize {
    // SAFETY: reads a value that Linux passes to every process at its start.
    unsafe { libc::getauxval(libc::AT_PAGESZ) as usize }
}

/// Returns the sizes of a stack with room for `bytes` and of its mapping with the guard, in bytes.
fn sizes(bytes: usize, page: usize) -> Option<(usize, usize)> {
    let stack = bytes.max(MIN_BYTES).checked_next_multiple_of(page)?;
    Some((stack, stack.checked_add(page)?))
}

impl Stack {
    /// Maps a new stack with a guard below it.
    pub(crate) fn allocate(bytes: usize) -> Option<Self> {
        let page = page();
        let (bytes, whole) = sizes(bytes, page)?;
        let flags = libc::MAP_PRIVATE | libc::MAP_ANONYMOUS | libc::MAP_STACK | libc::MAP_NORESERVE;
        let access = libc::PROT_READ | libc::PROT_WRITE;
        // SAFETY: a fresh anonymous mapping, not at a fixed address, touches no other memory.
        let base = unsafe { libc::mmap(ptr::null_mut(), whole, access, flags, -1, 0) };
        if base == libc::MAP_FAILED {
            return None;
        }
        // SAFETY: the first page of the mapping above.
        if unsafe { libc::mprotect(base, page, libc::PROT_NONE) } != 0 {
            // SAFETY: the mapping above, which is unused.
            unsafe { libc::munmap(base, whole) };
            return None;
        }
        Some(Self {
            low: base.wrapping_byte_add(page).cast(),
            words: bytes / size_of::<usize>(),
        })
    }

    /// Maps the stack of one of the kernel's own tasks. It is never unmapped.
    pub(crate) fn for_service() -> Self {
        match Self::allocate(SERVICE_BYTES) {
            Some(stack) => stack,
            None => fatal(format_args!("no memory for the stack of a kernel's task")),
        }
    }
}

impl Drop for Stack {
    fn drop(&mut self) {
        let base = self.low.wrapping_byte_sub(page()).cast();
        // SAFETY: the mapping of `allocate`; its task is gone.
        unsafe { libc::munmap(base, self.words * size_of::<usize>() + page()) };
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Linux on aarch64 has pages of 4, 16 or 64 KiB. If the guard were not a whole page, it would
    /// share one with the stack, whose lower part could then not be used.
    #[test]
    fn a_stack_and_its_guard_are_whole_pages_of_any_size() {
        for page in [4 << 10, 16 << 10, 64 << 10] {
            for bytes in [0, 1, 64 << 10, (64 << 10) + 1, 1 << 20] {
                let (stack, whole) = sizes(bytes, page).unwrap();
                assert!(stack >= bytes.max(64 << 10));
                assert_eq!((stack % page, whole - stack), (0, page));
            }
        }
        assert_eq!(sizes(usize::MAX, 4096), None);
        assert!(page().is_power_of_two() && page() >= 4096);
    }
}
