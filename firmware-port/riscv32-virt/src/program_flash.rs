//! The program flash of the system in this machine: RAM with the behaviour of NOR flash. The
//! emulator loads its content at the start.

use core::ptr::addr_of;
use core::sync::atomic::{AtomicU8, Ordering::Relaxed};
use embedded_storage::nor_flash::{
    ErrorType, NorFlash, NorFlashErrorKind, ReadNorFlash, check_erase, check_read, check_write,
};
use tandem_boot::{FLASH_BYTES, PAGE_BYTES, SMALLEST_SECTOR};

/// Address of the program flash; must be the same as in link.x.
pub const BEGIN: u32 = 0x8500_0000;
const ERASED: u8 = 0xFF;

unsafe extern "C" {
    static __program_flash: AtomicU8;
}

/// The program flash.
#[derive(Clone, Copy, Debug)]
pub struct ProgramFlash;

fn cells(offset: u32, len: usize) -> &'static [AtomicU8] {
    // SAFETY: link.x reserves 2 MiB there; atomics may be shared; the memory is never unmapped.
    let all =
        unsafe { core::slice::from_raw_parts(addr_of!(__program_flash), FLASH_BYTES as usize) };
    &all[offset as usize..][..len]
}

impl ErrorType for ProgramFlash {
    type Error = NorFlashErrorKind;
}

impl ReadNorFlash for ProgramFlash {
    const READ_SIZE: usize = 1;

    fn read(&mut self, offset: u32, bytes: &mut [u8]) -> Result<(), NorFlashErrorKind> {
        check_read(self, offset, bytes.len())?;
        let len = bytes.len();
        for (byte, cell) in bytes.iter_mut().zip(cells(offset, len)) {
            *byte = cell.load(Relaxed);
        }
        Ok(())
    }

    fn capacity(&self) -> usize {
        FLASH_BYTES as usize
    }
}

impl NorFlash for ProgramFlash {
    const WRITE_SIZE: usize = PAGE_BYTES;
    const ERASE_SIZE: usize = SMALLEST_SECTOR as usize;

    fn erase(&mut self, from: u32, to: u32) -> Result<(), NorFlashErrorKind> {
        check_erase(self, from, to)?;
        for cell in cells(from, (to - from) as usize) {
            cell.store(ERASED, Relaxed);
        }
        Ok(())
    }

    fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), NorFlashErrorKind> {
        check_write(self, offset, bytes.len())?;
        for (byte, cell) in bytes.iter().zip(cells(offset, bytes.len())) {
            cell.store(cell.load(Relaxed) & byte, Relaxed);
        }
        Ok(())
    }
}
