//! Faults on the processes, wires and files of a run.

use std::fs::OpenOptions;
use std::io::Write as _;
use std::path::PathBuf;

use anyhow::Context as _;
use rustix::process::Signal;
use tandem_board::{CoreId, Duration, ResetCause, SystemId};
use tandem_board_host::injection::{Injection, Target};
use tandem_board_host::{BusFault, Wire, clock};
use tandem_sim::faults::{Act, BusFaults, Fault};

/// Does the acts of faults to a run.
pub(super) struct Injector<'i> {
    injection: &'i Injection,
    /// The data flash of A and B.
    flash: [PathBuf; 2],
    /// Lets the process that started the run stand still for the given number of milliseconds.
    hold_launcher: &'i dyn Fn(u16) -> anyhow::Result<()>,
    bus: BusFaults,
    /// The system that is A in the faults: the one that drives.
    driver: SystemId,
}

impl<'i> Injector<'i> {
    pub(super) fn new(
        injection: &'i Injection,
        flash: [PathBuf; 2],
        hold_launcher: &'i dyn Fn(u16) -> anyhow::Result<()>,
    ) -> Self {
        Self {
            injection,
            flash,
            hold_launcher,
            bus: BusFaults::default(),
            driver: SystemId::A,
        }
    }

    /// Lets these faults, whose times count from now, come and go for `span` while `driver` drives;
    /// then all is mended.
    ///
    /// # Errors
    /// If the run's files cannot be changed.
    pub(super) fn suffer(
        &mut self,
        faults: &[Fault],
        span: Duration,
        driver: SystemId,
    ) -> anyhow::Result<()> {
        self.driver = driver;
        let begin = clock::now();
        let mut acts: Vec<(Duration, Act)> = Vec::new();
        for (at, act) in faults.iter().flat_map(|fault| fault.acts(span)) {
            match act {
                Act::Freeze(system, ms) => {
                    for core in CoreId::ALL {
                        acts.push((at, Act::FreezeCore(system, core, true)));
                        let until = at + Duration::from_ms(ms.into());
                        acts.push((until, Act::FreezeCore(system, core, false)));
                    }
                }
                act => acts.push((at, act)),
            }
        }
        acts.sort_by_key(|(at, _)| *at);
        for (at, act) in acts {
            clock::sleep_until(begin + at.min(span));
            if self.injection.backplane().stop_requested() {
                break;
            }
            self.act(act)?;
        }
        clock::sleep_until(begin + span);
        self.mend();
        Ok(())
    }

    /// Ends whatever is under way. A system without power is switched on.
    pub(super) fn mend(&mut self) {
        self.injection.signal(Target::Vehicle, Signal::CONT);
        self.bus = BusFaults::default();
        for system in SystemId::ALL {
            for wire in Wire::ALL {
                self.injection.set_cut(wire, &[system], false);
            }
            self.injection.hold_level_low(system, false);
            self.injection
                .backplane()
                .disturb_bus(system, BusFault::default());
            self.injection.signal(Target::Supply(system), Signal::CONT);
            for core in CoreId::ALL {
                self.injection
                    .signal(Target::Core(system, core), Signal::CONT);
            }
            self.injection.request_power(system);
        }
    }

    /// The system that a fault calls A, B.
    fn real(&self, system: SystemId) -> SystemId {
        if self.driver == SystemId::A {
            system
        } else {
            system.peer()
        }
    }

    fn act(&mut self, act: Act) -> anyhow::Result<()> {
        let injection = self.injection;
        let freeze = |target, on| {
            let signal = if on { Signal::STOP } else { Signal::CONT };
            injection.signal(target, signal);
        };
        match act {
            Act::Cut(wire, of, cut) => injection.set_cut(wire, &[self.real(of)], cut),
            Act::LevelLow(of, held) => injection.hold_level_low(self.real(of), held),
            Act::Edge(to, line, edge) => injection.stray_edge(self.real(to).peer(), line, edge),
            Act::LostOut(..) | Act::LostIn(..) | Act::Late(..) => {
                if let Some((of, fault)) = self.bus.follow(act) {
                    injection.backplane().disturb_bus(self.real(of), fault);
                }
            }
            Act::Power(of, true) => injection.request_power(self.real(of)),
            Act::Power(of, false) => {
                injection.signal(Target::Supply(self.real(of)), Signal::KILL);
            }
            Act::Reset(of, ResetCause::Watchdog) => {
                freeze(Target::Core(self.real(of), CoreId::CONTROL), true);
            }
            Act::Reset(of, ResetCause::Trap) => {
                injection.signal(Target::Core(self.real(of), CoreId::CONTROL), Signal::KILL);
            }
            Act::Reset(of, _) => injection.reset(self.real(of)),
            Act::FreezeCore(of, core, on) => freeze(Target::Core(self.real(of), core), on),
            Act::FreezeSupply(of, on) => freeze(Target::Supply(self.real(of)), on),
            Act::FreezeVehicle(on) => freeze(Target::Vehicle, on),
            Act::FreezeLauncher(ms) => (self.hold_launcher)(ms)?,
            Act::Kill(of, core) => {
                injection.signal(Target::Core(self.real(of), core), Signal::KILL);
            }
            Act::Scribble(of) => injection.scribble(self.real(of), 1)?,
            Act::FlashLost(of) => self.lose_flash(self.real(of))?,
            Act::Freeze(..)
            | Act::Rest(..)
            | Act::Clock(..)
            | Act::ClockJumps(..)
            | Act::WrongResults(..)
            | Act::FlashHangs(..)
            | Act::Poison(_)
            | Act::VehicleSilent(_) => unreachable!("Kind::is_for_processes refused it"),
        }
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
