//! The kernel's C interface, and the few wrappers around it that need `unsafe`.
#![allow(unsafe_code)]

pub(crate) mod ffi;
pub(crate) mod mutex;
pub(crate) mod queue;
pub(crate) mod set;
pub(crate) mod task;
pub(crate) mod timer;
pub(crate) mod trace;

use crate::port;

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

/// The life of the kernel that an object was made for.
///
/// What the kernel of an earlier life knew (waiting tasks, active timers) is gone: an object of it
/// is never passed to the kernel again.
pub(crate) struct Life(u32);

impl Life {
    pub(crate) fn current() -> Self {
        Self(port::epoch())
    }

    /// Whether the object is of this life.
    pub(crate) fn is_current(&self) -> bool {
        self.0 == port::epoch()
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
