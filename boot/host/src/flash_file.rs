//! The program flash of one system as a file of 2 MiB, with the same bytes as in the chip.

use embedded_storage::nor_flash::{
    ErrorType, NorFlash, NorFlashError, NorFlashErrorKind, ReadNorFlash,
};
use std::fs::{File, OpenOptions};
use std::io;
use std::os::unix::fs::FileExt;
use std::path::Path;
use tandem_boot::{FLASH_BYTES, PAGE_BYTES, SMALLEST_SECTOR, sector_at};

/// A flash file. Each operation is durable when it returns.
#[derive(Debug)]
pub struct FlashFile(File);

/// The file cannot be read or written, or the range does not consist of whole pages or sectors.
#[derive(Debug)]
pub struct FlashFileFault;

impl NorFlashError for FlashFileFault {
    fn kind(&self) -> NorFlashErrorKind {
        NorFlashErrorKind::Other
    }
}

impl FlashFile {
    /// Opens a file, or creates an erased one.
    ///
    /// # Errors
    /// An error of the operating system, or an error if the file has the wrong size.
    pub fn open(path: &Path) -> io::Result<Self> {
        let mut options = OpenOptions::new();
        let file = options
            .read(true)
            .write(true)
            .create(true)
            .truncate(false)
            .open(path)?;
        let length = file.metadata()?.len();
        if length == 0 {
            file.write_all_at(&vec![0xFF; FLASH_BYTES as usize], 0)?;
        } else if length != u64::from(FLASH_BYTES) {
            let text = format!("{length} bytes; a program flash has {FLASH_BYTES}");
            return Err(io::Error::new(io::ErrorKind::InvalidData, text));
        }
        Ok(Self(file))
    }

    /// Writes bytes, as a programming station does before assembly.
    ///
    /// # Errors
    /// An error of the operating system.
    pub fn load(&self, offset: u32, bytes: &[u8]) -> io::Result<()> {
        self.0.write_all_at(bytes, offset.into())
    }
}

impl ErrorType for FlashFile {
    type Error = FlashFileFault;
}

impl ReadNorFlash for FlashFile {
    const READ_SIZE: usize = 1;

    fn read(&mut self, offset: u32, bytes: &mut [u8]) -> Result<(), FlashFileFault> {
        self.0
            .read_exact_at(bytes, offset.into())
            .map_err(|_| FlashFileFault)
    }

    fn capacity(&self) -> usize {
        FLASH_BYTES as usize
    }
}

impl NorFlash for FlashFile {
    const WRITE_SIZE: usize = PAGE_BYTES;
    const ERASE_SIZE: usize = SMALLEST_SECTOR as usize;

    fn erase(&mut self, from: u32, to: u32) -> Result<(), FlashFileFault> {
        let mut at = from;
        while at < to {
            let sector = sector_at(at).filter(|sector| sector.start == at && sector.end <= to);
            let sector = sector.ok_or(FlashFileFault)?;
            let erased = vec![0xFF; sector.len()];
            self.0
                .write_all_at(&erased, at.into())
                .map_err(|_| FlashFileFault)?;
            at = sector.end;
        }
        self.0.sync_data().map_err(|_| FlashFileFault)
    }

    fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), FlashFileFault> {
        let end = offset as usize + bytes.len();
        let aligned = [offset as usize, bytes.len()].map(|one| one.is_multiple_of(PAGE_BYTES));
        if aligned != [true; 2] || end > FLASH_BYTES as usize {
            return Err(FlashFileFault);
        }
        let mut page = vec![0; bytes.len()];
        self.read(offset, &mut page)?;
        page.iter_mut()
            .zip(bytes)
            .for_each(|(old, new)| *old &= new);
        self.0
            .write_all_at(&page, offset.into())
            .map_err(|_| FlashFileFault)
    }
}
