//! The evidence about the other system. Each witness is one type; rules combine them.

mod can;
mod claims;
mod clock;
mod gate;
mod heartbeat;
mod level;
mod reports;

use crate::input::Seen;
use crate::{Actions, Config, LinkReport, RedundancyEvent};
use can::CanWatch;
use claims::Claims;
pub(crate) use claims::Source;
use clock::Clocks;
use gate::Gate;
pub(crate) use gate::GateVerdict;
pub(crate) use heartbeat::BeatSender;
use heartbeat::{BeatReceiver, LineChange};
use level::Level;
use reports::{Next, Reports};
use tandem_board::Instant;

/// All witnesses except one: the control frames of the master belong to the phases `Starting` and
/// `Standby`.
#[derive(Clone, Debug)]
pub(crate) struct Witnesses {
    pub(crate) beats: BeatReceiver,
    pub(crate) level: Level,
    pub(crate) can: CanWatch,
    pub(crate) reports: Reports,
    pub(crate) gate: Gate,
    pub(crate) clocks: Clocks,
    pub(crate) claims: Claims,
    /// The time limits were restarted after a stall, and no sign of life has arrived since.
    forgiven: bool,
}

impl Witnesses {
    pub(crate) fn new(config: &Config, now: Instant) -> Self {
        Self {
            beats: BeatReceiver::new(config.silent_limit(), now),
            level: Level::new(now),
            can: CanWatch::new(now),
            reports: Reports::default(),
            gate: Gate::default(),
            clocks: Clocks::default(),
            claims: Claims::default(),
            forgiven: false,
        }
    }

    /// Restarts the time limits, because this system was held up or has just begun. Does so only
    /// once between two signs of life, because a system that always polls late must also detect a
    /// failure of the other. Returns whether it did.
    pub(crate) fn forgive(&mut self, now: Instant) -> bool {
        if core::mem::replace(&mut self.forgiven, true) {
            return false;
        }
        self.beats.forgive(now);
        self.can.forgive(now);
        true
    }

    /// Updates the witnesses with the differences of a poll.
    pub(crate) fn update(
        &mut self,
        config: &Config,
        now: Instant,
        seen: &Seen,
        actions: &mut Actions,
    ) {
        for (line, change) in (1..).zip(self.beats.update(now, seen.beats)) {
            match change {
                Some(LineChange::Silent) => actions.record(RedundancyEvent::LineSilent(line)),
                Some(LineChange::Back) => actions.record(RedundancyEvent::LineBack(line)),
                None => {}
            }
        }
        let beats = seen.heartbeats() > 0;
        let beats_alive = beats || !self.beats.both_silent();
        let broken = self
            .level
            .update(config, now, seen.peer_powered, beats, beats_alive);
        if let Some(broken) = broken {
            actions.record(RedundancyEvent::LevelBroken(broken));
        }
        self.forgiven &= !beats;
        self.can
            .update(now, seen.can_frames, config.witness_limit());
        let silent = self.can_is_silent(config, now);
        if self.can.is_news(silent) {
            actions.record(RedundancyEvent::CanSilent(silent));
        }
    }

    /// Returns whether a report over the link is new: neither repeated nor too late. If all reports
    /// are late for a second, their delay becomes the usual one.
    pub(crate) fn is_new(&mut self, config: &Config, now: Instant, link: &LinkReport) -> bool {
        let clocks = &mut self.clocks;
        match self.reports.is_next(link) {
            Next::No => return false,
            Next::Yes => {}
            Next::Restarted => {
                clocks.forget_peer();
                self.reports.abilities.on_start();
            }
        }
        let late = clocks.on_peer(now, link.sent_us) > config.report_limit;
        let silent = self.reports.silent_for(now);
        if late && silent.is_some_and(|it| it <= config.recover_after) {
            return false;
        }
        if late {
            clocks.forget_peer();
        }
        true
    }

    /// Handles a sign of life of the other system at `at`, on CAN or over the link.
    pub(crate) fn on_life(&mut self, config: &Config, at: Instant, actions: &mut Actions) {
        if self.level.on_life(config, at) {
            actions.record(RedundancyEvent::LevelBroken(true));
        }
        self.forgiven = false;
    }

    /// Notes that the other system drives in a new term.
    pub(crate) fn on_drive(&mut self, actions: &mut Actions) {
        if self.level.on_drive() {
            actions.record(RedundancyEvent::LevelBroken(true));
        }
    }

    /// Returns whether the other system is without power.
    pub(crate) fn peer_is_off(&self, config: &Config, now: Instant) -> bool {
        self.level.is_off(config, now)
    }

    /// Returns whether the link and both heartbeat lines fell silent together: three wires that
    /// fail at the same time show a failed master, unless a control frame was heard since. A link
    /// that was cut before, or that is too slow, is not a witness.
    pub(crate) fn link_ended(&self, config: &Config, now: Instant, last_control: Instant) -> bool {
        let limit = config.link_limit();
        let lines = self.beats.silent_for(now);
        let link = self.reports.silent_for(now);
        limit < config.witness_limit()
            && link.is_some_and(|link| link > limit && link <= lines + limit)
            && now.since(last_control) + limit >= lines
    }

    /// Returns the times at which heartbeats, link and power level will count as silent or off if
    /// no further sign arrives. A time is past if its witness is already silent or off, and
    /// [`Instant::NEVER`] if the witness has seen nothing.
    pub(crate) fn limits(&self, config: &Config) -> [Instant; 3] {
        let link = self.reports.heard_at();
        [
            self.beats.last_edge() + config.silent_limit(),
            link.map_or(Instant::NEVER, |at| at + config.link_limit()),
            self.level.limit(config),
        ]
    }

    /// Returns whether this system no longer hears third parties that it heard before: it has no
    /// input for driving, and must not replace a master that can still stop the vehicle.
    pub(crate) fn is_deaf(&self, config: &Config, now: Instant) -> bool {
        self.can.is_deaf(now, config.mute_limit())
    }

    /// Returns whether no frame was received on CAN for too long.
    pub(crate) fn can_is_silent(&self, config: &Config, now: Instant) -> bool {
        self.can.is_silent(now, config.can_open_limit)
    }

    /// Returns whether both heartbeat lines are silent for so long that a master gives up its
    /// standby.
    pub(crate) fn standby_is_gone(&self, config: &Config, now: Instant) -> bool {
        self.beats.both_silent() && self.beats.silent_for(now) > config.standby_limit
    }
}
