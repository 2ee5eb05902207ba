//! Access to files of the host through the emulator's semihosting calls.
//!
//! A call completes before the next instruction: the whole machine and its clock stop until the
//! host has finished. ("Semihosting for AArch32 and AArch64", and the RISC-V supplement.)

use core::arch::asm;
use core::sync::atomic::AtomicU32;

/// A file of the host.
#[derive(Clone, Copy, Debug)]
pub(crate) struct File(usize);

/// The host could not open, write or read a file.
#[derive(Clone, Copy, Debug)]
pub(crate) struct HostError;

const SYS_OPEN: usize = 0x01;
const SYS_WRITE: usize = 0x05;
const SYS_READ: usize = 0x06;
const READ_BINARY: usize = 1;
const WRITE_BINARY: usize = 5;

/// # Safety
/// The parameters must be those of the call, and must give the true length of what they point to.
unsafe fn call(number: usize, parameters: &[usize; 3]) -> isize {
    let result: isize;
    // SAFETY: the three instructions are the call. The emulator reads `parameters`, reads or writes
    // the memory that they point to, which the caller guarantees, and changes only a0.
    unsafe {
        asm!(
            ".balign 16",
            ".option push",
            ".option norvc",
            "slli x0, x0, 0x1f",
            "ebreak",
            "srai x0, x0, 7",
            ".option pop",
            inlateout("a0") number => result,
            in("a1") parameters.as_ptr(),
            options(nostack),
        );
    }
    result
}

impl File {
    fn open(path: &core::ffi::CStr, mode: usize) -> Result<Self, HostError> {
        let parameters = [path.as_ptr() as usize, mode, path.count_bytes()];
        // SAFETY: a path with its length and a mode.
        let handle = unsafe { call(SYS_OPEN, &parameters) };
        usize::try_from(handle).map(Self).map_err(|_| HostError)
    }

    /// Opens a file or pipe for reading. Blocks until a pipe has a writer.
    pub(crate) fn open_to_read(path: &core::ffi::CStr) -> Result<Self, HostError> {
        Self::open(path, READ_BINARY)
    }

    /// Opens a file or pipe for writing. Blocks until a pipe has a reader.
    pub(crate) fn open_to_write(path: &core::ffi::CStr) -> Result<Self, HostError> {
        Self::open(path, WRITE_BINARY)
    }

    /// Writes all words.
    pub(crate) fn write(self, words: &[AtomicU32]) -> Result<(), HostError> {
        let parameters = [self.0, words.as_ptr() as usize, size_of_val(words)];
        // SAFETY: a handle, a buffer and its length. The call returns the bytes not written.
        match unsafe { call(SYS_WRITE, &parameters) } {
            0 => Ok(()),
            _ => Err(HostError),
        }
    }

    /// Reads until `into` is full.
    pub(crate) fn read(self, into: &[AtomicU32]) -> Result<(), HostError> {
        let (mut at, mut left) = (into.as_ptr() as usize, size_of_val(into));
        while left > 0 {
            // SAFETY: a handle, the rest of a buffer that may be written through a shared
            // reference, and its length. The call returns the number of bytes not filled.
            let unfilled = unsafe { call(SYS_READ, &[self.0, at, left]) };
            match usize::try_from(unfilled) {
                Ok(unfilled) if unfilled < left => {
                    at += left - unfilled;
                    left = unfilled;
                }
                // The end of the file, or an error.
                _ => return Err(HostError),
            }
        }
        Ok(())
    }
}
