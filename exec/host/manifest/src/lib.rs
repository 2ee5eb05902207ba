//! The manifest: which processes may run, how, and in which run targets. One TOML file, one reader.
#![forbid(unsafe_code)]

mod checks;
mod span;

use std::collections::BTreeMap;
use std::path::PathBuf;

use serde::{Deserialize, Serialize};
use tandem_board::Duration;
use toml::Spanned;

/// Why a manifest was refused. Names the line, the key and what was expected.
#[derive(Debug, thiserror::Error)]
pub enum ManifestError {
    /// It is no UTF-8 text.
    #[error("the manifest is not UTF-8 text: {0}")]
    Text(#[from] std::str::Utf8Error),
    /// It is no TOML, or a key is unknown, missing or of the wrong type.
    #[error("{0}")]
    Toml(#[from] toml::de::Error),
    /// The values contradict each other: the line, from 1, and what was expected.
    #[error("line {0}: {1}")]
    Value(usize, String),
}

/// A checked manifest: all names are resolved, and dependencies have no circle.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields, rename_all = "kebab-case")]
pub struct Manifest {
    version: Spanned<u32>,
    initial: Spanned<String>,
    fallback: Option<Spanned<String>>,
    /// What happens in the unrecoverable state.
    #[serde(default)]
    pub safe_state: SafeState,
    /// The processes.
    #[serde(rename = "process", default)]
    pub processes: Vec<ProcessPlan>,
    /// The run targets.
    #[serde(rename = "target")]
    pub targets: Vec<RunTarget>,
}

/// One process.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields, rename_all = "kebab-case")]
pub struct ProcessPlan {
    name: Spanned<String>,
    /// The executable, relative to the manifest's folder.
    pub program: PathBuf,
    /// Its arguments, without the program's name.
    #[serde(default)]
    pub arguments: Vec<String>,
    /// Its environment, beside `PATH` and what the launcher sets.
    #[serde(default)]
    pub environment: BTreeMap<String, String>,
    /// Its working directory, relative to the manifest's folder, which is the default.
    #[serde(default)]
    pub directory: PathBuf,
    /// A file for what it prints, relative to the manifest's folder; the launcher's by default.
    pub output: Option<PathBuf>,
    /// The numbers of the CPUs on which it may run; all by default.
    pub cpus: Option<Vec<usize>>,
    /// Its scheduling policy.
    #[serde(default)]
    pub policy: SchedulingPolicy,
    /// Its priority under `fifo` and `round-robin`, 1 ..= 99.
    pub priority: Option<Spanned<u8>>,
    /// Its user.
    pub uid: Option<u32>,
    /// Its group.
    pub gid: Option<u32>,
    /// Its supplementary groups; none by default if `uid` or `gid` is given.
    pub groups: Option<Vec<u32>>,
    /// What it may use.
    #[serde(default)]
    pub limits: ResourceLimits,
    #[serde(default)]
    after: Vec<Spanned<String>>,
    /// What makes it ready.
    #[serde(default)]
    pub ready: ReadyBy,
    /// Time from its start within which it must be ready.
    #[serde(default = "span::second", deserialize_with = "span::read")]
    pub ready_within: Duration,
    /// Whether it may end with status 0 when it is ready.
    #[serde(default)]
    pub may_end: bool,
    /// Time from SIGTERM to SIGKILL.
    #[serde(default = "span::second", deserialize_with = "span::read")]
    pub stop_within: Duration,
    /// What happens when it fails.
    #[serde(default)]
    pub restart: Restart,
    /// How often it must say that it is alive.
    pub alive: Option<AliveLimits>,
    /// How long it may take from one checkpoint to another.
    #[serde(default)]
    pub deadlines: Vec<DeadlineLimits>,
    /// In which order checkpoints may be reached.
    pub logical: Option<LogicalOrder>,
    /// It manages the state: it may switch the run target, and its failure is unrecoverable.
    #[serde(default)]
    pub state_management: bool,
    /// The indices of the processes that must be ready before it starts.
    #[serde(skip)]
    pub dependencies: Vec<usize>,
}

/// What makes a process ready.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum ReadyBy {
    /// It says so: `READY=1`.
    #[default]
    Report,
    /// It was started.
    Running,
    /// It has ended with status 0.
    Exit,
}

/// A scheduling policy of the kernel.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum SchedulingPolicy {
    /// `SCHED_OTHER`.
    #[default]
    Other,
    /// `SCHED_FIFO`.
    Fifo,
    /// `SCHED_RR`.
    RoundRobin,
}

/// Limits by `setrlimit`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields, rename_all = "kebab-case")]
pub struct ResourceLimits {
    /// Writable memory, bytes (`RLIMIT_DATA`; also the group's limit where cgroups grant one).
    pub memory: Option<u64>,
    /// Number of open files.
    pub open_files: Option<u64>,
    /// Number of processes and threads of its user.
    pub processes: Option<u64>,
    /// Size of a file that it writes, bytes.
    pub file_size: Option<u64>,
    /// Size of a core dump, bytes.
    pub core: Option<u64>,
    /// Time on CPUs, s.
    pub cpu_time: Option<u64>,
    /// Memory that it may lock, bytes.
    pub locked_memory: Option<u64>,
}

/// How often a process is started again after a failure. The count begins anew when a run target
/// starts the process.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields, rename_all = "kebab-case")]
pub struct Restart {
    /// How often; then the fallback target runs.
    pub times: u32,
    /// Pause before each.
    #[serde(default, deserialize_with = "span::read")]
    pub pause: Duration,
}

/// Alive supervision: the number of `WATCHDOG=1` in each cycle.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields, rename_all = "kebab-case")]
pub struct AliveLimits {
    /// Length of a cycle. The first begins when the process is ready.
    #[serde(deserialize_with = "span::read")]
    pub every: Duration,
    /// The least number in a cycle.
    #[serde(default = "span::one")]
    pub least: u32,
    /// The greatest number in a cycle.
    #[serde(default = "span::many")]
    pub most: u32,
    /// How many cycles in a row may be wrong.
    #[serde(default)]
    pub tolerated: u32,
}

/// Deadline supervision: the time from one checkpoint to another.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields, rename_all = "kebab-case")]
pub struct DeadlineLimits {
    /// The checkpoint that starts the time.
    pub from: u32,
    /// The checkpoint that ends it.
    pub to: u32,
    /// The shortest time.
    #[serde(default, deserialize_with = "span::read")]
    pub least: Duration,
    /// The longest time.
    #[serde(deserialize_with = "span::read")]
    pub most: Duration,
}

/// Logical supervision: the order of checkpoints.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields, rename_all = "kebab-case")]
pub struct LogicalOrder {
    /// The checkpoints that may be first.
    pub first: Vec<u32>,
    /// Which checkpoint may follow which.
    pub next: Vec<(u32, u32)>,
}

/// A set of processes that run together.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields, rename_all = "kebab-case")]
pub struct RunTarget {
    name: Spanned<String>,
    processes: Vec<Spanned<String>>,
    /// The indices of its processes and of all that these depend on, ascending.
    #[serde(skip)]
    pub members: Vec<usize>,
}

/// What happens in the unrecoverable state, which is also the safe state (E-5, E-6).
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields, rename_all = "kebab-case", default)]
pub struct SafeState {
    /// Pre-clean-up: a command that runs before processes are told to end.
    pub before: Vec<String>,
    /// Post-clean-up: a command that runs when no process is left, for example a reset.
    pub after: Vec<String>,
    /// Time from SIGTERM to SIGKILL; also the time that each command may take.
    #[serde(deserialize_with = "span::read", serialize_with = "span::write")]
    pub within: Duration,
    /// Time without a sign of life from the launcher after which the guardian ends it and cleans
    /// up; at least 100 ms.
    #[serde(deserialize_with = "span::read", serialize_with = "span::write")]
    pub watchdog: Duration,
}

impl Default for SafeState {
    fn default() -> Self {
        Self {
            before: vec![],
            after: vec![],
            within: Duration::from_ms(1_000),
            watchdog: Duration::from_ms(5_000),
        }
    }
}

impl Manifest {
    /// Reads and checks a manifest.
    ///
    /// # Errors
    /// [`ManifestError`] names line and key.
    pub fn read(bytes: &[u8]) -> Result<Self, ManifestError> {
        let text = std::str::from_utf8(bytes)?;
        let mut manifest: Self = toml::from_str(text)?;
        checks::resolve(&mut manifest, text)?;
        Ok(manifest)
    }

    /// Returns the index of the run target with this name.
    #[must_use]
    pub fn target_named(&self, name: &str) -> Option<usize> {
        self.targets.iter().position(|target| target.name() == name)
    }

    /// Returns the index of the first run target.
    #[must_use]
    pub fn initial(&self) -> usize {
        self.target_named(self.initial.get_ref()).unwrap_or(0)
    }

    /// Returns the index of the run target that follows a failure.
    #[must_use]
    pub fn fallback(&self) -> Option<usize> {
        self.target_named(self.fallback.as_ref()?.get_ref())
    }
}

impl ProcessPlan {
    /// Returns its name.
    #[must_use]
    pub fn name(&self) -> &str {
        self.name.get_ref()
    }

    /// Returns whether the launcher listens to what it says.
    #[must_use]
    pub fn reports(&self) -> bool {
        let supervised = self.alive.is_some() || self.logical.is_some();
        self.ready == ReadyBy::Report || supervised || !self.deadlines.is_empty()
    }
}

impl RunTarget {
    /// Returns its name.
    #[must_use]
    pub fn name(&self) -> &str {
        self.name.get_ref()
    }
}

#[cfg(test)]
mod tests;
