//! The memory that the processes of one batch share: words of the case, and the records of each
//! process.

use crate::clock::monotonic_ns;
use rustix::mm::{MapFlags, ProtFlags, mmap_anonymous, munmap};
use std::io;
use std::ops::Deref;
use std::sync::atomic::{AtomicU8, AtomicU32, AtomicU64, Ordering};
use tandem_shm::incarnation::Incarnation;
use tandem_shm::map::{Layout, Map};

/// Largest number of processes of a batch.
pub const PARTS: usize = 4;
/// Samples that one track of a part keeps; further ones are dropped.
pub const TRACK: usize = 1 << 16;
/// Numbers that a part can record besides its samples.
pub const NOTES: usize = 6;
/// The note that the harness records: CPU time of the part within its timed span, ns.
pub const CPU_NS: usize = NOTES - 1;

/// Words in a cache line.
pub const LINE: usize = 16;
/// Words in two cache lines, which some processors fetch together.
pub const PAIR: usize = 2 * LINE;
/// Words of a page.
const PAGE: usize = 1024;
/// Default number of words of a case.
const CASE_WORDS: usize = 4 * PAGE;
/// The pages of a case with more words than this are mapped when they are first touched.
const POPULATE_UP_TO: usize = 1 << 20;

/// Returns a random number below `count`.
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

/// Announces an incarnation of a core; it must be the core's latest.
pub fn announce(map: &Map<'_>, core: usize, generation: u32) -> Incarnation {
    let incarnation = Incarnation::new(core, generation).expect("an incarnation");
    let announced = map.incarnations().announce(incarnation);
    announced.expect("the latest incarnation");
    incarnation
}

/// A word on its own cache line.
#[repr(C, align(64))]
pub struct CacheLine(AtomicU32);

impl Deref for CacheLine {
    type Target = AtomicU32;

    fn deref(&self) -> &AtomicU32 {
        &self.0
    }
}

/// The records of one part: the counts of its samples, its numbers, a text, and the samples.
#[repr(C, align(64))]
struct Sheet {
    counts: [AtomicU32; 2],
    notes: [AtomicU64; NOTES],
    text: [AtomicU8; 252],
    tracks: [[AtomicU32; TRACK]; 2],
}

/// The header before the words of the case.
#[repr(C, align(4096))]
pub struct Head {
    met: CacheLine,
    /// Free for use by the parts, beside the words of the case.
    pub flag: CacheLine,
    /// Only the part inside a lock may change it.
    pub guarded: CacheLine,
    /// Further words that the parts agree on.
    pub spare: [CacheLine; 3],
    sheets: [Sheet; PARTS],
}

/// Memory that the parts of a batch share, zero at first. Each batch has its own, and its case
/// begins at a random place in the page: a multiple of [`PAIR`].
pub struct SharedPage {
    head: &'static Head,
    words: &'static [AtomicU32],
    case_at: usize,
}

impl SharedPage {
    /// Maps the memory, with room for a case that needs a few lines.
    ///
    /// # Errors
    /// If there is not enough memory.
    pub fn new() -> io::Result<Self> {
        Self::with_case_words(CASE_WORDS)
    }

    /// Maps the memory, with this many words for the case.
    ///
    /// # Errors
    /// If there is not enough memory.
    pub fn with_case_words(case_words: usize) -> io::Result<Self> {
        let case_at = size_of::<Head>() / 4 + draw(PAGE / PAIR) * PAIR;
        let total = case_at + case_words;
        let mut flags = MapFlags::SHARED | MapFlags::NORESERVE;
        flags.set(MapFlags::POPULATE, case_words <= POPULATE_UP_TO);
        let access = ProtFlags::READ | ProtFlags::WRITE;
        // SAFETY: a fresh mapping, not at a fixed address, touches no other memory.
        let base = unsafe { mmap_anonymous(std::ptr::null_mut(), total * 4, access, flags) }?;
        // SAFETY: the mapping has this many zeroed bytes, is aligned to a page, and is unmapped
        // only by `drop`, when its batch no longer uses it.
        let words = unsafe { std::slice::from_raw_parts(base.cast(), total) };
        // SAFETY: the words before `case_at` hold a `Head`, whose atomics may be zero. Only `head`
        // refers to them, except that `touch` reads the first word of each page, where the head has
        // atomics of 32 bits.
        let head = unsafe { &*base.cast() };
        Ok(Self {
            head,
            words,
            case_at,
        })
    }

    /// Maps the memory and formats an LMU of this layout in the words of the case. The returned
    /// map is valid while the returned memory exists.
    ///
    /// # Errors
    /// If there is not enough memory.
    pub fn with_lmu(layout: Layout) -> io::Result<(Self, Map<'static>)> {
        let shared = Self::with_case_words(layout.total_words())?;
        let map = Map::format(shared.case(), layout).map_err(|_| io::Error::other("no room"))?;
        Ok((shared, map))
    }

    /// Returns the words of the case, aligned to two cache lines.
    #[must_use]
    pub fn case(&self) -> &'static [AtomicU32] {
        &self.words[self.case_at..]
    }

    /// Returns one word of the case on its own cache line.
    #[must_use]
    pub fn line(&self, number: usize) -> &'static AtomicU32 {
        &self.case()[number * LINE]
    }

    /// Barrier: waits until this many parts have called it.
    pub fn meet(&self, parts: u32) {
        let met = &self.met;
        // AcqRel pairs with the Acquire below: the preparations of a part are visible to the
        // others.
        let before = met.fetch_add(1, Ordering::AcqRel);
        // Rounded up to a multiple of `parts`, because the parts may meet several times.
        let all = (before / parts + 1) * parts;
        while met.load(Ordering::Acquire) < all {
            std::thread::yield_now();
        }
    }

    /// Maps every page that the harness itself writes, so that no page fault is timed.
    pub fn touch(&self) {
        for page in self.words[..self.case_at].chunks(PAGE) {
            std::hint::black_box(page[0].load(Ordering::Relaxed));
        }
    }

    /// Returns the records of part `number`.
    #[must_use]
    pub fn log(&self, number: usize) -> Log {
        Log {
            sheet: &self.head.sheets[number],
            counts: [0; 2],
        }
    }
}

impl Deref for SharedPage {
    type Target = Head;

    fn deref(&self) -> &Head {
        self.head
    }
}

impl Drop for SharedPage {
    fn drop(&mut self) {
        let base = self.words.as_ptr().cast_mut().cast();
        // SAFETY: `base` and the length are those of the mapping from `new`; the batch is over, and
        // the processes of its parts have ended. `munmap` cannot fail for this mapping.
        let _ = unsafe { munmap(base, size_of_val(self.words)) };
    }
}

/// The records of one part of a batch: two tracks of samples in ticks, and some numbers.
#[derive(Clone)]
pub struct Log {
    sheet: &'static Sheet,
    counts: [usize; 2],
}

impl Log {
    /// Appends a sample to track 0 or 1; drops it when the track is full.
    #[inline]
    pub fn push(&mut self, track: usize, ticks: u32) {
        let count = self.counts[track];
        if let Some(place) = self.sheet.tracks[track].get(count) {
            place.store(ticks, Ordering::Relaxed);
            self.counts[track] = count + 1;
        }
    }

    /// Publishes the number of samples to the reader.
    pub fn close(&self) {
        for (word, count) in self.sheet.counts.iter().zip(self.counts) {
            word.store(count as u32, Ordering::Relaxed);
        }
    }

    /// Returns the samples of a track. Call it after the part has ended.
    pub fn samples(&self, track: usize) -> impl Iterator<Item = u32> {
        let count = self.sheet.counts[track].load(Ordering::Relaxed) as usize;
        let samples = self.sheet.tracks[track].iter().take(count);
        samples.map(|word| word.load(Ordering::Relaxed))
    }

    /// Records a number at index `at`, which must be below [`NOTES`].
    pub fn note(&self, at: usize, value: f64) {
        self.sheet.notes[at].store(value.to_bits(), Ordering::Relaxed);
    }

    /// Returns the number recorded at index `at`; 0 if there is none.
    #[must_use]
    pub fn noted(&self, at: usize) -> f64 {
        f64::from_bits(self.sheet.notes[at].load(Ordering::Relaxed))
    }

    /// Records why the part cannot continue: a text, cut to about 250 bytes.
    pub fn say(&self, text: &str) {
        for (place, byte) in self.sheet.text.iter().zip(text.bytes()) {
            place.store(byte, Ordering::Relaxed);
        }
    }

    /// Returns the text that [`Self::say`] recorded; empty if there is none.
    #[must_use]
    pub fn said(&self) -> String {
        let bytes = self.sheet.text.iter();
        let bytes = bytes.map(|byte| byte.load(Ordering::Relaxed));
        let bytes: Vec<u8> = bytes.take_while(|byte| *byte != 0).collect();
        String::from_utf8_lossy(&bytes).into_owned()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_log_keeps_samples_numbers_and_a_text() {
        let shared = SharedPage::new().unwrap();
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
        let shared = SharedPage::new().unwrap();
        let mut log = shared.log(3);
        (0..TRACK as u32 + 5).for_each(|ticks| log.push(0, ticks));
        log.close();
        assert_eq!(shared.log(3).samples(0).last(), Some(TRACK as u32 - 1));
        assert_eq!(shared.log(3).samples(1).count(), 0);
    }

    #[test]
    fn the_words_of_each_case_are_zero_and_lie_elsewhere() {
        let places = (0..30).map(|_| {
            let shared = SharedPage::with_case_words(100).unwrap();
            assert_eq!(shared.case().len(), 100);
            assert!(shared.case().iter().all(|w| w.load(Ordering::Relaxed) == 0));
            shared.case().as_ptr().addr() % (4 * PAGE)
        });
        let places: std::collections::HashSet<usize> = places.collect();
        assert!(places.iter().all(|place| place % (4 * PAIR) == 0));
        // All 30 draws are equal in one of 10^45 runs.
        assert!(places.len() > 1, "{places:?}");
    }
}
