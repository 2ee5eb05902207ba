//! Mastership terms: which of two masters the vehicle obeys.

use tandem_board::SystemId;

/// The number of one mastership: `count << 1 | system`.
///
/// A system that begins to drive takes a term above every term it knows. The lowest bit is the
/// system, so no two systems ever drive in the same term, and "the higher term" always names one of
/// them. The vehicle accepts no control frame of a term below the highest it has accepted
/// (fencing).
///
/// Terms do not wrap around: 2^31 masterships last longer than the data flash that counts them. If
/// terms wrapped around, one forged frame could reverse their order. A number near the end is not
/// a term, so no word that is received uses the terms up.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Term(u32);

impl Term {
    /// No mastership: lower than every term in which a system drives.
    pub const NONE: Self = Self(0);
    /// The highest term. Higher numbers, for instance all bits set, are no terms.
    pub const LAST: Self = Self::last_but(1 << 13);
    /// The highest term that is believed though it is far from the known one and only one witness
    /// reports it: two million masterships are left.
    pub const LAST_UNEXPLAINED: Self = Self::last_but(1 << 21);
    /// A term whose count differs from the known one by no more than this is explained by the rules
    /// for a new term: they raise the count by 1, 8 or 1,024.
    pub const EXPLAINED: u32 = 2_048;

    const fn last_but(count: u32) -> Self {
        Self(u32::MAX - 2 * count)
    }

    /// Returns the term with this number, from a frame or from the flash.
    #[must_use]
    pub const fn from_bits(bits: u32) -> Self {
        Self(bits)
    }

    /// Returns the number for a frame.
    #[must_use]
    pub const fn bits(self) -> u32 {
        self.0
    }

    /// Returns the system that may drive in this term.
    #[must_use]
    pub const fn system(self) -> SystemId {
        if self.0 & 1 == 0 {
            SystemId::A
        } else {
            SystemId::B
        }
    }

    /// Returns whether no rule for a new term explains this one beside the highest known term: it
    /// is far from it, or no term at all.
    #[must_use]
    pub const fn is_far_from(self, known: Self) -> bool {
        self.0 > Self::LAST.0 || (self.0 >> 1).abs_diff(known.0 >> 1) > Self::EXPLAINED
    }

    /// Returns the lowest term of `system` whose count is `step` (at least 1) above that of `self`;
    /// it is higher than `self`. `None` when the numbers are used up.
    #[must_use]
    pub const fn above(self, step: u32, system: SystemId) -> Option<Self> {
        match (self.0 >> 1).checked_add(if step == 0 { 1 } else { step }) {
            Some(count) if count <= Self::LAST.0 >> 1 => {
                Some(Self(count << 1 | system.index() as u32))
            }
            _ => None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// T-RED-9: terms of the two systems never coincide, and each new term is above all known ones.
    #[test]
    fn terms_are_unique_and_rise() {
        for bits in [0, 1, 2, 3, 1000, 1001, Term::LAST.bits() - 2] {
            let known = Term::from_bits(bits);
            let a = known.above(1, SystemId::A).unwrap();
            let b = known.above(1, SystemId::B).unwrap();
            assert!(a > known && b > known && a != b);
            assert_eq!((a.system(), b.system()), (SystemId::A, SystemId::B));
        }
    }

    #[test]
    fn terms_end_instead_of_wrapping() {
        for system in SystemId::ALL {
            assert_eq!(Term::from_bits(u32::MAX).above(1, system), None);
            assert_eq!(Term::LAST.above(1, system), None);
            assert_eq!(Term::from_bits(0).above(u32::MAX, system), None);
        }
    }

    /// T-RED-9: the rules explain a term up to a distance, and never one near the end.
    #[test]
    fn rules_explain_terms_up_to_a_distance() {
        let known = Term::from_bits(2 * 5_000);
        for (bits, far) in [
            (2 * (5_000 + 2_048) + 1, false),
            (2 * (5_000 + 2_049), true),
            (2 * (5_000 - 2_048), false),
            (2 * (5_000 - 2_049) + 1, true),
            (u32::MAX, true),
        ] {
            assert_eq!(Term::from_bits(bits).is_far_from(known), far, "{bits}");
        }
        for bits in Term::LAST.bits() + 1..Term::LAST.bits() + 9 {
            assert!(Term::from_bits(bits).is_far_from(Term::LAST));
        }
    }
}
