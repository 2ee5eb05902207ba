//! The witness of the power level: what the line says, and whether it is believed.

use crate::Config;
use tandem_board::Instant;

/// The other system's power level line.
#[derive(Clone, Debug)]
pub(crate) struct Level {
    /// Since when the line is low; `None` while it is high.
    low_since: Option<Instant>,
    /// Heartbeats came until the line fell, so they must end with it.
    beats_at_fall: bool,
    /// The last heartbeat, and the last sign of life of any kind, since the line fell.
    last_beat: Instant,
    last_sign: Instant,
    /// The line was low while the other system was seen to live. It is not believed until it has
    /// been high for long enough.
    broken: bool,
    /// Since when the line is high.
    high_since: Instant,
}

impl Level {
    pub(crate) const fn new(now: Instant) -> Self {
        Self {
            low_since: None,
            beats_at_fall: false,
            last_beat: now,
            last_sign: now,
            broken: false,
            high_since: now,
        }
    }

    /// Takes the level at a poll. `beats`: heartbeats came since the last poll; `beats_alive`: not
    /// both heartbeat lines are silent. Returns the new state of the line when it changes: broken
    /// or not.
    pub(crate) fn update(
        &mut self,
        config: &Config,
        now: Instant,
        powered: bool,
        beats: bool,
        beats_alive: bool,
    ) -> Option<bool> {
        let was_broken = self.broken;
        if powered {
            if self.low_since.take().is_some() {
                self.high_since = now;
            }
            self.broken &= now.since(self.high_since) < config.recover_after;
        } else if let Some(since) = self.low_since {
            if beats {
                self.last_beat = now;
                // One that was sent just before the fall may be counted a poll later.
                self.broken |= now.since(since) > config.poll_interval;
            }
        } else {
            self.low_since = Some(now);
            self.beats_at_fall = beats_alive;
            (self.last_beat, self.last_sign) = (now, now);
        }
        (self.broken != was_broken).then_some(self.broken)
    }

    /// The other system was seen to live at `at`, on CAN or over the link. Returns whether that
    /// shows the line to be broken.
    pub(crate) fn on_life(&mut self, config: &Config, at: Instant) -> bool {
        let Some(since) = self.low_since else {
            return false;
        };
        self.last_sign = self.last_sign.max(at);
        let contradicts = at > since + config.level_limit();
        contradicts && !core::mem::replace(&mut self.broken, true)
    }

    /// The other system drives in a new term: it cannot do so without power. Returns whether that
    /// shows the line to be broken.
    pub(crate) fn on_drive(&mut self) -> bool {
        self.low_since.is_some() && !core::mem::replace(&mut self.broken, true)
    }

    /// Whether the other system is without power: the line is low, and its heartbeats, if they came
    /// before, have ended with it. Without heartbeats to compare with, all other signs of life must
    /// have ended for the third witness's limit.
    pub(crate) fn is_off(&self, config: &Config, now: Instant) -> bool {
        self.low_since.is_some()
            && !self.broken
            && (self.beats_at_fall && now.since(self.last_beat) >= config.level_limit()
                || now.since(self.last_sign.max(self.last_beat)) > config.witness_limit())
    }
}
