//! Datagrams from core 0 to core 0 of the other system, besides the redundancy's report. They are
//! protected end to end like a CAN frame. T-CHIP-5
//!
//! Word 0 holds CRC-16, counter and version. Receivers decode the rest into a checked type or
//! refuse it.

use tandem_bus::e2e::{Checker, protect};

/// Words of the longest datagram.
pub(super) const MAX_WORDS: usize = 32;

/// Ids for the protection: above those of CAN, so that no frame is accepted as a datagram.
pub(super) const PEER_COMMAND: u16 = 0x0801;
pub(super) const KNOWLEDGE_REQUEST: u16 = 0x0802;
pub(super) const KNOWLEDGE_CHUNK: u16 = 0x0803;
pub(super) const PULSE: u16 = 0x0804;

/// Writes CRC, the next counter and version into word 0. `words` has at most [`MAX_WORDS`].
pub(super) fn seal(id: u16, version: u8, counter: &mut u8, words: &mut [u32]) {
    *counter = counter.wrapping_add(1);
    words[0] = u32::from(version) << 24;
    let mut bytes = [0; 4 * MAX_WORDS];
    let bytes = to_bytes(words, &mut bytes);
    protect(id, *counter, bytes);
    words[0] = u32::from_le_bytes([bytes[0], bytes[1], bytes[2], bytes[3]]);
}

/// Tests whether the datagram has the checker's id and this version, and is new. `words` has at
/// most [`MAX_WORDS`].
pub(super) fn is_sealed(checker: &mut Checker, version: u8, words: &[u32]) -> bool {
    let mut bytes = [0; 4 * MAX_WORDS];
    let is_new = checker.check(to_bytes(words, &mut bytes)).is_accepted();
    is_new && words[0] >> 24 == u32::from(version)
}

fn to_bytes<'a>(words: &[u32], bytes: &'a mut [u8; 4 * MAX_WORDS]) -> &'a mut [u8] {
    for (bytes, word) in bytes.chunks_exact_mut(4).zip(words) {
        bytes.copy_from_slice(&word.to_le_bytes());
    }
    &mut bytes[..4 * words.len()]
}
