//! One kernel for the tests of a process, one after the other, with a watchdog.
#![allow(dead_code, reason = "each test uses its part")]
#![allow(clippy::expect_used, reason = "a test may")]

use std::alloc::System;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;
use tandem_rtos::host::{TaskAllocator, deferred};
use tandem_rtos::{Clock, Kernel, Priority, TaskOptions};

#[global_allocator]
static ALLOCATOR: TaskAllocator<System> = TaskAllocator::new(System);

static TURN: Mutex<()> = Mutex::new(());

/// Fills a kernel and runs it until a task stops it.
pub(crate) fn run(clock: Clock, fill: impl FnOnce(&Kernel)) {
    run_for(Duration::from_secs(120), clock, fill);
}

/// As [`run`], with a watchdog of so long.
pub(crate) fn run_for(limit: Duration, clock: Clock, fill: impl FnOnce(&Kernel)) {
    let _turn = TURN.lock().unwrap_or_else(PoisonError::into_inner);
    let (ended, watch) = std::sync::mpsc::channel::<()>();
    std::thread::spawn(move || {
        let outcome = watch.recv_timeout(limit);
        if outcome == Err(std::sync::mpsc::RecvTimeoutError::Timeout) {
            eprintln!("the watchdog of the test ends the process");
            std::process::abort();
        }
    });
    let kernel = Kernel::take().expect("the last test gave it back");
    fill(&kernel);
    kernel.start(clock).expect("it starts");
    drop(ended);
}

/// What happened, in order. Noted by all tasks and handlers of a core.
pub(crate) struct Log<T>(Arc<Mutex<Vec<T>>>);

impl<T> Log<T> {
    pub(crate) fn new() -> Self {
        Self(Arc::default())
    }

    /// A lock of the standard library may not be held when a task is pre-empted.
    pub(crate) fn note(&self, what: T) {
        deferred(|| self.0.lock().expect("nobody panics").push(what));
    }

    pub(crate) fn take(&self) -> Vec<T> {
        std::mem::take(&mut self.0.lock().expect("nobody panics"))
    }
}

impl<T> Clone for Log<T> {
    fn clone(&self) -> Self {
        Self(Arc::clone(&self.0))
    }
}

/// Options of a task by name and priority.
pub(crate) const fn task(name: &str, priority: u8) -> TaskOptions<'_> {
    TaskOptions::new(name, Priority::new(priority))
}
