//! Starts, watches and kills processes.

use std::io;
use std::os::fd::OwnedFd;
use std::os::unix::process::CommandExt;
use std::process::{Child, Command};

use rustix::io::Errno;
use rustix::process::{
    Pid, PidfdFlags, Signal, getpid, getppid, kill_process, pidfd_open,
    set_parent_process_death_signal,
};
use tandem_board::Duration;

use crate::backplane::Backplane;
use crate::clock;

/// Starts a process that is killed as soon as the calling process dies, in any way.
///
/// The kernel watches the calling *thread*, so that thread must live as long as the new process.
pub(crate) fn spawn_bound(command: &mut Command) -> io::Result<Child> {
    let parent = getpid();
    let tie = move || {
        set_parent_process_death_signal(Some(Signal::KILL))?;
        if getppid() == Some(parent) {
            Ok(())
        } else {
            // The parent died between the fork and this line, so the kernel sends no signal. Return
            // an error number, because an error text would need an allocation.
            Err(Errno::SRCH.into())
        }
    };
    // SAFETY: between fork and exec only system calls are made: no allocation, no lock.
    unsafe { command.pre_exec(tie) };
    detach(command).spawn()
}

/// Makes this process die with its parent, like [`spawn_bound`], but in the child: the binding is
/// lost when a program with file capabilities is executed. Returns `false` if the original parent
/// has died, so that the parent is now a different process.
///
/// The calling thread must live as long as the process.
pub(crate) fn bind_to_parent(parent: u32) -> io::Result<bool> {
    set_parent_process_death_signal(Some(Signal::KILL))?;
    let found = getppid().map(|pid| pid.as_raw_nonzero().get().unsigned_abs());
    Ok(found == Some(parent))
}

/// Starts a process that can outlive the calling process.
pub(crate) fn spawn_free(command: &mut Command) -> io::Result<Child> {
    detach(command).spawn()
}

/// Detaches a process from Ctrl-C, which must reach only the launcher: it ends the run in order.
fn detach(command: &mut Command) -> &mut Command {
    command.process_group(0)
}

/// A process of the run, which may be a child of this process.
#[derive(Debug)]
pub(crate) struct Watched {
    fd: OwnedFd,
}

impl Watched {
    /// Returns `None` if the process has already ended (and, if it was a child, was waited for).
    pub(crate) fn new(pid: u32) -> Option<Self> {
        let fd = pidfd_open(self::pid(pid)?, PidfdFlags::empty()).ok()?;
        Some(Self { fd })
    }

    /// Returns a descriptor that becomes readable when the process has ended.
    pub(crate) const fn fd(&self) -> &OwnedFd {
        &self.fd
    }

    /// Returns whether the process has ended. Never blocks.
    pub(crate) fn has_ended(&self) -> bool {
        let mut fds = [rustix::event::PollFd::new(
            &self.fd,
            rustix::event::PollFlags::IN,
        )];
        let now = rustix::time::Timespec {
            tv_sec: 0,
            tv_nsec: 0,
        };
        rustix::event::poll(&mut fds, Some(&now)).is_ok_and(|ready| ready > 0)
    }
}

/// Converts a process id; `None` if the number is not a valid one.
pub(crate) fn pid(number: u32) -> Option<Pid> {
    Pid::from_raw(i32::try_from(number).ok()?)
}

/// Sends a signal to a process. No effect if the process has ended.
pub(crate) fn signal(number: u32, signal: Signal) {
    if let Some(pid) = pid(number) {
        let _ = kill_process(pid, signal);
    }
}

/// Waits until all processes of the run are known. Returns `false` if the launcher died first.
pub(crate) fn wait_until_assembled(backplane: Backplane) -> bool {
    let launcher = Watched::new(backplane.launcher_pid());
    while !backplane.is_assembled() {
        if launcher.as_ref().is_none_or(Watched::has_ended) {
            return backplane.is_assembled();
        }
        clock::sleep_until(clock::now() + Duration::from_ms(1));
    }
    true
}
