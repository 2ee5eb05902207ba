//! One drive of a campaign with the controller as firmware in two emulated machines. Time is the
//! emulator's, and faults happen between two steps of the machines.

use std::collections::VecDeque;
use std::sync::atomic::Ordering;

use anyhow::Context as _;
use rustix::process::{Signal, set_parent_process_death_signal};
use signal_hook::consts::{SIGINT, SIGTERM};
use tandem_board::{
    CanFrame, CanId, Carried, CoreId, Duration, HardwareFault, Instant, RoleLamp, SystemId, Traced,
    VehicleBus, VehiclePort,
};
use tandem_board_host::{BusFault, Wire};
use tandem_board_qemu::{EmulatedWorld, MachineError, MachineOptions, WorldLayout};
use tandem_bus::Control;
use tandem_faults::{BusFaults, CannotSuffer, Effect, Kind, Sequence, Site, Suffer, effects};
use tandem_processes::files::RunFiles;
use tandem_processes::recorder::Recorder;
use tandem_processes::run_config::LimitProfile;
use tandem_processes::vehicle;

use super::Source;
use super::pipe::{Line, report};
use super::recording_judge;
use super::round::{HEALED_WITHIN, Injected, SUSPENDED_FOR, arguments, driver, settled};
use crate::emulated;
use tandem::collected::read;
use tandem::output;
use tandem::run::{Recorded, surroundings};

/// Time without power when a system is switched off and on.
const OFF: Duration = Duration::from_ms(50);
/// Duration of the recording after the last fault.
const AFTERWARDS: Duration = Duration::from_ms(300);
/// The period of control frames.
const CYCLE: Duration = Duration::from_ms(10);
/// The largest additional delay of an edge or a datagram between the two machines, ms: it is
/// transferred once in a step.
const BETWEEN_MACHINES_MS: f64 = 2.0;

/// Injects the faults with these numbers in one run.
///
/// # Errors
/// If the run does not start or leaves no recording.
pub(super) fn run(source: &Source, numbers: &[u64]) -> anyhow::Result<()> {
    // If the campaign is killed, its run ends as after Ctrl-C.
    set_parent_process_death_signal(Some(Signal::TERM))?;
    let folder = tempfile::tempdir().context("a folder")?;
    let board = ["--board", "qemu", "--no-bootloader"];
    let args = arguments(numbers, &folder.path().join("report"), &board)?;
    let config = tandem::run::config_of(&args, LimitProfile::Rt);
    let files = RunFiles::within(folder.path());
    let options = MachineOptions {
        reintegrate: true,
        ..MachineOptions::default()
    };
    let image = emulated::image("controller", None)?;
    let world = EmulatedWorld::start(&image, WorldLayout::Two, options)?;
    for signal in [SIGINT, SIGTERM] {
        signal_hook::flag::register(signal, world.stop_flag()).context("watching for Ctrl-C")?;
    }
    let sequences = numbers.iter().map(|number| {
        let (sequence, phase) = source.sequence(*number)?;
        Ok((*number, sequence, phase))
    });
    let mut disturbed = Disturbed::new(world, sequences.collect::<anyhow::Result<_>>()?);
    let recorder = Recorder::create(&files)?;
    let scenario = config.load_scenario()?;
    vehicle::drive(&config, &scenario, &mut disturbed, recorder)?;
    if let Some(refused) = disturbed.refused {
        return Err(refused.into());
    }
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
    let (outcomes, wrong) = recording_judge::judge(source, &recorded)?;
    report(&Line::Ended(outcomes, wrong))
}

enum Doing {
    /// Waits for the next sequence. The systems have been master and standby since `since`.
    Settle { since: Instant },
    /// Faults begin and end, until the sequence is over.
    Suffer {
        begin: Instant,
        changes: VecDeque<(Duration, Effect)>,
        until: Instant,
    },
    /// All faults have ended. The systems must become master and standby before `until`.
    Heal { until: Instant },
    /// The consequences of the last fault are recorded until `at`.
    End { at: Instant },
}

/// The emulated machines with their vehicle, and the state of the campaign.
struct Disturbed {
    world: EmulatedWorld,
    left: VecDeque<(u64, Sequence, Option<Duration>)>,
    doing: Doing,
    /// The current fault; `None` before the first one.
    injected: Option<Injected>,
    done: Vec<Injected>,
    bus: BusFaults,
    /// Time from the next step of the machines to the next start or end of a fault, µs.
    after_us: u32,
    /// The reason why the drive ended early.
    refused: Option<CannotSuffer>,
    /// Time since which each system has been suspended.
    suspended: [Option<Instant>; 2],
    /// Time at which each system gets power again.
    power_on: [Option<Instant>; 2],
    /// Time at which each system sent its last control frame.
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
            bus: BusFaults::default(),
            after_us: 0,
            refused: None,
            suspended: [None; 2],
            power_on: [None; 2],
            control: [Instant::ORIGIN; 2],
        }
    }

    /// Performs the actions that are due before the next step of the machines.
    fn act_until_next(&mut self) -> Result<(), CannotSuffer> {
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
            Doing::Suffer {
                begin,
                changes,
                until,
            } => {
                let (begin, until) = (*begin, *until);
                let next = now + Duration::from_ms(1);
                let is_due = |(at, _): &&(Duration, Effect)| begin + *at < next;
                let due = changes.iter().take_while(is_due).count();
                let due: Vec<(Duration, Effect)> = changes.drain(..due).collect();
                for (at, change) in due {
                    let us = (begin + at).since(now).as_us() as u32;
                    self.after_us = us.min(999);
                    self.apply(change)?;
                }
                if now >= until {
                    self.restore();
                    self.heal(now);
                }
            }
            Doing::Heal { until } => {
                let is_late = now >= *until;
                self.bring_back(now, roles);
                let is_healed = driver(roles).is_some();
                if !is_healed && !is_late {
                    return Ok(());
                }
                if let Some(mut injected) = self.injected.take() {
                    injected.roles = roles;
                    injected.healed_ns = is_healed.then_some(now.as_ns());
                    if !is_healed {
                        eprintln!("the firmware says: {}", self.world.log());
                    }
                    self.done.push(injected);
                    if report(&Line::Done(self.done.len() as u64)).is_err() {
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
        Ok(())
    }

    /// Begins the next sequence if the systems have been master and standby for long enough.
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
        let changes = effects(&sequence.faults, sequence.span, driver);
        self.injected = Some(Injected::new(*number, driver, begin));
        self.doing = Doing::Suffer {
            begin,
            changes: changes.into(),
            until: begin + sequence.span,
        };
        self.left.pop_front();
    }

    fn heal(&mut self, now: Instant) {
        self.doing = Doing::Heal {
            until: now + HEALED_WITHIN,
        };
    }

    /// Switches a suspended system off and on.
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
}

impl Suffer for Disturbed {
    type Error = CannotSuffer;

    fn apply(&mut self, change: Effect) -> Result<(), CannotSuffer> {
        let world = &mut self.world;
        let (kind, of, on) = match change {
            Effect::Fault(kind, of, on) => (kind, of, on),
            Effect::Edge(from, line, edge) => {
                world.stray_edge(from.peer(), line, edge);
                return Ok(());
            }
        };
        if let Some(fault) = self.bus.follow(kind, of, on) {
            world.disturb_bus(of, fault);
            return Ok(());
        }
        match kind {
            Kind::Cut { wire } => {
                world.set_cut(wire, of, on);
                return Ok(());
            }
            Kind::LevelLow => {
                world.hold_level_low(of, on);
                return Ok(());
            }
            // The watchdog has already reset the system.
            Kind::CoreHangs(_) if !on => return Ok(()),
            // All other changes happen within a machine, after this delay.
            _ => world.later(of, self.after_us),
        }
        match kind {
            Kind::PowerLoss => world.set_feed(of, !on),
            Kind::ResetByWatchdog => world.hang(of),
            Kind::ResetByTrap => world.crash(of),
            Kind::CoreHangs(amount) if amount.core() == CoreId::CONTROL => world.hang(of),
            Kind::CoreDies(amount) if amount.core() == CoreId::CONTROL => world.crash(of),
            Kind::Scribble => world.scribble(of, 1),
            Kind::NetworkCut => world.set_fault(of, HardwareFault::Network, on),
            _ => {
                let site = Site::Machines;
                return Err(CannotSuffer { kind, site });
            }
        }
        Ok(())
    }

    fn restore(&mut self) {
        self.bus = BusFaults::default();
        for system in SystemId::ALL {
            for wire in Wire::ALL {
                self.world.set_cut(wire, system, false);
            }
            self.world.hold_level_low(system, false);
            self.world.set_fault(system, HardwareFault::Network, false);
            self.world.disturb_bus(system, BusFault::default());
            self.world.set_feed(system, true);
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
        if let Err(refused) = self.act_until_next() {
            self.refused = Some(refused);
            self.world.stop_flag().store(true, Ordering::Relaxed);
        }
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
