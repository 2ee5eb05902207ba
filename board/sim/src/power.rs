//! The supplies: power, resets, watchdogs, and the effect of a power loss on the flash.

use crate::config::Defect;
use crate::event::SystemEventKind;
use crate::flash::Flash;
use crate::machine::{Core, Machine};
use std::sync::atomic::Ordering;
use tandem_board::{
    CoreAddress, CoreId, FlashError, ResetCause, ResetRequest, RoleLamp, SystemId, watchdog_answer,
};
use tandem_peripherals::data_flash::PAGE_BYTES;
use tandem_peripherals::network::Wire;
use tandem_peripherals::supply::{Change, Supply};

impl Machine {
    pub(crate) fn is_powered(&self, system: SystemId) -> bool {
        self.systems[system.index()].supply.is_on()
    }

    /// The level line of `system`, seen by its peer.
    pub(crate) fn level(&self, system: SystemId) -> bool {
        let shown = self.is_powered(system) && !self.has(Defect::LevelStuckLow);
        let stuck = self.has(Defect::LevelStuckHigh);
        self.network.conditions.level(system, shown || stuck)
    }

    /// Runs an action of a supply; a change of the level line interrupts the other system.
    pub(crate) fn with_supply(
        &mut self,
        system: SystemId,
        act: impl FnOnce(&mut Supply) -> Option<Change>,
    ) {
        let before = self.level(system);
        let change = act(&mut self.system(system).supply);
        match change {
            None => return,
            Some(Change::Start(cause)) => self.start(system, cause),
            Some(Change::Reset(cause)) => self.stop(system, SystemEventKind::Reset(cause)),
            Some(Change::Suspend) => self.stop(system, SystemEventKind::Suspended),
            Some(Change::PowerOff) => self.stop(system, SystemEventKind::PowerLost),
        }
        if self.show_level(system) != before && !self.has(Defect::SilentLevel) {
            self.raise_peer(system);
        }
    }

    /// Shows the level line as it is now to the cores of the other system, and returns it.
    pub(crate) fn show_level(&self, system: SystemId) -> bool {
        let level = self.level(system);
        self.glance.level(system).store(level, Ordering::Relaxed);
        level
    }

    pub(crate) fn set_cut(&mut self, wire: Wire, from: SystemId, cut: bool) {
        let before = self.level(from);
        self.conditions().cuts.set(wire, from, cut);
        if self.show_level(from) != before {
            self.raise_peer(from);
        }
    }

    pub(crate) fn power_on(&mut self, system: SystemId) {
        let now = self.at();
        self.glance.forget_edges(system);
        let state = self.system(system);
        state.cores.iter_mut().for_each(|core| core.generation = 0);
        self.with_supply(system, |supply| supply.power_on(now));
    }

    /// Core 0 of a system begins a new incarnation; the others wait for its release.
    fn start(&mut self, system: SystemId, cause: ResetCause) {
        let skipped = u32::from(self.has(Defect::WrongGeneration));
        let all = self.has(Defect::NoneHeld);
        let state = self.system(system);
        state.lamp = RoleLamp::Starting;
        // All are dead here, unless a defect leaves one running.
        for core in state.cores.iter_mut().filter(|core| !core.alive) {
            (core.held, core.generation) = (true, core.generation + 1 + skipped);
        }
        for core in CoreId::ALL {
            if all || core == CoreId::CONTROL {
                self.release(CoreAddress { system, core });
            }
        }
        self.log(system, SystemEventKind::Started(cause));
    }

    /// A release by core 0, with the defects of the release.
    pub(crate) fn release_core(&mut self, place: CoreAddress) {
        let others = [CoreId::PERCEPTION, CoreId::PLANNING];
        match self.config.defect {
            Some(Defect::NeverReleased) => {}
            Some(Defect::ReleasesAll) => {
                for core in others {
                    self.release(CoreAddress { core, ..place });
                }
            }
            Some(Defect::ReleasesAgain) => {
                self.core(place).held = true;
                self.release(place);
            }
            _ => self.release(place),
        }
    }

    fn release(&mut self, place: CoreAddress) {
        self.incarnations += 1;
        let core = self.core(place);
        if core.held {
            let generation = core.generation;
            self.start_core(place, generation);
        }
    }

    /// Stops the cores of a system and its operations.
    fn stop(&mut self, system: SystemId, why: SystemEventKind) {
        let now = self.at();
        let resets = matches!(why, SystemEventKind::Reset(_));
        let partial = resets && self.has(Defect::PartialReset);
        let forgets = resets && self.has(Defect::FlashForgets);
        let state = &mut self.systems[system.index()];
        let interrupted = resets && state.flash.is_busy();
        let changed = state.flash.lose_power(now, &mut self.noise);
        state.flash_bytes_to_live = state
            .flash_bytes_to_live
            .map(|left| left - changed.min(left));
        state.inbox.clear();
        if forgets {
            state.flash = Flash::new();
        }
        if interrupted && self.config.defect == Some(Defect::ResetDisturbs) {
            state.flash.bytes_mut().fill(0);
        }
        let reached = if partial { 2 } else { CoreId::COUNT };
        state.cores[..reached]
            .iter_mut()
            .for_each(|core| (core.alive, core.held) = (false, false));
        self.incarnations += 1;
        self.network.stop(system, now);
        self.log(system, why);
    }

    pub(crate) fn power_off(&mut self, system: SystemId) {
        self.with_supply(system, Supply::power_off);
    }

    pub(crate) fn reset(&mut self, system: SystemId, cause: ResetCause) {
        let now = self.at();
        self.with_supply(system, |supply| supply.reset(now, cause));
    }

    pub(crate) fn kill_core(&mut self, place: CoreAddress) {
        if self.core(place).alive {
            self.core(place).alive = false;
            self.network.stop_core(place);
            self.incarnations += 1;
            self.log(place.system, SystemEventKind::CoreDied(place.core));
        }
    }

    pub(crate) fn restart_core(&mut self, place: CoreAddress) {
        if self.is_powered(place.system) {
            let generation = self.core(place).generation + 1;
            self.start_core(place, generation);
            self.incarnations += 1;
            self.log(place.system, SystemEventKind::CoreRestarted(place.core));
        }
    }

    pub(crate) fn request_reset(&mut self, place: CoreAddress, request: ResetRequest) {
        if !self.has(Defect::RequestIgnored) {
            self.system(place.system).supply.request(request);
        }
        self.log(
            place.system,
            SystemEventKind::Requested(place.core, request),
        );
    }

    /// The reset cause that the system's cores read.
    pub(crate) fn reset_cause(&self, system: SystemId) -> ResetCause {
        match self.has(Defect::CauseForgotten) {
            true => ResetCause::PowerOn,
            false => self.systems[system.index()].supply.cause(),
        }
    }

    /// The question of the functional watchdog, as a core reads it.
    pub(crate) fn watchdog_question(&self, system: SystemId) -> u8 {
        match self.has(Defect::SameQuestion) {
            true => 0,
            false => self.systems[system.index()].supply.question(),
        }
    }

    pub(crate) fn service_watchdog(&mut self, system: SystemId, answer: u8) {
        let now = self.at();
        let question = self.systems[system.index()].supply.question();
        let right = watchdog_answer(question);
        let answer = match self.config.defect {
            Some(Defect::AnyAnswer) => right,
            Some(Defect::SameQuestion) if answer == watchdog_answer(0) => right,
            Some(Defect::WatchdogRefuses) if question == 8 => !answer,
            _ => answer,
        };
        self.with_supply(system, |supply| supply.service(now, now, Some(answer)));
    }

    /// Does everything that is due at this instant in the supplies and the flash.
    pub(crate) fn settle(&mut self) {
        let now = self.at();
        self.settle_network();
        for system in SystemId::ALL {
            self.settle_flash(system);
            if self.systems[system.index()].supply.next() <= now {
                self.with_supply(system, |supply| supply.poll(now, true));
            }
        }
    }

    /// When the flash of a system reaches the number of changed bytes at which power fails.
    fn flash_dies_ns(&self, system: SystemId) -> Option<u64> {
        let state = &self.systems[system.index()];
        state.flash.changed_ns(state.flash_bytes_to_live?)
    }

    fn settle_flash(&mut self, system: SystemId) {
        let now_ns = self.now_ns;
        if !self.systems[system.index()].flash.is_busy() {
            return;
        }
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

    /// The next virtual time at which a supply or a flash acts by itself.
    pub(crate) fn next_ns(&self) -> u64 {
        let of_system = |system: SystemId| {
            let state = &self.systems[system.index()];
            let supply = state.supply.next().as_ns();
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
        let systems = of_system(SystemId::A).min(of_system(SystemId::B));
        systems.min(self.network.next().as_ns())
    }
}

/// Core 0's flash operations, with the defects of the medium.
impl Machine {
    pub(crate) fn start_erase(&mut self, system: SystemId, sector: u32) -> Result<(), FlashError> {
        let (now, defect) = (self.at(), self.config.defect);
        let flash = &mut self.system(system).flash;
        if defect == Some(Defect::NeverBusy) {
            flash.abandon();
        }
        flash.start_erase(sector, now)?;
        self.glance.flash(system).store(true, Ordering::Relaxed);
        let flash = &mut self.system(system).flash;
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
        let (now, defect) = (self.at(), self.config.defect);
        let flash = &mut self.system(system).flash;
        if defect == Some(Defect::NeverBusy) {
            flash.abandon();
        }
        let offset = match defect {
            Some(Defect::MisalignedProgram) => offset & !(PAGE_BYTES - 1),
            _ => offset,
        };
        flash.start_program(offset, data, now)?;
        self.glance.flash(system).store(true, Ordering::Relaxed);
        let flash = &mut self.system(system).flash;
        if defect == Some(Defect::ProgramSets) {
            flash.spoil(|_, target| target.copy_from_slice(data));
        }
        if defect == Some(Defect::ProgramDisturbs) {
            flash.spoil(|behind, _| behind.fill(0));
        }
        Ok(())
    }
}
