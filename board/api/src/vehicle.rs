//! The vehicle's interface to a board: the CAN bus between both systems, the ignition, and data for
//! an observer.
//!
//! A run has one vehicle. It makes all of these calls from one thread.

use crate::{CanFrame, CoreId, Instant, RoleLamp, SupplyEvent, SystemId, Traced};

/// A frame of a core that was on the bus.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Carried {
    /// The frame.
    pub frame: CanFrame,
    /// When its core sent it.
    pub sent: Instant,
    /// When it was on the bus: not before `sent`, and not before the previous frame on the bus.
    pub at: Instant,
}

/// The CAN bus as the vehicle's nodes see it.
pub trait VehicleBus {
    /// Reads the vehicle's clock.
    fn now(&self) -> Instant;

    /// Takes the frames that the cores have sent since the last call, in bus order, each with its
    /// sender.
    fn transmitted(&mut self, seen: &mut dyn FnMut(SystemId, CoreId, Carried));

    /// Sends a frame from one of the vehicle's own nodes. Returns the time at which it is on the
    /// bus: not before the previous frame on the bus.
    fn broadcast(&mut self, frame: &CanFrame) -> Instant;

    /// Wakes the cores that wait for frames, if there are new frames.
    fn ring_receivers(&mut self) {}
}

/// Why the vehicle was woken.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Pass {
    /// A period of 1 ms began at this time.
    Period(Instant),
    /// A period began at this time. The vehicle sends no frame in it: do not fetch frames.
    Quiet(Instant),
    /// A core sent a frame between two periods.
    Frames,
}

/// A further node of the bus that sends frames in the name of another: after such a frame that
/// it hears, each 10 ms, the next one with one wrong value.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Forgery {
    /// The id of the frame.
    pub id: u16,
    /// The number of the signal in the frame.
    pub field: u8,
    /// Its value, in the unit of the DBC.
    pub value: f64,
}

/// What was done to a system from outside.
#[derive(Clone, Copy, Debug)]
pub struct Handled<'a> {
    /// The system.
    pub system: SystemId,
    /// What was done, in words.
    pub what: core::fmt::Arguments<'a>,
    /// The wires that start at the system and are cut now, one bit for each, in the order of the
    /// board's wires.
    pub cuts: u8,
}

/// A whole run as the vehicle sees it.
pub trait VehiclePort: VehicleBus {
    /// Why the board failed.
    type Error;

    /// Waits for the next period of 1 ms and returns the time at which it was due. Blocks.
    ///
    /// # Errors
    /// If the board fails.
    fn tick(&mut self) -> Result<Instant, Self::Error>;

    /// Like [`VehiclePort::tick`], but a board may sleep until a core sends a frame or until
    /// `event` (the period in which the vehicle itself sends one), and then return all periods
    /// before that time together. Blocks.
    ///
    /// # Errors
    /// If the board fails.
    fn wait_for(&mut self, _event: Instant) -> Result<Pass, Self::Error> {
        self.tick().map(Pass::Period)
    }

    /// Connects the battery to both systems, or ends the run.
    fn set_ignition(&mut self, on: bool);

    /// Returns whether a person has asked to end the run early.
    fn stop_requested(&self) -> bool;

    /// Returns when the process that had started the run died; `None` if it lives, or if the board
    /// has no such process. The board ends the run a stated time after such a death.
    fn launcher_died(&self) -> Option<Instant> {
        None
    }

    /// Returns what a foreign node forges. On most boards there is no such node.
    fn forgery(&self) -> Option<Forgery> {
        None
    }

    /// Takes the cores' trace records since the last call, in order for each core, and returns how
    /// many were lost.
    fn drain_trace(&mut self, into: &mut dyn FnMut(Traced)) -> u32;

    /// Takes the records that follow a record whose writer was killed before completing it. Called
    /// only at the end of the run.
    fn salvage_trace(&mut self, _into: &mut dyn FnMut(Traced)) {}

    /// Takes the events of the supplies since the last call. A board may report none.
    fn drain_supplies(&mut self, _into: &mut dyn FnMut(Instant, SystemId, SupplyEvent)) {}

    /// Passes on what was done to a system from outside since the last call, and what ended, in
    /// words: faults that a person or a campaign injected. A board may report none.
    fn drain_hands(&mut self, _into: &mut dyn FnMut(Handled<'_>)) {}

    /// Returns the role that the system shows.
    fn role(&self, system: SystemId) -> RoleLamp;

    /// Returns whether the system has power and is out of reset.
    fn is_powered(&self, system: SystemId) -> bool;
}
