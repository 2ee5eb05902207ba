//! The Ed25519 keys that the bootloader trusts, and its strict and monitor modes. E-4

use crate::manifest::{MANIFEST_BYTES, SIGNED_BYTES};
use salty::{CompressedY, EdwardsPoint, Sha512};

/// Returns whether a signature of a message verifies with a public key.
pub type Verify = fn(key: &[u8; 32], message: &[u8], signature: &[u8; 64]) -> bool;

/// The treatment of an image that is not authentic.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TrustMode {
    /// Refuse it and do not start it.
    Strict,
    /// Accept and start it, and log that.
    Monitor,
}

/// The trust anchor of a bootloader, part of the bootloader's own image.
#[derive(Clone, Copy, Debug)]
pub struct Trust<'k> {
    /// Public keys by number. A new key needs a new bootloader.
    pub keys: &'k [[u8; 32]],
    /// Public keys of testers by number, one for each role. Without any, everybody may program.
    pub testers: &'k [[u8; 32]],
    /// The treatment of an image that is not authentic.
    pub mode: TrustMode,
    /// Verifies a signature: [`ed25519`], or what the chip has for it.
    pub verify: Verify,
}

/// The order of the group, little endian. A valid signature's scalar is below it (RFC 8032, 5.1.7).
const ORDER: [u8; 32] = [
    0xED, 0xD3, 0xF5, 0x5C, 0x1A, 0x63, 0x12, 0x58, 0xD6, 0x9C, 0xF7, 0xA2, 0xDE, 0xF9, 0xDE, 0x14,
    0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0x10,
];

impl Trust<'_> {
    /// Returns whether a manifest is signed by the key that it names, and that key is not below
    /// `lowest_key`.
    #[must_use]
    pub fn is_authentic(&self, manifest: &[u8; MANIFEST_BYTES], lowest_key: u8) -> bool {
        let number = manifest[7];
        let key = self.keys.get(usize::from(number));
        let key = key.filter(|_| number >= lowest_key);
        let (message, signature) = manifest.split_at(SIGNED_BYTES);
        match (key, <&[u8; 64]>::try_from(signature)) {
            (Some(key), Ok(signature)) => (self.verify)(key, message, signature),
            _ => false,
        }
    }
}

/// Verifies an Ed25519 signature (RFC 8032, 5.1.7) in software, with the points and the hash of
/// `salty`. The verification of `salty` itself is 5.5 KiB larger and slower, and accepts a second
/// form of each signature.
#[must_use]
pub fn ed25519(key: &[u8; 32], message: &[u8], signature: &[u8; 64]) -> bool {
    let (point, scalar) = signature.split_at(32);
    let Ok(public) = CompressedY(*key).decompressed() else {
        return false;
    };
    // A scalar that is not below the order would be another form of the same signature.
    if reduced(scalar) != *scalar {
        return false;
    }
    let mut hash = Sha512::new();
    for bytes in [point, key, message] {
        hash.update(bytes);
    }
    let hash = reduced(&hash.finalize());
    // Computes scalar * base - hash * public, both products bit by bit. All inputs are public, so
    // the time may depend on them.
    let (base, public) = (EdwardsPoint::basepoint(), -&public);
    let both = &base + &public;
    let mut sum = EdwardsPoint::neutral_element();
    for bit in (0..256).rev() {
        sum = &sum + &sum;
        let addend = match (is_set(scalar, bit), is_set(&hash, bit)) {
            (false, false) => continue,
            (true, false) => &base,
            (false, true) => &public,
            (true, true) => &both,
        };
        sum = &sum + addend;
    }
    sum.compressed().0 == *point
}

fn is_set(number: &[u8], bit: usize) -> bool {
    number[bit / 8] >> (bit % 8) & 1 != 0
}

/// Reduces a little-endian number modulo the order of the group, bit by bit.
fn reduced(number: &[u8]) -> [u8; 32] {
    let mut rest = [0u8; 32];
    for bit in (0..8 * number.len()).rev() {
        // Double the remainder and add this bit: the result is below 2^254.
        let mut carry = u8::from(is_set(number, bit));
        for byte in &mut rest {
            (*byte, carry) = (*byte << 1 | carry, *byte >> 7);
        }
        if rest.iter().rev().lt(ORDER.iter().rev()) {
            continue;
        }
        let mut borrow = false;
        for (byte, order) in rest.iter_mut().zip(ORDER) {
            let (difference, first) = byte.overflowing_sub(order);
            let (difference, second) = difference.overflowing_sub(u8::from(borrow));
            (*byte, borrow) = (difference, first | second);
        }
    }
    rest
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::manifest::tests::example;
    use proptest::prelude::*;

    fn signed(seed: u8) -> ([u8; 32], [u8; MANIFEST_BYTES]) {
        let pair = salty::Keypair::from(&[seed; 32]);
        let mut bytes = [0; MANIFEST_BYTES];
        let message = example().encode();
        bytes[..SIGNED_BYTES].copy_from_slice(&message);
        bytes[SIGNED_BYTES..].copy_from_slice(&pair.sign(&message).to_bytes());
        (pair.public.to_bytes(), bytes)
    }

    /// The signature of RFC 8032, 7.1, test 2.
    #[test]
    fn the_signature_of_the_rfc_verifies() {
        let hex = |text: &str| -> std::vec::Vec<u8> {
            let digits = text.as_bytes().as_chunks::<2>().0.iter();
            let digits = digits.map(|pair| core::str::from_utf8(pair).unwrap());
            digits
                .map(|pair| u8::from_str_radix(pair, 16).unwrap())
                .collect()
        };
        let key = hex("3d4017c3e843895a92b70aa74d1b7ebc9c982ccf2ec4968cc0cd55f12af4660c");
        let signature = hex(concat!(
            "92a009a9f0d4cab8720e820b5f642540a2b27b5416503f8fb3762223ebdb69da",
            "085ac1e43e15996e458f3613d0f11d8c387b2eaeb4302aeeb00d291612bb0c00"
        ));
        let (key, signature) = (key.try_into().unwrap(), signature.try_into().unwrap());
        assert!(ed25519(&key, &[0x72], &signature));
        assert!(!ed25519(&key, &[0x73], &signature));
    }

    /// E-4: a changed bit is detected; another key, an unknown one and a retired one are refused.
    #[test]
    fn only_the_signed_manifest_is_authentic() {
        let (key, bytes) = signed(1);
        let (other, _) = signed(2);
        let authentic = |keys: &[[u8; 32]], bytes: &_, lowest_key| {
            let mode = TrustMode::Strict;
            let testers = &[];
            let trust = Trust {
                keys,
                testers,
                mode,
                verify: ed25519,
            };
            trust.is_authentic(bytes, lowest_key)
        };
        assert!(authentic(&[key], &bytes, 0));
        assert!(!authentic(&[other], &bytes, 0));
        assert!(!authentic(&[other, key], &bytes, 0));
        assert!(!authentic(&[], &bytes, 0));
        assert!(!authentic(&[key], &bytes, 1));
        for bit in (0..MANIFEST_BYTES * 8).step_by(7) {
            let mut bytes = bytes;
            bytes[bit / 8] ^= 1 << (bit % 8);
            assert!(!authentic(&[key], &bytes, 0), "bit {bit}");
        }
    }

    proptest! {
        /// E-4: two implementations agree, whether or not a bit was changed.
        #[test]
        fn signatures_of_another_implementation_verify(
            seed: [u8; 32],
            message in prop::collection::vec(any::<u8>(), 0..300),
            changed in prop::option::of(0..64 * 8usize),
        ) {
            let pair = salty::Keypair::from(&seed);
            let mut signature = pair.sign(&message).to_bytes();
            if let Some(bit) = changed {
                signature[bit / 8] ^= 1 << (bit % 8);
            }
            let public = pair.public.to_bytes();
            prop_assert_eq!(ed25519(&public, &message, &signature), changed.is_none());
        }

        /// E-4: reduces numbers of up to 512 bits, including multiples of the order.
        #[test]
        fn numbers_are_reduced(wide: [u8; 64], times: u8) {
            let expected = salty::Scalar::from_u512_le(&wide);
            prop_assert_eq!(reduced(&wide), expected.to_bytes());
            let (mut multiple, mut carry) = ([0; 33], 0u16);
            for (byte, order) in multiple.iter_mut().zip(ORDER.into_iter().chain([0])) {
                carry += u16::from(order) * u16::from(times);
                (*byte, carry) = (carry as u8, carry >> 8);
            }
            prop_assert_eq!(reduced(&multiple), [0; 32]);
        }
    }

    /// E-4: the second form of a signature, its scalar plus the order, is refused.
    #[test]
    fn a_signature_has_one_form() {
        let (key, mut bytes) = signed(1);
        let mut carry = 0;
        for (byte, add) in bytes[SIGNED_BYTES + 32..].iter_mut().zip(ORDER) {
            let sum = u16::from(*byte) + u16::from(add) + carry;
            (*byte, carry) = (sum as u8, sum >> 8);
        }
        let (message, signature) = bytes.split_at(SIGNED_BYTES);
        let public = salty::PublicKey::try_from(&key).unwrap();
        let form: &[u8; 64] = signature.try_into().unwrap();
        assert!(
            public.verify(message, &form.into()).is_ok(),
            "salty takes it"
        );
        assert!(!ed25519(&key, message, form));
    }
}
