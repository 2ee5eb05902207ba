//! Reading of numbers from bytes.

use super::{EntityId, Sequence, SequenceSet};

/// Reads numbers from bytes. Each method returns `None` if the bytes end before.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Cursor<'m> {
    bytes: &'m [u8],
    is_little: bool,
}

impl<'m> Cursor<'m> {
    pub(crate) const fn new(bytes: &'m [u8], is_little: bool) -> Self {
        Self { bytes, is_little }
    }

    #[inline(never)]
    pub(crate) fn take(&mut self, len: usize) -> Option<&'m [u8]> {
        let (head, rest) = self.bytes.split_at_checked(len)?;
        self.bytes = rest;
        Some(head)
    }

    pub(crate) fn array<const N: usize>(&mut self) -> Option<[u8; N]> {
        let mut array = [0; N];
        self.read(&mut array).then_some(array)
    }

    #[inline(never)]
    fn read(&mut self, into: &mut [u8]) -> bool {
        let Some(bytes) = self.take(into.len()) else {
            return false;
        };
        for (to, from) in into.iter_mut().zip(bytes) {
            *to = *from;
        }
        true
    }

    pub(crate) fn u8(&mut self) -> Option<u8> {
        self.array::<1>().map(|[byte]| byte)
    }

    #[inline(never)]
    pub(crate) fn u16(&mut self) -> Option<u16> {
        let bytes = self.array()?;
        Some(if self.is_little {
            u16::from_le_bytes(bytes)
        } else {
            u16::from_be_bytes(bytes)
        })
    }

    #[inline(never)]
    pub(crate) fn u32(&mut self) -> Option<u32> {
        let bytes = self.array()?;
        Some(if self.is_little {
            u32::from_le_bytes(bytes)
        } else {
            u32::from_be_bytes(bytes)
        })
    }

    pub(crate) const fn rest(&self) -> &'m [u8] {
        self.bytes
    }

    pub(super) const fn set_little(&mut self, is_little: bool) {
        self.is_little = is_little;
    }

    pub(crate) const fn is_little(&self) -> bool {
        self.is_little
    }

    pub(super) fn entity(&mut self) -> Option<EntityId> {
        self.array().map(EntityId)
    }

    /// A number of a sample, or one less than the first.
    #[inline(never)]
    pub(super) fn sequence(&mut self) -> Option<Sequence> {
        let (high, low) = (self.u32()?, self.u32()?);
        (high == 0 && low < u32::MAX).then_some(low)
    }

    #[inline(never)]
    pub(super) fn set(&mut self) -> Option<SequenceSet> {
        let base = self.sequence().filter(|base| *base > 0)?;
        let len = self.u32().filter(|len| *len <= 256)?;
        let bits = if len == 0 { 0 } else { self.u32()? };
        for _ in 1..len.div_ceil(32) {
            self.u32()?;
        }
        let len = len.min(32) as u8;
        Some(SequenceSet { base, bits, len })
    }
}
