//! The emulator and the machine for an image, by the word size in the image.

use std::fs::File;
use std::io::{self, Read as _};
use std::path::Path;
use std::process::Command;

use crate::machine::MachineError;

/// Where an ELF file has its word size, behind four bytes that say what it is.
const CLASS_AT: usize = 4;
/// Seven harts, which start in the image and not in firmware of the emulator.
const HARTS: [&str; 4] = ["-smp", "7", "-bios", "none"];

/// Returns the command of the emulator, with the machine that `image` is built for and all its harts.
///
/// # Errors
/// [`MachineError::Image`] if the file cannot be read, or is not an image for these machines.
pub fn emulator_command(image: &Path) -> Result<Command, MachineError> {
    let mut head = [0; CLASS_AT + 1];
    File::open(image)
        .and_then(|mut file| file.read_exact(&mut head))
        .map_err(MachineError::Image)?;
    let (program, machine) = match &head {
        b"\x7FELF\x01" => ("qemu-system-riscv32", "virt"),
        // Doorbells by messages, and the timer apart from them: board of riscv64-virt.
        b"\x7FELF\x02" => ("qemu-system-riscv64", "virt,aclint=on,aia=aplic-imsic"),
        _ => {
            let error = io::Error::new(io::ErrorKind::InvalidData, "it is not an ELF file");
            return Err(MachineError::Image(error));
        }
    };
    let mut command = Command::new(program);
    command.args(["-machine", machine]).args(HARTS);
    Ok(command)
}
