//! Starts, watches and kills processes.

use core::fmt;
use std::io;
use std::os::fd::{AsFd as _, BorrowedFd, OwnedFd};
use std::os::unix::process::CommandExt;
use std::process::{Child, Command};
use std::sync::Arc;

use rustix::fs::{Gid, Uid};
use rustix::io::{Errno, FdFlags, fcntl_setfd};
use rustix::pipe::{PipeFlags, pipe_with};
use rustix::process::{
    Pid, PidfdFlags, Resource, Rlimit, Signal, getpid, getppid, getrlimit, kill_process,
    kill_process_group, pidfd_open, set_parent_process_death_signal, setrlimit,
};
use rustix::thread::{
    CpuSet, sched_setaffinity, set_thread_groups, set_thread_res_gid, set_thread_res_uid,
};
use tandem_board::Duration;

use crate::backplane::Backplane;
use crate::clock;

/// Starts a process that is killed as soon as the calling process dies, in any way.
///
/// The kernel watches the calling *thread*, so that thread must live as long as the new process.
pub(crate) fn spawn_bound(command: &mut Command) -> io::Result<Child> {
    let parent = getpid();
    let tie = move || bind(Signal::KILL, parent);
    // SAFETY: between fork and exec only system calls are made: no allocation, no lock.
    unsafe { command.pre_exec(tie) };
    detach(command).spawn()
}

/// In the child: requests this signal for the end of the thread that has started it.
fn bind(signal: Signal, parent: Pid) -> io::Result<()> {
    set_parent_process_death_signal(Some(signal))?;
    if getppid() == Some(parent) {
        Ok(())
    } else {
        // The parent died between the fork and this line, so the kernel sends no signal. Return an
        // error number, because an error text would need an allocation.
        Err(Errno::SRCH.into())
    }
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

/// What a process gets beside its command.
#[derive(Clone, Debug, Default)]
pub struct Placement {
    /// The CPUs on which it may run.
    pub cpus: Option<Vec<usize>>,
    /// Its policy and priority; the kernel's default without.
    pub scheduling: Option<(RealtimePolicy, u8)>,
    /// Its limits, soft and hard. The hard limit of the caller caps each.
    pub limits: Vec<(Resource, u64)>,
    /// Its user.
    pub uid: Option<u32>,
    /// Its group.
    pub gid: Option<u32>,
    /// Its supplementary groups.
    pub groups: Option<Vec<u32>>,
    /// It inherits all descriptors without close-on-exec, also those that the caller has inherited
    /// itself; otherwise the standard streams and `keep` only.
    pub inherit_all: bool,
    /// Descriptors that it inherits, beside the standard streams.
    pub keep: Vec<Arc<OwnedFd>>,
    /// `cgroup.procs` of the memory group that it joins, open for writing.
    pub memory: Option<Arc<OwnedFd>>,
    /// The signal that it gets when the calling thread has ended, in any way.
    pub when_caller_ends: Option<Signal>,
}

/// A real-time policy.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RealtimePolicy {
    /// `SCHED_FIFO`.
    Fifo,
    /// `SCHED_RR`.
    RoundRobin,
}

/// What a machine may refuse without a harm to safety: the process runs without it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Wish {
    /// The CPUs.
    Cpus,
    /// The policy and priority.
    Scheduling,
    /// A limit.
    Limit,
    /// A memory group.
    Memory,
}

impl Wish {
    const ALL: [Self; 4] = [Self::Cpus, Self::Scheduling, Self::Limit, Self::Memory];
}

impl fmt::Display for Wish {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Cpus => "its CPUs",
            Self::Scheduling => "its scheduling policy and priority",
            Self::Limit => "a limit: the hard limit of the launcher is lower",
            Self::Memory => "a memory group (cgroup v1): its limit is RLIMIT_DATA alone",
        })
    }
}

/// Starts a process in a process group of its own, with this placement. It can outlive the caller.
/// Returns also which wishes the machine did not grant.
///
/// # Errors
/// If the process cannot be started, or user, group or a descriptor cannot be set.
pub fn spawn(command: &mut Command, placement: &Placement) -> io::Result<(Child, Vec<Wish>)> {
    let (told, tell) = pipe_with(PipeFlags::CLOEXEC | PipeFlags::NONBLOCK)?;
    let keep = placement.keep.clone();
    let place = Prepared::of(placement);
    let setup = move || place.apply(tell.as_fd());
    // SAFETY: between fork and exec only system calls are made: no allocation, no lock.
    unsafe { command.pre_exec(setup) };
    let child = detach(command).spawn()?;
    drop(keep);
    // The child has written before it executed the program, and `spawn` waits for that.
    let mut bytes = [0_u8; 16];
    let count = rustix::io::read(&told, &mut bytes).unwrap_or(0);
    let refused = bytes.iter().take(count);
    let wishes = refused.filter_map(|byte| Wish::ALL.get(usize::from(*byte)).copied());
    Ok((child, wishes.collect()))
}

/// A placement in the form that needs no allocation after the fork.
struct Prepared {
    cpus: Option<CpuSet>,
    scheduling: Option<(libc::c_int, libc::sched_param)>,
    limits: Vec<(Resource, u64)>,
    uid: Option<Uid>,
    gid: Option<Gid>,
    groups: Option<Vec<Gid>>,
    keep: Vec<Arc<OwnedFd>>,
    memory: Option<Arc<OwnedFd>>,
    inherit_all: bool,
    when_caller_ends: Option<(Signal, Pid)>,
}

impl Prepared {
    fn of(placement: &Placement) -> Self {
        let cpus = placement.cpus.as_ref().map(|cpus| {
            let mut set = CpuSet::new();
            // A number that the set cannot hold is a CPU that no machine has.
            let known = cpus.iter().filter(|cpu| **cpu < CpuSet::MAX_CPU);
            known.for_each(|cpu| set.set(*cpu));
            set
        });
        let scheduling = placement.scheduling.map(|(policy, priority)| {
            let policy = match policy {
                RealtimePolicy::Fifo => libc::SCHED_FIFO,
                RealtimePolicy::RoundRobin => libc::SCHED_RR,
            };
            let sched_priority = libc::c_int::from(priority);
            (policy, libc::sched_param { sched_priority })
        });
        let changes_user = placement.uid.is_some() || placement.gid.is_some();
        let groups = placement.groups.clone().or(changes_user.then(Vec::new));
        Self {
            cpus,
            scheduling,
            limits: placement.limits.clone(),
            uid: placement.uid.map(Uid::from_raw),
            gid: placement.gid.map(Gid::from_raw),
            groups: groups.map(|all| all.into_iter().map(Gid::from_raw).collect()),
            keep: placement.keep.clone(),
            memory: placement.memory.clone(),
            inherit_all: placement.inherit_all,
            when_caller_ends: placement.when_caller_ends.map(|it| (it, getpid())),
        }
    }

    /// Runs in the child. Real-time priority and limits come before the user, who may not set them.
    fn apply(&self, tell: BorrowedFd<'_>) -> io::Result<()> {
        let refuse = |wish: Wish| {
            // A full pipe cannot be: there are fewer wishes than it has room.
            let _ = rustix::io::write(tell, &[wish as u8]);
        };
        // Process 0 is the one that writes.
        if let Some(group) = &self.memory
            && rustix::io::write(group, b"0").is_err()
        {
            refuse(Wish::Memory);
        }
        if let Some(cpus) = &self.cpus
            && sched_setaffinity(None, cpus).is_err()
        {
            refuse(Wish::Cpus);
        }
        if let Some((policy, param)) = &self.scheduling {
            // SAFETY: `param` is a valid `sched_param` during the call; 0 means the calling thread.
            let set = unsafe { libc::sched_setscheduler(0, *policy, param) };
            if set != 0 {
                refuse(Wish::Scheduling);
            }
        }
        if !self.limits.iter().all(|limit| set_limit(*limit)) {
            refuse(Wish::Limit);
        }
        if let Some(groups) = &self.groups {
            set_thread_groups(groups)?;
        }
        if let Some(gid) = self.gid {
            set_thread_res_gid(gid, gid, gid)?;
        }
        if let Some(uid) = self.uid {
            set_thread_res_uid(uid, uid, uid)?;
        }
        // A change of the user clears it, so it is set afterwards.
        if let Some((signal, caller)) = self.when_caller_ends {
            bind(signal, caller)?;
        }
        if !self.inherit_all {
            close_others_at_exec();
        }
        for fd in &self.keep {
            fcntl_setfd(fd, FdFlags::empty())?;
        }
        Ok(())
    }
}

/// Makes the program inherit the standard streams only. A descriptor that the caller has inherited
/// itself may lack close-on-exec.
fn close_others_at_exec() {
    const FIRST: libc::c_uint = 3;
    // SAFETY: the call changes flags of descriptors only. A kernel before 5.11 refuses it.
    unsafe {
        libc::syscall(
            libc::SYS_close_range,
            FIRST,
            libc::c_uint::MAX,
            libc::CLOSE_RANGE_CLOEXEC,
        );
    }
}

/// Sets a limit. Returns whether it is the one that was asked for.
fn set_limit((resource, value): (Resource, u64)) -> bool {
    let hard = getrlimit(resource).maximum.unwrap_or(u64::MAX);
    let limit = value.min(hard);
    let new = Rlimit {
        current: Some(limit),
        maximum: Some(limit),
    };
    setrlimit(resource, new).is_ok() && limit == value
}

/// A process of the run, which may be a child of this process.
#[derive(Debug)]
pub struct Watched {
    fd: OwnedFd,
}

impl Watched {
    /// Returns `None` if the process has already ended (and, if it was a child, was waited for).
    #[must_use]
    pub fn new(pid: u32) -> Option<Self> {
        let fd = pidfd_open(self::pid(pid)?, PidfdFlags::empty()).ok()?;
        Some(Self { fd })
    }

    /// Returns a descriptor that becomes readable when the process has ended.
    #[must_use]
    pub fn fd(&self) -> BorrowedFd<'_> {
        self.fd.as_fd()
    }

    /// Returns whether the process has ended. Never blocks.
    #[must_use]
    pub fn has_ended(&self) -> bool {
        clock::wait_for([self.fd()], Duration::ZERO).unwrap_or(false)
    }
}

/// Converts a process id; `None` if the number is not a valid one.
#[must_use]
pub fn pid(number: u32) -> Option<Pid> {
    Pid::from_raw(i32::try_from(number).ok()?)
}

/// Sends a signal to a process. No effect if the process has ended.
pub fn signal(number: u32, signal: Signal) {
    if let Some(pid) = pid(number) {
        let _ = kill_process(pid, signal);
    }
}

/// Kills this process, which must be a child that was not waited for, and its process group. It may
/// have left the group.
pub fn kill_group(leader: u32) {
    if let Some(leader) = pid(leader) {
        let _ = kill_process_group(leader, Signal::KILL);
        let _ = kill_process(leader, Signal::KILL);
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
