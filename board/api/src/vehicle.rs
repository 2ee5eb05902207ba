//! The vehicle's side of a board: the CAN bus between both systems, the ignition, and data for an
//! observer.
//!
//! A run has one vehicle. It calls all of this from one thread.

use crate::{CanFrame, CoreId, Instant, RoleLamp, SupplyEvent, SystemId, Traced};

/// A frame of a core on the bus.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Carried {
    /// The frame.
    pub frame: CanFrame,
    /// When its core sent it.
    pub sent: Instant,
    /// When it was on the bus: never before `sent`, nor before the previous frame on the bus.
    pub at: Instant,
}

/// The CAN bus, seen from the vehicle's nodes.
pub trait VehicleBus {
    /// The vehicle's clock.
    fn now(&self) -> Instant;

    /// Takes the frames that the cores have sent since the last call, in bus order, each with its
    /// sender.
    fn transmitted(&mut self, seen: &mut dyn FnMut(SystemId, CoreId, Carried));

    /// Sends a frame of one of the vehicle's own nodes. Returns when it is on the bus: never before
    /// the previous frame on the bus.
    fn broadcast(&mut self, frame: &CanFrame) -> Instant;

    /// Wakes the cores that wait for frames, if there are new ones.
    fn ring_receivers(&mut self) {}
}

/// Why the vehicle was woken.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Pass {
    /// A period of 1 ms was due at this time.
    Period(Instant),
    /// A period was due at this time, before the next frame of the vehicle: no frame is fetched.
    Quiet(Instant),
    /// A core has sent a frame between two periods.
    Frames,
}

/// A whole run, seen from the vehicle.
pub trait VehiclePort: VehicleBus {
    /// Why the board failed.
    type Error;

    /// Waits for the next period of 1 ms, and returns when it was due. Blocks.
    ///
    /// # Errors
    /// If the board fails.
    fn tick(&mut self) -> Result<Instant, Self::Error>;

    /// Waits like [`VehiclePort::tick`], but a board may sleep until a core sends a frame or until
    /// `event`, the period in which the vehicle sends one itself, and return the periods before it
    /// together. Blocks.
    ///
    /// # Errors
    /// If the board fails.
    fn wait_for(&mut self, _event: Instant) -> Result<Pass, Self::Error> {
        self.tick().map(Pass::Period)
    }

    /// Connects the battery of both systems, or ends the run.
    fn set_ignition(&mut self, on: bool);

    /// Whether a person wants the run to end early.
    fn stop_requested(&self) -> bool;

    /// Takes the cores' trace records since the last call, in the order of each core, and returns
    /// how many were lost.
    fn drain_trace(&mut self, into: &mut dyn FnMut(Traced)) -> u32;

    /// Takes the records behind a record that its writer never completed, because it was killed.
    /// Only at the end of the run.
    fn salvage_trace(&mut self, _into: &mut dyn FnMut(Traced)) {}

    /// Takes the events of the supplies since the last call. A board may report none.
    fn drain_supplies(&mut self, _into: &mut dyn FnMut(Instant, SystemId, SupplyEvent)) {}

    /// The role that the system shows.
    fn role(&self, system: SystemId) -> RoleLamp;

    /// Whether the system has power and is out of reset.
    fn is_powered(&self, system: SystemId) -> bool;
}
