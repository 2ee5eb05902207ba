//! A payload of any size: how it is filled and read, alike for every library.

use std::mem::MaybeUninit;

/// Returns the word at this place of a payload.
#[inline]
pub(crate) const fn word(stamp: u32, at: usize) -> u32 {
    stamp.wrapping_add(at as u32)
}

/// Writes each word of a payload in place.
#[inline]
pub(crate) fn fill(words: &mut [MaybeUninit<u32>], stamp: u32) {
    for (at, place) in words.iter_mut().enumerate() {
        place.write(word(stamp, at));
    }
}

/// Returns the stamp of a payload, after all its words were read.
///
/// # Panics
/// If a word is not what was written.
#[inline]
pub(crate) fn sum_from(words: &[u32]) -> u32 {
    let (stamp, count) = (words[0], words.len() as u32);
    let sum = words.iter().fold(0u32, |sum, word| sum.wrapping_add(*word));
    let places = (u64::from(count) * (u64::from(count) - 1) / 2) as u32;
    assert_eq!(
        sum,
        stamp.wrapping_mul(count).wrapping_add(places),
        "a payload arrived torn"
    );
    stamp
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_payload_is_known_by_all_its_words() {
        let stamp = u32::MAX - 3;
        let mut words = [MaybeUninit::uninit(); 10];
        fill(&mut words, stamp);
        // SAFETY: `fill` has written all words.
        let words = words.map(|word| unsafe { word.assume_init() });
        assert_eq!(sum_from(&words), stamp);
        let torn = [words[0], words[1] + 1];
        assert!(std::panic::catch_unwind(|| sum_from(&torn)).is_err());
    }
}
