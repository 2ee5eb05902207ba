//! The pending events: each has one bit at a fixed position.
//!
//! iceoryx2's own state (`RelocatableBitSet`) keeps a relative pointer and a capacity in memory
//! that every notifier maps writable, and trusts them: after one wrong word from a peer, the next
//! `notify` of another process ends with SIGSEGV. In the state defined here, no word is an address
//! or a trusted index: the event's number gives the bit's position, and a constant limits it.

use core::ptr::NonNull;
use core::sync::atomic::AtomicU32;
use core::sync::atomic::Ordering::{Acquire, Relaxed, Release};

use iceoryx2_bb_elementary_traits::allocator::{Allocate, AllocationError};
use iceoryx2_bb_elementary_traits::relocatable_container::RelocatableContainer;
use iceoryx2_bb_elementary_traits::zero_copy_send::ZeroCopySend;
use iceoryx2_cal::event::EventId;
use iceoryx2_cal::event::event_state::{EventActivation, EventState, EventStateActivateError};

/// Room for as many events as iceoryx2 has by default.
const WORDS: usize = 8;
const BITS: usize = WORDS * u32::BITS as usize;

/// The pending events of an iceoryx2 event, at most 256. The initial content is zero.
#[derive(Debug)]
#[repr(C)]
pub struct PendingBits {
    words: [AtomicU32; WORDS],
    /// Number of usable bits. A peer may overwrite this word, so `BITS` also limits the value.
    capacity: AtomicU32,
}

// SAFETY: 32-bit atomics with a C layout: self-contained, and valid for any bit pattern.
unsafe impl ZeroCopySend for PendingBits {}

impl PendingBits {
    fn capacity(&self) -> usize {
        (self.capacity.load(Relaxed) as usize).min(BITS)
    }
}

impl RelocatableContainer for PendingBits {
    unsafe fn new_uninit(capacity: usize) -> Self {
        Self {
            words: [const { AtomicU32::new(0) }; WORDS],
            capacity: AtomicU32::new(capacity.min(BITS) as u32),
        }
    }

    unsafe fn init<T: Allocate<NonNull<u8>>>(&mut self, _: &T) -> Result<(), AllocationError> {
        // Checks nothing: a peer may already write to this memory, and an error would end the
        // process.
        Ok(())
    }

    fn memory_size(_: usize) -> usize {
        0
    }
}

impl EventState for PendingBits {
    fn max_event_count(&self) -> u64 {
        1
    }

    fn max_event_id(&self) -> EventId {
        EventId::new(self.capacity().saturating_sub(1))
    }

    fn activate(&self, event_id: EventId) -> Result<(), EventStateActivateError> {
        let id = event_id.as_value();
        if id >= self.capacity() {
            return Err(EventStateActivateError::EventIdOutOfBounds);
        }
        let bit = 1 << (id % u32::BITS as usize);
        // Release pairs with the Acquire in `drain`: a listener that drains the event sees
        // everything that the notifier wrote before.
        self.words[id / u32::BITS as usize].fetch_or(bit, Release);
        Ok(())
    }

    fn drain<F: FnMut(EventActivation)>(&self, callback: &mut F) -> u64 {
        let mut drained = 0;
        let words = self.capacity().div_ceil(u32::BITS as usize);
        for (at, word) in self.words.iter().enumerate().take(words) {
            if word.load(Relaxed) == 0 {
                continue;
            }
            // Acquire pairs with the Release in `activate`.
            let mut pending = word.swap(0, Acquire);
            while pending != 0 {
                let bit = pending.trailing_zeros();
                pending &= pending - 1;
                drained += 1;
                let id = EventId::new(at * u32::BITS as usize + bit as usize);
                callback(EventActivation { id, count: 1 });
            }
        }
        drained
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use iceoryx2_bb_memory::bump_allocator::BumpAllocator;

    /// Even if a peer overwrites the state, no event with a number of 256 or more is reported.
    #[test]
    fn a_scribbled_state_is_no_address_and_no_index() {
        // SAFETY: initialized below, before any other use.
        let mut bits = unsafe { PendingBits::new_uninit(256) };
        let allocator = BumpAllocator::new(NonNull::dangling(), 0);
        // SAFETY: called once, before any other use.
        unsafe { bits.init(&allocator) }.unwrap();
        for scribble in [0, 1, 255, 256, 257, u32::MAX] {
            bits.capacity.store(scribble, Relaxed);
            bits.words
                .iter()
                .for_each(|word| word.store(u32::MAX, Relaxed));
            let mut ids = vec![];
            let drained = bits.drain(&mut |event| ids.push(event.id.as_value()));
            assert_eq!(drained as usize, ids.len());
            assert!(ids.iter().all(|id| *id < BITS), "{scribble}: {ids:?}");
            assert!(bits.max_event_id().as_value() < BITS);
            assert!(bits.activate(EventId::new(BITS)).is_err());
            assert!(bits.activate(EventId::new(usize::MAX)).is_err());
            assert_eq!(bits.activate(EventId::new(255)).is_ok(), scribble > 255);
        }
    }

    /// Events outside the range are refused even if a peer overwrites the memory before `init`.
    #[test]
    fn events_beyond_the_bits_are_refused_when_they_are_rung() {
        // SAFETY: initialized below, before any other use.
        let mut bits = unsafe { PendingBits::new_uninit(BITS + 1) };
        bits.capacity.store(u32::MAX, Relaxed);
        let allocator = BumpAllocator::new(NonNull::dangling(), 0);
        // SAFETY: called once, before any other use.
        unsafe { bits.init(&allocator) }.unwrap();
        assert!(bits.activate(EventId::new(BITS - 1)).is_ok());
        assert!(bits.activate(EventId::new(BITS)).is_err());
    }
}
