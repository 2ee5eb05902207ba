//! What this system knows of the other one. Each witness is one type; rules combine them.

mod can;
mod heartbeat;
mod level;
mod reports;

use crate::input::Seen;
use crate::{Actions, Config, Event};
use can::CanWatch;
pub(crate) use heartbeat::BeatSender;
use heartbeat::{BeatReceiver, LineChange};
use level::Level;
use reports::Reports;
use tandem_board::Instant;

/// All witnesses. The control frames of the master are a witness of the phases `Starting` and
/// `Standby` and stand there.
#[derive(Clone, Debug)]
pub(crate) struct Witnesses {
    pub(crate) beats: BeatReceiver,
    pub(crate) level: Level,
    pub(crate) can: CanWatch,
    pub(crate) reports: Reports,
    /// A stall was forgiven since the last sign of life.
    forgiven: bool,
}

impl Witnesses {
    pub(crate) fn new(config: &Config, now: Instant) -> Self {
        Self {
            beats: BeatReceiver::new(config.silent_limit(), now),
            level: Level::High,
            can: CanWatch::new(now),
            reports: Reports::default(),
            forgiven: false,
        }
    }

    /// This system was held up, or has just begun: silence counts from now on. Once between two
    /// signs of life: a system that always polls late must find a dead one too. Returns
    /// whether it was done.
    pub(crate) fn forgive(&mut self, now: Instant) -> bool {
        if core::mem::replace(&mut self.forgiven, true) {
            return false;
        }
        self.beats.forgive(now);
        self.can.forgive(now);
        true
    }

    /// Takes what a poll has seen.
    pub(crate) fn update(
        &mut self,
        config: &Config,
        now: Instant,
        seen: &Seen,
        actions: &mut Actions,
    ) {
        for (line, change) in (1..).zip(self.beats.update(now, seen.beats)) {
            match change {
                Some(LineChange::Silent) => actions.record(Event::LineSilent(line)),
                Some(LineChange::Back) => actions.record(Event::LineBack(line)),
                None => {}
            }
        }
        self.level.update(now, seen.peer_powered);
        if seen.heartbeats() > 0 {
            self.on_incarnation(config, now);
        }
        self.can
            .update(now, seen.can_frames, config.witness_limit());
        let silent = self.can_is_silent(config, now);
        if self.can.is_news(silent) {
            actions.record(Event::CanSilent(silent));
        }
    }

    /// A sign of life of the other system.
    pub(crate) fn on_incarnation(&mut self, config: &Config, now: Instant) {
        self.level.on_incarnation(now, config.witness_limit());
        self.forgiven = false;
    }

    /// Nothing was heard on CAN for too long.
    pub(crate) fn can_is_silent(&self, config: &Config, now: Instant) -> bool {
        self.can.is_silent(now, config.can_open_limit)
    }

    /// The other system is powered and its heartbeats come.
    pub(crate) fn peer_is_there(&self) -> bool {
        !self.level.is_off() && !self.beats.both_silent()
    }

    /// Both heartbeat lines are silent for so long that a master gives up its standby.
    pub(crate) fn standby_is_gone(&self, config: &Config, now: Instant) -> bool {
        self.beats.both_silent() && self.beats.silent_for(now) > config.standby_limit
    }
}
