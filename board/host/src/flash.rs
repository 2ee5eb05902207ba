//! Data flash as a file: NOR semantics, programmed in the background, durable when idle again.

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

use crate::clock;

const PAGE: u64 = HostFlash::PAGE_BYTES as u64;
const SECTOR: u64 = HostFlash::SECTOR_BYTES as u64;
const SIZE: u64 = SECTOR * HostFlash::SECTORS as u64;
const ERASED: u8 = 0xFF;

const IDLE: u8 = 0;
const BUSY: u8 = 1;
const FAILED: u8 = 2;

/// How long a start waits for a taken file. A process that was killed keeps it until the kernel has
/// taken its memory back, some milliseconds after it has left the list of processes.
const LAST_OWNER_ENDS: Duration = Duration::from_secs(1);

/// Why the file cannot be the data flash.
#[derive(Debug, thiserror::Error)]
pub enum FlashFileError {
    /// It cannot be created, read or written.
    #[error("data flash {path}: {source}")]
    Io {
        /// The file.
        path: PathBuf,
        /// What the operating system said.
        source: io::Error,
    },
    /// It is another kind of file.
    #[error("data flash {path} has {found} bytes, but a data flash has {SIZE}; name another file")]
    Size {
        /// The file.
        path: PathBuf,
        /// Its size in bytes.
        found: u64,
    },
    /// Another system has it.
    #[error("data flash {path} is in use by another system; end that run or name another file")]
    InUse {
        /// The file.
        path: PathBuf,
    },
}

/// The data flash of one system, for as long as this or any process started meanwhile lives: two
/// systems that write one flash would each destroy what the other has written.
#[derive(Debug)]
pub(crate) struct Claimed {
    _lock: File,
}

/// The data flash of a system in a file.
///
/// A background thread does what was started and calls `fdatasync`, so that "idle" means durable.
/// The death of the process at any time leaves in the range of the operation what NOR flash leaves
/// there: any mixture of old and new.
///
/// To start an operation allocates nothing and makes one system call, which wakes the thread. The
/// thread has a lower priority than the core, so the two share no lock at the same time.
#[derive(Debug)]
pub struct HostFlash {
    device: Arc<Device>,
    worker: Thread,
}

#[derive(Debug)]
struct Device {
    file: File,
    /// [`IDLE`], [`BUSY`] or [`FAILED`]. Who sets it to `BUSY` owns `operation` until the thread
    /// sets it to another value.
    status: AtomicU8,
    /// Never waited for: see `status`.
    operation: Mutex<Operation>,
    /// The operation is complete; the thread clears it when it begins.
    requested: AtomicBool,
    /// The flash was dropped; the thread ends.
    closed: AtomicBool,
}

#[derive(Debug)]
struct Operation {
    at: u64,
    length: usize,
    erases: bool,
    data: [u8; SECTOR as usize],
}

impl HostFlash {
    /// Creates the file, erased, if there is none; checks it otherwise.
    ///
    /// # Errors
    /// [`FlashFileError`] if it cannot be created or has a wrong size.
    pub fn prepare(path: &Path) -> Result<(), FlashFileError> {
        let failed = |source| FlashFileError::Io {
            path: path.to_owned(),
            source,
        };
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

    /// Prepares the file and takes it for one system of the calling process's run.
    ///
    /// # Errors
    /// [`FlashFileError`], among them that it is taken.
    pub(crate) fn claim(path: &Path) -> Result<Claimed, FlashFileError> {
        let failed = |source| FlashFileError::Io {
            path: path.to_owned(),
            source,
        };
        let deadline = Instant::now() + LAST_OWNER_ENDS;
        loop {
            Self::prepare(path)?;
            let file = OpenOptions::new()
                .read(true)
                .write(true)
                .open(path)
                .map_err(failed)?;
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
            // The name may stand for another file by now: whoever opens it would lock that one.
            let locked = file.metadata().map_err(failed)?;
            let named = fs::metadata(path);
            if !named.is_ok_and(|named| (named.dev(), named.ino()) == (locked.dev(), locked.ino()))
            {
                continue;
            }
            // The children inherit it, and with it the lock: a launcher may die before its run.
            fcntl_setfd(&file, FdFlags::empty()).map_err(|errno| failed(errno.into()))?;
            return Ok(Claimed { _lock: file });
        }
    }

    /// Opens the data flash and starts its background thread.
    ///
    /// # Errors
    /// [`FlashFileError`] if the file cannot be opened or created, or has a wrong size.
    pub fn open(path: &Path) -> Result<Self, FlashFileError> {
        Self::prepare(path)?;
        let failed = |source| FlashFileError::Io {
            path: path.to_owned(),
            source,
        };
        let file = OpenOptions::new()
            .read(true)
            .write(true)
            .open(path)
            .map_err(failed)?;
        let device = Arc::new(Device {
            file,
            status: AtomicU8::new(IDLE),
            operation: Mutex::new(Operation {
                at: 0,
                length: 0,
                erases: false,
                data: [ERASED; SECTOR as usize],
            }),
            requested: AtomicBool::new(false),
            closed: AtomicBool::new(false),
        });
        let its = Arc::clone(&device);
        let worker = thread::Builder::new()
            .name("data flash".to_owned())
            .spawn(move || its.work())
            .map_err(failed)?;
        Ok(Self {
            device,
            worker: worker.thread().clone(),
        })
    }

    /// Starts an operation that `fill` completes.
    fn begin(&self, fill: impl FnOnce(&mut Operation)) -> Result<(), FlashError> {
        let Device {
            status,
            operation,
            requested,
            ..
        } = &*self.device;
        // Acquire pairs with the release in `Device::work`: the thread is done with the operation.
        if status.swap(BUSY, Ordering::AcqRel) == BUSY {
            return Err(FlashError::Busy);
        }
        fill(&mut operation.lock().unwrap_or_else(PoisonError::into_inner));
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
    /// The life of the background thread.
    fn work(&self) {
        // What programming reads back, kept for its memory.
        let mut present = [ERASED; SECTOR as usize];
        loop {
            // Acquire pairs with the store in `HostFlash::begin`.
            if self.requested.swap(false, Ordering::Acquire) {
                let operation = self.operation.lock();
                let operation = operation.unwrap_or_else(PoisonError::into_inner);
                let done = carry_out(&self.file, &operation, &mut present);
                drop(operation);
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
    fn read(&self, offset: u32, into: &mut [u8]) -> Result<(), FlashError> {
        if self.device.status.load(Ordering::Acquire) == BUSY {
            return Err(FlashError::Busy);
        }
        check(u64::from(offset), into.len())?;
        self.device
            .file
            .read_exact_at(into, u64::from(offset))
            .map_err(|_| FlashError::Failed)
    }

    fn start_erase(&self, sector: u32) -> Result<(), FlashError> {
        if sector >= Self::SECTORS {
            return Err(FlashError::OutOfRange);
        }
        self.begin(|operation| {
            operation.at = u64::from(sector) * SECTOR;
            operation.length = SECTOR as usize;
            operation.erases = true;
        })
    }

    fn start_program(&self, offset: u32, data: &[u8]) -> Result<(), FlashError> {
        let at = u64::from(offset);
        check(at, data.len())?;
        let length = data.len() as u64;
        let in_one_sector = length > 0 && at / SECTOR == (at + length - 1) / SECTOR;
        if !in_one_sector || !at.is_multiple_of(PAGE) || !length.is_multiple_of(PAGE) {
            return Err(FlashError::OutOfRange);
        }
        self.begin(|operation| {
            operation.at = at;
            operation.length = data.len();
            operation.erases = false;
            operation.data[..data.len()].copy_from_slice(data);
        })
    }

    fn status(&self) -> FlashStatus {
        match self.device.status.load(Ordering::Acquire) {
            IDLE => FlashStatus::Idle,
            BUSY => FlashStatus::Busy,
            _ => FlashStatus::Failed,
        }
    }
}

fn check(at: u64, length: usize) -> Result<(), FlashError> {
    if at + length as u64 > SIZE {
        Err(FlashError::OutOfRange)
    } else {
        Ok(())
    }
}

fn carry_out(file: &File, operation: &Operation, present: &mut [u8]) -> io::Result<()> {
    let Operation {
        at, length, erases, ..
    } = *operation;
    let present = &mut present[..length];
    if erases {
        present.fill(ERASED);
    } else {
        file.read_exact_at(present, at)?;
        // NOR flash: programming only clears bits.
        for (old, new) in present.iter_mut().zip(&operation.data) {
            *old &= new;
        }
    }
    file.write_all_at(present, at)?;
    file.sync_data()
}

/// Creates the file whole or not at all, whenever the power goes; leaves one that another process
/// has created at the same time.
fn create(path: &Path) -> io::Result<()> {
    let folder = match path.parent() {
        Some(folder) if !folder.as_os_str().is_empty() => folder,
        _ => Path::new("."),
    };
    fs::create_dir_all(folder)?;
    let mut draft = path.as_os_str().to_owned();
    // Nobody else's: of this process, and of this moment in it.
    draft.push(format!(
        ".{}-{:x}",
        std::process::id(),
        clock::now().as_ns()
    ));
    let draft = PathBuf::from(draft);
    let written = File::create_new(&draft).and_then(|mut file| {
        file.write_all(&[ERASED; SIZE as usize])?;
        file.sync_all()?;
        // Never in the place of a file that another run has claimed. Not every file system can
        // rename so; those have links.
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
    // Renamed or not.
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
    fn ranges_are_checked() {
        let folder = tempfile::tempdir().unwrap();
        let flash = HostFlash::open(&folder.path().join("f")).unwrap();
        let refused = Err(FlashError::OutOfRange);
        assert_eq!(flash.start_erase(HostFlash::SECTORS), refused);
        assert_eq!(flash.start_program(4, &[0; 8]), refused, "not aligned");
        assert_eq!(flash.start_program(0, &[0; 7]), refused, "not a page");
        assert_eq!(flash.start_program(0, &[]), refused, "nothing");
        assert_eq!(
            flash.start_program(HostFlash::SECTOR_BYTES - 8, &[0; 16]),
            refused,
            "across"
        );
        assert_eq!(
            flash.start_program(SIZE as u32, &[0; 8]),
            refused,
            "outside"
        );
        assert_eq!(
            flash.start_program(u32::MAX - 7, &[0; 8]),
            refused,
            "far outside"
        );
        assert_eq!(flash.read(SIZE as u32 - 1, &mut [0; 2]), refused);
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

    /// T-RED-1: two runs that start at the same time, with a data flash that is not there yet: one
    /// of them gets it.
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

    /// A file whose name was given to another one while it was locked is not the data flash.
    #[test]
    fn what_was_locked_is_what_the_name_stands_for() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("A.dflash");
        let first = HostFlash::claim(&path).unwrap();
        let renamed = thread::scope(|scope| {
            // It waits for the first one's lock, with the first one's file open.
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

    /// T-RED-1: a run beside another does not write over its state.
    #[test]
    fn a_data_flash_belongs_to_one_system() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("A.dflash");
        let _claimed = HostFlash::claim(&path).unwrap();
        let error = HostFlash::claim(&path).unwrap_err();
        assert!(matches!(error, FlashFileError::InUse { .. }), "{error}");
        // Its cores open it all the same.
        HostFlash::open(&path).unwrap();
    }
}
