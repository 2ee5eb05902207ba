//! The machine of an image, and its emulator: the word size in the image says which.

use std::fmt;
use std::fs::File;
use std::io::{self, Read as _};
use std::path::Path;
use std::process::Command;

/// Where an ELF file has its word size, behind four bytes that say what it is.
const CLASS_AT: usize = 4;

/// A machine that an image is built for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ImageMachine {
    /// Board `riscv32-virt`.
    Riscv32,
    /// Board `riscv64-virt`: doorbells are messages, and the timer is apart from them.
    Riscv64,
}

impl ImageMachine {
    /// Returns the machine of an image.
    ///
    /// # Errors
    /// If the file cannot be read, or is not an image for these machines.
    pub fn of(image: &Path) -> io::Result<Self> {
        let mut head = [0; CLASS_AT + 1];
        File::open(image)?.read_exact(&mut head)?;
        match &head {
            b"\x7FELF\x01" => Ok(Self::Riscv32),
            b"\x7FELF\x02" => Ok(Self::Riscv64),
            _ => Err(io::Error::new(
                io::ErrorKind::InvalidData,
                "it is no ELF file",
            )),
        }
    }

    /// Returns the command of the emulator, with this machine and its seven harts.
    #[must_use]
    pub fn command(self) -> Command {
        let (program, machine) = match self {
            Self::Riscv32 => ("qemu-system-riscv32", "virt"),
            Self::Riscv64 => ("qemu-system-riscv64", "virt,aclint=on,aia=aplic-imsic"),
        };
        let mut command = Command::new(program);
        command.args(["-machine", machine, "-smp", "7", "-bios", "none"]);
        command
    }

    /// Returns whether core 0 of a machine with one system runs its tasks under FreeRTOS.
    #[must_use]
    pub const fn has_kernel(self) -> bool {
        matches!(self, Self::Riscv32)
    }
}

impl fmt::Display for ImageMachine {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Riscv32 => "riscv32",
            Self::Riscv64 => "riscv64",
        })
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "all of it is a test")]
mod tests {
    use super::*;

    #[test]
    fn the_image_says_for_which_machine_it_is() {
        let folder = tempfile::tempdir().unwrap();
        let image = folder.path().join("image");
        let machine_of = |bytes: &[u8]| {
            std::fs::write(&image, bytes).unwrap();
            ImageMachine::of(&image).map_err(|error| error.kind())
        };
        assert_eq!(machine_of(b"\x7FELF\x01..."), Ok(ImageMachine::Riscv32));
        assert_eq!(machine_of(b"\x7FELF\x02..."), Ok(ImageMachine::Riscv64));
        let other = Err(io::ErrorKind::InvalidData);
        assert_eq!(machine_of(b"\x7FELF\x03..."), other);
        assert_eq!(machine_of(b"S0030000FC"), other);
        assert_eq!(machine_of(b"\x7FEL"), Err(io::ErrorKind::UnexpectedEof));
    }
}
