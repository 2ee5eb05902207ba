//! The channels: FIFO (every value in order, or full), newest value (the last value, never torn),
//! broadcast (every value in order, or the number of lost values).

use crate::cell::{self, Opaque, TandemWords, opaque};
use crate::map::{self, TandemMap};
use crate::status::{TandemStatus, TandemStatus as S};
use core::sync::atomic::AtomicU32;
use tandem_shm::broadcast::{self, Lost, Receiver};
use tandem_shm::fifo::{self, Consumer, Incoming, Loan, Producer};
use tandem_shm::newest::{self, ReadError, Reader, View, Writer};
use tandem_shm::{FitError, Shape, bare};

/// The sending end of a FIFO. Each FIFO has one. Must be static and initially zero.
#[repr(C)]
#[derive(Debug)]
pub struct TandemFifoProducer {
    /// Private.
    pub opaque: [usize; 11],
}

/// The receiving end of a FIFO. Each FIFO has one. Must be static and initially zero.
#[repr(C)]
#[derive(Debug)]
pub struct TandemFifoConsumer {
    /// Private.
    pub opaque: [usize; 11],
}

/// Writing end of a newest-value channel. Each channel has one. Must be static and initially zero.
#[repr(C)]
#[derive(Debug)]
pub struct TandemNewestWriter {
    /// Private.
    pub opaque: [usize; 11],
}

/// Reading end of a newest-value channel, one of any number. Must be static and initially zero.
#[repr(C)]
#[derive(Debug)]
pub struct TandemNewestReader {
    /// Private.
    pub opaque: [usize; 20],
}

/// The sending end of a broadcast ring. Each ring has one. Must be static and initially zero.
#[repr(C)]
#[derive(Debug)]
pub struct TandemBroadcastSender {
    /// Private.
    pub opaque: [usize; 11],
}

/// A receiving end of a broadcast ring, with its own cursor; there may be any number. Must be
/// static and initially zero.
#[repr(C)]
#[derive(Debug)]
pub struct TandemBroadcastReceiver {
    /// Private.
    pub opaque: [usize; 11],
}

/// An end of a channel, and whether it has lent a slot.
pub(crate) struct End<T> {
    end: T,
    lent: bool,
}

impl<T> From<T> for End<T> {
    fn from(end: T) -> Self {
        Self { end, lent: false }
    }
}

impl<T> End<T> {
    /// Ends a loan. Returns `NothingToEnd` if there is none.
    fn take_back(&mut self) -> Result<&mut T, S> {
        match core::mem::replace(&mut self.lent, false) {
            true => Ok(&mut self.end),
            false => Err(S::NothingToEnd),
        }
    }
}

/// A reader, and the view of the value that is being read.
pub(crate) struct Reading {
    reader: Reader<'static, (), 0>,
    view: Option<View<'static>>,
}

impl From<Reader<'static, (), 0>> for Reading {
    fn from(reader: Reader<'static, (), 0>) -> Self {
        Self { reader, view: None }
    }
}

opaque!(TandemFifoProducer, End<Producer<'static>>, 0x07);
opaque!(TandemFifoConsumer, End<Consumer<'static>>, 0x08);
opaque!(TandemNewestWriter, End<Writer<'static>>, 0x09);
opaque!(TandemNewestReader, Reading, 0x0A);
opaque!(TandemBroadcastSender, End<Writer<'static>>, 0x0B);
opaque!(TandemBroadcastReceiver, End<Receiver<'static>>, 0x0C);

impl From<fifo::Full> for S {
    fn from(_: fifo::Full) -> Self {
        Self::Full
    }
}

impl From<ReadError> for S {
    fn from(error: ReadError) -> Self {
        match error {
            ReadError::Empty => Self::Empty,
            ReadError::Overrun | ReadError::Corrupt => Self::Overrun,
        }
    }
}

/// Returns the shape with these numbers, if they are in range.
fn shape(slots: usize, slot_words: usize) -> Result<Shape, S> {
    let slots_ok = slots.is_power_of_two() && (2..=1 << 16).contains(&slots);
    if slots_ok && (1..=1 << 16).contains(&slot_words) && slots * slot_words <= 1 << 24 {
        return Ok(Shape::new(slots, slot_words));
    }
    Err(S::OutOfRange)
}

/// Attaches an end of a channel of this shape.
///
/// # Safety
/// Rules 1, 2 and 3 of the caller's contract apply.
unsafe fn attach<O: Opaque, E>(
    object: *mut O,
    (map, region, slots, slot_words): (*const TandemMap, usize, usize, usize),
    end: impl FnOnce(&'static [AtomicU32], Shape) -> Result<E, FitError>,
) -> TandemStatus
where
    O::Inner: From<E>,
{
    let made = |words, _| Ok(end(words, shape(slots, slot_words)?)?.into());
    map::attach(object, map, region, made)
}

/// Returns the number of words of a FIFO with `slots` slots (a power of two, 2 ..= 65536) of
/// `slot_words` words each (1 ..= 65536), at most 2^24 words in all; 0 if a number is out of range.
/// `TANDEM_FIFO_WORDS` computes it as a constant.
#[unsafe(no_mangle)]
pub extern "C" fn tandem_fifo_words(slots: usize, slot_words: usize) -> usize {
    shape(slots, slot_words).map_or(0, fifo::words)
}

/// Attaches the sending end of the FIFO in region `region`. It continues after the values that
/// earlier incarnations have sent. Both ends must get the same shape. Tasks only; does not block.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_fifo_producer_attach(
    producer: *mut TandemFifoProducer,
    map: *const TandemMap,
    region: usize,
    slots: usize,
    slot_words: usize,
) -> TandemStatus {
    let place = (map, region, slots, slot_words);
    attach(producer, place, bare::fifo_producer::<()>)
}

/// Lends the next slot, which the caller fills in place; its words hold an old value. Only
/// `tandem_fifo_send` sends it; until then, further calls lend the same slot. Does not block.
///
/// `TANDEM_STATUS_FULL` if no slot is free.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_fifo_loan(
    producer: *mut TandemFifoProducer,
    words: *mut TandemWords,
) -> TandemStatus {
    cell::lend(producer, words, |producer| {
        let slot = producer.end.loan()?.words().as_slice();
        producer.lent = true;
        Ok(slot)
    })
}

/// Sends the value in the slot that was lent. Does not block. If the receiver may be asleep, ring
/// its doorbell or signal it through a mailbox.
///
/// `TANDEM_STATUS_NOTHING_TO_END` if no slot was lent.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_fifo_send(producer: *mut TandemFifoProducer) -> TandemStatus {
    cell::with(producer, |producer| {
        // `loan` returns the slot that was lent: only `send` moves to the next one.
        Ok(producer.take_back()?.loan().map(Loan::send)?)
    })
}

/// Attaches the receiving end of the FIFO in region `region`. It continues with the oldest value
/// that earlier incarnations have not released. Tasks only; does not block.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_fifo_consumer_attach(
    consumer: *mut TandemFifoConsumer,
    map: *const TandemMap,
    region: usize,
    slots: usize,
    slot_words: usize,
) -> TandemStatus {
    let place = (map, region, slots, slot_words);
    attach(consumer, place, bare::fifo_consumer::<()>)
}

/// Lends the next value, which the caller reads in place. Further calls lend the same value until
/// `tandem_fifo_release`. Does not block.
///
/// `TANDEM_STATUS_EMPTY`
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_fifo_receive(
    consumer: *mut TandemFifoConsumer,
    words: *mut TandemWords,
) -> TandemStatus {
    cell::lend(consumer, words, |consumer| {
        let slot = consumer.end.item().ok_or(S::Empty)?.words().as_slice();
        consumer.lent = true;
        Ok(slot)
    })
}

/// Frees the slot of the received value, so that the producer can reuse it. Does not block.
///
/// `TANDEM_STATUS_NOTHING_TO_END` if no value was received.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_fifo_release(consumer: *mut TandemFifoConsumer) -> TandemStatus {
    cell::with(consumer, |consumer| {
        let item = consumer.take_back()?.item();
        item.map(Incoming::release).ok_or(S::Empty)
    })
}

/// Returns the number of words of a channel with `slots` slots (4 if in doubt) of `slot_words`
/// words each; ranges as in `tandem_fifo_words`. `TANDEM_NEWEST_WORDS` computes it as a constant.
#[unsafe(no_mangle)]
pub extern "C" fn tandem_newest_words(slots: usize, slot_words: usize) -> usize {
    shape(slots, slot_words).map_or(0, newest::words)
}

/// Attaches the writing end of the channel in region `region`. It continues after the values of
/// earlier incarnations. All ends must get the same shape. Tasks only; does not block.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_newest_writer_attach(
    writer: *mut TandemNewestWriter,
    map: *const TandemMap,
    region: usize,
    slots: usize,
    slot_words: usize,
) -> TandemStatus {
    let place = (map, region, slots, slot_words);
    attach(writer, place, bare::newest_writer::<()>)
}

/// Lends the slot of the next value, which the caller fills in place; its words hold an old value.
/// Only `tandem_newest_publish` publishes it. Does not block.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_newest_loan(
    writer: *mut TandemNewestWriter,
    words: *mut TandemWords,
) -> TandemStatus {
    cell::lend(writer, words, |writer| {
        writer.lent = true;
        Ok(writer.end.loan().words().as_slice())
    })
}

/// Publishes the value in the slot that was lent. Does not block.
///
/// `TANDEM_STATUS_NOTHING_TO_END` if no slot was lent.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_newest_publish(writer: *mut TandemNewestWriter) -> TandemStatus {
    cell::with(writer, publish)
}

fn publish(writer: &mut End<Writer<'static>>) -> Result<(), S> {
    // `loan` returns the slot that was lent: only `publish` moves to the next one.
    writer.take_back()?.loan().publish();
    Ok(())
}

/// Attaches a reading end of the channel in region `region`. Tasks only; does not block.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_newest_reader_attach(
    reader: *mut TandemNewestReader,
    map: *const TandemMap,
    region: usize,
    slots: usize,
    slot_words: usize,
) -> TandemStatus {
    let place = (map, region, slots, slot_words);
    attach(reader, place, bare::newest_reader::<()>)
}

/// Lends the newest value, which the caller reads in place. The read is valid only if
/// `tandem_newest_finish` returns `TANDEM_STATUS_OK`. Does not block.
///
/// `TANDEM_STATUS_EMPTY` if no value was published, `TANDEM_STATUS_OVERRUN` if the writer has
/// overwritten it: try again.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_newest_view(
    reader: *mut TandemNewestReader,
    words: *mut TandemWords,
) -> TandemStatus {
    cell::lend(reader, words, |reading| {
        let view = reading.reader.view()?;
        Ok(reading.view.insert(view).words().as_slice())
    })
}

/// Checks that all words read through the last view belong to one value. Writes the value's number
/// to `number` (may be NULL): it counts over all incarnations, and wraps. Does not block.
///
/// `TANDEM_STATUS_OVERRUN`: discard the words. `TANDEM_STATUS_NOTHING_TO_END` if there is no view.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_newest_finish(
    reader: *mut TandemNewestReader,
    number: *mut u32,
) -> TandemStatus {
    cell::with(reader, |reading| {
        let stamp = reading.view.take().ok_or(S::NothingToEnd)?.finish()?;
        cell::write_if_wanted(number, stamp.0)
    })
}

/// Copies the newest value to `into` (at most `count` words), and its number to `number` (may be
/// NULL). Tries up to four times; does not block.
///
/// `TANDEM_STATUS_EMPTY` and `TANDEM_STATUS_OVERRUN`: discard the content of `into`.
///
/// # Safety
/// The caller's contract, for `count` initialised words at `into`.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_newest_read(
    reader: *mut TandemNewestReader,
    into: *mut u32,
    count: usize,
    number: *mut u32,
) -> TandemStatus {
    cell::with(reader, |reading| {
        let into = cell::words_mut(into, count)?;
        let (stamp, ()) = reading.reader.read_by(|words| {
            into.iter_mut()
                .zip(words.iter())
                .for_each(|(to, word)| *to = word);
        })?;
        cell::write_if_wanted(number, stamp.0)
    })
}

/// Returns the number of words of a ring with `slots` slots of `slot_words` words each; ranges as
/// in `tandem_fifo_words`. `TANDEM_BROADCAST_WORDS` computes it as a constant.
#[unsafe(no_mangle)]
pub extern "C" fn tandem_broadcast_words(slots: usize, slot_words: usize) -> usize {
    shape(slots, slot_words).map_or(0, broadcast::words)
}

/// Attaches the sending end of the ring in region `region`. It continues after the values of
/// earlier incarnations. All ends must get the same shape. Tasks only; does not block.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_broadcast_sender_attach(
    sender: *mut TandemBroadcastSender,
    map: *const TandemMap,
    region: usize,
    slots: usize,
    slot_words: usize,
) -> TandemStatus {
    let place = (map, region, slots, slot_words);
    attach(sender, place, bare::broadcast_writer::<()>)
}

/// Lends the slot of the next value, which the caller fills in place; its words hold an old value.
/// Only `tandem_broadcast_send` sends it. Does not block.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_broadcast_loan(
    sender: *mut TandemBroadcastSender,
    words: *mut TandemWords,
) -> TandemStatus {
    cell::lend(sender, words, |sender| {
        sender.lent = true;
        Ok(sender.end.loan().words().as_slice())
    })
}

/// Sends the value in the slot that was lent. Does not block.
///
/// `TANDEM_STATUS_NOTHING_TO_END` if no slot was lent.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_broadcast_send(sender: *mut TandemBroadcastSender) -> TandemStatus {
    cell::with(sender, publish)
}

/// Attaches a receiving end of the ring in region `region`, for values sent from now on. If
/// `oldest` is not 0, starts with the oldest value still in the ring. Tasks only; does not block.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_broadcast_receiver_attach(
    receiver: *mut TandemBroadcastReceiver,
    map: *const TandemMap,
    region: usize,
    slots: usize,
    slot_words: usize,
    oldest: u32,
) -> TandemStatus {
    let end = |words, shape| {
        let end = bare::broadcast_receiver::<()>(words, shape)?;
        Ok(if oldest == 0 { end } else { end.from_oldest() })
    };
    attach(receiver, (map, region, slots, slot_words), end)
}

/// Writes the number of lost values and returns the status.
///
/// # Safety
/// Rule 1 of the caller's contract applies.
unsafe fn overrun(lost: *mut u32, error: Lost) -> S {
    // SAFETY: rule 1 of the caller's contract.
    match unsafe { cell::write_if_wanted(lost, error.count) } {
        Ok(()) => S::Overrun,
        Err(error) => error,
    }
}

/// Lends the next value, which the caller reads in place. Only `tandem_broadcast_finish` confirms
/// the read and advances the cursor. Does not block.
///
/// `TANDEM_STATUS_EMPTY`; `TANDEM_STATUS_OVERRUN` if values were overwritten before they were
/// received: writes how many to `lost` (may be NULL). The next call continues after them.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_broadcast_receive(
    receiver: *mut TandemBroadcastReceiver,
    words: *mut TandemWords,
    lost: *mut u32,
) -> TandemStatus {
    cell::lend(receiver, words, |receiver| {
        receiver.lent = false;
        let found = receiver.end.item().map_err(|error| overrun(lost, error))?;
        let slot = found.ok_or(S::Empty)?.words().as_slice();
        receiver.lent = true;
        Ok(slot)
    })
}

/// Ends the read and checks that all words belong to one value. Writes its number to `number` (may
/// be NULL). Does not block.
///
/// `TANDEM_STATUS_OVERRUN` as in `tandem_broadcast_receive`: discard the words.
/// `TANDEM_STATUS_NOTHING_TO_END` if no value was received.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_broadcast_finish(
    receiver: *mut TandemBroadcastReceiver,
    number: *mut u32,
    lost: *mut u32,
) -> TandemStatus {
    cell::with(receiver, |receiver| {
        // `item` returns the same value again, or an error if it was overwritten.
        let finished = match receiver.take_back()?.item() {
            Ok(Some(item)) => item.finish(),
            Ok(None) => return Err(S::NothingToEnd),
            Err(error) => Err(error),
        };
        let stamp = finished.map_err(|error| overrun(lost, error))?;
        cell::write_if_wanted(number, stamp.0)
    })
}
