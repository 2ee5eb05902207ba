//! The LMU of each system, at the address from the linker script. Each board includes this file.

use core::ptr::addr_of;
use core::sync::atomic::AtomicU32;
use tandem_board::SystemId;

/// Words of an LMU: 32 KiB.
pub const LMU_WORDS: usize = 8192;

unsafe extern "C" {
    static __lmu_a: AtomicU32;
    static __lmu_b: AtomicU32;
}

/// Returns the LMU of a system.
#[must_use]
pub fn lmu(system: SystemId) -> &'static [AtomicU32] {
    // SAFETY: link.x reserves 32 KiB there for this use only, aligned to 64 bytes; atomics may be
    // shared; the memory exists as long as the machine.
    unsafe {
        let begin = match system {
            SystemId::A => addr_of!(__lmu_a),
            SystemId::B => addr_of!(__lmu_b),
        };
        core::slice::from_raw_parts(begin, LMU_WORDS)
    }
}
