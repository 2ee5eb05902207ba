//! Memory of C: places objects in it, reads values from it and writes results to it.
//!
//! All unsafe code that follows a pointer from C is here. The numbers in the `SAFETY` comments are
//! those of the caller's contract in the crate's documentation.

#![deny(unsafe_op_in_unsafe_fn)]

use crate::status::{TandemStatus, status};
use core::mem::MaybeUninit;
use core::sync::atomic::AtomicU32;

/// The words of a slot or of an allocation in the LMU, which the caller accesses in place. Read and
/// write each word as a whole.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub struct TandemWords {
    /// The first word.
    pub first: *mut TandemWord,
    /// The number of words.
    pub count: usize,
}

/// A word of the LMU: `volatile uint32_t` in C.
#[repr(transparent)]
#[derive(Debug)]
pub struct TandemWord(AtomicU32);

impl TandemWords {
    pub(crate) fn of(words: &[AtomicU32]) -> Self {
        Self {
            first: words.as_ptr().cast::<TandemWord>().cast_mut(),
            count: words.len(),
        }
    }
}

/// A type of C whose memory holds a Rust value.
///
/// # Safety
/// [`fits`] returns true for both types, and every bit pattern is a value of the implementing type.
pub(crate) unsafe trait Opaque {
    /// The type of the Rust value.
    type Inner;
    /// The mark of an attached object of this type: not 0, and different for each type.
    const MARK: u32;
}

/// The layout of a Rust value in memory of C.
#[repr(C)]
pub(crate) struct Cell<T> {
    /// [`Opaque::MARK`] or [`IN_USE`]; any other value means that the object is not attached.
    mark: u32,
    value: MaybeUninit<T>,
}

/// The mark while a handler of C runs inside a call.
const IN_USE: u32 = 0x7D00_FFFF;

/// Returns whether a [`Cell`] with `T` fits in `O`.
pub(crate) const fn fits<O, T>() -> bool {
    size_of::<Cell<T>>() <= size_of::<O>() && align_of::<Cell<T>>() <= align_of::<O>()
}

/// Assigns a Rust type to a type of C, and checks at compile time that the Rust type fits.
macro_rules! opaque {
    ($outer:ty, $inner:ty, $mark:literal) => {
        const _: () = assert!(
            $crate::cell::fits::<$outer, $inner>(),
            "the opaque type is too small"
        );
        // SAFETY: checked by the line above; the type is an array of integers.
        unsafe impl $crate::cell::Opaque for $outer {
            type Inner = $inner;
            const MARK: u32 = 0x7D00_0000 | $mark;
        }
    };
}
pub(crate) use opaque;

fn checked<T>(pointer: *mut T) -> Result<*mut T, TandemStatus> {
    if pointer.is_null() || !pointer.is_aligned() {
        return Err(TandemStatus::BadPointer);
    }
    Ok(pointer)
}

/// Writes a value to the memory of an object. It does not drop an earlier value, because the memory
/// may hold anything. Returns `Busy` while a handler of C runs inside a call of the same object,
/// because that call has a reference to the earlier value.
///
/// # Safety
/// Rules 1 and 3 of the caller's contract apply.
pub(crate) unsafe fn put<O: Opaque>(object: *mut O, value: O::Inner) -> Result<(), TandemStatus> {
    let cell = checked(object)?.cast::<Cell<O::Inner>>();
    // SAFETY: not null, aligned, and of the type by rule 1; every bit pattern is a valid mark.
    if unsafe { (&raw const (*cell).mark).read() } == IN_USE {
        return Err(TandemStatus::Busy);
    }
    // SAFETY: not null, aligned, and large enough by `Opaque`; by rules 1 and 3 no other code uses
    // it during the call; the mark shows that no reference to the value exists.
    unsafe {
        (&raw mut (*cell).value).write(MaybeUninit::new(value));
        (&raw mut (*cell).mark).write(O::MARK);
    }
    Ok(())
}

/// Returns the cell of an attached object.
///
/// # Safety
/// Rule 1 of the caller's contract applies.
unsafe fn attached<O: Opaque>(object: *mut O) -> Result<*mut Cell<O::Inner>, TandemStatus> {
    let cell = checked(object)?.cast::<Cell<O::Inner>>();
    // SAFETY: not null, aligned, and of the type by rule 1; every bit pattern is a valid mark.
    match unsafe { (&raw const (*cell).mark).read() } {
        mark if mark == O::MARK => Ok(cell),
        IN_USE => Err(TandemStatus::Busy),
        _ => Err(TandemStatus::NotAttached),
    }
}

/// Returns the value in an attached object, for one call that runs no code of C.
///
/// # Safety
/// Rules 1 and 3 of the caller's contract apply. The reference is used only during that call.
pub(crate) unsafe fn get<'c, O: Opaque>(object: *mut O) -> Result<&'c mut O::Inner, TandemStatus> {
    // SAFETY: the caller guarantees rule 1.
    let cell = unsafe { attached(object) }?;
    // SAFETY: the mark shows that `put` wrote the value; by rule 3 no other code uses it now.
    Ok(unsafe { (*cell).value.assume_init_mut() })
}

/// Returns the value in an attached object, for reading only.
///
/// # Safety
/// Rule 1 of the caller's contract applies; the object is not attached again during the call.
pub(crate) unsafe fn share<'c, O: Opaque>(object: *const O) -> Result<&'c O::Inner, TandemStatus> {
    // SAFETY: the caller guarantees rule 1; nothing is written through the pointer.
    let cell = unsafe { attached(object.cast_mut()) }?;
    // SAFETY: the mark shows that `put` wrote the value; all other code only reads it.
    Ok(unsafe { (*cell).value.assume_init_ref() })
}

/// Runs `call`, which runs no code of C, on an attached object. Returns its status.
///
/// # Safety
/// Rules 1 and 3 of the caller's contract apply.
pub(crate) unsafe fn with<O: Opaque, R: Into<TandemStatus>>(
    object: *mut O,
    call: impl FnOnce(&mut O::Inner) -> Result<R, TandemStatus>,
) -> TandemStatus {
    // SAFETY: the caller guarantees the same contract.
    status(|| call(unsafe { get(object) }?))
}

/// Like [`with`], for a call that lends words of the LMU: writes them to `words`.
///
/// # Safety
/// Rules 1 and 3 of the caller's contract apply.
pub(crate) unsafe fn lend<O: Opaque>(
    object: *mut O,
    words: *mut TandemWords,
    call: impl FnOnce(&mut O::Inner) -> Result<&'static [AtomicU32], TandemStatus>,
) -> TandemStatus {
    status(|| {
        checked(words)?;
        // SAFETY: the caller guarantees the same contract.
        unsafe { write(words, TandemWords::of(call(get(object)?)?)) }
    })
}

/// Runs `call` on the value of an attached object. Marks the object as in use, because `call` may
/// run code of C, which may call a function on the same object.
///
/// # Safety
/// Rules 1 and 3 of the caller's contract apply.
pub(crate) unsafe fn occupy<O: Opaque, R>(
    object: *mut O,
    call: impl FnOnce(&mut O::Inner) -> R,
) -> Result<R, TandemStatus> {
    // SAFETY: the caller guarantees rule 1.
    let cell = unsafe { attached(object) }?;
    // SAFETY: as in `get`; while `call` runs, the mark makes other calls return `Busy`, so the
    // reference to the value is the only one. The mark is not part of the value.
    unsafe {
        (&raw mut (*cell).mark).write(IN_USE);
        let result = call((*cell).value.assume_init_mut());
        (&raw mut (*cell).mark).write(O::MARK);
        Ok(result)
    }
}

/// Reads a plain value from memory of C. `T` consists of integers and pointers only.
///
/// # Safety
/// Rule 1 of the caller's contract applies; the memory is initialised.
pub(crate) unsafe fn read<T: Copy>(from: *const T) -> Result<T, TandemStatus> {
    let from = checked(from.cast_mut())?;
    // SAFETY: not null and aligned; initialised by the contract.
    Ok(unsafe { from.read() })
}

/// Writes a result to memory of C, which need not be initialised.
///
/// # Safety
/// Rule 1 of the caller's contract applies.
pub(crate) unsafe fn write<T>(to: *mut T, value: T) -> Result<(), TandemStatus> {
    let to = checked(to)?;
    // SAFETY: not null and aligned, memory of the type by rule 1.
    unsafe { to.write(value) };
    Ok(())
}

/// Writes an optional result; does nothing if `to` is NULL.
///
/// # Safety
/// Rule 1 of the caller's contract applies.
pub(crate) unsafe fn write_if_wanted<T>(to: *mut T, value: T) -> Result<(), TandemStatus> {
    if to.is_null() {
        return Ok(());
    }
    // SAFETY: the caller guarantees the same contract.
    unsafe { write(to, value) }
}

/// Checks that a result can be written to `to`. Call it before a change that must not fail halfway
/// because of a bad pointer.
pub(crate) fn writable<T>(to: *mut T) -> Result<(), TandemStatus> {
    checked(to).map(|_| ())
}

/// Checks that plain words of C are not null, are aligned, and are at most [`MAX_COUNT`].
fn checked_words(first: *mut u32, count: usize) -> Result<*mut u32, TandemStatus> {
    match count {
        0 => Ok(core::ptr::dangling_mut()),
        1..=MAX_COUNT => checked(first),
        _ => Err(TandemStatus::OutOfRange),
    }
}

/// Returns plain words of C. If `count` is 0, returns an empty slice for any pointer.
///
/// # Safety
/// Rule 1 of the caller's contract applies. No other code writes the `count` words during the call.
pub(crate) unsafe fn words<'c>(first: *const u32, count: usize) -> Result<&'c [u32], TandemStatus> {
    let first = checked_words(first.cast_mut(), count)?;
    // SAFETY: not null and aligned; `count` words by the contract.
    Ok(unsafe { core::slice::from_raw_parts(first, count) })
}

/// Returns plain words of C, for writing. If `count` is 0, returns an empty slice for any pointer.
///
/// # Safety
/// Rules 1 and 3 of the caller's contract apply, to `count` initialised words.
pub(crate) unsafe fn words_mut<'c>(
    first: *mut u32,
    count: usize,
) -> Result<&'c mut [u32], TandemStatus> {
    let first = checked_words(first, count)?;
    // SAFETY: not null and aligned; `count` words that no other code uses, by the contract.
    Ok(unsafe { core::slice::from_raw_parts_mut(first, count) })
}

/// More words than any slot or pool has.
const MAX_COUNT: usize = 1 << 16;
