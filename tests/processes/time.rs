//! Tests of the vehicle's time in a run: `tandem run --grandmaster` and `tandem time`.

use std::process::{Child, Stdio};

use serde_json::Value;
use tandem_observers::{ChainedClock, News, VehicleClocks};
use tandem_timesync::TimeStatus;

use crate::fixture::{Fixture, Run, kill};
use crate::observers::{child_of, observer};
use crate::place::own_place;

const GRANDMASTER: u8 = 1;
const OTHER_SYSTEM: u8 = 2;

/// Waits until `is_it` is true of the newest published time.
fn until_time(run: &Run, what: &str, is_it: impl Fn(&VehicleClocks) -> bool) {
    let mut observer = observer(run);
    run.until(what, |_| {
        let mut found = false;
        observer.poll(&mut |news| {
            if let News::Time(time) = news {
                found = is_it(&time);
            }
        });
        found.then_some(())
    });
}

fn is_held(clock: &ChainedClock) -> bool {
    clock.status & TimeStatus::HOLDOVER.bits() != 0
}

/// Returns whether one system follows the grandmaster, and the other one that system.
fn is_followed(time: &VehicleClocks) -> bool {
    let [a, b, _] = &time.clocks;
    let mut sources = [a.source, b.source];
    sources.sort_unstable();
    sources == [GRANDMASTER, OTHER_SYSTEM]
        && [a, b].iter().all(|it| it.heard_ns > 0 && !is_held(it))
        && time.sensors == [1; 6]
}

/// A process that is killed when the test ends.
struct Beside(Child);

impl Drop for Beside {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// S-1, S-2: both systems follow the grandmaster of a run, and the sensors the systems. When it is
/// killed, the clock that followed it tells holdover. A new one is followed without a leap.
/// `tandem time` and the figures of the run show it.
#[test]
fn a_grandmaster_is_followed_and_its_death_is_told() {
    let (fixture, own) = (Fixture::new(), own_place());
    let domain = own.place.domain().to_string();
    let words = ["--scenario", "free-lane", "--duration", "110"];
    let mut run = fixture.run(&[&["--grandmaster", "--domain", &domain], &words[..]].concat());
    run.until_dual();
    until_time(&run, "a time that all follow", is_followed);
    let name = observer(&run).run().to_string();
    let seen = fixture.folder().join("seen.json");
    let shown = [
        "time",
        &name,
        "--duration",
        "2s",
        "--json",
        seen.to_str().unwrap(),
    ];
    let output = fixture.output(&shown);
    let text = String::from_utf8(output.stdout).unwrap();
    assert!(
        output.status.success(),
        "{:?}",
        String::from_utf8(output.stderr)
    );
    for part in [
        "the grandmaster, synchronised",
        "the other system",
        "A - B",
        "sensors 6/6",
    ] {
        assert!(text.contains(part), "{part}: {text}");
    }
    kill(child_of(&run, "grandmaster").unwrap());
    until_time(&run, "holdover", |time| time.clocks.iter().any(is_held));
    run.until("what the run says", |_| {
        run.said()
            .contains("the grandmaster's process ended (signal: 9")
            .then_some(())
    });
    let mut again = fixture.command(&["grandmaster", "--domain", &domain]);
    let _again = Beside(again.stdout(Stdio::null()).spawn().unwrap());
    until_time(&run, "the time of the new grandmaster", is_followed);
    let metrics = run.interrupt();
    let time = &metrics["time"];
    let clocks = time["clocks"].as_object().unwrap();
    let held = |clock: &Value| clock["holdover_s"].as_f64().unwrap() > 0.0;
    assert!(clocks.values().any(held), "{time:#}");
    let leapt = |clock: &Value| clock["leaps"] != 0;
    assert!(!clocks.values().any(leapt), "{time:#}");
    assert!(
        time["grandmaster_died"]
            .as_str()
            .unwrap()
            .contains("signal: 9"),
        "{time:#}"
    );
    let seen: Value = serde_json::from_slice(&std::fs::read(seen).unwrap()).unwrap();
    assert_eq!(seen["run"], name.as_str());
    run.until_vanished();
    run.left_nothing();
}

/// Each command on a run or a folder that is not there says so, with the same exit status: 2.
#[test]
fn what_is_not_there_is_told_with_one_exit_status() {
    let fixture = Fixture::new();
    let run = ["--run", "tandem-0-none"];
    let with = |words: &[&'static str]| [words, &run].concat();
    for words in [
        vec!["time", "tandem-0-none"],
        with(&["cut", "can"]),
        with(&["mend", "can"]),
        with(&["power", "off", "A"]),
        with(&["fault", "hang", "A"]),
        vec!["dflash", "show", "--folder", "tandem-0-none"],
        vec!["run", "--dflash", "tandem-0-none"],
    ] {
        crate::fixture::refuses(&fixture, &words, &["tandem-0-none"]);
    }
}

/// Other boards have no grandmaster's process.
#[test]
fn a_grandmaster_of_emulated_systems_is_refused() {
    let words = ["run", "--board", "qemu", "--grandmaster"];
    crate::fixture::refuses(&Fixture::new(), &words, &["--grandmaster", "--board"]);
}
