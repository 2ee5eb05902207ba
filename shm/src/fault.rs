//! Tests only: atomics that count accesses. A test can kill or freeze an operation at any access.
//!
//! They wrap the machine's atomics in unit tests and in builds with `--cfg stepped`, and loom's in
//! loom models.
#![allow(unreachable_pub, reason = "loom models are outside of the crate")]

use core::cell::RefCell;
#[cfg(not(loom))]
use core::sync::atomic::AtomicU32 as Word;
use core::sync::atomic::Ordering;
#[cfg(loom)]
use loom::sync::atomic::AtomicU32 as Word;
use std::boxed::Box;
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};

/// The action that runs just before the chosen access.
type Event = Box<dyn FnOnce()>;

enum Mode {
    /// Every access is performed.
    Free,
    /// After this many accesses the action runs.
    Armed(usize, Event),
    /// The operation was killed: the destructors that run while it unwinds do not access memory.
    Dead,
}

#[cfg(not(loom))]
std::thread_local! {
    static MODE: RefCell<Mode> = const { RefCell::new(Mode::Free) };
}
#[cfg(all(test, not(any(loom, miri))))]
std::thread_local! {
    static SWITCHING: core::cell::Cell<bool> = const { core::cell::Cell::new(false) };
}
// Each thread of the model has its own mode.
#[cfg(loom)]
loom::thread_local! {
    static MODE: RefCell<Mode> = RefCell::new(Mode::Free);
}

fn set_mode(mode: Mode) -> Mode {
    MODE.with(|current| current.replace(mode))
}

/// Counts one access and runs the armed action. Returns whether the access reaches the memory.
fn step() -> bool {
    let mode = set_mode(Mode::Free);
    // Other cores of a random schedule run only here; `mode` keeps this core's mode.
    #[cfg(all(test, not(any(loom, miri))))]
    if SWITCHING.get() && !matches!(mode, Mode::Dead) {
        shuttle::thread::yield_now();
    }
    match mode {
        Mode::Free => true,
        Mode::Dead => {
            set_mode(Mode::Dead);
            false
        }
        Mode::Armed(0, event) => {
            event();
            true
        }
        Mode::Armed(left, event) => {
            set_mode(Mode::Armed(left - 1, event));
            true
        }
    }
}

/// Payload of the panic that simulates `kill -9`.
struct Killed;

/// Runs `operation` and kills it just before its access number `at` (from 0). Returns `None` if it
/// was killed, `Some` if it ended before that access.
pub fn kill_at<T>(at: usize, operation: impl FnOnce() -> T) -> Option<T> {
    let kill: Event = Box::new(|| {
        set_mode(Mode::Dead);
        resume_unwind(Box::new(Killed));
    });
    set_mode(Mode::Armed(at, kill));
    let end = catch_unwind(AssertUnwindSafe(operation));
    set_mode(Mode::Free);
    match end {
        Ok(value) => Some(value),
        Err(payload) if payload.is::<Killed>() => None,
        Err(payload) => resume_unwind(payload),
    }
}

/// Runs a shuttle model, in which another thread may run before each access.
#[cfg(all(test, not(any(loom, miri))))]
pub fn switch_cores(model: impl FnOnce()) {
    SWITCHING.set(true);
    model();
    SWITCHING.set(false);
}

/// Runs `operation`, freezes it just before its access number `at` while `meanwhile` runs, then
/// thaws it. The flag is true if the operation reached that access.
pub fn freeze_at<T>(
    at: usize,
    meanwhile: impl FnOnce() + 'static,
    operation: impl FnOnce() -> T,
) -> (T, bool) {
    set_mode(Mode::Armed(at, Box::new(meanwhile)));
    let value = operation();
    let unused = matches!(set_mode(Mode::Free), Mode::Armed(..));
    (value, !unused)
}

/// An atomic word that calls `step` at each access. In a loom model it also checks plain accesses.
#[derive(Debug, Default)]
#[cfg_attr(not(loom), repr(transparent))]
pub struct AtomicU32(Word, #[cfg(loom)] loom::cell::UnsafeCell<()>);

impl AtomicU32 {
    /// Returns a word with this value.
    #[cfg(not(loom))]
    pub const fn new(value: u32) -> Self {
        Self(Word::new(value))
    }

    /// Returns a word with this value.
    #[cfg(loom)]
    pub fn new(value: u32) -> Self {
        Self(Word::new(value), loom::cell::UnsafeCell::new(()))
    }

    /// A plain read: the model fails if it is not ordered after each plain write.
    #[cfg(loom)]
    pub(crate) fn read_plainly(&self) {
        self.1.with(|_| ());
    }

    /// A plain write: the model fails if it is not ordered after each other plain access.
    #[cfg(loom)]
    pub(crate) fn write_plainly(&self) {
        self.1.with_mut(|_| ());
    }

    /// Returns the word for one access, or `None` for a killed operation, whose loads return 0.
    fn access(&self) -> Option<&Word> {
        step().then_some(&self.0)
    }

    /// Like the machine's operation of the same name.
    pub fn load(&self, order: Ordering) -> u32 {
        self.access().map_or(0, |word| word.load(order))
    }

    /// Like the machine's operation of the same name.
    pub fn store(&self, value: u32, order: Ordering) {
        if let Some(word) = self.access() {
            word.store(value, order);
        }
    }

    /// Like the machine's operation of the same name.
    pub fn swap(&self, value: u32, order: Ordering) -> u32 {
        self.access().map_or(0, |word| word.swap(value, order))
    }

    /// Like the machine's operation of the same name.
    pub fn fetch_add(&self, value: u32, order: Ordering) -> u32 {
        self.access().map_or(0, |word| word.fetch_add(value, order))
    }

    /// Like the machine's operation of the same name.
    pub fn fetch_or(&self, value: u32, order: Ordering) -> u32 {
        self.access().map_or(0, |word| word.fetch_or(value, order))
    }

    /// Like the machine's operation of the same name.
    pub fn fetch_and(&self, value: u32, order: Ordering) -> u32 {
        self.access().map_or(0, |word| word.fetch_and(value, order))
    }

    /// Like the machine's operation of the same name.
    #[allow(clippy::missing_errors_doc, reason = "as the machine's")]
    pub fn compare_exchange(
        &self,
        current: u32,
        new: u32,
        success: Ordering,
        failure: Ordering,
    ) -> Result<u32, u32> {
        let word = self.access().ok_or(0_u32)?;
        word.compare_exchange(current, new, success, failure)
    }
}

#[cfg(all(test, not(loom)))]
pub(crate) use unit::zeroed;

#[cfg(not(loom))]
#[allow(clippy::unwrap_used, reason = "test code")]
#[cfg(test)]
mod unit {
    use super::*;
    use std::sync::Mutex;
    use std::vec::Vec;

    /// Returns zeroed words for a test, from a line boundary on. They are never freed, so that
    /// frozen operations may still use them.
    pub(crate) fn zeroed(words: usize) -> &'static [AtomicU32] {
        /// Keeps the words reachable, so that Miri reports no leak.
        static ALL: Mutex<Vec<&'static [AtomicU32]>> = Mutex::new(Vec::new());
        /// Bytes of a cache line.
        const LINE: usize = 64;
        // The first line starts within this many words.
        let spare = LINE / size_of::<AtomicU32>();
        let all: Box<[AtomicU32]> = (0..words + spare).map(|_| AtomicU32::new(0)).collect();
        let all: &'static [AtomicU32] = Box::leak(all);
        ALL.lock().unwrap().push(all);
        let skip = all.as_ptr().align_offset(LINE);
        &all[skip..skip + words]
    }

    #[test]
    fn a_killed_operation_changes_nothing_more_and_a_frozen_one_continues() {
        let w = zeroed(2);
        let write = || {
            w[0].store(1, Ordering::Relaxed);
            w[1].store(1, Ordering::Relaxed);
        };
        assert_eq!(kill_at(1, write), None);
        assert_eq!(
            (w[0].load(Ordering::Relaxed), w[1].load(Ordering::Relaxed)),
            (1, 0)
        );
        assert_eq!(kill_at(2, write), Some(()));
        let ((), hit) = freeze_at(1, || w[0].store(7, Ordering::Relaxed), write);
        assert!(hit);
        assert_eq!(
            (w[0].load(Ordering::Relaxed), w[1].load(Ordering::Relaxed)),
            (7, 1)
        );
    }
}
