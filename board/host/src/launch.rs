//! Starts a run and ends it without leaving processes or files behind.
//!
//! Driving and failover do not need the launcher: after the start it only waits. If it is killed,
//! the vehicle drives on for a second and then ends the run; all other processes end with it.

use std::ffi::OsString;
use std::io;
use std::path::PathBuf;
use std::process::{Child, Command, ExitStatus};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal, WaitOptions, set_child_subreaper, wait};
use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM};
use tandem_board::SystemId;
use tandem_board_udp::UdpPlace;

use crate::args::{Common, ProcessArgs, Schedule, SupplyArgs, VehicleArgs};
use crate::backplane::Backplane;
use crate::clock;
use crate::flash_file::{Claimed, FlashFileError, HostFlash};
use crate::injection::Injection;
use crate::isolation::{self, Isolation, IsolationError};
use crate::memory::{self, MemoryError};
use crate::name::RunName;
use crate::process_list::{self, Process};
use crate::spawn::{self, Watched};
use crate::supply::{self, Pokes};

/// How long the vehicle may take to end after a request, for example to write its report.
const STOP_GRACE: Duration = Duration::from_secs(30);
/// How long the supplies may take to power down.
const POWER_DOWN_GRACE: Duration = Duration::from_secs(2);
/// How long killed processes may take to disappear.
const KILL_GRACE: Duration = Duration::from_secs(5);
/// How long a killed supply may take to end.
const POWER_OFF_WITHIN: Duration = Duration::from_millis(50);
const LOOK_AGAIN: Duration = Duration::from_millis(5);
/// Poll interval during the run. Signals, pokes and the vehicle's end wake the launcher earlier.
const LOOK_AGAIN_IN_RUN: tandem_board::Duration = tandem_board::Duration::from_ms(1_000);

/// Why a run did not start.
#[derive(Debug, thiserror::Error)]
pub enum LaunchError {
    /// No place is available for the run's files.
    #[error(transparent)]
    Isolation(#[from] IsolationError),
    /// The run's shared memory could not be created, or there is not enough room.
    #[error(transparent)]
    Memory(#[from] MemoryError),
    /// The data flash of a system could not be used.
    #[error(transparent)]
    Flash(#[from] FlashFileError),
    /// A process could not be started.
    #[error("cannot start the {what}: {source}")]
    Spawn {
        /// The process.
        what: String,
        /// The error of the operating system.
        source: io::Error,
    },
    /// The signal handlers could not be installed.
    #[error("cannot listen to signals: {0}")]
    Signals(io::Error),
}

/// The configuration of a run.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LaunchPlan {
    /// The scheduling of the processes.
    pub schedule: Schedule,
    /// The files of the data flashes of A and B; created if missing.
    pub flash: [PathBuf; 2],
    /// The network of both systems; `None`: they are not connected to one.
    pub network: Option<UdpPlace>,
    /// Arguments that the program passes on to all of its processes.
    pub extra: Vec<OsString>,
}

/// How the vehicle ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Ended {
    /// The vehicle's exit status; `None` if it is unknown.
    pub vehicle: Option<ExitStatus>,
    /// Whether a person ended the run early (Ctrl-C, SIGTERM, a closed terminal).
    pub interrupted: bool,
}

/// Processes and files that a run has left behind; empty if the run ended cleanly.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Leftovers {
    /// Processes that could not be killed.
    pub processes: Vec<Process>,
    /// Files in `/dev/shm` and `/tmp`.
    pub files: Vec<String>,
}

impl Leftovers {
    /// Returns the number of processes and files.
    #[must_use]
    pub fn count(&self) -> usize {
        self.processes.len() + self.files.len()
    }
}

/// A run, as seen by the process that started it. Dropping this ends the run.
#[derive(Debug)]
pub struct Launcher {
    isolation: Isolation,
    backplane: Backplane,
    /// Supply A, supply B, vehicle.
    children: Vec<Child>,
    /// Locked until all processes of the run have ended.
    flash: Vec<Claimed>,
    /// Whether a signal that requests the end has arrived and has not been handled yet.
    signalled: Arc<AtomicBool>,
    pokes: Pokes,
    is_over: bool,
}

impl Launcher {
    /// Prepares a run: its place, its backplane, and the handling of Ctrl-C.
    ///
    /// Call it before the process starts threads (see [`isolation::enter`]).
    ///
    /// # Errors
    /// [`LaunchError`] if shared memory or signals are not available.
    pub fn prepare() -> Result<Self, LaunchError> {
        Self::prepare_in(isolation::enter()?)
    }

    /// Prepares a run in this place.
    ///
    /// # Errors
    /// [`LaunchError`] if shared memory or signals are not available.
    pub fn prepare_in(isolation: Isolation) -> Result<Self, LaunchError> {
        // If there is not enough room, remove what was created.
        let backplane = memory::create(isolation.run()).inspect_err(|_| isolation.wipe())?;
        backplane.set_launcher(std::process::id());
        // Cores whose supply was killed become children of this process, which waits for them.
        let _ = set_child_subreaper(Pid::from_raw(1));
        let signalled = Arc::new(AtomicBool::new(false));
        let signals = [SIGINT, SIGTERM, SIGHUP];
        for signal in signals {
            signal_hook::flag::register(signal, Arc::clone(&signalled))
                .map_err(LaunchError::Signals)?;
        }
        // Registered after the flags, so that a signal has set its flag before it ends a sleep.
        let pokes = Pokes::receive(&signals).map_err(LaunchError::Signals)?;
        Ok(Self {
            isolation,
            backplane,
            children: vec![],
            flash: vec![],
            signalled,
            pokes,
            is_over: false,
        })
    }

    /// Returns the place of the run's files. Its `Display` says whether `/dev/shm` is private.
    #[must_use]
    pub const fn isolation(&self) -> &Isolation {
        &self.isolation
    }

    /// Returns the backplane of the run.
    #[must_use]
    pub const fn backplane(&self) -> Backplane {
        self.backplane
    }

    /// Returns access for fault injection into this run from this process.
    #[must_use]
    pub fn injection(&self) -> Injection {
        Injection::of(self.isolation.run().clone(), self.backplane)
    }

    /// Makes the system power on this long after the ignition. Call it before the start.
    pub fn stagger(&self, system: SystemId, by: tandem_board::Duration) {
        self.backplane.set_stagger(system, by);
    }

    /// Starts both supplies and the vehicle. `command` makes the command that starts this program
    /// with these arguments; it may set standard streams and environment variables.
    ///
    /// # Errors
    /// [`LaunchError::Flash`], also if a data flash belongs to another run; [`LaunchError::Spawn`].
    /// Processes that were started are killed when the launcher is dropped.
    pub fn start(
        &mut self,
        plan: &LaunchPlan,
        command: &dyn Fn(&ProcessArgs) -> Command,
    ) -> Result<(), LaunchError> {
        for path in &plan.flash {
            self.flash.push(HostFlash::claim(path)?);
        }
        let common = common(self.isolation.run(), plan);
        for system in SystemId::ALL {
            let args = supply_args(self.isolation.run(), plan, system);
            self.spawn(
                &format!("supply of system {system}"),
                ProcessArgs::Supply(args),
                command,
            )?;
        }
        self.spawn(
            "vehicle",
            ProcessArgs::Vehicle(VehicleArgs { common }),
            command,
        )?;
        let pids: Vec<u32> = self.children.iter().map(Child::id).collect();
        self.backplane.assemble([pids[0], pids[1]], pids[2]);
        Ok(())
    }

    fn spawn(
        &mut self,
        what: &str,
        args: ProcessArgs,
        command: &dyn Fn(&ProcessArgs) -> Command,
    ) -> Result<(), LaunchError> {
        let child =
            spawn::spawn_free(&mut command(&args)).map_err(|source| LaunchError::Spawn {
                what: what.to_owned(),
                source,
            })?;
        self.children.push(child);
        Ok(())
    }

    /// Waits until the vehicle has ended. The first Ctrl-C asks it to end, the second kills it.
    pub fn wait(&mut self) -> Ended {
        self.wait_with(&mut |_| {})
    }

    /// Like [`Launcher::wait`], but starts a killed supply again on request. `command` is as in
    /// [`Launcher::start`]. A supply that does not start leaves its system without power.
    pub fn wait_and_switch(
        &mut self,
        plan: &LaunchPlan,
        command: &dyn Fn(&ProcessArgs) -> Command,
    ) -> Ended {
        self.wait_with(&mut |launcher| {
            for system in SystemId::ALL {
                if launcher.backplane.take_power_request(system) {
                    launcher.switch_on(system, plan, command);
                }
            }
        })
    }

    fn switch_on(
        &mut self,
        system: SystemId,
        plan: &LaunchPlan,
        command: &dyn Fn(&ProcessArgs) -> Command,
    ) {
        let Some(supply) = self.children.get_mut(system.index()) else {
            return;
        };
        // A killed supply ends within milliseconds. A supply that does not end was not killed.
        let patience = Instant::now() + POWER_OFF_WITHIN;
        while matches!(supply.try_wait(), Ok(None)) {
            if Instant::now() > patience {
                return;
            }
            std::thread::sleep(Duration::from_millis(1));
        }
        let args = ProcessArgs::Supply(supply_args(self.isolation.run(), plan, system));
        if let Ok(child) = spawn::spawn_free(&mut command(&args)) {
            self.backplane.set_supply(system, child.id());
            *supply = child;
            // The other supply must watch the new one from now on.
            supply::poke(self.backplane, system.peer());
        }
    }

    fn wait_with(&mut self, look: &mut dyn FnMut(&mut Self)) -> Ended {
        let mut asked: Option<Instant> = None;
        loop {
            look(self);
            let Some(vehicle) = self.children.get_mut(2) else {
                return Ended {
                    vehicle: None,
                    interrupted: false,
                };
            };
            match vehicle.try_wait() {
                Ok(None) => {}
                ended => {
                    let vehicle = ended.ok().flatten();
                    return Ended {
                        vehicle,
                        interrupted: asked.is_some(),
                    };
                }
            }
            let signalled = self.signalled.swap(false, Ordering::Relaxed);
            let patience_is_over = asked.is_some_and(|since| since.elapsed() > STOP_GRACE);
            if patience_is_over || (signalled && asked.is_some()) {
                // Fails if the vehicle has just ended.
                let _ = vehicle.kill();
            } else if signalled {
                self.backplane.request_stop();
                asked = Some(Instant::now());
            }
            self.sleep();
        }
    }

    /// Sleeps until the vehicle ends or a signal arrives.
    fn sleep(&mut self) {
        let vehicle = self
            .children
            .get(2)
            .and_then(|child| Watched::new(child.id()));
        let fds = vehicle.iter().map(Watched::fd).chain([self.pokes.fd()]);
        // A failure needs no handling: the loop checks everything anyway.
        let _ = clock::wait_for(fds, LOOK_AGAIN_IN_RUN);
        self.pokes.take();
    }

    /// Ends the run: powers the systems down, kills the remaining processes, waits for all of them,
    /// removes the files, and reports what is still left.
    pub fn finish(mut self) -> Leftovers {
        self.end()
    }

    fn end(&mut self) -> Leftovers {
        self.is_over = true;
        self.backplane.request_stop();
        self.backplane.set_ignition(false);
        let all_gone = self.wait_for_children(POWER_DOWN_GRACE);
        let mut processes = process_list::of_run(self.isolation.run());
        if !all_gone || !processes.is_empty() {
            let deadline = Instant::now() + KILL_GRACE;
            // Kill repeatedly: cores die with their supply, but a supply may be about to start one.
            while !processes.is_empty() && Instant::now() < deadline {
                for process in &processes {
                    spawn::signal(process.pid, Signal::KILL);
                }
                self.wait_for_children(LOOK_AGAIN);
                reap_orphans();
                processes = process_list::of_run(self.isolation.run());
            }
        }
        reap_orphans();
        self.isolation.wipe();
        Leftovers {
            processes,
            files: self.isolation.leftovers(),
        }
    }

    /// Waits for all processes that this process started; returns whether they ended in this time.
    fn wait_for_children(&mut self, grace: Duration) -> bool {
        let deadline = Instant::now() + grace;
        loop {
            let alive = |child: &mut Child| matches!(child.try_wait(), Ok(None));
            if !self.children.iter_mut().any(alive) {
                return true;
            }
            if Instant::now() >= deadline {
                return false;
            }
            std::thread::sleep(LOOK_AGAIN);
        }
    }
}

fn common(run: &RunName, plan: &LaunchPlan) -> Common {
    Common {
        run: run.clone(),
        schedule: plan.schedule.clone(),
        network: plan.network,
        extra: plan.extra.clone(),
    }
}

fn supply_args(run: &RunName, plan: &LaunchPlan, system: SystemId) -> SupplyArgs {
    SupplyArgs {
        common: common(run, plan),
        system,
        flash: plan.flash[system.index()].clone(),
    }
}

impl Drop for Launcher {
    fn drop(&mut self) {
        if !self.is_over {
            self.end();
        }
    }
}

/// Waits for cores whose supply was killed and which have become children of this process.
fn reap_orphans() {
    while let Ok(Some(_)) = wait(WaitOptions::NOHANG) {}
}
