//! The jump from the first program of a core to the program in a slot: the process stays the same.
//!
//! A slot holds a file that Linux can execute: an ELF file or a script. The script
//! `#!/proc/self/exe __application NAME` starts the application NAME of the running executable.

use std::io::{self, Write as _};
use std::os::fd::AsRawFd as _;
use std::os::unix::process::CommandExt as _;
use std::process::Command;

use rustix::fs::{MemfdFlags, memfd_create};

use crate::args::{APPLICATION, CoreArgs, ProcessArgs};
use crate::backplane::{Backplane, BackplaneError};
use crate::this_program::this_program;

const SCRIPT: &str = "#!/proc/self/exe ";

/// Returns the content of a slot that starts an application of the running executable.
#[must_use]
pub fn script(application: &str) -> Vec<u8> {
    format!("{SCRIPT}{APPLICATION}{application}\n").into_bytes()
}

/// Replaces the program of this process. The process keeps its id and its priority, and still dies
/// with its supply; the rest of the old program's state is lost. Returns only if the jump fails.
#[must_use]
pub fn jump(image: &[u8], args: &CoreArgs) -> io::Error {
    // The file stays open across the exec, because the interpreter of a script opens this path.
    let execute = || -> io::Result<core::convert::Infallible> {
        let mut file = std::fs::File::from(memfd_create("slot", MemfdFlags::empty())?);
        file.write_all(image)?;
        let path = format!("/proc/self/fd/{}", file.as_raw_fd());
        let argv = ProcessArgs::Core(args.clone()).to_argv();
        // The kernel would start the loader of a program that runs from sealed copies.
        let mut again = this_program();
        let mut command = match word_of(image) {
            Some(word) if again.get_args().len() > 0 => {
                again.args([word, &path]);
                again
            }
            _ => Command::new(path),
        };
        Err(command.args(argv).exec())
    };
    match execute() {
        Ok(never) => match never {},
        Err(error) => error,
    }
}

/// Returns the word that a script of [`script`] gives to the running executable.
fn word_of(image: &[u8]) -> Option<&str> {
    let line = image.split(|byte| *byte == b'\n').next()?;
    std::str::from_utf8(line).ok()?.strip_prefix(SCRIPT)
}

/// Publishes the slot to which core 0 is about to jump; the other cores of its system will follow.
///
/// # Errors
/// [`BackplaneError`] if the run has ended.
pub fn set_booted(args: &CoreArgs, slot: u32) -> Result<(), BackplaneError> {
    Backplane::open(&args.common.run)?.set_booted(args.identity.system, slot);
    Ok(())
}

/// Returns the slot to which core 0 of this core's system has jumped.
///
/// # Errors
/// [`BackplaneError`] if the run has ended.
pub fn booted(args: &CoreArgs) -> Result<u32, BackplaneError> {
    Ok(Backplane::open(&args.common.run)?.booted(args.identity.system))
}
