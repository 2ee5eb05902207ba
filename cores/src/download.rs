//! The part of the download protocol (`docs/boot.md`) that an application receives: a host asks for
//! the bootloader of this system. T-BOOT-1

use tandem_board::{CanFrame, CanId, SystemId};

/// Frames from a host to a bootloader.
const TO_LOADER: CanId = CanId::Extended(0x0CFF_0126);
/// Connect, in the first four bytes.
const CONNECT: u32 = 0x083E_572D;

/// Returns the system whose bootloader a host asks for. A request that names no system is for a
/// system that has just started. A running application ignores it.
pub(crate) fn requested(frame: &CanFrame) -> Option<SystemId> {
    let &[a, b, c, d, system, _, 0, 0] = frame.data() else {
        return None;
    };
    let connects = frame.id() == TO_LOADER && u32::from_le_bytes([a, b, c, d]) == CONNECT;
    match system {
        1 if connects => Some(SystemId::A),
        2 if connects => Some(SystemId::B),
        _ => None,
    }
}
