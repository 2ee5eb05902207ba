//! A run of a campaign with the controller as firmware in two emulated machines. Time is the
//! emulator's, and faults happen between two steps of the machines.

use std::collections::VecDeque;
use std::sync::atomic::Ordering;

use anyhow::Context as _;
use rustix::process::{Signal, set_parent_process_death_signal};
use signal_hook::consts::{SIGINT, SIGTERM};
use tandem_board::{
    CanFrame, CanId, Carried, CoreId, Duration, Instant, ResetCause, RoleLamp, SystemId, Traced,
    VehicleBus, VehiclePort,
};
use tandem_board_host::{BusFault, Wire};
use tandem_board_qemu::{EmulatedWorld, Layout, MachineError, Options};
use tandem_bus::Control;
use tandem_sim::faults::{Act, BusFaults, Sequence};
use tandem_vehicle::Scenario;

use super::Source;
use super::judge;
use super::leg::{self, HEALED_WITHIN, Injected, Line, SUSPENDED_FOR, driver, settled, tell};
use crate::emulated;
use tandem::collected::read;
use tandem::files::RunFiles;
use tandem::recorder::Recorder;
use tandem::run::{Recorded, surroundings};
use tandem::run_config::{LimitProfile, RunConfig};
use tandem::{output, vehicle};

/// A system that is switched off and on is without power for this long.
const OFF: Duration = Duration::from_ms(50);
/// The recording goes on for this long after the last fault.
const AFTERWARDS: Duration = Duration::from_ms(300);
/// The period of control frames.
const CYCLE: Duration = Duration::from_ms(10);
/// An edge or a datagram needs at most this much longer from one machine to the other, ms: it is
/// carried once in a step.
const BETWEEN_MACHINES_MS: f64 = 2.0;

/// Injects the faults of these numbers in one run.
///
/// # Errors
/// If the run does not start or leaves no recording.
pub(super) fn run(source: &Source<'_>, numbers: &[u64]) -> anyhow::Result<()> {
    // The campaign may be killed: its run then ends as by Ctrl-C.
    set_parent_process_death_signal(Some(Signal::TERM))?;
    let folder = tempfile::tempdir().context("a folder")?;
    let board = ["--board", "qemu", "--no-bootloader"];
    let args = leg::arguments(numbers, &folder.path().join("report"), &board)?;
    let config = RunConfig::of(&args, LimitProfile::Rt);
    let files = RunFiles::within(folder.path());
    let options = Options {
        reintegrate: true,
        ..Options::default()
    };
    let image = emulated::image("controller", None)?;
    let world = EmulatedWorld::start(&image, Layout::Two, options)?;
    for signal in [SIGINT, SIGTERM] {
        signal_hook::flag::register(signal, world.stop_flag()).context("watching for Ctrl-C")?;
    }
    let sequences = numbers.iter().map(|number| {
        let (sequence, phase) = source.sequence(*number)?;
        Ok((*number, sequence, phase))
    });
    let mut disturbed = Disturbed::new(world, sequences.collect::<anyhow::Result<_>>()?);
    let recorder = Recorder::create(&files)?;
    let scenario = Scenario::load(&config.scenario)?;
    vehicle::drive(&config, &scenario, &mut disturbed, recorder)?;
    let log = read(&files.recording(), &folder.path().join(output::CANDUMP))?;
    let mut around = surroundings(&config, "emulated machines".to_owned());
    for bound_ms in around.beside.bounds.all_mut() {
        *bound_ms += BETWEEN_MACHINES_MS;
    }
    let recorded = Recorded {
        log,
        around,
        done: disturbed.done,
    };
    let (outcomes, wrong) = judge::judge(source, &recorded)?;
    tell(&Line::Ended(outcomes, wrong))
}

enum Doing {
    /// Since then one system has been master and the other its standby.
    Settle { since: Instant },
    /// The faults come and go.
    Suffer {
        begin: Instant,
        acts: VecDeque<(Duration, Act)>,
        until: Instant,
    },
    /// Everything works again, and the systems find together, at the latest then.
    Heal { until: Instant },
    /// The consequences of the last fault are recorded up to then.
    End { at: Instant },
}

/// The machines, and what is done to them.
struct Disturbed {
    world: EmulatedWorld,
    left: VecDeque<(u64, Sequence, Option<Duration>)>,
    doing: Doing,
    /// The fault that is under way; `None` before the first one.
    injected: Option<Injected>,
    done: Vec<Injected>,
    /// The system that is A in the faults: the one that drives.
    driver: SystemId,
    bus: BusFaults,
    /// Since when a system has been suspended.
    suspended: [Option<Instant>; 2],
    /// When a system gets power again.
    power_on: [Option<Instant>; 2],
    /// When each system sent its last control frame.
    control: [Instant; 2],
}

impl Disturbed {
    fn new(world: EmulatedWorld, left: VecDeque<(u64, Sequence, Option<Duration>)>) -> Self {
        Self {
            world,
            left,
            doing: Doing::Heal {
                until: Instant::ORIGIN + HEALED_WITHIN,
            },
            injected: None,
            done: Vec::new(),
            driver: SystemId::A,
            bus: BusFaults::default(),
            suspended: [None; 2],
            power_on: [None; 2],
            control: [Instant::ORIGIN; 2],
        }
    }

    /// What is due before the machines go on.
    fn act_until_next(&mut self) {
        let now = self.world.reported();
        let roles = SystemId::ALL.map(|system| self.world.role(system));
        match &mut self.doing {
            Doing::Settle { since } => {
                let since = *since;
                match driver(roles) {
                    Some(driver) => self.begin(now, since, driver),
                    None => self.heal(now),
                }
            }
            Doing::Suffer { begin, acts, until } => {
                let (begin, until) = (*begin, *until);
                let next = now + Duration::from_ms(1);
                let due = acts.iter().take_while(|(at, _)| begin + *at < next).count();
                let due: Vec<(Duration, Act)> = acts.drain(..due).collect();
                for (at, act) in due {
                    let us = (begin + at).since(now).as_us() as u32;
                    self.act(act, us.min(999));
                }
                if now >= until {
                    self.mend();
                    self.heal(now);
                }
            }
            Doing::Heal { until } => {
                let is_late = now >= *until;
                self.bring_back(now, roles);
                let is_healed = driver(roles).is_some();
                if !is_healed && !is_late {
                    return;
                }
                if let Some(mut injected) = self.injected.take() {
                    injected.roles = roles;
                    injected.healed_ns = is_healed.then_some(now.as_ns());
                    if !is_healed {
                        eprintln!("the firmware says: {}", self.world.log());
                    }
                    self.done.push(injected);
                    if tell(&Line::Done(self.done.len() as u64)).is_err() {
                        self.world.stop_flag().store(true, Ordering::Relaxed);
                    }
                }
                self.doing = match is_healed && !self.left.is_empty() {
                    true => Doing::Settle { since: now },
                    false => Doing::End {
                        at: now + AFTERWARDS,
                    },
                };
            }
            Doing::End { at } => {
                if now >= *at {
                    self.world.stop_flag().store(true, Ordering::Relaxed);
                }
            }
        }
    }

    /// Begins with the next sequence, if the systems have been together for long enough.
    fn begin(&mut self, now: Instant, since: Instant, driver: SystemId) {
        let next = self.left.front();
        let Some((number, sequence, phase)) =
            next.filter(|(number, ..)| now >= since + settled(*number))
        else {
            return;
        };
        let mut begin = now;
        if let Some(phase) = phase {
            begin = self.control[driver.index()] + *phase;
            while begin < now {
                begin += CYCLE;
            }
        }
        let mut acts: Vec<(Duration, Act)> = sequence
            .faults
            .iter()
            .flat_map(|fault| fault.acts(sequence.span))
            .collect();
        acts.sort_by_key(|(at, _)| *at);
        self.driver = driver;
        self.injected = Some(Injected {
            number: *number,
            driver,
            at_ns: begin.as_ns(),
            healed_ns: None,
            power_cycles: 0,
            roles: [RoleLamp::Starting; 2],
        });
        self.doing = Doing::Suffer {
            begin,
            acts: acts.into(),
            until: begin + sequence.span,
        };
        self.left.pop_front();
    }

    fn heal(&mut self, now: Instant) {
        self.doing = Doing::Heal {
            until: now + HEALED_WITHIN,
        };
    }

    /// Switches a system off and on that has suspended itself.
    fn bring_back(&mut self, now: Instant, roles: [RoleLamp; 2]) {
        for system in SystemId::ALL {
            let index = system.index();
            if self.power_on[index].is_some_and(|at| now >= at) {
                self.power_on[index] = None;
                self.world.set_feed(system, true);
            }
            if roles[index] != RoleLamp::Suspended {
                self.suspended[index] = None;
                continue;
            }
            let since = *self.suspended[index].get_or_insert(now);
            if now >= since + SUSPENDED_FOR {
                self.suspended[index] = None;
                self.power_on[index] = Some(now + OFF);
                self.world.set_feed(system, false);
                if let Some(injected) = &mut self.injected {
                    injected.power_cycles += 1;
                }
            }
        }
    }

    /// Ends whatever is under way. A system without power is switched on.
    fn mend(&mut self) {
        self.bus = BusFaults::default();
        for system in SystemId::ALL {
            for wire in Wire::ALL {
                self.world.set_cut(wire, system, false);
            }
            self.world.hold_level_low(system, false);
            self.world.disturb_bus(system, BusFault::default());
            self.world.set_feed(system, true);
        }
    }

    /// Does something, in a machine `us` after its next step.
    fn act(&mut self, act: Act, us: u32) {
        // What a fault calls A is the system that drives.
        let driver = self.driver;
        let real = move |of: SystemId| match driver {
            SystemId::A => of,
            SystemId::B => of.peer(),
        };
        let in_machine = match act {
            Act::Power(of, _) | Act::Reset(of, _) | Act::Kill(of, _) | Act::Scribble(of) => {
                Some(of)
            }
            Act::FreezeCore(of, CoreId::CONTROL, true) => Some(of),
            _ => None,
        };
        if let Some(of) = in_machine.map(real) {
            self.world.later(of, us);
        }
        match act {
            Act::Cut(wire, of, cut) => self.world.set_cut(wire, real(of), cut),
            Act::LevelLow(of, held) => self.world.hold_level_low(real(of), held),
            Act::Edge(to, line, edge) => self.world.stray_edge(real(to), line, edge),
            Act::LostOut(..) | Act::LostIn(..) | Act::Late(..) => {
                if let Some((of, fault)) = self.bus.follow(act) {
                    self.world.disturb_bus(real(of), fault);
                }
            }
            Act::Power(of, on) => self.world.set_feed(real(of), on),
            Act::Reset(of, ResetCause::Watchdog) | Act::FreezeCore(of, _, true) => {
                self.world.hang(real(of));
            }
            Act::Reset(of, _) | Act::Kill(of, _) => self.world.crash(real(of)),
            Act::Scribble(of) => self.world.scribble(real(of), 1),
            // Its watchdog has reset it.
            Act::FreezeCore(_, _, false) => {}
            Act::Freeze(..)
            | Act::Rest(..)
            | Act::Clock(..)
            | Act::ClockJumps(..)
            | Act::WrongResults(..)
            | Act::FlashHangs(..)
            | Act::FlashLost(_)
            | Act::FreezeSupply(..)
            | Act::FreezeVehicle(_)
            | Act::FreezeLauncher(_)
            | Act::Poison(_)
            | Act::VehicleSilent(_) => unreachable!("Kind::is_for_machines refused it"),
        }
    }
}

impl VehicleBus for Disturbed {
    fn now(&self) -> Instant {
        self.world.now()
    }

    fn transmitted(&mut self, seen: &mut dyn FnMut(SystemId, CoreId, Carried)) {
        let control = &mut self.control;
        self.world.transmitted(&mut |system, core, carried| {
            if carried.frame.id() == CanId::Standard(Control::IDS[system.index()]) {
                control[system.index()] = carried.at;
            }
            seen(system, core, carried);
        });
    }

    fn broadcast(&mut self, frame: &CanFrame) -> Instant {
        self.world.broadcast(frame)
    }
}

impl VehiclePort for Disturbed {
    type Error = MachineError;

    fn tick(&mut self) -> Result<Instant, MachineError> {
        let now = self.world.tick()?;
        self.act_until_next();
        Ok(now)
    }

    fn set_ignition(&mut self, on: bool) {
        self.world.set_ignition(on);
    }

    fn stop_requested(&self) -> bool {
        self.world.stop_requested()
    }

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
