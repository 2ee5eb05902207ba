//! The processes of the manifest, as children of the launcher.

use std::error::Error;
use std::fs::File;
use std::io;
use std::os::fd::BorrowedFd;
use std::os::unix::process::ExitStatusExt as _;
use std::path::PathBuf;
use std::process::{Child, Command, Stdio};
use std::sync::Arc;

use rustix::io::Errno;
use rustix::process::{Resource, Signal, kill_process_group};
use tandem_board_host::spawn::{self, Placement, RealtimePolicy, Watched, Wish};

use super::descendants::{self, MARK};
use super::group::MemoryGroups;
use super::{SocketNames, Unrecoverable, system};
use crate::manifest::{Manifest, ProcessPlan, ResourceLimits, SchedulingPolicy};
use crate::report::{CONTROL_SOCKET, NOTIFY_SOCKET};
use crate::supervisor::ExitKind;
use crate::trust::Platform;

/// The path for programs that a process starts; deterministic.
const PATH: &str = "/usr/local/bin:/usr/bin:/bin:/usr/local/sbin:/usr/sbin:/sbin";

/// What is told if memory is limited by `setrlimit` alone.
const NO_MEMORY_GROUP: &str = "a memory group (cgroup v1): its limit is RLIMIT_DATA alone";

#[derive(Debug)]
pub(super) struct Children {
    manifest: Arc<Manifest>,
    platform: Platform,
    folder: PathBuf,
    names: SocketNames,
    running: Vec<Option<Running>>,
    status: Vec<String>,
    /// A guardian handles what is left when the launcher dies.
    guarded: bool,
    memory: Option<MemoryGroups>,
}

#[derive(Debug)]
struct Running {
    child: Child,
    watched: Watched,
}

/// A process that was started: its id, and what was not granted. Or why it was not started.
type Start = Result<(u32, Vec<&'static str>, Option<String>), String>;

impl Children {
    pub(super) fn new(
        manifest: Arc<Manifest>,
        platform: Platform,
        folder: PathBuf,
        names: &SocketNames,
        guarded: bool,
    ) -> Self {
        let count = manifest.processes.len();
        Self {
            manifest,
            platform,
            folder,
            names: names.clone(),
            running: (0..count).map(|_| None).collect(),
            status: vec![String::new(); count],
            guarded,
            memory: MemoryGroups::named(&names.control),
        }
    }

    /// Starts a process. A refusal of the program is an error of the process; an operating system
    /// that has no process or descriptor left is unrecoverable.
    pub(super) fn start(&mut self, at: usize) -> Result<Start, Unrecoverable> {
        let manifest = Arc::clone(&self.manifest);
        let Some(plan) = manifest.processes.get(at) else {
            return Ok(Err("no such process".to_owned()));
        };
        let mut trusted = match self.platform.command(&plan.program) {
            Ok(trusted) => trusted,
            Err(error) => return refused(&error, error.to_string()),
        };
        trusted.command.env_clear().env("PATH", PATH);
        for (name, value) in &plan.environment {
            if let Err(error) = trusted.set(name, value.as_ref()) {
                return refused(&error, error.to_string());
            }
        }
        let unchecked = trusted.warning.take();
        let mut command = trusted.command;
        command.args(&plan.arguments);
        if plan.reports() {
            command.env(NOTIFY_SOCKET, format!("@{}", self.names.notify));
        }
        if plan.state_management {
            command.env(CONTROL_SOCKET, format!("@{}", self.names.control));
        }
        command.env(MARK, plan.name());
        command.current_dir(self.folder.join(&plan.directory));
        command.stdin(Stdio::null());
        let mut placement = placement(plan);
        placement.keep = trusted.keep;
        placement.when_caller_ends = (!self.guarded).then_some(Signal::TERM);
        if let Err(error) = self.set_output(plan, &mut command) {
            return refused(&error, format!("its output: {error}"));
        }
        let mut refusals = vec![];
        if let Some(bytes) = plan.limits.memory {
            match self
                .memory
                .as_ref()
                .map(|groups| groups.make(plan.name(), bytes))
            {
                Some(Ok(group)) => placement.join.push(Arc::new(group)),
                _ => refusals.push(NO_MEMORY_GROUP),
            }
        }
        let (child, wishes) = match spawn::spawn(&mut command, &placement) {
            Ok(started) => started,
            Err(error) => {
                let program = plan.program.display();
                return refused(&error, format!("{program}: {error}"));
            }
        };
        let pid = child.id();
        // The child is not waited for yet, so it has a descriptor, unless there is none left.
        let watched = Watched::new(pid).ok_or_else(|| io::Error::from(Errno::MFILE));
        let watched = watched.map_err(system("a descriptor of a process"))?;
        if let Some(place) = self.running.get_mut(at) {
            *place = Some(Running { child, watched });
        }
        refusals.extend(wishes.into_iter().map(in_words));
        Ok(Ok((pid, refusals, unchecked)))
    }

    /// Leads standard output and standard error to the file of the manifest.
    fn set_output(&self, plan: &ProcessPlan, command: &mut Command) -> io::Result<()> {
        if let Some(file) = &plan.output {
            let mut options = File::options();
            let file = options
                .append(true)
                .create(true)
                .open(self.folder.join(file))?;
            command.stdout(file.try_clone()?).stderr(file);
        }
        Ok(())
    }

    pub(super) fn fds(&self) -> impl Iterator<Item = BorrowedFd<'_>> {
        use std::os::fd::AsFd as _;
        let running = self.running.iter().flatten();
        running.map(|running| running.watched.fd().as_fd())
    }

    /// Returns the processes that have ended, and kills what they have left.
    pub(super) fn take_ended(&mut self) -> Vec<(usize, ExitKind)> {
        let mut ended = vec![];
        for at in 0..self.running.len() {
            let Some(running) = self.running.get_mut(at).and_then(Option::as_mut) else {
                continue;
            };
            if !running.watched.has_ended() {
                continue;
            }
            // Before it is waited for: until then the number of its group is not used again.
            kill_group(&running.child);
            let status = running.child.wait().ok();
            let signal = status.and_then(|status| status.signal());
            let code = status.and_then(|status| status.code()).unwrap_or(-1);
            ended.push((at, signal.map_or(ExitKind::Code(code), ExitKind::Signal)));
            self.running[at] = None;
            let name = self.manifest.processes[at].name().to_owned();
            descendants::kill_orphans_of(&name, &self.pids());
        }
        ended
    }

    pub(super) fn terminate(&self, at: usize) {
        if let Some(pid) = self.pid(at) {
            spawn::signal(pid, Signal::TERM);
        }
    }

    pub(super) fn kill(&self, at: usize) {
        if let Some(running) = self.running.get(at).and_then(Option::as_ref) {
            kill_group(&running.child);
        }
    }

    pub(super) fn kill_all(&self) {
        (0..self.running.len()).for_each(|at| self.kill(at));
    }

    /// Kills what the processes have started and left. In a process of its own, the launcher kills
    /// all of its descendants.
    pub(super) fn kill_what_is_left(&self) {
        self.kill_orphans();
        self.memory.iter().for_each(MemoryGroups::remove);
    }

    fn kill_orphans(&self) {
        for plan in &self.manifest.processes {
            if self.guarded {
                while descendants::signal_all(Signal::KILL) > 0 {
                    std::thread::sleep(std::time::Duration::from_millis(1));
                }
                return;
            }
            descendants::kill_orphans_of(plan.name(), &self.pids());
        }
    }

    fn pids(&self) -> Vec<u32> {
        let running = self.running.iter().flatten();
        running.map(|running| running.child.id()).collect()
    }

    pub(super) fn pid(&self, at: usize) -> Option<u32> {
        Some(self.running.get(at)?.as_ref()?.child.id())
    }

    /// Returns which process has this id, if the launcher listens to it.
    pub(super) fn reporter(&self, pid: u32) -> Option<usize> {
        let at = (0..self.running.len()).find(|at| self.pid(*at) == Some(pid))?;
        self.manifest.processes.get(at)?.reports().then_some(at)
    }

    /// Returns whether this is a process of the manifest, and not state management.
    pub(super) fn is_other_process(&self, pid: u32) -> bool {
        let at = (0..self.running.len()).find(|at| self.pid(*at) == Some(pid));
        at.is_some_and(|at| !self.manifest.processes[at].state_management)
    }

    pub(super) fn set_status(&mut self, at: usize, status: String) {
        if let Some(place) = self.status.get_mut(at) {
            *place = status;
        }
    }

    pub(super) fn status(&self, at: usize) -> String {
        self.status.get(at).cloned().unwrap_or_default()
    }
}

/// Returns why a process was not started, unless the operating system fails.
fn refused(error: &(dyn Error + 'static), why: String) -> Result<Start, Unrecoverable> {
    match system_failure(error) {
        Some(errno) => Err(system("starting a process")(errno.into())),
        None => Ok(Err(why)),
    }
}

/// Returns the error number if it says that the system has no process, descriptor or memory left.
fn system_failure(error: &(dyn Error + 'static)) -> Option<Errno> {
    let mut error = Some(error);
    while let Some(this) = error {
        let number = this
            .downcast_ref::<io::Error>()
            .and_then(Errno::from_io_error);
        let number = number.or_else(|| this.downcast_ref::<Errno>().copied());
        let lacks = [Errno::AGAIN, Errno::NOMEM, Errno::MFILE, Errno::NFILE];
        if let Some(number) = number.filter(|it| lacks.contains(it)) {
            return Some(number);
        }
        error = this.source();
    }
    None
}

fn kill_group(child: &Child) {
    // Fails if all of the group have ended.
    let _ = spawn::pid(child.id()).map(|pid| kill_process_group(pid, Signal::KILL));
}

fn placement(plan: &ProcessPlan) -> Placement {
    let policy = match plan.policy {
        SchedulingPolicy::Other => None,
        SchedulingPolicy::Fifo => Some(RealtimePolicy::Fifo),
        SchedulingPolicy::RoundRobin => Some(RealtimePolicy::RoundRobin),
    };
    Placement {
        cpus: plan.cpus.clone(),
        scheduling: policy.zip(plan.priority.as_ref().map(|it| *it.get_ref())),
        limits: limits(plan.limits),
        uid: plan.uid,
        gid: plan.gid,
        groups: plan.groups.clone(),
        keep: vec![],
        join: vec![],
        when_caller_ends: None,
    }
}

fn limits(of: ResourceLimits) -> Vec<(Resource, u64)> {
    let all = [
        (Resource::Data, of.memory),
        (Resource::Nofile, of.open_files),
        (Resource::Nproc, of.processes),
        (Resource::Fsize, of.file_size),
        (Resource::Core, of.core),
        (Resource::Cpu, of.cpu_time),
        (Resource::Memlock, of.locked_memory),
    ];
    let set = |(resource, value): (Resource, Option<u64>)| Some((resource, value?));
    all.into_iter().filter_map(set).collect()
}

const fn in_words(wish: Wish) -> &'static str {
    match wish {
        Wish::Cpus => "its CPUs",
        Wish::Scheduling => "its scheduling policy and priority",
        Wish::Limit => "a limit: the hard limit of the launcher is lower",
        Wish::Group => NO_MEMORY_GROUP,
    }
}
