//! What the kernel did when: switches, wake-ups and interrupts, for traces and pictures.

use core::sync::atomic::{AtomicU32, Ordering, fence};

/// What happened.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum EventKind {
    /// The kernel chose a task, which begins or continues. It may be the one that ran before.
    SwitchedIn,
    /// The running task gives way, perhaps to itself.
    SwitchedOut,
    /// A task became ready: it was woken or made, or its wait has ended.
    Ready,
    /// A handler begins. The subject is the interrupt's number; 63 is the host's tick. The target's
    /// tick is not told.
    InterruptEntered,
    /// A handler has ended.
    InterruptLeft,
}

impl EventKind {
    /// As the kernel's C code numbers them, in `FreeRTOSConfig.h`.
    pub(crate) const fn from_number(number: u32) -> Option<Self> {
        Some(match number {
            1 => Self::SwitchedIn,
            2 => Self::SwitchedOut,
            3 => Self::Ready,
            4 => Self::InterruptEntered,
            5 => Self::InterruptLeft,
            _ => return None,
        })
    }

    const fn number(self) -> u32 {
        match self {
            Self::SwitchedIn => 1,
            Self::SwitchedOut => 2,
            Self::Ready => 3,
            Self::InterruptEntered => 4,
            Self::InterruptLeft => 5,
        }
    }
}

/// One event.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Event {
    /// When, in nanoseconds: of CLOCK_MONOTONIC or of virtual time on the host, of `mtime` on the
    /// target.
    pub at_ns: u64,
    /// What.
    pub kind: EventKind,
    /// The task's number (see [`TaskStatistics`](crate::TaskStatistics)), or the interrupt's.
    pub subject: u32,
}

/// Receives the events. Called in tasks and in handlers, also nested in itself: it must not block,
/// allocate or lock.
pub trait TraceSink: Sync {
    /// An event.
    fn record(&self, event: Event);
}

/// One event in words of 32 bits, which every target writes undivided. The first is twice the
/// event's number plus one, or even while the rest is written.
struct Slot {
    sequence: AtomicU32,
    at_ns: [AtomicU32; 2],
    kind: AtomicU32,
    subject: AtomicU32,
}

/// What a slot of this event says when it is whole.
const fn whole(number: u32) -> u32 {
    number << 1 | 1
}

/// The last `N` events. Written by the core and read from anywhere, without locks: a writer that is
/// interrupted by another one has its place already, and a reader sees which places were
/// overwritten under its eyes, as long as it is not 2^31 events behind.
///
/// After: the sequence lock of Boehm, "Can seqlocks get along with programming language memory
/// models?" (2012), one for each place.
pub struct TraceRing<const N: usize> {
    slots: [Slot; N],
    /// The next event's number.
    next: AtomicU32,
}

impl<const N: usize> TraceRing<N> {
    /// An empty ring, for a static.
    ///
    /// # Panics
    /// If `N` is not a power of two; in a constant that is an error of the compiler.
    #[must_use]
    #[allow(
        clippy::new_without_default,
        reason = "for statics, where a default is of no use"
    )]
    pub const fn new() -> Self {
        assert!(
            N.is_power_of_two() && N < 1 << 30,
            "numbers wrap, and places must not jump"
        );
        Self {
            slots: [const {
                Slot {
                    sequence: AtomicU32::new(0),
                    at_ns: [const { AtomicU32::new(0) }; 2],
                    kind: AtomicU32::new(0),
                    subject: AtomicU32::new(0),
                }
            }; N],
            next: AtomicU32::new(0),
        }
    }

    fn slot(&self, number: u32) -> &Slot {
        &self.slots[number as usize % N]
    }

    /// A reader of the events from now on.
    #[must_use]
    pub fn reader(&self) -> TraceReader<'_, N> {
        TraceReader {
            ring: self,
            at: self.next.load(Ordering::Relaxed),
            lost: 0,
        }
    }
}

impl<const N: usize> TraceSink for TraceRing<N> {
    fn record(&self, event: Event) {
        // One addition: a handler that records in between takes the next place.
        let number = self.next.fetch_add(1, Ordering::Relaxed);
        let slot = self.slot(number);
        slot.sequence.store(0, Ordering::Relaxed);
        // Release pairs with the Acquire fence in `next`: who sees the words sees the zero.
        fence(Ordering::Release);
        slot.at_ns[0].store(event.at_ns as u32, Ordering::Relaxed);
        slot.at_ns[1].store((event.at_ns >> 32) as u32, Ordering::Relaxed);
        slot.kind.store(event.kind.number(), Ordering::Relaxed);
        slot.subject.store(event.subject, Ordering::Relaxed);
        // Release pairs with the Acquire in `next`: a reader that sees the number sees the words.
        slot.sequence.store(whole(number), Ordering::Release);
    }
}

/// Reads a ring in order, each event once.
pub struct TraceReader<'a, const N: usize> {
    ring: &'a TraceRing<N>,
    at: u32,
    lost: u64,
}

impl<const N: usize> TraceReader<'_, N> {
    /// Events that were overwritten before they were read.
    #[must_use]
    pub fn lost(&self) -> u64 {
        self.lost
    }
}

impl<const N: usize> Iterator for TraceReader<'_, N> {
    type Item = Event;

    /// The next event, or `None` if there is none yet.
    fn next(&mut self) -> Option<Event> {
        loop {
            let behind = self.ring.next.load(Ordering::Relaxed).wrapping_sub(self.at);
            if behind == 0 {
                return None;
            }
            if let Some(over @ 1..) = behind.checked_sub(N as u32) {
                self.lost += u64::from(over);
                self.at = self.at.wrapping_add(over);
            }
            let slot = self.ring.slot(self.at);
            // Acquire pairs with the last Release in `record`.
            let before = slot.sequence.load(Ordering::Acquire);
            let [low, high] = slot
                .at_ns
                .each_ref()
                .map(|word| word.load(Ordering::Relaxed));
            let kind = slot.kind.load(Ordering::Relaxed);
            let subject = slot.subject.load(Ordering::Relaxed);
            // Pairs with the Release fence in `record`.
            fence(Ordering::Acquire);
            let after = slot.sequence.load(Ordering::Relaxed);
            if before == whole(self.at) && after == before {
                self.at = self.at.wrapping_add(1);
                return Some(Event {
                    at_ns: u64::from(high) << 32 | u64::from(low),
                    kind: EventKind::from_number(kind)?,
                    subject,
                });
            }
            let behind = self.ring.next.load(Ordering::Relaxed).wrapping_sub(self.at);
            if behind <= N as u32 {
                // It is being written.
                return None;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_ring_gives_its_last_events_in_order_and_counts_the_lost() {
        let ring = TraceRing::<4>::new();
        let event = |subject| Event {
            at_ns: u64::from(subject) * 10,
            kind: EventKind::Ready,
            subject,
        };
        let mut reader = ring.reader();
        assert_eq!(reader.next(), None);
        (0..3).for_each(|subject| ring.record(event(subject)));
        assert_eq!(reader.next(), Some(event(0)));
        (3..9).for_each(|subject| ring.record(event(subject)));
        assert_eq!(
            reader.by_ref().collect::<alloc::vec::Vec<_>>(),
            [5, 6, 7, 8].map(event)
        );
        assert_eq!(reader.lost(), 4);
        ring.next.store(u32::MAX, Ordering::Relaxed);
        let mut reader = ring.reader();
        (9..11).for_each(|subject| ring.record(event(subject)));
        assert_eq!(
            reader.by_ref().collect::<alloc::vec::Vec<_>>(),
            [9, 10].map(event)
        );
    }

    #[test]
    fn kinds_have_one_number() {
        for number in 1..=5 {
            assert_eq!(
                EventKind::from_number(number).map(EventKind::number),
                Some(number)
            );
        }
        assert_eq!(EventKind::from_number(6), None);
    }
}
