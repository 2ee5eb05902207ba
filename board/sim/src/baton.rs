//! The right to run, which the pair passes to one blocking core at a time.

use std::panic::resume_unwind;
use std::sync::mpsc::{Receiver, Sender};
use std::sync::{Mutex, PoisonError};
use tandem_board::Instant;

/// The panic payload that unwinds a blocking core when its incarnation ends. It starts in the call
/// in which the core is parked.
#[derive(Clone, Copy, Debug)]
pub struct CoreKilled;

/// Message from a core to the pair.
pub(crate) enum Said {
    /// Parked until this time on the core's clock.
    Parked(Instant),
    /// The core's function has ended.
    Ended,
}

/// The core's end of the hand-over: the core runs from each resume to the next park.
pub(crate) struct Baton {
    pub(crate) resumed: Mutex<Receiver<()>>,
    pub(crate) said: Sender<Said>,
}

impl Baton {
    /// Parks this core until `until` on its clock, or until the pair resumes it earlier; the other
    /// cores run in that time. Unwinds with [`CoreKilled`] if the core's incarnation has ended.
    pub(crate) fn park(&self, until: Instant) {
        if std::thread::panicking() {
            return;
        }
        let parked = self.said.send(Said::Parked(until));
        let resumed = self
            .resumed
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .recv();
        if parked.is_err() || resumed.is_err() {
            resume_unwind(Box::new(CoreKilled));
        }
    }
}
