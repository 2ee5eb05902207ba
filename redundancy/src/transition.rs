//! The transition table: the effect of one piece of evidence in one phase.

use crate::{Evidence, Phase};

/// One cell of the table.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Rule {
    /// The effect that is applied before the phase changes.
    pub(crate) effect: Option<Effect>,
    /// The phase that the system enters; `None` if the phase does not change.
    pub(crate) enter: Option<Phase>,
}

/// An effect of a rule other than entering a phase.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Effect {
    /// Answers the other system's handshake with handshake and sync edge: both begin now.
    LeadStart,
    /// Begins on the other system's sync edge.
    FollowStart,
    /// The other system counts as failed.
    MarkPeerFailed,
    /// The other system no longer counts as failed.
    MarkPeerRecovered,
    /// Reports that the heartbeat lines are cut.
    ReportLinesSplit,
}

const NOTHING: Rule = Rule {
    effect: None,
    enter: None,
};

const fn enter(phase: Phase) -> Rule {
    Rule {
        enter: Some(phase),
        ..NOTHING
    }
}

const fn only(effect: Effect) -> Rule {
    Rule {
        effect: Some(effect),
        ..NOTHING
    }
}

const fn both(effect: Effect, phase: Phase) -> Rule {
    Rule {
        effect: Some(effect),
        enter: Some(phase),
    }
}

/// Returns the cell of this phase and this evidence.
pub(crate) const fn rule(phase: Phase, evidence: Evidence) -> Rule {
    use Evidence as E;
    use Phase as P;
    match (phase, evidence) {
        (P::Suspended, _) => NOTHING,
        // The only evidence that counts for a system that waits for its reset.
        (_, E::FaultSuspend) => enter(P::Suspended),
        // A system that drives never resets itself: it stops the vehicle until the other drives.
        (P::Starting | P::Standby, E::FaultReset) => enter(P::Resetting),

        (P::Starting, E::SyncHeard) => both(Effect::FollowStart, P::Standby),
        (P::Starting, E::PeerRuns) => enter(P::Standby),
        (P::Starting, E::HandshakeDone) => both(Effect::LeadStart, P::Master),
        (P::Starting, E::NoAnswer) => enter(P::DegradedMaster),

        (P::Standby, E::PeerOff | E::PeerSilent | E::MasterMute | E::MasterResigns) => {
            enter(P::DegradedMaster)
        }
        (P::Standby, E::SyncStray) => enter(P::Starting),
        (P::Standby, E::HandshakeDone) => both(Effect::LeadStart, P::Master),
        (P::Standby, E::BeatsSilent) => only(Effect::ReportLinesSplit),

        (
            P::Master,
            E::PeerOff | E::BeatsSilent | E::StandbyMute | E::StandbyUnable | E::FaultStop,
        ) => enter(P::DegradedMaster),
        (P::DegradedMaster, E::PeerOff | E::BeatsSilent | E::StandbyMute | E::StandbyUnable) => {
            only(Effect::MarkPeerFailed)
        }
        (P::DegradedMaster, E::BeatsBack) => only(Effect::MarkPeerRecovered),
        (P::DegradedMaster | P::Thawed, E::PeerStable) => enter(P::Master),
        (P::Master | P::DegradedMaster | P::Thawed, E::HigherTerm) => enter(P::Standby),
        (P::Master | P::DegradedMaster, E::Stalled) => enter(P::Thawed),
        (P::Thawed, E::ListenOver | E::PeerOff) => enter(P::DegradedMaster),
        _ => NOTHING,
    }
}
