//! One number that identifies a whole run.

use crate::event::{OnBus, SystemEvent, SystemEventKind};
use tandem_board::{CanId, CoreAddress};
use tandem_peripherals::codec::Sender;

/// A running digest of 64-bit words. It is not cryptographic: two different runs have different
/// digests with a probability of 1 - 2^-64.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Digest(u64);

impl Digest {
    pub(crate) const fn new() -> Self {
        Self(0x5EED)
    }

    pub(crate) const fn value(self) -> u64 {
        self.0
    }

    /// Mixes in a word with the finalizer of SplitMix64 (Steele, Lea, Flood 2014).
    const fn word(&mut self, word: u64) {
        let mut mixed = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15) ^ word;
        mixed = (mixed ^ (mixed >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        mixed = (mixed ^ (mixed >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        self.0 = mixed ^ (mixed >> 31);
    }

    pub(crate) fn frame(&mut self, OnBus { at, sender, frame }: &OnBus) {
        let from = match sender {
            Sender::Core(CoreAddress { system, core }) => 1 + system.index() * 3 + core.index(),
            _ => 0,
        };
        let id = match frame.id() {
            CanId::Standard(id) => id.into(),
            CanId::Extended(id) => id | 1 << 31,
        };
        self.word(at.as_ns());
        self.word(u64::from(id) << 32 | (from as u64) << 16 | frame.data().len() as u64);
        for bytes in frame.data().chunks(8) {
            let mut word = [0; 8];
            word[..bytes.len()].copy_from_slice(bytes);
            self.word(u64::from_le_bytes(word));
        }
    }

    pub(crate) fn event(&mut self, SystemEvent { at, system, kind }: &SystemEvent) {
        use SystemEventKind as K;
        let (what, which) = match *kind {
            K::Started(cause) => (0, cause as usize),
            K::PowerLost => (1, 0),
            K::Requested(core, request) => (2, core.index() << 8 | request as usize),
            K::Reset(cause) => (3, cause as usize),
            K::Suspended => (4, 0),
            K::CoreDied(core) => (5, core.index()),
            K::CoreRestarted(core) => (6, core.index()),
            K::Lamp(lamp) => (7, lamp as usize),
        };
        self.word(at.as_ns());
        self.word(system.index() as u64 | what << 8 | (which as u64) << 16);
    }
}
