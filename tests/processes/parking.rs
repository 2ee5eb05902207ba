//! Tests of `tandem run --soc`: the SoC's process parks the vehicle over DDS.

use std::cell::Cell;
use std::fs;

use serde_json::Value;
use tandem_board_host::clock;
use tandem_cores::driving::parking::SOC_STOP_LIMIT;
use tandem_observers::News;
use tandem_topics_host::approach::SPEED;

use crate::fixture::{Fixture, Run, kill};
use crate::injection::inject;
use crate::observers::{child_of, observer, until_driven, until_driven_for, until_obeyed};
use crate::place::own_place;

/// A longer stall may cost the SoC its time-out, 200 ms, or a core 0 a frame that it must fetch.
const TOLERATED_STALL_MS: f64 = 20.0;
/// Largest number of drives: one that failed beside a longer stall is repeated.
const TRIES: u32 = 5;
/// When a fault is injected, s: the vehicle drives at its highest speed.
const FAULT_AT_S: f64 = 4.5;
/// Longer than an observer is behind the vehicle, s.
const OBSERVED_LATE_S: f64 = 0.5;

/// Drives with an SoC until the figures are as they must be. Stalls of the machine, which the run
/// records, excuse a failed drive.
fn drives(
    words: &[&str],
    act: impl Fn(&Fixture, &Run),
    unkept: impl Fn(&Value) -> Option<String>,
) -> Value {
    for tried in 1.. {
        let (fixture, own) = (Fixture::new(), own_place());
        let domain = own.place.domain().to_string();
        let mut run = fixture.run(&[&["--domain", &domain], words].concat());
        act(&fixture, &run);
        let metrics = run.metrics();
        run.until_vanished();
        run.left_nothing();
        let Some(what) = unkept(&metrics) else {
            return metrics;
        };
        let stalled_ms = metrics["stalls"]["longest_ms"].as_f64().unwrap();
        let what = format!("{what}: {metrics:#}");
        assert!(stalled_ms > TOLERATED_STALL_MS, "no stall excuses {what}");
        assert!(tried < TRIES, "the machine stalls too often: {what}");
        eprintln!("tried again, after a stall of {stalled_ms:.1} ms");
    }
    unreachable!()
}

/// Returns what is wrong with a drive that must end parked.
fn unparked(metrics: &Value) -> Option<String> {
    let soc = &metrics["soc"];
    if soc["parked"] != true {
        return Some(format!("not parked: {}", soc["not_parked"]));
    }
    (soc["lost"] != 0).then(|| "lost frames".to_owned())
}

fn rules(metrics: &Value) -> Vec<&str> {
    let findings = metrics["verdict"]["findings"].as_array().unwrap().iter();
    findings.map(|it| it["rule"].as_str().unwrap()).collect()
}

/// D-2, D-3: the SoC's process parks the vehicle, although the supply of the master dies on the
/// way. Each frame that one of the systems heard has reached the SoC. The run shows phases, way and
/// frames.
#[test]
fn a_run_with_an_soc_parks_and_a_takeover_loses_no_frame() {
    let words = ["--soc", "6", "--duration", "13"];
    let act = |_: &Fixture, run: &Run| {
        run.until_dual();
        until_driven_for(run, FAULT_AT_S);
        let master = run.master_supply();
        kill(master.pid);
        let other = if master.system.as_deref() == Some("A") {
            "B"
        } else {
            "A"
        };
        until_obeyed(run, other);
    };
    let metrics = drives(&words, act, unparked);
    let soc = &metrics["soc"];
    let driven_m = soc["driven_m"].as_f64().unwrap();
    assert!((5.5..6.5).contains(&driven_m), "{metrics:#}");
    assert_eq!(soc["phases"].as_array().unwrap().len(), 4, "{metrics:#}");
    let ids = soc["ids"].as_array().unwrap();
    let motion = ids.iter().find(|id| id["name"] == "EgoMotion").unwrap();
    for system in ["A", "B"] {
        let samples = motion["samples"][system].as_u64().unwrap();
        assert!(samples > 200, "{metrics:#}");
    }
    assert!(!rules(&metrics).contains(&"not-parked"), "{metrics:#}");
}

/// D-3: the network of both systems is cut on the way. The vehicle stands after less than it drives
/// at its highest speed within the limit.
#[test]
#[ignore = "ten seconds of the machine alone: cargo xtask campaign topics"]
fn a_cut_network_stops_the_vehicle() {
    let words = ["--soc", "30", "--duration", "12"];
    let most_m = f64::from(SPEED) * (f64::from(SOC_STOP_LIMIT.as_secs_f32()) + OBSERVED_LATE_S);
    let way_m = Cell::new(f64::INFINITY);
    let act = |fixture: &Fixture, run: &Run| {
        until_driven_for(run, FAULT_AT_S);
        let mut observer = observer(run);
        for system in ["A", "B"] {
            inject(fixture, run, &["fault", "network-cut", system]);
        }
        let cut = clock::now();
        let first_m = Cell::new(None);
        let (at_ns, end_m) = run.until("standstill", |_| {
            let mut stands = None;
            observer.poll(&mut |news| {
                if let News::Vehicle(vehicle) = news {
                    first_m.set(first_m.get().or(Some(vehicle.x)));
                    stands = (vehicle.speed < 0.01).then_some((vehicle.at_ns, vehicle.x));
                }
            });
            stands
        });
        way_m.set(end_m - first_m.get().unwrap());
        let ms = at_ns.saturating_sub(cut.as_ns()) / 1_000_000;
        eprintln!(
            "stood {ms} ms after the cut of both, {:.2} m on",
            way_m.get()
        );
    };
    let unkept = |metrics: &Value| {
        let rules = rules(metrics);
        if !(rules.contains(&"safe-stop") && rules.contains(&"not-parked")) {
            return Some(format!("told {rules:?}"));
        }
        (way_m.get() > most_m).then(|| format!("{} m", way_m.get()))
    };
    drives(&words, act, unkept);
}

/// D-3: the SoC's process dies on the way. The run says so, and the controller stops the vehicle.
#[test]
#[ignore = "ten seconds of the machine alone: cargo xtask campaign topics"]
fn a_killed_soc_is_told_and_stops_the_vehicle() {
    let words = ["--soc", "30", "--duration", "9"];
    let act = |_: &Fixture, run: &Run| {
        until_driven_for(run, FAULT_AT_S);
        kill(child_of(run, "soc").unwrap());
        run.until("what the run says", |_| {
            run.said()
                .contains("the SoC's process ended (signal: 9")
                .then_some(())
        });
    };
    let unkept = |metrics: &Value| {
        let rules = rules(metrics);
        let told = rules.contains(&"safe-stop") && rules.contains(&"not-parked");
        (!told).then(|| format!("told {rules:?}"))
    };
    let metrics = drives(&words, act, unkept);
    let why = metrics["soc"]["not_parked"].as_str().unwrap();
    assert!(why.contains("signal: 9"), "{why}");
}

/// The SoC's process ends when `tandem run` is killed, and with a Ctrl-C.
#[test]
fn the_soc_ends_with_tandem_run() {
    let (fixture, own) = (Fixture::new(), own_place());
    let domain = own.place.domain().to_string();
    let words = ["--soc", "--domain", &domain, "--duration", "60"];
    let mut run = fixture.run(&words);
    until_driven(&run);
    let soc = child_of(&run, "soc").unwrap();
    run.interrupt();
    assert!(!is_alive(soc));
    run.until_vanished();
    run.left_nothing();
    let mut run = fixture.run(&words);
    until_driven(&run);
    let soc = child_of(&run, "soc").unwrap();
    kill(run.launcher_pid());
    run.end();
    run.until("the end of the SoC", |_| (!is_alive(soc)).then_some(()));
}

/// Returns whether there is still such a process.
fn is_alive(pid: i32) -> bool {
    fs::read(format!("/proc/{pid}/cmdline")).is_ok_and(|line| !line.is_empty())
}

/// A network that this machine does not have is an error before anything starts.
#[test]
fn an_interface_of_another_machine_is_refused() {
    let fixture = Fixture::new();
    let words = ["run", "--soc", "--interface", "192.0.2.1"];
    crate::fixture::refuses(&fixture, &words, &["domain 0 on 192.0.2.1", "interface"]);
}

/// A second run in a domain would be taken for the first one, and neither would park.
#[test]
fn a_domain_of_another_run_is_refused() {
    let (fixture, own) = (Fixture::new(), own_place());
    let _other = own.place.claim().unwrap();
    let domain = own.place.domain().to_string();
    let words = ["run", "--soc", "--domain", &domain];
    crate::fixture::refuses(&fixture, &words, &["another run", "--domain"]);
}
