//! The result of a call.

/// The result of a call. Below 16: the call succeeded. From 16 on: the call changed nothing.
///
/// 16 ..= 31 are expected: try again, or do something else. 32 ..= 47 are caused by another core.
/// Values from 48 on are errors of the caller.
#[repr(i32)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TandemStatus {
    /// The call succeeded.
    Ok = 0,
    /// The lock is taken, but its last owner died holding it: its data may be half-changed.
    Recovered = 1,
    /// The signal was sent, and the receiver may be asleep: ring its doorbell.
    RingNeeded = 2,

    /// Every slot or block is in use.
    Full = 16,
    /// There is nothing to receive or to read.
    Empty = 17,
    /// Another core, or the call that runs this handler, is using the object.
    Busy = 18,
    /// The lock could not be taken within the permitted number of polls.
    TimedOut = 19,
    /// The LMU is not formatted yet.
    NotReady = 20,
    /// The other end overwrote values: the words that were read are not valid, or values were lost.
    Overrun = 21,
    /// Signals are not handled yet: do not sleep.
    DoNotSleep = 22,

    /// The words are not an LMU of this library.
    WrongMagic = 32,
    /// Another version of this library formatted the LMU.
    WrongVersion = 33,
    /// An image with another layout formatted the LMU.
    WrongLayout = 34,
    /// A later incarnation of this core is announced, or this one was marked dead: it must stop.
    Outdated = 35,
    /// The words were already given back, or reclaimed from a dead owner.
    Stale = 36,
    /// The words belong to another core, or to an earlier incarnation of this one.
    NotOwner = 37,
    /// The handle or the datagram is not valid: forged or overwritten.
    Invalid = 38,
    /// The other core is not alive.
    ReceiverDead = 39,

    /// A pointer is null or not aligned.
    BadPointer = 48,
    /// A number is out of its range.
    OutOfRange = 49,
    /// The object is not attached.
    NotAttached = 50,
    /// The memory is smaller than the layout, or the region is too small for the object.
    TooSmall = 51,
    /// The memory is not aligned to 64 bytes.
    Misaligned = 52,
    /// There is no loan, lock or read for this call to end.
    NothingToEnd = 53,
    /// The task id already has a handler.
    Taken = 54,
}

impl From<tandem_shm::FitError> for TandemStatus {
    fn from(error: tandem_shm::FitError) -> Self {
        match error {
            tandem_shm::FitError::TooSmall => Self::TooSmall,
            tandem_shm::FitError::Misaligned => Self::Misaligned,
        }
    }
}

impl From<()> for TandemStatus {
    /// Converts the result of a call that returns only a status.
    fn from((): ()) -> Self {
        Self::Ok
    }
}

/// Runs `call` and returns its result or its error as a status.
pub(crate) fn status<R: Into<TandemStatus>>(
    call: impl FnOnce() -> Result<R, TandemStatus>,
) -> TandemStatus {
    call().map_or_else(|error| error, R::into)
}
