//! The start protocol: handshake, sync, time limits, and which system leads. T-RED-2
//!
//! Each system repeats its handshake edge until the start is decided, so the order of switching on
//! does not matter. The leading system sends a handshake and the sync edge when it has heard two
//! handshakes of the other system. The other system begins on the sync edge. A master that already
//! runs answers a handshake with the sync edge, so a late system becomes its standby.

use crate::input::Seen;
use crate::{Config, Evidence};
use tandem_board::{Duration, Instant, SystemId};

/// This many heartbeats show that the other system runs: more than one or two stray edges.
const BEATS_OF_A_RUNNING_SYSTEM: u32 = 3;
/// This many handshakes show that the other system starts: more than one stray edge.
const HANDSHAKES_OF_A_STARTING_SYSTEM: u32 = 2;

/// How a system begins.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum StartKind {
    /// Power-on, and both systems count as healthy: wait for the other system's handshake.
    Handshake,
    /// After a reset, or if the other system counts as failed: only listen for a running master.
    Listen,
}

/// The phase `Starting`.
#[derive(Clone, Debug)]
pub(crate) struct Starting {
    kind: StartKind,
    claims_master: bool,
    system: SystemId,
    since: Instant,
    next_handshake: Instant,
    handshakes: u32,
    heard_at: Option<Instant>,
    beats: u32,
    control_frame: bool,
}

impl Starting {
    pub(crate) const fn new(
        kind: StartKind,
        claims_master: bool,
        system: SystemId,
        now: Instant,
    ) -> Self {
        Self {
            kind,
            claims_master,
            system,
            since: now,
            next_handshake: now,
            handshakes: 0,
            heard_at: None,
            beats: 0,
            control_frame: false,
        }
    }

    /// Notes that a control frame of the other system was heard: it drives.
    pub(crate) fn on_control_frame(&mut self) {
        self.control_frame = true;
    }

    /// Extends the time limit for an answer by a time in which this system did not listen.
    pub(crate) fn forgive(&mut self, span: Duration) {
        self.since += span;
    }

    /// Returns whether to send a handshake now.
    pub(crate) fn handshake_due(&mut self, config: &Config, now: Instant) -> bool {
        let due = now >= self.next_handshake;
        if due {
            self.next_handshake = now + config.handshake_period;
        }
        due
    }

    /// Returns the evidence that ends the start, if there is any.
    pub(crate) fn judge(&mut self, config: &Config, now: Instant, seen: &Seen) -> Option<Evidence> {
        self.handshakes = self.handshakes.saturating_add(seen.handshakes.min(1));
        if self.handshakes >= HANDSHAKES_OF_A_STARTING_SYSTEM && self.heard_at.is_none() {
            self.heard_at = Some(now);
        }
        let peer_runs = self.peer_runs(seen);
        if seen.syncs > 0 {
            return Some(Evidence::SyncHeard);
        }
        if peer_runs {
            return Some(Evidence::PeerRuns);
        }
        if let Some(heard_at) = self.heard_at {
            let lead = now.since(heard_at) >= self.lead_after(config);
            return lead.then_some(Evidence::HandshakeDone);
        }
        self.is_over(config, now).then_some(Evidence::NoAnswer)
    }

    /// Returns whether the other system is known to run, after the heartbeats of this poll.
    pub(crate) fn peer_runs(&mut self, seen: &Seen) -> bool {
        // Edges that arrive together are one heartbeat, or a disturbance.
        self.beats = self.beats.saturating_add(seen.heartbeats().min(1));
        self.control_frame || self.beats >= BEATS_OF_A_RUNNING_SYSTEM
    }

    /// Returns whether the time limit for an answer of the other system has passed. The first
    /// handshake extends the limit until the second one is due.
    pub(crate) fn is_over(&self, config: &Config, now: Instant) -> bool {
        let more = config.handshake_period.times(self.handshakes.min(1));
        now.since(self.since) >= self.alone_after(config) + more
    }

    /// Returns the delay from the other system's handshake until this system leads. If both claim
    /// to be master, or neither does, A leads before B, so that the first sync edge decides.
    fn lead_after(&self, config: &Config) -> Duration {
        match (self.claims_master, self.system) {
            (true, SystemId::A) => Duration::ZERO,
            (true, SystemId::B) => config.sync_stagger,
            (false, SystemId::A) => config.promote_limit,
            (false, SystemId::B) => config.promote_limit.times(2),
        }
    }

    /// Returns how long this system waits for the other one. The times are staggered: if the start
    /// line is cut, the system that stops first is heard on other lines before the other stops.
    fn alone_after(&self, config: &Config) -> Duration {
        match self.kind {
            StartKind::Listen => config.listen_limit(self.system),
            StartKind::Handshake => {
                let follows = if self.claims_master { 0 } else { 2 };
                config.start_limit + config.stagger.times(follows) + config.stagger_of(self.system)
            }
        }
    }
}
