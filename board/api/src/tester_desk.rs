//! What answers a tester while the application runs. T-BOOT-1

use crate::{CanFrame, CanId, Instant, ResetRequest};

/// From a host to a bootloader, or to a desk: see `docs/boot.md`.
pub const TO_LOADER: CanId = CanId::Extended(0x0CFF_0126);
/// From a bootloader or a desk to the host.
pub const TO_HOST: CanId = CanId::Extended(0x0CFF_0127);
/// From a desk to everybody: the release that its application runs.
pub const RELEASES: CanId = CanId::Extended(0x0CFF_0128);
/// Connect, in the first four bytes of a frame to a bootloader, little endian.
pub const CONNECT: u32 = 0x083E_572D;
/// The first byte of a frame of the protocol's extension.
pub const EXTENSION: u8 = b'W';

/// What the desk wants of core 0.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DeskAction {
    /// Send this frame.
    Send(CanFrame),
    /// Reset the system as soon as the vehicle does not need it.
    Leave(ResetRequest),
    /// This start has worked: see [`Supply::confirm_start`](crate::Supply::confirm_start).
    ConfirmStart,
}

/// Answers a tester beside the application. Core 2 calls it between two plans, because a desk may
/// check a signature or write the flash; core 0 passes the frames on and does what the desk wants.
pub trait TesterDesk {
    /// Takes a frame of a tester, or of the other system's desk. Task context; may block.
    fn hear(&mut self, now: Instant, frame: &CanFrame) -> Option<DeskAction>;

    /// Does what is due. `has_role`: this system is master or standby. Task context; may block.
    fn poll(&mut self, now: Instant, has_role: bool) -> Option<DeskAction>;
}

/// Answers no frame.
impl TesterDesk for () {
    fn hear(&mut self, _now: Instant, _frame: &CanFrame) -> Option<DeskAction> {
        None
    }

    fn poll(&mut self, _now: Instant, _has_role: bool) -> Option<DeskAction> {
        None
    }
}
