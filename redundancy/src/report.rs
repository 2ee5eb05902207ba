//! A system's report about itself, over the link and in its status frame.

use crate::state::CRC;
use crate::{Mode, Role, Term};

/// A system's report about itself. The same content is sent over the data link (every control
/// cycle) and, without `can_alive`, in the status frame on CAN.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PeerReport {
    /// Its role.
    pub role: Role,
    /// The function that it runs.
    pub mode: Mode,
    /// The highest term that it knows.
    pub term: Term,
    /// It hears frames on CAN.
    pub can_alive: bool,
}

impl PeerReport {
    /// Length of the datagram in words.
    pub const WORDS: usize = 3;
    const MAGIC: u32 = 0x5E90_0000;

    /// The datagram for the link: head, term, CRC-32 of both.
    #[must_use]
    pub fn to_words(&self) -> [u32; Self::WORDS] {
        let head = Self::MAGIC
            | u32::from(self.role.code())
            | u32::from(self.mode.code()) << 4
            | u32::from(self.can_alive) << 8;
        let term = self.term.bits();
        [head, term, Self::check(head, term)]
    }

    fn check(head: u32, term: u32) -> u32 {
        let mut digest = CRC.digest();
        digest.update(&head.to_le_bytes());
        digest.update(&term.to_le_bytes());
        digest.finalize()
    }

    /// The report in a datagram; `None` if the datagram is invalid.
    #[must_use]
    pub fn from_words(words: &[u32]) -> Option<Self> {
        let &[head, term, check] = words else {
            return None;
        };
        if check != Self::check(head, term) || head & !0x1FF != Self::MAGIC {
            return None;
        }
        Some(Self {
            role: Role::from_code((head & 0xF) as u8)?,
            mode: Mode::from_code((head >> 4 & 0xF) as u8)?,
            term: Term::from_bits(term),
            can_alive: head & 0x100 != 0,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reports_round_trip() {
        for role in Role::ALL {
            for mode in Mode::ALL {
                for can_alive in [false, true] {
                    let report = PeerReport {
                        role,
                        mode,
                        term: Term::from_bits(77),
                        can_alive,
                    };
                    assert_eq!(PeerReport::from_words(&report.to_words()), Some(report));
                }
            }
        }
    }

    #[test]
    fn what_is_no_report_is_refused() {
        let report = PeerReport {
            role: Role::Master,
            mode: Mode::L3,
            term: Term::from_bits(8),
            can_alive: true,
        };
        let words = report.to_words();
        assert_eq!(PeerReport::from_words(&words[..2]), None);
        for word in 0..3 {
            for bit in 0..32 {
                let mut wrong = words;
                wrong[word] ^= 1 << bit;
                assert_eq!(
                    PeerReport::from_words(&wrong),
                    None,
                    "word {word} bit {bit}"
                );
            }
        }
    }
}
