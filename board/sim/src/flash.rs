//! Data flash as NOR flash is: one operation at a time, torn by a loss of power.

use rand::Rng;
use tandem_board::FlashError;

pub(crate) const PAGE_BYTES: u32 = 8;
pub(crate) const SECTOR_BYTES: u32 = 4096;
pub(crate) const SECTORS: u32 = 2;

/// Time to program one byte: 80 µs a page.
const PROGRAM_BYTE_NS: u64 = 10_000;
/// Time to erase one byte: about 10 ms a sector.
const ERASE_BYTE_NS: u64 = 2_500;

/// The operation under way. Bytes change one after the other, from the lowest address.
#[derive(Clone, Debug)]
struct Operation {
    offset: usize,
    /// What the range holds when the operation has ended.
    target: Vec<u8>,
    started_ns: u64,
    byte_ns: u64,
}

impl Operation {
    fn done_bytes(&self, at_ns: u64) -> usize {
        let done = at_ns.saturating_sub(self.started_ns) / self.byte_ns;
        usize::try_from(done)
            .unwrap_or(usize::MAX)
            .min(self.target.len())
    }

    fn ends_ns(&self) -> u64 {
        self.started_ns + self.byte_ns * self.target.len() as u64
    }
}

/// The medium and what is being done to it.
#[derive(Clone, Debug)]
pub(crate) struct Flash {
    bytes: Vec<u8>,
    operation: Option<Operation>,
}

impl Flash {
    /// As it comes from the factory: erased.
    pub(crate) fn new() -> Self {
        Self {
            bytes: vec![0xFF; (SECTOR_BYTES * SECTORS) as usize],
            operation: None,
        }
    }

    pub(crate) fn bytes(&self) -> &[u8] {
        &self.bytes
    }

    pub(crate) fn bytes_mut(&mut self) -> &mut [u8] {
        &mut self.bytes
    }

    pub(crate) fn is_busy(&self) -> bool {
        self.operation.is_some()
    }

    /// When the operation under way ends.
    pub(crate) fn ends_ns(&self) -> Option<u64> {
        self.operation.as_ref().map(Operation::ends_ns)
    }

    /// When the operation under way has changed `count` bytes, if it changes that many.
    pub(crate) fn changed_ns(&self, count: u64) -> Option<u64> {
        let operation = self.operation.as_ref()?;
        let reaches = count <= operation.target.len() as u64;
        reaches.then(|| operation.started_ns + operation.byte_ns * count)
    }

    /// How many bytes the operation under way changes in all.
    pub(crate) fn operation_bytes(&self) -> u64 {
        self.operation
            .as_ref()
            .map_or(0, |operation| operation.target.len() as u64)
    }

    pub(crate) fn read(&self, offset: u32, into: &mut [u8]) -> Result<(), FlashError> {
        if self.is_busy() {
            return Err(FlashError::Busy);
        }
        let range = range(offset, into.len(), self.bytes.len())?;
        into.copy_from_slice(&self.bytes[range]);
        Ok(())
    }

    pub(crate) fn start_erase(&mut self, sector: u32, now_ns: u64) -> Result<(), FlashError> {
        if self.is_busy() {
            return Err(FlashError::Busy);
        }
        if sector >= SECTORS {
            return Err(FlashError::OutOfRange);
        }
        self.operation = Some(Operation {
            offset: (sector * SECTOR_BYTES) as usize,
            target: vec![0xFF; SECTOR_BYTES as usize],
            started_ns: now_ns,
            byte_ns: ERASE_BYTE_NS,
        });
        Ok(())
    }

    /// Programming can only clear bits: the result is the old content AND the data.
    pub(crate) fn start_program(
        &mut self,
        offset: u32,
        data: &[u8],
        now_ns: u64,
    ) -> Result<(), FlashError> {
        if self.is_busy() {
            return Err(FlashError::Busy);
        }
        let range = range(offset, data.len(), self.bytes.len())?;
        let page = PAGE_BYTES as usize;
        let aligned = range.start.is_multiple_of(page) && data.len().is_multiple_of(page);
        let sector = SECTOR_BYTES as usize;
        let one_sector = !data.is_empty() && range.start / sector == (range.end - 1) / sector;
        if !aligned || !one_sector {
            return Err(FlashError::OutOfRange);
        }
        let old = &self.bytes[range.clone()];
        self.operation = Some(Operation {
            offset: range.start,
            target: old.iter().zip(data).map(|(old, new)| old & new).collect(),
            started_ns: now_ns,
            byte_ns: PROGRAM_BYTE_NS,
        });
        Ok(())
    }

    /// Lets a defect change what the operation under way does: the page behind its range, its
    /// result.
    pub(crate) fn spoil(&mut self, change: impl FnOnce(&mut [u8], &mut [u8])) {
        if let Some(operation) = &mut self.operation {
            let end = (operation.offset + operation.target.len()).min(self.bytes.len());
            let page = (end + PAGE_BYTES as usize).min(self.bytes.len());
            change(&mut self.bytes[end..page], &mut operation.target);
        }
    }

    /// Ends the operation under way if its time has come; says how many bytes it changed.
    pub(crate) fn settle(&mut self, now_ns: u64) -> u64 {
        if self.ends_ns().is_none_or(|ends| now_ns < ends) {
            return 0;
        }
        let count = self.operation_bytes();
        self.finish();
        count
    }

    /// A defect: forgets the operation under way.
    pub(crate) fn abandon(&mut self) {
        self.operation = None;
    }

    /// Ends the operation under way at once.
    pub(crate) fn finish(&mut self) {
        if let Some(Operation { offset, target, .. }) = self.operation.take() {
            self.bytes[offset..offset + target.len()].copy_from_slice(&target);
        }
    }

    /// Power is lost: the bytes done so far are new, the next one is noise, the rest is old.
    /// Says how many bytes were done.
    pub(crate) fn lose_power(&mut self, now_ns: u64, noise: &mut impl Rng) -> u64 {
        let Some(operation) = self.operation.take() else {
            return 0;
        };
        let done = operation.done_bytes(now_ns);
        let range = &mut self.bytes[operation.offset..operation.offset + operation.target.len()];
        range[..done].copy_from_slice(&operation.target[..done]);
        if let Some(torn) = range.get_mut(done) {
            *torn = noise.next_u32() as u8;
        }
        done as u64
    }
}

fn range(offset: u32, len: usize, size: usize) -> Result<core::ops::Range<usize>, FlashError> {
    let start = offset as usize;
    match start.checked_add(len) {
        Some(end) if end <= size => Ok(start..end),
        _ => Err(FlashError::OutOfRange),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand_chacha::ChaCha8Rng;
    use rand_chacha::rand_core::SeedableRng;

    #[test]
    fn an_operation_takes_its_time_and_then_is_durable() {
        let mut flash = Flash::new();
        flash
            .start_program(8, &[1, 2, 3, 4, 5, 6, 7, 8], 100)
            .unwrap();
        let ends = flash.ends_ns().unwrap();
        assert_eq!(flash.settle(ends - 1), 0);
        assert_eq!(flash.read(8, &mut [0; 8]), Err(FlashError::Busy));
        assert_eq!(flash.settle(ends), 8);
        assert_eq!(
            &flash.bytes()[6..18],
            &[255, 255, 1, 2, 3, 4, 5, 6, 7, 8, 255, 255]
        );
    }

    #[test]
    fn programming_clears_bits_and_never_sets_them() {
        let mut flash = Flash::new();
        for value in [0b1100, 0b1010] {
            flash.start_program(0, &[value; 8], 0).unwrap();
            flash.finish();
        }
        assert_eq!(flash.bytes()[0], 0b1000);
    }

    #[test]
    fn power_loss_tears_at_every_byte_and_touches_nothing_else() {
        let mut noise = ChaCha8Rng::seed_from_u64(1);
        for cut in 0..8 {
            let mut flash = Flash::new();
            flash.start_program(16, &[0; 8], 0).unwrap();
            let at = flash.changed_ns(cut).unwrap();
            assert_eq!(flash.lose_power(at, &mut noise), cut);
            let cut = 16 + cut as usize;
            assert!(flash.bytes()[16..cut].iter().all(|b| *b == 0));
            assert!(flash.bytes()[cut + 1..].iter().all(|b| *b == 0xFF));
            assert!(flash.bytes()[..16].iter().all(|b| *b == 0xFF));
            assert!(!flash.is_busy());
        }
    }

    #[test]
    fn ranges_are_checked() {
        let mut flash = Flash::new();
        let refused = Err(FlashError::OutOfRange);
        assert_eq!(flash.start_erase(SECTORS, 0), refused);
        assert_eq!(flash.start_program(4, &[0; 8], 0), refused);
        assert_eq!(flash.start_program(0, &[0; 4], 0), refused);
        assert_eq!(flash.start_program(0, &[], 0), refused);
        assert_eq!(flash.start_program(SECTOR_BYTES - 8, &[0; 16], 0), refused);
        assert_eq!(flash.start_program(u32::MAX - 7, &[0; 8], 0), refused);
        assert_eq!(flash.read(SECTOR_BYTES * SECTORS - 1, &mut [0; 2]), refused);
        assert_eq!(flash.read(SECTOR_BYTES * SECTORS, &mut []), Ok(()));
    }
}
