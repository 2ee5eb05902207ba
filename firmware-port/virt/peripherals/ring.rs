//! A queue of records between two harts: one hart puts records, the other takes them.

use core::sync::atomic::{AtomicU32, Ordering};

/// A queue of up to `SLOTS` records (a power of two) of at most `WORDS` words. Zeroed memory is an
/// empty queue.
pub(crate) struct Ring<const SLOTS: usize, const WORDS: usize> {
    /// Number of records put, written by the putting hart. Wraps around.
    put: AtomicU32,
    /// Number of records taken, written by the taking hart. Wraps around.
    taken: AtomicU32,
    /// Number of records put before the last discard, written by the putting hart. Wraps around.
    discarded: AtomicU32,
    slots: [[AtomicU32; WORDS]; SLOTS],
}

impl<const SLOTS: usize, const WORDS: usize> Ring<SLOTS, WORDS> {
    /// Puts a record of at most `WORDS` words; returns whether there was room.
    pub(crate) fn put(&self, record: &[u32]) -> bool {
        const { assert!(SLOTS.is_power_of_two()) };
        let put = self.put.load(Ordering::Relaxed);
        // Acquire pairs with the Release in `take_if`: the slot has been read.
        if put.wrapping_sub(self.taken.load(Ordering::Acquire)) as usize >= SLOTS {
            return false;
        }
        for (word, value) in self.slots[put as usize % SLOTS].iter().zip(record) {
            word.store(*value, Ordering::Relaxed);
        }
        // Release pairs with the Acquire in `take_if`: the slot has been written.
        self.put.store(put.wrapping_add(1), Ordering::Release);
        true
    }

    /// Discards the records that were put and not yet taken. Only the putting hart calls this.
    pub(crate) fn discard(&self) {
        // Relaxed: the Release in `put` orders later records after this store.
        self.discarded
            .store(self.put.load(Ordering::Relaxed), Ordering::Relaxed);
    }

    /// Returns the number of the next record to take. Discarded records count as taken.
    fn first_wanted(&self) -> u32 {
        let taken = self.taken.load(Ordering::Relaxed);
        let discarded = self.discarded.load(Ordering::Relaxed);
        if discarded.wrapping_sub(taken).cast_signed() > 0 {
            // Release pairs with the Acquire in `put`.
            self.taken.store(discarded, Ordering::Release);
            return discarded;
        }
        taken
    }

    /// Takes the oldest record.
    pub(crate) fn take(&self) -> Option<[u32; WORDS]> {
        self.take_if(|| true)
    }

    /// Takes the oldest record, if there is one and `wanted` returns true.
    pub(crate) fn take_if(&self, wanted: impl FnOnce() -> bool) -> Option<[u32; WORDS]> {
        let taken = self.first_wanted();
        if self.put.load(Ordering::Acquire) == taken || !wanted() {
            return None;
        }
        let slot = &self.slots[taken as usize % SLOTS];
        let record = core::array::from_fn(|index| slot[index].load(Ordering::Relaxed));
        self.taken.store(taken.wrapping_add(1), Ordering::Release);
        Some(record)
    }

    pub(crate) fn is_empty(&self) -> bool {
        self.put.load(Ordering::Acquire) == self.taken.load(Ordering::Relaxed)
    }

    /// Removes all records. The hart at the other end must be stopped.
    pub(crate) fn clear(&self) {
        self.put.store(0, Ordering::Relaxed);
        self.taken.store(0, Ordering::Relaxed);
        self.discarded.store(0, Ordering::Relaxed);
    }
}
