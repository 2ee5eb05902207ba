//! The clean-up of the unrecoverable state: pre-clean-up, SIGTERM, SIGKILL, post-clean-up (E-5).

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use rustix::event::{PollFd, PollFlags, poll};
use rustix::process::{Signal, kill_process_group};
use rustix::time::Timespec;
use tandem_board_host::spawn::{self, Watched};

use super::descendants;
use super::group::{ControlGroup, MemoryGroups};
use crate::manifest::SafeState;
use crate::trust::Platform;

const LOOK_AGAIN: Duration = Duration::from_millis(2);
/// How long killed processes may take to disappear.
const GONE_WITHIN: Duration = Duration::from_secs(5);

/// What the clean-up needs to know.
#[derive(Clone, Debug, Default)]
pub(super) struct CleanUp {
    /// Commands of the command line: they act whatever the manifest says.
    pub(super) before: Vec<String>,
    pub(super) after: Vec<String>,
    /// From SIGTERM to SIGKILL; also the longest time of a command, ms.
    pub(super) within_ms: u64,
    /// The manifest's folder and the anchor, for commands of the manifest.
    pub(super) manifest: Option<(PathBuf, Option<PathBuf>)>,
    pub(super) group: Option<ControlGroup>,
    pub(super) memory: Option<MemoryGroups>,
}

impl CleanUp {
    /// Cleans up. Returns what could not be done.
    pub(super) fn run(&self) -> Vec<String> {
        let within = Duration::from_millis(self.within_ms);
        let mut failed = vec![];
        failed.extend(self.command("pre-clean-up", &self.before, within).err());
        descendants::signal_all(Signal::TERM);
        wait_for_none(within);
        let deadline = Instant::now() + GONE_WITHIN;
        while descendants::signal_all(Signal::KILL) > 0 && Instant::now() < deadline {
            self.group.iter().for_each(ControlGroup::kill);
            std::thread::sleep(LOOK_AGAIN);
        }
        let left = descendants::living(&[]);
        if !left.is_empty() {
            failed.push(format!("processes that cannot be killed: {left:?}"));
        }
        self.group.iter().for_each(ControlGroup::remove);
        self.memory.iter().for_each(MemoryGroups::remove);
        failed.extend(self.command("post-clean-up", &self.after, within).err());
        failed
    }

    fn command(&self, what: &str, words: &[String], within: Duration) -> Result<(), String> {
        let Some((program, arguments)) = words.split_first() else {
            return Ok(());
        };
        let fail = |why: &dyn std::fmt::Display| format!("{what}: {program}: {why}");
        let (mut command, keep) = match &self.manifest {
            None => (Command::new(program), vec![]),
            Some((manifest, anchor)) => {
                let platform = Platform::open(manifest, anchor.as_deref());
                let trusted = platform.and_then(|it| it.command(Path::new(program)));
                let trusted = trusted.map_err(|error| fail(&error))?;
                (trusted.command, trusted.keep)
            }
        };
        command.args(arguments).stdin(Stdio::null());
        let placement = spawn::Placement {
            keep,
            ..Default::default()
        };
        let started = spawn::spawn(&mut command, &placement);
        let (mut child, _) = started.map_err(|error| fail(&error))?;
        if let Some(watched) = Watched::new(child.id()) {
            let mut fds = [PollFd::new(watched.fd(), PollFlags::IN)];
            let span = Timespec {
                tv_sec: within.as_secs() as i64,
                tv_nsec: i64::from(within.subsec_nanos()),
            };
            if poll(&mut fds, Some(&span)) == Ok(0) {
                // Fails if it has just ended.
                let _ = spawn::pid(child.id()).map(|pid| kill_process_group(pid, Signal::KILL));
            }
        }
        match child.wait() {
            Ok(status) if status.success() => Ok(()),
            Ok(status) => Err(fail(&status)),
            Err(error) => Err(fail(&error)),
        }
    }
}

/// The clean-up by a launcher that has lost its guardian.
#[derive(Clone, Debug)]
pub struct AloneCleanUp(CleanUp, String);

impl AloneCleanUp {
    pub(super) fn of(
        safe_state: &SafeState,
        manifest: (PathBuf, Option<PathBuf>),
        group: &str,
    ) -> Self {
        let clean_up = CleanUp {
            before: safe_state.before.clone(),
            after: safe_state.after.clone(),
            within_ms: safe_state.within.as_us() / 1_000,
            manifest: Some(manifest),
            group: None,
            memory: MemoryGroups::named(group),
        };
        Self(clean_up, group.to_owned())
    }

    /// Cleans up. Returns what could not be done.
    pub(super) fn run(&self) -> Vec<String> {
        let mut clean_up = self.0.clone();
        clean_up.group = ControlGroup::leave(&self.1);
        clean_up.run()
    }
}

/// Waits until no descendant is left, but no longer than this.
fn wait_for_none(within: Duration) {
    let deadline = Instant::now() + within;
    while !descendants::living(&[]).is_empty() && Instant::now() < deadline {
        std::thread::sleep(LOOK_AGAIN);
    }
}
