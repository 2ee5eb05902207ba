//! Enters a mount namespace with a new `/dev/shm`, either completely or not at all.

use core::ffi::CStr;
use std::ffi::CString;
use std::fmt;
use std::io::{self, Read as _};
use std::os::fd::AsFd as _;
use std::os::unix::net::UnixStream;

use rustix::fs::{CWD, Mode, OFlags, openat};
use rustix::io::{Errno, write};
use rustix::mount::{MountFlags, MountPropagationFlags, mount, mount_change};
use rustix::process::{Pid, WaitOptions, getegid, geteuid, waitpid};
use rustix::thread::{CapabilitySet, UnshareFlags, capabilities, unshare_unsafe};

/// The steps, in the order in which they are taken.
#[derive(Clone, Copy, Debug)]
enum Step {
    /// If this step is refused, the process is unchanged.
    Namespace,
    SetGroups,
    UserMap,
    GroupMap,
    Private,
    Mount,
}

impl Step {
    const ALL: [Self; 6] = [
        Self::Namespace,
        Self::SetGroups,
        Self::UserMap,
        Self::GroupMap,
        Self::Private,
        Self::Mount,
    ];
}

impl fmt::Display for Step {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Namespace => "unshare",
            Self::SetGroups => "setgroups",
            Self::UserMap => "uid_map",
            Self::GroupMap => "gid_map",
            Self::Private => "private mounts",
            Self::Mount => "mount",
        })
    }
}

/// A step that the kernel refused.
#[derive(Clone, Copy, Debug)]
struct Refused {
    step: Step,
    errno: Errno,
}

impl fmt::Display for Refused {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}: {}", self.step, self.errno)
    }
}

/// Enters a mount namespace that has a new `/dev/shm`. If the kernel refuses a step, returns `Some`
/// with that step, and the calling process is unchanged.
///
/// # Errors
/// If no child can be started, or the kernel refuses the process a step that it granted to the
/// child. In the second case the process may be only partly in a namespace, and must end.
pub(super) fn enter() -> io::Result<Option<String>> {
    let way = Way::of_this_process();
    match way.rehearse()? {
        Some(refused) => Ok(Some(refused.to_string())),
        None => match way.go() {
            Ok(()) => Ok(None),
            Err(refused) => Err(io::Error::other(refused.to_string())),
        },
    }
}

/// The data for all steps, prepared in advance, because the child of a process with threads must
/// not allocate.
struct Way {
    may_enter_user_namespace: bool,
    users: CString,
    groups: CString,
}

impl Way {
    fn of_this_process() -> Self {
        // Read before the steps. The ids are mapped to themselves, so the files keep their owner.
        let map = |id: u32| CString::new(format!("{id} {id} 1")).unwrap_or_default();
        let for_realtime = CapabilitySet::SYS_NICE | CapabilitySet::IPC_LOCK;
        let held = capabilities(None).map(|sets| sets.effective);
        Self {
            may_enter_user_namespace: held.is_ok_and(|held| !held.intersects(for_realtime)),
            users: map(geteuid().as_raw()),
            groups: map(getegid().as_raw()),
        }
    }

    /// Makes a child try all steps and end; returns the step that the kernel refused, if any.
    fn rehearse(&self) -> io::Result<Option<Refused>> {
        let (mut reader, tells) = UnixStream::pair()?;
        // SAFETY: the child allocates nothing and takes no lock: it makes system calls and ends.
        let child = match unsafe { libc::fork() } {
            -1 => return Err(io::Error::last_os_error()),
            0 => {
                if let Err(refused) = self.go() {
                    let errno = refused.errno.raw_os_error() as u8;
                    let _ = write(tells.as_fd(), &[refused.step as u8, errno]);
                }
                // SAFETY: ends the process without running the parent's exit handlers.
                unsafe { libc::_exit(0) }
            }
            child => child,
        };
        drop(tells);
        let mut said = vec![];
        reader.read_to_end(&mut said)?;
        while matches!(
            waitpid(Pid::from_raw(child), WaitOptions::empty()),
            Err(Errno::INTR)
        ) {}
        Ok(match said[..] {
            [step, errno] => Some(Refused {
                step: Step::ALL[usize::from(step) % Step::ALL.len()],
                errno: Errno::from_raw_os_error(errno.into()),
            }),
            _ => None,
        })
    }

    fn go(&self) -> Result<(), Refused> {
        let refused = |step| move |errno| Refused { step, errno };
        if let Err(errno) = unshare(UnshareFlags::NEWNS) {
            if !self.may_enter_user_namespace {
                return Err(refused(Step::Namespace)(errno));
            }
            unshare(UnshareFlags::NEWNS | UnshareFlags::NEWUSER)
                .map_err(refused(Step::Namespace))?;
            set(c"/proc/self/setgroups", c"deny").map_err(refused(Step::SetGroups))?;
            set(c"/proc/self/uid_map", &self.users).map_err(refused(Step::UserMap))?;
            set(c"/proc/self/gid_map", &self.groups).map_err(refused(Step::GroupMap))?;
        }
        let private = MountPropagationFlags::PRIVATE | MountPropagationFlags::REC;
        mount_change(c"/", private).map_err(refused(Step::Private))?;
        let flags = MountFlags::NOSUID | MountFlags::NODEV;
        // No `size` option: the default, half of RAM, leaves enough space for long logs.
        mount(c"tmpfs", c"/dev/shm", c"tmpfs", flags, c"mode=1777").map_err(refused(Step::Mount))
    }
}

fn unshare(flags: UnshareFlags) -> rustix::io::Result<()> {
    // SAFETY: `unshare` is unsafe because threads may stop sharing their table of file descriptors
    // (CLONE_FILES); that flag is not set here.
    unsafe { unshare_unsafe(flags) }
}

fn set(file: &CStr, text: &CStr) -> rustix::io::Result<()> {
    let file = openat(CWD, file, OFlags::WRONLY | OFlags::CLOEXEC, Mode::empty())?;
    write(&file, text.to_bytes()).map(drop)
}
