//! What the vehicle needs of a board: its clock, the bus, and what an observer sees.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use tandem_board::{
    CanFrame, CoreId, Duration, Instant, Received, RoleLamp, SupplyEvent, SystemId, Traced,
};
use tandem_board_host::clock::Ticker;
use tandem_board_host::{HostVehiclePort, VehicleArgs, VehiclePortError};
use tandem_board_qemu::EmulatedWorld;

/// One tick of the vehicle.
const TICK: Duration = Duration::from_ms(1);

/// A board as the vehicle sees it.
pub(crate) trait VehiclePort {
    /// Waits for the next tick of 1 ms, and returns when it was due.
    ///
    /// # Errors
    /// If the board fails.
    fn tick(&mut self) -> anyhow::Result<Instant>;
    /// The clock.
    fn now(&self) -> Instant;
    /// Switches both systems on, or ends the run.
    fn set_ignition(&mut self, on: bool);
    /// Whether a person wants the run to end early.
    fn stop_requested(&self) -> bool;
    /// Takes the frames that the cores have sent.
    fn transmitted(&mut self, seen: &mut dyn FnMut(SystemId, CoreId, Received));
    /// Sends a frame of one of the vehicle's own nodes.
    fn broadcast(&mut self, frame: &CanFrame);
    /// Tells the cores that want to know that there are new frames.
    fn ring_receivers(&mut self);
    /// Takes the cores' trace records, and returns how many were lost.
    fn drain_trace(&mut self, into: &mut dyn FnMut(Traced)) -> u32;
    /// Takes what is behind a record that its writer was killed in. Only at the end of the run.
    fn salvage_trace(&mut self, _into: &mut dyn FnMut(Traced)) {}
    /// Takes what the supplies have done, on a board that tells.
    fn drain_supplies(&mut self, _into: &mut dyn FnMut(Instant, SystemId, SupplyEvent)) {}
    /// What the system shows of its role.
    fn role(&self, system: SystemId) -> RoleLamp;
    /// Whether the system has power and is out of reset.
    fn is_powered(&self, system: SystemId) -> bool;
}

/// The run's processes on this machine, in real time.
pub(crate) struct OnHost {
    port: HostVehiclePort,
    ticker: Option<Ticker>,
}

impl OnHost {
    /// Attaches as the vehicle of the run.
    ///
    /// # Errors
    /// If the run is over.
    pub(crate) fn attach(args: &VehicleArgs) -> Result<Self, VehiclePortError> {
        Ok(Self {
            port: HostVehiclePort::attach(args)?,
            ticker: None,
        })
    }
}

impl VehiclePort for OnHost {
    fn tick(&mut self) -> anyhow::Result<Instant> {
        let ticker = self.ticker.get_or_insert_with(|| Ticker::new(TICK));
        Ok(ticker.wait().due)
    }

    fn now(&self) -> Instant {
        self.port.now()
    }

    fn set_ignition(&mut self, on: bool) {
        self.port.set_ignition(on);
    }

    fn stop_requested(&self) -> bool {
        self.port.stop_requested()
    }

    fn transmitted(&mut self, seen: &mut dyn FnMut(SystemId, CoreId, Received)) {
        self.port.transmitted(seen);
    }

    fn broadcast(&mut self, frame: &CanFrame) {
        self.port.broadcast(frame);
    }

    fn ring_receivers(&mut self) {
        self.port.ring_receivers();
    }

    fn drain_trace(&mut self, into: &mut dyn FnMut(Traced)) -> u32 {
        self.port.drain_trace(into)
    }

    fn salvage_trace(&mut self, into: &mut dyn FnMut(Traced)) {
        self.port.salvage_trace(into);
    }

    fn drain_supplies(&mut self, into: &mut dyn FnMut(Instant, SystemId, SupplyEvent)) {
        self.port.drain_supplies(into);
    }

    fn role(&self, system: SystemId) -> RoleLamp {
        self.port.role(system)
    }

    fn is_powered(&self, system: SystemId) -> bool {
        self.port.is_powered(system)
    }
}

/// Emulated machines, in virtual time.
pub(crate) struct OnQemu {
    /// The machines.
    pub(crate) world: EmulatedWorld,
    /// A person wants the run to end.
    pub(crate) stop: Arc<AtomicBool>,
}

impl VehiclePort for OnQemu {
    fn tick(&mut self) -> anyhow::Result<Instant> {
        Ok(self.world.step()?)
    }

    fn now(&self) -> Instant {
        self.world.now()
    }

    fn set_ignition(&mut self, on: bool) {
        self.world.set_ignition(on);
    }

    fn stop_requested(&self) -> bool {
        self.stop.load(Ordering::Relaxed)
    }

    fn transmitted(&mut self, seen: &mut dyn FnMut(SystemId, CoreId, Received)) {
        self.world.transmitted(seen);
    }

    fn broadcast(&mut self, frame: &CanFrame) {
        self.world.broadcast(frame);
    }

    fn ring_receivers(&mut self) {}

    fn drain_trace(&mut self, into: &mut dyn FnMut(Traced)) -> u32 {
        self.world.drain_trace(into)
    }

    fn role(&self, system: SystemId) -> RoleLamp {
        self.world.role(system)
    }

    fn is_powered(&self, system: SystemId) -> bool {
        self.world.is_powered(system)
    }
}
