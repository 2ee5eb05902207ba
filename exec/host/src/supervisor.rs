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

use tandem_board::Instant;

pub use event::{LaunchEvent, PlatformState, ProcessRow, Told};
use monitor::Monitor;
use tandem_manifest::{Manifest, ReadyBy};

/// How a process ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ExitKind {
    /// With this status.
    #[error("exit status: {0}")]
    Code(i32),
    /// By this signal.
    #[error("signal: {0}")]
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
    Starting,
    Ready,
    Finished,
    /// As failed, if it has failed.
    Ending(Option<String>),
    Pausing,
    Failed,
}

impl UnitState {
    /// A process of this state exists, and is not told to end.
    const fn is_up(&self) -> bool {
        matches!(self, Self::Starting | Self::Ready)
    }

    /// A process of this state exists.
    const fn exists(&self) -> bool {
        self.is_up() || matches!(self, Self::Ending(_))
    }

    /// What depends on it may start.
    const fn is_ready(&self) -> bool {
        matches!(self, Self::Ready | Self::Finished)
    }
}

#[derive(Debug)]
struct Unit {
    state: UnitState,
    /// When the state is over, by time.
    until: Instant,
    restarts: u32,
    /// While it is ready, until it says that it ends.
    monitor: Option<Monitor>,
}

impl Unit {
    /// Changes the state, and returns the last one.
    fn enter(&mut self, state: UnitState) -> UnitState {
        (self.until, self.monitor) = (Instant::NEVER, None);
        core::mem::replace(&mut self.state, state)
    }
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
    is_over: bool,
    /// The time of the input, and what to do after it.
    now: Instant,
    actions: Vec<Action>,
}

impl Supervisor {
    /// Returns a supervisor of processes that do not run yet. Its first [`Input::Switch`] starts
    /// them.
    #[must_use]
    pub fn new(manifest: Arc<Manifest>) -> Self {
        let unit = |_: &_| Unit {
            state: UnitState::Off,
            until: Instant::NEVER,
            restarts: 0,
            monitor: None,
        };
        Self {
            units: manifest.processes.iter().map(unit).collect(),
            manifest,
            target: None,
            is_reached: false,
            is_fallback: false,
            is_over: false,
            now: Instant::ORIGIN,
            actions: vec![],
        }
    }

    /// Returns what to do after this. Inputs about an unknown process or target do nothing.
    pub fn on_input(&mut self, now: Instant, input: Input) -> Vec<Action> {
        self.now = now;
        let exists = |at: usize| self.units.get(at).is_some_and(|it| it.state.exists());
        match input {
            _ if self.is_over => {}
            Input::Started(at) if exists(at) => self.ready(at, ReadyBy::Running),
            Input::NotStarted(at, why) if exists(at) => {
                self.recover(at, format!("it did not start: {why}"));
            }
            Input::Report(at, report) if exists(at) => self.report(at, report),
            Input::Ended(at, how) if exists(at) => self.ended(at, how),
            Input::Switch(target) if target < self.manifest.targets.len() => {
                self.is_fallback = false;
                self.switch(target);
            }
            Input::Stop => (self.target, self.is_reached) = (None, false),
            Input::Tick => (0..self.units.len()).for_each(|at| self.tick(at)),
            _ => {}
        }
        if !self.is_over {
            self.settle();
        }
        core::mem::take(&mut self.actions)
    }

    /// Returns when [`Input::Tick`] is due next.
    #[must_use]
    pub fn next_tick(&self, now: Instant) -> Option<Instant> {
        let units = self.units.iter().zip(&self.manifest.processes);
        let due = units.flat_map(|(unit, plan)| {
            let monitor = unit.monitor.as_ref();
            [Some(unit.until), monitor.map(|it| it.next(plan))]
        });
        let is_due = |due: &Instant| *due > now && *due < Instant::NEVER;
        due.flatten().filter(is_due).min()
    }

    /// Returns the state of a process, in a word, and how often it was restarted.
    #[must_use]
    pub fn state_of(&self, at: usize) -> (&'static str, u32) {
        let unit = &self.units[at];
        let word = match unit.state {
            UnitState::Off => "off",
            UnitState::Starting => "starting",
            UnitState::Ready => "ready",
            UnitState::Finished => "finished",
            UnitState::Ending(_) => "ending",
            UnitState::Pausing => "pausing",
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
        let target = self.target.map(|it| &self.manifest.targets[it]);
        target.is_some_and(|it| it.members.contains(&at))
    }

    fn switch(&mut self, target: usize) {
        self.target = Some(target);
        self.is_reached = false;
        let name = self.manifest.targets[target].name().to_owned();
        self.tell(LaunchEvent::Switching { target: name });
        for at in 0..self.units.len() {
            let forgets = match self.units[at].state {
                UnitState::Failed => true,
                UnitState::Finished | UnitState::Pausing => !self.wants(at),
                _ => false,
            };
            if forgets {
                self.units[at].enter(UnitState::Off);
            }
        }
    }

    /// A process that starts is ready, if it is this that makes it ready.
    fn ready(&mut self, at: usize, by: ReadyBy) {
        let (unit, plan) = (&mut self.units[at], &self.manifest.processes[at]);
        if unit.state == UnitState::Starting && plan.ready == by {
            unit.enter(UnitState::Ready);
            unit.monitor = Some(Monitor::begin(plan, self.now));
            self.tell(LaunchEvent::Ready {
                process: self.name(at),
            });
        }
    }

    fn report(&mut self, at: usize, report: ProcessReport) {
        let (unit, plan) = (&mut self.units[at], &self.manifest.processes[at]);
        match (report, &mut unit.monitor) {
            (ProcessReport::Ready, _) => self.ready(at, ReadyBy::Report),
            (ProcessReport::Stopping, monitor) => *monitor = None,
            (ProcessReport::Alive, Some(monitor)) => monitor.alive(),
            (ProcessReport::Checkpoint(number, then), Some(monitor)) => {
                let failure = monitor.checkpoint(plan, number, then.min(self.now));
                self.fail(at, failure);
            }
            _ => {}
        }
    }

    /// Handles the end of a process that existed.
    fn ended(&mut self, at: usize, how: ExitKind) {
        let (unit, plan) = (&mut self.units[at], &self.manifest.processes[at]);
        let is_by_exit = plan.ready == ReadyBy::Exit;
        let may_end = is_by_exit || unit.state == UnitState::Ready && plan.may_end;
        match unit.enter(UnitState::Off) {
            UnitState::Ending(None) => {}
            UnitState::Ending(Some(failure)) => self.recover(at, failure),
            _ if may_end && how == ExitKind::Code(0) => {
                unit.state = UnitState::Finished;
                if is_by_exit {
                    self.tell(LaunchEvent::Ready {
                        process: self.name(at),
                    });
                }
            }
            _ => self.recover(at, format!("it ended: {how}")),
        }
    }

    /// Handles a failure, if there is one, of a process that exists: first it must end.
    fn fail(&mut self, at: usize, failure: Option<String>) {
        if failure.is_some() {
            self.terminate(at, failure);
        }
    }

    fn terminate(&mut self, at: usize, failure: Option<String>) {
        let unit = &mut self.units[at];
        unit.enter(UnitState::Ending(failure));
        unit.until = self.now + self.manifest.processes[at].stop_within;
        self.actions.push(Action::Terminate(at));
    }

    /// Decides what follows the failure of a process that no longer exists.
    fn recover(&mut self, at: usize, failure: String) {
        let is_wanted = self.wants(at);
        let (unit, plan) = (&mut self.units[at], &self.manifest.processes[at]);
        let may_fall_back = !self.is_fallback && !plan.state_management;
        let fallback = self.manifest.fallback().filter(|_| may_fall_back);
        let recovery = if !is_wanted {
            unit.enter(UnitState::Off);
            Recovery::None
        } else if unit.restarts < plan.restart.times {
            unit.enter(UnitState::Pausing);
            unit.until = self.now + plan.restart.pause;
            unit.restarts += 1;
            Recovery::Restart(unit.restarts)
        } else {
            unit.enter(UnitState::Failed);
            fallback.map_or(Recovery::SafeState, |_| Recovery::Fallback)
        };
        let manages_state = plan.state_management;
        self.tell(LaunchEvent::Failed {
            process: self.name(at),
            why: failure,
            next: recovery,
        });
        match (recovery, fallback) {
            (Recovery::Fallback, Some(fallback)) => {
                self.is_fallback = true;
                self.switch(fallback);
            }
            (Recovery::SafeState, _) if manages_state => self.end(Outcome::NoStateManagement(at)),
            (Recovery::SafeState, _) => self.end(Outcome::SafeState(at)),
            _ => {}
        }
    }

    fn name(&self, at: usize) -> String {
        self.manifest.processes[at].name().to_owned()
    }

    fn tell(&mut self, notice: LaunchEvent) {
        self.actions.push(Action::Tell(notice));
    }

    fn end(&mut self, outcome: Outcome) {
        self.is_over = true;
        self.actions.push(Action::End(outcome));
    }

    fn tick(&mut self, at: usize) {
        let (unit, plan) = (&mut self.units[at], &self.manifest.processes[at]);
        let is_due = unit.until <= self.now;
        let failure = match &unit.state {
            UnitState::Starting if is_due => {
                let ms = plan.ready_within.as_us() / 1_000;
                Some(format!("it was not ready within {ms} ms"))
            }
            UnitState::Ending(_) if is_due => {
                unit.until = Instant::NEVER;
                self.actions.push(Action::Kill(at));
                None
            }
            _ => unit.monitor.as_mut().and_then(|it| it.tick(plan, self.now)),
        };
        self.fail(at, failure);
    }

    /// Ends what no target wants, in reverse order of dependency; then starts what it wants, as far
    /// as dependencies permit.
    fn settle(&mut self) {
        let manifest = Arc::clone(&self.manifest);
        let count = self.units.len();
        let unwanted: Vec<usize> = (0..count).filter(|at| !self.wants(*at)).collect();
        for &at in &unwanted {
            let mut others = manifest.processes.iter().zip(&self.units);
            let is_needed =
                others.any(|(plan, other)| plan.dependencies.contains(&at) && other.state.exists());
            if self.units[at].state.is_up() && !is_needed {
                self.terminate(at, None);
            }
        }
        if unwanted.iter().any(|at| self.units[*at].state.exists()) {
            return;
        }
        let Some(target) = self.target else {
            return self.end(Outcome::Done);
        };
        let members = manifest.targets[target].members.as_slice();
        members.iter().for_each(|at| self.start_if_due(*at));
        let states = || members.iter().map(|at| &self.units[*at].state);
        let is_done = states().all(|state| *state == UnitState::Finished);
        if !self.is_reached && states().all(UnitState::is_ready) {
            self.is_reached = true;
            let target = manifest.targets[target].name().to_owned();
            self.tell(LaunchEvent::Reached { target });
        }
        if is_done {
            self.end(Outcome::Done);
        }
    }

    fn start_if_due(&mut self, at: usize) {
        let plan = &self.manifest.processes[at];
        let mut dependencies = plan.dependencies.iter();
        if !dependencies.all(|it| self.units[*it].state.is_ready()) {
            return;
        }
        let unit = &mut self.units[at];
        match unit.state {
            UnitState::Off => unit.restarts = 0,
            UnitState::Pausing if unit.until <= self.now => {}
            _ => return,
        }
        unit.enter(UnitState::Starting);
        unit.until = self.now + plan.ready_within;
        self.actions.push(Action::Start(at));
    }
}

#[cfg(test)]
mod tests;
