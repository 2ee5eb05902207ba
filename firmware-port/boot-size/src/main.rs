//! Links all of `tandem-boot` without a board, to measure the size of a bootloader without drivers.
//! A panic stops the processor without a message, as in a product.
#![no_std]
#![no_main]

use core::hint::black_box;
use core::panic::PanicInfo;
use embedded_storage::nor_flash::{ErrorType, NorFlash, NorFlashErrorKind, ReadNorFlash};
use tandem_board::{CanFrame, Instant, ResetCause, SystemId};
use tandem_boot::{
    Bank, FLASH_BYTES, Loader, Next, PAGE_BYTES, SMALLEST_SECTOR, Setup, Trust, TrustMode, ed25519,
    rom_choice,
};

#[panic_handler]
fn stop(_: &PanicInfo<'_>) -> ! {
    loop {
        core::hint::spin_loop();
    }
}

/// A flash that the compiler cannot optimise away.
struct Unknown;

impl ErrorType for Unknown {
    type Error = NorFlashErrorKind;
}

impl ReadNorFlash for Unknown {
    const READ_SIZE: usize = 1;

    #[inline(never)]
    fn read(&mut self, offset: u32, bytes: &mut [u8]) -> Result<(), NorFlashErrorKind> {
        black_box((offset, bytes));
        black_box(Ok(()))
    }

    fn capacity(&self) -> usize {
        FLASH_BYTES as usize
    }
}

impl NorFlash for Unknown {
    const WRITE_SIZE: usize = PAGE_BYTES;
    const ERASE_SIZE: usize = SMALLEST_SECTOR as usize;

    #[inline(never)]
    fn erase(&mut self, from: u32, to: u32) -> Result<(), NorFlashErrorKind> {
        black_box(from..to);
        black_box(Ok(()))
    }

    #[inline(never)]
    fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), NorFlashErrorKind> {
        black_box((offset, bytes));
        black_box(Ok(()))
    }
}

#[unsafe(no_mangle)]
extern "C" fn tandem_size_boot() -> ! {
    let key = black_box([0; 32]);
    let setup = Setup {
        trust: Trust {
            keys: &[key],
            testers: black_box(&[[0; 32]]),
            mode: black_box(TrustMode::Strict),
            verify: ed25519,
        },
        system: black_box(SystemId::A),
        bank: rom_choice(&mut Unknown).unwrap_or(Bank::Primary),
        cause: black_box(ResetCause::PowerOn),
        starts: black_box(1),
        counter: black_box(0),
        noise: black_box([7; 32]),
    };
    loop {
        let now = || black_box(Instant::ORIGIN);
        let mut loader = Loader::start(Unknown, setup, now());
        loop {
            match black_box(loader.next(now())) {
                Next::Wait(_) => {
                    let frame: Option<CanFrame> = black_box(None);
                    if let Some(frame) = frame {
                        loader.on_frame(now(), &frame);
                    }
                }
                Next::Send(_) => {}
                Next::Jump(_) | Next::StartBank(_) | Next::Reset => break,
            }
        }
    }
}
