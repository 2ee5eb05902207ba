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
mod guardian;
mod notify;

use std::collections::VecDeque;
use std::io::{self, Read as _};
use std::os::fd::AsFd as _;
use std::os::unix::ffi::OsStrExt as _;
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};

use rustix::process::{Signal, getpid, set_child_subreaper};
use sha2::{Digest as _, Sha256};
use tandem_board::{Duration, Instant};
use tandem_board_host::socket::{self, DatagramSocket, LineRequest, RequestSocket};
use tandem_board_host::{clock, spawn};

use crate::supervisor::{Action, Input, Outcome, Recovery, Supervisor};
pub use crate::supervisor::{LaunchEvent, PlatformState, ProcessRow, Told};
use crate::trust::Platform;
use children::Children;
use clean_up::CleanUp;
pub use guardian::{GIVES_UP, GuardEnd, GuardPlan, NOTHING_STARTED, guard};
use tandem_manifest::Manifest;

/// The longest time between two looks at the guardian, and at processes that were left.
const LOOK_AGAIN: Duration = Duration::from_ms(500);

/// The most reports between two looks at all else: a process that floods must not hold it up.
const MOST_AT_ONCE: usize = 256;

/// The most requests for run targets that wait.
const MOST_WAITING: usize = 64;

/// Why a manifest cannot be run, for people: it is not there, not to be trusted or wrong, or a
/// launcher runs it already, or the system does not permit it. Nothing was started.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub struct OpenError(String);

/// Why the launcher gives up, for people: the safe state (E-6), or that state management, the
/// guardian, or something of the operating system is lost (E-5). What it has started still runs:
/// the caller calls [`give_up`].
#[derive(Debug, thiserror::Error)]
#[error("{why}")]
pub struct Unrecoverable {
    why: String,
    /// What a lost guardian does not do.
    clean_up: Option<Box<CleanUp>>,
}

impl From<String> for Unrecoverable {
    fn from(why: String) -> Self {
        let clean_up = None;
        Self { why, clean_up }
    }
}

/// Returns the exit status of a launcher's process that gives up. Without a guardian it cleans up
/// itself, before.
#[must_use]
pub fn give_up(why: &Unrecoverable) -> u8 {
    if let Some(clean_up) = &why.clean_up {
        clean_up.clone().run_alone();
    }
    GIVES_UP
}

/// Makes the error of a system call that must not fail.
fn system(what: &'static str) -> impl FnOnce(io::Error) -> Unrecoverable {
    move |source| format!("the operating system fails: {what}: {source}").into()
}

/// A manifest that is ready to run.
#[derive(Debug)]
pub struct ProcessLauncher {
    children: Children,
    notify: DatagramSocket,
    control: RequestSocket,
    clean_up: CleanUp,
}

/// Returns the name of the control socket and the control groups for the manifest at this path: the
/// path leads to its launcher.
fn name_of(path: &Path) -> String {
    let digest = format!("{:x}", Sha256::digest(path.as_os_str().as_bytes()));
    format!("tandem-exec-{}-control", &digest[..16])
}

/// Returns the name of the socket for reports.
fn notify_socket(name: &str) -> String {
    name.replace("control", "notify")
}

/// Sends a request to the launcher that runs this manifest, and returns its answer.
///
/// # Errors
/// If no launcher runs it, or it ends before it answers.
pub fn ask(manifest: &Path, request: &str) -> io::Result<String> {
    socket::ask(&name_of(&manifest.canonicalize()?), request)
}

/// Reads and checks a manifest. Returns also its path without symbolic links.
fn read(path: &Path, anchor: Option<&Path>) -> Result<(Platform, Manifest, PathBuf), OpenError> {
    // An error of a path that does not exist is told by what reads it.
    let path = path.canonicalize().unwrap_or_else(|_| path.to_owned());
    let platform = Platform::open(&path, anchor).map_err(|error| OpenError(error.to_string()))?;
    let checked = Manifest::read(platform.manifest())
        .map_err(|error| OpenError(format!("{}: {error}", path.display())))?;
    Ok((platform, checked, path))
}

/// Checks a manifest and that each of its programs may run. Starts nothing.
///
/// # Errors
/// [`OpenError`] says what is wrong.
pub fn check(manifest: &Path, anchor: Option<&Path>) -> Result<Manifest, OpenError> {
    let (platform, checked, _) = read(manifest, anchor)?;
    for process in &checked.processes {
        let command = platform.command(&process.program);
        command.map_err(|error| OpenError(error.to_string()))?;
    }
    Ok(checked)
}

impl ProcessLauncher {
    /// Reads a manifest, and checks it. Starts nothing.
    ///
    /// # Errors
    /// [`OpenError`] says what is wrong.
    pub fn open(manifest: &Path, anchor: Option<&Path>) -> Result<Self, OpenError> {
        let (platform, manifest, path) = read(manifest, anchor)?;
        let name = name_of(&path);
        let refused = |error: io::Error| match error.kind() {
            io::ErrorKind::AddrInUse => {
                let path = path.display();
                OpenError(format!("{path} runs already; `tandem exec ps` shows it"))
            }
            _ => OpenError(format!("the sockets of the launcher: {error}")),
        };
        let control = RequestSocket::open(&name).map_err(refused)?;
        let notify = DatagramSocket::open(&notify_socket(&name)).map_err(refused)?;
        let folder = path.parent().unwrap_or(Path::new("/")).to_owned();
        Ok(Self {
            notify,
            control,
            clean_up: CleanUp {
                safe_state: manifest.safe_state.clone(),
                name: Some(name.clone()),
                group: None,
                files: Some((path, anchor.map(Path::to_owned))),
            },
            children: Children::new(manifest, platform, folder, name),
        })
    }

    /// Runs the processes until all have ended. The first byte from `stops` ends them in order, the
    /// second kills them. With a guardian, standard input leads to it; without one, the kernel
    /// sends SIGTERM to each process when the calling thread ends.
    ///
    /// # Errors
    /// [`Unrecoverable`]: the caller must clean up.
    pub fn run(
        mut self,
        stops: UnixStream,
        guarded: bool,
        tell: &mut dyn FnMut(&Told),
    ) -> Result<(), Unrecoverable> {
        stops.set_nonblocking(true).map_err(system("signals"))?;
        self.children.guarded = guarded;
        let mut shell = Shell {
            supervisor: Supervisor::new(self.children.manifest.clone()),
            launcher: self,
            stops,
            asked_to_stop: 0,
            waiting: vec![],
            inputs: VecDeque::new(),
            begin: clock::now(),
            heard: clock::now(),
            tell,
            is_done: false,
        };
        shell.run()
    }
}

/// The launcher while it runs.
struct Shell<'a> {
    launcher: ProcessLauncher,
    supervisor: Supervisor,
    stops: UnixStream,
    asked_to_stop: usize,
    /// Requests for a run target, with the target.
    waiting: Vec<(String, LineRequest)>,
    inputs: VecDeque<Input>,
    begin: Instant,
    /// When it last looked at what has happened: what was due by then is handled.
    heard: Instant,
    tell: &'a mut dyn FnMut(&Told),
    is_done: bool,
}

impl Shell<'_> {
    fn run(&mut self) -> Result<(), Unrecoverable> {
        if self.launcher.children.guarded {
            set_child_subreaper(Some(getpid()))
                .map_err(|error| system("subreaper")(error.into()))?;
            // A guardian that has ended already is noticed later.
            guardian::send(&serde_json::to_string(&self.launcher.clean_up).unwrap_or_default());
        }
        if let Some(warning) = self.launcher.children.platform.warning() {
            let what = warning.to_string();
            let process = "manifest".to_owned();
            self.tell(LaunchEvent::NotGranted { process, what });
        }
        let initial = self.launcher.children.manifest.initial();
        self.inputs.push_back(Input::Switch(initial));
        loop {
            // What follows from these waits for the next look: starts may fail again and again.
            for input in std::mem::take(&mut self.inputs) {
                // What a process reports while others start is not late.
                let is_tick = input == Input::Tick;
                let now = if is_tick { self.heard } else { clock::now() };
                for action in self.supervisor.on_input(now, input) {
                    self.perform(action)?;
                }
            }
            if self.is_done {
                self.launcher.children.kill_what_is_left();
                return Ok(());
            }
            if self.inputs.is_empty() {
                self.wait()?;
            }
            self.hear()?;
        }
    }

    fn perform(&mut self, action: Action) -> Result<(), Unrecoverable> {
        let children = &mut self.launcher.children;
        match action {
            Action::Start(at) => match children.start(at)? {
                Ok((pid, refused)) => {
                    let process = self.name(at);
                    self.tell(LaunchEvent::Started { process, pid });
                    for what in refused {
                        let process = self.name(at);
                        self.tell(LaunchEvent::NotGranted { process, what });
                    }
                    self.inputs.push_back(Input::Started(at));
                }
                Err(why) => self.inputs.push_back(Input::NotStarted(at, why)),
            },
            Action::Terminate(at) => {
                let pid = children.pid(at).into_iter();
                pid.for_each(|pid| spawn::signal(pid, Signal::TERM));
            }
            Action::Kill(at) => children.kill(at),
            Action::Tell(event) => self.tell(event),
            Action::End(Outcome::Done) => self.is_done = true,
            Action::End(Outcome::SafeState(at)) => {
                let name = self.name(at);
                Err(format!(
                    "{name} has failed, and no run target is left: safe state"
                ))?;
            }
            Action::End(Outcome::NoStateManagement(at)) => {
                let name = self.name(at);
                Err(format!("state management is lost: {name} has failed"))?;
            }
        }
        Ok(())
    }

    fn tell(&mut self, event: LaunchEvent) {
        match &event {
            LaunchEvent::Failed { process, why, next } => {
                if matches!(next, Recovery::Fallback | Recovery::SafeState) {
                    self.answer_if(|_| true, &format!("{process} has failed: {why}"));
                }
            }
            LaunchEvent::Switching { target } => {
                self.answer_if(|it| it != target, "another run target was asked for since");
            }
            // A request for another one may have arrived since.
            LaunchEvent::Reached { target } => self.answer_if(|it| it == target, "ok"),
            _ => {}
        }
        let after_ms = clock::now().since(self.begin).as_ms_f64();
        (self.tell)(&Told { after_ms, event });
    }

    /// Answers the requests for these run targets.
    fn answer_if(&mut self, is_answered: impl Fn(&str) -> bool, answer: &str) {
        let answered = self
            .waiting
            .extract_if(.., |(target, _)| is_answered(target));
        answered.for_each(|(_, request)| request.answer(answer));
    }

    /// Waits until something happens.
    fn wait(&self) -> Result<(), Unrecoverable> {
        let ProcessLauncher {
            children,
            notify,
            control,
            ..
        } = &self.launcher;
        let now = clock::now();
        let watchdog = Duration::from_ns(children.manifest.safe_state.watchdog.as_ns() / 4);
        let look_again = now + LOOK_AGAIN.min(watchdog);
        let tick = self.supervisor.next_tick(self.heard);
        let span = tick.map_or(look_again, |it| it.min(look_again)).since(now);
        let stdin = io::stdin();
        let fds = [notify.as_fd(), self.stops.as_fd()].into_iter();
        let fds = fds.chain(children.guarded.then(|| stdin.as_fd()));
        let fds = fds.chain(control.fds()).chain(children.fds());
        clock::wait_for(fds, span).map_err(system("poll"))?;
        Ok(())
    }

    /// Notes all that has happened.
    fn hear(&mut self) -> Result<(), Unrecoverable> {
        let ProcessLauncher {
            children,
            notify,
            control,
            clean_up,
        } = &mut self.launcher;
        self.heard = clock::now();
        // A process that reports and then ends has reported: its reports are read in between.
        let ended = children.have_ended();
        let datagrams = std::iter::from_fn(|| notify.receive());
        for (pid, datagram) in datagrams.take(MOST_AT_ONCE) {
            let listens = |at: &usize| children.manifest.processes[*at].reports();
            let Some(at) = children.with_pid(pid).filter(listens) else {
                continue;
            };
            let datagram = notify::parse(&datagram, self.heard);
            if let Some(status) = datagram.status {
                children.status[at] = status;
            }
            let reports = datagram.reports.into_iter();
            self.inputs.extend(reports.map(|it| Input::Report(at, it)));
        }
        let ended = children.wait_for(ended).into_iter();
        self.inputs
            .extend(ended.map(|(at, how)| Input::Ended(at, how)));
        let mut bytes = [0; 16];
        let count = (&self.stops).read(&mut bytes).unwrap_or(0);
        if count > 0 {
            self.asked_to_stop += count;
            self.inputs.push_back(Input::Stop);
            let waiting = self.waiting.drain(..);
            waiting.for_each(|(_, it)| it.answer("all ends"));
        }
        if self.asked_to_stop > 1 {
            (0..children.status.len()).for_each(|at| children.kill(at));
        }
        if children.guarded && !guardian::send("") {
            return Err(Unrecoverable {
                why: "the guardian has ended".to_owned(),
                clean_up: Some(Box::new(clean_up.clone())),
            });
        }
        let requests = control.take().map_err(system("the control socket"))?;
        requests.into_iter().for_each(|it| self.answer(it));
        self.inputs.push_back(Input::Tick);
        Ok(())
    }

    fn answer(&mut self, request: LineRequest) {
        let children = &self.launcher.children;
        let manifest = &children.manifest;
        let asks = children
            .with_pid(request.from)
            .map(|at| &manifest.processes[at]);
        match request.text.split_once(' ') {
            None if request.text == "ps" => {
                let state = serde_json::to_string(&self.state());
                request.answer(&state.unwrap_or_default());
            }
            Some(("target", _)) if asks.is_some_and(|it| !it.state_management) => {
                request.answer("only state management may switch the run target");
            }
            Some(("target", _)) if self.asked_to_stop > 0 => request.answer("all ends"),
            Some(("target", _)) if self.waiting.len() >= MOST_WAITING => request.answer("busy"),
            Some(("target", name)) => {
                if let Some(target) = manifest.target_named(name) {
                    self.waiting.push((name.to_owned(), request));
                    self.inputs.push_back(Input::Switch(target));
                } else {
                    let names = manifest.targets.iter().map(|it| it.name());
                    let names = names.collect::<Vec<_>>().join(", ");
                    request.answer(&format!("no such run target; there are: {names}"));
                }
            }
            _ => request.answer("expected ps or target NAME"),
        }
    }

    fn state(&self) -> PlatformState {
        let children = &self.launcher.children;
        let row = |at: usize| {
            let (state, restarts) = self.supervisor.state_of(at);
            ProcessRow {
                process: self.name(at),
                state: state.to_owned(),
                pid: children.pid(at),
                restarts,
                status: children.status[at].clone(),
            }
        };
        let (target, reached) = self.supervisor.target();
        PlatformState {
            target: target.map(|it| children.manifest.targets[it].name().to_owned()),
            reached,
            processes: (0..children.manifest.processes.len()).map(row).collect(),
        }
    }

    fn name(&self, at: usize) -> String {
        let processes = &self.launcher.children.manifest.processes;
        processes[at].name().to_owned()
    }
}
