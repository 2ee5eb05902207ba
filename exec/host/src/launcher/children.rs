//! The processes of the manifest, as children of the launcher.

use std::error::Error;
use std::fs::File;
use std::io;
use std::os::fd::BorrowedFd;
use std::os::unix::process::ExitStatusExt as _;
use std::path::PathBuf;
use std::process::{Child, Stdio};
use std::sync::Arc;

use rustix::io::Errno;
use rustix::process::{Resource, Signal};
use tandem_board_host::control_group::MemoryGroups;
use tandem_board_host::descendants;
use tandem_board_host::process_report::{CONTROL_SOCKET, NOTIFY_SOCKET};
use tandem_board_host::spawn::{self, Placement, RealtimePolicy, Watched, Wish};

use super::{Unrecoverable, notify_socket, system};
use tandem_manifest::{Manifest, ProcessPlan, SchedulingPolicy};

use crate::supervisor::ExitKind;
use crate::trust::Platform;

/// The path for programs that a process starts; deterministic.
const PATH: &str = "/usr/local/bin:/usr/bin:/bin:/usr/local/sbin:/usr/sbin:/sbin";

/// Environment variable that names the process of the manifest; descendants inherit it.
const MARK: &str = "TANDEM_EXEC_PROCESS";

#[derive(Debug)]
pub(super) struct Children {
    pub(super) manifest: Arc<Manifest>,
    pub(super) platform: Platform,
    folder: PathBuf,
    /// The name of the control socket and of the control groups.
    pub(super) name: String,
    running: Vec<Option<Running>>,
    /// What each process last said of itself.
    pub(super) status: Vec<String>,
    /// A guardian handles what is left when the launcher dies.
    pub(super) guarded: bool,
    memory: Option<MemoryGroups>,
}

#[derive(Debug)]
struct Running {
    child: Child,
    watched: Watched,
}

/// A process that was started: its id, and what was not granted. Or why it was not started.
type Start = Result<(u32, Vec<String>), String>;

/// What the operating system refuses.
#[derive(Debug, thiserror::Error)]
#[error("{0}: {1}")]
struct Refusal(String, #[source] io::Error);

impl Children {
    pub(super) fn new(
        manifest: Manifest,
        platform: Platform,
        folder: PathBuf,
        name: String,
    ) -> Self {
        let count = manifest.processes.len();
        Self {
            manifest: Arc::new(manifest),
            platform,
            folder,
            running: (0..count).map(|_| None).collect(),
            status: vec![String::new(); count],
            guarded: false,
            memory: MemoryGroups::named(&name),
            name,
        }
    }

    /// Starts a process. A refusal of the program is an error of the process; an operating system
    /// that has no process or descriptor left is unrecoverable.
    pub(super) fn start(&mut self, at: usize) -> Result<Start, Unrecoverable> {
        match self.try_start(at) {
            Ok(started) => Ok(Ok(started)),
            Err(error) => match system_failure(&*error) {
                Some(lacks) => Err(system("starting a process")(lacks.into())),
                None => Ok(Err(error.to_string())),
            },
        }
    }

    fn try_start(&mut self, at: usize) -> Result<(u32, Vec<String>), Box<dyn Error>> {
        let manifest = Arc::clone(&self.manifest);
        let plan = manifest.processes.get(at).ok_or("no such process")?;
        let mut trusted = self.platform.command(&plan.program)?;
        trusted.command.args(&plan.arguments).env_clear();
        for (name, value) in self.environment(plan) {
            trusted.set(name, value.as_ref())?;
        }
        let mut command = trusted.command;
        command.current_dir(self.folder.join(&plan.directory));
        command.stdin(Stdio::null());
        if let Some(file) = &plan.output {
            let file = File::options()
                .append(true)
                .create(true)
                .open(self.folder.join(file))
                .map_err(|source| Refusal("its output".to_owned(), source))?;
            command.stdout(file.try_clone()?).stderr(file);
        }
        let mut placement = placement(plan);
        placement.keep = trusted.keep;
        placement.when_caller_ends = (!self.guarded).then_some(Signal::TERM);
        placement.inherit_all = !self.guarded;
        let mut refused: Vec<String> = trusted.warning.into_iter().collect();
        if let Some(bytes) = plan.limits.memory {
            let groups = self.memory.as_ref();
            let group = groups.and_then(|it| it.make(plan.name(), bytes).ok());
            placement.memory = group.map(Arc::new);
            refused.extend((placement.memory.is_none()).then(|| Wish::Memory.to_string()));
        }
        let program = || plan.program.display().to_string();
        let (child, wishes) =
            spawn::spawn(&mut command, &placement).map_err(|source| Refusal(program(), source))?;
        let pid = child.id();
        // The child is not waited for yet, so it has a descriptor, unless there is none left.
        let watched = Watched::new(pid).ok_or(Errno::MFILE)?;
        self.running[at] = Some(Running { child, watched });
        refused.extend(wishes.iter().map(Wish::to_string));
        Ok((pid, refused))
    }

    /// Returns the environment of a process; later variables replace earlier ones.
    fn environment<'a>(&self, plan: &'a ProcessPlan) -> Vec<(&'a str, String)> {
        let mut all = vec![("PATH", PATH.to_owned())];
        if plan.reports() {
            all.push((NOTIFY_SOCKET, format!("@{}", notify_socket(&self.name))));
        }
        if plan.state_management {
            all.push((CONTROL_SOCKET, format!("@{}", self.name)));
        }
        let own = plan.environment.iter();
        all.extend(own.map(|(name, value)| (name.as_str(), value.clone())));
        all.push((MARK, plan.name().to_owned()));
        all
    }

    pub(super) fn fds(&self) -> impl Iterator<Item = BorrowedFd<'_>> {
        let running = self.running.iter().flatten();
        running.map(|running| running.watched.fd())
    }

    pub(super) fn have_ended(&self) -> Vec<usize> {
        let has_ended = |at: &usize| self.running[*at].iter().any(|it| it.watched.has_ended());
        (0..self.running.len()).filter(has_ended).collect()
    }

    /// Waits for these, which have ended, and kills what they have left.
    pub(super) fn wait_for(&mut self, these: Vec<usize>) -> Vec<(usize, ExitKind)> {
        let mut ended = vec![];
        for at in these {
            let Some(mut running) = self.running[at].take() else {
                continue;
            };
            // Before it is waited for: until then the number of its group is not used again.
            spawn::kill_group(running.child.id());
            let status = running.child.wait().ok();
            let signal = status.and_then(|status| status.signal());
            let code = status.and_then(|status| status.code()).unwrap_or(-1);
            ended.push((at, signal.map_or(ExitKind::Code(code), ExitKind::Signal)));
            self.kill_orphans_of(at);
        }
        ended
    }

    pub(super) fn kill(&self, at: usize) {
        self.pid(at).into_iter().for_each(spawn::kill_group);
    }

    /// Kills what the processes have started and left. In a process of its own, the launcher kills
    /// all of its descendants.
    pub(super) fn kill_what_is_left(&self) {
        while self.guarded && descendants::signal_all(Signal::KILL) > 0 {
            std::thread::sleep(std::time::Duration::from_millis(1));
        }
        if !self.guarded {
            (0..self.running.len()).for_each(|at| self.kill_orphans_of(at));
        }
        self.memory.iter().for_each(MemoryGroups::remove);
    }

    fn kill_orphans_of(&self, at: usize) {
        let mark = format!("{MARK}={}", self.manifest.processes[at].name());
        let running = self.running.iter().flatten();
        let known: Vec<u32> = running.map(|it| it.child.id()).collect();
        descendants::kill_orphans(&mark, &known);
    }

    pub(super) fn pid(&self, at: usize) -> Option<u32> {
        Some(self.running.get(at)?.as_ref()?.child.id())
    }

    /// Returns which process of the manifest has this id.
    pub(super) fn with_pid(&self, pid: u32) -> Option<usize> {
        (0..self.running.len()).find(|at| self.pid(*at) == Some(pid))
    }
}

/// Returns the error number if it says that the system has no process, descriptor or memory left.
fn system_failure(error: &(dyn Error + 'static)) -> Option<Errno> {
    let mut causes = std::iter::successors(Some(error), |it| (*it).source());
    causes.find_map(|cause| {
        let number = cause.downcast_ref::<io::Error>();
        let number = number.and_then(Errno::from_io_error);
        let number = number.or_else(|| cause.downcast_ref::<Errno>().copied());
        let lacks = [Errno::AGAIN, Errno::NOMEM, Errno::MFILE, Errno::NFILE];
        number.filter(|it| lacks.contains(it))
    })
}

fn placement(plan: &ProcessPlan) -> Placement {
    let policy = match plan.policy {
        SchedulingPolicy::Other => None,
        SchedulingPolicy::Fifo => Some(RealtimePolicy::Fifo),
        SchedulingPolicy::RoundRobin => Some(RealtimePolicy::RoundRobin),
    };
    let limits = [
        (Resource::Data, plan.limits.memory),
        (Resource::Nofile, plan.limits.open_files),
        (Resource::Nproc, plan.limits.processes),
        (Resource::Fsize, plan.limits.file_size),
        (Resource::Core, plan.limits.core),
        (Resource::Cpu, plan.limits.cpu_time),
        (Resource::Memlock, plan.limits.locked_memory),
    ];
    let limits = limits.into_iter();
    Placement {
        cpus: plan.cpus.clone(),
        scheduling: policy.zip(plan.priority.as_ref().map(|it| *it.get_ref())),
        limits: limits
            .filter_map(|(of, value)| Some((of, value?)))
            .collect(),
        uid: plan.uid,
        gid: plan.gid,
        groups: plan.groups.clone(),
        ..Placement::default()
    }
}
