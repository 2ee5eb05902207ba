//! The supplies: power, resets, watchdogs, and the effect of a power loss on the flash.

use crate::event::SystemEventKind;
use crate::flash_medium::Flash;
use crate::machine::{Core, Machine};
use std::sync::atomic::Ordering;
use tandem_board::{
    CoreAddress, CoreId, FlashError, Instant, ResetCause, ResetRequest, RoleLamp, SystemId,
};
use tandem_peripherals::network::Wire;
use tandem_peripherals::supply::{Change, Supply};

impl Machine {
    pub(crate) fn is_powered(&self, system: SystemId) -> bool {
        self.systems[system.index()].supply.is_on()
    }

    /// Returns the level line of `system`, as its peer reads it.
    pub(crate) fn level(&self, system: SystemId) -> bool {
        let is_on = self.is_powered(system);
        self.network.conditions.level(system, is_on)
    }

    /// Runs an action of a supply, and interrupts the other system if the level line changes.
    pub(crate) fn with_supply(
        &mut self,
        system: SystemId,
        act: impl FnOnce(&mut Supply) -> Option<Change>,
    ) {
        let before = self.level(system);
        let change = self.system(system).supply.act(act);
        match change {
            None => return,
            Some(Change::Start(cause)) => self.start(system, cause),
            Some(Change::Reset(cause)) => self.stop(system, SystemEventKind::Reset(cause)),
            Some(Change::Suspend) => self.stop(system, SystemEventKind::Suspended),
            Some(Change::PowerOff) => self.stop(system, SystemEventKind::PowerLost),
        }
        if self.show_level(system) != before {
            self.raise_peer(system);
        }
    }

    /// Publishes the present level line to the cores of the other system, and returns it.
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
        state.time_edge = None;
        state.cores.iter_mut().for_each(|core| core.generation = 0);
        self.with_supply(system, |supply| supply.power_on(now));
    }

    /// Begins a new incarnation of core 0; the other cores wait for their release.
    fn start(&mut self, system: SystemId, cause: ResetCause) {
        let state = self.system(system);
        state.lamp = RoleLamp::Starting;
        for core in &mut state.cores {
            (core.held, core.generation) = (true, core.generation + 1);
        }
        self.release(CoreAddress::new(system, CoreId::CONTROL));
        self.log(system, SystemEventKind::Started(cause));
    }

    pub(crate) fn release(&mut self, place: CoreAddress) {
        self.incarnations += 1;
        let core = self.core(place);
        if core.held {
            let generation = core.generation;
            self.start_core(place, generation);
        }
    }

    /// Stops the cores of a system and its flash operation.
    fn stop(&mut self, system: SystemId, why: SystemEventKind) {
        let now = self.at();
        let state = &mut self.systems[system.index()];
        let changed = state.flash.lose_power(now, &mut self.noise);
        state.flash_bytes_to_live = state
            .flash_bytes_to_live
            .map(|left| left - changed.min(left));
        state.inbox.clear();
        for core in &mut state.cores {
            (core.alive, core.held) = (false, false);
        }
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
        let supply = &mut self.system(place.system).supply;
        supply.act(|supply| supply.request(request));
        self.log(
            place.system,
            SystemEventKind::Requested(place.core, request),
        );
    }

    pub(crate) fn service_watchdog(&mut self, system: SystemId, answer: u8) {
        let now = self.at();
        self.with_supply(system, |supply| supply.service(now, now, Some(answer)));
    }

    /// Carries out everything that is due at this instant in network, supplies and flash.
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

    /// Returns the time at which the flash has changed `flash_bytes_to_live` bytes, ns.
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

    /// Returns the next virtual time at which a supply, a flash, a core or the network acts.
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

/// Core 0's flash operations.
impl Machine {
    /// Begins the flash operation that `start` starts.
    pub(crate) fn start_flash(
        &mut self,
        system: SystemId,
        start: impl FnOnce(&mut Flash, Instant) -> Result<(), FlashError>,
    ) -> Result<(), FlashError> {
        let now = self.at();
        start(&mut self.system(system).flash, now)?;
        self.glance.flash(system).store(true, Ordering::Relaxed);
        Ok(())
    }
}
