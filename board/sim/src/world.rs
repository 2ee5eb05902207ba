//! What lies outside the two systems, as a function that is called once a millisecond.

use crate::machine::OnBus;
use tandem_board::{CanFrame, Instant, RoleLamp};

/// One step of the world: what it hears, sees and sends.
#[derive(Debug)]
pub struct WorldTick {
    /// The virtual time.
    pub at: Instant,
    /// What was on the bus since the last step, in bus order, its own frames included.
    pub heard: Vec<OnBus>,
    /// The roles that the systems show; `None` while a system has no power or is in reset.
    pub lamps: [Option<RoleLamp>; 2],
    pub(crate) sent: Vec<CanFrame>,
}

impl WorldTick {
    /// Puts a frame on the bus, after those sent before.
    pub fn send(&mut self, frame: CanFrame) {
        self.sent.push(frame);
    }
}
