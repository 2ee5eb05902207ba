//! Events on the bus and of a system.

use tandem_board::{CanFrame, CoreId, Instant, ResetCause, ResetRequest, RoleLamp, SystemId};
use tandem_peripherals::codec::Sender;

/// A frame on the CAN bus.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct OnBus {
    /// The virtual time.
    pub at: Instant,
    /// Its sender.
    pub sender: Sender,
    /// The frame.
    pub frame: CanFrame,
}

/// An event of a system.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SystemEvent {
    /// The virtual time.
    pub at: Instant,
    /// The system.
    pub system: SystemId,
    /// The event.
    pub kind: SystemEventKind,
}

/// The kinds of events of a system.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SystemEventKind {
    /// Power was switched on, or the supply released the reset: the cores start.
    Started(ResetCause),
    /// Power was lost.
    PowerLost,
    /// A core requested a reset.
    Requested(CoreId, ResetRequest),
    /// The supply holds the system in reset for this cause.
    Reset(ResetCause),
    /// The supply holds the system in reset until the next power-on.
    Suspended,
    /// A core died.
    CoreDied(CoreId),
    /// A single core began a new incarnation.
    CoreRestarted(CoreId),
    /// The system shows another role.
    Lamp(RoleLamp),
}
