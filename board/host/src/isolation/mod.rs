//! Chooses the place of a run's files so that no file is left behind, however the run ends.
//!
//! If permitted, the run gets a mount namespace with a private `/dev/shm`: when its last process
//! has died, in any way, the kernel removes all files. If not (as in most containers), the files
//! are in the machine's `/dev/shm` under the run's name, next to a lock file that all processes of
//! the run hold open. The run removes them at its end. Every start also removes the files of runs
//! whose processes are all dead: their lock is free.
//!
//! An ordinary user also needs a user namespace, which has two costs:
//!
//! - A process that has entered a user namespace cannot return to its old identity if the kernel
//!   refuses the next step. So a child tries all steps first, and the process itself takes them
//!   only if the child succeeds.
//! - In a user namespace, capabilities do not permit real time. So a process with a capability for
//!   real time (`CAP_SYS_NICE`, `CAP_IPC_LOCK`) enters no user namespace and uses the machine's
//!   `/dev/shm`. A limit on priorities (`RLIMIT_RTPRIO`) is also valid in a user namespace.

mod namespace;

use core::fmt;
use std::ffi::OsStr;
use std::io;
use std::os::fd::OwnedFd;
use std::os::unix::ffi::OsStrExt;
use std::path::Path;

use rustix::fs::{
    AtFlags, CWD, Dir, FlockOperation, Mode as FileMode, OFlags, flock, fstat, openat, statat,
    statvfs, unlinkat,
};
use rustix::io::{Errno, FdFlags, fcntl_setfd};

use crate::name::RunName;
use crate::process_list;

const SHM: &str = "/dev/shm";
const TMP: &str = "/tmp";
const LOCK_SUFFIX: &str = ".lock";

/// No place with shared memory is available for a run.
#[derive(Debug, thiserror::Error)]
#[error("{place}: {source}; shared memory is needed, so /dev/shm must be mounted and writable")]
pub struct IsolationError {
    place: String,
    source: io::Error,
}

/// The place of a run's files. The launcher owns it.
#[derive(Debug)]
pub struct Isolation {
    run: RunName,
    place: Place,
    /// The machine's `/dev/shm` and `/tmp`, opened before the namespace was entered.
    outside: [OwnedFd; 2],
}

#[derive(Debug)]
enum Place {
    /// The run's private `/dev/shm`.
    Private,
    /// The machine's `/dev/shm`.
    Shared {
        /// Every process of the run holds this descriptor open, so the lock becomes free only when
        /// all of them have ended.
        _lock: OwnedFd,
        refused: String,
    },
}

#[derive(Clone, Copy)]
enum Mode {
    Own,
    Shared,
}

/// Gives the calling process, and all processes that it starts, a place for the files of a new run:
/// a private `/dev/shm` if that is permitted.
///
/// Call it before the process starts threads.
///
/// # Errors
/// [`IsolationError`] if there is no usable `/dev/shm`.
pub fn enter() -> Result<Isolation, IsolationError> {
    enter_with(Mode::Own)
}

/// Like [`enter`], but uses the machine's `/dev/shm` even if a private one is permitted.
///
/// # Errors
/// [`IsolationError`] if there is no usable `/dev/shm`.
pub fn enter_shared() -> Result<Isolation, IsolationError> {
    enter_with(Mode::Shared)
}

fn enter_with(mode: Mode) -> Result<Isolation, IsolationError> {
    let run = RunName::unique();
    let outside = [open_folder(SHM)?, open_folder(TMP)?];
    sweep(&outside[0]);
    let refused = match mode {
        Mode::Shared => Some("not asked for".to_owned()),
        Mode::Own => namespace::enter().map_err(|source| IsolationError {
            place: "a mount namespace".to_owned(),
            source,
        })?,
    };
    let place = match refused {
        None => Place::Private,
        Some(refused) => {
            let lock = lock(&outside[0], &run)?;
            Place::Shared {
                _lock: lock,
                refused,
            }
        }
    };
    Ok(Isolation {
        run,
        place,
        outside,
    })
}

impl Isolation {
    /// Returns the run of this place.
    #[must_use]
    pub const fn run(&self) -> &RunName {
        &self.run
    }

    /// Removes the files of the run. All its processes must have ended.
    pub fn wipe(&self) {
        match self.place {
            Place::Private => {
                // The files disappear with the namespace; this only frees the memory earlier.
                if let Ok(folder) = open_folder(SHM) {
                    remove(&folder, self.run.as_str());
                }
            }
            Place::Shared { .. } => remove(&self.outside[0], self.run.as_str()),
        }
    }

    /// Returns the files of this run in the machine's `/dev/shm` and `/tmp`.
    #[must_use]
    pub fn leftovers(&self) -> Vec<String> {
        let mut found = vec![];
        for (folder, path) in self.outside.iter().zip([SHM, TMP]) {
            // Each file name of a run contains the run's name.
            let own = names(folder).filter(|name| name.contains(self.run.as_str()));
            found.extend(own.map(|name| format!("{path}/{name}")));
        }
        found
    }
}

impl fmt::Display for Isolation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match &self.place {
            Place::Private => f.write_str("own /dev/shm (a mount namespace)"),
            Place::Shared { refused, .. } => {
                write!(
                    f,
                    "shared /dev/shm under {} (no namespace: {refused})",
                    self.run
                )
            }
        }
    }
}

/// Returns how many bytes this process may still write to the file system of `path`; `None` if the
/// kernel does not report it.
#[must_use]
pub fn free_bytes(path: &Path) -> Option<u64> {
    let found = statvfs(path).ok()?;
    Some(found.f_bavail.saturating_mul(found.f_frsize))
}

fn open_folder(path: &str) -> Result<OwnedFd, IsolationError> {
    openat(
        CWD,
        path,
        OFlags::RDONLY | OFlags::DIRECTORY | OFlags::CLOEXEC,
        FileMode::empty(),
    )
    .map_err(|errno| IsolationError {
        place: path.to_owned(),
        source: errno.into(),
    })
}

/// Creates the run's lock file and locks it for this process and all its children.
fn lock(shm: &OwnedFd, run: &RunName) -> Result<OwnedFd, IsolationError> {
    let name = format!("{run}{LOCK_SUFFIX}");
    let failed = |errno: Errno| IsolationError {
        place: format!("{SHM}/{name}"),
        source: errno.into(),
    };
    loop {
        let flags = OFlags::CREATE | OFlags::RDWR | OFlags::CLOEXEC;
        let file =
            openat(shm, name.as_str(), flags, FileMode::RUSR | FileMode::WUSR).map_err(failed)?;
        // A sweep may have locked the file since then and be about to remove it: wait for its end.
        match flock(&file, FlockOperation::LockExclusive) {
            Err(Errno::INTR) => continue,
            locked => locked.map_err(failed)?,
        }
        let mine = fstat(&file).map_err(failed)?;
        let there = statat(shm, name.as_str(), AtFlags::SYMLINK_NOFOLLOW);
        if there.is_ok_and(|there| there.st_ino == mine.st_ino) {
            // The children inherit the descriptor and thus the lock.
            fcntl_setfd(&file, FdFlags::empty()).map_err(failed)?;
            return Ok(file);
        }
    }
}

/// Removes the files of runs whose processes are all dead.
fn sweep(shm: &OwnedFd) {
    for name in names(shm) {
        let Some(run) = name.strip_suffix(LOCK_SUFFIX) else {
            continue;
        };
        let Ok(run) = run.parse::<RunName>() else {
            continue;
        };
        let Ok(file) = openat(
            shm,
            &*name,
            OFlags::RDWR | OFlags::CLOEXEC,
            FileMode::empty(),
        ) else {
            continue;
        };
        if is_dead(&file, &run) {
            remove(shm, run.as_str());
        }
    }
}

/// Tests whether no process of the run holds its lock. The kernel takes a killed process off the
/// list of processes some milliseconds before it frees the lock, so this waits for the lock.
fn is_dead(lock: &OwnedFd, run: &RunName) -> bool {
    let is_free = || flock(lock, FlockOperation::NonBlockingLockExclusive).is_ok();
    let is_free_later = || {
        std::thread::sleep(std::time::Duration::from_millis(1));
        is_free()
    };
    is_free() || process_list::of_run(run).is_empty() && (0..50).any(|_| is_free_later())
}

/// Removes all files of a run, its lock file last: while it exists, a sweep finds the other files.
fn remove(folder: &OwnedFd, run: &str) {
    let lock = format!("{run}{LOCK_SUFFIX}");
    let own = |name: &String| {
        let rest = name.strip_prefix(run);
        rest.is_some_and(|rest| rest.starts_with(['_', '.'])) && *name != lock
    };
    for name in names(folder).filter(own) {
        let _ = unlinkat(folder, &*name, AtFlags::empty());
    }
    let _ = unlinkat(folder, lock.as_str(), AtFlags::empty());
}

fn names(folder: &OwnedFd) -> impl Iterator<Item = String> {
    let entries = Dir::read_from(folder).into_iter().flatten().flatten();
    entries.map(|entry| {
        let name = OsStr::from_bytes(entry.file_name().to_bytes());
        name.to_string_lossy().into_owned()
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs;

    /// If the sweep of another run has locked the lock file first, a start waits for that sweep.
    #[test]
    fn a_sweep_beside_a_start_is_waited_for() {
        let folder = tempfile::tempdir().unwrap();
        let shm = open_folder(folder.path().to_str().unwrap()).unwrap();
        let run = RunName::unique();
        let path = folder.path().join(format!("{run}{LOCK_SUFFIX}"));
        let other = fs::File::create(&path).unwrap();
        flock(&other, FlockOperation::NonBlockingLockExclusive).unwrap();
        let sweep = std::thread::spawn(move || {
            std::thread::sleep(std::time::Duration::from_millis(100));
            fs::remove_file(&path).unwrap();
            drop(other);
            path
        });
        let _lock = lock(&shm, &run).unwrap();
        assert!(
            sweep.join().unwrap().exists(),
            "the lock is held on a file that is there"
        );
    }
}
