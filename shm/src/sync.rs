//! Selects the atomics: those of the machine, of loom, or of the step injector in `fault`.

pub use core::sync::atomic::Ordering;

#[cfg(not(any(loom, stepped, test)))]
pub use core::sync::atomic::{AtomicU32, fence};

#[cfg(loom)]
pub use loom::sync::atomic::fence;

#[cfg(any(loom, stepped, test))]
pub use crate::fault::AtomicU32;
#[cfg(all(any(stepped, test), not(loom)))]
pub use core::sync::atomic::fence;

/// Tells the processor (or loom) that this is a spin loop, `rounds` times. Never blocks.
#[inline]
pub fn spin(rounds: u32) {
    for _ in 0..rounds {
        #[cfg(not(loom))]
        core::hint::spin_loop();
    }
    // For loom one yield is enough.
    #[cfg(loom)]
    loom::thread::yield_now();
}
