//! Where the files of a run live, so that nothing is left behind whatever happens.
//!
//! If permitted, the run gets a mount namespace with a `/dev/shm` of its own: when its last process
//! has died, by whatever means, the kernel removes all of it. If not (as in most containers), the
//! files lie in the machine's `/dev/shm` under the run's name, beside a lock file that all
//! processes of the run hold open. The run wipes them at its end, and every start sweeps what runs
//! left whose processes are all dead, which is when their lock is free.
//!
//! An ordinary user needs a user namespace as well, and that has two costs:
//!
//! - A process that has entered one and is then refused the rest has lost its identity. So a child
//!   goes all the way first, and only if it arrives does the process itself follow.
//! - Capabilities do not count outside of it. A process that holds one for real time
//!   (`CAP_SYS_NICE`, `CAP_IPC_LOCK`) keeps it and uses the machine's `/dev/shm`. A limit on
//!   priorities (`RLIMIT_RTPRIO`) counts everywhere.

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

const SHM: &str = "/dev/shm";
const TMP: &str = "/tmp";
const LOCK_SUFFIX: &str = ".lock";

/// Why a run cannot have shared memory.
#[derive(Debug, thiserror::Error)]
#[error("{place}: {source}; shared memory is needed, so /dev/shm must be mounted and writable")]
pub struct IsolationError {
    place: String,
    source: io::Error,
}

/// The place of a run's files. Held by the launcher.
#[derive(Debug)]
pub struct Isolation {
    run: RunName,
    place: Place,
    /// The machine's `/dev/shm` and `/tmp`, as they are outside.
    outside: [OwnedFd; 2],
}

#[derive(Debug)]
enum Place {
    /// A `/dev/shm` of the run's own.
    Private,
    /// The machine's.
    Shared {
        /// Held open by every process of the run; dropping it here does not free the lock as long
        /// as one lives.
        _lock: OwnedFd,
        refused: String,
    },
}

#[derive(Clone, Copy)]
enum Mode {
    Own,
    Shared,
}

/// Gives the calling process, and all that it starts, a place for the files of a new run: one of
/// its own if that is permitted.
///
/// To be called first thing, before the process has threads.
///
/// # Errors
/// [`IsolationError`] if there is no usable `/dev/shm`.
pub fn enter() -> Result<Isolation, IsolationError> {
    enter_with(Mode::Own)
}

/// As [`enter`], but in the machine's `/dev/shm` even if a place of its own is permitted.
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
    /// The run that lives here.
    #[must_use]
    pub const fn run(&self) -> &RunName {
        &self.run
    }

    /// Whether the kernel removes everything by itself.
    #[must_use]
    pub const fn is_private(&self) -> bool {
        matches!(self.place, Place::Private)
    }

    /// Removes the files of the run. Its processes must have ended.
    pub fn wipe(&self) {
        match self.place {
            Place::Private => {
                // They go with the namespace; this only gives the memory back at once.
                if let Ok(folder) = open_folder(SHM) {
                    remove(&folder, self.run.as_str());
                }
            }
            Place::Shared { .. } => remove(&self.outside[0], self.run.as_str()),
        }
    }

    /// Files of this run in the machine's `/dev/shm` and `/tmp`.
    #[must_use]
    pub fn leftovers(&self) -> Vec<String> {
        let mut found = vec![];
        for (folder, path) in self.outside.iter().zip([SHM, TMP]) {
            // All that a process of the run creates has the run's name in its own.
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

/// Bytes that this process may still write to the file system that holds `path`; `None` if the
/// kernel does not say.
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

/// Creates the run's lock file and takes the lock for this process and all its children.
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
        // A sweep may have locked it in between, and removes it then: that is waited for.
        match flock(&file, FlockOperation::LockExclusive) {
            Err(Errno::INTR) => continue,
            locked => locked.map_err(failed)?,
        }
        let mine = fstat(&file).map_err(failed)?;
        let there = statat(shm, name.as_str(), AtFlags::SYMLINK_NOFOLLOW);
        if there.is_ok_and(|there| there.st_ino == mine.st_ino) {
            // The children inherit it, and with it the lock.
            fcntl_setfd(&file, FdFlags::empty()).map_err(failed)?;
            return Ok(file);
        }
    }
}

/// Removes what runs have left whose processes are all dead.
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
        if flock(&file, FlockOperation::NonBlockingLockExclusive).is_ok() {
            remove(shm, run.as_str());
        }
    }
}

/// Removes all files of a run, its lock file last: as long as that is there, a sweep finds the
/// rest.
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

    /// A run that starts beside this one sweeps, and finds the lock file before it is locked.
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
