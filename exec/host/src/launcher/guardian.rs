//! The guardian: a watchdog process above the launcher. It is the one that cleans up (E-5).
//!
//! The launcher's standard input leads to the guardian. The launcher sends a line at least every
//! half second. Silence, the end of the launcher, or its exit status 70 begin the clean-up.

use std::io::{self, Read as _};
use std::os::fd::{AsFd as _, BorrowedFd, OwnedFd};
use std::os::unix::net::UnixStream;
use std::os::unix::process::CommandExt as _;
use std::path::PathBuf;
use std::process::{Child, Command, ExitStatus, Stdio};
use std::time::{Duration, Instant};

use rustix::event::{PollFd, PollFlags, poll};
use rustix::io::Errno;
use rustix::process::{Signal, getpid, set_child_subreaper};
use rustix::time::Timespec;
use serde::{Deserialize, Serialize};
use tandem_board_host::spawn::{self, Watched};

use super::clean_up::CleanUp;
use super::descendants;
use super::group::{ControlGroup, MemoryGroups};
use crate::manifest::SafeState;

/// The shortest time of the watchdog: below, a busy machine would end a launcher that works.
const SHORTEST: Duration = Duration::from_millis(100);
/// The exit status of a launcher that gives up.
pub const GIVES_UP: u8 = 70;
/// The exit status of a launcher that has started nothing.
pub const NOTHING_STARTED: u8 = 2;

/// What the guardian watches, and what it runs.
#[derive(Clone, Debug, Default)]
pub struct GuardPlan {
    /// The manifest.
    pub manifest: PathBuf,
    /// The trust anchor.
    pub anchor: Option<PathBuf>,
    /// Pre-clean-up in place of the manifest's: it runs also if that cannot be read.
    pub before: Vec<String>,
    /// Post-clean-up in place of the manifest's.
    pub after: Vec<String>,
}

/// How it has ended.
#[derive(Debug)]
pub enum GuardEnd {
    /// The launcher has ended as it was asked to.
    Done,
    /// The launcher has started nothing; it has said why.
    NothingStarted,
    /// The unrecoverable state: why, and what of the clean-up has failed.
    CleanedUp(String, Vec<String>),
}

/// The line that the launcher sends first.
#[derive(Debug, Serialize, Deserialize)]
struct Begin {
    before: Vec<String>,
    after: Vec<String>,
    within_ms: u64,
    watchdog_ms: u64,
    group: String,
}

/// The launcher's end.
#[derive(Debug)]
pub(super) struct Link {
    stream: io::Stdin,
}

impl Link {
    pub(super) fn new() -> Self {
        Self {
            stream: io::stdin(),
        }
    }

    /// Tells the guardian what the clean-up needs.
    pub(super) fn begin(&mut self, safe_state: &SafeState, group: &str) {
        let begin = Begin {
            before: safe_state.before.clone(),
            after: safe_state.after.clone(),
            within_ms: safe_state.within.as_us() / 1_000,
            watchdog_ms: safe_state.watchdog.as_us() / 1_000,
            group: group.to_owned(),
        };
        let mut line = serde_json::to_string(&begin).unwrap_or_default();
        line.push('\n');
        self.send(line.as_bytes());
    }

    /// Says that the launcher lives. Returns whether the guardian does.
    pub(super) fn kick(&mut self) -> bool {
        self.send(b"\n")
    }

    fn send(&self, line: &[u8]) -> bool {
        // A guardian that is suspended reads later: its silence is no end.
        !matches!(
            rustix::io::write(&self.stream, line),
            Err(Errno::PIPE | Errno::CONNRESET)
        )
    }

    pub(super) fn fd(&self) -> BorrowedFd<'_> {
        self.stream.as_fd()
    }
}

/// The guardian while it watches.
#[derive(Debug)]
pub struct Guardian {
    plan: GuardPlan,
    clean_up: CleanUp,
    launcher: Child,
    watched: Watched,
    stream: UnixStream,
    heard: Vec<u8>,
    watchdog: Duration,
}

impl Guardian {
    /// Starts the launcher by this command, which must run [`super::ProcessLauncher::run`].
    ///
    /// # Errors
    /// If the system does not permit it.
    pub fn start(mut launcher: Command, plan: GuardPlan) -> io::Result<Self> {
        set_child_subreaper(Some(getpid()))?;
        let (stream, theirs) = UnixStream::pair()?;
        theirs.set_nonblocking(true)?;
        launcher
            .stdin(Stdio::from(OwnedFd::from(theirs)))
            .process_group(0);
        let child = launcher.spawn()?;
        drop(launcher);
        let watched = Watched::new(child.id()).ok_or(io::ErrorKind::NotFound)?;
        let defaults = SafeState::default();
        Ok(Self {
            clean_up: CleanUp {
                before: plan.before.clone(),
                after: plan.after.clone(),
                within_ms: defaults.within.as_us() / 1_000,
                manifest: None,
                group: None,
                memory: None,
            },
            plan,
            launcher: child,
            watched,
            stream,
            heard: vec![],
            watchdog: Duration::from_nanos(defaults.watchdog.as_ns()),
        })
    }

    /// Watches until the launcher has ended, and cleans up if need be. Bytes from `stops` are
    /// signals that the launcher gets, too. `warn` is told what the machine does not grant.
    ///
    /// # Errors
    /// If the system does not permit to watch.
    pub fn watch(mut self, stops: &UnixStream, warn: &mut dyn FnMut(&str)) -> io::Result<GuardEnd> {
        stops.set_nonblocking(true)?;
        self.stream.set_nonblocking(true)?;
        let mut last = Instant::now();
        let why = loop {
            if let Some(status) = self.launcher.try_wait()? {
                match status.code() {
                    Some(0) => {
                        self.clean_up.group.iter().for_each(ControlGroup::remove);
                        return Ok(GuardEnd::Done);
                    }
                    Some(code) if code == i32::from(NOTHING_STARTED) => {
                        self.clean_up.run();
                        return Ok(GuardEnd::NothingStarted);
                    }
                    _ => break ended(status),
                }
            }
            if self.hear(warn) {
                last = Instant::now();
            }
            if last.elapsed() > self.watchdog {
                // Fails if it has just ended.
                let _ = self.launcher.kill();
                self.launcher.wait()?;
                break format!("the launcher was silent for {:?}", self.watchdog);
            }
            self.sleep(stops, self.watchdog.saturating_sub(last.elapsed()));
            let mut bytes = [0; 16];
            for _ in 0..(&mut &*stops).read(&mut bytes).unwrap_or(0) {
                spawn::signal(self.launcher.id(), Signal::TERM);
            }
        };
        self.hear(warn);
        Ok(GuardEnd::CleanedUp(why, self.clean_up.run()))
    }

    fn sleep(&self, stops: &UnixStream, span: Duration) {
        let fds = [
            self.watched.fd().as_fd(),
            self.stream.as_fd(),
            stops.as_fd(),
        ];
        let mut fds = fds.map(|fd| PollFd::from_borrowed_fd(fd, PollFlags::IN));
        let span = Timespec {
            tv_sec: span.as_secs() as i64,
            tv_nsec: i64::from(span.subsec_nanos()) + 1,
        };
        // An interrupted poll needs no handling: the caller looks at everything anyway.
        let _ = poll(&mut fds, Some(&span));
    }

    /// Reads what the launcher has sent. Returns whether it was anything.
    fn hear(&mut self, warn: &mut dyn FnMut(&str)) -> bool {
        let mut bytes = [0; 4096];
        let mut has_heard = false;
        while let Ok(count @ 1..) = (&self.stream).read(&mut bytes) {
            has_heard = true;
            self.heard.extend(bytes.iter().take(count));
        }
        while let Some(end) = self.heard.iter().position(|byte| *byte == b'\n') {
            let line: Vec<u8> = self.heard.drain(..=end).collect();
            if let Ok(begin) = serde_json::from_slice::<Begin>(&line) {
                self.begin(begin, warn);
            }
        }
        has_heard
    }

    fn begin(&mut self, begin: Begin, warn: &mut dyn FnMut(&str)) {
        self.watchdog = SHORTEST.max(Duration::from_millis(begin.watchdog_ms));
        self.clean_up.within_ms = begin.within_ms;
        // Beside the start of the processes: a move takes 5 to 15 ms, in which the kernel waits.
        let launcher = self.launcher.id();
        let group = ControlGroup::make(&begin.group);
        let all = || descendants::living(&[launcher]);
        self.clean_up.group = group.filter(|it| it.take(all));
        self.clean_up.memory = MemoryGroups::named(&begin.group);
        if self.clean_up.group.is_none() {
            warn(
                "no control group (cgroup v2) is granted: process groups and /proc take its place",
            );
        }
        if self.plan.before.is_empty() && self.plan.after.is_empty() {
            self.clean_up.before = begin.before;
            self.clean_up.after = begin.after;
            self.clean_up.manifest = Some((self.plan.manifest.clone(), self.plan.anchor.clone()));
        }
    }
}

fn ended(status: ExitStatus) -> String {
    match status.code() {
        Some(code) if code == i32::from(GIVES_UP) => "the launcher has given up".to_owned(),
        _ => format!("the launcher has ended ({status})"),
    }
}
