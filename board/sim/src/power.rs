//! What the supplies do: power, resets, watchdogs, and what a loss of power does to the flash.

use crate::config::Defect;
use crate::flash::{Flash, PAGE_BYTES};
use crate::machine::{Core, EventKind, Machine, Power, Wire};
use crate::watchdog::{Service, Watchdog};
use tandem_board::{
    CoreAddress, CoreId, FlashError, ResetCause, ResetRequest, RoleLamp, SystemId, watchdog_answer,
};

impl Machine {
    pub(crate) fn is_powered(&self, system: SystemId) -> bool {
        self.systems[system.index()].power == Power::On
    }

    /// What the level line shows of `system` to its peer.
    pub(crate) fn level(&self, system: SystemId) -> bool {
        let shown = self.is_powered(system) && !self.has(Defect::LevelStuckLow);
        let stuck = self.has(Defect::LevelStuckHigh);
        shown || stuck || self.systems[system.index()].is_cut(Wire::Level)
    }

    /// Changes the state of a supply; a change of the level line interrupts the other system.
    fn set_power(&mut self, system: SystemId, power: Power) {
        let before = self.level(system);
        self.system(system).power = power;
        if self.level(system) != before && !self.has(Defect::SilentLevel) {
            self.raise_peer(system);
        }
    }

    pub(crate) fn set_cut(&mut self, wire: Wire, from: SystemId, cut: bool) {
        let before = self.level(from);
        self.system(from).cut[wire.index()] = cut;
        if self.level(from) != before {
            self.raise_peer(from);
        }
    }

    pub(crate) fn power_on(&mut self, system: SystemId) {
        let state = self.system(system);
        state.edges = [[0; 2]; 3];
        state.cores.iter_mut().for_each(|core| core.generation = 0);
        self.start(system, ResetCause::PowerOn);
    }

    /// The cores of a system begin a new life.
    fn start(&mut self, system: SystemId, cause: ResetCause) {
        let now_ns = self.now_ns;
        let skipped = u32::from(self.has(Defect::WrongGeneration));
        let state = self.system(system);
        state.cause = cause;
        state.watchdog = Watchdog::start(now_ns);
        state.lamp = RoleLamp::Starting;
        state.request = None;
        // All are dead here, but for a defect.
        for core in state.cores.iter_mut().filter(|core| !core.alive) {
            core.start(core.generation + 1 + skipped, now_ns);
        }
        self.set_power(system, Power::On);
        self.log(system, EventKind::Started(cause));
    }

    /// The cores of a system and what the chip was doing end.
    fn stop(&mut self, system: SystemId, power: Power) {
        let now_ns = self.now_ns;
        let resets = matches!(power, Power::Reset { .. });
        let partial = resets && self.has(Defect::PartialReset);
        let forgets = resets && self.has(Defect::FlashForgets);
        let state = &mut self.systems[system.index()];
        let changed = state.flash.lose_power(now_ns, &mut self.noise);
        state.flash_bytes_to_live = state
            .flash_bytes_to_live
            .map(|left| left - changed.min(left));
        state.inbox.clear();
        if forgets {
            state.flash = Flash::new();
        }
        let reached = if partial { 2 } else { CoreId::COUNT };
        state.cores[..reached]
            .iter_mut()
            .for_each(|core| core.alive = false);
        self.set_power(system, power);
    }

    pub(crate) fn power_off(&mut self, system: SystemId) {
        if self.systems[system.index()].power != Power::Off {
            self.stop(system, Power::Off);
            self.log(system, EventKind::PowerLost);
        }
    }

    pub(crate) fn reset(&mut self, system: SystemId, cause: ResetCause) {
        if self.is_powered(system) {
            let until = self.at() + self.config.reset_hold;
            self.stop(system, Power::Reset { until, cause });
            self.log(system, EventKind::Reset(cause));
        }
    }

    pub(crate) fn kill_core(&mut self, place: CoreAddress) {
        if self.core(place).alive {
            self.core(place).alive = false;
            self.log(place.system, EventKind::CoreDied(place.core));
        }
    }

    pub(crate) fn restart_core(&mut self, place: CoreAddress) {
        if self.is_powered(place.system) {
            let now_ns = self.now_ns;
            let core = self.core(place);
            core.start(core.generation + 1, now_ns);
            self.log(place.system, EventKind::CoreRestarted(place.core));
        }
    }

    pub(crate) fn request_reset(&mut self, place: CoreAddress, request: ResetRequest) {
        self.system(place.system).request.get_or_insert(request);
        self.log(place.system, EventKind::Requested(place.core, request));
    }

    pub(crate) fn service_watchdog(&mut self, system: SystemId, answer: u8) {
        let (now_ns, defect) = (self.now_ns, self.config.defect);
        let watchdog = &mut self.system(system).watchdog;
        let before = *watchdog;
        let answer = match defect {
            Some(Defect::AnyAnswer) => watchdog_answer(before.question()),
            Some(Defect::WatchdogRefuses) if before.question() == 2 => !answer,
            _ => answer,
        };
        let service = watchdog.service(answer, now_ns);
        match defect {
            Some(Defect::SameQuestion) => watchdog.ask_again(&before),
            Some(Defect::WindowIgnored) => watchdog.open(),
            _ => {}
        }
        if service == Service::Refused && self.config.watchdog {
            self.reset(system, ResetCause::Watchdog);
        }
    }

    /// What the supplies and the flash do at this instant.
    pub(crate) fn settle(&mut self) {
        for system in SystemId::ALL {
            self.settle_flash(system);
            if let Some(request) = self.system(system).request.take() {
                self.obey(system, request);
            }
            let sleeps = self.has(Defect::WatchdogSleeps);
            match self.systems[system.index()].power {
                Power::On => {
                    let late = self.now_ns > self.systems[system.index()].watchdog.closes_ns();
                    if late && self.config.watchdog && !sleeps {
                        self.reset(system, ResetCause::Watchdog);
                    }
                }
                Power::Reset { until, cause } if self.at() >= until => {
                    let forgotten = self.has(Defect::CauseForgotten);
                    self.start(
                        system,
                        if forgotten {
                            ResetCause::PowerOn
                        } else {
                            cause
                        },
                    );
                }
                _ => {}
            }
        }
    }

    fn obey(&mut self, system: SystemId, request: ResetRequest) {
        if !self.is_powered(system) || self.has(Defect::RequestIgnored) {
            return;
        }
        match request {
            ResetRequest::Software => self.reset(system, ResetCause::Software),
            ResetRequest::CoreDead => self.reset(system, ResetCause::Trap),
            ResetRequest::Suspend => {
                self.stop(system, Power::Suspended);
                self.log(system, EventKind::Suspended);
            }
        }
    }

    /// When the flash of a system has changed as many bytes as it is allowed to.
    fn flash_dies_ns(&self, system: SystemId) -> Option<u64> {
        let state = &self.systems[system.index()];
        state.flash.changed_ns(state.flash_bytes_to_live?)
    }

    fn settle_flash(&mut self, system: SystemId) {
        let now_ns = self.now_ns;
        if self
            .flash_dies_ns(system)
            .is_some_and(|dies| now_ns >= dies)
        {
            self.power_off(system);
            self.system(system).flash_bytes_to_live = None;
            return;
        }
        let state = self.system(system);
        let changed = state.flash.settle(now_ns);
        state.flash_bytes_to_live = state.flash_bytes_to_live.map(|left| left - changed);
    }

    /// The next virtual time at which something happens by itself.
    pub(crate) fn next_ns(&self) -> u64 {
        let sleeps = self.has(Defect::WatchdogSleeps);
        let of_system = |system: SystemId| {
            let state = &self.systems[system.index()];
            let supply = match state.power {
                Power::On if self.config.watchdog && !sleeps => {
                    state.watchdog.closes_ns().saturating_add(1)
                }
                Power::Reset { until, .. } => until.as_ns(),
                _ => u64::MAX,
            };
            let flash = state.flash.ends_ns().unwrap_or(u64::MAX);
            let cut = self.flash_dies_ns(system).unwrap_or(u64::MAX);
            let cores = state
                .cores
                .iter()
                .map(Core::next_ns)
                .min()
                .unwrap_or(u64::MAX);
            supply.min(flash).min(cut).min(cores)
        };
        of_system(SystemId::A).min(of_system(SystemId::B))
    }
}

/// What core 0 asks of the flash, with the defects of the medium.
impl Machine {
    pub(crate) fn start_erase(&mut self, system: SystemId, sector: u32) -> Result<(), FlashError> {
        let (now_ns, defect) = (self.now_ns, self.config.defect);
        let flash = &mut self.system(system).flash;
        if defect == Some(Defect::NeverBusy) {
            flash.abandon();
        }
        flash.start_erase(sector, now_ns)?;
        if defect == Some(Defect::EraseToZero) {
            flash.spoil(|_, target| target.fill(0));
        }
        Ok(())
    }

    pub(crate) fn start_program(
        &mut self,
        system: SystemId,
        offset: u32,
        data: &[u8],
    ) -> Result<(), FlashError> {
        let (now_ns, defect) = (self.now_ns, self.config.defect);
        let flash = &mut self.system(system).flash;
        if defect == Some(Defect::NeverBusy) {
            flash.abandon();
        }
        let offset = match defect {
            Some(Defect::MisalignedProgram) => offset & !(PAGE_BYTES - 1),
            _ => offset,
        };
        flash.start_program(offset, data, now_ns)?;
        if defect == Some(Defect::ProgramDisturbs) {
            flash.spoil(|behind, _| behind.fill(0));
        }
        Ok(())
    }
}
