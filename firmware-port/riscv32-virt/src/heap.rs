//! The heap of the hart that runs a kernel. It never frees single allocations, because it is for
//! programs that allocate only while they start.

use core::alloc::{GlobalAlloc, Layout};
use core::cell::UnsafeCell;
use core::sync::atomic::{AtomicUsize, Ordering};

/// Bytes of the heap. Only programs that use it link it.
pub const BYTES: usize = 160 << 10;

#[repr(align(64))]
struct Heap {
    memory: UnsafeCell<[u8; BYTES]>,
    used: AtomicUsize,
}

// SAFETY: each byte is allocated once: `used` only increases, by compare-and-swap.
unsafe impl Sync for Heap {}

#[global_allocator]
static HEAP: Heap = Heap {
    memory: UnsafeCell::new([0; BYTES]),
    used: AtomicUsize::new(0),
};

// SAFETY: `alloc` returns aligned memory inside `memory`, and never the same bytes again.
unsafe impl GlobalAlloc for Heap {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        let mut begin = 0;
        let place = |used: usize| {
            begin = used.checked_next_multiple_of(layout.align().min(64))?;
            begin.checked_add(layout.size()).filter(|end| *end <= BYTES)
        };
        let fits = layout.align() <= 64
            && self
                .used
                .fetch_update(Ordering::Relaxed, Ordering::Relaxed, place)
                .is_ok();
        if !fits {
            return core::ptr::null_mut();
        }
        self.memory.get().cast::<u8>().wrapping_add(begin)
    }

    unsafe fn dealloc(&self, _: *mut u8, _: Layout) {}
}

/// Frees the whole heap, after a reset of the hart that uses it.
///
/// # Safety
/// No earlier allocation is used again.
pub unsafe fn restart() {
    HEAP.used.store(0, Ordering::Relaxed);
}
