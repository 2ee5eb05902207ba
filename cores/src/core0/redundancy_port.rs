//! The redundancy of this system and its effects on the board: lines, flash, role lamp, resets.
//!
//! Invariant: each list of actions is carried out completely, and its deadline kept, before the
//! redundancy gets the next input.

use super::state_flash;
use crate::Config;
use crate::trace::Event;
use tandem_board::{Board, Can, Duration, Instant, Lines, Link, ResetRequest, Supply, SystemId};
use tandem_redundancy::{
    Action, Actions, FailureMode, Input, LineSnapshot, Loaded, Mode, Phase, Redundancy, StateStore,
};

/// A flash counts as hung if it takes longer than this to store the state: erasing a sector and
/// programming a record take less.
const FLASH_HANGS: Duration = Duration::from_ms(100);
/// Period of polls while the start protocol waits for cores 1 and 2.
const BOOT_POLL: Duration = Duration::from_ms(1);

/// Conditions of automated driving. The start protocol waits for all of them, up to a limit.
#[derive(Default)]
pub(super) struct StartConditions {
    /// Cores 1 and 2 have both completed a cycle.
    pub(super) cores_run: bool,
    /// The chassis sends the vehicle's motion.
    pub(super) ego_seen: bool,
    /// The latest scene has lanes.
    pub(super) lanes_seen: bool,
}

/// The effect of an input to the redundancy.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[must_use]
pub(super) enum Outcome {
    /// The input changes nothing outside this port.
    Done,
    /// The control cycle restarts at once.
    RestartControl,
}

/// The redundancy with its connections to the board.
pub(super) struct RedundancyPort<'b, B: Board> {
    board: &'b B,
    config: Config,
    system: SystemId,
    started: Instant,
    pub(super) ready: StartConditions,
    store: StateStore,
    loaded: Loaded,
    /// `None` until the start protocol begins.
    running: Option<Redundancy>,
    due: Instant,
    /// When the redundancy first asked for a reset.
    reset_asked: Option<Instant>,
    shown: Option<(Phase, Mode, u32)>,
}

impl<'b, B: Board> RedundancyPort<'b, B> {
    /// Reads the state from the data flash (bounded time).
    pub(super) fn new(board: &'b B, config: Config) -> Self {
        let (store, loaded) = state_flash::load(board.flash());
        let started = board.now();
        Self {
            board,
            config,
            system: board.identity().system,
            started,
            ready: StartConditions::default(),
            store,
            loaded,
            running: None,
            due: started,
            reset_asked: None,
            shown: None,
        }
    }

    /// Returns how many starts the data flash had counted before this one.
    pub(super) const fn starts_before(&self) -> u32 {
        match &self.loaded {
            Loaded::State(state) => state.total_resets,
            _ => 0,
        }
    }

    /// `None` until the start protocol begins.
    pub(super) const fn running(&self) -> Option<&Redundancy> {
        self.running.as_ref()
    }

    /// Returns the phase, once the start protocol has begun.
    pub(super) fn phase(&self) -> Option<Phase> {
        self.running().map(Redundancy::phase)
    }

    /// Returns whether this system is master.
    pub(super) fn is_driving(&self) -> bool {
        self.phase().is_some_and(Phase::is_driving)
    }

    /// Returns whether this system offers its role to the other one.
    pub(super) fn offers_role(&self) -> bool {
        self.running().is_some_and(Redundancy::offers_role)
    }

    /// Returns the time at which [`RedundancyPort::poll`] is due.
    pub(super) const fn due(&self) -> Instant {
        self.due
    }

    /// Returns the end of the next limit after which this system may have to take over.
    pub(super) fn next_limit(&self, now: Instant) -> Instant {
        let running = self.running.as_ref();
        running.map_or(Instant::NEVER, |redundancy| redundancy.next_limit(now))
    }

    /// Returns whether this system may send a control frame now; `None` before the start protocol.
    pub(super) fn may_transmit(&mut self) -> Option<bool> {
        let now = self.board.now();
        self.running.as_mut().map(|it| it.may_transmit(now))
    }

    /// Reports this system's state to the other one, over the link.
    pub(super) fn report(&mut self) {
        if let Some(redundancy) = &mut self.running {
            let report = redundancy.link_report(self.board.now());
            // The link is full if the other system does not read it; the next report will do.
            let _full = self.board.link().try_send(&report.to_words());
        }
    }

    /// Gives one input to the redundancy and carries out its actions.
    pub(super) fn on(&mut self, input: Input) -> Outcome {
        let now = self.board.now();
        match &mut self.running {
            Some(redundancy) => {
                let actions = redundancy.on(now, input);
                self.act(actions)
            }
            None => Outcome::Done,
        }
    }

    /// Called when core 1 or 2 is dead. Before the start protocol, that is a reason for a reset.
    pub(super) fn on_dead_core(&mut self, fault: FailureMode) -> Outcome {
        if self.running.is_none() {
            self.board.supply().request_reset(ResetRequest::CoreDead);
        }
        self.on(Input::OwnFault(fault))
    }

    /// Starts the redundancy when its conditions hold. Once it runs, passes it the lines to judge.
    pub(super) fn poll(&mut self, lines: LineSnapshot) -> Outcome {
        if self.running.is_none() {
            self.start();
            return Outcome::Done;
        }
        let outcome = self.on(Input::Poll(lines));
        if self.config.redundancy.report_period < super::CONTROL_PERIOD {
            self.report();
        }
        state_flash::drive(&mut self.store, self.board.flash());
        outcome
    }

    /// Begins the start protocol when the chain of cores 1, 2 and 0 runs, or after the time limit.
    fn start(&mut self) {
        let now = self.board.now();
        let StartConditions {
            cores_run,
            ego_seen,
            lanes_seen,
        } = self.ready;
        let is_ready = cores_run && ego_seen && lanes_seen;
        // A system must start even without lanes, and without any vehicle.
        if is_ready || now.since(self.started) > self.config.boot_limit {
            let cause = self.board.supply().reset_cause();
            let config = self.config.redundancy;
            let redundancy = Redundancy::new(config, self.system, cause, self.loaded, now);
            self.running = Some(redundancy);
            self.due = now;
        } else {
            self.due = now + BOOT_POLL;
        }
    }

    #[deny(clippy::wildcard_enum_match_arm, reason = "no action may be forgotten")]
    fn act(&mut self, actions: Actions) -> Outcome {
        let now = self.board.now();
        let (mut outcome, mut reset) = (Outcome::Done, None);
        for action in actions.iter() {
            match action {
                Action::SendEdge(line, edge) => self.board.lines().send(line, edge),
                Action::DiscardUnsent => self.board.can().discard_unsent(),
                // Both systems begin their control cycle on the sync edge. A takeover begins a new
                // grid: it does not wait for the next cycle of the old one.
                Action::Transmit | Action::AlignControl => outcome = Outcome::RestartControl,
                Action::Persist(state) => self.store.request(state),
                Action::Reset(request) => reset = Some(request),
                Action::Record(event) => self.board.trace(Event::from(event).encode()),
            }
        }
        self.due = actions.deadline();
        state_flash::drive(&mut self.store, self.board.flash());
        if let Some(request) = reset {
            // A flash that hangs must not prevent a reset.
            let since = *self.reset_asked.get_or_insert(now);
            if self.store.is_settled() || now.since(since) > FLASH_HANGS {
                self.board.supply().request_reset(request);
            }
        }
        self.show();
        outcome
    }

    /// Shows role and mode on the lamp and in the trace when they have changed.
    fn show(&mut self) {
        let Some(redundancy) = &self.running else {
            return;
        };
        let term = redundancy.highest_term().bits();
        let (phase, mode) = (redundancy.phase(), redundancy.mode());
        if self.shown.replace((phase, mode, term)) == Some((phase, mode, term)) {
            return;
        }
        self.board.supply().show_role(phase.lamp());
        let role = phase.role() as u8;
        let mode = mode as u8;
        self.board.trace(Event::Role { role, mode, term }.encode());
    }
}
