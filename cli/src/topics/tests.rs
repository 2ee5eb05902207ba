//! `tandem topics` over UDP, with a stand-in for the controller.

#[path = "../../../topics/host/tests/stand_in/mod.rs"]
mod stand_in;

use super::*;
use std::io::ErrorKind;
use std::thread::JoinHandle;

use clap::Parser as _;
use serde_json::Value;
use stand_in::place::OwnPlace;
use stand_in::{StandIn, own_place};
use tandem_board_udp::UdpPlace;
use tandem_bus::ParkingBrakeCode;
use tandem_topics::endpoints::{INPUTS, OUTPUTS};
use tandem_topics::{Durability, Qos, Reliability};

use crate::args::{Cli, Command};

/// A test that waits longer fails, and shows what it got.
const PATIENCE: Duration = Duration::from_secs(100);

/// A controller that publishes until it is dropped.
struct Controller {
    end: Arc<AtomicBool>,
    /// Set 50 cycles after the parking brake has been applied.
    parked: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Controller {
    fn start(place: UdpPlace) -> Self {
        let (end, parked) = (Arc::<AtomicBool>::default(), Arc::<AtomicBool>::default());
        let (ends, parks) = (Arc::clone(&end), Arc::clone(&parked));
        let thread = std::thread::spawn(move || {
            let mut stand_in = StandIn::open(place);
            let mut applied = 0;
            while !ends.load(Ordering::Relaxed) {
                stand_in.cycle();
                applied += u32::from(stand_in.vehicle.brake == ParkingBrakeCode::Applied);
                parks.store(applied >= 50, Ordering::Relaxed);
            }
        });
        Self {
            end,
            parked,
            thread: Some(thread),
        }
    }
}

impl Drop for Controller {
    fn drop(&mut self) {
        self.end.store(true, Ordering::Relaxed);
        let _panicked = self.thread.take().map(JoinHandle::join);
    }
}

/// Runs `tandem topics` with these words. Returns what it prints, and how it ends.
fn topics(own: &OwnPlace, words: &str, stop: &AtomicBool) -> (String, Result<(), Failure>) {
    let line = format!("tandem topics --domain {} {words}", own.place.domain());
    let Command::Topics(args) = Cli::parse_from(line.split_whitespace()).command else {
        panic!("{line}");
    };
    let mut out = Out::new(Vec::new());
    let result = run_to(&args, stop, &mut out);
    (String::from_utf8(out.to).unwrap(), result)
}

/// Runs it again and again, until what it prints is right: a machine may stall.
fn printed(own: &OwnPlace, words: &str, is_right: impl Fn(&str) -> bool) -> String {
    let begin = Instant::now();
    loop {
        let text = match topics(own, words, &AtomicBool::new(false)) {
            (_, Err(Failure::NothingHeard(text))) => text,
            (text, result) => {
                result.unwrap();
                text
            }
        };
        if is_right(&text) {
            return text;
        }
        assert!(begin.elapsed() < PATIENCE, "{words}: {text}");
    }
}

fn contains(text: &str, parts: &[&str]) -> bool {
    parts.iter().all(|part| text.contains(part))
}

/// D-2, D-3: both systems, all topics, and which endpoints do not fit.
#[test]
fn list_shows_endpoints_and_what_does_not_fit() {
    let own = own_place();
    let _controller = Controller::start(own.place);
    let mut weak = OUTPUTS;
    weak[0].qos = Qos {
        reliability: Reliability::BestEffort,
        durability: Durability::Volatile,
        depth: 1,
    };
    let weak = Box::leak(Box::new(weak));
    let other: Node<1, 1> = Node::open(own.place, weak, &OUTPUTS).unwrap();
    let (end, ended) = std::sync::mpsc::channel::<()>();
    let thread = std::thread::spawn(move || {
        let mut other = other;
        while ended.try_recv() == Err(std::sync::mpsc::TryRecvError::Empty) {
            other.turn(TURN).unwrap();
        }
    });
    let name = format!("tandem-{}", std::process::id());
    let misfit = format!("INCOMPATIBLE with {name}: asks for reliable, is offered best effort");
    let mut parts = vec![misfit];
    for endpoint in OUTPUTS.iter().chain(&INPUTS) {
        parts.push(format!("{}  {}\n", endpoint.topic, endpoint.type_name));
    }
    for system in ["A", "B"] {
        parts.push(format!(
            "  writer  {system:18}  reliable, transient-local, keeps 3\n"
        ));
    }
    let parts: Vec<&str> = parts.iter().map(String::as_str).collect();
    let text = printed(&own, "--for 1s", |text| contains(text, &parts));
    assert_eq!(text.matches("INCOMPATIBLE").count(), 1, "{text}");
    let json = printed(&own, "list --json --for 1s", |text| {
        text.matches("reader").count() == 9
    });
    drop(end);
    thread.join().unwrap();
    let rows: Vec<Value> = serde_json::from_str(&json).unwrap();
    let readers = rows.iter().filter(|row| row["role"] == "reader");
    let misfits = readers.filter(|row| row["incompatible"] != serde_json::json!([]));
    assert_eq!(misfits.map(|row| &row["from"]).collect::<Vec<_>>(), [&name]);
}

/// D-2: each frame once, with the values of the DBC.
#[test]
fn echo_decodes_each_frame_once() {
    let own = own_place();
    let _controller = Controller::start(own.place);
    let is_right = |text: &str| text.contains("EgoMotion");
    let text = printed(&own, "echo EgoMotion --for 1s", is_right);
    let line = text.lines().next().unwrap();
    let parts = ["110 EgoMotion", "  Gear=Drive", "  Speed=0 m/s"];
    assert!(contains(line, &parts), "{line}");

    let is_right = |text: &str| text.lines().count() > 1;
    let text = printed(&own, "echo controla --for 1s --json", is_right);
    let rows = text
        .lines()
        .map(|line| serde_json::from_str::<Value>(line).unwrap());
    let rows: Vec<Value> = rows.collect();
    assert!(
        rows.iter()
            .all(|row| row["id"] == "0A0" && row["name"] == "ControlA")
    );
    let sent = rows
        .iter()
        .map(|row| row["values"]["SentAt"].as_u64().unwrap());
    let sent: Vec<u64> = sent.collect();
    assert!(sent.is_sorted_by(|one, next| one < next), "{sent:?}");

    let is_right = |text: &str| contains(text, &["ControlA", "EgoMotion", "DriverRequest"]);
    printed(&own, "echo vehicle/can --for 1s", is_right);
}

/// D-2: rate, age and loss have a row for each id.
#[test]
fn tables_have_a_row_for_each_id() {
    let own = own_place();
    let _controller = Controller::start(own.place);
    for (table, head) in [("rate", "RATE/s"), ("age", "AGE ms"), ("loss", "LOST %")] {
        let parts = [
            head,
            "\n0A0       ControlA ",
            "\n110       EgoM",
            "\n120       DriverR",
        ];
        printed(&own, &format!("{table} --for 1s"), |text| {
            contains(text, &parts)
        });
    }
    let is_right = |text: &str| text.contains("EgoMotion");
    let json = printed(&own, "loss --json --for 1s", is_right);
    let rows: Vec<Value> = serde_json::from_str(&json).unwrap();
    let motion = rows.iter().find(|row| row["id"] == "110").unwrap();
    assert_eq!(motion["period_ms"], 10);
    assert!(motion["frames"].as_u64() > Some(0) && motion["age_ms"].as_f64() > Some(0.0));
}

/// A command that hears nothing says what to do.
#[test]
fn silence_is_told() {
    let own = own_place();
    for words in [
        "--for 100ms",
        "rate --for 100ms",
        "echo EgoMotion --for 100ms",
    ] {
        let (_, result) = topics(&own, words, &AtomicBool::new(false));
        let Err(Failure::NothingHeard(text)) = result else {
            panic!("{words}");
        };
        assert!(
            contains(&text, &["tandem run --soc", "--interface"]),
            "{text}"
        );
    }
    let _controller = Controller::start(own.place);
    let is_right = |text: &str| contains(text, &["no participant", "writes soc/power"]);
    printed(&own, "echo soc/power --for 1s", is_right);
    let is_right = |text: &str| contains(text, &["samples of vehicle/can", "none of StatusA"]);
    printed(&own, "echo StatusA --for 1s", is_right);
}

/// D-3: the SoC's side of parking, to the end.
#[test]
fn soc_parks() {
    let own = own_place();
    let controller = Controller::start(own.place);
    let (text, result) = topics(&own, "soc --park 0.5m", &controller.parked);
    result.unwrap();
    let phases = ["waiting until", "approaching", "standing", "parked"];
    let found = phases.map(|phase| text.find(phase));
    assert!(
        found.iter().all(Option::is_some) && found.is_sorted(),
        "{text}"
    );
}

/// A wrong name, profile or file is told before anything is opened.
#[test]
fn wrong_input_is_told() {
    let own = own_place();
    let file = concat!(
        env!("CARGO_MANIFEST_DIR"),
        "/../topics/host/profiles/soc.xml"
    );
    for (words, part) in [
        ("echo Speed".to_owned(), "EgoMotion"),
        ("rate --profile none.xml#A::B".to_owned(), "none.xml"),
        (format!("rate --profile {file}#A::B"), "Tandem::SocNewest"),
        (
            format!("soc --park 1 --profile {file}#A::B"),
            "Tandem::SocNewest",
        ),
    ] {
        let (_, result) = topics(&own, &words, &AtomicBool::new(false));
        let Err(Failure::Usage(error)) = result else {
            panic!("{words}");
        };
        assert!(format!("{error:#}").contains(part), "{error:#}");
    }
}

/// A reader of the output that has gone ends it, without an error.
#[test]
fn a_closed_pipe_ends_the_output() {
    struct Closed;
    impl Write for Closed {
        fn write(&mut self, _: &[u8]) -> io::Result<usize> {
            Err(ErrorKind::BrokenPipe.into())
        }

        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }
    let mut out = Out::new(Closed);
    out.print("line").unwrap();
    assert!(out.is_closed);
}
