//! The kernel's C interface, and the few wrappers around it that need `unsafe`.
#![allow(unsafe_code)]

pub(crate) mod event;
pub(crate) mod ffi;
pub(crate) mod mutex;
pub(crate) mod queue;
pub(crate) mod shared;
pub(crate) mod sink;
pub(crate) mod task;
pub(crate) mod timer;

use crate::InUse;
use crate::port;
use core::sync::atomic::{AtomicU32, Ordering};

/// Runs `body` with interrupts masked. Nests. Ends also if `body` unwinds.
pub(crate) fn critical<R>(body: impl FnOnce() -> R) -> R {
    struct End;
    impl Drop for End {
        fn drop(&mut self) {
            // SAFETY: pairs with the entry below.
            unsafe { ffi::tandem_exit_critical() };
        }
    }
    // SAFETY: callable from every task, and before the scheduler runs; `End` pairs with it.
    unsafe { ffi::tandem_enter_critical() };
    let _end = End;
    body()
}

/// Whether an object is made, and for which life of the kernel.
///
/// What the kernel of an earlier life knew (waiting tasks, active timers) is gone: an object of it
/// is never passed to the kernel again.
pub(crate) struct Life(AtomicU32);

impl Life {
    /// Of no life: not made.
    pub(crate) const fn none() -> Self {
        Self(AtomicU32::new(0))
    }

    /// Takes the memory for an object of this life.
    pub(crate) fn claim(&self) -> Result<(), InUse> {
        let now = port::epoch();
        if self.0.swap(now, Ordering::Relaxed) == now {
            Err(InUse)
        } else {
            Ok(())
        }
    }

    /// Whether the object is of this life.
    pub(crate) fn is_current(&self) -> bool {
        self.0.load(Ordering::Relaxed) == port::epoch()
    }

    /// # Panics
    /// If the object is of an earlier life.
    pub(crate) fn assert_current(&self) {
        assert!(
            self.is_current(),
            "an object that was made for an earlier life of the kernel"
        );
    }
}
