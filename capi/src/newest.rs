//! The newest-value channel: the last value that was written, never torn.

use crate::cell::{self, opaque};
use crate::fifo::{End, shape};
use crate::map::{self, TandemMap, TandemWords};
use crate::status::{TandemStatus, TandemStatus as S, status};
use tandem_shm::newest::{self, ReadError, Reader, View, Writer};

/// The writing end of a newest-value channel. There is one at a time. Static, zero at first.
#[repr(C)]
#[derive(Debug)]
pub struct TandemNewestWriter {
    /// Private.
    pub opaque: [usize; 11],
}

/// A reading end of a newest-value channel; any number of them. Static, zero at first.
#[repr(C)]
#[derive(Debug)]
pub struct TandemNewestReader {
    /// Private.
    pub opaque: [usize; 18],
}

/// A reader, and the value that is being read.
pub(crate) struct Reading {
    reader: Reader<'static>,
    view: Option<View<'static>>,
}

opaque!(TandemNewestWriter, End<Writer<'static>>, 0x09);
opaque!(TandemNewestReader, Reading, 0x0A);

impl From<ReadError> for S {
    fn from(error: ReadError) -> Self {
        match error {
            ReadError::Empty => Self::Empty,
            ReadError::Overrun => Self::Overrun,
        }
    }
}

/// Words of a channel of `slots` slots (4 are a good number) of `slot_words` words each; ranges as
/// `tandem_fifo_words`. `TANDEM_NEWEST_WORDS` is the same as a constant.
#[unsafe(no_mangle)]
pub extern "C" fn tandem_newest_words(slots: usize, slot_words: usize) -> usize {
    shape(slots, slot_words).map_or(0, newest::words)
}

/// Attaches to the channel in region `region`, after the values of earlier incarnations. All ends
/// must be given the same shape. Task; does not block.
///
/// # Safety
/// 1, 2 and 3 of the caller's contract.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_newest_writer_attach(
    writer: *mut TandemNewestWriter,
    map: *const TandemMap,
    region: usize,
    slots: usize,
    slot_words: usize,
) -> TandemStatus {
    status(|| {
        let shape = shape(slots, slot_words)?;
        // SAFETY: the caller's contract is passed on.
        unsafe {
            let end = Writer::attach(map::region(map, region)?, shape)?;
            cell::put(writer, End::new(end))
        }
    })
}

/// Lends the slot of the next value, to be filled in place; its words hold an old value. Nothing is
/// published before `tandem_newest_publish`. Waits for nobody.
///
/// # Safety
/// 1, 2 and 3 of the caller's contract.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_newest_loan(
    writer: *mut TandemNewestWriter,
    words: *mut TandemWords,
) -> TandemStatus {
    status(|| {
        cell::writable(words)?;
        // SAFETY: the caller's contract is passed on.
        let writer = unsafe { cell::get(writer) }?;
        let lent = TandemWords::of(writer.end.loan().words().as_slice());
        writer.lent = true;
        // SAFETY: 1 of the caller's contract.
        unsafe { cell::write(words, lent) }?;
        Ok(S::Ok)
    })
}

/// Publishes the value in the slot that was lent. Waits for nobody.
///
/// `TANDEM_STATUS_NOTHING_TO_END` if none was lent.
///
/// # Safety
/// 1, 2 and 3 of the caller's contract.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_newest_publish(writer: *mut TandemNewestWriter) -> TandemStatus {
    status(|| {
        // SAFETY: the caller's contract is passed on.
        let writer = unsafe { cell::get(writer) }?.take_back()?;
        // The same slot as was lent: only publishing goes on to the next.
        writer.loan().send();
        Ok(S::Ok)
    })
}

/// Attaches to the channel in region `region`. Task; does not block.
///
/// # Safety
/// 1, 2 and 3 of the caller's contract.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_newest_reader_attach(
    reader: *mut TandemNewestReader,
    map: *const TandemMap,
    region: usize,
    slots: usize,
    slot_words: usize,
) -> TandemStatus {
    status(|| {
        let shape = shape(slots, slot_words)?;
        // SAFETY: the caller's contract is passed on.
        unsafe {
            let reader_end = Reader::attach(map::region(map, region)?, shape)?;
            let reading = Reading {
                reader: reader_end,
                view: None,
            };
            cell::put(reader, reading)
        }
    })
}

/// The newest value, to be read in place; what is read counts only if `tandem_newest_finish` says
/// so. Does not block.
///
/// `TANDEM_STATUS_EMPTY` if nothing was ever published, `TANDEM_STATUS_OVERRUN` if the writer was
/// faster: try again.
///
/// # Safety
/// 1, 2 and 3 of the caller's contract.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_newest_view(
    reader: *mut TandemNewestReader,
    words: *mut TandemWords,
) -> TandemStatus {
    status(|| {
        cell::writable(words)?;
        // SAFETY: the caller's contract is passed on.
        let reading = unsafe { cell::get(reader) }?;
        let view = reading.reader.view()?;
        let lent = TandemWords::of(view.words().as_slice());
        reading.view = Some(view);
        // SAFETY: 1 of the caller's contract.
        unsafe { cell::write(words, lent) }?;
        Ok(S::Ok)
    })
}

/// Whether all that was read through the last view was one value; its number, counted over all
/// incarnations of the writer and wrapping around, goes to `number` (null: nobody wants to know).
/// Does not block.
///
/// `TANDEM_STATUS_OVERRUN`: forget what was read. `TANDEM_STATUS_NOTHING_TO_END` without a view.
///
/// # Safety
/// 1, 2 and 3 of the caller's contract.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_newest_finish(
    reader: *mut TandemNewestReader,
    number: *mut u32,
) -> TandemStatus {
    status(|| {
        // SAFETY: the caller's contract is passed on.
        let view = unsafe { cell::get(reader) }?.view.take();
        let stamp = view.ok_or(S::NothingToEnd)?.finish()?;
        if !number.is_null() {
            // SAFETY: 1 of the caller's contract.
            unsafe { cell::write(number, stamp.0) }?;
        }
        Ok(S::Ok)
    })
}

/// Copies the newest value to `into`, as many words as both have, and its number to `number` (null:
/// nobody wants to know). Tries up to four times; does not block.
///
/// `TANDEM_STATUS_EMPTY`, `TANDEM_STATUS_OVERRUN`: the content of `into` is void.
///
/// # Safety
/// 1, 2 and 3 of the caller's contract, for `count` initialised words.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_newest_read(
    reader: *mut TandemNewestReader,
    into: *mut u32,
    count: usize,
    number: *mut u32,
) -> TandemStatus {
    status(|| {
        // SAFETY: the caller's contract is passed on.
        let (reading, into) = unsafe { (cell::get(reader)?, cell::words_mut(into, count)?) };
        let (stamp, _) = reading.reader.read(|words| words.copy_to(into))?;
        if !number.is_null() {
            // SAFETY: 1 of the caller's contract.
            unsafe { cell::write(number, stamp.0) }?;
        }
        Ok(S::Ok)
    })
}
