//! The straps: words that the emulator writes before the start.

use core::ptr::addr_of;

unsafe extern "C" {
    static __straps: u32;
}

/// Returns word `index` of the words that the emulator writes before the start, like pins that are
/// tied high or low. Returns 0 if the word was not set.
///
/// # Panics
/// If there is no such strap: there are 1024.
#[must_use]
pub fn strap(index: usize) -> u32 {
    assert!(index < 1024);
    // SAFETY: link.x reserves 4 KiB there, which no code writes after the start.
    unsafe { addr_of!(__straps).add(index).read_volatile() }
}
