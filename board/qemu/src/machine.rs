//! One emulator process and the two pipes to its emulated peripherals.

use std::fs::File;
use std::io::{self, PipeReader, PipeWriter, Read as _, Seek as _, SeekFrom, Write as _, pipe};
use std::os::unix::fs::symlink;
use std::os::unix::process::CommandExt as _;
use std::path::{Path, PathBuf};
use std::process::{Child, ExitStatus};
use std::time::{Duration, Instant};

use rustix::event::{PollFd, PollFlags, poll};
use tandem_board::SystemId;
use tandem_cosim::{ITEM_WORDS, Item, MAGIC, MAX_WORDS, REPORT_WORDS, Report};
use tempfile::TempDir;

use crate::emulator::ImageMachine;

/// Address from which the firmware reads its straps.
const STRAPS_AT: u32 = 0x8090_0000;
/// Address of the public key that the bootloader trusts.
const KEY_AT: u32 = STRAPS_AT + 64;
/// Start of the RAM that a bootloader from a bank runs from: its image is linked there.
pub const LOADER_RAM_AT: u32 = 0x8048_0000;
/// Start of the system's program flash.
pub const PROGRAM_FLASH_AT: u32 = 0x8500_0000;
/// A machine that sends no report for this long has hung. One step takes far less than a second.
const PATIENCE: Duration = Duration::from_secs(60);
/// How often a silent machine is checked.
const LOOK_MS: i64 = 50;

/// Why a machine cannot continue.
#[derive(Debug, thiserror::Error)]
pub enum MachineError {
    /// The emulator could not be started.
    #[error("cannot start QEMU (apt-get install --no-install-recommends qemu-system-misc)")]
    Start(#[source] io::Error),
    /// The image cannot be read, or is for no machine that is known here.
    #[error("the image cannot be used")]
    Image(#[source] io::Error),
    /// The pipes could not be made.
    #[error("cannot make the pipes to the emulator")]
    Pipes(#[source] io::Error),
    /// The emulator has ended; its log says why.
    #[error("the emulator ended with {status}: {log}")]
    Ended {
        /// Its exit status.
        status: ExitStatus,
        /// The firmware's log.
        log: String,
    },
    /// The emulator has stopped reporting.
    #[error("the firmware does not answer: {log}")]
    Hangs {
        /// The firmware's log.
        log: String,
    },
    /// The report cannot be decoded: the image has another version.
    #[error("the firmware is not of this version")]
    Malformed,
}

/// The flash and key with which the image `bootloader` starts one system in its own machine.
#[derive(Clone, Debug)]
pub struct BootFrom {
    /// The content of the program flash, 2 MiB. The machine works on a copy.
    pub flash: PathBuf,
    /// The public key that the bootloader trusts.
    pub public: [u8; 32],
    /// The public key of a tester; without one, everybody may program the machine.
    pub tester: Option<[u8; 32]>,
}

/// The straps of the controller's image.
#[derive(Clone, Copy, Debug, Default)]
pub struct MachineOptions {
    /// A system that restarts becomes the standby of the running one.
    pub reintegrate: bool,
    /// Timing profile `chip`, not `rt`. Only for [`WorldLayout::One`](crate::WorldLayout::One):
    /// between two machines, edges and datagrams take up to 2 ms.
    pub chip: bool,
    /// Overload of core 0's tasks, as strap `Third`: see the image's `main`. 0 means no overload.
    pub overload: u32,
}

/// An emulator process. It ends when this value is dropped.
#[derive(Debug)]
pub struct Machine {
    child: Child,
    from: PipeReader,
    to: PipeWriter,
    /// The emulator's errors and the firmware's log.
    logs: [File; 2],
    /// Kept until the emulator has opened all files in it. Dropping it removes them.
    folder: Option<TempDir>,
    systems: Vec<SystemId>,
}

impl Machine {
    /// Starts the image with these systems in it, on the machine that it is built for. In a machine
    /// of 32 bits with a single system, core 0 runs its tasks under FreeRTOS. `BootFrom` is for an
    /// image that boots.
    ///
    /// # Errors
    /// [`MachineError::Image`], [`MachineError::Start`] or [`MachineError::Pipes`].
    pub fn start(
        image: &Path,
        systems: &[SystemId],
        options: MachineOptions,
        boot: Option<&BootFrom>,
    ) -> Result<Self, MachineError> {
        let folder = tempfile::Builder::new()
            .prefix("tandem-qemu-")
            .tempdir()
            .map_err(MachineError::Pipes)?;
        // The firmware opens the pipes as files. They are anonymous: if this process dies, even
        // before the firmware opens them, the emulator reads end-of-file.
        let (from, to_world) = pipe().map_err(MachineError::Pipes)?;
        let (from_world, to) = pipe().map_err(MachineError::Pipes)?;
        for (name, place) in [("from-world", 0), ("to-world", 1)] {
            symlink(format!("/proc/self/fd/{place}"), folder.path().join(name))
                .map_err(MachineError::Pipes)?;
        }
        let mask: u32 = systems.iter().map(|system| 1 << system.index()).sum();
        let machine = ImageMachine::of(image).map_err(MachineError::Image)?;
        let mut command = machine.command();
        command
            .current_dir(folder.path())
            .args([
                "-display", "none", "-monitor", "none", "-serial", "file:log",
            ])
            .args(["-icount", "shift=0,sleep=off", "-semihosting", "-kernel"])
            .arg(image);
        // Strap 0, the mode, stays 0.
        let flags = u32::from(options.reintegrate) | u32::from(options.chip) << 1;
        for (index, value) in [(1, mask), (2, flags), (3, options.overload)] {
            let at = STRAPS_AT + 4 * index;
            command
                .arg("-device")
                .arg(format!("loader,addr={at:#x},data={value},data-len=4"));
        }
        if let Some(BootFrom {
            flash,
            public,
            tester,
        }) = boot
        {
            let file = flash.display();
            command.arg("-device").arg(format!(
                "loader,file={file},addr={PROGRAM_FLASH_AT:#x},force-raw=on"
            ));
            let keys = [&public[..], tester.as_ref().map_or(&[], |key| &key[..])].concat();
            for (at, word) in (KEY_AT..).step_by(4).zip(keys.as_chunks::<4>().0) {
                let value = u32::from_le_bytes(*word);
                command
                    .arg("-device")
                    .arg(format!("loader,addr={at:#x},data={value},data-len=4"));
            }
        }
        let log = |name| {
            let mut options = File::options();
            options.create(true).append(true).read(true);
            let file = options.open(folder.path().join(name));
            file.map_err(MachineError::Pipes)
        };
        let logs = [log("errors")?, log("log")?];
        let errors = logs[0].try_clone().map_err(MachineError::Pipes)?;
        let child = command
            // Ctrl-C at a terminal must reach only the run, which handles it.
            .process_group(0)
            .stdin(from_world)
            .stdout(to_world)
            .stderr(errors)
            .spawn()
            .map_err(MachineError::Start)?;
        Ok(Self {
            child,
            from,
            to,
            logs,
            folder: Some(folder),
            systems: systems.to_vec(),
        })
    }

    /// Returns the systems in the machine.
    #[must_use]
    pub fn systems(&self) -> &[SystemId] {
        &self.systems
    }

    /// Returns the process id of the emulator.
    #[must_use]
    pub fn pid(&self) -> u32 {
        self.child.id()
    }

    /// Waits for the machine's next exchange and returns its report; passes each event since the
    /// last exchange to `each`. Blocks.
    ///
    /// # Errors
    /// [`MachineError`] if the machine does not report.
    pub fn report(&mut self, mut each: impl FnMut(Item)) -> Result<Report, MachineError> {
        let mut words = vec![0; REPORT_WORDS];
        self.read(&mut words)?;
        self.folder = None;
        let report = Report::decode(&words).map_err(|_| MachineError::Malformed)?;
        let len = words[1] as usize;
        if !(REPORT_WORDS..=MAX_WORDS).contains(&len) {
            return Err(MachineError::Malformed);
        }
        words.resize(len - REPORT_WORDS, 0);
        self.read(&mut words)?;
        let mut left = &words[..];
        while !left.is_empty() {
            each(Item::decode(&mut left).map_err(|_| MachineError::Malformed)?);
        }
        Ok(report)
    }

    /// Answers: the machine continues with these items from outside. Returns the number of items
    /// that did not fit and were dropped.
    ///
    /// # Errors
    /// [`MachineError`] if the machine has ended.
    pub fn answer(&mut self, items: &[Item]) -> Result<usize, MachineError> {
        let mut words = vec![MAGIC, 0];
        let mut buffer = [0; ITEM_WORDS];
        let mut left_out = 0;
        for item in items {
            let len = item.encode(&mut buffer);
            if words.len() + len <= MAX_WORDS {
                words.extend_from_slice(&buffer[..len]);
            } else {
                left_out += 1;
            }
        }
        words[1] = words.len() as u32;
        let bytes: Vec<u8> = words.iter().flat_map(|word| word.to_le_bytes()).collect();
        match self.to.write_all(&bytes) {
            Ok(()) => Ok(left_out),
            Err(_) => Err(self.ended()),
        }
    }

    /// Ends the machine's run and returns its log.
    ///
    /// # Errors
    /// [`MachineError`] if it had ended before.
    pub fn end(mut self) -> Result<String, MachineError> {
        self.answer(&[Item::End])?;
        match self.ended() {
            MachineError::Ended { status, log } if status.success() => Ok(log),
            error => Err(error),
        }
    }

    fn read(&mut self, into: &mut [u32]) -> Result<(), MachineError> {
        let mut bytes = vec![0; into.len() * 4];
        let mut filled = 0;
        let begin = Instant::now();
        while filled < bytes.len() {
            self.await_bytes(begin)?;
            match self.from.read(&mut bytes[filled..]) {
                Ok(0) => return Err(self.ended()),
                Ok(count) => filled += count,
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                Err(error) => return Err(MachineError::Pipes(error)),
            }
        }
        for (word, bytes) in into.iter_mut().zip(bytes.chunks_exact(4)) {
            *word = bytes
                .iter()
                .rev()
                .fold(0, |word, byte| word << 8 | u32::from(*byte));
        }
        Ok(())
    }

    /// Waits until there may be bytes to read.
    fn await_bytes(&mut self, begin: Instant) -> Result<(), MachineError> {
        let wait = rustix::time::Timespec {
            tv_sec: 0,
            tv_nsec: LOOK_MS * 1_000_000,
        };
        loop {
            let mut fds = [PollFd::new(&self.from, PollFlags::IN)];
            match poll(&mut fds, Some(&wait)) {
                Ok(0) | Err(rustix::io::Errno::INTR) => {}
                Ok(_) => return Ok(()),
                Err(error) => return Err(MachineError::Pipes(error.into())),
            }
            if self.has_ended() {
                return Err(self.ended());
            }
            if begin.elapsed() > PATIENCE {
                return Err(MachineError::Hangs { log: self.log() });
            }
        }
    }

    fn has_ended(&mut self) -> bool {
        !matches!(self.child.try_wait(), Ok(None))
    }

    fn ended(&mut self) -> MachineError {
        match self.child.wait() {
            Ok(status) => MachineError::Ended {
                status,
                log: self.log(),
            },
            Err(error) => MachineError::Start(error),
        }
    }

    /// Returns the emulator's errors and the firmware's log.
    #[must_use]
    pub fn log(&self) -> String {
        let mut text = String::new();
        for mut log in &self.logs {
            // A log that cannot be read counts as empty.
            let _ = log.seek(SeekFrom::Start(0));
            let _ = log.read_to_string(&mut text);
        }
        text.trim().to_owned()
    }
}

impl Drop for Machine {
    fn drop(&mut self) {
        // Fails if the process has already ended.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
