//! The memory that the processes of one batch share: words of the case, and what each writes down.

use crate::clock::monotonic_ns;
use std::io;
use std::sync::atomic::{AtomicU32, AtomicU64, Ordering};

/// Processes of a batch at most.
pub const PARTS: usize = 4;
/// Samples that one track of a part keeps; further ones are dropped.
pub const TRACK: usize = 1 << 16;
/// Numbers that a part can note besides its samples.
pub const NOTES: usize = 6;
/// The one that the harness notes: CPU time of the part within its timed span, ns.
pub const CPU_NS: usize = NOTES - 1;

/// Words in a cache line.
pub const LINE: usize = 16;
/// Words in two cache lines, which some processors fetch together.
pub const PAIR: usize = 2 * LINE;
/// Words of a page.
const PAGE: usize = 1024;
/// Word 0 counts the parts that have met.
const MET_AT: usize = 0;
/// A word of the harness for whatever the parts agree on.
const FLAG_AT: usize = LINE;
/// A word that only the part inside a lock may change.
const GUARDED_AT: usize = 2 * LINE;
/// Further words for whatever the parts agree on.
const SPARE_AT: usize = 3 * LINE;
/// Each part's page: two counts, notes of two words each, then a text.
const PAGES_AT: usize = PAGE;
const NOTES_AT: usize = LINE;
const TEXT_AT: usize = 4 * LINE;
const TEXT_WORDS: usize = 64;
const TRACKS_AT: usize = PAGES_AT + PARTS * PAGE;
const TRACKS_END: usize = TRACKS_AT + PARTS * 2 * TRACK;
/// Words of a case that asks for no more.
const CASE_WORDS: usize = 4 * PAGE;
/// Beyond this, pages of the case come when they are touched.
const POPULATE_UP_TO: usize = 1 << 20;

/// A number below `count`, drawn anew by each call.
#[must_use]
pub fn draw(count: usize) -> usize {
    static DRAWN: AtomicU64 = AtomicU64::new(0);
    // G. Steele and others, "Fast splittable pseudorandom number generators", 2014: SplitMix64.
    let step = DRAWN.fetch_add(0x9E37_79B9_7F4A_7C15, Ordering::Relaxed);
    let seed = monotonic_ns().wrapping_add(step);
    let mixed = (seed ^ (seed >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    let mixed = (mixed ^ (mixed >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    ((mixed ^ (mixed >> 31)) % count as u64) as usize
}

/// Memory that the parts of a batch share, zero at first. Each batch has its own, and its case
/// begins at a place in the page that is drawn anew: a multiple of [`PAIR`].
#[derive(Debug)]
pub struct Shared {
    words: &'static [AtomicU32],
    case_at: usize,
}

impl Shared {
    /// Maps it, with room for a case that needs a few lines.
    ///
    /// # Errors
    /// If there is not enough memory.
    pub fn new() -> io::Result<Self> {
        Self::with_case_words(CASE_WORDS)
    }

    /// Maps it, with this many words for the case.
    ///
    /// # Errors
    /// If there is not enough memory.
    pub fn with_case_words(case_words: usize) -> io::Result<Self> {
        let case_at = TRACKS_END + draw(PAGE / PAIR) * PAIR;
        let total = case_at + case_words;
        let populate = if case_words <= POPULATE_UP_TO {
            libc::MAP_POPULATE
        } else {
            0
        };
        // SAFETY: a fresh anonymous mapping, not at a fixed address, touches no other memory.
        let base = unsafe {
            libc::mmap(
                std::ptr::null_mut(),
                total * 4,
                libc::PROT_READ | libc::PROT_WRITE,
                libc::MAP_SHARED | libc::MAP_ANONYMOUS | libc::MAP_NORESERVE | populate,
                -1,
                0,
            )
        };
        if base == libc::MAP_FAILED {
            return Err(io::Error::last_os_error());
        }
        // SAFETY: the mapping has this many zeroed bytes, is aligned to a page, and is unmapped
        // only by `drop`, after which its batch uses no word of it any more.
        let words = unsafe { std::slice::from_raw_parts(base.cast(), total) };
        Ok(Self { words, case_at })
    }

    /// The words of the case, aligned to two cache lines.
    #[must_use]
    pub fn case(&self) -> &'static [AtomicU32] {
        &self.words[self.case_at..]
    }

    /// One word of the case on a cache line of its own.
    #[must_use]
    pub fn line(&self, number: usize) -> &'static AtomicU32 {
        &self.case()[number * LINE]
    }

    /// Barrier: waits until this many parts have called it.
    pub fn meet(&self, parts: u32) {
        let met = &self.words[MET_AT];
        // AcqRel pairs with the Acquire below: what a part prepared is visible to the others.
        let before = met.fetch_add(1, Ordering::AcqRel);
        // Rounded up: the parts may meet again.
        let all = (before / parts + 1) * parts;
        while met.load(Ordering::Acquire) < all {
            std::thread::yield_now();
        }
    }

    /// A word for whatever the parts agree on, beside those of the case.
    #[must_use]
    pub fn flag(&self) -> &'static AtomicU32 {
        &self.words[FLAG_AT]
    }

    /// A word that only the part inside a lock may change.
    #[must_use]
    pub fn guarded(&self) -> &'static AtomicU32 {
        &self.words[GUARDED_AT]
    }

    /// Further words that the parts agree on, each on a cache line of its own: 0 to 2.
    #[must_use]
    pub fn spare(&self, number: usize) -> &'static AtomicU32 {
        &self.words[SPARE_AT + number * LINE]
    }

    /// Maps every page that the harness itself writes, so that no fault is timed.
    pub fn touch(&self) {
        for page in self.words[..self.case_at].chunks(PAGE) {
            std::hint::black_box(page[0].load(Ordering::Relaxed));
        }
    }

    /// What part `number` writes down, or has written down.
    #[must_use]
    pub fn log(&self, number: usize) -> Log {
        let tracks = [0, 1].map(|track| {
            let at = TRACKS_AT + (2 * number + track) * TRACK;
            &self.words[at..at + TRACK]
        });
        Log {
            page: &self.words[PAGES_AT + number * PAGE..][..PAGE],
            tracks,
            counts: [0; 2],
        }
    }
}

impl Drop for Shared {
    fn drop(&mut self) {
        let base = self.words.as_ptr().cast_mut().cast();
        // SAFETY: `base` and the length are those of the mapping made at the begin; the batch is
        // over, and its parts, which were processes, are gone.
        unsafe { libc::munmap(base, size_of_val(self.words)) };
    }
}

/// What one part of a batch writes down: two tracks of samples in ticks, and some numbers.
#[derive(Clone, Debug)]
pub struct Log {
    page: &'static [AtomicU32],
    tracks: [&'static [AtomicU32]; 2],
    counts: [usize; 2],
}

impl Log {
    /// Appends a sample to track 0 or 1; drops it when the track is full.
    #[inline]
    pub fn push(&mut self, track: usize, ticks: u32) {
        let count = self.counts[track];
        if let Some(place) = self.tracks[track].get(count) {
            place.store(ticks, Ordering::Relaxed);
            self.counts[track] = count + 1;
        }
    }

    /// Tells the reader how many samples there are.
    pub fn close(&self) {
        for (word, count) in self.page.iter().zip(self.counts) {
            word.store(count as u32, Ordering::Relaxed);
        }
    }

    /// The samples of a track, when the part has ended.
    pub fn samples(&self, track: usize) -> impl Iterator<Item = u32> {
        let count = self.page[track].load(Ordering::Relaxed) as usize;
        let samples = self.tracks[track].iter().take(count);
        samples.map(|word| word.load(Ordering::Relaxed))
    }

    /// Notes the number `at`, below [`NOTES`].
    pub fn note(&self, at: usize, value: f64) {
        assert!(at < NOTES);
        let bits = value.to_bits();
        self.page[NOTES_AT + 2 * at].store(bits as u32, Ordering::Relaxed);
        self.page[NOTES_AT + 2 * at + 1].store((bits >> 32) as u32, Ordering::Relaxed);
    }

    /// The number `at`, as it was noted; 0 if it was not.
    #[must_use]
    pub fn noted(&self, at: usize) -> f64 {
        let word = |at: usize| u64::from(self.page[at].load(Ordering::Relaxed));
        f64::from_bits(word(NOTES_AT + 2 * at) | word(NOTES_AT + 2 * at + 1) << 32)
    }

    /// Leaves a text, cut to some 250 bytes: why the part cannot go on.
    pub fn say(&self, text: &str) {
        let bytes = text.as_bytes().chunks(4).take(TEXT_WORDS - 1);
        for (word, bytes) in self.page[TEXT_AT..].iter().zip(bytes) {
            let mut four = [0; 4];
            four[..bytes.len()].copy_from_slice(bytes);
            word.store(u32::from_ne_bytes(four), Ordering::Relaxed);
        }
    }

    /// The text; empty if none was left.
    #[must_use]
    pub fn said(&self) -> String {
        let words = &self.page[TEXT_AT..TEXT_AT + TEXT_WORDS];
        let bytes = words
            .iter()
            .flat_map(|word| word.load(Ordering::Relaxed).to_ne_bytes());
        let bytes: Vec<u8> = bytes.take_while(|byte| *byte != 0).collect();
        String::from_utf8_lossy(&bytes).into_owned()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_log_keeps_samples_numbers_and_a_text() {
        let shared = Shared::new().unwrap();
        let mut log = shared.log(1);
        for ticks in [5, 6, 7] {
            log.push(1, ticks);
        }
        log.note(0, 0.25);
        log.note(4, -1e12);
        log.say("nought");
        log.close();
        let read = shared.log(1);
        assert_eq!(read.samples(1).collect::<Vec<_>>(), [5, 6, 7]);
        assert_eq!(read.samples(0).count(), 0);
        assert_eq!((read.noted(0), read.noted(4)), (0.25, -1e12));
        assert_eq!(read.said(), "nought");
        assert_eq!(shared.log(0).said(), "");
    }

    #[test]
    fn a_full_track_drops_what_comes_after() {
        let shared = Shared::new().unwrap();
        let mut log = shared.log(3);
        (0..TRACK as u32 + 5).for_each(|ticks| log.push(0, ticks));
        log.close();
        assert_eq!(shared.log(3).samples(0).last(), Some(TRACK as u32 - 1));
        assert_eq!(shared.log(3).samples(1).count(), 0);
    }

    #[test]
    fn the_words_of_each_case_are_zero_and_lie_elsewhere() {
        let places = (0..30).map(|_| {
            let shared = Shared::with_case_words(100).unwrap();
            assert_eq!(shared.case().len(), 100);
            assert!(shared.case().iter().all(|w| w.load(Ordering::Relaxed) == 0));
            shared.case().as_ptr().addr() % (4 * PAGE)
        });
        let places: std::collections::HashSet<usize> = places.collect();
        assert!(places.iter().all(|place| place % (4 * PAIR) == 0));
        // One place is drawn 30 times once in 10^45 runs.
        assert!(places.len() > 1, "{places:?}");
    }
}
