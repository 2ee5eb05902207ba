//! Collects data into whole pages and pads the rest of a page. T-BOOT-5

use crate::map::PAGE_BYTES;

/// One page of flash.
pub(crate) type Page = [u8; PAGE_BYTES];

/// CRC-32/ISO-HDLC of bytes, piece by piece: the checksum of all data in the flash. A sixth of the
/// size of the `crc` crate's without a table, with which a test compares it.
pub(crate) struct Crc32(u32);

impl Crc32 {
    pub(crate) const fn new() -> Self {
        Self(u32::MAX)
    }

    #[inline(never)]
    pub(crate) fn update(&mut self, bytes: &[u8]) {
        for byte in bytes {
            self.0 ^= u32::from(*byte);
            for _ in 0..8 {
                self.0 = (self.0 >> 1) ^ (0xEDB8_8320 * (self.0 & 1));
            }
        }
    }

    pub(crate) const fn value(&self) -> u32 {
        !self.0
    }
}

/// Returns the checksum of bytes.
#[inline(never)]
pub(crate) fn checksum(bytes: &[u8]) -> u32 {
    let mut crc = Crc32::new();
    crc.update(bytes);
    crc.value()
}

/// Returns the little-endian word at `at`; 0 beyond the end.
#[inline(never)]
pub(crate) fn word(bytes: &[u8], at: usize) -> u32 {
    let word = bytes.get(at..).and_then(<[u8]>::first_chunk);
    word.map_or(0, |word| u32::from_le_bytes(*word))
}

/// The value of bytes in a page that were not sent. Erased flash may have another one.
pub(crate) const PADDING: u8 = 0xFF;

/// The page that is being filled.
#[derive(Clone, Debug, Default)]
pub(crate) struct PageBuffer(Option<(u32, Page)>);

impl PageBuffer {
    /// Adds data at `offset`. Calls `program` with each completed page, padded.
    pub(crate) fn put<E>(
        &mut self,
        offset: u32,
        data: &[u8],
        mut program: impl FnMut(u32, &Page) -> Result<(), E>,
    ) -> Result<(), E> {
        for (byte, at) in data.iter().zip(offset..) {
            let place = at % PAGE_BYTES as u32;
            let page = at - place;
            if self.0.is_some_and(|(start, _)| start != page) {
                self.flush(&mut program)?;
            }
            let (_, bytes) = self.0.get_or_insert((page, [PADDING; PAGE_BYTES]));
            bytes[place as usize] = *byte;
        }
        Ok(())
    }

    /// Calls `program` with the page in the buffer, if there is one.
    pub(crate) fn flush<E>(
        &mut self,
        mut program: impl FnMut(u32, &Page) -> Result<(), E>,
    ) -> Result<(), E> {
        match self.0.take() {
            Some((start, bytes)) => program(start, &bytes),
            None => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn the_checksum_is_that_of_the_crate(bytes: std::vec::Vec<u8>) {
            let crate_s = crc::Crc::<u32>::new(&crc::CRC_32_ISO_HDLC);
            prop_assert_eq!(checksum(&bytes), crate_s.checksum(&bytes));
        }
    }

    use core::convert::Infallible;
    use std::collections::BTreeMap;
    use std::vec;
    use std::vec::Vec;

    proptest! {
        /// T-BOOT-5: records of any length, with gaps between them, program each page once, the
        /// last page too; bytes that were not sent are padding.
        #[test]
        fn pages_hold_what_was_put(
            runs in prop::collection::vec(
                (0u32..90, prop::collection::vec(any::<u8>(), 1..70)),
                1..9,
            )
        ) {
            let mut buffer = PageBuffer::default();
            let mut pages = BTreeMap::new();
            let mut expected = vec![PADDING; 4096];
            let mut program = |start: u32, page: &Page| {
                assert_eq!(pages.insert(start, *page), None, "page {start} programmed twice");
                Ok::<(), Infallible>(())
            };
            let mut at = 0;
            for (gap, data) in runs {
                at += gap;
                buffer.put(at, &data, &mut program).unwrap();
                expected[at as usize..at as usize + data.len()].copy_from_slice(&data);
                at += data.len() as u32;
            }
            buffer.flush(&mut program).unwrap();
            let mut flash = vec![PADDING; 4096];
            for (start, page) in pages {
                flash[start as usize..start as usize + PAGE_BYTES].copy_from_slice(&page);
            }
            prop_assert_eq!(flash, expected);
        }
    }

    /// T-BOOT-5: the last page of a file is written even if it is not full.
    #[test]
    fn the_tail_is_written() {
        let mut buffer = PageBuffer::default();
        let mut pages = Vec::new();
        let mut program = |start: u32, page: &Page| {
            pages.push((start, *page));
            Ok::<(), Infallible>(())
        };
        buffer.put(64, &[1; 33], &mut program).unwrap();
        buffer.flush(&mut program).unwrap();
        let mut tail = [PADDING; PAGE_BYTES];
        tail[0] = 1;
        assert_eq!(pages, vec![(64, [1; PAGE_BYTES]), (96, tail)]);
    }
}
