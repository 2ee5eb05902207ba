//! Turns a core whose code blocks into a poller: a thread that runs only while the pair polls it.

use crate::baton::{Baton, Said};
use crate::board::{Poller, SimBoard};
use std::panic::resume_unwind;
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::Duration as WallTime;
use tandem_board::{Board, Instant};

/// How long a core may compute, in wall-clock time, before the pair assumes that it hangs in a loop
/// without calling its board. No result of a run depends on it.
const HANGS_AFTER: WallTime = WallTime::from_secs(120);

/// Reports the end of the function, also when the function unwinds.
struct AtEnd(Arc<Baton>);

impl Drop for AtEnd {
    fn drop(&mut self) {
        // Fails if the pair was dropped.
        let _ = self.0.said.send(Said::Ended);
    }
}

/// The pair's end of the hand-over; dropping it ends the thread.
struct CoreThread {
    resume: Option<Sender<()>>,
    said: Receiver<Said>,
    thread: Option<JoinHandle<()>>,
}

impl CoreThread {
    /// Runs the core until it parks; returns the time until which the core sleeps.
    fn poll(&mut self) -> Instant {
        let Some(resume) = &self.resume else {
            return Instant::NEVER;
        };
        let _ = resume.send(());
        match self.said.recv_timeout(HANGS_AFTER) {
            Ok(Said::Parked(until)) => return until,
            Err(RecvTimeoutError::Timeout) => {
                panic!("a core computes for {HANGS_AFTER:?} without looking at its board")
            }
            Ok(Said::Ended) | Err(RecvTimeoutError::Disconnected) => {}
        }
        self.resume = None;
        if let Some(Err(panic)) = self.thread.take().map(JoinHandle::join) {
            resume_unwind(panic);
        }
        Instant::NEVER
    }
}

impl Drop for CoreThread {
    fn drop(&mut self) {
        self.resume = None;
        // The thread unwinds. If a destructor in it panics, the message is already printed.
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

/// Turns a function that blocks in `Board::wait` into a poller, for a factory of
/// [`SimPair`](crate::SimPair). When `run` returns, the core sleeps for ever.
///
/// `run` has its own thread, which runs only while the pair polls it. Each read of the clock, of a
/// line or of an empty receiver costs [`Config::look_at_clock`](crate::Config) of virtual time, in
/// which the other cores run, so a loop that polls one of these ends. A loop that only reads the
/// LMU never ends.
///
/// # Panics
/// A panic in `run` propagates out of the pair's run function. The poller panics if the core
/// computes for two minutes without a call to its board.
pub fn blocking(board: &SimBoard, run: impl FnOnce(&SimBoard) + Send + 'static) -> Poller {
    let (resume, resumed) = channel();
    let (says, said) = channel();
    let baton = Arc::new(Baton {
        resumed: Mutex::new(resumed),
        said: says,
    });
    let board = board.with_baton(Arc::clone(&baton));
    let name = format!("core {}{}", board.identity().system, board.identity().core);
    let body = move || {
        let first = baton
            .resumed
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .recv();
        let _at_end = AtEnd(Arc::clone(&baton));
        if first.is_ok() {
            run(&board);
        }
    };
    let thread = std::thread::Builder::new().name(name).spawn(body);
    let thread = match thread {
        Ok(thread) => Some(thread),
        Err(error) => panic!("no thread for a core: {error}"),
    };
    let mut core = CoreThread {
        resume: Some(resume),
        said,
        thread,
    };
    Box::new(move |_| core.poll())
}
