//! Data flash (DFlash): memory that survives power loss, programmed in the background.

/// Why a flash operation was refused.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum FlashError {
    /// An operation is in progress; try again when [`DataFlash::status`] returns `Idle`.
    Busy,
    /// The range is outside the flash or not aligned.
    OutOfRange,
    /// The board cannot read or write its medium.
    Failed,
}

impl core::fmt::Display for FlashError {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str(match self {
            Self::Busy => "an operation is in progress",
            Self::OutOfRange => "the range is outside the flash or not aligned",
            Self::Failed => "the medium cannot be read or written",
        })
    }
}

impl core::error::Error for FlashError {}

/// State of the flash.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum FlashStatus {
    /// Ready; the last operation, if any, is durable.
    Idle,
    /// An operation is in progress.
    Busy,
    /// The last operation failed, and the content of its range is undefined. The next operation may
    /// be started.
    Failed,
}

/// NOR data flash: erasing sets a sector to ones; programming writes aligned pages that were
/// erased. Power loss during an operation leaves any mixture of old and new bytes in its range; no
/// other byte changes.
///
/// Programming takes time and must not stop the control core, so operations are started and then
/// run in the background, one at a time.
pub trait DataFlash {
    /// Bytes of one page, the unit of programming.
    const PAGE_BYTES: u32 = 8;
    /// Bytes of one sector, the unit of erasing.
    const SECTOR_BYTES: u32 = 4096;
    /// Number of sectors; at least 2.
    const SECTORS: u32 = 2;

    /// Copies `into.len()` bytes from `offset`. One at a time; takes a bounded, short time.
    ///
    /// # Errors
    /// [`FlashError::Busy`] while an operation runs, [`FlashError::OutOfRange`],
    /// [`FlashError::Failed`].
    fn read(&self, offset: u32, into: &mut [u8]) -> Result<(), FlashError>;

    /// Starts to erase one sector to 0xFF. One at a time.
    ///
    /// # Errors
    /// [`FlashError::Busy`], [`FlashError::OutOfRange`].
    fn start_erase(&self, sector: u32) -> Result<(), FlashError>;

    /// Starts to program whole pages: at most one sector, not across a sector's end. One at a
    /// time.
    ///
    /// # Errors
    /// [`FlashError::Busy`], [`FlashError::OutOfRange`] (also when not aligned to pages).
    fn start_program(&self, offset: u32, data: &[u8]) -> Result<(), FlashError>;

    /// Returns the present state of the flash. Any context.
    fn status(&self) -> FlashStatus;
}
