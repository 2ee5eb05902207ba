//! NOR data flash: one operation at a time; a loss of power interrupts it.

use rand::Rng;
use tandem_board::{FlashError, Instant};
use tandem_peripherals::data_flash::{ERASED, Operation, SIZE, range};

/// The operation in progress.
#[derive(Clone, Debug)]
struct UnderWay {
    operation: Operation,
    /// Content of the range after the operation.
    target: Vec<u8>,
    begun: Instant,
}

/// The medium and the operation in progress.
#[derive(Clone, Debug)]
pub(crate) struct Flash {
    bytes: Vec<u8>,
    under_way: Option<UnderWay>,
    hangs: bool,
}

impl Flash {
    /// Returns a flash as delivered: erased.
    pub(crate) fn new() -> Self {
        Self {
            bytes: vec![ERASED; SIZE],
            under_way: None,
            hangs: false,
        }
    }

    pub(crate) fn hang(&mut self, hangs: bool) {
        self.hangs = hangs;
    }

    pub(crate) fn bytes(&self) -> &[u8] {
        &self.bytes
    }

    pub(crate) fn bytes_mut(&mut self) -> &mut [u8] {
        &mut self.bytes
    }

    pub(crate) fn is_busy(&self) -> bool {
        self.under_way.is_some()
    }

    /// Returns the time at which the operation in progress ends.
    pub(crate) fn ends_ns(&self) -> Option<u64> {
        let UnderWay {
            operation, begun, ..
        } = self.under_way.as_ref().filter(|_| !self.hangs)?;
        Some(operation.ends(*begun).as_ns())
    }

    /// Returns the time at which `count` bytes have changed; `None` if the operation changes fewer.
    pub(crate) fn changed_ns(&self, count: u64) -> Option<u64> {
        let UnderWay {
            operation, begun, ..
        } = self.under_way.as_ref()?;
        operation.changed(*begun, count).map(Instant::as_ns)
    }

    pub(crate) fn read(&self, offset: u32, into: &mut [u8]) -> Result<(), FlashError> {
        if self.is_busy() {
            return Err(FlashError::Busy);
        }
        into.copy_from_slice(&self.bytes[range(offset, into.len())?]);
        Ok(())
    }

    pub(crate) fn start_erase(&mut self, sector: u32, now: Instant) -> Result<(), FlashError> {
        self.begin(Operation::erase(sector), &[], now)
    }

    pub(crate) fn start_program(
        &mut self,
        offset: u32,
        data: &[u8],
        now: Instant,
    ) -> Result<(), FlashError> {
        self.begin(Operation::program(offset, data.len()), data, now)
    }

    fn begin(
        &mut self,
        operation: Result<Operation, FlashError>,
        data: &[u8],
        now: Instant,
    ) -> Result<(), FlashError> {
        if self.is_busy() {
            return Err(FlashError::Busy);
        }
        let operation = operation?;
        let mut target = self.bytes[operation.range()].to_vec();
        operation.apply(&mut target, data);
        self.under_way = Some(UnderWay {
            operation,
            target,
            begun: now,
        });
        Ok(())
    }

    /// Ends the operation in progress if it is due; returns how many bytes it changed.
    pub(crate) fn settle(&mut self, now_ns: u64) -> u64 {
        if self.ends_ns().is_none_or(|ends| now_ns < ends) {
            return 0;
        }
        self.finish()
    }

    /// Ends the operation in progress at once; returns how many bytes it changed.
    fn finish(&mut self) -> u64 {
        let Some(under_way) = self.under_way.take() else {
            return 0;
        };
        self.bytes[under_way.operation.range()].copy_from_slice(&under_way.target);
        under_way.target.len() as u64
    }

    /// Models a loss of power: the bytes already processed are new, the next one is random, the
    /// rest is old. Returns how many bytes were processed.
    pub(crate) fn lose_power(&mut self, now: Instant, noise: &mut impl Rng) -> u64 {
        let Some(under_way) = self.under_way.take() else {
            return 0;
        };
        let done = under_way.operation.done(under_way.begun, now);
        let range = &mut self.bytes[under_way.operation.range()];
        range[..done].copy_from_slice(&under_way.target[..done]);
        if let Some(torn) = range.get_mut(done) {
            *torn = noise.next_u32() as u8;
        }
        done as u64
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use chacha20::ChaCha8Rng;
    use chacha20::rand_core::SeedableRng;

    #[test]
    fn an_operation_takes_its_time_and_then_is_durable() {
        let mut flash = Flash::new();
        flash
            .start_program(8, &[1, 2, 3, 4, 5, 6, 7, 8], Instant::from_ns(100))
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
    fn power_loss_tears_at_every_byte_and_touches_nothing_else() {
        let mut noise = ChaCha8Rng::seed_from_u64(1);
        for cut in 0..8 {
            let mut flash = Flash::new();
            flash.start_program(16, &[0; 8], Instant::ORIGIN).unwrap();
            let at = Instant::from_ns(flash.changed_ns(cut).unwrap());
            assert_eq!(flash.lose_power(at, &mut noise), cut);
            let cut = 16 + cut as usize;
            assert!(flash.bytes()[16..cut].iter().all(|b| *b == 0));
            assert!(flash.bytes()[cut + 1..].iter().all(|b| *b == 0xFF));
            assert!(flash.bytes()[..16].iter().all(|b| *b == 0xFF));
            assert!(!flash.is_busy());
        }
    }
}
