//! Tests the data that a run publishes, and that no observer disturbs the run.

use std::io::{BufRead as _, BufReader};
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use rustix::process::Signal;
use tandem_observers::{News, Observer, Roles};

use crate::fixture::{Fixture, Run, kill, send};

const EXAMPLE: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/examples/observe.py");

/// Waits until the run publishes, and returns an observer of it.
pub(crate) fn observer(run: &Run) -> Observer {
    run.until("an observer", |_| {
        Observer::on(Some(&run.launcher_pid().to_string())).ok()
    })
}

/// Waits until `is_it` returns true for the newest roles.
fn until_roles(run: &Run, what: &str, is_it: impl Fn(&Roles) -> bool) {
    let mut observer = observer(run);
    run.until(what, |_| {
        let mut found = false;
        observer.poll(&mut |news| {
            if let News::Roles(now) = news {
                found = is_it(&now);
            }
        });
        found.then_some(())
    });
}

/// Waits until the vehicle obeys any system.
pub(crate) fn until_driven(run: &Run) {
    until_roles(run, "a driver", |now| now.obeyed < 2);
}

/// Waits until the vehicle obeys this system.
pub(crate) fn until_obeyed(run: &Run, system: &str) {
    let wanted = u8::from(system == "B");
    until_roles(run, "the other driver", |now| now.obeyed == wanted);
}

/// Waits until the vehicle has driven for this scenario time.
pub(crate) fn until_driven_for(run: &Run, seconds: f64) {
    until_roles(run, "a longer drive", |now| now.time_s >= seconds);
}

/// Starts an observer of a run: this test program, in a process that can be frozen and killed.
fn observing(run: &Run) -> Child {
    Command::new(std::env::current_exe().unwrap())
        .args([
            "observers::observes_until_it_is_killed",
            "--exact",
            "--ignored",
        ])
        .env("TANDEM_OBSERVED_RUN", run.launcher_pid().to_string())
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .unwrap()
}

#[test]
#[ignore = "the process that another test starts"]
fn observes_until_it_is_killed() {
    let Ok(run) = std::env::var("TANDEM_OBSERVED_RUN") else {
        return;
    };
    let mut observer = Observer::on(Some(&run)).unwrap();
    loop {
        observer.poll(&mut |_| {});
        std::thread::sleep(Duration::from_millis(20));
    }
}

/// Freezes one observer, kills another, and stops the publisher, for a second and a half.
pub(crate) fn disturb(run: &Run) {
    let mut both = [observing(run), observing(run)];
    until_driven_for(run, 1.0);
    send(both[0].id() as i32, Signal::STOP);
    kill(both[1].id() as i32);
    send(publisher_of(run).unwrap(), Signal::STOP);
    std::thread::sleep(Duration::from_millis(1_500));
    for observer in &mut both {
        let _ = observer.kill();
        observer.wait().unwrap();
    }
}

/// Returns `Some` if one system drives, the other stands by, and all cores are alive.
fn sees_both(observer: &mut Observer) -> Option<()> {
    let mut both = false;
    observer.poll(&mut |news| {
        if let News::Roles(now) = news {
            let in_roles = matches!((now.state, now.obeyed), ([3, 2], 0) | ([2, 3], 1));
            both = in_roles && (now.alive, now.beats) == ([1; 6], [3, 3]);
        }
    });
    both.then_some(())
}

/// Observers receive roles, vehicle, frames and events while one observer is frozen, another is
/// killed, and later the publisher is stopped. The run drives as if there were no observer.
#[test]
fn observers_that_are_frozen_or_killed_do_not_disturb_the_run() {
    let fixture = Fixture::new();
    let mut run = fixture.run(&["--duration", "110", "--scenario", "free-lane"]);
    let mut own = observer(&run);
    let [mut frozen, mut killed] = [observing(&run), observing(&run)];
    run.until_dual();
    // Both observers subscribe within this time.
    until_driven_for(&run, 1.0);
    send(frozen.id() as i32, Signal::STOP);
    kill(killed.id() as i32);
    killed.wait().unwrap();
    own.poll(&mut |_| {});
    // The third observer still receives messages beside the frozen and the dead one.
    let (mut roles, mut vehicles, mut frames, mut reached_s) = (0, 0, 0, 0.0);
    while roles < 3 || vehicles < 10 || frames < 100 {
        assert!(!run.processes().is_empty(), "{roles} {vehicles} {frames}");
        own.poll(&mut |news| match news {
            News::Roles(now) => (roles, reached_s) = (roles + 1, now.time_s),
            News::Vehicle(_) => vehicles += 1,
            News::Frame(_) => frames += 1,
            News::Event(_) | News::Time(_) => {}
        });
    }
    run.until("news of both in their roles", |_| sees_both(&mut own));
    let publisher = publisher_of(&run).expect("a publisher");
    send(publisher, Signal::STOP);
    // The run publishes nothing now, so only the figures at its end show that it continued.
    std::thread::sleep(Duration::from_millis(500));
    let metrics = run.interrupt();
    assert!(
        metrics["duration_s"].as_f64().unwrap() > reached_s,
        "{metrics:#}"
    );
    run.until_vanished();
    run.left_nothing();
    frozen.kill().unwrap();
    frozen.wait().unwrap();
}

/// Returns the process that publishes the run.
fn publisher_of(run: &Run) -> Option<i32> {
    child_of(run, "publish")
}

/// Returns the process that `tandem run` has started with this command.
pub(crate) fn child_of(run: &Run, command: &str) -> Option<i32> {
    let pid = run.launcher_pid();
    // The launcher of the SoC is a thread.
    let tasks = std::fs::read_dir(format!("/proc/{pid}/task"))
        .ok()?
        .flatten();
    let children = tasks.filter_map(|it| std::fs::read_to_string(it.path().join("children")).ok());
    let children: String = children.map(|it| it + " ").collect();
    let is_it = |pid: &&str| {
        let line = std::fs::read_to_string(format!("/proc/{pid}/cmdline")).unwrap_or_default();
        line.split('\0').nth(1) == Some(command)
    };
    children.split_whitespace().find(is_it)?.parse().ok()
}

/// The example in Python reports a takeover. Skipped if its library is missing.
#[test]
fn the_example_in_python_sees_a_takeover() {
    let fixture = Fixture::new();
    let has_library = Command::new("python3")
        .args(["-c", "import iceoryx2"])
        .output();
    if !has_library.is_ok_and(|output| output.status.success()) {
        assert!(std::env::var_os("TANDEM_REQUIRE_ICEORYX2_PYTHON").is_none());
        eprintln!("skipped: the Python package iceoryx2 is not installed");
        return;
    }
    let mut run = fixture.run(&["--duration", "110", "--scenario", "free-lane"]);
    let name = observer(&run).run().to_string();
    let mut python = Command::new("python3")
        .args([EXAMPLE, &name, "100"])
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let mut lines = BufReader::new(python.stdout.take().unwrap()).lines();
    let mut reported = String::new();
    // The interpreter may need longer to subscribe than the systems need to start.
    let both_drive = |line: &String| line.contains("A master, B standby, term");
    let seen = lines.by_ref().map(Result::unwrap).find(both_drive);
    assert!(seen.is_some(), "the example ended before both drove");
    kill(run.master_supply().pid);
    let sees_takeover = |reported: &str| {
        reported.contains("B core 0: takes over: ") && reported.contains("B degraded master")
    };
    while !sees_takeover(&reported) {
        let line = lines
            .next()
            .unwrap_or_else(|| panic!("no takeover: {reported}"));
        reported += &(line.unwrap() + "\n");
    }
    python.kill().unwrap();
    python.wait().unwrap();
    run.interrupt();
}
