//! Injects faults into the processes, wires and files of a run.

use std::fs::OpenOptions;
use std::io::Write as _;
use std::path::PathBuf;

use anyhow::Context as _;
use rustix::process::Signal;
use tandem_board::{CoreId, Duration, HardwareFault, SystemId};
use tandem_board_host::injection::{Injection, Target};
use tandem_board_host::{BusFault, Wire, clock};
use tandem_faults::{BusFaults, CannotSuffer, Effect, Fault, Kind, Site, Suffer, effects};

/// Injects faults into a run.
pub(super) struct Injector<'i> {
    injection: &'i Injection,
    /// The data flash of A and B.
    flash: [PathBuf; 2],
    /// Stops, for the given number of milliseconds, the process that started the run.
    hold_launcher: &'i dyn Fn(i32) -> anyhow::Result<()>,
    bus: BusFaults,
}

impl<'i> Injector<'i> {
    pub(super) fn new(
        injection: &'i Injection,
        flash: [PathBuf; 2],
        hold_launcher: &'i dyn Fn(i32) -> anyhow::Result<()>,
    ) -> Self {
        Self {
            injection,
            flash,
            hold_launcher,
            bus: BusFaults::default(),
        }
    }

    /// Injects these faults for `span` while `driver` drives, and then restores everything. The
    /// times of the faults count from now.
    ///
    /// # Errors
    /// If one of the faults is not possible with processes, or the run's files cannot be changed.
    pub(super) fn suffer(
        &mut self,
        faults: &[Fault],
        span: Duration,
        driver: SystemId,
    ) -> anyhow::Result<()> {
        let begin = clock::now();
        for (at, change) in effects(faults, span, driver) {
            clock::sleep_until(begin + at.min(span));
            if self.injection.backplane().stop_requested() {
                break;
            }
            self.apply(change)?;
        }
        clock::sleep_until(begin + span);
        self.restore();
        Ok(())
    }

    fn lose_flash(&self, of: SystemId) -> anyhow::Result<()> {
        let path = &self.flash[of.index()];
        let lose = || {
            let mut file = OpenOptions::new().write(true).open(path)?;
            let bytes = usize::try_from(file.metadata()?.len()).unwrap_or(0);
            file.write_all(&vec![0x5A; bytes])
        };
        lose().with_context(|| path.display().to_string())
    }
}

impl Suffer for Injector<'_> {
    type Error = anyhow::Error;

    fn apply(&mut self, change: Effect) -> anyhow::Result<()> {
        let injection = self.injection;
        let (kind, of, on) = match change {
            Effect::Fault(kind, of, on) => (kind, of, on),
            Effect::Edge(from, line, edge) => {
                injection.stray_edge(from, line, edge);
                return Ok(());
            }
        };
        if let Some(fault) = self.bus.follow(kind, of, on) {
            injection.backplane().disturb_bus(of, fault);
            return Ok(());
        }
        let freeze = |target| {
            injection.signal(target, if on { Signal::STOP } else { Signal::CONT });
        };
        let core = |core| Target::Core(of, core);
        match kind {
            Kind::Forged(forged) => injection.backplane().forge(on.then(|| forged.forgery())),
            Kind::Cut { wire } => injection.set_cut(wire, &[of], on),
            Kind::LevelLow => injection.hold_level_low(of, on),
            Kind::PowerLoss if on => {
                injection.signal(Target::Supply(of), Signal::KILL);
            }
            Kind::PowerLoss => injection.request_power(of),
            Kind::ResetByWatchdog => freeze(core(CoreId::CONTROL)),
            Kind::ResetByTrap => {
                injection.signal(core(CoreId::CONTROL), Signal::KILL);
            }
            Kind::ResetBySoftware => injection.reset(of),
            Kind::Hang(_) => CoreId::ALL.map(core).into_iter().for_each(freeze),
            Kind::CoreHangs(amount) => freeze(core(amount.core())),
            Kind::CoreDies(amount) => {
                injection.signal(core(amount.core()), Signal::KILL);
            }
            Kind::SupplyHangs(_) => freeze(Target::Supply(of)),
            Kind::VehicleHangs(_) => freeze(Target::Vehicle),
            Kind::LauncherHangs(amount) => (self.hold_launcher)(amount.get())?,
            Kind::Scribble => injection.scribble(of, 1)?,
            Kind::FlashLost => self.lose_flash(of)?,
            Kind::NetworkCut => injection.set_fault(of, HardwareFault::Network, on),
            _ => {
                let site = Site::Processes;
                return Err(CannotSuffer { kind, site }.into());
            }
        }
        Ok(())
    }

    fn restore(&mut self) {
        let injection = self.injection;
        injection.signal(Target::Vehicle, Signal::CONT);
        self.bus = BusFaults::default();
        injection.backplane().forge(None);
        for system in SystemId::ALL {
            for wire in Wire::ALL {
                injection.set_cut(wire, &[system], false);
            }
            injection.hold_level_low(system, false);
            injection.set_fault(system, HardwareFault::Network, false);
            injection
                .backplane()
                .disturb_bus(system, BusFault::default());
            injection.signal(Target::Supply(system), Signal::CONT);
            for core in CoreId::ALL {
                injection.signal(Target::Core(system, core), Signal::CONT);
            }
            injection.request_power(system);
        }
    }
}
