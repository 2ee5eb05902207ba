//! The driving phases `Master` and `DegradedMaster`, and `Thawed` after a stall.

use crate::witness::Witnesses;
use crate::{Config, Evidence, SystemState, Term};
use tandem_board::{Duration, Instant};

/// One mastership.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Driving {
    /// The term in control frames.
    term: Term,
    /// When the system was last permitted to transmit.
    last_permit: Instant,
    /// A transmission was refused because the last poll was too long ago.
    refused: bool,
    /// The last echo said that the vehicle refuses this term, and that no system drives.
    refused_by_vehicle: bool,
    /// When this system began to drive.
    since: Instant,
}

impl Driving {
    pub(crate) const fn new(term: Term, now: Instant) -> Self {
        Self {
            term,
            last_permit: now,
            refused: false,
            refused_by_vehicle: false,
            since: now,
        }
    }

    pub(crate) const fn term(&self) -> Term {
        self.term
    }

    pub(crate) const fn last_permit(&self) -> Instant {
        self.last_permit
    }

    pub(crate) fn raise(&mut self, term: Term) {
        self.term = term;
        self.refused_by_vehicle = false;
    }

    /// Records whether the vehicle refuses this term while no system drives. Returns whether two
    /// echoes in a row said so: the vehicle would have heard a reconnected master in the control
    /// period between them.
    pub(crate) fn note_refusal(&mut self, refused: bool) -> bool {
        core::mem::replace(&mut self.refused_by_vehicle, refused) && refused
    }

    /// Returns whether a frame may be sent `since_poll` after the last poll.
    pub(crate) fn may_transmit(
        &mut self,
        config: &Config,
        now: Instant,
        since_poll: Duration,
    ) -> bool {
        let leased = since_poll <= config.lease();
        if leased {
            self.last_permit = now;
        }
        self.refused = !leased;
        leased
    }

    /// Returns whether the last transmission was refused.
    pub(crate) const fn is_refused(&self) -> bool {
        self.refused
    }

    /// Returns whether a transmission was refused since the last call.
    pub(crate) fn take_refused(&mut self) -> bool {
        core::mem::take(&mut self.refused)
    }

    /// Returns whether the other system may have taken over since this master was last permitted to
    /// transmit. It cannot do so within the third witness's limit, or if it is off.
    pub(crate) fn may_be_deposed(
        &self,
        config: &Config,
        now: Instant,
        witnesses: &Witnesses,
    ) -> bool {
        let off = witnesses.peer_is_off(config, now);
        let others = !witnesses.beats.both_silent() || witnesses.reports.was_standby();
        let earliest = self.last_permit + config.witness_limit();
        others && !off && now >= earliest
    }

    /// Judges in dual operation whether the standby is lost.
    pub(crate) fn judge_dual(
        &self,
        config: &Config,
        now: Instant,
        witnesses: &Witnesses,
    ) -> Option<Evidence> {
        if witnesses.peer_is_off(config, now) {
            return Some(Evidence::PeerOff);
        }
        if witnesses.standby_is_gone(config, now) {
            return Some(Evidence::BeatsSilent);
        }
        // Heartbeats show that the standby runs, not that it can transmit.
        let limit = config.status_limit;
        let heard = witnesses.reports.standby_within(now, limit) || now.since(self.since) <= limit;
        if !heard {
            return Some(Evidence::StandbyMute);
        }
        let alone = witnesses.reports.abilities.has_no_backup(now);
        alone.then_some(Evidence::StandbyUnable)
    }

    /// Judges, while this system drives alone, whether the other system has recovered and may be
    /// the standby again. `peer_sound_for`: time since the last evidence of its failure.
    pub(crate) fn judge_alone(
        &self,
        config: &Config,
        now: Instant,
        witnesses: &Witnesses,
        state: &SystemState,
        peer_sound_for: Duration,
    ) -> Option<Evidence> {
        if let gone @ Some(_) = self.judge_dual(config, now, witnesses) {
            return gone;
        }
        // A backup that is not heard on CAN could not take over.
        if !witnesses.reports.standby_within(now, config.status_limit) {
            return None;
        }
        let sound_for = witnesses.beats.alive_for(now).min(peer_sound_for);
        if state.cpsys_failure {
            return (sound_for >= config.recover_after).then_some(Evidence::BeatsBack);
        }
        let stable = sound_for >= config.recover_after.times(2) && !state.sys_failure;
        (config.reintegrate && stable).then_some(Evidence::PeerStable)
    }
}

/// The phase `Thawed`: this master was held up, and listens for another driver.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Thawed {
    /// The mastership to resume. After a stall this master takes no new term: if the other system
    /// had taken over unheard, a new term would depose it.
    pub(crate) driving: Driving,
    /// This master was in dual operation.
    pub(crate) dual: bool,
    /// When it began to listen.
    pub(crate) since: Instant,
}

impl Thawed {
    /// Returns whether no takeover has happened or is in progress. `age`: time since the vehicle
    /// accepted the last frame of this mastership. A takeover is excluded if `age` is too short for
    /// one, or so long that the vehicle would obey the other system by now.
    pub(crate) fn is_kept(&self, config: &Config, age: Duration) -> bool {
        let under_way = config.poll_interval.times(2);
        age + under_way < config.witness_limit() || age > config.gap_bound() + under_way
    }

    pub(crate) fn judge(
        &self,
        config: &Config,
        now: Instant,
        witnesses: &Witnesses,
    ) -> Option<Evidence> {
        if witnesses.peer_is_off(config, now) {
            return Some(Evidence::PeerOff);
        }
        (now.since(self.since) > config.mute_limit()).then_some(Evidence::ListenOver)
    }
}
