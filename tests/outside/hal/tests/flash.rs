//! The state of the redundancy in a NOR flash of a HAL, which has rules and can fail.

use embedded_storage::nor_flash::{
    ErrorType, NorFlash, NorFlashError, NorFlashErrorKind, ReadNorFlash, check_erase, check_read,
    check_write,
};
use tandem_board::{DataFlash, FlashError, FlashStatus, NorDataFlash, SystemId};
use tandem_redundancy::{FlashOp, Geometry, Loaded, StateStore, SystemState, Term};

const SECTOR: usize = 1024;
const PAGE: usize = 16;
/// Where the data flash begins in the driver.
const BEGIN: usize = 2 * SECTOR;

/// Programs erased pages, erases sectors to ones.
struct Driver {
    cells: Vec<u8>,
    /// How many operations are still done; then each fails in its middle.
    lasts: u32,
}

#[derive(Debug)]
struct Refused(NorFlashErrorKind);

impl NorFlashError for Refused {
    fn kind(&self) -> NorFlashErrorKind {
        self.0
    }
}

impl ErrorType for Driver {
    type Error = Refused;
}

impl ReadNorFlash for Driver {
    const READ_SIZE: usize = 4;

    fn read(&mut self, offset: u32, bytes: &mut [u8]) -> Result<(), Refused> {
        check_read(self, offset, bytes.len()).map_err(Refused)?;
        bytes.copy_from_slice(&self.cells[offset as usize..][..bytes.len()]);
        Ok(())
    }

    fn capacity(&self) -> usize {
        self.cells.len()
    }
}

impl Driver {
    fn new() -> Self {
        Self {
            cells: vec![0xFF; 4 * SECTOR],
            lasts: u32::MAX,
        }
    }

    fn change(
        &mut self,
        offset: u32,
        bytes: impl ExactSizeIterator<Item = u8>,
    ) -> Result<(), Refused> {
        let works = self.lasts > 0;
        let len = if works { bytes.len() } else { bytes.len() / 2 };
        self.lasts = self.lasts.saturating_sub(1);
        let cells = self.cells[offset as usize..]
            .iter_mut()
            .zip(bytes.take(len));
        cells.for_each(|(cell, byte)| *cell = byte);
        if works {
            Ok(())
        } else {
            Err(Refused(NorFlashErrorKind::Other))
        }
    }
}

impl NorFlash for Driver {
    const WRITE_SIZE: usize = PAGE;
    const ERASE_SIZE: usize = SECTOR;

    fn erase(&mut self, from: u32, to: u32) -> Result<(), Refused> {
        check_erase(self, from, to).map_err(Refused)?;
        self.change(from, vec![0xFF; (to - from) as usize].into_iter())
    }

    fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), Refused> {
        check_write(self, offset, bytes.len()).map_err(Refused)?;
        let cells = &self.cells[offset as usize..][..bytes.len()];
        assert!(
            cells.iter().all(|cell| *cell == 0xFF),
            "a page is programmed twice"
        );
        self.change(offset, bytes.to_vec().into_iter())
    }
}

type Flash = NorDataFlash<Driver, 2>;

fn geometry() -> Geometry {
    Geometry::first_sectors(Flash::SECTOR_BYTES)
}

fn load(flash: &Flash) -> (StateStore, Loaded) {
    StateStore::load(geometry(), |offset, into| flash.read(offset, into))
}

/// Does what the store asks for, until it is settled.
fn settle(store: &mut StateStore, flash: &Flash) {
    for _ in 0..100 {
        match store.poll(flash.status()) {
            Some(FlashOp::Erase { sector }) => flash.start_erase(sector).unwrap(),
            Some(FlashOp::Program { offset, data }) => flash.start_program(offset, &data).unwrap(),
            None if store.is_settled() => return,
            None => {}
        }
    }
    panic!("the store is never settled");
}

fn state(count: u32) -> SystemState {
    let term = Term::from_bits(2 * count);
    SystemState {
        term,
        ..SystemState::factory(SystemId::A)
    }
}

/// Hundreds of states, over many erases: each is read back from the driver by the next start.
#[test]
fn states_survive_in_a_driver() {
    let flash = Flash::new(Driver::new(), BEGIN as u32).unwrap();
    let (mut store, loaded) = load(&flash);
    assert_eq!(loaded, Loaded::Blank);
    for count in 1..=300 {
        store.request(state(count));
        settle(&mut store, &flash);
        assert_eq!(load(&flash).1, Loaded::State(state(count)));
    }
    let before = &flash.into_inner().cells[..BEGIN];
    assert!(
        before.iter().all(|cell| *cell == 0xFF),
        "other sectors have changed"
    );
}

/// A driver that fails in the middle of an operation is told, and the last state is not lost.
#[test]
fn a_failed_operation_is_told_and_loses_no_state() {
    for lasts in 1..40 {
        let mut driver = Driver::new();
        driver.lasts = lasts;
        let flash = Flash::new(driver, BEGIN as u32).unwrap();
        let (mut store, _) = load(&flash);
        let mut durable = 0;
        for count in 1.. {
            store.request(state(count));
            let mut failed = false;
            while let Some(operation) = store.poll(flash.status()) {
                match operation {
                    FlashOp::Erase { sector } => flash.start_erase(sector).unwrap(),
                    FlashOp::Program { offset, data } => {
                        flash.start_program(offset, &data).unwrap()
                    }
                }
                if flash.status() == FlashStatus::Failed {
                    failed = true;
                    break;
                }
            }
            if failed {
                break;
            }
            durable = count;
        }
        let Loaded::State(found) = load(&flash).1 else {
            assert_eq!(durable, 0, "the state is lost");
            continue;
        };
        assert!(
            found == state(durable) || found == state(durable + 1),
            "{found:?} after {durable}"
        );
    }
}

/// What is not aligned or outside is refused before the driver is called.
#[test]
fn places_are_checked() {
    let end = (4 * SECTOR) as u32;
    for begin in [1, SECTOR as u32 / 2, end - SECTOR as u32, end] {
        assert_eq!(
            Flash::new(Driver::new(), begin).err(),
            Some(FlashError::OutOfRange)
        );
    }
    assert!(
        NorDataFlash::<_, 1>::new(Driver::new(), 0).is_err(),
        "one sector"
    );
    let flash = Flash::new(Driver::new(), BEGIN as u32).unwrap();
    let refused = Err(FlashError::OutOfRange);
    assert_eq!(flash.start_erase(2), refused);
    assert_eq!(flash.start_program(8, &[0; PAGE]), refused);
    assert_eq!(flash.start_program(0, &[0; PAGE - 1]), refused);
    assert_eq!(flash.start_program(0, &[]), refused);
    assert_eq!(
        flash.start_program((SECTOR - PAGE) as u32, &[0; 2 * PAGE]),
        refused
    );
    assert_eq!(
        flash.start_program((2 * SECTOR) as u32, &[0; PAGE]),
        refused
    );
    assert_eq!(flash.read(2, &mut [0; 4]), refused);
    assert_eq!(flash.read((2 * SECTOR) as u32 - 4, &mut [0; 8]), refused);
    assert_eq!(
        flash.start_program((2 * SECTOR - PAGE) as u32, &[7; PAGE]),
        Ok(())
    );
    let mut back = [0; PAGE];
    assert_eq!(flash.read((2 * SECTOR - PAGE) as u32, &mut back), Ok(()));
    assert_eq!(back, [7; PAGE]);
}
