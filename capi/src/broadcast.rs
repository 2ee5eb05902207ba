//! The broadcast ring: every value, in order, or so many lost.

use crate::cell::{self, opaque};
use crate::fifo::{End, shape};
use crate::map::{self, TandemMap, TandemWords};
use crate::status::{TandemStatus, TandemStatus as S, status};
use tandem_shm::broadcast::{self, Lost, Receiver, Sender};

/// The sending end of a broadcast ring. There is one at a time. Static, zero at first.
#[repr(C)]
#[derive(Debug)]
pub struct TandemBroadcastSender {
    /// Private.
    pub opaque: [usize; 11],
}

/// A receiving end of a broadcast ring, with its own cursor; any number of them. Static, zero at
/// first.
#[repr(C)]
#[derive(Debug)]
pub struct TandemBroadcastReceiver {
    /// Private.
    pub opaque: [usize; 11],
}

opaque!(TandemBroadcastSender, End<Sender<'static>>, 0x0B);
opaque!(TandemBroadcastReceiver, End<Receiver<'static>>, 0x0C);

/// Words of a ring of `slots` slots of `slot_words` words each; ranges as `tandem_fifo_words`.
/// `TANDEM_BROADCAST_WORDS` is the same as a constant.
#[unsafe(no_mangle)]
pub extern "C" fn tandem_broadcast_words(slots: usize, slot_words: usize) -> usize {
    shape(slots, slot_words).map_or(0, broadcast::words)
}

/// Attaches to the ring in region `region`, after the values of earlier incarnations. All ends must
/// be given the same shape. Task; does not block.
///
/// # Safety
/// 1, 2 and 3 of the caller's contract.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_broadcast_sender_attach(
    sender: *mut TandemBroadcastSender,
    map: *const TandemMap,
    region: usize,
    slots: usize,
    slot_words: usize,
) -> TandemStatus {
    status(|| {
        let shape = shape(slots, slot_words)?;
        // SAFETY: the caller's contract is passed on.
        unsafe {
            let end = Sender::attach(map::region(map, region)?, shape)?;
            cell::put(sender, End::new(end))
        }
    })
}

/// Lends the slot of the next value, to be filled in place; its words hold an old value. Nothing is
/// sent before `tandem_broadcast_send`. Waits for nobody.
///
/// # Safety
/// 1, 2 and 3 of the caller's contract.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_broadcast_loan(
    sender: *mut TandemBroadcastSender,
    words: *mut TandemWords,
) -> TandemStatus {
    status(|| {
        cell::writable(words)?;
        // SAFETY: the caller's contract is passed on.
        let sender = unsafe { cell::get(sender) }?;
        let lent = TandemWords::of(sender.end.loan().words().as_slice());
        sender.lent = true;
        // SAFETY: 1 of the caller's contract.
        unsafe { cell::write(words, lent) }?;
        Ok(S::Ok)
    })
}

/// Sends the value in the slot that was lent. Waits for nobody.
///
/// `TANDEM_STATUS_NOTHING_TO_END` if none was lent.
///
/// # Safety
/// 1, 2 and 3 of the caller's contract.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_broadcast_send(sender: *mut TandemBroadcastSender) -> TandemStatus {
    status(|| {
        // SAFETY: the caller's contract is passed on.
        let sender = unsafe { cell::get(sender) }?.take_back()?;
        // The same slot as was lent: only sending goes on to the next.
        sender.loan().send();
        Ok(S::Ok)
    })
}

/// Attaches to the ring in region `region`, to receive what is sent from now on, or with `oldest`
/// not 0 the oldest value that is still there first. Task; does not block.
///
/// # Safety
/// 1, 2 and 3 of the caller's contract.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_broadcast_receiver_attach(
    receiver: *mut TandemBroadcastReceiver,
    map: *const TandemMap,
    region: usize,
    slots: usize,
    slot_words: usize,
    oldest: u32,
) -> TandemStatus {
    status(|| {
        let shape = shape(slots, slot_words)?;
        let attach = match oldest {
            0 => Receiver::attach,
            _ => Receiver::attach_oldest,
        };
        // SAFETY: the caller's contract is passed on.
        unsafe {
            let end = attach(map::region(map, region)?, shape)?;
            cell::put(receiver, End::new(end))
        }
    })
}

/// Writes how many values are lost.
///
/// # Safety
/// 1 of the caller's contract.
unsafe fn overrun(lost: *mut u32, error: Lost) -> S {
    if lost.is_null() {
        return S::Overrun;
    }
    // SAFETY: 1 of the caller's contract.
    match unsafe { cell::write(lost, error.count) } {
        Ok(()) => S::Overrun,
        Err(error) => error,
    }
}

/// The next value, to be read in place; what is read counts, and the cursor goes on, only with
/// `tandem_broadcast_finish`. Does not block.
///
/// `TANDEM_STATUS_EMPTY`; `TANDEM_STATUS_OVERRUN` if values were overwritten before they were
/// received: how many goes to `lost` (null: nobody wants to know), and the next call goes on behind
/// them.
///
/// # Safety
/// 1, 2 and 3 of the caller's contract.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_broadcast_receive(
    receiver: *mut TandemBroadcastReceiver,
    words: *mut TandemWords,
    lost: *mut u32,
) -> TandemStatus {
    status(|| {
        cell::writable(words)?;
        // SAFETY: the caller's contract is passed on.
        let receiver = unsafe { cell::get(receiver) }?;
        receiver.lent = false;
        let found = receiver.end.receive();
        // SAFETY: the caller's contract is passed on.
        let item = found.map_err(|error| unsafe { overrun(lost, error) })?;
        let lent = TandemWords::of(item.ok_or(S::Empty)?.words().as_slice());
        receiver.lent = true;
        // SAFETY: 1 of the caller's contract.
        unsafe { cell::write(words, lent) }?;
        Ok(S::Ok)
    })
}

/// Ends the reading: whether all that was read was one value. Its number goes to `number` (null:
/// nobody wants to know). Does not block.
///
/// `TANDEM_STATUS_OVERRUN` as `tandem_broadcast_receive`: forget what was read.
/// `TANDEM_STATUS_NOTHING_TO_END` if nothing was received.
///
/// # Safety
/// 1, 2 and 3 of the caller's contract.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_broadcast_finish(
    receiver: *mut TandemBroadcastReceiver,
    number: *mut u32,
    lost: *mut u32,
) -> TandemStatus {
    status(|| {
        // SAFETY: the caller's contract is passed on.
        let receiver = unsafe { cell::get(receiver) }?.take_back()?;
        // The same value again, or it was overwritten.
        let finished = match receiver.receive() {
            Ok(Some(item)) => item.finish(),
            Ok(None) => return Err(S::NothingToEnd),
            Err(error) => Err(error),
        };
        // SAFETY: the caller's contract is passed on.
        let k = finished.map_err(|error| unsafe { overrun(lost, error) })?;
        if !number.is_null() {
            // SAFETY: 1 of the caller's contract.
            unsafe { cell::write(number, k) }?;
        }
        Ok(S::Ok)
    })
}
