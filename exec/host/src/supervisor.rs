//! The supervisor: what to start, to end and to restart, and when the safe state is due. Sans-IO.
//!
//! A process is in one of these states:
//!
//! | state | left by | to |
//! |---|---|---|
//! | off | a target wants it, all it depends on is ready | starting |
//! | starting | its report, start or end with status 0, as the manifest says | ready, finished |
//! | starting, ready | no target wants it, and nothing that depends on it runs | ending |
//! | starting, ready | it is late, or breaks a rule of its supervision | ending, as failed |
//! | starting, ready | it ended | pausing or failed; finished if it may end |
//! | ending | it ended | off; pausing or failed if it had failed |
//! | pausing | the pause is over, and all it depends on is ready | starting |
//! | failed, finished | a target that does not hold it | off |
//!
//! A process that fails more often than its manifest permits leads to the fallback target; a second
//! one, in the fallback target, to the safe state (E-6). Dependents of a failed process run on.

mod event;
mod monitor;

use core::fmt;
use std::sync::Arc;

use tandem_board::{Duration, Instant};

use crate::manifest::{Manifest, ReadyBy};
pub use event::{LaunchEvent, PlatformState, ProcessRow, Told};
use monitor::Monitor;

/// How a process ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ExitKind {
    /// With this status.
    Code(i32),
    /// By this signal.
    Signal(i32),
}

/// What a process says (`NOTIFY_SOCKET`).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ProcessReport {
    /// It is ready.
    Ready,
    /// It is alive.
    Alive,
    /// It is about to end, and is no longer supervised.
    Stopping,
    /// It has reached a checkpoint, at this time.
    Checkpoint(u32, Instant),
}

/// What has happened.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Input {
    /// The process runs.
    Started(usize),
    /// The process could not be started.
    NotStarted(usize, String),
    /// The process said something.
    Report(usize, ProcessReport),
    /// The process has ended.
    Ended(usize, ExitKind),
    /// State management wants this run target.
    Switch(usize),
    /// All is to end.
    Stop,
    /// Time has passed.
    Tick,
}

/// What the caller must do, in this order.
#[derive(Clone, Debug, PartialEq, Eq)]
#[must_use]
pub enum Action {
    /// Start the process, and answer by [`Input::Started`] or [`Input::NotStarted`].
    Start(usize),
    /// Send SIGTERM.
    Terminate(usize),
    /// Send SIGKILL to the process and to all that it has started.
    Kill(usize),
    /// Tell it to people and to state management.
    Tell(LaunchEvent),
    /// Nothing more will happen. Unless it is [`Outcome::Done`], clean up.
    End(Outcome),
}

/// What follows a failure.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Recovery {
    /// The process is started again; the number of this restart.
    Restart(u32),
    /// No target wants the process any more.
    None,
    /// The fallback target is next.
    Fallback,
    /// The safe state is next.
    SafeState,
}

/// Why a process has failed.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ProcessFailure {
    /// It did not start.
    #[error("it did not start: {0}")]
    NotStarted(String),
    /// It was not ready in time.
    #[error("it was not ready within {} ms", .0.as_us() / 1_000)]
    NotReady(Duration),
    /// It ended.
    #[error("it ended: {0}")]
    Ended(ExitKind),
    /// It said too seldom or too often that it is alive.
    #[error("it was alive {0} times in a cycle")]
    Alive(u32),
    /// The time between two checkpoints was too short or too long.
    #[error("from checkpoint {0} to {1} it was too fast or too slow")]
    Deadline(u32, u32),
    /// This checkpoint may not follow the last one.
    #[error("checkpoint {0} is out of order")]
    Order(u32),
}

/// How all of it has ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Outcome {
    /// As asked for, or because nothing is left to run.
    Done,
    /// The safe state: the fallback target has failed, too, or there is none (E-6).
    SafeState(usize),
    /// State management has failed (E-5).
    NoStateManagement(usize),
}

impl fmt::Display for ExitKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Code(code) => write!(f, "exit status: {code}"),
            Self::Signal(signal) => write!(f, "signal: {signal}"),
        }
    }
}

impl fmt::Display for Recovery {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Restart(number) => write!(f, "restart {number}"),
            Self::None => f.write_str("not needed any more"),
            Self::Fallback => f.write_str("fallback"),
            Self::SafeState => f.write_str("safe state"),
        }
    }
}

/// The state of a process.
#[derive(Clone, Debug, PartialEq, Eq)]
enum UnitState {
    Off,
    Starting {
        until: Instant,
    },
    Ready,
    Finished,
    Ending {
        until: Instant,
        failed: Option<ProcessFailure>,
    },
    Pausing {
        until: Instant,
    },
    Failed,
}

impl UnitState {
    /// A process of this state exists, and is not told to end.
    const fn is_up(&self) -> bool {
        matches!(self, Self::Starting { .. } | Self::Ready)
    }

    /// A process of this state exists.
    const fn exists(&self) -> bool {
        self.is_up() || matches!(self, Self::Ending { .. })
    }

    /// What depends on it may start.
    const fn is_ready(&self) -> bool {
        matches!(self, Self::Ready | Self::Finished)
    }
}

#[derive(Debug)]
struct Unit {
    state: UnitState,
    restarts: u32,
    monitor: Option<Monitor>,
}

/// The state machine. Told the time and what has happened, it returns what to do.
#[derive(Debug)]
pub struct Supervisor {
    manifest: Arc<Manifest>,
    units: Vec<Unit>,
    /// The run target; `None` when all is to end.
    target: Option<usize>,
    is_reached: bool,
    /// A failure has led to the current target.
    is_fallback: bool,
    over: Option<Outcome>,
}

impl Supervisor {
    /// Returns a supervisor of processes that do not run yet. Its first [`Input::Switch`] starts
    /// them.
    #[must_use]
    pub fn new(manifest: Arc<Manifest>) -> Self {
        let unit = |_: &_| Unit {
            state: UnitState::Off,
            restarts: 0,
            monitor: None,
        };
        Self {
            units: manifest.processes.iter().map(unit).collect(),
            manifest,
            target: None,
            is_reached: false,
            is_fallback: false,
            over: None,
        }
    }

    /// Returns what to do after this. Inputs about an unknown process or target do nothing.
    pub fn on_input(&mut self, now: Instant, input: Input) -> Vec<Action> {
        let mut actions = vec![];
        if self.over.is_some() {
            return actions;
        }
        match input {
            Input::Started(at) => self.started(now, at, &mut actions),
            Input::NotStarted(at, why) => {
                self.failed(now, at, ProcessFailure::NotStarted(why), &mut actions);
            }
            Input::Report(at, report) => self.report(now, at, report, &mut actions),
            Input::Ended(at, how) => self.ended(now, at, how, &mut actions),
            Input::Switch(target) if target < self.manifest.targets.len() => {
                self.is_fallback = false;
                self.switch(target, &mut actions);
            }
            Input::Switch(_) => {}
            Input::Stop => self.target = None,
            Input::Tick => self.tick(now, &mut actions),
        }
        self.settle(now, &mut actions);
        actions
    }

    /// Returns when [`Input::Tick`] is due next.
    #[must_use]
    pub fn next_tick(&self, now: Instant) -> Option<Instant> {
        let due = |(at, unit): (usize, &Unit)| {
            let until = match &unit.state {
                UnitState::Starting { until }
                | UnitState::Ending { until, .. }
                | UnitState::Pausing { until } => *until,
                _ => Instant::NEVER,
            };
            let plan = &self.manifest.processes[at];
            let monitor = unit.monitor.as_ref();
            until.min(monitor.map_or(Instant::NEVER, |it| it.next(plan)))
        };
        let due = self.units.iter().enumerate().map(due);
        due.filter(|due| *due > now && *due < Instant::NEVER).min()
    }

    /// Returns the state of a process, in a word, and how often it was restarted.
    #[must_use]
    pub fn state_of(&self, at: usize) -> (&'static str, u32) {
        let Some(unit) = self.units.get(at) else {
            return ("unknown", 0);
        };
        let word = match unit.state {
            UnitState::Off => "off",
            UnitState::Starting { .. } => "starting",
            UnitState::Ready => "ready",
            UnitState::Finished => "finished",
            UnitState::Ending { .. } => "ending",
            UnitState::Pausing { .. } => "pausing",
            UnitState::Failed => "failed",
        };
        (word, unit.restarts)
    }

    /// Returns the run target, and whether all of its processes are ready.
    #[must_use]
    pub const fn target(&self) -> (Option<usize>, bool) {
        (self.target, self.is_reached)
    }

    fn wants(&self, at: usize) -> bool {
        let members = self.target.map(|it| self.manifest.targets[it].members());
        members.is_some_and(|it| it.contains(&at))
    }

    fn switch(&mut self, target: usize, actions: &mut Vec<Action>) {
        self.target = Some(target);
        self.is_reached = false;
        let name = self.manifest.targets[target].name().to_owned();
        actions.push(Action::Tell(LaunchEvent::Switching { target: name }));
        for at in 0..self.units.len() {
            let is_wanted = self.wants(at);
            let unit = &mut self.units[at];
            let forgets = match unit.state {
                UnitState::Failed => true,
                UnitState::Finished | UnitState::Pausing { .. } => !is_wanted,
                _ => false,
            };
            if forgets {
                unit.state = UnitState::Off;
            }
        }
    }

    fn started(&mut self, now: Instant, at: usize, actions: &mut Vec<Action>) {
        let plan = self.manifest.processes.get(at);
        if plan.is_some_and(|plan| plan.ready == ReadyBy::Running) {
            self.ready(now, at, actions);
        }
    }

    fn ready(&mut self, now: Instant, at: usize, actions: &mut Vec<Action>) {
        let manifest = Arc::clone(&self.manifest);
        let (Some(unit), Some(plan)) = (self.units.get_mut(at), manifest.processes.get(at)) else {
            return;
        };
        if matches!(unit.state, UnitState::Starting { .. }) {
            unit.state = UnitState::Ready;
            unit.monitor = Monitor::begin(plan, now);
            let process = plan.name().to_owned();
            actions.push(Action::Tell(LaunchEvent::Ready { process }));
        }
    }

    fn report(
        &mut self,
        now: Instant,
        at: usize,
        report: ProcessReport,
        actions: &mut Vec<Action>,
    ) {
        let manifest = Arc::clone(&self.manifest);
        let (Some(unit), Some(plan)) = (self.units.get_mut(at), manifest.processes.get(at)) else {
            return;
        };
        let failure = match (report, &mut unit.monitor) {
            (ProcessReport::Ready, _) if plan.ready == ReadyBy::Report => {
                return self.ready(now, at, actions);
            }
            (ProcessReport::Stopping, monitor) => {
                *monitor = None;
                None
            }
            (ProcessReport::Alive, Some(monitor)) => {
                monitor.alive();
                None
            }
            (ProcessReport::Checkpoint(number, then), Some(monitor)) => {
                monitor.checkpoint(plan, number, then.min(now))
            }
            _ => None,
        };
        if let Some(failure) = failure {
            self.failed(now, at, failure, actions);
        }
    }

    fn ended(&mut self, now: Instant, at: usize, how: ExitKind, actions: &mut Vec<Action>) {
        let manifest = Arc::clone(&self.manifest);
        let (Some(unit), Some(plan)) = (self.units.get_mut(at), manifest.processes.get(at)) else {
            return;
        };
        unit.monitor = None;
        let is_ready = match unit.state {
            UnitState::Starting { .. } => plan.ready == ReadyBy::Exit,
            UnitState::Ready => plan.may_end(),
            _ => false,
        };
        match core::mem::replace(&mut unit.state, UnitState::Off) {
            UnitState::Ending { failed: None, .. } => {}
            UnitState::Ending {
                failed: Some(failure),
                ..
            } => {
                self.recover(now, at, failure, actions);
            }
            UnitState::Starting { .. } | UnitState::Ready
                if is_ready && how == ExitKind::Code(0) =>
            {
                unit.state = UnitState::Finished;
                if plan.ready == ReadyBy::Exit {
                    let process = plan.name().to_owned();
                    actions.push(Action::Tell(LaunchEvent::Ready { process }));
                }
            }
            UnitState::Starting { .. } | UnitState::Ready => {
                self.recover(now, at, ProcessFailure::Ended(how), actions);
            }
            // An end that was told twice.
            other => unit.state = other,
        }
    }

    /// Handles a failure of a process that may still exist: if so, it must end first.
    fn failed(
        &mut self,
        now: Instant,
        at: usize,
        failure: ProcessFailure,
        actions: &mut Vec<Action>,
    ) {
        let Some(unit) = self.units.get_mut(at).filter(|it| it.state.is_up()) else {
            return;
        };
        unit.monitor = None;
        if matches!(failure, ProcessFailure::NotStarted(_)) {
            return self.recover(now, at, failure, actions);
        }
        unit.state = UnitState::Ending {
            until: now + self.manifest.processes[at].stop_within,
            failed: Some(failure),
        };
        actions.push(Action::Terminate(at));
    }

    /// Decides what follows the failure of a process that no longer exists.
    fn recover(
        &mut self,
        now: Instant,
        at: usize,
        failure: ProcessFailure,
        actions: &mut Vec<Action>,
    ) {
        let restart = self.manifest.processes[at].restart;
        let is_wanted = self.wants(at);
        let unit = &mut self.units[at];
        let recovery = if !is_wanted {
            unit.state = UnitState::Off;
            Recovery::None
        } else if unit.restarts < restart.times {
            unit.restarts += 1;
            let until = now + restart.pause;
            unit.state = UnitState::Pausing { until };
            Recovery::Restart(unit.restarts)
        } else {
            unit.state = UnitState::Failed;
            match self.manifest.fallback() {
                Some(_) if !self.is_fallback && !self.manages_state(at) => Recovery::Fallback,
                _ => Recovery::SafeState,
            }
        };
        actions.push(Action::Tell(LaunchEvent::Failed {
            process: self.manifest.processes[at].name().to_owned(),
            why: failure,
            next: recovery,
        }));
        match (recovery, self.manifest.fallback()) {
            (Recovery::Fallback, Some(fallback)) => {
                self.is_fallback = true;
                self.switch(fallback, actions);
            }
            (Recovery::SafeState, _) if self.manages_state(at) => {
                self.end(Outcome::NoStateManagement(at), actions);
            }
            (Recovery::SafeState, _) => self.end(Outcome::SafeState(at), actions),
            _ => {}
        }
    }

    fn manages_state(&self, at: usize) -> bool {
        self.manifest.processes[at].state_management
    }

    fn end(&mut self, outcome: Outcome, actions: &mut Vec<Action>) {
        self.over = Some(outcome);
        actions.push(Action::End(outcome));
    }

    fn tick(&mut self, now: Instant, actions: &mut Vec<Action>) {
        let manifest = Arc::clone(&self.manifest);
        for (at, plan) in manifest.processes.iter().enumerate() {
            let unit = &mut self.units[at];
            let failure = match &mut unit.state {
                UnitState::Starting { until } if *until <= now => {
                    Some(ProcessFailure::NotReady(plan.ready_within))
                }
                UnitState::Ending { until, .. } if *until <= now => {
                    *until = Instant::NEVER;
                    actions.push(Action::Kill(at));
                    None
                }
                _ => unit.monitor.as_mut().and_then(|it| it.tick(plan, now)),
            };
            if let Some(failure) = failure {
                self.failed(now, at, failure, actions);
            }
        }
    }

    /// Ends what no target wants, in reverse order of dependency; then starts what it wants, as far
    /// as dependencies permit.
    fn settle(&mut self, now: Instant, actions: &mut Vec<Action>) {
        if self.over.is_some() {
            return;
        }
        let count = self.units.len();
        let unwanted: Vec<usize> = (0..count).filter(|at| !self.wants(*at)).collect();
        for at in &unwanted {
            let depends = |other: &usize| {
                let dependencies = self.manifest.processes[*other].dependencies();
                dependencies.contains(at) && self.units[*other].state.exists()
            };
            if self.units[*at].state.is_up() && !(0..count).any(|other| depends(&other)) {
                let until = now + self.manifest.processes[*at].stop_within;
                let unit = &mut self.units[*at];
                unit.monitor = None;
                unit.state = UnitState::Ending {
                    until,
                    failed: None,
                };
                actions.push(Action::Terminate(*at));
            }
        }
        if unwanted.iter().any(|at| self.units[*at].state.exists()) {
            return;
        }
        let Some(target) = self.target else {
            return self.end(Outcome::Done, actions);
        };
        let members = self.manifest.targets[target].members().to_vec();
        for at in &members {
            self.start_if_due(now, *at, actions);
        }
        let is =
            |test: fn(&UnitState) -> bool| members.iter().all(|at| test(&self.units[*at].state));
        if !self.is_reached && is(UnitState::is_ready) {
            self.is_reached = true;
            let target = self.manifest.targets[target].name().to_owned();
            actions.push(Action::Tell(LaunchEvent::Reached { target }));
        }
        if self.is_reached && is(|state| *state == UnitState::Finished) {
            self.end(Outcome::Done, actions);
        }
    }

    fn start_if_due(&mut self, now: Instant, at: usize, actions: &mut Vec<Action>) {
        let plan = &self.manifest.processes[at];
        let mut dependencies = plan.dependencies().iter();
        if !dependencies.all(|it| self.units[*it].state.is_ready()) {
            return;
        }
        let unit = &mut self.units[at];
        match unit.state {
            UnitState::Off => unit.restarts = 0,
            UnitState::Pausing { until } if until <= now => {}
            _ => return,
        }
        let until = now + plan.ready_within;
        unit.state = UnitState::Starting { until };
        actions.push(Action::Start(at));
    }
}

#[cfg(test)]
mod tests;
