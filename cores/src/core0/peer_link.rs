//! Datagrams of core 0 to the other system's core 0, beside the redundancy's report: protected end
//! to end like a CAN frame. T-CHIP-5
//!
//! Word 0 holds CRC-16, counter and kind; the rest is the content. What arrives is an allegation:
//! it is decoded into a checked type or refused.

use super::agreement::Stage;
use crate::driving::types::Command;
use tandem_bus::ModeCode;
use tandem_bus::e2e::{Checker, protect};

/// What this system would command, and whether it agrees with the other.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Opinion {
    /// The function that gave it; none while the opinion does not count yet.
    pub(super) mode: ModeCode,
    pub(super) stage: Stage,
    pub(super) command: Command,
}

/// Data ids of the protection: above those of CAN, so that no frame passes for a datagram.
const OPINION: u16 = 0x0801;

/// Largest magnitude of a command: far beyond what a vehicle does.
const LIMIT: f32 = 1e3;

impl Opinion {
    const WORDS: usize = 4;

    fn to_words(self, counter: u8) -> [u32; Self::WORDS] {
        let words = [
            0,
            self.mode as u32 | (self.stage as u32) << 8,
            self.command.steering_angle.to_bits(),
            self.command.acceleration.to_bits(),
        ];
        let mut bytes = [0; 4 * Self::WORDS];
        for (bytes, word) in bytes.chunks_exact_mut(4).zip(words) {
            bytes.copy_from_slice(&word.to_le_bytes());
        }
        protect(OPINION, counter, &mut bytes);
        words_of(&bytes)
    }

    fn from_words(words: &[u32; Self::WORDS]) -> Option<Self> {
        let code = |code: u32| u8::try_from(code).ok();
        let number = |bits| Some(f32::from_bits(bits)).filter(|value| value.abs() <= LIMIT);
        let mode = code(words[1] & 0xFF)?;
        let stage = code(words[1] >> 8)?;
        Some(Self {
            mode: ModeCode::ALL.into_iter().find(|one| *one as u8 == mode)?,
            stage: Stage::ALL.into_iter().find(|one| *one as u8 == stage)?,
            command: Command {
                steering_angle: number(words[2])?,
                acceleration: number(words[3])?,
            },
        })
    }
}

fn words_of<const BYTES: usize, const WORDS: usize>(bytes: &[u8; BYTES]) -> [u32; WORDS] {
    let mut words = [0; WORDS];
    for (word, bytes) in words.iter_mut().zip(bytes.chunks_exact(4)) {
        *word = u32::from_le_bytes([bytes[0], bytes[1], bytes[2], bytes[3]]);
    }
    words
}

/// Both ends of the datagrams.
#[derive(Clone, Debug)]
pub(super) struct PeerLink {
    sent: u8,
    checker: Checker,
}

impl PeerLink {
    pub(super) const fn new() -> Self {
        Self {
            sent: 0,
            checker: Checker::new(OPINION),
        }
    }

    /// The datagram for an opinion that is sent now.
    pub(super) fn opinion(&mut self, opinion: Opinion) -> [u32; Opinion::WORDS] {
        self.sent = self.sent.wrapping_add(1);
        opinion.to_words(self.sent)
    }

    /// The opinion in a datagram; `None` if there is none, or not a new one.
    pub(super) fn on_datagram(&mut self, words: &[u32]) -> Option<Opinion> {
        let words: &[u32; Opinion::WORDS] = words.try_into().ok()?;
        let mut bytes = [0; 4 * Opinion::WORDS];
        for (bytes, word) in bytes.chunks_exact_mut(4).zip(words) {
            bytes.copy_from_slice(&word.to_le_bytes());
        }
        let check = self.checker.check(&bytes);
        Opinion::from_words(words).filter(|_| check.is_accepted())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn opinion() -> Opinion {
        Opinion {
            mode: ModeCode::L3,
            stage: Stage::Disagreed,
            command: Command {
                steering_angle: -0.02,
                acceleration: 1.5,
            },
        }
    }

    /// T-CHIP-5: an opinion arrives once; a repeated or damaged one is refused, and so is one with
    /// values that no system sends.
    #[test]
    fn only_a_new_and_whole_opinion_is_taken() {
        let (mut from, mut to) = (PeerLink::new(), PeerLink::new());
        let words = from.opinion(opinion());
        assert_eq!(to.on_datagram(&words), Some(opinion()));
        assert_eq!(to.on_datagram(&words), None, "repeated");
        let words = from.opinion(opinion());
        assert_eq!(to.on_datagram(&words[..3]), None);
        for bit in 0..128 {
            let mut wrong = words;
            wrong[bit / 32] ^= 1 << (bit % 32);
            assert_eq!(to.clone().on_datagram(&wrong), None, "bit {bit}");
        }
        for strange in [f32::NAN, f32::INFINITY, 1e9] {
            let mut strange_one = opinion();
            strange_one.command.acceleration = strange;
            let words = from.opinion(strange_one);
            assert_eq!(to.on_datagram(&words), None, "{strange}");
        }
    }
}
