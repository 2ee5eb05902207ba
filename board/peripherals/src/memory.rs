//! Faults of shared memory.

use core::sync::atomic::Ordering::Relaxed;
use tandem_board::LmuWord;

/// Overwrites all of these words, as a faulty core might. `seed` determines the new words.
pub fn scribble(words: &[LmuWord], seed: u32) {
    let mut word = seed | 1;
    for place in words {
        // Marsaglia's xorshift: the words are arbitrary, but the same in each run.
        word ^= word << 13;
        word ^= word >> 17;
        word ^= word << 5;
        place.store(word, Relaxed);
    }
}
