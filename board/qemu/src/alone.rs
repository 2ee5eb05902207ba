//! Runs an image to its end in a machine without a vehicle.

use std::fs::File;
use std::path::Path;
use std::process::{Child, Stdio};
use std::time::{Duration, Instant};

use crate::emulator::ImageMachine;
use crate::machine::MachineError;

/// Longer than any such image runs, even on a busy machine.
const PATIENCE: Duration = Duration::from_secs(120);

/// An emulator process that is killed when this value is dropped.
struct Emulator(Child);

impl Drop for Emulator {
    fn drop(&mut self) {
        // Fails if the process has already ended.
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Runs an image to its end and returns its log. Uses `-icount shift=0`: an instruction takes 1 ns
/// of virtual time, and time skips ahead when all harts sleep. So all runs are the same.
///
/// # Errors
/// [`MachineError::Image`], [`MachineError::Start`] or [`MachineError::Pipes`];
/// [`MachineError::Ended`] if the exit status is not 0; [`MachineError::Hangs`] after two minutes.
pub fn run_to_end(image: &Path) -> Result<String, MachineError> {
    let folder = tempfile::Builder::new()
        .prefix("tandem-qemu-")
        .tempdir()
        .map_err(MachineError::Pipes)?;
    let path = folder.path().join("log");
    let log = File::create(&path).map_err(MachineError::Pipes)?;
    let errors = log.try_clone().map_err(MachineError::Pipes)?;
    let machine = ImageMachine::of(image).map_err(MachineError::Image)?;
    let mut command = machine.command();
    command
        .args(["-display", "none", "-monitor", "none", "-serial", "stdio"])
        .args(["-icount", "shift=0,sleep=off", "-kernel"])
        .arg(image)
        .stdin(Stdio::null())
        .stdout(log)
        .stderr(errors);
    let child = command.spawn().map_err(MachineError::Start)?;
    let mut emulator = Emulator(child);
    let begin = Instant::now();
    let said = || std::fs::read_to_string(&path).map_err(MachineError::Pipes);
    loop {
        match emulator.0.try_wait().map_err(MachineError::Start)? {
            Some(status) if status.success() => return said(),
            Some(status) => {
                return Err(MachineError::Ended {
                    status,
                    log: said()?,
                });
            }
            None if begin.elapsed() > PATIENCE => {
                return Err(MachineError::Hangs { log: said()? });
            }
            None => std::thread::sleep(Duration::from_millis(5)),
        }
    }
}
