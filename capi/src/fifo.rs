//! The FIFO: every value, in order, or full.

use crate::cell::{self, opaque};
use crate::map::{self, TandemMap, TandemWords};
use crate::status::{TandemStatus, TandemStatus as S, status};
use tandem_shm::Shape;
use tandem_shm::fifo::{self, Consumer, Producer};

/// The sending end of a FIFO. There is one at a time. Static, zero at first.
#[repr(C)]
#[derive(Debug)]
pub struct TandemFifoProducer {
    /// Private.
    pub opaque: [usize; 11],
}

/// The receiving end of a FIFO. There is one at a time. Static, zero at first.
#[repr(C)]
#[derive(Debug)]
pub struct TandemFifoConsumer {
    /// Private.
    pub opaque: [usize; 11],
}

/// An end, and whether a slot is lent through it.
pub(crate) struct End<T> {
    pub(crate) end: T,
    pub(crate) lent: bool,
}

impl<T> End<T> {
    pub(crate) const fn new(end: T) -> Self {
        Self { end, lent: false }
    }

    /// Ends the lending; refuses if nothing is lent.
    pub(crate) fn take_back(&mut self) -> Result<&mut T, S> {
        match core::mem::replace(&mut self.lent, false) {
            true => Ok(&mut self.end),
            false => Err(S::NothingToEnd),
        }
    }
}

opaque!(TandemFifoProducer, End<Producer<'static>>, 0x07);
opaque!(TandemFifoConsumer, End<Consumer<'static>>, 0x08);

/// The shape, if there is one with these numbers.
pub(crate) fn shape(slots: usize, slot_words: usize) -> Result<Shape, S> {
    let slots_ok = slots.is_power_of_two() && (2..=1 << 16).contains(&slots);
    if slots_ok && (1..=1 << 16).contains(&slot_words) && slots * slot_words <= 1 << 24 {
        return Ok(Shape::new(slots, slot_words));
    }
    Err(S::OutOfRange)
}

/// Words of a FIFO of `slots` slots (a power of two, 2 ..= 65536) of `slot_words` words each
/// (1 ..= 65536), 2^24 words in all at most; 0 if there can be no such FIFO. `TANDEM_FIFO_WORDS` is
/// the same as a constant.
#[unsafe(no_mangle)]
pub extern "C" fn tandem_fifo_words(slots: usize, slot_words: usize) -> usize {
    shape(slots, slot_words).map_or(0, fifo::words)
}

/// Attaches to the FIFO in region `region`, behind what earlier incarnations have sent. Both ends
/// must be given the same shape. Task; does not block.
///
/// # Safety
/// 1, 2 and 3 of the caller's contract.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_fifo_producer_attach(
    producer: *mut TandemFifoProducer,
    map: *const TandemMap,
    region: usize,
    slots: usize,
    slot_words: usize,
) -> TandemStatus {
    status(|| {
        let shape = shape(slots, slot_words)?;
        // SAFETY: the caller's contract is passed on.
        unsafe {
            let end = Producer::attach(map::region(map, region)?, shape)?;
            cell::put(producer, End::new(end))
        }
    })
}

/// Lends the next slot, to be filled in place; its words hold an old value. Nothing is sent before
/// `tandem_fifo_send`; until then another loan lends the same slot. Does not block.
///
/// `TANDEM_STATUS_FULL`
///
/// # Safety
/// 1, 2 and 3 of the caller's contract.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_fifo_loan(
    producer: *mut TandemFifoProducer,
    words: *mut TandemWords,
) -> TandemStatus {
    status(|| {
        cell::writable(words)?;
        // SAFETY: the caller's contract is passed on.
        let producer = unsafe { cell::get(producer) }?;
        let mut loan = producer.end.loan().map_err(|_| S::Full)?;
        let lent = TandemWords::of(loan.words().as_slice());
        producer.lent = true;
        // SAFETY: 1 of the caller's contract.
        unsafe { cell::write(words, lent) }?;
        Ok(S::Ok)
    })
}

/// Sends the value in the slot that was lent. Does not block. Ring the receiver's doorbell, or
/// signal it through a mailbox, if it may be asleep.
///
/// `TANDEM_STATUS_NOTHING_TO_END` if none was lent.
///
/// # Safety
/// 1, 2 and 3 of the caller's contract.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_fifo_send(producer: *mut TandemFifoProducer) -> TandemStatus {
    status(|| {
        // SAFETY: the caller's contract is passed on.
        let producer = unsafe { cell::get(producer) }?.take_back()?;
        // The same slot as was lent: only sending goes on to the next.
        producer.loan().map_err(|_| S::Full)?.send();
        Ok(S::Ok)
    })
}

/// Attaches to the FIFO in region `region`, at the oldest value that earlier incarnations have not
/// released. Task; does not block.
///
/// # Safety
/// 1, 2 and 3 of the caller's contract.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_fifo_consumer_attach(
    consumer: *mut TandemFifoConsumer,
    map: *const TandemMap,
    region: usize,
    slots: usize,
    slot_words: usize,
) -> TandemStatus {
    status(|| {
        let shape = shape(slots, slot_words)?;
        // SAFETY: the caller's contract is passed on.
        unsafe {
            let end = Consumer::attach(map::region(map, region)?, shape)?;
            cell::put(consumer, End::new(end))
        }
    })
}

/// The next value, to be worked on in place; it stays the next one until `tandem_fifo_release`.
/// Does not block.
///
/// `TANDEM_STATUS_EMPTY`
///
/// # Safety
/// 1, 2 and 3 of the caller's contract.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_fifo_receive(
    consumer: *mut TandemFifoConsumer,
    words: *mut TandemWords,
) -> TandemStatus {
    status(|| {
        cell::writable(words)?;
        // SAFETY: the caller's contract is passed on.
        let consumer = unsafe { cell::get(consumer) }?;
        let item = consumer.end.receive().ok_or(S::Empty)?;
        let lent = TandemWords::of(item.words().as_slice());
        consumer.lent = true;
        // SAFETY: 1 of the caller's contract.
        unsafe { cell::write(words, lent) }?;
        Ok(S::Ok)
    })
}

/// Frees the slot of the value that was received, for the producer. Does not block.
///
/// `TANDEM_STATUS_NOTHING_TO_END` if none was received.
///
/// # Safety
/// 1, 2 and 3 of the caller's contract.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_fifo_release(consumer: *mut TandemFifoConsumer) -> TandemStatus {
    status(|| {
        // SAFETY: the caller's contract is passed on.
        let consumer = unsafe { cell::get(consumer) }?.take_back()?;
        consumer.receive().ok_or(S::Empty)?.release();
        Ok(S::Ok)
    })
}
