//! Finds the processes of the runs on this machine in `/proc`.

use core::fmt;
use std::fs;

use tandem_board::{CoreId, Generation, RoleLamp, SystemId};

use crate::args::ProcessArgs;
use crate::name::RunName;
use crate::this_program::{command_line, loader_words};

/// Kind of a process.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ProcessKind {
    /// The supply of a system.
    Supply,
    /// A core, in one of its incarnations.
    Core(CoreId, Generation),
    /// The vehicle.
    Vehicle,
}

impl fmt::Display for ProcessKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Supply => "supply",
            Self::Core(..) => "core",
            Self::Vehicle => "vehicle",
        })
    }
}

/// One process of a run.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Process {
    /// The process id.
    pub pid: u32,
    /// Its run.
    pub run: RunName,
    /// Its kind.
    pub kind: ProcessKind,
    /// Its system; `None` for the vehicle.
    pub system: Option<SystemId>,
    /// The role that its system shows (`master`, `degraded`, `standby`, `suspended`, `starting`);
    /// `None` if it shows no role, and for the vehicle.
    pub role: Option<String>,
    /// The CPU on which it last ran.
    pub cpu: Option<u32>,
}

/// Returns the name of a role in [`Process::role`].
#[must_use]
pub const fn role_name(lamp: RoleLamp) -> &'static str {
    match lamp {
        RoleLamp::Starting => "starting",
        RoleLamp::Master => "master",
        RoleLamp::DegradedMaster => "degraded",
        RoleLamp::Standby => "standby",
        RoleLamp::Suspended => "suspended",
    }
}

/// Returns all runs' processes, sorted by run, then system (vehicle last), supply before cores.
///
/// Lists only processes that the caller may read in `/proc`. Processes that have ended but were not
/// waited for are left out.
#[must_use]
pub fn list() -> Vec<Process> {
    let mut found: Vec<Process> = pids().filter_map(look_at).collect();
    for at in 0..found.len() {
        found[at].role = found[at]
            .system
            .and_then(|system| role(&found, &found[at].run, system));
    }
    found.sort_by_key(|process| {
        let core = match process.kind {
            ProcessKind::Core(core, _) => 1 + core.index(),
            ProcessKind::Supply | ProcessKind::Vehicle => 0,
        };
        (
            process.run.clone(),
            process.system.map_or(2, SystemId::index),
            core,
            process.pid,
        )
    });
    found
}

/// Returns the processes of one run.
#[must_use]
pub fn of_run(run: &RunName) -> Vec<Process> {
    list()
        .into_iter()
        .filter(|process| process.run == *run)
        .collect()
}

/// Why no single run was found.
#[derive(Debug, thiserror::Error)]
pub enum RunError {
    /// No run is active.
    #[error("no run is active; `tandem run` starts one")]
    NoRun,
    /// The named run is not active.
    #[error("no run {0} is active; `tandem ps` lists the runs")]
    NotActive(String),
    /// Several runs are active.
    #[error("several runs are active; name one of them by --run: {0}")]
    Several(String),
}

/// Returns the run with this name, or the run started by the `tandem run` with this process id;
/// without a name, the only active run.
///
/// # Errors
/// If the run does not exist, or several match.
pub fn run_named(name: Option<&str>) -> Result<RunName, RunError> {
    Ok(process_of(name)?.run)
}

/// Returns a process of the run that [`run_named`] returns.
pub(crate) fn process_of(name: Option<&str>) -> Result<Process, RunError> {
    let mut found = list();
    found.retain(|process| {
        let run = process.run.as_str();
        name.is_none_or(|name| run == name || run.starts_with(&format!("tandem-{name}-")))
    });
    found.dedup_by(|one, other| one.run == other.run);
    match found.len() {
        0 => Err(name.map_or(RunError::NoRun, |name| RunError::NotActive(name.to_owned()))),
        1 => Ok(found.swap_remove(0)),
        _ => {
            let names: Vec<_> = found.iter().map(|it| it.run.to_string()).collect();
            Err(RunError::Several(names.join(", ")))
        }
    }
}

fn look_at(pid: u32) -> Option<Process> {
    let argv = command_line(&pid.to_string())?;
    let own = loader_words(&argv).max(1);
    let argv = argv.into_iter().skip(own);
    let args = ProcessArgs::parse(argv)?.ok()?;
    let stat = Stat::read(pid).filter(|stat| !stat.has_ended)?;
    let (kind, system) = match &args {
        ProcessArgs::Supply(args) => (ProcessKind::Supply, Some(args.system)),
        ProcessArgs::Core(args) => {
            let of = args.identity;
            (ProcessKind::Core(of.core, of.generation), Some(of.system))
        }
        ProcessArgs::Vehicle(_) => (ProcessKind::Vehicle, None),
    };
    Some(Process {
        pid,
        run: args.common().run.clone(),
        kind,
        system,
        role: None,
        cpu: stat.cpu,
    })
}

/// Returns the ids of all processes that `/proc` shows.
pub(crate) fn pids() -> impl Iterator<Item = u32> {
    let entries = fs::read_dir("/proc").into_iter().flatten().flatten();
    entries.filter_map(|entry| entry.file_name().to_str()?.parse().ok())
}

/// What `/proc/PID/stat` says of a process: fields 3, 4, 20 and 39 (proc(5)).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Stat {
    /// All of its threads have ended, not its first one alone. Its parent has not waited for it.
    pub(crate) has_ended: bool,
    pub(crate) parent: u32,
    /// The CPU on which it last ran.
    cpu: Option<u32>,
}

impl Stat {
    pub(crate) fn read(pid: u32) -> Option<Self> {
        Self::parse(&fs::read_to_string(format!("/proc/{pid}/stat")).ok()?)
    }

    /// Field 2, the name, may hold any character, so fields are counted from its closing bracket.
    fn parse(line: &str) -> Option<Self> {
        let mut fields = line.rsplit_once(')')?.1.split_whitespace();
        let is_zombie = matches!(fields.next()?, "Z" | "X");
        Some(Self {
            parent: fields.next()?.parse().ok()?,
            has_ended: fields.nth(15)?.parse::<u32>().ok()? <= 1 && is_zombie,
            cpu: fields.nth(18).and_then(|cpu| cpu.parse().ok()),
        })
    }
}

/// Reads the role of a system from the process name of its core 0, for example `A0 master`.
fn role(processes: &[Process], run: &RunName, system: SystemId) -> Option<String> {
    let control = processes.iter().find(|process| {
        let is_control = matches!(process.kind, ProcessKind::Core(CoreId::CONTROL, _));
        is_control && process.run == *run && process.system == Some(system)
    })?;
    let name = fs::read_to_string(format!("/proc/{}/comm", control.pid)).ok()?;
    let role = name.trim_end().strip_prefix(&format!("{system}0 "))?;
    Some(role.to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_name_of_a_process_cannot_confuse() {
        let tail = (4..=52)
            .map(|n| n.to_string())
            .collect::<Vec<_>>()
            .join(" ");
        let line = format!("17 (a) Z) 3 (x) S {tail}\n");
        let expected = Stat {
            has_ended: false,
            parent: 4,
            cpu: Some(39),
        };
        assert_eq!(Stat::parse(&line), Some(expected));
    }

    #[test]
    fn a_cut_line_is_no_process() {
        assert_eq!(Stat::parse("17 (x"), None);
        assert_eq!(Stat::parse("17 (x)"), None);
        assert_eq!(Stat::parse("17 (x) R 1 2"), None);
    }
}
