//! Data flash as a file: NOR semantics, programmed in the background, durable when idle.

use std::fs::{self, File, OpenOptions};
use std::io::{self, Write as _};
use std::os::unix::fs::{FileExt, MetadataExt};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, AtomicU8, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::{self, Thread};
use std::time::{Duration, Instant};

use rustix::fs::{AtFlags, CWD, FlockOperation, RenameFlags, flock, linkat, renameat_with};
use rustix::io::{Errno, FdFlags, fcntl_setfd};
use tandem_board::{DataFlash, FlashError, FlashStatus};
use tandem_peripherals::data_flash::{self, Operation};

use crate::clock;

const SIZE: u64 = data_flash::SIZE as u64;
const SECTOR: usize = data_flash::SECTOR_BYTES as usize;

const IDLE: u8 = 0;
const BUSY: u8 = 1;
const FAILED: u8 = 2;

/// How long a start waits for a file that is in use. A killed process holds it until the kernel has
/// released that process's memory, some milliseconds after it has left the list of processes.
const LAST_OWNER_ENDS: Duration = Duration::from_secs(1);

/// Why the file cannot be the data flash.
#[derive(Debug, thiserror::Error)]
pub enum FlashFileError {
    /// The file could not be created, read or written.
    #[error("data flash {path}: {source}")]
    Io {
        /// The file.
        path: PathBuf,
        /// The error of the operating system.
        source: io::Error,
    },
    /// The file has the wrong size, so it is not a data flash.
    #[error("data flash {path} has {found} bytes, but a data flash has {SIZE}; name another file")]
    Size {
        /// The file.
        path: PathBuf,
        /// Its size in bytes.
        found: u64,
    },
    /// Another system uses the file.
    #[error("data flash {path} is in use by another system; end that run or name another file")]
    InUse {
        /// The file.
        path: PathBuf,
    },
}

/// The data flash of one system, locked until this process and all processes that it started have
/// ended, because two systems that write to one flash would destroy each other's data.
#[derive(Debug)]
pub struct Claimed {
    _lock: File,
}

/// The data flash of a system in a file.
///
/// A background thread performs the operations and calls `fdatasync`, so "idle" means durable. If
/// the process dies during an operation, the range of the operation holds any mixture of old and
/// new bytes, as NOR flash could.
///
/// Starting an operation allocates nothing and makes one system call, which wakes the thread. The
/// thread has a lower priority than the core, so the two never compete for a lock.
#[derive(Debug)]
pub struct HostFlash {
    device: Arc<Device>,
    worker: Thread,
}

#[derive(Debug)]
struct Device {
    file: File,
    /// [`IDLE`], [`BUSY`] or [`FAILED`]. A caller that sets it to `BUSY` owns `operation` until the
    /// thread sets another value.
    status: AtomicU8,
    /// Never contended: see `status`.
    operation: Mutex<Started>,
    /// The operation is ready to run; the thread clears this flag when it begins.
    requested: AtomicBool,
    /// The flash was dropped; the thread must end.
    closed: AtomicBool,
}

#[derive(Debug)]
struct Started {
    /// `None` before the first operation.
    operation: Option<Operation>,
    /// The data to program.
    data: [u8; SECTOR],
}

impl HostFlash {
    /// Creates the file with erased content if it does not exist; otherwise checks its size.
    ///
    /// # Errors
    /// [`FlashFileError`] if it cannot be created or has a wrong size.
    pub fn prepare(path: &Path) -> Result<(), FlashFileError> {
        let failed = refused(path);
        match fs::metadata(path) {
            Ok(found) if found.len() == SIZE => Ok(()),
            Ok(found) => Err(FlashFileError::Size {
                path: path.to_owned(),
                found: found.len(),
            }),
            Err(error) if error.kind() == io::ErrorKind::NotFound => create(path).map_err(failed),
            Err(error) => Err(failed(error)),
        }
    }

    /// Prepares the file and claims it for one system of the calling process's run.
    ///
    /// # Errors
    /// [`FlashFileError`] if the file cannot be prepared or locked, or is in use.
    pub fn claim(path: &Path) -> Result<Claimed, FlashFileError> {
        let failed = refused(path);
        let deadline = Instant::now() + LAST_OWNER_ENDS;
        loop {
            let file = open_prepared(path)?;
            match flock(&file, FlockOperation::NonBlockingLockExclusive) {
                Err(Errno::WOULDBLOCK) if Instant::now() < deadline => {
                    thread::sleep(Duration::from_millis(2));
                    continue;
                }
                Err(Errno::WOULDBLOCK) => {
                    let path = path.to_owned();
                    return Err(FlashFileError::InUse { path });
                }
                locked => locked.map_err(|errno| failed(errno.into()))?,
            }
            // If the name belongs to another file by now, the next process would open and lock that
            // file. So try again.
            let locked = file.metadata().map_err(failed)?;
            let named = fs::metadata(path);
            if !named.is_ok_and(|named| (named.dev(), named.ino()) == (locked.dev(), locked.ino()))
            {
                continue;
            }
            // The children inherit the descriptor and thus the lock, because a launcher may die
            // before its run ends.
            fcntl_setfd(&file, FdFlags::empty()).map_err(|errno| failed(errno.into()))?;
            return Ok(Claimed { _lock: file });
        }
    }

    /// Opens the data flash and starts its background thread.
    ///
    /// # Errors
    /// [`FlashFileError`] if the file cannot be opened or created, or has a wrong size.
    pub fn open(path: &Path) -> Result<Self, FlashFileError> {
        let file = open_prepared(path)?;
        let device = Arc::new(Device {
            file,
            status: AtomicU8::new(IDLE),
            operation: Mutex::new(Started {
                operation: None,
                data: [data_flash::ERASED; SECTOR],
            }),
            requested: AtomicBool::new(false),
            closed: AtomicBool::new(false),
        });
        let its = Arc::clone(&device);
        let worker = thread::Builder::new()
            .name("data flash".to_owned())
            .spawn(move || its.work())
            .map_err(refused(path))?;
        Ok(Self {
            device,
            worker: worker.thread().clone(),
        })
    }

    fn begin(&self, operation: Operation, data: &[u8]) -> Result<(), FlashError> {
        let Device {
            status,
            operation: started,
            requested,
            ..
        } = &*self.device;
        // Acquire pairs with the Release in `Device::work`: the thread has finished with the
        // operation.
        if status.swap(BUSY, Ordering::AcqRel) == BUSY {
            return Err(FlashError::Busy);
        }
        let mut started = started.lock().unwrap_or_else(PoisonError::into_inner);
        started.operation = Some(operation);
        started.data[..data.len()].copy_from_slice(data);
        drop(started);
        // Pairs with the swap in `Device::work`.
        requested.store(true, Ordering::Release);
        self.worker.unpark();
        Ok(())
    }
}

impl Drop for HostFlash {
    fn drop(&mut self) {
        // Pairs with the load in `Device::work`.
        self.device.closed.store(true, Ordering::Release);
        self.worker.unpark();
    }
}

impl Device {
    /// Runs the background thread until the flash is dropped.
    fn work(&self) {
        // Buffer for the old content of a range; kept to avoid allocation.
        let mut present = [data_flash::ERASED; SECTOR];
        loop {
            // Acquire pairs with the store in `HostFlash::begin`.
            if self.requested.swap(false, Ordering::Acquire) {
                let started = self.operation.lock();
                let started = started.unwrap_or_else(PoisonError::into_inner);
                let done = carry_out(&self.file, &started, &mut present);
                drop(started);
                let after = if done.is_ok() { IDLE } else { FAILED };
                // Pairs with the loads in `status` and `begin`.
                self.status.store(after, Ordering::Release);
            } else if self.closed.load(Ordering::Acquire) {
                return;
            } else {
                thread::park();
            }
        }
    }
}

impl DataFlash for HostFlash {
    const PAGE_BYTES: u32 = data_flash::PAGE_BYTES;
    const SECTOR_BYTES: u32 = data_flash::SECTOR_BYTES;
    const SECTORS: u32 = data_flash::SECTORS;

    fn read(&self, offset: u32, into: &mut [u8]) -> Result<(), FlashError> {
        // Acquire pairs with the Release in `Device::work`: this read sees everything that the
        // thread has written.
        if self.device.status.load(Ordering::Acquire) == BUSY {
            return Err(FlashError::Busy);
        }
        data_flash::range(offset, into.len())?;
        self.device
            .file
            .read_exact_at(into, u64::from(offset))
            .map_err(|_| FlashError::Failed)
    }

    fn start_erase(&self, sector: u32) -> Result<(), FlashError> {
        self.begin(Operation::erase(sector)?, &[])
    }

    fn start_program(&self, offset: u32, data: &[u8]) -> Result<(), FlashError> {
        self.begin(Operation::program(offset, data.len())?, data)
    }

    fn status(&self) -> FlashStatus {
        // Acquire pairs with the Release in `Device::work`.
        match self.device.status.load(Ordering::Acquire) {
            IDLE => FlashStatus::Idle,
            BUSY => FlashStatus::Busy,
            _ => FlashStatus::Failed,
        }
    }
}

fn carry_out(file: &File, started: &Started, present: &mut [u8; SECTOR]) -> io::Result<()> {
    let Some(operation) = started.operation else {
        return Ok(());
    };
    let range = operation.range();
    let (bytes, at) = (&mut present[..range.len()], range.start as u64);
    file.read_exact_at(bytes, at)?;
    operation.apply(bytes, &started.data);
    file.write_all_at(bytes, at)?;
    file.sync_data()
}

/// Prepares the file and opens it for reading and writing.
fn open_prepared(path: &Path) -> Result<File, FlashFileError> {
    HostFlash::prepare(path)?;
    let mut options = OpenOptions::new();
    let opened = options.read(true).write(true).open(path);
    opened.map_err(refused(path))
}

/// Returns a function that makes the error of an operation on this file.
fn refused(path: &Path) -> impl Fn(io::Error) -> FlashFileError + Copy {
    move |source| FlashFileError::Io {
        path: path.to_owned(),
        source,
    }
}

/// Creates the file completely or not at all, even at a power loss. Keeps a file that another
/// process creates at the same time.
fn create(path: &Path) -> io::Result<()> {
    let folder = match path.parent() {
        Some(folder) if !folder.as_os_str().is_empty() => folder,
        _ => Path::new("."),
    };
    fs::create_dir_all(folder)?;
    let mut draft = path.as_os_str().to_owned();
    // A unique name: the id of this process and the time.
    draft.push(format!(
        ".{}-{:x}",
        std::process::id(),
        clock::now().as_ns()
    ));
    let draft = PathBuf::from(draft);
    let written = File::create_new(&draft).and_then(|mut file| {
        file.write_all(&[data_flash::ERASED; data_flash::SIZE])?;
        file.sync_all()?;
        // Does not replace a file that another run has claimed. Some file systems cannot rename
        // without replacing, but support links.
        let renamed = match renameat_with(CWD, &draft, CWD, path, RenameFlags::NOREPLACE) {
            Err(Errno::INVAL) => linkat(CWD, &draft, CWD, path, AtFlags::empty()),
            renamed => renamed,
        };
        match renamed {
            Err(Errno::EXIST) => {}
            renamed => renamed?,
        }
        File::open(folder)?.sync_all()
    });
    // Remove the draft, whether or not it was renamed.
    let _ = fs::remove_file(&draft);
    written
}

#[cfg(test)]
mod tests {
    use super::*;

    fn wait(flash: &HostFlash) -> FlashStatus {
        while flash.status() == FlashStatus::Busy {
            thread::yield_now();
        }
        flash.status()
    }

    #[test]
    fn a_missing_file_is_created_erased_and_keeps_what_is_programmed() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("deep/dflash-A.bin");
        let flash = HostFlash::open(&path).unwrap();
        let mut bytes = [0; 16];
        flash.read(0, &mut bytes).unwrap();
        assert_eq!(bytes, [0xFF; 16]);
        flash.start_program(8, &[1, 2, 3, 4, 5, 6, 7, 8]).unwrap();
        assert_eq!(wait(&flash), FlashStatus::Idle);
        drop(flash);

        let flash = HostFlash::open(&path).unwrap();
        flash.read(0, &mut bytes).unwrap();
        assert_eq!(bytes[..8], [0xFF; 8]);
        assert_eq!(bytes[8..], [1, 2, 3, 4, 5, 6, 7, 8]);
        flash.start_erase(0).unwrap();
        assert_eq!(wait(&flash), FlashStatus::Idle);
        flash.read(0, &mut bytes).unwrap();
        assert_eq!(bytes, [0xFF; 16]);
        assert_eq!(
            fs::read_dir(path.parent().unwrap()).unwrap().count(),
            1,
            "no draft stays"
        );
    }

    #[test]
    fn programming_only_clears_bits() {
        let folder = tempfile::tempdir().unwrap();
        let flash = HostFlash::open(&folder.path().join("f")).unwrap();
        flash.start_program(0, &[0xF0; 8]).unwrap();
        wait(&flash);
        flash.start_program(0, &[0x3C; 8]).unwrap();
        wait(&flash);
        let mut bytes = [0; 8];
        flash.read(0, &mut bytes).unwrap();
        assert_eq!(bytes, [0x30; 8]);
    }

    #[test]
    fn a_file_of_another_size_is_refused_and_untouched() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("notes.txt");
        fs::write(&path, "mine").unwrap();
        let error = HostFlash::open(&path).unwrap_err();
        assert!(error.to_string().contains("has 4 bytes"), "{error}");
        assert_eq!(fs::read(&path).unwrap(), b"mine");
    }

    /// T-RED-1: if several runs start together and a data flash does not exist yet, exactly one of
    /// them gets it.
    #[test]
    fn a_new_data_flash_is_claimed_once() {
        for round in 0..3 {
            let folder = tempfile::tempdir().unwrap();
            let path = folder.path().join("A.dflash");
            let start = std::sync::Barrier::new(8);
            let claims: Vec<_> = thread::scope(|scope| {
                let claim = || {
                    start.wait();
                    HostFlash::claim(&path)
                };
                let all: Vec<_> = (0..8).map(|_| scope.spawn(claim)).collect();
                all.into_iter().map(|one| one.join().unwrap()).collect()
            });
            let granted = claims.iter().filter(|claim| claim.is_ok()).count();
            assert_eq!(granted, 1, "round {round}");
            let files = fs::read_dir(folder.path()).unwrap().count();
            assert_eq!(files, 1, "no draft stays");
        }
    }

    /// A locked file is not the data flash if its name now belongs to another file.
    #[test]
    fn what_was_locked_is_what_the_name_stands_for() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("A.dflash");
        let first = HostFlash::claim(&path).unwrap();
        let renamed = thread::scope(|scope| {
            // The second claim opens the same file as the first and waits for the first's lock.
            let second = scope.spawn(|| HostFlash::claim(&path));
            thread::sleep(Duration::from_millis(100));
            fs::remove_file(&path).unwrap();
            HostFlash::prepare(&path).unwrap();
            drop(first);
            second.join().unwrap()
        });
        let second = renamed.unwrap();
        let there = fs::metadata(&path).unwrap();
        assert_eq!(second._lock.metadata().unwrap().ino(), there.ino());
    }

    /// T-RED-1: a second run on the machine does not overwrite the state of the first.
    #[test]
    fn a_data_flash_belongs_to_one_system() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("A.dflash");
        let _claimed = HostFlash::claim(&path).unwrap();
        let error = HostFlash::claim(&path).unwrap_err();
        assert!(matches!(error, FlashFileError::InUse { .. }), "{error}");
        // The cores of its system can still open it.
        HostFlash::open(&path).unwrap();
    }
}
