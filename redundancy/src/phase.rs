//! Phases of a system, evidence, and the transition table between them.

use strum::{FromRepr, VariantArray};
use tandem_board::RoleLamp;

/// The role as encoded in control and status frames.
#[derive(Clone, Copy, Debug, PartialEq, Eq, FromRepr, VariantArray)]
#[repr(u8)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Role {
    /// Has no role yet.
    Starting = 0,
    /// Drives the vehicle.
    Master = 1,
    /// Computes silently.
    Standby = 2,
    /// Has failed and stays silent.
    Suspended = 3,
}

/// The driving function that a system runs.
#[derive(Clone, Copy, Debug, PartialEq, Eq, FromRepr, VariantArray)]
#[repr(u8)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Mode {
    /// No driving function.
    None = 0,
    /// Automated driving with both systems healthy.
    L3 = 1,
    /// Lane and distance keeping by the remaining system.
    DegradedL2 = 2,
    /// Stopping the vehicle: the remaining system has a fault too.
    SafeStop = 3,
}

/// The state of the machine.
#[derive(Clone, Copy, Debug, PartialEq, Eq, FromRepr, VariantArray)]
#[repr(u8)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Phase {
    /// Start protocol, or listening for a running master. Output closed, no heartbeats.
    Starting = 0,
    /// The other system drives. Output closed, heartbeats.
    Standby = 1,
    /// Dual operation: drives, the other system is standby. Output open, heartbeats.
    Master = 2,
    /// Drives alone. Output open, heartbeats.
    DegradedMaster = 3,
    /// Was master and was held up longer than its lease. Listens to find out whether the other
    /// system drives. Output closed, no heartbeats.
    Thawed = 4,
    /// Has requested a reset that may cure its fault. Output closed, no heartbeats.
    Resetting = 5,
    /// Has failed. Output closed, no heartbeats.
    Suspended = 6,
}

impl Phase {
    /// Returns whether the output is open.
    #[must_use]
    pub const fn is_driving(self) -> bool {
        matches!(self, Self::Master | Self::DegradedMaster)
    }

    /// Returns whether the system sends heartbeats: it has a role, or is ready for one.
    #[must_use]
    pub const fn sends_heartbeats(self) -> bool {
        matches!(self, Self::Standby | Self::Master | Self::DegradedMaster)
    }

    /// Returns whether the driver changes when a system enters `to` from this phase.
    #[must_use]
    pub fn changes_driver(self, to: Self) -> bool {
        let drove = self.is_driving() || self == Self::Thawed;
        self == Self::Standby && to.is_driving() || drove && to == Self::Standby
    }

    /// Returns the role that the frames show.
    #[must_use]
    pub const fn role(self) -> Role {
        match self {
            Self::Starting | Self::Thawed | Self::Resetting => Role::Starting,
            Self::Standby => Role::Standby,
            Self::Master | Self::DegradedMaster => Role::Master,
            Self::Suspended => Role::Suspended,
        }
    }

    /// Returns the state that the digital outputs show.
    #[must_use]
    pub const fn lamp(self) -> RoleLamp {
        match self {
            Self::Starting | Self::Thawed | Self::Resetting => RoleLamp::Starting,
            Self::Standby => RoleLamp::Standby,
            Self::Master => RoleLamp::Master,
            Self::DegradedMaster => RoleLamp::DegradedMaster,
            Self::Suspended => RoleLamp::Suspended,
        }
    }
}

/// The evidence of a poll. The order is that of the table in the docs.
#[derive(Clone, Copy, Debug, PartialEq, Eq, FromRepr, VariantArray)]
#[repr(u8)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Evidence {
    /// A sync edge arrived: the other system leads.
    SyncHeard = 0,
    /// Heartbeats or control frames arrived while this system starts: the other system runs.
    PeerRuns = 1,
    /// Handshakes were exchanged in both directions, or both systems are standby, and this system
    /// leads.
    HandshakeDone = 2,
    /// No system answered within the time limit.
    NoAnswer = 3,
    /// The other system's power level is low and its heartbeats have ended: it cannot transmit.
    PeerOff = 4,
    /// Since the master's last control frame, both heartbeat lines were silent at some time, and no
    /// control frame has arrived for the third witness's limit.
    PeerSilent = 5,
    /// Both heartbeat lines are silent; control frames are not considered.
    BeatsSilent = 6,
    /// The vehicle says that no control frame reaches it.
    MasterMute = 7,
    /// A control frame of the other system in a higher term arrived: it drives.
    HigherTerm = 8,
    /// Heartbeats of a failed system have arrived again for long enough.
    BeatsBack = 9,
    /// The recovered system is also heard on CAN, and the configuration permits dual operation
    /// again. Or the vehicle still obeys this master, which was held up in dual operation.
    PeerStable = 10,
    /// This master was held up; the other system may have taken over during the stall.
    Stalled = 11,
    /// The time for listening after a stall is over: the other system has not taken over.
    ListenOver = 12,
    /// This system has a fault that a reset may cure; it does not drive, and the other system does.
    FaultReset = 13,
    /// This system has a fault while it drives: it continues to drive, to stop the vehicle, until
    /// the other system drives.
    FaultStop = 14,
    /// This system has a permanent fault, and the other system drives.
    FaultSuspend = 15,
    /// The standby is not heard on CAN: it could not take over.
    StandbyMute = 16,
    /// The master resigns: it has a fault and stops the vehicle, or was asked to hand over.
    MasterResigns = 17,
    /// After the sync edge that this system followed, no other system was heard: the edge was a
    /// disturbance, and the start continues.
    SyncStray = 18,
    /// The standby reports that it could only stop the vehicle, or less; this master can do more.
    StandbyUnable = 19,
}
