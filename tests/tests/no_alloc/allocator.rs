//! An allocator that counts requests while a core runs.

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;

thread_local! {
    /// Whether requests of this thread are counted.
    static ARMED: Cell<bool> = const { Cell::new(false) };
    /// Number of counted requests.
    static REQUESTS: Cell<u64> = const { Cell::new(0) };
}

/// Counts the allocations, reallocations and deallocations of each thread in which it is armed.
struct Counting;

#[global_allocator]
static ALLOCATOR: Counting = Counting;

fn request() {
    if ARMED.get() {
        REQUESTS.set(REQUESTS.get() + 1);
    }
}

// SAFETY: every call is passed to the system's allocator unchanged. Counting neither allocates nor
// unwinds: the thread-locals are const-initialised and have no destructor, so they need no
// registration and exist until the thread ends.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        request();
        // SAFETY: the caller keeps the contract of `alloc`.
        unsafe { System.alloc(layout) }
    }

    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        request();
        // SAFETY: the caller keeps the contract of `alloc_zeroed`.
        unsafe { System.alloc_zeroed(layout) }
    }

    unsafe fn realloc(&self, pointer: *mut u8, layout: Layout, new_size: usize) -> *mut u8 {
        request();
        // SAFETY: the caller keeps the contract of `realloc`; the pointer came from `System`.
        unsafe { System.realloc(pointer, layout, new_size) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        request();
        // SAFETY: the caller keeps the contract of `dealloc`; the pointer came from `System`.
        unsafe { System.dealloc(pointer, layout) }
    }
}

/// Restores the previous state on drop, so that regions can be nested.
struct Region {
    before: bool,
}

impl Region {
    fn enter(armed: bool) -> Self {
        Self {
            before: ARMED.replace(armed),
        }
    }
}

impl Drop for Region {
    fn drop(&mut self) {
        ARMED.set(self.before);
    }
}

/// Returns the number of requests in `work` outside [`uncounted`] regions, and its result.
pub(crate) fn counted<R>(work: impl FnOnce() -> R) -> (u64, R) {
    let before = REQUESTS.get();
    let result = {
        let _armed = Region::enter(true);
        work()
    };
    (REQUESTS.get() - before, result)
}

/// Runs work whose requests are not counted, because they are not the core's.
pub(crate) fn uncounted<R>(work: impl FnOnce() -> R) -> R {
    let _disarmed = Region::enter(false);
    work()
}

/// Counts all requests of this thread from the first call on, and returns their number.
pub(crate) fn watch_this_thread() -> u64 {
    ARMED.set(true);
    REQUESTS.get()
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::hint::black_box;

    #[test]
    fn each_kind_of_request_counts() {
        let (allocated, mut bytes) = counted(|| black_box(Vec::<u8>::with_capacity(16)));
        assert_eq!(allocated, 1);
        let (grown, ()) = counted(|| bytes.reserve_exact(black_box(4096)));
        assert_eq!(grown, 1);
        let (freed, ()) = counted(|| drop(black_box(bytes)));
        assert_eq!(freed, 1);
        let (zeroed, _bytes) = counted(|| black_box(vec![0_u8; black_box(64)]));
        assert_eq!(zeroed, 1);
    }

    #[test]
    fn only_the_armed_part_counts() {
        let allocate = || drop(black_box(Box::new(1)));
        allocate();
        let (requests, ()) = counted(|| {
            uncounted(allocate);
            uncounted(|| uncounted(allocate));
            allocate();
        });
        assert_eq!(requests, 2, "the last box, made and dropped");
        let (requests, ()) = counted(|| ());
        assert_eq!(requests, 0);
    }
}
