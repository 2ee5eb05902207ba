//! The vehicle's side of a board: the CAN bus between both systems, the ignition, and what an
//! observer sees.
//!
//! There is one vehicle in a run. It calls all of this from one thread.

use crate::{CanFrame, CoreId, Instant, RoleLamp, SupplyEvent, SystemId, Traced};

/// A frame of a core, as the bus carried it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Carried {
    /// The frame.
    pub frame: CanFrame,
    /// When its core sent it.
    pub sent: Instant,
    /// When it was on the bus: never before `sent`, nor before the frame that the bus carried last.
    pub at: Instant,
}

/// The CAN bus, as the vehicle's nodes are connected to it.
pub trait VehicleBus {
    /// The vehicle's clock.
    fn now(&self) -> Instant;

    /// Takes the frames that the cores have sent since the last call, in bus order. Each comes with
    /// its sender.
    fn transmitted(&mut self, seen: &mut dyn FnMut(SystemId, CoreId, Carried));

    /// Sends a frame of one of the vehicle's own nodes. Returns when it is on the bus: never before
    /// a frame that the bus has carried.
    fn broadcast(&mut self, frame: &CanFrame) -> Instant;

    /// Wakes the cores that wait for frames, if there are new ones.
    fn ring_receivers(&mut self) {}
}

/// A whole run as the vehicle sees it.
pub trait VehiclePort: VehicleBus {
    /// Why the board failed.
    type Error;

    /// Waits for the next period of 1 ms, and returns when it was due. Blocks.
    ///
    /// # Errors
    /// If the board fails.
    fn tick(&mut self) -> Result<Instant, Self::Error>;

    /// Connects the battery of both systems, or ends the run.
    fn set_ignition(&mut self, on: bool);

    /// Whether a person wants the run to end early.
    fn stop_requested(&self) -> bool;

    /// Takes the trace records of the cores since the last call, in the order of each core, and
    /// returns how many were lost.
    fn drain_trace(&mut self, into: &mut dyn FnMut(Traced)) -> u32;

    /// Takes the records behind one whose writer was killed while it wrote. Only at the end of the
    /// run.
    fn salvage_trace(&mut self, _into: &mut dyn FnMut(Traced)) {}

    /// Takes what the supplies have done since the last call, on a board that tells.
    fn drain_supplies(&mut self, _into: &mut dyn FnMut(Instant, SystemId, SupplyEvent)) {}

    /// The role that the system shows.
    fn role(&self, system: SystemId) -> RoleLamp;

    /// Whether the system has power and is out of reset.
    fn is_powered(&self, system: SystemId) -> bool;
}
