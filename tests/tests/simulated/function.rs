//! Tests of the driving function's state machine, with the whole controller and a driver. U-1

use std::cell::Cell;
use std::rc::Rc;
use tandem_board::{Board, CoreId, Duration, SystemId};
use tandem_bus::{Message, ModeCode, SensorId};
use tandem_cores::driving::function::{DEGRADED_LIMIT, END_LIMIT, TAKEOVER_LIMIT};
use tandem_cores::trace::Event;
use tandem_sim::drive::{Drive, poller};
use tandem_tests::bent::{altered, bent_core, straight};
use tandem_vehicle::{Habit, Scenario, World};

use crate::S;

/// Returns the functions that the vehicle obeyed, each with its first scenario time, s.
fn functions(drive: &Drive) -> Vec<(ModeCode, f64)> {
    let seen = drive.seen.borrow();
    let start_ns = seen.log.accepted().next().map_or(0, |frame| frame.at_ns);
    let mut functions: Vec<(ModeCode, f64)> = vec![];
    for frame in seen.log.accepted() {
        if functions.last().is_none_or(|(mode, _)| *mode != frame.mode) {
            functions.push((frame.mode, (frame.at_ns - start_ns) as f64 * 1e-9));
        }
    }
    functions
}

fn modes(drive: &Drive) -> Vec<ModeCode> {
    functions(drive).into_iter().map(|(mode, _)| mode).collect()
}

fn with(habit: Habit) -> Drive {
    let drive = Drive::new("free-lane", 1);
    drive.seen.borrow_mut().world.set_driver(habit);
    drive
}

/// U-1: one system is lost, and the driver does not answer. The vehicle stops within the stated
/// time, and the function leaves no state earlier than its table permits.
#[test]
fn degraded_mode_ends_at_standstill_when_no_driver_answers() {
    let mut drive = with(Habit::default());
    drive.run_for(S(5));
    drive.pair.power_off(SystemId::A);
    drive.run_for(DEGRADED_LIMIT + TAKEOVER_LIMIT);
    let speed = |drive: &Drive| drive.seen.borrow().world.snapshot().speed;
    assert!(speed(&drive) > 10.0, "it drives until then");
    let left =
        Duration::from_us(END_LIMIT.as_us() - DEGRADED_LIMIT.as_us() - TAKEOVER_LIMIT.as_us());
    drive.run_for(left);
    assert!(speed(&drive) < 0.1, "{}", speed(&drive));
    let expected = [ModeCode::L3, ModeCode::DegradedL2, ModeCode::SafeStop];
    assert_eq!(modes(&drive), expected, "{:?}", functions(&drive));
    assert_eq!(drive.collisions(), 0);
    assert!(drive.gap_max() < Duration::from_ms(20));
}

/// U-1: the driver answers the request, and the function hands the moving vehicle over.
#[test]
fn degraded_mode_ends_with_a_driver_who_answers() {
    let mut drive = with(Habit {
        answers_after_s: Some(4.0),
        ..Habit::default()
    });
    drive.run_for(S(5));
    drive.pair.power_off(SystemId::A);
    drive.run_for(DEGRADED_LIMIT + TAKEOVER_LIMIT + S(5));
    let expected = [ModeCode::L3, ModeCode::DegradedL2, ModeCode::None];
    assert_eq!(modes(&drive), expected, "{:?}", functions(&drive));
    let seen = drive.seen.borrow();
    let now = seen.world.snapshot();
    assert!(
        now.speed > 10.0 && now.lateral_offset.abs() < 0.5,
        "{now:?}"
    );
}

/// The driver overrides for five seconds and engages again. Until then neither system regards the
/// other as failed. The function then continues from the vehicle's motion.
#[test]
fn a_driver_overrides_and_engages_again() {
    let mut drive = with(Habit {
        overrides_s: Some((4.0, 9.0)),
        ..Habit::default()
    });
    drive.run_for(S(20));
    let functions = functions(&drive);
    assert_eq!(
        modes(&drive),
        [ModeCode::L3, ModeCode::None, ModeCode::L3],
        "{functions:?}"
    );
    // The vehicle sends the driver's frame every 100 ms.
    let late = [functions[1].1 - 4.0, functions[2].1 - 9.0];
    assert!(
        late.iter().all(|late| (0.0..0.15).contains(late)),
        "{late:?}"
    );
    assert_eq!(drive.masters(), [SystemId::A]);
    assert!(drive.gap_max() < Duration::from_ms(11));
    let seen = drive.seen.borrow();
    assert_eq!(seen.world.gate().counts().implausible, 0);
    assert!(
        seen.world.metrics().lateral_error_max_m < 0.5,
        "{:?}",
        seen.world.metrics()
    );
}

/// Returns a straight road of one lane, with a crossing 400 m ahead of the start.
fn crossing() -> String {
    let lanelet = |id: u32, from: (f64, f64), to: (f64, f64)| {
        let (dx, dy) = ((to.0 - from.0), (to.1 - from.1));
        let half = 1.75 / dx.hypot(dy);
        let bound = |name: &str, side: f64| {
            let point = |(x, y): (f64, f64)| {
                let (x, y) = (x - dy * half * side, y + dx * half * side);
                format!("<point><x>{x}</x><y>{y}</y></point>")
            };
            format!("<{name}>{}{}</{name}>", point(from), point(to))
        };
        let (left, right) = (bound("leftBound", 1.0), bound("rightBound", -1.0));
        format!("<lanelet id=\"{id}\">{left}{right}</lanelet>")
    };
    let road = lanelet(1, (0.0, 0.0), (800.0, 0.0)) + &lanelet(2, (450.0, -60.0), (450.0, 60.0));
    let state = "<position><point><x>50</x><y>0</y></point></position><orientation><exact>0</exact>\
                 </orientation><time><exact>0</exact></time><velocity><exact>20</exact></velocity>";
    format!(
        "<commonRoad commonRoadVersion=\"2020a\" benchmarkID=\"crossing\" timeStepSize=\"0.1\">{road}\
         <planningProblem id=\"9\"><initialState>{state}</initialState></planningProblem></commonRoad>"
    )
}

/// The operational design domain ends at a junction, and the driver does not answer. The function
/// requests a takeover in time, and stops the vehicle before the junction (minimal-risk stop).
#[test]
fn the_end_of_the_domain_is_asked_for_and_then_stopped_for() {
    let scenario = Scenario::parse(&crossing(), "crossing.xml").expect("a scenario");
    assert_eq!(scenario.outside_domain(), None);
    let mut drive = Drive::new("free-lane", 1);
    drive.seen.borrow_mut().world = World::new(&scenario, tandem_vehicle::WorldConfig { seed: 1 });
    drive.run_for(S(40));
    let seen = drive.seen.borrow();
    let (metrics, now) = (seen.world.metrics(), seen.world.snapshot());
    let asked = metrics.takeover_asked_s.expect("a request");
    let stopped = metrics.safe_stop_s.expect("a minimal-risk stop");
    let limit = TAKEOVER_LIMIT.as_ms_f64() * 1e-3;
    assert!((stopped - asked - limit).abs() < 0.1, "{asked} {stopped}");
    assert!(asked > 2.0, "not before the end is in sight: {asked}");
    assert!(now.speed < 0.1 && now.pose.position.x < 448.0, "{now:?}");
    assert!(metrics.outside_domain_s == 0.0 && metrics.deceleration_max < 4.0);
    let expected = [ModeCode::L3, ModeCode::SafeStop];
    assert_eq!(modes(&drive), expected, "{:?}", functions(&drive));
}

/// Starts a drive with this sensor fault. Also returns a flag: whether the last control frame
/// requests a takeover by the driver.
fn with_sensor(fault: &str) -> (Drive, Rc<Cell<bool>>) {
    let config = tandem_cores::Config::rt();
    let asks = Rc::new(Cell::new(false));
    let asked = Rc::clone(&asks);
    let drive = Drive::with("free-lane", 1, move |board| {
        let asked = Rc::clone(&asked);
        let sends = move |_, frame| {
            let sent = altered(frame, |message| {
                if let Message::Control { control, .. } = message {
                    asked.set(control.takeover_request);
                }
            });
            vec![sent]
        };
        match board.identity().core {
            CoreId::CONTROL => bent_core(board, config, Box::new(sends), Box::new(straight)),
            _ => poller(board, config),
        }
    });
    let fault = fault.parse().expect("a fault");
    drive.seen.borrow_mut().world.set_sensor_faults(vec![fault]);
    (drive, asks)
}

/// T-CHIP-4, U-1: a radar is lost, or its data is late. Within half a second the function requests
/// a takeover by the driver. It continues if the radar returns, and otherwise stops the vehicle.
#[test]
fn a_sensor_that_is_lost_or_late_is_a_takeover_request() {
    for kind in ["lost", "late"] {
        let back = with_sensor(&format!("radar-front-left:{kind}:5-10"));
        let gone = with_sensor(&format!("radar-front-left:{kind}:5-60"));
        for ((mut drive, asks), expected) in [
            (back, &[ModeCode::L3][..]),
            (gone, &[ModeCode::L3, ModeCode::SafeStop]),
        ] {
            // Scenario time begins with the first control frame.
            drive.run_for(S(6));
            assert!(asks.get(), "it asks");
            drive.run_for(S(7));
            assert_eq!(asks.get(), expected.len() > 1, "until it is back");
            drive.run_for(TAKEOVER_LIMIT);
            assert_eq!(modes(&drive), expected, "{:?}", functions(&drive));
            assert_eq!(drive.masters(), [SystemId::A]);
            let reported = drive.events.iter().filter_map(|(.., event)| match event {
                Event::Sensors { missing } => Some(*missing),
                _ => None,
            });
            let reported: Vec<_> = reported.collect();
            let bit = 1 << SensorId::RadarFrontLeft.index();
            let both = match expected.len() {
                1 => vec![bit, bit, 0, 0],
                _ => vec![bit; 2],
            };
            assert_eq!(reported, both);
        }
    }
}
