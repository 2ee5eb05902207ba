//! The world outside the two systems, as a function that is called every millisecond.

use crate::event::OnBus;
use tandem_board::{CanFrame, Carried, CoreId, Instant, RoleLamp, SystemId, VehicleBus};
use tandem_peripherals::codec::Sender;

/// One step of the world: its inputs and outputs.
#[derive(Debug)]
pub struct WorldTick {
    /// The virtual time.
    pub at: Instant,
    /// Frames on the bus since the last step, in bus order, including the world's own.
    pub heard: Vec<OnBus>,
    /// The roles that the systems show; `None` while a system has no power or is in reset.
    pub lamps: [Option<RoleLamp>; 2],
    pub(crate) sent: Vec<CanFrame>,
}

impl VehicleBus for WorldTick {
    fn now(&self) -> Instant {
        self.at
    }

    fn transmitted(&mut self, seen: &mut dyn FnMut(SystemId, CoreId, Carried)) {
        for &OnBus { at, sender, frame } in &self.heard {
            if let Sender::Core(from) = sender {
                let sent = at;
                seen(from.system, from.core, Carried { frame, sent, at });
            }
        }
    }

    fn broadcast(&mut self, frame: &CanFrame) -> Instant {
        self.sent.push(*frame);
        self.at
    }
}
