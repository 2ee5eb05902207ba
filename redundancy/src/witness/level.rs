//! The witness of the power level: the state of the line, and whether it can be trusted.

use crate::Config;
use tandem_board::Instant;

/// The other system's power level line.
#[derive(Clone, Debug)]
pub(crate) struct Level {
    /// When the line fell. Kept after the line is high again, until a heartbeat arrives: a short
    /// reset ends before the missing heartbeat is detected.
    fell: Option<Instant>,
    is_low: bool,
    /// Whether heartbeats arrived until the line fell. If they did, a loss of power ends them.
    beats_at_fall: bool,
    /// When the last heartbeat arrived, and the last sign of any kind that the other system runs.
    last_beat: Instant,
    last_sign: Instant,
    /// The line was low while the other system was running. It is ignored until it has been high
    /// for long enough.
    broken: bool,
    /// When the line last rose.
    high_since: Instant,
}

impl Level {
    pub(crate) const fn new(now: Instant) -> Self {
        Self {
            fell: None,
            is_low: false,
            beats_at_fall: false,
            last_beat: now,
            last_sign: now,
            broken: false,
            high_since: now,
        }
    }

    /// Takes the level at a poll. `beats`: heartbeats arrived since the last poll; `beats_alive`: a
    /// heartbeat line is not silent. Returns whether the line is broken, when that changes.
    pub(crate) fn update(
        &mut self,
        config: &Config,
        now: Instant,
        powered: bool,
        beats: bool,
        beats_alive: bool,
    ) -> Option<bool> {
        let was_broken = self.broken;
        if beats {
            self.last_beat = now;
        }
        let was_low = core::mem::replace(&mut self.is_low, !powered);
        if powered {
            if was_low {
                self.high_since = now;
            }
            if beats || !self.beats_at_fall {
                self.fell = None;
            }
            self.broken &= now.since(self.high_since) < config.recover_after;
        } else if !was_low {
            self.fell = Some(now);
            self.beats_at_fall = beats_alive;
            (self.last_beat, self.last_sign) = (now, now);
        } else if let (true, Some(fell)) = (beats, self.fell) {
            // A heartbeat from just before the fall may be counted a poll later.
            self.broken |= now.since(fell) > config.poll_interval;
        }
        (self.broken != was_broken).then_some(self.broken)
    }

    /// Handles a sign of life of the other system at `at`, on CAN or over the link. Returns whether
    /// it shows that the line is broken.
    pub(crate) fn on_life(&mut self, config: &Config, at: Instant) -> bool {
        let Some(fell) = self.fell else {
            return false;
        };
        self.last_sign = self.last_sign.max(at);
        if at <= fell + config.level_limit() {
            return false;
        }
        if !self.is_low {
            self.fell = None;
            return false;
        }
        !core::mem::replace(&mut self.broken, true)
    }

    /// Notes that the other system drives in a new term, which needs power. Returns whether this
    /// shows that the line is broken.
    pub(crate) fn on_drive(&mut self) -> bool {
        self.is_low && !core::mem::replace(&mut self.broken, true)
    }

    /// Returns the time at which the fallen line will have been low for long enough, if no
    /// heartbeat arrives before then.
    pub(crate) fn limit(&self, config: &Config) -> Instant {
        match self.fell {
            Some(_) => self.last_beat + config.level_limit(),
            None => Instant::NEVER,
        }
    }

    /// Returns whether the other system is without power, or was and has not restarted yet: the
    /// line fell, and heartbeats that arrived before the fall have ended. If none arrived before,
    /// the line must be low, and no other sign of life may have arrived for the third witness's
    /// limit.
    pub(crate) fn is_off(&self, config: &Config, now: Instant) -> bool {
        let last_sign = self.last_sign.max(self.last_beat);
        self.fell.is_some()
            && !self.broken
            && (self.beats_at_fall && now.since(self.last_beat) >= config.level_limit()
                || self.is_low && now.since(last_sign) > config.witness_limit())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tandem_board::Duration;

    /// A system whose level fell counts as off if its heartbeats have ended too. If there were none
    /// before, the level must stay low, and no other sign of life may have arrived for the third
    /// witness's limit.
    #[test]
    fn a_fallen_level_counts_when_the_signs_of_life_have_ended() {
        let (rt, ns) = (Config::rt(), Duration::from_ns(1));
        let (low, witness) = (rt.level_limit(), rt.witness_limit());
        let ms = Duration::from_ms(1);
        for (beats_before, is_low, sign, after, expected) in [
            (true, true, None, low - ns, false),
            (true, true, None, low, true),
            (true, false, None, low, true),
            (false, true, None, witness, false),
            (false, true, None, witness + ns, true),
            (false, true, Some(ms), witness + ns, false),
            (false, true, Some(ms), witness + ms, false),
            (false, true, Some(ms), witness + ms + ns, true),
            (false, false, None, witness + ns, false),
        ] {
            let fell = Instant::from_ns(1_000_000);
            let mut level = Level::new(fell);
            let reported = level.update(&rt, fell, false, false, beats_before);
            assert_eq!(reported, None);
            if let Some(sign) = sign {
                assert!(!level.on_life(&rt, fell + sign));
            }
            let reported = level.update(&rt, fell + ms, !is_low, false, false);
            assert_eq!(reported, None);
            let case = (beats_before, is_low, sign, after);
            assert_eq!(level.is_off(&rt, fell + after), expected, "{case:?}");
        }
    }
}
