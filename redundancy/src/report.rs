//! A system's report about itself, over the link and in its status frame.

use crate::state::CRC;
use crate::{Ability, Mode, Role, Term};

/// A system's report about itself. The same content is sent over the data link in a
/// [`LinkReport`] and, without `can_alive`, in the status frame on CAN: there, role and mode are
/// their numbers, the ability is [`Ability::bits`], and the frame's arrival shows `can_alive`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct PeerReport {
    /// Its role.
    pub role: Role,
    /// The function that it runs.
    pub mode: Mode,
    /// The highest term that it has seen.
    pub term: Term,
    /// Whether it hears frames on CAN.
    pub can_alive: bool,
    /// How well it can drive.
    pub ability: Ability,
}

/// A report as sent over the link. It contains its time of sending, so that a report that is
/// repeated, or arrives far too late, does not count as a sign of life. The time also shows the
/// sender's clock to the other system.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct LinkReport {
    /// The content.
    pub report: PeerReport,
    /// Identifies its sender's last start: the lowest eleven bits of the count of starts.
    pub start: u16,
    /// When it was sent, µs on the sender's clock; wraps around. Of two reports of one start the
    /// later one has the larger time.
    pub sent_us: u32,
}

impl LinkReport {
    /// Length of the datagram in words.
    pub const WORDS: usize = 4;
    const MAGIC: u32 = 0x5E90_0000;
    const STARTS: u16 = 0x7FF;

    /// Returns the datagram for the link: head, term, time, CRC-32 of these.
    #[must_use]
    pub fn to_words(&self) -> [u32; Self::WORDS] {
        let report = &self.report;
        let head = Self::MAGIC
            | u32::from(report.role as u8)
            | u32::from(report.ability.bits()) << 2
            | u32::from(report.mode as u8) << 4
            | u32::from(report.can_alive) << 8
            | u32::from(self.start & Self::STARTS) << 9;
        let content = [head, report.term.bits(), self.sent_us];
        let [head, term, sent_us] = content;
        [head, term, sent_us, Self::check(content)]
    }

    fn check(content: [u32; 3]) -> u32 {
        let mut digest = CRC.digest();
        for word in content {
            digest.update(&word.to_le_bytes());
        }
        digest.finalize()
    }

    /// Returns the report in a datagram; `None` if the datagram is invalid.
    #[must_use]
    pub fn from_words(words: &[u32]) -> Option<Self> {
        let &[head, term, sent_us, check] = words else {
            return None;
        };
        if check != Self::check([head, term, sent_us]) || head >> 20 != Self::MAGIC >> 20 {
            return None;
        }
        let report = PeerReport {
            role: Role::from_repr((head & 3) as u8)?,
            mode: Mode::from_repr((head >> 4 & 0xF) as u8)?,
            term: Term::from_bits(term),
            can_alive: head & 0x100 != 0,
            ability: Ability::from_bits((head >> 2) as u8),
        };
        let start = (head >> 9) as u16 & Self::STARTS;
        Some(Self {
            report,
            start,
            sent_us,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use strum::VariantArray as _;

    #[test]
    fn reports_round_trip() {
        for &role in Role::VARIANTS {
            for &mode in Mode::VARIANTS {
                for (can_alive, &ability) in [false, true]
                    .iter()
                    .flat_map(|it| Ability::VARIANTS.iter().map(move |a| (*it, a)))
                {
                    let report = PeerReport {
                        role,
                        mode,
                        term: Term::from_bits(77),
                        can_alive,
                        ability,
                    };
                    for start in [0, 1, 0x7FF] {
                        let sent = LinkReport {
                            report,
                            start,
                            sent_us: u32::MAX - 4,
                        };
                        assert_eq!(LinkReport::from_words(&sent.to_words()), Some(sent));
                    }
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
            ability: Ability::All,
        };
        let sent = LinkReport {
            report,
            start: 3,
            sent_us: 17,
        };
        let words = sent.to_words();
        assert_eq!(LinkReport::from_words(&words[..3]), None);
        for word in 0..4 {
            for bit in 0..32 {
                let mut wrong = words;
                wrong[word] ^= 1 << bit;
                assert_eq!(
                    LinkReport::from_words(&wrong),
                    None,
                    "word {word} bit {bit}"
                );
            }
        }
    }
}
