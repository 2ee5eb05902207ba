//! Memory for the bootloader: the RAM that it runs from, and the keys beside the straps.

use core::ptr::addr_of;
use core::sync::atomic::AtomicU8;

unsafe extern "C" {
    static __straps: u32;
}

/// The RAM that a bootloader from a bank runs from: bank.x.
pub(crate) static LOADER_RAM: LoaderRam = LoaderRam(());

/// See [`LOADER_RAM`].
pub(crate) struct LoaderRam(());

impl core::ops::Deref for LoaderRam {
    type Target = [AtomicU8];

    fn deref(&self) -> &[AtomicU8] {
        const BEGIN: *const AtomicU8 = core::ptr::without_provenance(0x8048_0000);
        // SAFETY: link.x keeps 32 KiB there free; atomics may be shared.
        unsafe { core::slice::from_raw_parts(BEGIN, 32 << 10) }
    }
}

/// Index of the first word of the public key in the straps.
const KEY_AT: usize = 16;

/// Returns the public key that the bootloader of this machine trusts. A chip has it in fuses.
#[must_use]
pub(crate) fn public_key() -> [u8; 32] {
    key_at(KEY_AT)
}

/// Returns the public keys of testers: one, or none.
#[must_use]
pub(crate) fn testers() -> &'static [[u8; 32]] {
    // SAFETY: link.x reserves 4 KiB there; the key is bytes, and nothing writes it after the start.
    let key = unsafe { &*addr_of!(__straps).add(KEY_AT + 8).cast::<[u8; 32]>() };
    if key.iter().all(|byte| *byte == 0) {
        return &[];
    }
    core::slice::from_ref(key)
}

fn key_at(at: usize) -> [u8; 32] {
    let mut key = [0; 32];
    let (words, _) = key.as_chunks_mut::<4>();
    for (index, word) in words.iter_mut().enumerate() {
        // SAFETY: words of the memory that `testers` describes.
        let read = unsafe { addr_of!(__straps).add(at + index).read_volatile() };
        *word = read.to_le_bytes();
    }
    key
}
