//! Unit tests only: atomics that count accesses, so that a test can kill or freeze at each step.

use core::cell::RefCell;
use core::sync::atomic::{AtomicU32 as Word, Ordering};
use std::boxed::Box;
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::sync::Mutex;
use std::vec::Vec;

use crate::LINE_WORDS;

/// What happens at the chosen access, just before it.
type Event = Box<dyn FnOnce()>;

enum Mode {
    /// Every access goes through.
    Free,
    /// So many accesses go through, then the event.
    Armed(usize, Event),
    /// The running operation was killed: the unwinding destructors reach the memory no more.
    Dead,
}

std::thread_local! {
    static MODE: RefCell<Mode> = const { RefCell::new(Mode::Free) };
}

/// Whether this access reaches the memory.
fn step() -> bool {
    let event = MODE.with_borrow_mut(|mode| match core::mem::replace(mode, Mode::Free) {
        Mode::Free => Ok(true),
        Mode::Dead => {
            *mode = Mode::Dead;
            Ok(false)
        }
        Mode::Armed(0, event) => Err(event),
        Mode::Armed(left, event) => {
            *mode = Mode::Armed(left - 1, event);
            Ok(true)
        }
    });
    match event {
        Ok(through) => through,
        Err(event) => {
            event();
            true
        }
    }
}

/// Payload of the unwinding that stands for `kill -9`.
struct Killed;

/// Runs `operation` and kills it just before its access number `at` (from 0). `None` if it was
/// killed, `Some` if it ended before.
pub(crate) fn kill_at<T>(at: usize, operation: impl FnOnce() -> T) -> Option<T> {
    let kill: Event = Box::new(|| {
        MODE.set(Mode::Dead);
        resume_unwind(Box::new(Killed));
    });
    MODE.set(Mode::Armed(at, kill));
    let end = catch_unwind(AssertUnwindSafe(operation));
    MODE.set(Mode::Free);
    match end {
        Ok(value) => Some(value),
        Err(payload) if payload.is::<Killed>() => None,
        Err(payload) => resume_unwind(payload),
    }
}

/// Runs `operation`, freezes it just before its access number `at` for as long as `meanwhile`
/// takes, then thaws it. The flag says whether it came that far.
pub(crate) fn freeze_at<T>(
    at: usize,
    meanwhile: impl FnOnce() + 'static,
    operation: impl FnOnce() -> T,
) -> (T, bool) {
    MODE.set(Mode::Armed(at, Box::new(meanwhile)));
    let value = operation();
    let unused = matches!(MODE.replace(Mode::Free), Mode::Armed(..));
    (value, !unused)
}

/// An atomic word whose accesses are steps.
#[derive(Debug, Default)]
pub struct AtomicU32(Word);

impl AtomicU32 {
    /// A word with this value.
    pub const fn new(value: u32) -> Self {
        Self(Word::new(value))
    }

    /// As the machine's; a dead operation reads 0.
    pub fn load(&self, order: Ordering) -> u32 {
        if step() { self.0.load(order) } else { 0 }
    }

    /// As the machine's.
    pub fn store(&self, value: u32, order: Ordering) {
        if step() {
            self.0.store(value, order);
        }
    }

    /// As the machine's.
    pub fn swap(&self, value: u32, order: Ordering) -> u32 {
        if step() { self.0.swap(value, order) } else { 0 }
    }

    /// As the machine's.
    pub fn fetch_add(&self, value: u32, order: Ordering) -> u32 {
        if step() {
            self.0.fetch_add(value, order)
        } else {
            0
        }
    }

    /// As the machine's.
    pub fn fetch_or(&self, value: u32, order: Ordering) -> u32 {
        if step() {
            self.0.fetch_or(value, order)
        } else {
            0
        }
    }

    /// As the machine's.
    pub fn fetch_and(&self, value: u32, order: Ordering) -> u32 {
        if step() {
            self.0.fetch_and(value, order)
        } else {
            0
        }
    }

    /// As the machine's.
    #[allow(clippy::missing_errors_doc, reason = "as the machine's")]
    pub fn compare_exchange(
        &self,
        current: u32,
        new: u32,
        success: Ordering,
        failure: Ordering,
    ) -> Result<u32, u32> {
        if step() {
            self.0.compare_exchange(current, new, success, failure)
        } else {
            Err(0)
        }
    }
}

/// Zeroed words for a test, from a line boundary on; never freed, so that frozen operations may
/// keep them.
pub(crate) fn zeroed(words: usize) -> &'static [AtomicU32] {
    /// Where Miri finds them, so that it sees no leak.
    static ALL: Mutex<Vec<&'static [AtomicU32]>> = Mutex::new(Vec::new());
    let all: Box<[AtomicU32]> = (0..words + LINE_WORDS).map(|_| AtomicU32::new(0)).collect();
    let all: &'static [AtomicU32] = Box::leak(all);
    ALL.lock().unwrap().push(all);
    let skip = all.as_ptr().align_offset(64);
    &all[skip..skip + words]
}

#[test]
fn a_killed_operation_changes_nothing_more_and_a_frozen_one_goes_on() {
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
