//! The right to run, which the pair passes to one blocking core at a time.

use std::panic::resume_unwind;
use std::sync::mpsc::{Receiver, Sender};
use std::sync::{Mutex, PoisonError};
use tandem_board::Instant;

/// The panic payload that unwinds a blocking core whose incarnation is over, out of the call in
/// which it is parked.
#[derive(Clone, Copy, Debug)]
pub struct CoreKilled;

/// Message of a core to the pair.
pub(crate) enum Said {
    /// Parked until this time on the core's clock.
    Parked(Instant),
    /// The core's function has ended.
    Ended,
}

/// The core's side: it runs between a resume and the next park.
pub(crate) struct Baton {
    pub(crate) resumed: Mutex<Receiver<()>>,
    pub(crate) said: Sender<Said>,
}

impl Baton {
    /// Lets the others run until `until` on the core's clock, or until the pair resumes this core
    /// earlier. Unwinds with [`CoreKilled`] when the core's incarnation is over.
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
