//! The data flash over a flash driver of a HAL, with the traits of `embedded-storage`.

use core::cell::{Cell, RefCell};
use embedded_storage::nor_flash::NorFlash;

use crate::{DataFlash, FlashError, FlashStatus};

/// [`DataFlash`] in `SECTORS` sectors of a driver, each of [`NorFlash::ERASE_SIZE`] bytes; a page
/// has [`NorFlash::WRITE_SIZE`].
///
/// The driver blocks: an operation is over when its start returns, and the core does nothing else
/// until then. Use it if the longest erase fits into the time that the core may be held up, or on a
/// core that has no deadline.
#[derive(Debug)]
pub struct NorDataFlash<F, const SECTORS: u32> {
    flash: RefCell<F>,
    begin: u32,
    status: Cell<FlashStatus>,
}

impl<F: NorFlash, const SECTORS: u32> NorDataFlash<F, SECTORS> {
    const BYTES: u32 = F::ERASE_SIZE as u32 * SECTORS;

    /// Uses the sectors from offset `begin` of the driver on.
    ///
    /// # Errors
    /// [`FlashError::OutOfRange`] if `begin` is not the start of a sector, the flash ends before
    /// the last sector does, there are fewer than 2 sectors, or a sector is not whole pages.
    pub fn new(flash: F, begin: u32) -> Result<Self, FlashError> {
        let end = begin as usize + Self::BYTES as usize;
        let fits = (begin as usize).is_multiple_of(F::ERASE_SIZE) && end <= flash.capacity();
        if SECTORS < 2 || !fits || !F::ERASE_SIZE.is_multiple_of(F::WRITE_SIZE) {
            return Err(FlashError::OutOfRange);
        }
        Ok(Self {
            flash: RefCell::new(flash),
            begin,
            status: Cell::new(FlashStatus::Idle),
        })
    }

    /// Returns the driver.
    pub fn into_inner(self) -> F {
        self.flash.into_inner()
    }

    /// Returns the place in the driver of `len` bytes at `offset`.
    fn place(&self, offset: u32, len: usize) -> Result<u32, FlashError> {
        let end = offset as usize + len;
        if end > Self::BYTES as usize {
            return Err(FlashError::OutOfRange);
        }
        Ok(self.begin + offset)
    }

    fn run(&self, operation: impl FnOnce(&mut F) -> Result<(), F::Error>) {
        let done = operation(&mut self.flash.borrow_mut());
        self.status.set(match done {
            Ok(()) => FlashStatus::Idle,
            Err(_) => FlashStatus::Failed,
        });
    }
}

impl<F: NorFlash, const COUNT: u32> DataFlash for NorDataFlash<F, COUNT> {
    const PAGE_BYTES: u32 = F::WRITE_SIZE as u32;
    const SECTOR_BYTES: u32 = F::ERASE_SIZE as u32;
    const SECTORS: u32 = COUNT;

    /// The offset and the length must be multiples of
    /// [`ReadNorFlash::READ_SIZE`](embedded_storage::nor_flash::ReadNorFlash::READ_SIZE).
    fn read(&self, offset: u32, into: &mut [u8]) -> Result<(), FlashError> {
        let place = self.place(offset, into.len())?;
        let aligned = (offset as usize | into.len()).is_multiple_of(F::READ_SIZE);
        if !aligned {
            return Err(FlashError::OutOfRange);
        }
        let mut flash = self.flash.borrow_mut();
        flash.read(place, into).map_err(|_| FlashError::Failed)
    }

    fn start_erase(&self, sector: u32) -> Result<(), FlashError> {
        if sector >= COUNT {
            return Err(FlashError::OutOfRange);
        }
        let begin = self.begin + sector * Self::SECTOR_BYTES;
        self.run(|flash| flash.erase(begin, begin + Self::SECTOR_BYTES));
        Ok(())
    }

    fn start_program(&self, offset: u32, data: &[u8]) -> Result<(), FlashError> {
        let place = self.place(offset, data.len())?;
        let (page, sector) = (F::WRITE_SIZE, F::ERASE_SIZE);
        let (at, len) = (offset as usize, data.len());
        let whole_pages = len > 0 && at.is_multiple_of(page) && len.is_multiple_of(page);
        if !whole_pages || at % sector + len > sector {
            return Err(FlashError::OutOfRange);
        }
        self.run(|flash| flash.write(place, data));
        Ok(())
    }

    fn status(&self) -> FlashStatus {
        self.status.get()
    }
}
