//! The start protocol: handshake, sync, time limits, and who leads. T-RED-2
//!
//! Each system repeats its handshake edge until the start is decided, so it does not matter which
//! was switched on first. The system that leads sends a handshake and the sync edge when it has
//! heard the other; the other begins on the sync edge. A master that is already running answers a
//! handshake in the same way, so a late system becomes its standby.

use crate::Config;
use tandem_board::{Duration, Instant, SystemId};

/// Heartbeats of a running system that must be heard to believe it: more than a stray edge or two.
const BEATS_OF_A_RUNNING_SYSTEM: u32 = 3;

/// How a system begins.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum StartKind {
    /// Power-on with both systems taken for healthy: wait for the other's handshake.
    Handshake,
    /// After a reset, or with the other taken for failed: only make sure that no master is running.
    Listen,
}

/// What was seen since the last poll.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Seen {
    pub(crate) handshakes: u32,
    pub(crate) syncs: u32,
    pub(crate) beats: u32,
    pub(crate) control_frame: bool,
    pub(crate) peer_off: bool,
}

/// How the start ends.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Verdict {
    /// The other leads: begin on its sync edge.
    FollowSync,
    /// The other is already running.
    Join,
    /// Both are there and this system leads.
    Lead,
    /// Nobody answered within the time limit.
    Alone,
    /// The other is without power, and there was no need to wait for it.
    PeerOff,
}

#[derive(Clone, Debug)]
pub(crate) struct Start {
    kind: StartKind,
    claims_master: bool,
    system: SystemId,
    since: Instant,
    next_handshake: Instant,
    heard_at: Option<Instant>,
    beats: u32,
    control_frame: bool,
}

impl Start {
    pub(crate) fn new(
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
            heard_at: None,
            beats: 0,
            control_frame: false,
        }
    }

    /// Whether to send a handshake now, and how the start ends if it does.
    pub(crate) fn poll(
        &mut self,
        config: &Config,
        now: Instant,
        seen: Seen,
    ) -> (bool, Option<Verdict>) {
        let handshake = now >= self.next_handshake;
        if handshake {
            self.next_handshake = now + config.handshake_period;
        }
        if seen.handshakes > 0 && self.heard_at.is_none() {
            self.heard_at = Some(now);
        }
        self.beats = self.beats.saturating_add(seen.beats);
        self.control_frame |= seen.control_frame;
        (handshake, self.verdict(config, now, seen))
    }

    fn verdict(&self, config: &Config, now: Instant, seen: Seen) -> Option<Verdict> {
        if seen.syncs > 0 {
            return Some(Verdict::FollowSync);
        }
        if self.control_frame || self.beats >= BEATS_OF_A_RUNNING_SYSTEM {
            return Some(Verdict::Join);
        }
        if let Some(heard_at) = self.heard_at {
            let lead = now.since(heard_at) >= self.lead_after(config);
            return lead.then_some(Verdict::Lead);
        }
        if self.kind == StartKind::Listen && seen.peer_off {
            return Some(Verdict::PeerOff);
        }
        (now.since(self.since) >= self.alone_after(config)).then_some(Verdict::Alone)
    }

    /// How long after the other's handshake this system takes the lead. A before B among equals, so
    /// that two that claim (or do not claim) to be master agree: the first sync edge decides.
    fn lead_after(&self, config: &Config) -> Duration {
        match (self.claims_master, self.system) {
            (true, SystemId::A) => Duration::ZERO,
            (true, SystemId::B) => config.sync_stagger,
            (false, SystemId::A) => config.promote_limit,
            (false, SystemId::B) => config.promote_limit.times(2),
        }
    }

    /// How long this system waits for the other. Staggered, so that with the start line cut the
    /// first to give up is running, and heard on other lines, before the second gives up.
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
