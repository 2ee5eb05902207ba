//! Access to a run from outside: its wires, its power, its memory.
//!
//! A run has a separate `/dev/shm`. Another process of the same user enters the run's namespaces
//! permanently and maps the backplane there.

use std::fs::{self, File};
use std::io;
use std::path::PathBuf;
use std::time::{Duration, Instant};

use rustix::io::Errno;
use rustix::process::{Pid, Signal, kill_process};
use rustix::thread::{LinkNameSpaceType, move_into_link_name_space};
use tandem_board::{CoreId, Edge, HardwareFault, Line, ResetRequest, SystemId};
use tandem_peripherals::memory::scribble;
use tandem_peripherals::network::Wire;

use crate::backplane::{Backplane, BackplaneError, Deed};
use crate::doorbell::Ringers;
use crate::memory;
use crate::name::RunName;
use crate::process_list::{self, Process, ProcessKind, RunError};
use crate::segment::SegmentError;
use crate::supply::{poke, poke_launcher};

/// Maximum time for the launcher to start a supply.
const SWITCHED_ON_WITHIN: Duration = Duration::from_secs(2);
const LOOK_AGAIN: Duration = Duration::from_millis(5);
/// How long a core is stopped: longer than its watchdog waits.
const HANG: Duration = Duration::from_millis(100);

/// Why a run cannot be reached.
#[derive(Debug, thiserror::Error)]
pub enum InjectionError {
    /// The run does not exist, or several runs are active.
    #[error(transparent)]
    Run(#[from] RunError),
    /// The namespaces of the run could not be entered.
    #[error("cannot enter the place of {run}: {source}")]
    Place {
        /// The run.
        run: RunName,
        /// The error of the operating system.
        source: io::Error,
    },
    /// The run's backplane could not be mapped.
    #[error(transparent)]
    Backplane(#[from] BackplaneError),
    /// A system's LMU could not be mapped.
    #[error("LMU: {0}")]
    Lmu(#[from] SegmentError),
    /// The system is already without power.
    #[error("system {0} is off")]
    IsOff(SystemId),
    /// The system already has power.
    #[error("system {0} is on")]
    IsOn(SystemId),
    /// The process that starts supplies has ended or does not respond.
    #[error("system {0} is not switched on: the `tandem run` of this run has ended or is stopped")]
    NoLauncher(SystemId),
    /// The supply could not be killed.
    #[error("cannot kill the supply: {0}")]
    Kill(io::Error),
}

/// A process of a run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Target {
    /// The supply of a system.
    Supply(SystemId),
    /// A core.
    Core(SystemId, CoreId),
    /// The vehicle, which is also the bus.
    Vehicle,
}

/// A process that has entered a run.
#[derive(Clone, Debug)]
pub struct Injection {
    run: RunName,
    backplane: Backplane,
}

impl Injection {
    /// Enters the run with this name, or the run started by the `tandem run` with this process id;
    /// without a name, the only active run. The calling process must have only one thread, and it
    /// stays in the run's namespaces.
    ///
    /// # Errors
    /// [`InjectionError`] if no run or more than one matches, or if the run cannot be entered.
    pub fn on(name: Option<&str>) -> Result<Self, InjectionError> {
        let process = process_list::process_of(name)?;
        let run = process.run.clone();
        enter(&process).map_err(|source| InjectionError::Place {
            run: run.clone(),
            source,
        })?;
        let backplane = Backplane::open(&run)?;
        Ok(Self { run, backplane })
    }

    /// Makes an injection in the process that started the run, which need not enter it.
    pub(crate) const fn of(run: RunName, backplane: Backplane) -> Self {
        Self { run, backplane }
    }

    /// Returns the backplane of the run.
    #[must_use]
    pub const fn backplane(&self) -> Backplane {
        self.backplane
    }

    /// Sends a signal to a process of the run; returns `false` if the process does not exist.
    pub fn signal(&self, to: Target, signal: Signal) -> bool {
        let pid = match to {
            Target::Supply(system) => self.backplane.supply_pid(system),
            Target::Core(system, core) => self.backplane.core_pid(system, core),
            Target::Vehicle => self.backplane.vehicle_pid(),
        };
        let pid = i32::try_from(pid).ok().and_then(Pid::from_raw);
        pid.is_some_and(|pid| kill_process(pid, signal).is_ok())
    }

    /// Makes this system's level line read low at the other system, even while this system is on.
    pub fn hold_level_low(&self, system: SystemId, held: bool) {
        self.backplane.hold_low(system, held);
        Ringers::new(&self.run).ring(system.peer(), CoreId::CONTROL);
    }

    /// Asks the launcher to switch a system on; does not wait. No effect if the system is on.
    pub fn request_power(&self, system: SystemId) {
        self.backplane.request_power(system);
        poke_launcher(self.backplane);
    }

    /// Makes the supply reset the system, as after a software request of core 0.
    pub fn reset(&self, system: SystemId) {
        self.backplane.note(system, Deed::Reset);
        self.backplane.request_reset(system, ResetRequest::Software);
        poke(self.backplane, system);
    }

    /// Cuts or restores this wire at each of these systems.
    pub fn set_cut(&self, wire: Wire, from: &[SystemId], is_cut: bool) {
        for system in from {
            self.backplane.set_cut(wire, *system, is_cut);
            if wire == Wire::Level {
                // A change of the level must interrupt the other system.
                Ringers::new(&self.run).ring(system.peer(), CoreId::CONTROL);
            }
        }
    }

    /// Cuts the power of a system: kills its supply, and thus its cores.
    ///
    /// # Errors
    /// [`InjectionError::IsOff`], [`InjectionError::Kill`].
    pub fn power_off(&self, system: SystemId) -> Result<(), InjectionError> {
        let pid = self.supply(system).ok_or(InjectionError::IsOff(system))?;
        self.backplane.note(system, Deed::PowerOff);
        kill_process(pid, Signal::KILL).map_err(|errno| InjectionError::Kill(errno.into()))
    }

    /// Switches on a system that was killed or switched off. Waits until its supply runs.
    ///
    /// # Errors
    /// [`InjectionError::IsOn`], [`InjectionError::NoLauncher`].
    pub fn power_on(&self, system: SystemId) -> Result<(), InjectionError> {
        if self.supply(system).is_some() {
            return Err(InjectionError::IsOn(system));
        }
        self.backplane.note(system, Deed::PowerOn);
        self.backplane.request_power(system);
        poke_launcher(self.backplane);
        let begin = Instant::now();
        while self.supply(system).is_none() {
            if begin.elapsed() > SWITCHED_ON_WITHIN {
                self.backplane.take_power_request(system);
                return Err(InjectionError::NoLauncher(system));
            }
            std::thread::sleep(LOOK_AGAIN);
        }
        Ok(())
    }

    /// Stops core 0 of a system for 100 ms, longer than its watchdog waits. Blocks for that time.
    /// Returns `false` if the core has no process.
    pub fn hang(&self, system: SystemId) -> bool {
        let is_it = |kind| matches!(kind, ProcessKind::Core(CoreId::CONTROL, _));
        let Some(core) = self.process(system, is_it) else {
            return false;
        };
        let is_stopped = kill_process(core, Signal::STOP).is_ok();
        if is_stopped {
            self.backplane.note(system, Deed::Hang);
            std::thread::sleep(HANG);
            // Fails if the watchdog has reset the core.
            let _ = kill_process(core, Signal::CONT);
        }
        is_stopped
    }

    /// Returns the process of a system's supply, if it is alive.
    fn supply(&self, system: SystemId) -> Option<Pid> {
        self.process(system, |kind| kind == ProcessKind::Supply)
    }

    /// Returns this process of a system, if it is alive: its number here, which is another one
    /// than in the run if that has processes of its own.
    fn process(&self, system: SystemId, is_it: fn(ProcessKind) -> bool) -> Option<Pid> {
        let all = process_list::of_run(&self.run).into_iter();
        let mut found = all.filter(|it| it.system == Some(system) && is_it(it.kind));
        i32::try_from(found.next()?.pid)
            .ok()
            .and_then(Pid::from_raw)
    }

    /// Overwrites the whole LMU of a system, as a faulty core might. `seed` determines the words.
    ///
    /// # Errors
    /// [`InjectionError::Lmu`].
    pub fn scribble(&self, system: SystemId, seed: u32) -> Result<(), InjectionError> {
        let lmu = memory::open_lmu(&self.run, system)?;
        self.backplane.note(system, Deed::Scribble);
        scribble(lmu, seed);
        Ok(())
    }

    /// Injects or repairs a hardware fault of a system.
    pub fn set_fault(&self, of: SystemId, fault: HardwareFault, present: bool) {
        self.backplane.set_fault(of, fault, present);
        poke(self.backplane, of);
    }

    /// Delivers to the other system an edge that this system did not send.
    pub fn stray_edge(&self, from: SystemId, line: Line, edge: Edge) {
        self.backplane.note(from, Deed::StrayEdge);
        let arrives = self.backplane.send_edge(from, line, edge);
        if line.interrupts() && arrives {
            Ringers::new(&self.run).ring(from.peer(), CoreId::CONTROL);
        }
    }
}

/// Enters the namespaces of a process that differ from those of the calling process.
fn enter(process: &Process) -> io::Result<()> {
    let of = |pid: &str, name: &str| PathBuf::from(format!("/proc/{pid}/ns/{name}"));
    let pid = process.pid.to_string();
    for (name, kind) in [
        ("user", LinkNameSpaceType::User),
        ("mnt", LinkNameSpaceType::Mount),
    ] {
        let (own, theirs) = (of("self", name), of(&pid, name));
        if fs::read_link(own)? == fs::read_link(&theirs)? {
            continue;
        }
        let place = File::open(theirs)?;
        move_into_link_name_space(rustix::fd::AsFd::as_fd(&place), Some(kind))
            .map_err(|errno: Errno| io::Error::from(errno))?;
    }
    Ok(())
}
