//! Faults of power, cores, wires, bus, flash and clock.

use crate::config::{Clock, Filter, Tamper};
use crate::machine::Machine;
use crate::pair::SimPair;
use rand::RngExt;
use tandem_board::{
    CoreAddress, CoreId, Duration, Edge, HardwareFault, Line, ResetCause, SystemId,
};
use tandem_peripherals::memory::scribble;
use tandem_peripherals::network::{BusFault, Station, Wire};

/// Fault injection.
impl SimPair {
    /// Switches a supply on: the LMU is zero, core 0 starts in generation 1. No effect if it is on.
    pub fn power_on(&mut self, system: SystemId) {
        self.shared.power_on(system);
        self.follow_incarnations();
    }

    /// Cuts the power of a system at once.
    pub fn power_off(&mut self, system: SystemId) {
        self.shared.lock().power_off(system);
        self.follow_incarnations();
    }

    /// Cuts the power of a system as soon as its flash has changed `bytes` more bytes; with 0,
    /// before the next operation changes its first byte.
    pub fn power_off_after_flash_bytes(&mut self, system: SystemId, bytes: u64) {
        self.shared.lock().system(system).flash_bytes_to_live = Some(bytes);
    }

    /// Makes the supply reset a powered system; the system restarts after
    /// [`Config::reset_hold`](crate::Config::reset_hold).
    pub fn reset(&mut self, system: SystemId, cause: ResetCause) {
        self.shared.lock().reset(system, cause);
        self.follow_incarnations();
    }

    /// Kills a core; it stays dead, and no other core is notified.
    pub fn kill_core(&mut self, system: SystemId, core: CoreId) {
        self.shared.lock().kill_core(CoreAddress { system, core });
        self.follow_incarnations();
    }

    /// Begins the next incarnation of a single core; the LMU keeps its content.
    pub fn restart_core(&mut self, system: SystemId, core: CoreId) {
        self.shared
            .lock()
            .restart_core(CoreAddress { system, core });
        self.follow_incarnations();
    }

    /// Stops a core for a span of virtual time; its interrupts and frames stay pending.
    pub fn freeze_core(&mut self, system: SystemId, core: CoreId, span: Duration) {
        let mut machine = self.shared.lock();
        let thaws = (machine.at() + span).as_ns();
        machine.core(CoreAddress { system, core }).frozen_until_ns = thaws;
    }

    /// Stops all cores of a system for a span of virtual time; the supply keeps running.
    pub fn freeze(&mut self, system: SystemId, span: Duration) {
        CoreId::ALL
            .into_iter()
            .for_each(|core| self.freeze_core(system, core, span));
    }

    /// Cuts a connection that starts at this system.
    pub fn cut(&mut self, wire: Wire, from: SystemId) {
        self.shared.lock().set_cut(wire, from, true);
    }

    /// Restores a connection that was cut.
    pub fn restore(&mut self, wire: Wire, from: SystemId) {
        self.shared.lock().set_cut(wire, from, false);
    }

    /// Changes the content of a system's flash, as a programming device would.
    pub fn edit_flash(&mut self, system: SystemId, edit: impl FnOnce(&mut [u8])) {
        edit(self.shared.lock().system(system).flash.bytes_mut());
    }

    /// Makes this system's level line read low at the other system, even while this system is on.
    pub fn hold_level_low(&mut self, system: SystemId, held: bool) {
        self.shared.lock().hold_level_low(system, held);
    }

    /// Delivers to `to` an edge that no system has sent.
    pub fn stray_edge(&mut self, to: SystemId, line: Line, edge: Edge) {
        self.shared.lock().count_edge(to, line, edge);
    }

    /// Sets the faults of a system's connection to the CAN bus.
    pub fn disturb_bus(&mut self, system: SystemId, fault: BusFault) {
        self.shared.lock().conditions().bus[system.index()] = fault;
    }

    /// Injects or repairs a hardware fault of a system.
    pub fn set_fault(&mut self, of: SystemId, fault: HardwareFault, present: bool) {
        self.shared.lock().set_fault(of, fault, present);
        self.follow_incarnations();
    }

    /// Delays a core after each poll by this span, so that all its deadlines pass late.
    pub fn rest_core(&mut self, system: SystemId, core: CoreId, span: Duration) {
        self.shared.lock().core(CoreAddress { system, core }).rest = span;
    }

    /// Changes each frame that a system sends from now on; `None` ends the changes.
    pub fn tamper(&mut self, system: SystemId, with: Option<Tamper>) {
        self.shared.lock().system(system).tamper = with;
    }

    /// Changes each frame that a core hears from now on; `None` ends the changes.
    pub fn filter_heard(&mut self, system: SystemId, core: CoreId, filter: Option<Filter>) {
        self.shared.lock().system(system).heard[core.index()] = filter;
    }

    /// Changes each frame that a core sends from now on; `None` ends the changes.
    pub fn filter_sent(&mut self, system: SystemId, core: CoreId, filter: Option<Filter>) {
        self.shared.lock().system(system).sent[core.index()] = filter;
    }

    /// Overwrites the LMU of a system, as one of its cores could.
    pub fn scribble(&mut self, system: SystemId, seed: u32) {
        scribble(self.lmu(system), seed);
    }

    /// While `hangs` is true, no flash operation ends, neither the present one nor a later one.
    pub fn hang_flash(&mut self, system: SystemId, hangs: bool) {
        self.shared.lock().system(system).flash.hang(hangs);
    }

    /// Moves the clock of a system by this many milliseconds, but not below zero.
    pub fn jump_clock(&mut self, system: SystemId, by_ms: i32) {
        let mut machine = self.shared.lock();
        let clock = &mut machine.config.clocks[system.index()];
        clock.offset_ns = clock
            .offset_ns
            .saturating_add_signed(i64::from(by_ms) * 1_000_000);
        let now_ns = machine.now_ns;
        machine.set_now(now_ns);
        for core in &mut machine.system(system).cores {
            // The clock may now be past the core's deadline, so poll the core at once.
            core.deadline_ns = core.deadline_ns.min(now_ns);
        }
    }

    /// Makes the clock of a system continue from its present value, faster than virtual time by
    /// `drift_ppb` parts per billion.
    pub fn set_clock_rate(&mut self, system: SystemId, drift_ppb: i32) {
        let mut machine = self.shared.lock();
        let now_ns = machine.now_ns;
        let clock = &mut machine.config.clocks[system.index()];
        *clock = clock.with_rate(now_ns, drift_ppb);
        machine.set_now(now_ns);
    }
}

impl Machine {
    pub(crate) fn set_fault(&mut self, of: SystemId, fault: HardwareFault, present: bool) {
        let now = self.at();
        let faults = &mut self.conditions().hardware[of.index()];
        faults.set(fault, present);
        let faults = *faults;
        if let Some(ethernet) = &mut self.ethernet {
            let is_cut = faults.has(HardwareFault::Network);
            ethernet.set_cut(Station::of(of), is_cut, now);
        }
        self.with_supply(of, |supply| supply.observe(now, faults));
    }

    fn hold_level_low(&mut self, system: SystemId, held: bool) {
        let before = self.level(system);
        self.conditions().held_low[system.index()] = held;
        if self.show_level(system) != before {
            self.raise_peer(system);
        }
    }

    /// Returns a random number below `limit`; 0 if `limit` is 0.
    pub(crate) fn draw_below(&mut self, limit: u64) -> u64 {
        self.noise.random_range(0..limit.max(1))
    }
}

impl Clock {
    /// Returns this clock with another rate from virtual time `at_ns` on.
    fn with_rate(self, at_ns: u64, drift_ppb: i32) -> Self {
        let shows = self.local_ns(at_ns);
        let from_zero = Self {
            offset_ns: 0,
            drift_ppb,
        };
        Self {
            offset_ns: shows.saturating_sub(from_zero.local_ns(at_ns)),
            drift_ppb,
        }
    }
}
