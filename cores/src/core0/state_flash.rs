//! The redundancy's state in the data flash of the board. T-RED-1

use tandem_board::DataFlash;
use tandem_redundancy::{FlashOp, Geometry, Loaded, StateStore};

/// Reads the state from the first two sectors. Blocks until they have been read.
pub(super) fn load<F: DataFlash>(flash: &F) -> (StateStore, Loaded) {
    let geometry = Geometry::first_sectors(F::SECTOR_BYTES);
    StateStore::load(geometry, |offset, into| flash.read(offset, into))
}

/// One step: gives the flash's status to the store and starts the operation that the store asks
/// for. Never blocks.
pub(super) fn drive(store: &mut StateStore, flash: &impl DataFlash) {
    let started = match store.poll(flash.status()) {
        None => return,
        Some(FlashOp::Erase { sector }) => flash.start_erase(sector),
        Some(FlashOp::Program { offset, data }) => flash.start_program(offset, &data),
    };
    if started.is_err() {
        store.refused();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::cell::{Cell, RefCell};
    use std::vec;
    use std::vec::Vec;
    use tandem_board::{FlashError, FlashStatus, SystemId};
    use tandem_redundancy::{SystemState, Term};

    const SECTOR: u32 = 128;

    /// A flash on which an operation takes several calls of `status`.
    struct SlowFlash {
        bytes: RefCell<Vec<u8>>,
        running: RefCell<Option<FlashOp>>,
        left: Cell<u32>,
    }

    impl SlowFlash {
        fn start(&self, op: FlashOp) -> Result<(), FlashError> {
            if self.left.get() > 0 {
                return Err(FlashError::Busy);
            }
            *self.running.borrow_mut() = Some(op);
            self.left.set(3);
            Ok(())
        }

        fn finish(&self) {
            let mut bytes = self.bytes.borrow_mut();
            match self.running.take() {
                None => {}
                Some(FlashOp::Erase { sector }) => {
                    let from = (sector * SECTOR) as usize;
                    bytes[from..from + SECTOR as usize].fill(0xFF);
                }
                Some(FlashOp::Program { offset, data }) => {
                    let from = offset as usize;
                    let range = &mut bytes[from..from + data.len()];
                    assert!(range.iter().all(|byte| *byte == 0xFF), "not erased");
                    range.copy_from_slice(&data);
                }
            }
        }
    }

    impl DataFlash for SlowFlash {
        const SECTOR_BYTES: u32 = SECTOR;

        fn read(&self, offset: u32, into: &mut [u8]) -> Result<(), FlashError> {
            let from = offset as usize;
            into.copy_from_slice(&self.bytes.borrow()[from..from + into.len()]);
            Ok(())
        }

        fn start_erase(&self, sector: u32) -> Result<(), FlashError> {
            self.start(FlashOp::Erase { sector })
        }

        fn start_program(&self, offset: u32, data: &[u8]) -> Result<(), FlashError> {
            let data = data.try_into().map_err(|_| FlashError::OutOfRange)?;
            self.start(FlashOp::Program { offset, data })
        }

        fn status(&self) -> FlashStatus {
            match self.left.get() {
                0 => return FlashStatus::Idle,
                1 => self.finish(),
                _ => {}
            }
            self.left.set(self.left.get() - 1);
            FlashStatus::Busy
        }
    }

    /// T-RED-1: the store drives a flash through the board's trait, without waiting, over several
    /// changes of the sector.
    #[test]
    fn drives_a_flash_of_a_board() {
        let flash = SlowFlash {
            bytes: RefCell::new(vec![0xFF; 2 * SECTOR as usize]),
            running: RefCell::new(None),
            left: Cell::new(0),
        };
        let (mut store, loaded) = load(&flash);
        assert_eq!(loaded, Loaded::Blank);
        for n in 0..20 {
            let state = SystemState {
                term: Term::from_bits(n),
                ..SystemState::factory(SystemId::A)
            };
            store.request(state);
            let mut calls = 0;
            while !store.is_settled() {
                drive(&mut store, &flash);
                calls += 1;
                assert!(calls < 20);
            }
            assert_eq!(load(&flash).1, Loaded::State(state));
        }
    }
}
