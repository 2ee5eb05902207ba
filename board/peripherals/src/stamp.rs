//! Times that hardware records, in words that processors share: of edges and of sent frames.
//!
//! Each word of a [`TimeStamp`] carries a quarter of the time and the number of what happened. So a
//! reader recognises words of different stamps whenever the writer stopped between two of them, and
//! without any order of the accesses.

use core::sync::atomic::{
    AtomicU32,
    Ordering::{Relaxed, SeqCst},
};

use tandem_board::{Instant, TimeEdge};

/// Words of a stamp.
pub const STAMP_WORDS: usize = 4;
/// Words of the stamps of a [`Capture`].
pub const CAPTURE_WORDS: usize = SLOTS * STAMP_WORDS;
/// How many further edges may come while a reader reads a stamp, before it must try again.
const SLOTS: usize = 4;
/// A reader that is so often overtaken by edges finds none: a line has some hundred in a second.
const TRIES: u32 = 100;

/// The time of a numbered event. Of the number, the lower half counts: no two writers may write
/// stamps with the same lower half at one time.
#[derive(Clone, Copy, Debug)]
pub struct TimeStamp<'a>(pub &'a [AtomicU32; STAMP_WORDS]);

impl TimeStamp<'_> {
    /// Writes the time of event `number`.
    pub fn write(self, number: u32, at: Instant) {
        for (index, word) in self.0.iter().enumerate() {
            let quarter = (at.as_ns() >> (16 * index)) as u32 & 0xFFFF;
            word.store(number << 16 | quarter, Relaxed);
        }
    }

    /// Returns the time of event `number`; `None` while its words are not all written.
    #[must_use]
    pub fn read(self, number: u32) -> Option<Instant> {
        let mut ns = 0;
        for word in self.0.iter().rev() {
            let word = word.load(Relaxed);
            if word >> 16 != number & 0xFFFF {
                return None;
            }
            ns = ns << 16 | u64::from(word & 0xFFFF);
        }
        Some(Instant::from_ns(ns))
    }

    /// Removes the stamp that has the same lower half of the number as event `number`, long ago.
    pub fn forget(self, number: u32) {
        self.0[0].store(!number << 16, Relaxed);
    }
}

/// The capture unit of a line: counts the rising edges, and stamps the last few. Zero at the start.
///
/// Several processors may send edges at the same time, and may stop or die at any point: an edge
/// that they have counted and not yet stamped is passed over.
#[derive(Clone, Copy, Debug)]
pub struct Capture<'a> {
    /// The number of edges; wraps around. Only [`Capture::edge`] may change it.
    pub count: &'a AtomicU32,
    /// The stamps of the newest edges.
    pub stamps: &'a [AtomicU32; CAPTURE_WORDS],
}

impl Capture<'_> {
    /// Counts an edge and stamps it. Any context; lock-free.
    pub fn edge(&self, now: impl Fn() -> Instant) {
        let mut before = self.count.load(SeqCst);
        loop {
            // Read between the load and the exchange, which pair with those of other senders: so
            // the times are in the order of the numbers.
            let at = now();
            let number = before.wrapping_add(1);
            let counted = self.count.compare_exchange(before, number, SeqCst, SeqCst);
            match counted {
                Ok(_) => return self.stamp(number).write(number, at),
                Err(count) => before = count,
            }
        }
    }

    /// Returns the newest edge with a stamp, after the first `before` edges, from which its count
    /// begins. Any context; it repeats only if further edges come while it reads. After a sender
    /// that was held up for some edges, or has died, an earlier edge may be found again.
    #[must_use]
    pub fn newest(&self, before: u32) -> Option<TimeEdge> {
        let mut newest = self.count.load(SeqCst);
        for _ in 0..TRIES {
            let count = newest.wrapping_sub(before);
            let passed_over = 0..count.min(SLOTS as u32);
            let found = passed_over.into_iter().find_map(|older| {
                let number = newest.wrapping_sub(older);
                let at = self.stamp(number).read(number)?;
                let count = count - older;
                Some(TimeEdge { count, at })
            });
            // Of the edges before the newest one, some may have been overwritten since.
            let now = self.count.load(SeqCst);
            if now == newest || found.is_some_and(|edge| edge.count == count) {
                return found;
            }
            newest = now;
        }
        None
    }

    fn stamp(&self, number: u32) -> TimeStamp<'_> {
        TimeStamp(&self.stamps.as_chunks().0[number as usize % SLOTS])
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use core::cell::Cell;
    use std::vec::Vec;

    fn words<const N: usize>() -> [AtomicU32; N] {
        [const { AtomicU32::new(0) }; N]
    }

    /// A time whose four quarters all depend on the number.
    fn time(number: u32) -> Instant {
        Instant::from_ns(u64::from(number).wrapping_mul(0x0001_0003_0007_0015))
    }

    /// S-3: a writer that dies after any of its stores leaves no half of a stamp.
    #[test]
    fn a_stamp_that_is_not_whole_is_none() {
        for (old, new) in [(0, 1), (1, 5), (4, 8), (0xFFFF, 0x1_0003), (7, u32::MAX)] {
            let [mixed, whole] = [words(), words()];
            let (mixed, whole) = (TimeStamp(&mixed), TimeStamp(&whole));
            mixed.write(old, time(old));
            whole.write(new, time(new));
            for index in 0..STAMP_WORDS {
                assert_eq!(mixed.read(new), None, "{index} words");
                mixed.0[index].store(whole.0[index].load(Relaxed), Relaxed);
                let is_old = mixed.read(old).is_some();
                assert!(!is_old, "{index} words");
            }
            assert_eq!(mixed.read(new), Some(time(new)));
            mixed.forget(new);
            assert_eq!(mixed.read(new), None);
        }
    }

    /// S-3: the newest edge is found over all numbers, and begins anew at a power-on.
    #[test]
    fn the_newest_edge_is_the_last_one() {
        let stamps = words();
        for begin in [0, 1, 0xFFFE, u32::MAX - 2] {
            let count = AtomicU32::new(begin);
            let stamps = &stamps;
            let capture = Capture {
                count: &count,
                stamps,
            };
            for edges in 0..6 {
                let expected = (edges > 0).then(|| TimeEdge {
                    count: edges,
                    at: time(begin.wrapping_add(edges)),
                });
                assert_eq!(capture.newest(begin), expected);
                assert_eq!(capture.newest(begin.wrapping_add(edges)), None, "power-on");
                capture.edge(|| time(count.load(Relaxed).wrapping_add(1)));
            }
        }
    }

    /// S-3: an edge whose sender dies before its stamp is passed over; the next one is whole.
    #[test]
    fn an_edge_without_a_stamp_is_passed_over() {
        let (count, stamps) = (AtomicU32::new(0), words());
        let capture = Capture {
            count: &count,
            stamps: &stamps,
        };
        let at = |number| TimeEdge {
            count: number,
            at: time(number),
        };
        capture.edge(|| time(1));
        count.store(3, Relaxed);
        assert_eq!(capture.newest(0), Some(at(1)));
        capture.edge(|| time(4));
        assert_eq!(capture.newest(0), Some(at(4)));
        count.store(8, Relaxed);
        assert_eq!(capture.newest(0), None, "four senders have died");
    }

    /// S-3: a sender that another one interrupts has the later number and reads the clock again.
    #[test]
    fn times_are_in_the_order_of_the_numbers() {
        let (count, stamps) = (AtomicU32::new(0), words());
        let capture = Capture {
            count: &count,
            stamps: &stamps,
        };
        let reads = Cell::new(0);
        capture.edge(|| {
            reads.set(reads.get() + 1);
            let first = reads.get() == 1;
            if first {
                capture.edge(|| Instant::from_ns(50));
            }
            Instant::from_ns(if first { 40 } else { 60 })
        });
        let at = Instant::from_ns(60);
        assert_eq!(capture.newest(0), Some(TimeEdge { count: 2, at }));
    }

    /// S-3: senders and a reader at the same time: every pair is one that was sent, and with one
    /// sender both its count and its time only grow.
    #[test]
    fn a_reader_never_sees_a_torn_pair() {
        for senders in [1, 2] {
            let mut seen = seen_of(senders);
            if senders > 1 {
                // One that is held up between its stores spoils a later stamp.
                seen.sort_by_key(|edge| edge.count);
                seen.dedup();
            }
            for pair in seen.windows(2) {
                assert!(pair[0].count < pair[1].count, "{pair:?}");
                assert!(pair[0].at < pair[1].at, "{pair:?}");
            }
            for edge in seen {
                let [low, high] = edge.at.to_words();
                assert_eq!(low, high, "{edge:?}");
            }
        }
    }

    /// Returns the edges that a reader sees while this number of senders send, and the last one.
    fn seen_of(senders: u32) -> Vec<TimeEdge> {
        const EDGES: u32 = if cfg!(miri) { 50 } else { 100_000 };
        let (count, stamps) = (AtomicU32::new(0), words());
        let capture = Capture {
            count: &count,
            stamps: &stamps,
        };
        let clock = AtomicU32::new(0);
        let mut seen = Vec::<TimeEdge>::new();
        std::thread::scope(|scope| {
            for _ in 0..senders {
                let send = || {
                    capture.edge(|| {
                        // Both halves of the time change with each edge.
                        let tick = clock.fetch_add(1, SeqCst);
                        Instant::from_words([tick; 2])
                    });
                };
                scope.spawn(move || (0..EDGES).for_each(|_| send()));
            }
            while count.load(SeqCst) < senders * EDGES {
                let edge = capture.newest(0);
                seen.extend(edge.filter(|edge| seen.last() != Some(edge)));
            }
        });
        let last = capture.newest(0);
        seen.extend(last.filter(|edge| seen.last() != Some(edge)));
        assert!(senders > 1 || last.is_some_and(|edge| edge.count == EDGES));
        seen
    }
}
