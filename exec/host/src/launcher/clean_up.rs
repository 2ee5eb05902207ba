//! The clean-up of the unrecoverable state: pre-clean-up, SIGTERM, SIGKILL, post-clean-up (E-5).

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use rustix::process::Signal;
use serde::{Deserialize, Serialize};
use tandem_board::Duration;
use tandem_board_host::control_group::{ControlGroup, MemoryGroups};
use tandem_board_host::spawn::{self, Placement, Watched};
use tandem_board_host::{clock, descendants};

use crate::trust::Platform;
use tandem_manifest::SafeState;

/// How long killed processes may take to disappear.
const GONE_WITHIN: Duration = Duration::from_ms(5_000);

/// What the clean-up needs to know. The launcher sends it to its guardian, as a line of JSON.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub(super) struct CleanUp {
    pub(super) safe_state: SafeState,
    /// The name of the launcher's control groups, if it has begun.
    pub(super) name: Option<String>,
    #[serde(skip)]
    pub(super) group: Option<ControlGroup>,
    /// The manifest and the anchor, for commands of the manifest. Those of the command line act
    /// whatever the manifest says.
    #[serde(skip)]
    pub(super) files: Option<(PathBuf, Option<PathBuf>)>,
}

impl CleanUp {
    /// Cleans up. Returns what could not be done.
    pub(super) fn run(&self) -> Vec<String> {
        let SafeState { before, after, .. } = &self.safe_state;
        let mut failed = vec![];
        failed.extend(self.command("pre-clean-up", before).err());
        descendants::signal_all(Signal::TERM);
        clock::wait_until(self.safe_state.within, || {
            descendants::living(&[]).is_empty()
        });
        clock::wait_until(GONE_WITHIN, || {
            let left = descendants::signal_all(Signal::KILL);
            self.group.iter().for_each(ControlGroup::kill);
            left == 0
        });
        let left = descendants::living(&[]);
        if !left.is_empty() {
            failed.push(format!("processes that cannot be killed: {left:?}"));
        }
        self.group.iter().for_each(ControlGroup::remove);
        let memory = self.name.as_deref().and_then(MemoryGroups::named);
        memory.iter().for_each(MemoryGroups::remove);
        failed.extend(self.command("post-clean-up", after).err());
        failed
    }

    /// Cleans up in a launcher that has lost its guardian.
    pub(super) fn run_alone(mut self) {
        self.group = self.name.as_deref().and_then(ControlGroup::leave);
        self.run();
    }

    fn command(&self, what: &str, words: &[String]) -> Result<(), String> {
        let Some((program, arguments)) = words.split_first() else {
            return Ok(());
        };
        let fail = |why: &dyn std::fmt::Display| format!("{what}: {program}: {why}");
        let mut placement = Placement::default();
        let mut command = Command::new(program);
        if let Some((manifest, anchor)) = &self.files {
            let platform = Platform::open(manifest, anchor.as_deref());
            let trusted = platform.and_then(|it| it.command(Path::new(program)));
            let trusted = trusted.map_err(|error| fail(&error))?;
            (command, placement.keep) = (trusted.command, trusted.keep);
        }
        command.args(arguments).stdin(Stdio::null());
        let started = spawn::spawn(&mut command, &placement);
        let (mut child, _) = started.map_err(|error| fail(&error))?;
        if let Some(watched) = Watched::new(child.id()) {
            clock::wait_until(self.safe_state.within, || watched.has_ended());
            if !watched.has_ended() {
                spawn::kill_group(child.id());
            }
        }
        match child.wait() {
            Ok(status) if status.success() => Ok(()),
            Ok(status) => Err(fail(&status)),
            Err(error) => Err(fail(&error)),
        }
    }
}
