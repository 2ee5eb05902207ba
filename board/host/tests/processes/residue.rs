//! Tests that a run leaves nothing behind, whichever process is killed and whenever it is killed.

use std::path::Path;
use std::process::Child;
use std::thread;
use std::time::{Duration, Instant};

use libtest_mimic::Trial;
use rustix::process::Signal;
use tandem_board::{SystemId, VehiclePort};
use tandem_board_host::{RunName, process_list};

use crate::fixture::{self, Case, PATIENCE, Script, live, signal};
use crate::launcher::start_launcher;

pub(crate) const CASES: &[Case] = &[Case {
    name: "a_short_run_ends_by_itself",
    core: live,
    vehicle: short,
}];

fn short(script: &mut Script) {
    script.await_incarnation(SystemId::A, 1);
    script.await_incarnation(SystemId::B, 1);
}

/// Runs until a test ends it. Not a separate case: the trials below need a run to kill.
pub(crate) const LASTING: Case = Case {
    name: "lasting",
    core: live,
    vehicle: last,
};

fn last(script: &mut Script) {
    script.until("a test stops it", |script| script.port.stop_requested());
}

pub(crate) fn trials() -> Vec<Trial> {
    vec![
        Trial::test("ctrl_c_ends_all_in_order", || interrupt("own")),
        Trial::test("ctrl_c_ends_all_in_order_in_a_shared_place", || {
            interrupt("shared")
        }),
        Trial::test("killing_all_leaves_nothing", || kill_all("own")),
        Trial::test("killing_all_leaves_nothing_in_a_shared_place", || {
            kill_all("shared")
        }),
        Trial::test("without_its_launcher_a_run_goes_on_and_ends", || {
            orphan("own")
        }),
        Trial::test("killed_at_any_moment_of_the_start_it_ends", || {
            kill_while_starting("own")
        }),
        Trial::test("killed_at_the_start_in_a_shared_place", || {
            kill_while_starting("shared")
        }),
        Trial::test("two_runs_do_not_meet", two_runs),
    ]
}

pub(crate) type Outcome = Result<(), libtest_mimic::Failed>;

/// A launcher and its run, which has at least one other process.
pub(crate) struct Started {
    pub(crate) launcher: Child,
    pub(crate) run: RunName,
}

pub(crate) fn until<T>(what: &str, mut get: impl FnMut() -> Option<T>) -> Result<T, String> {
    let deadline = Instant::now() + PATIENCE / 2;
    while Instant::now() < deadline {
        if let Some(value) = get() {
            return Ok(value);
        }
        thread::sleep(Duration::from_millis(2));
    }
    Err(format!("never: {what}"))
}

/// Starts a run that lasts until it is ended; waits until `count` of its processes exist.
fn start(folder: &Path, place: &str, count: usize) -> Result<Started, String> {
    started(start_launcher(LASTING.name, folder, place), count)
}

/// Waits until `count` processes of the run exist.
pub(crate) fn started(launcher: Child, count: usize) -> Result<Started, String> {
    let prefix = format!("tandem-{}-", launcher.id());
    let found = until("the run starts", || {
        let all = process_list::list();
        let ours: Vec<_> = all
            .iter()
            .filter(|p| p.run.as_str().starts_with(&prefix))
            .collect();
        (ours.len() >= count).then(|| ours[0].run.clone())
    });
    match found {
        Ok(run) => Ok(Started { launcher, run }),
        Err(error) => {
            signal(launcher.id(), Signal::INT);
            let ended = launcher.wait_with_output().map_err(|why| why.to_string())?;
            let said = String::from_utf8_lossy(&ended.stderr);
            Err(format!("{error}; the launcher: {}: {said}", ended.status))
        }
    }
}

fn gone(run: &RunName) -> Result<(), String> {
    until("all processes are gone", || {
        process_list::of_run(run).is_empty().then_some(())
    })
    .map_err(|error| format!("{error}: {:?}", process_list::of_run(run)))
}

fn interrupt(place: &str) -> Outcome {
    let folder = tempfile::tempdir()?;
    end_in_order(start(folder.path(), place, 9)?)
}

/// Ends a run by Ctrl-C; the launcher must end with success and leave nothing behind.
pub(crate) fn end_in_order(mut started: Started) -> Outcome {
    let launchers = [started.launcher.id()];
    signal(started.launcher.id(), Signal::INT);
    until("the launcher ends", || {
        started.launcher.try_wait().ok().flatten()
    })?;
    let ended = started.launcher.wait_with_output()?;
    if !ended.status.success() {
        let said = String::from_utf8_lossy(&ended.stderr);
        return Err(format!("{}: {said}", ended.status).into());
    }
    gone(&started.run)?;
    assert_clean(&launchers)
}

/// Checks that no file name in `/dev/shm` and `/tmp` contains the name of a run of these launchers.
fn assert_clean(launchers: &[u32]) -> Outcome {
    let own = |name: &String| {
        launchers
            .iter()
            .any(|pid| name.contains(&format!("tandem-{pid}-")))
    };
    let left: Vec<String> = ["/dev/shm", "/tmp"]
        .iter()
        .flat_map(|folder| std::fs::read_dir(folder).into_iter().flatten().flatten())
        .map(|entry| entry.path().to_string_lossy().into_owned())
        .filter(own)
        .collect();
    if left.is_empty() {
        Ok(())
    } else {
        Err(format!("left behind: {left:?}").into())
    }
}

fn kill_all(place: &str) -> Outcome {
    let folder = tempfile::tempdir()?;
    let mut launchers = vec![];
    for _ in 0..3 {
        let mut started = start(folder.path(), place, 9)?;
        launchers.push(started.launcher.id());
        signal(started.launcher.id(), Signal::KILL);
        for process in process_list::of_run(&started.run) {
            signal(process.pid, Signal::KILL);
        }
        started.launcher.wait()?;
        gone(&started.run)?;
    }
    // The next run must start without help, and remove the leftovers in a shared place.
    let mut next = start(folder.path(), place, 9)?;
    launchers.push(next.launcher.id());
    signal(next.launcher.id(), Signal::INT);
    let status = until("the launcher ends", || {
        next.launcher.try_wait().ok().flatten()
    })?;
    assert!(status.success(), "{status}");
    assert_clean(&launchers)
}

fn orphan(place: &str) -> Outcome {
    let folder = tempfile::tempdir()?;
    let mut started = start(folder.path(), place, 9)?;
    let launchers = [started.launcher.id()];
    signal(started.launcher.id(), Signal::KILL);
    started.launcher.wait()?;
    thread::sleep(Duration::from_millis(300));
    let alive = process_list::of_run(&started.run);
    assert_eq!(alive.len(), 9, "{alive:?}");
    let vehicle = alive
        .iter()
        .find(|process| process.system.is_none())
        .expect("a vehicle");
    signal(vehicle.pid, Signal::KILL);
    gone(&started.run)?;
    assert_clean(&launchers)
}

fn kill_while_starting(place: &str) -> Outcome {
    let folder = tempfile::tempdir()?;
    let mut launchers = vec![];
    for round in 0..20_u64 {
        let mut launcher = start_launcher(LASTING.name, folder.path(), place);
        launchers.push(launcher.id());
        let prefix = format!("tandem-{}-", launcher.id());
        thread::sleep(Duration::from_micros(round * 1_300));
        let ours = || -> Vec<process_list::Process> {
            let all = process_list::list().into_iter();
            all.filter(|process| process.run.as_str().starts_with(&prefix))
                .collect()
        };
        if round % 2 == 0 {
            signal(launcher.id(), Signal::KILL);
        } else {
            // Kill one of the existing processes of the run.
            let there = ours();
            if let Some(victim) = there.get(round as usize % there.len().max(1)) {
                let pid = rustix::process::Pid::from_raw(victim.pid as i32).expect("a process");
                let _ = rustix::process::kill_process(pid, Signal::KILL);
            }
            thread::sleep(Duration::from_millis(20));
            signal(launcher.id(), Signal::INT);
        }
        until("the launcher ends", || launcher.try_wait().ok().flatten())?;
        // Kill the vehicle, because this ends a run that has no launcher.
        for process in ours() {
            let pid = rustix::process::Pid::from_raw(process.pid as i32).expect("a process");
            if process.system.is_none() {
                let _ = rustix::process::kill_process(pid, Signal::KILL);
            }
        }
        until("all are gone", || ours().is_empty().then_some(()))
            .map_err(|error| format!("round {round}: {error}: {:?}", ours()))?;
    }
    // After all of that, a new run must start, and remove the leftovers.
    let mut next = start(folder.path(), place, 9)?;
    launchers.push(next.launcher.id());
    signal(next.launcher.id(), Signal::INT);
    until("the launcher ends", || {
        next.launcher.try_wait().ok().flatten()
    })?;
    assert_clean(&launchers)
}

fn two_runs() -> Outcome {
    let folder = tempfile::tempdir()?;
    let mut lasting = start(folder.path(), "shared", 9)?;
    let case = fixture::all_cases().find(|case| case.name == "a_short_run_ends_by_itself");
    let second = fixture::run_case(case.expect("a known case"));
    let first = process_list::of_run(&lasting.run).len();
    signal(lasting.launcher.id(), Signal::INT);
    until("the launcher ends", || {
        lasting.launcher.try_wait().ok().flatten()
    })?;
    gone(&lasting.run)?;
    second?;
    assert_eq!(first, 9, "the first is untouched");
    Ok(())
}
