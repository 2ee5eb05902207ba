//! The ring into which a core writes its trace. It outlives the core, and no writer ever waits.
//!
//! A bounded queue with many writers and one reader after D. Vyukov, "Bounded MPMC queue": a writer
//! reserves the next slot by compare-and-swap, fills it, and then writes the number of its turn to
//! mark it as filled. A writer is a task or a handler of one core. A writer that is interrupted or
//! killed before the mark stops only the reader, and only at this slot. A full ring refuses new
//! records: the old records stay, and the caller counts the refused ones.
//!
//! An incarnation that has ended never fills the slots that it had reserved. The supply starts the
//! next incarnation only after the previous one has died: [`TraceRing::begin_incarnation`] then
//! marks these slots as void. When no core writes any more, [`Reader::salvage`] skips them.

use core::sync::atomic::AtomicU32;
use core::sync::atomic::Ordering::{Acquire, Relaxed, Release};

use tandem_board::{Instant, TraceRecord};
use tandem_peripherals::codec::{TRACE_WORDS, decode_trace, encode_trace};

/// Words of a cache line.
const LINE: usize = 16;
/// Line 0, written by the core: total number of slots reserved so far; wraps around.
const RESERVED_AT: usize = 0;
/// Line 1, written by the reader: total number of slots read so far; wraps around.
const READ_AT: usize = LINE;
const SLOTS_AT: usize = 2 * LINE;
/// A record, its turn, and the void mark: two slots fill a cache line.
const SLOT_WORDS: usize = 8;
const TURN_AT: usize = TRACE_WORDS;
/// Index of the word that marks a void record; never decoded.
const VOID_AT: usize = TRACE_WORDS + 1;

/// Number of slots: enough for more than a second at core 0's load of about 3200 records a second.
pub(crate) const SLOTS: u32 = 4096;
/// Number of words of a ring.
pub(crate) const WORDS: usize = SLOTS_AT + SLOTS as usize * SLOT_WORDS;

/// The writers' end.
#[derive(Clone, Copy, Debug)]
pub(crate) struct TraceRing {
    words: &'static [AtomicU32],
}

/// The ring is full; the record was not written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Full;

impl TraceRing {
    /// Makes the ring in these words, which must be zero before the first record.
    ///
    /// # Panics
    /// If the number of words is not [`WORDS`].
    pub(crate) fn new(words: &'static [AtomicU32]) -> Self {
        assert_eq!(words.len(), WORDS, "the words of a trace ring");
        Self { words }
    }

    fn slot(self, ticket: u32) -> &'static [AtomicU32] {
        let first = SLOTS_AT + (ticket % SLOTS) as usize * SLOT_WORDS;
        &self.words[first..first + SLOT_WORDS]
    }

    /// Marks as void the slots that earlier incarnations of this core have reserved and not filled.
    /// Call it once in each incarnation, before its first record and after all earlier incarnations
    /// have ended.
    pub(crate) fn begin_incarnation(self) {
        let reserved = self.words[RESERVED_AT].load(Relaxed);
        // Acquire pairs with the Release in `Reader::release`: the slots before `read` were read.
        let read = self.words[READ_AT].load(Acquire);
        if reserved.wrapping_sub(read) > SLOTS {
            // Only a corrupt counter causes this, so start again at the reader's position.
            self.words[RESERVED_AT].store(read, Relaxed);
            return;
        }
        let mut ticket = read;
        while ticket != reserved {
            let slot = self.slot(ticket);
            if slot[TURN_AT].load(Relaxed) != ticket.wrapping_add(1) {
                slot[VOID_AT].store(1, Relaxed);
                // Release pairs with the Acquire in `Reader::next`.
                slot[TURN_AT].store(ticket.wrapping_add(1), Release);
            }
            ticket = ticket.wrapping_add(1);
        }
    }

    /// Writes a record. Any task or handler of the core may call it; never blocks, no system call.
    ///
    /// # Errors
    /// [`Full`]
    pub(crate) fn write(self, at: Instant, record: TraceRecord) -> Result<(), Full> {
        let mut ticket = self.words[RESERVED_AT].load(Relaxed);
        loop {
            // Acquire pairs with the Release in `Reader::next`: the slot was read.
            let read = self.words[READ_AT].load(Acquire);
            if ticket.wrapping_sub(read) >= SLOTS {
                return Err(Full);
            }
            let next = ticket.wrapping_add(1);
            match self.words[RESERVED_AT].compare_exchange_weak(ticket, next, Relaxed, Relaxed) {
                Ok(_) => break,
                Err(now) => ticket = now,
            }
        }
        let slot = self.slot(ticket);
        for (word, value) in slot.iter().zip(encode_trace(at, record)) {
            word.store(value, Relaxed);
        }
        slot[VOID_AT].store(0, Relaxed);
        // Release pairs with the Acquire in `Reader::next`: the turn is set after the record.
        slot[TURN_AT].store(ticket.wrapping_add(1), Release);
        Ok(())
    }
}

/// The reader's end. Only one may exist at a time; the next one continues where it ended.
#[derive(Debug)]
pub(crate) struct Reader {
    ring: TraceRing,
    read: u32,
}

impl Reader {
    pub(crate) fn new(ring: TraceRing) -> Self {
        let read = ring.words[READ_AT].load(Relaxed);
        Self { ring, read }
    }

    /// Returns the next record; `None` if the ring is empty or a writer is filling the next slot.
    pub(crate) fn next(&mut self) -> Option<(Instant, TraceRecord)> {
        loop {
            let slot = self.ring.slot(self.read);
            // Acquire pairs with the Release in `TraceRing::write`.
            if slot[TURN_AT].load(Acquire) != self.read.wrapping_add(1) {
                return None;
            }
            let found = self.take(slot);
            if found.is_some() {
                return found;
            }
        }
    }

    /// Returns the next record and skips slots that were never filled. The core must have ended.
    pub(crate) fn salvage(&mut self) -> Option<(Instant, TraceRecord)> {
        let reserved = self.ring.words[RESERVED_AT].load(Relaxed);
        // At most SLOTS records can be unread, so a larger difference is corrupt.
        let left = reserved.wrapping_sub(self.read).min(SLOTS);
        for _ in 0..left {
            if let Some(found) = self.next() {
                return Some(found);
            }
            if self.read == reserved {
                return None;
            }
            self.release();
        }
        None
    }

    fn take(&mut self, slot: &[AtomicU32]) -> Option<(Instant, TraceRecord)> {
        let mut words = [0; TRACE_WORDS];
        for (value, word) in words.iter_mut().zip(slot) {
            *value = word.load(Relaxed);
        }
        let void = slot[VOID_AT].load(Relaxed) != 0;
        self.release();
        (!void).then(|| decode_trace(words))
    }

    fn release(&mut self) {
        self.read = self.read.wrapping_add(1);
        // Release pairs with the Acquire in `TraceRing::write`: the slot is read before a writer
        // fills it again.
        self.ring.words[READ_AT].store(self.read, Release);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn words() -> &'static [AtomicU32] {
        Box::leak((0..WORDS).map(|_| AtomicU32::new(0)).collect())
    }

    fn ends(words: &'static [AtomicU32]) -> (TraceRing, Reader) {
        let ring = TraceRing::new(words);
        (ring, Reader::new(ring))
    }

    fn at(n: u32) -> Instant {
        Instant::from_ns(n.into())
    }

    fn all(reader: &mut Reader) -> Vec<u32> {
        std::iter::from_fn(|| reader.next())
            .map(|(_, record)| record[0])
            .collect()
    }

    /// Behaves like a writer that is killed after its reservation.
    fn reserve_and_die(words: &[AtomicU32]) {
        words[RESERVED_AT].fetch_add(1, Relaxed);
    }

    #[test]
    fn records_come_in_order_through_many_rounds_and_a_full_ring_refuses() {
        let words = words();
        // Start just before the counters wrap around.
        words[RESERVED_AT].store(0u32.wrapping_sub(100), Relaxed);
        words[READ_AT].store(0u32.wrapping_sub(100), Relaxed);
        let (ring, mut reader) = ends(words);
        for round in 0..3 {
            for n in 0..SLOTS {
                ring.write(at(n), [round * SLOTS + n, 1, 2, 3]).unwrap();
            }
            assert_eq!(ring.write(at(0), [9; 4]), Err(Full));
            let expected: Vec<u32> = (round * SLOTS..(round + 1) * SLOTS).collect();
            assert_eq!(all(&mut reader), expected);
        }
    }

    #[test]
    fn a_writer_that_was_interrupted_holds_back_what_came_after_it_and_loses_nothing() {
        let words = words();
        let (ring, mut reader) = ends(words);
        ring.write(at(0), [1; 4]).unwrap();
        reserve_and_die(words);
        ring.write(at(2), [3; 4]).unwrap();
        assert_eq!(all(&mut reader), [1]);
        assert_eq!(all(&mut reader), []);
        // The writer continues and fills its slot.
        let slot = ring.slot(1);
        for (word, value) in slot.iter().zip(encode_trace(at(1), [2; 4])) {
            word.store(value, Relaxed);
        }
        slot[TURN_AT].store(2, Release);
        assert_eq!(all(&mut reader), [2, 3]);
    }

    #[test]
    fn what_a_killed_writer_never_filled_is_void_for_the_next_incarnation() {
        let words = words();
        let (ring, mut reader) = ends(words);
        // In the second round, each slot still holds an old record.
        for n in 0..SLOTS {
            ring.write(at(n), [n; 4]).unwrap();
        }
        assert_eq!(all(&mut reader).len(), SLOTS as usize);
        ring.write(at(0), [100; 4]).unwrap();
        reserve_and_die(words);
        TraceRing::new(words).begin_incarnation();
        ring.write(at(1), [101; 4]).unwrap();
        assert_eq!(all(&mut reader), [100, 101]);
        // The void slot can be used in the next round.
        for n in 0..SLOTS {
            ring.write(at(n), [n; 4]).unwrap();
        }
        assert_eq!(all(&mut reader).len(), SLOTS as usize);
    }

    #[test]
    fn the_last_records_of_a_core_are_salvaged_around_its_hole() {
        let words = words();
        let (ring, mut reader) = ends(words);
        ring.write(at(0), [1; 4]).unwrap();
        reserve_and_die(words);
        ring.write(at(2), [3; 4]).unwrap();
        reserve_and_die(words);
        let saved: Vec<u32> = std::iter::from_fn(|| reader.salvage())
            .map(|(_, record)| record[0])
            .collect();
        assert_eq!(saved, [1, 3]);
    }

    #[test]
    fn scribbled_counters_are_no_records_and_the_next_incarnation_heals_the_ring() {
        for (reserved, read) in [(7, 1 << 31), (1 << 31, 0), (0, 5)] {
            let words = words();
            words[RESERVED_AT].store(reserved, Relaxed);
            words[READ_AT].store(read, Relaxed);
            let (ring, mut reader) = ends(words);
            assert!(all(&mut reader).is_empty());
            ring.begin_incarnation();
            ring.write(at(0), [1; 4]).unwrap();
            assert_eq!(all(&mut reader), [1], "{reserved} {read}");
        }
    }

    /// `cargo test --release -p tandem-board-host --lib -- --ignored --nocapture trace_ring`
    #[test]
    #[ignore = "a measurement"]
    fn what_a_record_costs() {
        const EACH: u32 = 1_000;
        let words = words();
        let (ring, mut reader) = ends(words);
        let mut measure = |what: &str, work: &mut dyn FnMut(u32)| {
            let mut spans: Vec<f64> = (0..2_000)
                .map(|_| {
                    let begin = std::time::Instant::now();
                    (0..EACH).for_each(&mut *work);
                    let span_ns = begin.elapsed().as_nanos() as f64 / f64::from(EACH);
                    while reader.next().is_some() {}
                    span_ns
                })
                .collect();
            spans.sort_by(f64::total_cmp);
            let (p50, p99) = (spans[spans.len() / 2], spans[spans.len() * 99 / 100]);
            println!("{what:24} p50 {p50:6.1} ns, p99 {p99:6.1} ns");
        };
        measure("the clock", &mut |_| {
            std::hint::black_box(crate::clock::now());
        });
        measure("a record", &mut |n| {
            assert_eq!(ring.write(at(n), [n; 4]), Ok(()));
        });
        measure("a record with its time", &mut |n| {
            assert_eq!(ring.write(crate::clock::now(), [n; 4]), Ok(()));
        });
    }

    #[test]
    fn records_of_several_writers_are_whole_and_each_writers_in_order() {
        const EACH: u32 = 50_000;
        let words = words();
        let (ring, mut reader) = ends(words);
        std::thread::scope(|scope| {
            for writer in 0..3 {
                scope.spawn(move || {
                    for n in 0..EACH {
                        while ring.write(at(n), [writer, n, !n, n ^ 7]).is_err() {
                            std::thread::yield_now();
                        }
                    }
                });
            }
            let mut next = [0; 3];
            while next != [EACH; 3] {
                let Some((time, [writer, n, inverse, mixed])) = reader.next() else {
                    std::thread::yield_now();
                    continue;
                };
                assert_eq!((n, inverse, mixed), (next[writer as usize], !n, n ^ 7));
                assert_eq!(time, at(n));
                next[writer as usize] += 1;
            }
        });
    }
}
