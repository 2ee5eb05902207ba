//! The bootloader on a flash driver of `embedded-storage`, here bytes in memory. Nothing is in it
//! that could boot, so the loader waits for a host and answers it.
//! `cargo run -p tandem-boot --example blank_flash`
#![allow(clippy::print_stdout, reason = "its output is its purpose")]

use embedded_storage::nor_flash::{
    ErrorType, NorFlash, NorFlashError, NorFlashErrorKind, ReadNorFlash, check_erase, check_read,
    check_write,
};
use tandem_board::tester_desk::CONNECT;
use tandem_board::{CanFrame, Instant, InvalidFrame, ResetCause, SystemId};
use tandem_boot::{
    Answer, Bank, CONNECT_WINDOW, FLASH_BYTES, Loader, Next, PAGE_BYTES, SMALLEST_SECTOR, Setup,
    TO_LOADER, Trust, TrustMode, ed25519,
};

/// A driver as a HAL has it: whole pages are programmed, whole sectors are erased to ones.
struct Flash(Vec<u8>);

#[derive(Debug)]
struct Refused(NorFlashErrorKind);

impl NorFlashError for Refused {
    fn kind(&self) -> NorFlashErrorKind {
        self.0
    }
}

impl ErrorType for Flash {
    type Error = Refused;
}

impl ReadNorFlash for Flash {
    const READ_SIZE: usize = 1;

    fn read(&mut self, offset: u32, bytes: &mut [u8]) -> Result<(), Refused> {
        check_read(self, offset, bytes.len()).map_err(Refused)?;
        bytes.copy_from_slice(&self.0[offset as usize..][..bytes.len()]);
        Ok(())
    }

    fn capacity(&self) -> usize {
        self.0.len()
    }
}

impl NorFlash for Flash {
    const WRITE_SIZE: usize = PAGE_BYTES;
    const ERASE_SIZE: usize = SMALLEST_SECTOR as usize;

    fn erase(&mut self, from: u32, to: u32) -> Result<(), Refused> {
        check_erase(self, from, to).map_err(Refused)?;
        self.0[from as usize..to as usize].fill(0xFF);
        Ok(())
    }

    fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), Refused> {
        check_write(self, offset, bytes.len()).map_err(Refused)?;
        let cells = &mut self.0[offset as usize..][..bytes.len()];
        // A page is programmed once after it was erased.
        if cells.iter().any(|cell| *cell != 0xFF) {
            return Err(Refused(NorFlashErrorKind::Other));
        }
        cells.copy_from_slice(bytes);
        Ok(())
    }
}

fn main() -> Result<(), InvalidFrame> {
    let setup = Setup {
        trust: Trust {
            keys: &[],
            testers: &[],
            mode: TrustMode::Strict,
            verify: ed25519,
        },
        system: SystemId::A,
        bank: Bank::Primary,
        cause: ResetCause::PowerOn,
        starts: 1,
        counter: 0,
        noise: [7; 32],
    };
    let flash = Flash(vec![0xFF; FLASH_BYTES as usize]);
    let mut loader = Loader::start(flash, setup, Instant::ORIGIN);
    let wait = loader.next(Instant::ORIGIN);
    println!("a host may connect: {wait:?}");
    let now = Instant::ORIGIN + CONNECT_WINDOW;
    assert_eq!(
        loader.next(now),
        Next::Wait(Instant::NEVER),
        "nothing boots"
    );

    let mut request = [0; 8];
    request[..4].copy_from_slice(&CONNECT.to_le_bytes());
    let frame = CanFrame::new(TO_LOADER, false, &request)?;
    loader.on_frame(now, &frame);
    let Next::Send(answer) = loader.next(now) else {
        panic!("no answer");
    };
    println!("a host connects: {:?}", Answer::decode(answer.data()));
    assert_eq!(Answer::decode(answer.data()), Some(Answer::Connected));
    Ok(())
}
