//! The phase `Standby`: is the master there? Its control frames are the witness that decides.

use crate::witness::Witnesses;
use crate::{Config, Evidence, Mode, Role};
use tandem_board::{Duration, Instant, SystemId};

/// The phase `Standby`: what is known of the master from its control frames.
#[derive(Clone, Debug)]
pub(crate) struct Standby {
    system: SystemId,
    /// When the last valid control frame was heard, or when this system became standby.
    last_control: Instant,
    /// A control frame was heard in this phase.
    control_known: bool,
    /// Since its last control frame, the master was silent on both lines or sent a handshake.
    suspected: bool,
    /// The lines were silent at the last poll.
    silent: bool,
    /// What this system computes: the master's function as far as a standby can follow it.
    mode: Mode,
}

impl Standby {
    pub(crate) const fn new(system: SystemId, now: Instant, mode: Mode) -> Self {
        Self {
            system,
            last_control: now,
            control_known: false,
            suspected: false,
            silent: false,
            mode,
        }
    }

    pub(crate) const fn mode(&self) -> Mode {
        self.mode
    }

    pub(crate) const fn last_control(&self) -> Instant {
        self.last_control
    }

    /// A valid control frame of the master, in the highest term.
    pub(crate) fn on_control_frame(&mut self, now: Instant, mode: Mode) {
        self.last_control = now;
        self.control_known = true;
        self.suspected = false;
        self.mode = match mode {
            Mode::L3 => Mode::L3,
            Mode::None | Mode::DegradedL2 | Mode::SafeStop => Mode::DegradedL2,
        };
    }

    /// The vehicle accepted a frame of the master `age` ago. Counts if no frame was heard since
    /// about then: this system has lost frames, and the master drives.
    pub(crate) fn on_echo(&mut self, config: &Config, now: Instant, age: Duration) {
        let unheard = now.since(self.last_control);
        if unheard > age + config.control_margin {
            self.last_control = Instant::from_ns(now.as_ns().saturating_sub(age.as_ns()));
            self.control_known = true;
            self.suspected = false;
        }
    }

    /// This system was held up: its absence is no evidence against the master.
    pub(crate) fn forgive(&mut self, now: Instant) {
        self.last_control = self.last_control.max(now);
    }

    /// What the witnesses say about the master. `handshakes`: new ones.
    pub(crate) fn judge(
        &mut self,
        config: &Config,
        now: Instant,
        witnesses: &Witnesses,
        handshakes: u32,
    ) -> Option<Evidence> {
        let silent = witnesses.beats.both_silent();
        let was_silent = core::mem::replace(&mut self.silent, silent);
        // Remembered until control frames come again: a master that was reset may be back with its
        // heartbeats, as a standby, before its control frames are missed. A handshake is a sign of
        // a system that has just started, so it does not drive.
        self.suspected |= silent || handshakes > 0;
        if witnesses.level.is_off() {
            return Some(Evidence::PeerOff);
        }
        if self.suspected && now.since(self.last_control) > config.witness_limit() {
            return Some(Evidence::PeerSilent);
        }
        if !silent && self.master_is_mute(config, now, witnesses) {
            return Some(Evidence::MasterMute);
        }
        (silent && !was_silent).then_some(Evidence::BeatsSilent)
    }

    /// Heartbeats come, but control frames do not.
    fn master_is_mute(&self, config: &Config, now: Instant, witnesses: &Witnesses) -> bool {
        let age = now.since(self.last_control);
        // After an outage of the whole bus the master needs a control period to be heard again.
        let bus_alive = witnesses.can.alive_for(now) > config.witness_limit();
        if self.control_known {
            return age > config.mute_limit() && bus_alive;
        }
        let says_master = witnesses
            .reports
            .fresh(now, config.report_limit)
            .is_some_and(|report| report.role == Role::Master);
        age > config.no_master_limit(self.system) && (bus_alive || !says_master)
    }
}
