//! Defines what a case is, and what each process of its run does.

use std::ffi::OsString;
use std::process::{Child, ExitCode};
use std::thread;
use std::time::{Duration, Instant};

use rustix::process::Signal;
use tandem_board::{
    Board, CoreId, Generation, SupplyEvent, SystemId, Traced, VehicleBus, VehiclePort,
};
use tandem_board_host::{
    HostBoard, HostVehiclePort, ProcessArgs, RunName, clock, process_list, supply,
};
use tandem_peripherals::watchdog::Window;

use crate::launcher::{self, again, start_launcher};

const CONTROL: CoreId = CoreId::CONTROL;

/// Time limit for any step; a step that takes longer is considered hung.
pub(crate) const PATIENCE: Duration = Duration::from_secs(40);

/// First trace record of every core in the real-time cases: whether the core was granted real-time
/// priority.
pub(crate) const GRANTED: u32 = 1_000;
/// Trace record that core 0 writes directly after it has serviced the watchdog.
const SERVES: u32 = 1_001;

/// One case: the function of every core, and the script of the vehicle.
#[derive(Clone, Copy)]
pub(crate) struct Case {
    pub(crate) name: &'static str,
    pub(crate) core: fn(&HostBoard),
    pub(crate) vehicle: fn(&mut Script),
}

/// The vehicle's part of a case.
pub(crate) struct Script {
    pub(crate) port: HostVehiclePort,
    pub(crate) run: RunName,
    pub(crate) case: String,
    pub(crate) folder: OsString,
    /// Trace records that were read but not yet returned to a test.
    traced: Vec<Traced>,
    /// The resets that the supplies reported.
    resets: Vec<(tandem_board::Instant, SystemId)>,
    /// Trace records that the cores could not write.
    pub(crate) lost: u32,
}

pub(crate) fn all_cases() -> impl Iterator<Item = Case> {
    crate::cases::CASES
        .iter()
        .chain(crate::deaths::CASES)
        .chain(crate::residue::CASES)
        .copied()
        .chain(crate::conformance::cases())
}

fn case(name: &str) -> Case {
    let mut all = all_cases().chain([crate::residue::LASTING, crate::environment::GRANTED_CASE]);
    all.find(|case| case.name == name).expect("a known case")
}

/// Runs a case in separate processes. If it fails, returns their messages.
pub(crate) fn run_case(case: Case) -> Result<(), String> {
    let folder = tempfile::tempdir().map_err(|error| error.to_string())?;
    finish(start_launcher(case.name, folder.path(), "own"))
}

/// Waits until a case has ended, and returns the messages of its processes if it failed.
pub(crate) fn finish(launcher: Child) -> Result<(), String> {
    launcher::finish(launcher, PATIENCE + Duration::from_secs(10)).map(drop)
}

/// Returns whether the processes of a case claim real-time scheduling.
pub(crate) fn claims_realtime(case: &str) -> bool {
    [
        crate::deaths::REALTIME,
        crate::environment::GRANTED_REALTIME,
    ]
    .contains(&case)
}

/// Does the work of one process of a run.
pub(crate) fn play(args: ProcessArgs) -> ExitCode {
    let name = args.common().extra[0].to_str().expect("name").to_owned();
    let case = case(&name);
    match args {
        ProcessArgs::Supply(args) => {
            let ended = supply::run(&args, &|core| again(&ProcessArgs::Core(core.clone())));
            if let Err(error) = ended {
                eprintln!("supply {}: {error}", args.system);
                return ExitCode::FAILURE;
            }
        }
        ProcessArgs::Core(args) if crate::conformance::play(&name, &args) => {}
        ProcessArgs::Core(args) => match HostBoard::attach(&args) {
            Ok(board) => {
                let grant = args.claim();
                if claims_realtime(case.name) {
                    board.trace([GRANTED, u32::from(grant.is_realtime()), 0, 0]);
                }
                if args.identity.core == CoreId::CONTROL {
                    board.release_core(CoreId::PERCEPTION);
                    board.release_core(CoreId::PLANNING);
                }
                (case.core)(&board);
            }
            Err(error) => {
                eprintln!("core: {error}");
                return ExitCode::FAILURE;
            }
        },
        ProcessArgs::Vehicle(args) => {
            launcher::watch(PATIENCE);
            let _ = args.claim();
            match HostVehiclePort::attach(&args) {
                Ok(port) => {
                    let mut script = Script {
                        port,
                        run: args.common.run.clone(),
                        case: name,
                        folder: args.common.extra[1].clone(),
                        traced: vec![],
                        resets: vec![],
                        lost: 0,
                    };
                    script.port.set_ignition(true);
                    (case.vehicle)(&mut script);
                    script.port.set_ignition(false);
                }
                Err(error) => {
                    eprintln!("vehicle: {error}");
                    return ExitCode::FAILURE;
                }
            }
        }
    }
    ExitCode::SUCCESS
}

impl Script {
    /// Runs the bus until `is_true` returns true.
    pub(crate) fn until(&mut self, what: &str, mut is_true: impl FnMut(&mut Self) -> bool) {
        let deadline = Instant::now() + PATIENCE / 2;
        while !is_true(self) {
            assert!(
                Instant::now() < deadline,
                "never: {what}; {:?}",
                process_list::of_run(&self.run)
            );
            self.port.transmitted(&mut |_, _, _| {});
            thread::sleep(Duration::from_micros(200));
        }
    }

    /// Runs the bus for this many milliseconds.
    pub(crate) fn rest(&mut self, ms: u64) {
        let end = clock::now() + tandem_board::Duration::from_ms(ms);
        self.until("time passes", |_| clock::now() >= end);
    }

    /// Waits for the next record `[code, ..]` in the trace of the core, and removes it.
    pub(crate) fn await_trace(&mut self, system: SystemId, core: CoreId, code: u32) -> [u32; 4] {
        let is_it = |t: &Traced| t.system == system && t.core == core && t.record[0] == code;
        self.until(&format!("{system}{core} says {code}"), |script| {
            script.drain();
            script.traced.iter().any(is_it)
        });
        let at = self.traced.iter().position(is_it).expect("just found");
        self.traced.remove(at).record
    }

    /// Removes and returns the records `[code, ..]` of the core that have already been read.
    pub(crate) fn take_traced(
        &mut self,
        system: SystemId,
        core: CoreId,
        code: u32,
    ) -> Vec<[u32; 4]> {
        let is_it = |t: &mut Traced| t.system == system && t.core == core && t.record[0] == code;
        self.traced
            .extract_if(.., is_it)
            .map(|t| t.record)
            .collect()
    }

    pub(crate) fn pid(&self, system: SystemId, core: CoreId) -> u32 {
        self.port.backplane().core_pid(system, core)
    }

    /// Signals a core as soon as its supply has registered it.
    pub(crate) fn signal(&mut self, system: SystemId, core: CoreId, what: Signal) {
        self.until("the core has a process", |script| {
            script.pid(system, core) != 0
        });
        signal(self.pid(system, core), what);
    }

    /// Returns whether the system was never reset, except when its core 0 had no CPU until the
    /// watchdog's window closed.
    pub(crate) fn was_never_blamed(&mut self, system: SystemId) -> bool {
        self.drain();
        let serves = |t: &&Traced| (t.system, t.core, t.record[0]) == (system, CONTROL, SERVES);
        let closes = tandem_board::Duration::from_us(Window::DESKTOP.closes_us.into());
        let was_held_up = |reset: tandem_board::Instant| {
            let before = self.traced.iter().filter(serves).map(|t| t.at);
            let last = before.filter(|at| *at < reset).max();
            last.is_some_and(|last| reset.since(last) >= closes)
        };
        let resets = self.resets.iter().filter(|(_, of)| *of == system);
        let excused: Vec<bool> = resets.map(|(at, _)| was_held_up(*at)).collect();
        let incarnations = self.generation(system, CONTROL).0 as usize;
        excused.len() + 1 == incarnations && !excused.contains(&false)
    }

    /// Reads the traces of the cores and the supplies.
    fn drain(&mut self) {
        self.lost += self
            .port
            .drain_trace(&mut |traced| self.traced.push(traced));
        self.port.drain_supplies(&mut |at, of, event| {
            if matches!(event, SupplyEvent::Reset(_)) {
                self.resets.push((at, of));
            }
        });
    }

    pub(crate) fn generation(&self, system: SystemId, core: CoreId) -> Generation {
        self.port.backplane().generation(system, core)
    }

    /// Waits until all cores of a system have started for the `incarnation`th time.
    pub(crate) fn await_incarnation(&mut self, system: SystemId, incarnation: u32) {
        self.until(
            &format!("incarnation {incarnation} of {system}"),
            |script| {
                CoreId::ALL.iter().all(|core| {
                    script.generation(system, *core) == Generation(incarnation)
                        && script.pid(system, *core) != 0
                })
            },
        );
    }
}

pub(crate) fn signal(pid: u32, signal: Signal) {
    let pid = rustix::process::Pid::from_raw(pid as i32).expect("a process");
    rustix::process::kill_process(pid, signal).expect("the process is there");
}

/// Waits for an interrupt, and fails if none arrives.
pub(crate) fn await_interrupt(board: &HostBoard) {
    let deadline = board.now() + tandem_board::Duration::from_ms(15_000);
    assert_eq!(
        board.wait(deadline),
        tandem_board::Wake::Interrupt,
        "an interrupt was lost"
    );
}

/// Sleeps until the process is killed.
pub(crate) fn idle(board: &HostBoard) {
    loop {
        board.wait(tandem_board::Instant::NEVER);
    }
}

/// Services the watchdog correctly until the process is killed.
pub(crate) fn serve(board: &HostBoard) {
    loop {
        service(board);
        clock::sleep_until(board.now() + tandem_board::Duration::from_ms(10));
    }
}

/// Services the watchdog once, correctly.
pub(crate) fn service(board: &HostBoard) {
    use tandem_board::Supply;
    let question = board.supply().watchdog_question();
    board
        .supply()
        .service_watchdog(tandem_board::watchdog_answer(question));
    // Write the record after the service, so that its time is never before the service.
    board.trace([SERVES, 0, 0, 0]);
}

/// Core 0 services the watchdog; the other cores sleep.
pub(crate) fn live(board: &HostBoard) {
    if board.identity().core == CoreId::CONTROL {
        serve(board)
    } else {
        idle(board)
    }
}
