//! One case, and the code of each process of its run.

use crate::launcher::{again, finish, start_launcher, watch};
use crate::{calls, control_core, flood};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::{Duration as Span, Instant as Clock};
use tandem_board::{
    Board, CoreId, Duration, Instant, SystemId, Traced, VehicleBus, VehiclePort, Wake,
};
use tandem_board_host::realtime::Grant;
use tandem_board_host::{CoreArgs, HostBoard, HostVehiclePort, ProcessArgs, supply};
use tandem_cores::core1::Core1;
use tandem_cores::core2::Core2;
use tandem_cores::trace::Event;
use tandem_cores::{Config, Core};
use tandem_vehicle::{Ruling, Scenario, World};

/// A case that takes longer than this has failed.
const PATIENCE: Span = Span::from_secs(60);

/// One case.
pub(crate) struct Case {
    pub(crate) name: &'static str,
    /// Called in the process of core 0 of B before anything else.
    pub(crate) before: fn(&CoreArgs),
    /// The program of core 0 of B. Core 0 of A and the other cores run as usual.
    pub(crate) peer: fn(&CoreArgs, HostBoard, Grant),
    pub(crate) vehicle: fn(&mut Script),
}

pub(crate) fn all_cases() -> impl Iterator<Item = Case> {
    [flood::CASE].into_iter().chain(calls::CASES)
}

/// The vehicle's part of a case.
pub(crate) struct Script {
    port: HostVehiclePort,
    world: World,
    folder: PathBuf,
    /// The trace records of the cores. The records of each core are in order.
    pub(crate) traced: Vec<(Traced, Event)>,
    /// Time and system of each accepted control frame.
    pub(crate) accepted: Vec<(Instant, SystemId)>,
}

/// Runs a case in separate processes. If it fails, returns the output of these processes.
pub(crate) fn run_case(case: &Case) -> Result<(), String> {
    let folder = tempfile::tempdir().map_err(|error| error.to_string())?;
    let launcher = start_launcher(case.name, folder.path(), "own");
    print!("{}", finish(launcher, PATIENCE + Span::from_secs(10))?);
    Ok(())
}

/// Runs one process of a run.
pub(crate) fn play(args: ProcessArgs) -> ExitCode {
    let name = args.common().extra[0].clone();
    let case = all_cases().find(|case| name == case.name);
    let case = case.expect("a known case");
    match args {
        ProcessArgs::Supply(args) => {
            supply::run(&args, &|core| again(&ProcessArgs::Core(core.clone()))).expect("a supply");
        }
        ProcessArgs::Core(args) => {
            let is_peer = args.identity.system == SystemId::B;
            if is_peer && args.identity.core == CoreId::CONTROL {
                (case.before)(&args);
            }
            let grant = args.claim();
            let board = HostBoard::attach(&args).expect("a board");
            match (args.identity.system, args.identity.core) {
                (SystemId::B, CoreId::CONTROL) => (case.peer)(&args, board, grant),
                (SystemId::A, CoreId::CONTROL) => {
                    control_core::go(board, config(), grant).expect("core 0");
                }
                (_, CoreId::PERCEPTION) => compute(&board, Core1::new(&board)),
                _ => compute(&board, Core2::new(&board)),
            }
        }
        ProcessArgs::Vehicle(args) => {
            watch(PATIENCE);
            let _ = args.claim();
            let scenario = Scenario::load("free-lane").expect("an embedded scenario");
            let mut script = Script {
                port: HostVehiclePort::attach(&args).expect("a run"),
                world: World::new(&scenario, tandem_vehicle::WorldConfig { seed: 1 }),
                folder: args.common.extra[1].clone().into(),
                traced: vec![],
                accepted: vec![],
            };
            script.port.set_ignition(true);
            (case.vehicle)(&mut script);
            script.port.set_ignition(false);
        }
    }
    ExitCode::SUCCESS
}

/// Returns the desktop limits, except that a start does not wait for the other system.
pub(crate) fn config() -> Config {
    let mut config = Config::desktop();
    config.redundancy.start_limit = Duration::from_ms(500);
    config
}

fn compute(board: &HostBoard, mut core: impl Core) {
    loop {
        let deadline = core.poll();
        let _: Wake = board.wait(deadline);
    }
}

impl Script {
    /// Drives the vehicle until `is_true` returns true.
    pub(crate) fn until(&mut self, what: &str, mut is_true: impl FnMut(&Self) -> bool) {
        let deadline = Clock::now() + PATIENCE / 2;
        while !is_true(self) {
            if Clock::now() > deadline {
                let reported = self.traced.iter().filter(|(_, event)| {
                    !matches!(
                        event,
                        Event::TaskIn { .. } | Event::TaskOut { .. } | Event::Ready { .. }
                    )
                });
                panic!("never: {what}; {:?}", reported.take(40).collect::<Vec<_>>());
            }
            self.tick();
        }
    }

    /// Drives the vehicle for `span`.
    pub(crate) fn drive_for(&mut self, span: Duration) {
        let end = self.port.now() + span;
        self.until("time passes", |script| script.port.now() >= end);
    }

    /// Drives one millisecond.
    fn tick(&mut self) {
        let Self {
            port,
            world,
            accepted,
            ..
        } = self;
        let due = port.tick().expect("the clock");
        world.run_period(due, port, &mut |frame| {
            if frame.ruling == Some(Ruling::Accepted) {
                accepted.extend(frame.controller().map(|system| (frame.at, system)));
            }
        });
        let traced = &mut self.traced;
        port.drain_trace(&mut |entry| {
            traced.extend(Event::decode(entry.record).map(|event| (entry, event)));
        });
    }

    /// Returns the folder of the case.
    pub(crate) fn folder(&self) -> &Path {
        &self.folder
    }

    pub(crate) fn now(&self) -> Instant {
        self.port.now()
    }

    pub(crate) fn port(&self) -> &HostVehiclePort {
        &self.port
    }
}
