//! The launcher: runs the processes of a manifest as the supervisor decides.
//!
//! ```text
//! guardian ── launcher ── process ── what it starts      each is a process
//!    └── pre- and post-clean-up
//! ```
//!
//! The guardian is the watchdog: when the launcher dies, hangs or gives up, it cleans up (E-5). If
//! the guardian dies, the launcher does so.

mod children;
mod clean_up;
mod control;
mod descendants;
mod event;
mod group;
mod guardian;
mod notify;

use std::collections::VecDeque;
use std::io::{self, Read as _};
use std::os::fd::{AsFd as _, BorrowedFd};
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use rustix::event::{PollFd, PollFlags, poll};
use rustix::io::Errno;
use rustix::process::{getpid, set_child_subreaper};
use rustix::time::Timespec;
use sha2::{Digest as _, Sha256};
use tandem_board::{Duration, Instant};
use tandem_board_host::clock;

use crate::manifest::{Manifest, ManifestError};
use crate::report;
use crate::supervisor::{Action, Input, Notice, Outcome, Recovery, Supervisor};
use crate::trust::{Platform, TrustError};
use children::Children;
pub use clean_up::AloneCleanUp;
use control::{ControlSocket, Request};
use notify::NotifySocket;

pub use event::{LaunchEvent, ProcessRow, Told};
pub use guardian::{GIVES_UP, GuardEnd, GuardPlan, Guardian, NOTHING_STARTED};

/// The longest time between two looks at the guardian, and at processes that were left.
const LOOK_AGAIN: Duration = Duration::from_ms(500);

/// The most reports between two looks at all else: a process that floods must not hold it up.
const MOST_AT_ONCE: usize = 256;

/// Why a manifest cannot be run. Nothing was started.
#[derive(Debug, thiserror::Error)]
pub enum OpenError {
    /// It is not there, or not to be trusted.
    #[error(transparent)]
    Trust(#[from] TrustError),
    /// It has an error.
    #[error("{path}: {source}")]
    Manifest {
        /// The file.
        path: PathBuf,
        /// The error.
        source: ManifestError,
    },
    /// A launcher runs it already.
    #[error("{0} runs already; `tandem exec ps` shows it")]
    Runs(PathBuf),
    /// The system does not permit it.
    #[error("{what}: {source}")]
    System {
        /// What was tried.
        what: &'static str,
        /// The error of the operating system.
        source: io::Error,
    },
}

/// Why the launcher gives up. What it has started still runs: the caller cleans up (E-5).
#[derive(Debug, thiserror::Error)]
pub enum Unrecoverable {
    /// The fallback target failed, too, or there is none (E-6).
    #[error("{0} has failed, and no run target is left: safe state")]
    SafeState(String),
    /// State management has failed.
    #[error("state management is lost: {0} has failed")]
    NoStateManagement(String),
    /// The operating system refuses what the launcher needs.
    #[error("the operating system fails: {what}: {source}")]
    System {
        /// What was tried.
        what: &'static str,
        /// The error of the operating system.
        source: io::Error,
    },
    /// The watchdog is lost.
    #[error("the guardian has ended")]
    NoGuardian(AloneCleanUp),
}

/// Returns the exit status of a launcher's process that gives up. Without a guardian it cleans up
/// itself, before.
#[must_use]
pub fn give_up(why: &Unrecoverable) -> u8 {
    if let Unrecoverable::NoGuardian(clean_up) = why {
        clean_up.run();
    }
    GIVES_UP
}

/// Makes the error of a system call that must not fail.
fn system(what: &'static str) -> impl FnOnce(io::Error) -> Unrecoverable {
    move |source| Unrecoverable::System { what, source }
}

/// A manifest that is ready to run.
#[derive(Debug)]
pub struct ProcessLauncher {
    manifest: Arc<Manifest>,
    platform: Platform,
    folder: PathBuf,
    notify: NotifySocket,
    control: ControlSocket,
    names: SocketNames,
    /// The manifest and the anchor.
    files: (PathBuf, Option<PathBuf>),
}

/// The names of the sockets in the abstract namespace: no file is left behind.
#[derive(Clone, Debug)]
struct SocketNames {
    notify: String,
    control: String,
}

impl SocketNames {
    /// Names for the manifest at this path: whoever knows it finds the launcher.
    fn of(path: &Path) -> Self {
        use std::os::unix::ffi::OsStrExt as _;
        let digest = Sha256::digest(path.as_os_str().as_bytes());
        let digest: String = digest
            .iter()
            .take(8)
            .map(|byte| format!("{byte:02x}"))
            .collect();
        Self {
            notify: format!("tandem-exec-{digest}-notify"),
            control: format!("tandem-exec-{digest}-control"),
        }
    }
}

/// Sends a request to the launcher that runs this manifest, and returns its answer.
///
/// # Errors
/// If no launcher runs it, or it ends before it answers.
pub fn ask(manifest: &Path, request: &str) -> io::Result<String> {
    let names = SocketNames::of(&manifest.canonicalize()?);
    report::ask(names.control.as_bytes(), request)
}

impl ProcessLauncher {
    /// Reads a manifest, and checks it. Starts nothing.
    ///
    /// # Errors
    /// [`OpenError`] says what is wrong.
    pub fn open(manifest: &Path, anchor: Option<&Path>) -> Result<Self, OpenError> {
        let (platform, checked, path) = read(manifest, anchor)?;
        let names = SocketNames::of(&path);
        let open = |source: io::Error| match source.kind() {
            io::ErrorKind::AddrInUse => OpenError::Runs(path.clone()),
            _ => OpenError::System {
                what: "the sockets of the launcher",
                source,
            },
        };
        let control = ControlSocket::open(&names.control).map_err(open)?;
        let notify = NotifySocket::open(&names.notify).map_err(open)?;
        Ok(Self {
            manifest: Arc::new(checked),
            platform,
            folder: path.parent().unwrap_or(Path::new("/")).to_owned(),
            notify,
            control,
            names,
            files: (path, anchor.map(Path::to_owned)),
        })
    }

    /// Returns the manifest.
    #[must_use]
    pub fn manifest(&self) -> &Manifest {
        &self.manifest
    }

    /// Runs the processes until all have ended. The first byte from `stops` ends them in order, the
    /// second kills them. With a guardian, standard input leads to it; without one, the kernel
    /// sends SIGTERM to each process when the calling thread ends.
    ///
    /// # Errors
    /// [`Unrecoverable`]: the caller must clean up.
    pub fn run(
        self,
        stops: UnixStream,
        guarded: bool,
        tell: &mut dyn FnMut(&Told),
    ) -> Result<(), Unrecoverable> {
        stops.set_nonblocking(true).map_err(system("signals"))?;
        let manifest = Arc::clone(&self.manifest);
        let children = Children::new(manifest, self.platform, self.folder, &self.names, guarded);
        let mut shell = Shell {
            supervisor: Supervisor::new(self.manifest.clone()),
            initial: self.manifest.initial(),
            manifest: self.manifest,
            children,
            notify: self.notify,
            control: self.control,
            stops,
            asked_to_stop: 0,
            waiting: vec![],
            inputs: VecDeque::new(),
            guard: guarded.then(|| guardian::Link::new()),
            group: self.names.control,
            files: self.files,
            begin: clock::now(),
            tell,
            outcome: None,
        };
        shell.run()
    }
}

/// Reads and checks a manifest. Returns also its path without symbolic links.
fn read(path: &Path, anchor: Option<&Path>) -> Result<(Platform, Manifest, PathBuf), OpenError> {
    // An error of a path that does not exist is told by what reads it.
    let path = path.canonicalize().unwrap_or_else(|_| path.to_owned());
    let platform = Platform::open(&path, anchor)?;
    let checked = Manifest::read(platform.manifest()).map_err(|source| OpenError::Manifest {
        path: path.clone(),
        source,
    })?;
    Ok((platform, checked, path))
}

/// Checks a manifest and that each of its programs may run. Starts nothing.
///
/// # Errors
/// [`OpenError`] says what is wrong.
pub fn check(manifest: &Path, anchor: Option<&Path>) -> Result<Manifest, OpenError> {
    let (platform, checked, _) = read(manifest, anchor)?;
    for process in &checked.processes {
        platform.command(&process.program)?;
    }
    Ok(checked)
}

/// The launcher while it runs.
struct Shell<'a> {
    manifest: Arc<Manifest>,
    initial: usize,
    supervisor: Supervisor,
    children: Children,
    notify: NotifySocket,
    control: ControlSocket,
    stops: UnixStream,
    asked_to_stop: u32,
    /// Requests for a run target, with the target.
    waiting: Vec<(usize, Request)>,
    inputs: VecDeque<Input>,
    guard: Option<guardian::Link>,
    /// Name of the control group.
    group: String,
    files: (PathBuf, Option<PathBuf>),
    begin: Instant,
    tell: &'a mut dyn FnMut(&Told),
    outcome: Option<Outcome>,
}

impl Shell<'_> {
    fn run(&mut self) -> Result<(), Unrecoverable> {
        if let Some(guard) = &mut self.guard {
            set_child_subreaper(Some(getpid()))
                .map_err(|error| system("subreaper")(error.into()))?;
            guard.begin(&self.manifest.safe_state, &self.group);
        }
        self.inputs.push_back(Input::Switch(self.initial));
        loop {
            self.work()?;
            match self.outcome {
                None => self.wait()?,
                Some(Outcome::Done) => {
                    self.children.kill_what_is_left();
                    return Ok(());
                }
                Some(Outcome::SafeState(at)) => {
                    return Err(Unrecoverable::SafeState(self.name(at)));
                }
                Some(Outcome::NoStateManagement(at)) => {
                    return Err(Unrecoverable::NoStateManagement(self.name(at)));
                }
            }
        }
    }

    /// Handles all that has happened, and what follows from it.
    fn work(&mut self) -> Result<(), Unrecoverable> {
        while let Some(input) = self.inputs.pop_front() {
            for action in self.supervisor.on_input(clock::now(), input) {
                self.perform(action)?;
            }
        }
        Ok(())
    }

    fn perform(&mut self, action: Action) -> Result<(), Unrecoverable> {
        match action {
            Action::Start(at) => match self.children.start(at)? {
                Ok((pid, refused, unchecked)) => {
                    self.tell(LaunchEvent::Started {
                        process: self.name(at),
                        pid,
                    });
                    if let Some(why) = unchecked {
                        self.tell(LaunchEvent::Unchecked {
                            process: self.name(at),
                            why,
                        });
                    }
                    for what in refused {
                        self.tell(LaunchEvent::NotGranted {
                            process: self.name(at),
                            what,
                        });
                    }
                    self.inputs.push_back(Input::Started(at));
                }
                Err(why) => self.inputs.push_back(Input::NotStarted(at, why)),
            },
            Action::Terminate(at) => self.children.terminate(at),
            Action::Kill(at) => self.children.kill(at),
            Action::Tell(notice) => self.notice(notice),
            Action::End(outcome) => self.outcome = Some(outcome),
        }
        Ok(())
    }

    fn notice(&mut self, notice: Notice) {
        let event = match notice {
            Notice::Ready(at) => LaunchEvent::Ready {
                process: self.name(at),
            },
            Notice::Failed(at, why, recovery) => {
                let next = match recovery {
                    Recovery::Restart(number) => format!("restart {number}"),
                    Recovery::None => "not needed any more".to_owned(),
                    Recovery::Fallback => "fallback".to_owned(),
                    Recovery::SafeState => "safe state".to_owned(),
                };
                let why = why.to_string();
                if matches!(recovery, Recovery::Fallback | Recovery::SafeState) {
                    let answer = format!("{} has failed: {why}", self.name(at));
                    self.waiting
                        .drain(..)
                        .for_each(|(_, request)| request.answer(&answer));
                }
                LaunchEvent::Failed {
                    process: self.name(at),
                    why,
                    next,
                }
            }
            Notice::Switching(to) => {
                let superseded = |(target, _): &(usize, Request)| *target != to;
                let others: Vec<_> = self.waiting.extract_if(.., |it| superseded(it)).collect();
                let answer = "another run target was asked for since";
                others
                    .into_iter()
                    .for_each(|(_, request)| request.answer(answer));
                LaunchEvent::Switching {
                    target: self.target_name(to),
                }
            }
            Notice::Reached(target) => {
                // A request for another one may have arrived since.
                let reached: Vec<_> = self.waiting.extract_if(.., |it| it.0 == target).collect();
                reached
                    .into_iter()
                    .for_each(|(_, request)| request.answer("ok"));
                LaunchEvent::Reached {
                    target: self.target_name(target),
                }
            }
        };
        self.tell(event);
    }

    /// Waits until something happens, and notes it.
    fn wait(&mut self) -> Result<(), Unrecoverable> {
        let now = clock::now();
        let watchdog = Duration::from_ns(self.manifest.safe_state.watchdog.as_ns() / 4);
        let look_again = now + LOOK_AGAIN.min(watchdog);
        let until = self
            .supervisor
            .next_tick(now)
            .map_or(look_again, |it| it.min(look_again));
        let span = until.since(now).as_ns();
        let span = Timespec {
            tv_sec: (span / 1_000_000_000) as i64,
            tv_nsec: (span % 1_000_000_000) as i64,
        };
        let fixed = [self.notify.as_fd(), self.stops.as_fd()];
        let guard = self.guard.as_ref().map(|it| it.fd());
        let fds: Vec<BorrowedFd<'_>> = fixed.into_iter().chain(guard).collect();
        let fds = fds
            .into_iter()
            .chain(self.control.fds())
            .chain(self.children.fds());
        let mut fds: Vec<_> = fds
            .map(|fd| PollFd::from_borrowed_fd(fd, PollFlags::IN))
            .collect();
        match poll(&mut fds, Some(&span)) {
            Ok(_) | Err(Errno::INTR) => {}
            Err(error) => return Err(system("poll")(error.into())),
        }
        drop(fds);
        self.hear()
    }

    fn hear(&mut self) -> Result<(), Unrecoverable> {
        // Reports first: a process that reports and ends has reported.
        for _ in 0..MOST_AT_ONCE {
            let Some((pid, datagram)) = self.notify.receive(clock::now()) else {
                break;
            };
            let Some(at) = self.children.reporter(pid) else {
                continue;
            };
            if let Some(status) = datagram.status {
                self.children.set_status(at, status);
            }
            let reports = datagram.reports.into_iter();
            self.inputs
                .extend(reports.map(|report| Input::Report(at, report)));
        }
        let ended = self.children.take_ended();
        self.inputs
            .extend(ended.into_iter().map(|(at, how)| Input::Ended(at, how)));
        for request in self.control.take().map_err(system("the control socket"))? {
            self.answer(request);
        }
        let mut bytes = [0; 16];
        let count = (&self.stops).read(&mut bytes).unwrap_or(0);
        if count > 0 {
            self.asked_to_stop += count as u32;
            self.inputs.push_back(Input::Stop);
        }
        if self.asked_to_stop > 1 {
            self.children.kill_all();
        }
        if let Some(guard) = &mut self.guard
            && !guard.kick()
        {
            let clean_up =
                AloneCleanUp::of(&self.manifest.safe_state, self.files.clone(), &self.group);
            return Err(Unrecoverable::NoGuardian(clean_up));
        }
        self.inputs.push_back(Input::Tick);
        Ok(())
    }

    fn answer(&mut self, request: Request) {
        let known = request
            .text
            .split_once(' ')
            .map_or((request.text.as_str(), ""), |it| it);
        match known {
            ("ps", "") => {
                let rows = self.rows();
                let (target, reached) = self.supervisor.target();
                let target = target.map(|it| self.target_name(it));
                request.answer(&event::state(target.as_deref(), reached, &rows));
            }
            ("target", name) => match self.manifest.target_named(name) {
                _ if self.children.is_other_process(request.from) => {
                    request.answer("only state management may switch the run target");
                }
                Some(target) => {
                    self.waiting.push((target, request));
                    self.inputs.push_back(Input::Switch(target));
                }
                None => {
                    let names = self.manifest.targets.iter().map(|it| it.name());
                    let names: Vec<_> = names.collect();
                    let names = names.join(", ");
                    request.answer(&format!("no such run target; there are: {names}"));
                }
            },
            _ => request.answer("expected ps or target NAME"),
        }
    }

    fn rows(&self) -> Vec<ProcessRow> {
        let row = |at: usize| {
            let (state, restarts) = self.supervisor.state_of(at);
            ProcessRow {
                process: self.name(at),
                state: state.to_owned(),
                pid: self.children.pid(at),
                restarts,
                status: self.children.status(at),
            }
        };
        (0..self.manifest.processes.len()).map(row).collect()
    }

    fn tell(&mut self, event: LaunchEvent) {
        let after = clock::now().since(self.begin);
        let after_ms = after.as_ms_f64();
        (self.tell)(&Told { after_ms, event });
    }

    fn name(&self, at: usize) -> String {
        let process = self.manifest.processes.get(at);
        process.map_or_else(String::new, |it| it.name().to_owned())
    }

    fn target_name(&self, at: usize) -> String {
        let target = self.manifest.targets.get(at);
        target.map_or_else(String::new, |it| it.name().to_owned())
    }
}
