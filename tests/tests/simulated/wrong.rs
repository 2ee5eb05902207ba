//! Tests of a system that is alive but wrong: it sends valid frames in time, with wrong commands.

use std::collections::VecDeque;
use tandem_board::{Board, CanFrame, CoreId, Duration, Instant, SystemId};
use tandem_board_sim::{Config as BoardConfig, Poller, SimBoard};
use tandem_bus::{Message, ModeCode};
use tandem_cores::Config;
use tandem_cores::trace::Event;
use tandem_sim::drive::{Drive, poller};
use tandem_tests::bent::{OnHear, OnSend, altered, bent_core, straight};
use tandem_vehicle::Scenario;

pub(crate) const MS: fn(u64) -> Duration = Duration::from_ms;
/// The fault begins at this time on A's clock.
pub(crate) const FAULT: Instant = Instant::from_ns(12_000_000_000);

/// Starts a drive in which one core of A sends or receives altered frames.
fn drive(core: CoreId, bend: impl Fn() -> (OnSend, OnHear) + 'static) -> Drive {
    drive_of((SystemId::A, core), bend)
}

pub(crate) fn drive_of(
    bent: (SystemId, CoreId),
    bend: impl Fn() -> (OnSend, OnHear) + 'static,
) -> Drive {
    let mut drive = Drive::with("free-lane", 5, move |board: &SimBoard| -> Poller {
        let of = board.identity();
        if (of.system, of.core) == bent {
            let (on_send, on_hear) = bend();
            bent_core(board, Config::rt(), on_send, on_hear)
        } else {
            poller(board, Config::rt())
        }
    });
    drive.run_for(MS(FAULT.as_ns() / 1_000_000));
    drive
}

/// Drives for `span`, and returns the largest offset from the lane during it, m.
pub(crate) fn aside(drive: &mut Drive, span: Duration) -> f64 {
    let until = drive.pair.now() + span;
    let mut most = 0.0_f64;
    while drive.pair.now() < until {
        drive.run_for(MS(10));
        most = most.max(drive.seen.borrow().world.snapshot().lateral_offset.abs());
    }
    most
}

fn steers(frame: CanFrame, angle: impl Fn(f32) -> f32) -> CanFrame {
    altered(frame, |message| {
        if let Message::Control { control, .. } = message {
            control.steering_angle = angle(control.steering_angle);
        }
    })
}

/// Returns the first event of this kind after the fault: its delay, ms, and its system.
pub(crate) fn first(drive: &Drive, kind: impl Fn(&Event) -> bool) -> Option<(u64, SystemId)> {
    let mut events = drive.events.iter();
    events.find_map(|(at, system, _, event)| {
        (*at >= FAULT && kind(event)).then(|| ((at.as_ns() - FAULT.as_ns()) / 1_000_000, *system))
    })
}

/// Maps the time since the fault, s, and a steering angle, rad, to the altered angle.
type Steering = fn(f32, f32) -> f32;

/// Starts a drive in which `angle` alters the steering angles in A's control frames.
fn drive_steering(angle: Steering) -> (Drive, f64) {
    let mut drive = drive(CoreId::CONTROL, move || bend_steering(angle));
    let aside = aside(&mut drive, MS(3_000));
    crate::print_story(&drive);
    println!("{aside:.2} m aside after 3 s");
    (drive, aside)
}

fn bend_steering(angle: Steering) -> (OnSend, OnHear) {
    let bent = move |now: Instant, frame| {
        let since = now.since(FAULT).as_secs_f32();
        let frame = if now < FAULT {
            frame
        } else {
            steers(frame, |own| angle(since, own))
        };
        vec![frame]
    };
    (Box::new(bent), Box::new(straight))
}

/// Starts a drive in which the steering angle in A's frames is stuck.
pub(crate) fn stuck() -> Drive {
    drive_steering(|_, _| 0.01).0
}

/// T-RED-9: the steering angle in A's frames is stuck or drifts, with valid protection. A reads
/// back its own frames, accepted or rejected, and leaves. B continues from the accepted ones.
#[test]
fn a_steering_angle_that_is_wrong_on_the_wire_costs_centimetres() {
    let faults: [(&str, Steering); 4] = [
        ("stuck", |_, _| 0.01),
        ("drifts", |since, own| own + 0.02 * since),
        ("reversed", |_, own| -own - 0.001),
        ("aside", |_, own| own + 0.004),
    ];
    for (name, fault) in faults {
        let (drive, aside) = drive_steering(fault);
        let reported = first(&drive, |event| *event == Event::WrongCommand { witness: 0 });
        println!(
            "{name}: found after {reported:?}, gap {:?}",
            drive.gap_max()
        );
        assert!(
            reported.is_some_and(|(ms, of)| ms < 100 && of == SystemId::A),
            "{reported:?}"
        );
        assert_eq!(drive.masters(), [SystemId::A, SystemId::B]);
        assert!(drive.gap_max() < MS(60), "{:?}", drive.gap_max());
        assert!(aside < 0.4, "{name}: {aside} m");
        assert_eq!(stage(&drive), 0, "B drives on without a doubt");
    }
}

/// Returns the stage of agreement that a system reported last.
fn stage(drive: &Drive) -> u8 {
    let mut stages = drive.events.iter().filter_map(|(.., event)| match event {
        Event::Agreement { stage, .. } => Some(*stage),
        _ => None,
    });
    stages.next_back().unwrap_or(0)
}

/// T-RED-9: core 0 of A receives a wrong speed with valid protection, and uses it for control.
/// Core 2 of A finds that the step contradicts the system's other data. A leaves, and B drives on.
#[test]
fn a_wrong_input_of_the_control_core_is_found_by_another_core() {
    let mut drive = drive(CoreId::CONTROL, || {
        let hears = |now, frame| {
            altered(frame, |message| {
                if let (Message::EgoMotion(motion), true) = (message, now >= FAULT) {
                    motion.speed *= 0.7;
                }
            })
        };
        (Box::new(|_, frame| vec![frame]), Box::new(hears))
    });
    let aside = aside(&mut drive, MS(3_000));
    crate::print_story(&drive);
    let found = first(&drive, |event| *event == Event::WrongCommand { witness: 1 });
    println!("{aside:.2} m aside, found after {found:?}");
    assert!(
        found.is_some_and(|(ms, of)| ms <= 160 && of == SystemId::A),
        "{found:?}"
    );
    assert_eq!(drive.masters(), [SystemId::A, SystemId::B]);
    assert!(drive.gap_max() < MS(30), "{:?}", drive.gap_max());
}

/// T-RED-9: core 1 of one system sees the lane at a wrong place. Core 0 of that system finds it
/// before the systems disagree. The system leaves, and the other one drives in the lane.
#[test]
fn a_lane_that_one_system_sees_aside_does_not_steer() {
    for (wrong, beside_m) in [
        (SystemId::A, 1.0),
        (SystemId::A, -1.7),
        (SystemId::B, 1.0),
        (SystemId::B, -1.7),
    ] {
        let origin = BoardConfig::default().clocks[wrong.index()].offset_ns;
        let fault = Instant::from_ns(FAULT.as_ns() + origin);
        let hears = move |now, frame| {
            altered(frame, |message| {
                if let (Message::CameraLanes(lanes), true) = (message, now >= fault) {
                    lanes.c0 += beside_m;
                }
            })
        };
        let bend =
            move || -> (OnSend, OnHear) { (Box::new(|_, frame| vec![frame]), Box::new(hears)) };
        let mut drive = drive_of((wrong, CoreId::PERCEPTION), bend);
        let aside = aside(&mut drive, MS(20_000));
        let what = format!("{wrong} sees its lane {beside_m} m aside");
        let found = first(&drive, |event| matches!(event, Event::WrongScene { .. }));
        println!("{what}: {aside:.2} m aside; found {found:?}");
        assert!(
            found.is_some_and(|(ms, by)| ms < 300 && by == wrong),
            "{what}"
        );
        assert!(aside < 0.2, "{what}: {aside} m");
        assert_eq!(stage(&drive), 0, "{what}: the systems never disagree");
        let seen = drive.seen.borrow();
        let control = seen.log.control.last().expect("control frames");
        assert_ne!(control.mode, ModeCode::SafeStop, "{what}");
        drop(seen);
        let masters = drive.masters();
        let driver = masters.last().copied();
        assert_eq!(driver, Some(wrong.peer()), "{what}: {masters:?}");
        assert!(drive.gap_max() < MS(20), "{what}: {:?}", drive.gap_max());
    }
}

/// T-RED-9: A's frames wait in a growing queue. Each frame is valid, in order, and fresh by its
/// own data. B detects the delay and takes over before the vehicle has to reject the frames.
#[test]
fn frames_that_wait_in_a_growing_queue_do_not_drive() {
    let mut drive = drive(CoreId::CONTROL, || {
        let mut queue: VecDeque<(Instant, CanFrame)> = VecDeque::new();
        let waits = move |now: Instant, frame| {
            // The delay grows by 100 ms each second.
            let delay = MS(now.since(FAULT).as_ns() / 10_000_000);
            queue.push_back((now + delay, frame));
            let due = queue.iter().take_while(|(due, _)| *due <= now).count();
            queue.drain(..due).map(|(_, frame)| frame).collect()
        };
        (Box::new(waits), Box::new(straight))
    });
    let aside = aside(&mut drive, MS(8_000));
    crate::print_story(&drive);
    let counts = drive.seen.borrow().world.gate().counts();
    println!("{aside:.2} m aside, {counts:?}");
    assert_eq!(drive.masters(), [SystemId::A, SystemId::B]);
    assert!(drive.gap_max() < MS(100), "{:?}", drive.gap_max());
    assert!(aside < 0.3, "{aside} m");
}

/// T-RED-9: two healthy systems agree in all traffic and in all phases of their cycles.
/// `TANDEM_SCENARIOS` names the folder of the recorded scenarios.
#[test]
fn two_healthy_systems_agree_in_every_scenario() {
    let mut names: Vec<String> = Scenario::names().map(str::to_owned).collect();
    if let Some(folder) = std::env::var_os("TANDEM_SCENARIOS") {
        let files = std::fs::read_dir(folder).expect("the folder of the scenarios");
        names.extend(files.map(|file| file.expect("a file").path().display().to_string()));
    }
    for name in names {
        for late_us in [7_100, 38_900] {
            let mut drive = Drive::new(&name, 2);
            // Switch B on later, so that its cores 1 and 2 run in other phases than A's.
            drive.pair.power_off(SystemId::B);
            drive.run_for(Duration::from_us(late_us));
            drive.pair.power_on(SystemId::B);
            drive.run_for(MS(45_000));
            let used = drive.events.iter().filter_map(|(.., event)| match event {
                Event::Agreement { percent, .. } => Some(*percent),
                _ => None,
            });
            let worst = used.max().unwrap_or(0);
            let scenes = drive.events.iter().filter_map(|(.., event)| match event {
                Event::SceneCheck { percent } | Event::TrajectoryCheck { percent, .. } => {
                    Some(*percent)
                }
                Event::WrongTrajectory { .. } => Some(100),
                Event::WrongScene { .. } | Event::WrongEcho | Event::PeerScene { .. } => Some(100),
                _ => None,
            });
            let scene = scenes.max().unwrap_or(0);
            println!("{name}, B {late_us} us late: {worst} % of the limit, scenes {scene} %");
            assert!(worst < 70, "{name}: {worst} %");
            assert!(scene < 66, "{name}: {scene} %");
            assert_eq!(drive.masters(), [SystemId::A]);
            let counts = drive.seen.borrow().world.gate().counts();
            assert_eq!((counts.stale, counts.implausible), (0, 0), "{name}");
        }
    }
}
