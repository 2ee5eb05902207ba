//! Software lockstep: compares the outputs of redundant clients (E-3).
//!
//! A client that is silent and one that deviates are different findings: the first may only be
//! late, the second must not act.

use crate::message::{ClientId, Clients};

/// What the outputs of one activation show.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Agreement {
    /// More than half of the outputs are equal, and they are enough.
    Agreed {
        /// Their digest.
        output: u64,
        /// The clients that computed it.
        agreeing: Clients,
        /// The clients that computed something else.
        deviating: Clients,
    },
    /// No majority, or too small a one: safe state. Nobody can tell which output is right.
    NoMajority,
}

/// Compares the outputs of one activation: who computed which digest. A majority counts if it has
/// at least `quorum` clients. A client must not occur twice.
#[must_use]
pub fn compare(outputs: impl Iterator<Item = (ClientId, u64)> + Clone, quorum: usize) -> Agreement {
    // The majority vote of R. S. Boyer and J S. Moore, "MJRTY" (1991): the only candidate that can
    // have a majority is the one that is left when unequal pairs are taken out.
    let (mut candidate, mut lead) = (0, 0_usize);
    for (_, output) in outputs.clone() {
        if lead == 0 {
            (candidate, lead) = (output, 1);
        } else if output == candidate {
            lead += 1;
        } else {
            lead -= 1;
        }
    }
    let of = |wanted: bool| -> Clients {
        let chosen = outputs
            .clone()
            .filter(move |(_, output)| (*output == candidate) == wanted);
        chosen.map(|(client, _)| client).collect()
    };
    let (agreeing, deviating) = (of(true), of(false));
    if agreeing.len() > deviating.len() && agreeing.len() >= quorum {
        Agreement::Agreed {
            output: candidate,
            agreeing,
            deviating,
        }
    } else {
        Agreement::NoMajority
    }
}

/// The digest of a client's outputs: FNV-1a of 64 bits (G. Fowler, L. C. Noll, K.-P. Vo, RFC 9923).
///
/// Each step is a bijection of the state, so outputs that differ in bits of one byte always have
/// different digests; others have equal ones with a probability of 2^-64.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct OutputDigest(u64);

impl OutputDigest {
    /// No outputs.
    pub const NONE: Self = Self(0xCBF2_9CE4_8422_2325);

    /// Adds a word of the outputs.
    pub const fn add(&mut self, word: u32) {
        let bytes = word.to_le_bytes();
        let mut rest = bytes.as_slice();
        while let [byte, after @ ..] = rest {
            self.0 = (self.0 ^ *byte as u64).wrapping_mul(0x0100_0000_01B3);
            rest = after;
        }
    }

    /// Returns the digest.
    #[must_use]
    pub const fn digest(self) -> u64 {
        self.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn judge(outputs: &[u64], quorum: usize) -> Option<(u64, Vec<usize>)> {
        let clients = ClientId::first(outputs.len()).zip(outputs.iter().copied());
        match compare(clients, quorum) {
            Agreement::Agreed {
                output, deviating, ..
            } => Some((output, deviating.iter().map(ClientId::index).collect())),
            Agreement::NoMajority => None,
        }
    }

    /// E-3: of three clients the deviating one is named, wherever it stands; two that differ, and
    /// three of which each differs, have no majority.
    #[test]
    fn the_one_that_deviates_is_named() {
        assert_eq!(judge(&[7, 7, 7], 2), Some((7, vec![])));
        assert_eq!(judge(&[9, 7, 7], 2), Some((7, vec![0])));
        assert_eq!(judge(&[7, 9, 7], 2), Some((7, vec![1])));
        assert_eq!(judge(&[7, 7, 9], 2), Some((7, vec![2])));
        assert_eq!(judge(&[7, 9], 1), None);
        assert_eq!(judge(&[7, 8, 9], 1), None);
        assert_eq!(judge(&[1, 1, 2, 2], 1), None);
        assert_eq!(judge(&[1, 2, 1, 3, 1], 2), Some((1, vec![1, 3])));
        assert_eq!(judge(&[], 0), None);
    }

    /// One client alone agrees with itself; that is enough only if the quorum says so.
    #[test]
    fn a_small_majority_is_none() {
        assert_eq!(judge(&[7], 2), None);
        assert_eq!(judge(&[7], 1), Some((7, vec![])));
        assert_eq!(judge(&[7, 7, 9], 3), None);
    }

    /// E-3: every single bit flip in outputs of 24 words changes the digest.
    #[test]
    fn a_bit_flip_changes_the_digest() {
        let words: [u32; 24] = core::array::from_fn(|k| (k as u32).wrapping_mul(0x9E37_79B9));
        let digest = |words: &[u32]| {
            let mut output = OutputDigest::NONE;
            words.iter().for_each(|word| output.add(*word));
            output.digest()
        };
        for bit in 0..24 * 32 {
            let mut flipped = words;
            flipped[bit / 32] ^= 1 << (bit % 32);
            assert_ne!(digest(&flipped), digest(&words), "bit {bit}");
        }
        // The published test vector for the bytes "foobar" is of bytes; ours of whole words.
        assert_eq!(digest(&[u32::from_le_bytes(*b"foob")]), fnv1a(b"foob"));
    }

    fn fnv1a(bytes: &[u8]) -> u64 {
        let step = |hash: u64, byte: &u8| (hash ^ u64::from(*byte)).wrapping_mul(1_099_511_628_211);
        bytes.iter().fold(14_695_981_039_346_656_037, step)
    }
}
