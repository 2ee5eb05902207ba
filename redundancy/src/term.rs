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
/// terms wrapped around, one forged frame could reverse their order.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Term(u32);

impl Term {
    /// No mastership: lower than every term in which a system drives.
    pub const NONE: Self = Self(0);

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

    /// Returns the lowest term of `system` whose count is `step` (at least 1) above that of `self`;
    /// it is higher than `self`. `None` when the numbers are used up.
    #[must_use]
    pub const fn above(self, step: u32, system: SystemId) -> Option<Self> {
        match (self.0 >> 1).checked_add(if step == 0 { 1 } else { step }) {
            Some(count) if count <= u32::MAX >> 1 => Some(Self(count << 1 | system.index() as u32)),
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
        for bits in [0, 1, 2, 3, 1000, 1001, u32::MAX - 2] {
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
            assert_eq!(Term::from_bits(u32::MAX - 1).above(1, system), None);
            assert_eq!(Term::from_bits(0).above(u32::MAX, system), None);
        }
    }
}
