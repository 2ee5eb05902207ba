//! The data flash of a system: RAM that behaves like NOR flash, until the machine ends.

use crate::interrupts::TICK_NS;
use core::sync::atomic::{AtomicU8, AtomicU32, Ordering::Relaxed};
use tandem_board::{FlashError, Instant};
use tandem_peripherals::data_flash::{ERASED, Operation, SIZE, range};

/// The cells, and the start and length of the current operation (low word of the clock, ticks).
///
/// Only core 0 of the system uses it, and the carrier while that core is stopped. An operation
/// changes the cells at its start; until its end the flash is busy.
pub(crate) struct Registers {
    cells: [AtomicU8; SIZE],
    begun: AtomicU32,
    takes: AtomicU32,
}

impl Registers {
    /// Erases all cells, as in a new flash.
    pub(crate) fn erase_all(&self) {
        self.cells
            .iter()
            .for_each(|cell| cell.store(ERASED, Relaxed));
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

    pub(crate) fn read(&self, offset: u32, into: &mut [u8]) -> Result<(), FlashError> {
        if self.is_busy() {
            return Err(FlashError::Busy);
        }
        let cells = &self.cells[range(offset, into.len())?];
        for (byte, cell) in into.iter_mut().zip(cells) {
            *byte = cell.load(Relaxed);
        }
        Ok(())
    }

    /// Starts an operation. For an erase, `data` is empty.
    pub(crate) fn begin(
        &self,
        operation: Result<Operation, FlashError>,
        data: &[u8],
    ) -> Result<(), FlashError> {
        if self.is_busy() {
            return Err(FlashError::Busy);
        }
        let operation = operation?;
        let data = data.iter().copied().chain(core::iter::repeat(ERASED));
        for (cell, data) in self.cells[operation.range()].iter().zip(data) {
            cell.store(operation.result(cell.load(Relaxed), data), Relaxed);
        }
        let takes = operation.ends(Instant::ORIGIN).as_ns() / TICK_NS;
        self.begun.store(crate::hart::time() as u32, Relaxed);
        self.takes.store(takes as u32, Relaxed);
        Ok(())
    }
}
