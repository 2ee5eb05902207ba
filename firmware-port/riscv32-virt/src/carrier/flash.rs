//! The data flash of a system: RAM that behaves as NOR flash does, for as long as the machine runs.

use core::sync::atomic::{AtomicU8, AtomicU32, Ordering::Relaxed};
use tandem_board::FlashError;

pub(crate) const PAGE_BYTES: u32 = 8;
pub(crate) const SECTOR_BYTES: u32 = 4096;
pub(crate) const SECTORS: u32 = 2;
const BYTES: usize = (SECTOR_BYTES * SECTORS) as usize;

/// How long an erase takes, in ticks of 100 ns: 1 ms, as a flash of this kind does at best.
const ERASE_TICKS: u32 = 10_000;
/// How long a page takes: 40 us.
const PAGE_TICKS: u32 = 400;

/// The cells, and when the operation under way ends (low word of the clock).
///
/// Only core 0 of the system uses it, and the carrier when that core stands still.
pub(crate) struct Registers {
    cells: [AtomicU8; BYTES],
    begun: AtomicU32,
    takes: AtomicU32,
}

impl Registers {
    pub(crate) const fn new() -> Self {
        Self {
            cells: [const { AtomicU8::new(0) }; BYTES],
            begun: AtomicU32::new(0),
            takes: AtomicU32::new(0),
        }
    }

    /// As it comes from the factory.
    pub(crate) fn erase_all(&self) {
        self.cells.iter().for_each(|cell| cell.store(0xFF, Relaxed));
        self.takes.store(0, Relaxed);
    }

    pub(crate) fn is_busy(&self) -> bool {
        let takes = self.takes.load(Relaxed);
        let busy = takes != 0
            && (crate::hart::time() as u32).wrapping_sub(self.begun.load(Relaxed)) < takes;
        if !busy {
            self.takes.store(0, Relaxed);
        }
        busy
    }

    fn begin(&self, takes: u32) {
        self.begun.store(crate::hart::time() as u32, Relaxed);
        self.takes.store(takes, Relaxed);
    }

    fn range(&self, offset: u32, len: usize) -> Result<&[AtomicU8], FlashError> {
        if self.is_busy() {
            return Err(FlashError::Busy);
        }
        let begin = offset as usize;
        let end = begin.checked_add(len).ok_or(FlashError::OutOfRange)?;
        self.cells.get(begin..end).ok_or(FlashError::OutOfRange)
    }

    pub(crate) fn read(&self, offset: u32, into: &mut [u8]) -> Result<(), FlashError> {
        let cells = self.range(offset, into.len())?;
        for (byte, cell) in into.iter_mut().zip(cells) {
            *byte = cell.load(Relaxed);
        }
        Ok(())
    }

    pub(crate) fn erase(&self, sector: u32) -> Result<(), FlashError> {
        let offset = sector
            .checked_mul(SECTOR_BYTES)
            .ok_or(FlashError::OutOfRange)?;
        let cells = self.range(offset, SECTOR_BYTES as usize)?;
        cells.iter().for_each(|cell| cell.store(0xFF, Relaxed));
        self.begin(ERASE_TICKS);
        Ok(())
    }

    pub(crate) fn program(&self, offset: u32, data: &[u8]) -> Result<(), FlashError> {
        let cells = self.range(offset, data.len())?;
        let pages = data.len() as u32 / PAGE_BYTES;
        let whole = pages > 0
            && offset.is_multiple_of(PAGE_BYTES)
            && data.len().is_multiple_of(PAGE_BYTES as usize);
        let within = offset % SECTOR_BYTES + data.len() as u32 <= SECTOR_BYTES;
        if !whole || !within {
            return Err(FlashError::OutOfRange);
        }
        for (cell, byte) in cells.iter().zip(data) {
            // Programming clears bits and sets none.
            cell.store(cell.load(Relaxed) & byte, Relaxed);
        }
        self.begin(pages * PAGE_TICKS);
        Ok(())
    }
}
