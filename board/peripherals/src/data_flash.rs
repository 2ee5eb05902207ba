//! NOR data flash: the range of an operation, its effect on each byte, and its progress. The board
//! stores the bytes.

use core::ops::Range;
use tandem_board::{FlashError, Instant};

/// Bytes of a page, the unit of programming.
pub const PAGE_BYTES: u32 = 8;
/// Bytes of a sector, the unit of erasing.
pub const SECTOR_BYTES: u32 = 4096;
/// Number of sectors.
pub const SECTORS: u32 = 2;
/// Bytes of the flash.
pub const SIZE: usize = (SECTOR_BYTES * SECTORS) as usize;
/// Content of an erased byte.
pub const ERASED: u8 = 0xFF;

/// Time to program one byte, ns: 80 µs per page.
const PROGRAM_BYTE_NS: u64 = 10_000;
/// Time to erase one byte, ns: about 10 ms per sector.
const ERASE_BYTE_NS: u64 = 2_500;

/// An operation that the flash can do.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Operation {
    programs: bool,
    offset: usize,
    len: usize,
}

impl Operation {
    /// Returns the operation that erases a sector.
    ///
    /// # Errors
    /// [`FlashError::OutOfRange`] if the sector does not exist.
    pub fn erase(sector: u32) -> Result<Self, FlashError> {
        if sector >= SECTORS {
            return Err(FlashError::OutOfRange);
        }
        Ok(Self {
            programs: false,
            offset: (sector * SECTOR_BYTES) as usize,
            len: SECTOR_BYTES as usize,
        })
    }

    /// Returns the operation that programs `len` bytes from `offset`.
    ///
    /// # Errors
    /// [`FlashError::OutOfRange`] if these are not whole pages in one sector.
    pub fn program(offset: u32, len: usize) -> Result<Self, FlashError> {
        let Range { start, end } = range(offset, len)?;
        let (page, sector) = (PAGE_BYTES as usize, SECTOR_BYTES as usize);
        let whole_pages = len > 0 && start.is_multiple_of(page) && len.is_multiple_of(page);
        if !whole_pages || start / sector != (end - 1) / sector {
            return Err(FlashError::OutOfRange);
        }
        Ok(Self {
            programs: true,
            offset: start,
            len,
        })
    }

    /// Returns the range of the bytes that the operation changes.
    #[must_use]
    pub const fn range(&self) -> Range<usize> {
        self.offset..self.offset + self.len
    }

    /// Returns the new value of a byte that holds `old`; only programming uses `data`. Programming
    /// clears bits and never sets one.
    #[must_use]
    pub const fn result(&self, old: u8, data: u8) -> u8 {
        if self.programs { old & data } else { ERASED }
    }

    /// Performs the operation on all bytes of its range at once. An erase needs no data.
    pub fn apply(&self, cells: &mut [u8], data: &[u8]) {
        let data = data.iter().copied().chain(core::iter::repeat(ERASED));
        for (cell, data) in cells.iter_mut().zip(data) {
            *cell = self.result(*cell, data);
        }
    }

    /// Returns the time at which the operation, begun at `begun`, has changed `count` bytes; `None`
    /// if it changes fewer. It changes the bytes one after the other, from the lowest address.
    #[must_use]
    pub fn changed(&self, begun: Instant, count: u64) -> Option<Instant> {
        let ns = begun.as_ns() + self.byte_ns() * count;
        (count <= self.len as u64).then_some(Instant::from_ns(ns))
    }

    /// Returns the time at which the operation ends, if it began at `begun`.
    #[must_use]
    pub fn ends(&self, begun: Instant) -> Instant {
        Instant::from_ns(begun.as_ns() + self.byte_ns() * self.len as u64)
    }

    /// Returns how many bytes the operation has changed at `now`, if it began at `begun`.
    #[must_use]
    pub fn done(&self, begun: Instant, now: Instant) -> usize {
        let done = now.since(begun).as_ns() / self.byte_ns();
        usize::try_from(done).map_or(self.len, |done| done.min(self.len))
    }

    const fn byte_ns(&self) -> u64 {
        if self.programs {
            PROGRAM_BYTE_NS
        } else {
            ERASE_BYTE_NS
        }
    }
}

/// Returns the range of bytes of a read.
///
/// # Errors
/// [`FlashError::OutOfRange`] if some of them are outside the flash.
pub fn range(offset: u32, len: usize) -> Result<Range<usize>, FlashError> {
    let start = offset as usize;
    match start.checked_add(len) {
        Some(end) if end <= SIZE => Ok(start..end),
        _ => Err(FlashError::OutOfRange),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const REFUSED: Result<Operation, FlashError> = Err(FlashError::OutOfRange);

    #[test]
    fn whole_pages_in_one_sector_can_be_programmed_and_nothing_else() {
        let (page, sector) = (PAGE_BYTES as usize, SECTOR_BYTES as usize);
        for offset in 0..SIZE + 2 * page {
            for len in [
                0,
                1,
                page - 1,
                page,
                page + 1,
                2 * page,
                sector,
                sector + page,
            ] {
                let aligned = offset % page == 0 && len % page == 0 && len > 0;
                let one_sector = offset % sector + len <= sector;
                let expected = aligned && one_sector && offset + len <= SIZE;
                let operation = Operation::program(offset as u32, len);
                assert_eq!(operation.is_ok(), expected, "{offset} {len}");
                if let Ok(operation) = operation {
                    assert_eq!(operation.range(), offset..offset + len);
                }
            }
        }
        assert_eq!(Operation::program(u32::MAX - 7, page), REFUSED);
        assert_eq!(Operation::program(0, usize::MAX - 7), REFUSED);
    }

    #[test]
    fn whole_sectors_can_be_erased_and_nothing_else() {
        for sector in 0..SECTORS {
            let operation = Operation::erase(sector).unwrap();
            let begin = (sector * SECTOR_BYTES) as usize;
            assert_eq!(operation.range(), begin..begin + SECTOR_BYTES as usize);
        }
        assert_eq!(Operation::erase(SECTORS), REFUSED);
        assert_eq!(Operation::erase(u32::MAX), REFUSED);
    }

    #[test]
    fn all_bytes_can_be_read_and_nothing_else() {
        assert_eq!(range(0, SIZE), Ok(0..SIZE));
        assert_eq!(range(SIZE as u32, 0), Ok(SIZE..SIZE));
        let refused = Err(FlashError::OutOfRange);
        assert_eq!(range(1, SIZE), refused);
        assert_eq!(range(SIZE as u32 + 1, 0), refused);
        assert_eq!(range(u32::MAX, usize::MAX), refused);
    }

    /// A second programming without an erase leaves only the bits that were set both times.
    #[test]
    fn programming_clears_bits_and_erasing_sets_all() {
        let program = Operation::program(0, 8).unwrap();
        let erase = Operation::erase(0).unwrap();
        for old in 0..=u8::MAX {
            for data in 0..=u8::MAX {
                assert_eq!(program.result(old, data), old & data);
                assert_eq!(erase.result(old, data), ERASED);
            }
        }
        let mut cells = [ERASED, 0b1100, 0b1010];
        program.apply(&mut cells, &[1, 0b1010, 0b1100]);
        assert_eq!(cells, [1, 0b1000, 0b1000]);
        erase.apply(&mut cells, &[]);
        assert_eq!(cells, [ERASED; 3]);
    }

    #[test]
    fn an_operation_changes_byte_after_byte() {
        let begun = Instant::from_ns(7_000);
        for operation in [Operation::program(8, 16), Operation::erase(1)] {
            let operation = operation.unwrap();
            let len = operation.range().len();
            for count in [0, 1, 7, len] {
                let at = operation.changed(begun, count as u64).unwrap();
                assert_eq!(operation.done(begun, at), count);
                let before = Instant::from_ns(at.as_ns().saturating_sub(1));
                assert_eq!(operation.done(begun, before), count.saturating_sub(1));
            }
            assert_eq!(
                operation.changed(begun, len as u64),
                Some(operation.ends(begun))
            );
            assert_eq!(operation.changed(begun, len as u64 + 1), None);
            assert_eq!(operation.done(begun, Instant::NEVER), len);
            assert_eq!(operation.done(begun, Instant::ORIGIN), 0);
        }
    }
}
