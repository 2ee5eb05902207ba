//! Evidence from the periodic look at the lines and the CAN receiver.

use super::Redundancy;
use crate::can_watch::CanWatch;
use crate::start::{Seen, Verdict};
use crate::{
    Actions, BeatReceiver, Event, Evidence, FailureMode, LineChange, Mode, Phase, Role, Snapshot,
};
use tandem_board::Instant;

impl Redundancy {
    pub(super) fn poll(&mut self, now: Instant, snapshot: Snapshot, actions: &mut Actions) {
        let last = *self.last.get_or_insert_with(|| {
            self.beats = BeatReceiver::new(self.config.silent_limit(), snapshot.beats, now);
            self.can = CanWatch::new(snapshot.can_frames, now);
            self.last_poll = now;
            snapshot
        });
        self.last = Some(snapshot);
        let held_up = now.since(self.last_poll);
        if held_up > self.config.stall_limit() {
            // Silence is what was listened to: own absence is no evidence against the other.
            self.beats.forgive(now);
            self.can.forgive(now);
            self.last_control = self.last_control.max(now);
        }
        let new_beats = self.watch_lines(now, &last, &snapshot, actions);
        self.watch_can(now, &snapshot, actions);
        self.last_poll = now;

        let overdue = held_up > self.config.lease();
        match self.phase {
            Phase::Starting => self.poll_start(now, &last, &snapshot, new_beats, actions),
            Phase::Standby => {
                // A handshake is a word of a system that has just started, so it does not drive.
                self.suspected |= snapshot.handshakes != last.handshakes;
                self.poll_standby(now, actions);
            }
            Phase::Master | Phase::DegradedMaster => {
                if overdue && self.may_be_deposed(now, new_beats) {
                    self.apply(now, Evidence::Stalled, actions);
                } else {
                    self.poll_driving(now, actions);
                }
            }
            Phase::Thawed => self.poll_thawed(now, actions),
            Phase::Resetting | Phase::Suspended => {}
        }
        if self.phase.is_driving() && snapshot.handshakes != last.handshakes {
            // The other starts while this system drives: tell it to follow.
            actions.handshake = true;
            actions.sync = true;
        }
        if core::mem::take(&mut self.refused) && self.phase.is_driving() {
            actions.transmit_now = true;
        }
        self.note_health(now);
        actions.beat = self.beat_sender.poll(now);
    }

    /// Updates what is known from the lines; returns the number of new heartbeats.
    pub(super) fn watch_lines(
        &mut self,
        now: Instant,
        last: &Snapshot,
        snapshot: &Snapshot,
        actions: &mut Actions,
    ) -> u32 {
        for (line, change) in (1..).zip(self.beats.update(now, snapshot.beats)) {
            match change {
                Some(LineChange::Silent) => actions.events.push(Event::LineSilent(line)),
                Some(LineChange::Back) => actions.events.push(Event::LineBack(line)),
                None => {}
            }
        }
        let new = |line: usize| snapshot.beats[line].wrapping_sub(last.beats[line]);
        let new_beats = new(0).max(new(1));
        if snapshot.peer_powered {
            self.peer_low_since = None;
            self.level_broken = false;
        } else if self.peer_low_since.is_none() {
            self.peer_low_since = Some(now);
        } else if new_beats > 0 {
            self.note_life(now);
        }
        new_beats
    }

    /// A sign of life of the other. If its power level has been low for longer than anything can be
    /// under way, the level line is broken and is not believed until it is high again.
    pub(super) fn note_life(&mut self, now: Instant) {
        let under_way = self.config.witness_limit();
        if self
            .peer_low_since
            .is_some_and(|since| now.since(since) > under_way)
        {
            self.level_broken = true;
        }
    }

    pub(super) fn peer_off(&self) -> bool {
        self.peer_low_since.is_some() && !self.level_broken
    }

    /// The other system is powered and its heartbeats come.
    pub(super) fn peer_is_there(&self) -> bool {
        !self.peer_off() && !self.beats.both_silent()
    }

    pub(super) fn watch_can(&mut self, now: Instant, snapshot: &Snapshot, actions: &mut Actions) {
        self.can
            .update(now, snapshot.can_frames, self.config.witness_limit());
        let silent = self.can.silent_for(now) > self.config.can_open_limit;
        if silent != self.can_silent {
            self.can_silent = silent;
            actions.events.push(Event::CanSilent(silent));
        }
        // Nothing heard may also mean that the whole bus is dead, and then both systems would
        // suspend. Only if the other hears what this one does not is the own connection open.
        // T-RED-6
        let limit = self.config.report_limit;
        let peer_hears = self
            .peer_link
            .is_some_and(|(report, at)| report.can_alive && now.since(at) <= limit);
        if silent && peer_hears {
            self.own_fault(now, FailureMode::CanOpenCircuit, actions);
        }
    }

    pub(super) fn poll_start(
        &mut self,
        now: Instant,
        last: &Snapshot,
        snapshot: &Snapshot,
        beats: u32,
        actions: &mut Actions,
    ) {
        let seen = Seen {
            handshakes: snapshot.handshakes.wrapping_sub(last.handshakes),
            syncs: snapshot.syncs.wrapping_sub(last.syncs),
            beats,
            control_frame: self.control_while_starting,
            peer_off: self.peer_off(),
        };
        let (handshake, verdict) = self.start.poll(&self.config, now, seen);
        actions.handshake = handshake;
        let Some(verdict) = verdict else { return };
        match verdict {
            Verdict::FollowSync => {
                actions.synchronised = true;
                self.apply(now, Evidence::SyncHeard, actions);
                self.peer_mode = Mode::L3;
            }
            Verdict::Join => self.apply(now, Evidence::PeerRuns, actions),
            Verdict::Lead => {
                actions.handshake = true;
                actions.sync = true;
                actions.synchronised = true;
                self.apply(now, Evidence::HandshakeDone, actions);
            }
            Verdict::Alone => self.apply(now, Evidence::NobodyThere, actions),
            Verdict::PeerOff => self.apply(now, Evidence::PeerOff, actions),
        }
    }

    pub(super) fn poll_standby(&mut self, now: Instant, actions: &mut Actions) {
        let control_age = now.since(self.last_control);
        let silent = self.beats.both_silent();
        // A silence is remembered until control frames come again: a master that was reset may be
        // back with its heartbeats, as a standby, before the third witness has spoken.
        self.suspected |= silent;
        if self.peer_off() {
            self.apply(now, Evidence::PeerOff, actions);
        } else if self.suspected && control_age > self.config.witness_limit() {
            self.apply(now, Evidence::PeerSilent, actions);
        } else if !silent && self.master_is_mute(now) {
            self.apply(now, Evidence::MasterMute, actions);
        } else if silent && !self.lines_split {
            // The third witness speaks for the master: the lines are cut, not the system.
            actions.events.push(Event::LinesSplit);
        }
        self.lines_split = silent && self.phase == Phase::Standby;
    }

    /// Heartbeats come, but control frames do not.
    pub(super) fn master_is_mute(&self, now: Instant) -> bool {
        let age = now.since(self.last_control);
        // After an outage of the whole bus the master needs a control period to be heard again.
        let bus_alive = self.can.alive_for(now) > self.config.witness_limit();
        if self.control_known {
            return age > self.config.mute_limit() && bus_alive;
        }
        let master_reported = self.peer_link.is_some_and(|(report, at)| {
            report.role == Role::Master && now.since(at) <= self.config.report_limit
        });
        age > self.config.no_master_limit(self.system) && (bus_alive || !master_reported)
    }

    pub(super) fn poll_driving(&mut self, now: Instant, actions: &mut Actions) {
        let gone =
            self.beats.both_silent() && self.beats.silent_for(now) > self.config.standby_limit;
        if self.phase == Phase::Master {
            if self.peer_off() {
                self.apply(now, Evidence::PeerOff, actions);
            } else if gone {
                self.apply(now, Evidence::BeatsSilent, actions);
            }
            return;
        }
        let alive_for = self.beats.alive_for(now);
        if self.peer_off() || gone {
            self.set_peer_failed(true, actions);
        } else if alive_for >= self.config.recover_after {
            self.apply(now, Evidence::BeatsBack, actions);
        }
        // A backup that is not heard on CAN is none.
        let limit = self.config.can_open_limit;
        let heard = self
            .peer_standby_at
            .is_some_and(|at| now.since(at) <= limit);
        let stable = !self.state.cpsys_failure && alive_for >= self.config.recover_after.times(2);
        if self.config.reintegrate && stable && heard && !self.stopping {
            self.apply(now, Evidence::PeerStable, actions);
        }
    }

    pub(super) fn poll_thawed(&mut self, now: Instant, actions: &mut Actions) {
        if self.peer_off() {
            self.apply(now, Evidence::PeerOff, actions);
        } else if now.since(self.thawed_at) > self.config.mute_limit() {
            self.apply(now, Evidence::ListenOver, actions);
        }
    }

    /// Whether the other may have taken over since this master last showed a sign of life. It may
    /// not have before the third witness was silent for its limit, nor if it is not there.
    pub(super) fn may_be_deposed(&self, now: Instant, new_beats: u32) -> bool {
        let others = self.peer_is_there() || new_beats > 0 || self.peer_standby_at.is_some();
        let earliest = self.last_permit + self.config.witness_limit();
        others && !self.peer_off() && now >= earliest
    }
}
