//! Tests the world through the controller's interface: frames and time only.

#![allow(clippy::unwrap_used)]

use tandem_bus::{Control, FrameReceiver, FrameTransmitter, Message, ModeCode, RoleCode};
use tandem_vehicle::{Ruling, Scenario, World, WorldConfig, WorldSnapshot};

const MS: u64 = 1_000_000;

/// A world, a clock, and a controller that sends constant commands.
struct Run {
    world: World,
    now_ms: u64,
    transmitter: FrameTransmitter,
    receiver: FrameReceiver,
    received: Vec<(u64, Message)>,
}

impl Run {
    fn new(scenario: &str, seed: u64) -> Self {
        Self::of(&Scenario::load(scenario).unwrap(), seed)
    }

    fn of(scenario: &Scenario, seed: u64) -> Self {
        Self {
            world: World::new(scenario, WorldConfig { seed }),
            now_ms: 5_000,
            transmitter: FrameTransmitter::new(),
            receiver: FrameReceiver::new(),
            received: Vec::new(),
        }
    }

    /// Sends a control frame and returns its ruling.
    fn send(&mut self, system: u8, term: u32, acceleration: f32, steering_angle: f32) -> Ruling {
        let (role, mode) = (RoleCode::Master, ModeCode::L3);
        let control = Control {
            role,
            mode,
            term,
            acceleration,
            steering_angle,
            ..Control::default()
        };
        let frame = self
            .transmitter
            .encode(&Message::Control { system, control });
        let now_ns = self.now_ms * MS;
        let judged = self.world.on_frame(now_ns, frame.id.into(), frame.data());
        judged.unwrap().ruling
    }

    /// Advances time. Every frame must pass the receiver's checks and must have been predicted.
    fn wait(&mut self, ms: u64) {
        for period in 0..ms {
            let (before, now_ns) = (self.received.len(), self.now_ms * MS);
            let foreseen_ns = self.world.next_frame(now_ns);
            let (receiver, received, now) = (&mut self.receiver, &mut self.received, self.now_ms);
            self.world.step(now * MS, &mut |id, data| {
                received.push((now, receiver.receive(u32::from(id), data).unwrap()));
            });
            let sends = self.received.len() > before;
            // The first frame may be late.
            assert!(
                period == 0 || sends == (foreseen_ns == now_ns),
                "at {} ms",
                self.now_ms
            );
            self.now_ms += 1;
        }
    }

    /// Sends a frame every 10 ms for this long.
    fn control(&mut self, ms: u64, acceleration: f32) {
        for _ in 0..ms / 10 {
            self.send(0, 2, acceleration, 0.0);
            self.wait(10);
        }
    }

    fn now(&self) -> &WorldSnapshot {
        self.world.snapshot()
    }
}

#[test]
fn the_world_waits_for_the_first_control_frame() {
    let mut run = Run::new("free-lane", 1);
    let start = run.now().clone();
    run.wait(500);
    assert_eq!(*run.now(), start, "nothing moves");
    let running = |run: &Run| {
        run.received
            .iter()
            .rev()
            .find_map(|(_, message)| match message {
                Message::EgoMotion(motion) => Some((motion.world_running, motion.speed)),
                _ => None,
            })
    };
    let (is_running, speed) = running(&run).unwrap();
    assert!(
        !is_running && (speed - 30.0).abs() < 0.3,
        "the sensors show the start"
    );
    run.send(0, 2, 0.0, 0.0);
    run.wait(100);
    assert!(running(&run).unwrap().0);
    assert!((run.now().time_s - 0.1).abs() < 1e-9);
    assert!((run.now().pose.position.x - start.pose.position.x - 3.0).abs() < 0.1);
}

/// T-CHIP-3, T-CHIP-4: five radars and a camera every 50 ms, the ego's motion every 10 ms, and
/// every list is as long as its header says.
#[test]
fn frames_come_in_their_cycles() {
    let mut run = Run::new("cut-in", 1);
    run.control(1_000, 0.0);
    let count = |wanted: &dyn Fn(&Message) -> bool| {
        run.received
            .iter()
            .filter(|(_, message)| wanted(message))
            .count()
    };
    assert_eq!(count(&|m| matches!(m, Message::EgoMotion(_))), 100);
    assert_eq!(count(&|m| matches!(m, Message::GateEcho(_))), 100);
    assert_eq!(count(&|m| matches!(m, Message::CameraLanes(_))), 20);
    assert_eq!(count(&|m| matches!(m, Message::DriverRequest(_))), 10);
    for sensor in tandem_bus::SensorId::ALL {
        let headers = run
            .received
            .iter()
            .filter_map(|(at, message)| match message {
                Message::SensorHeader(s, header) if *s == sensor => Some((*at, header)),
                _ => None,
            });
        let headers: Vec<_> = headers.collect();
        assert_eq!(headers.len(), 20, "{sensor:?}");
        let announced: u32 = headers.iter().map(|(_, h)| u32::from(h.object_count)).sum();
        let sent = count(&|m| matches!(m, Message::SensorObject(s, _) if *s == sensor));
        assert_eq!(sent, announced as usize, "{sensor:?}");
        assert!(
            headers
                .iter()
                .all(|(at, h)| u64::from(h.measured_at) == at * 1_000)
        );
        assert!(
            headers.windows(2).all(|w| w[1].0 - w[0].0 == 50),
            "{sensor:?}"
        );
    }
}

#[test]
fn the_same_seed_gives_the_same_frames_and_another_one_does_not() {
    let frames = |seed| {
        let mut run = Run::new("stop-and-go", seed);
        run.control(3_000, -1.0);
        run.received
    };
    assert!(frames(7) == frames(7));
    assert!(frames(7) != frames(8));
}

#[test]
fn a_late_caller_gets_all_that_was_due_and_a_frozen_one_stops_the_world() {
    let mut run = Run::new("free-lane", 1);
    run.control(100, 0.0);
    run.now_ms += 60;
    run.wait(1);
    assert!(
        (run.now().time_s - 0.161).abs() < 1e-9,
        "{}",
        run.now().time_s
    );
    run.now_ms += 5_000;
    run.wait(1);
    assert!(
        (run.now().time_s - 0.162).abs() < 1e-9,
        "{}",
        run.now().time_s
    );
    assert_eq!(run.world.stalled_ns(), 5_000 * MS);
}

/// T-CHIP-7: without a controller the vehicle holds the steering and brakes gently, and it obeys
/// the next master at once. It never obeys the former one again.
#[test]
fn without_a_controller_it_brakes_gently_until_the_next_master() {
    let mut run = Run::new("free-lane", 1);
    run.control(1_000, 0.0);
    run.wait(90);
    assert!(!run.now().fallback);
    run.wait(1_000);
    assert!(run.now().fallback);
    assert!((run.now().acceleration + 2.0).abs() < 0.01);
    assert_eq!(run.send(1, 3, 1.0, 0.0), Ruling::Accepted);
    assert_eq!(run.send(0, 2, -9.0, 0.0), Ruling::Fenced);
    run.wait(60);
    assert!(!run.now().fallback && run.now().request.acceleration == 1.0);
    assert_eq!(run.now().accepted.map(|a| (a.system, a.term)), Some((1, 3)));
    assert!(run.world.gate().mastership().gap_max_ns(run.now_ms * MS) >= 1_090 * MS);
}

#[test]
fn braking_ends_at_a_standstill_and_never_goes_backwards() {
    let mut run = Run::new("free-lane", 1);
    run.control(6_000, -8.0);
    assert_eq!(run.now().speed, 0.0);
    let place = run.now().pose;
    run.control(1_000, -8.0);
    assert_eq!(run.now().pose, place);
    run.control(2_000, 2.0);
    assert!(run.now().speed > 2.0);
    assert!(run.world.metrics().deceleration_max < 8.1);
}

#[test]
fn hitting_the_leader_counts_as_one_collision() {
    let mut run = Run::new("stop-and-go", 1);
    run.control(20_000, 0.5);
    assert_eq!(
        run.world.metrics().collisions,
        1,
        "{:?}",
        run.world.metrics()
    );
    assert!(run.world.metrics().ttc_min_s < 0.1);
}

/// Who leaves the lane onto one that is not for cars is outside, as far as beside any road.
#[test]
fn a_lane_that_is_not_for_cars_is_outside() {
    let bound = |name: &str, y: f64| {
        let point = |x: f64| format!("<point><x>{x}</x><y>{y}</y></point>");
        format!("<{name}>{}{}</{name}>", point(-300.0), point(900.0))
    };
    let lanelet = |id: u32, y: f64, rest: &str| {
        let (left, right) = (bound("leftBound", y + 1.75), bound("rightBound", y - 1.75));
        format!("<lanelet id=\"{id}\">{left}{right}{rest}</lanelet>")
    };
    for (kind, is_outside) in [("urban", false), ("sidewalk", true), ("busLane", true)] {
        let beside = format!(
            "<adjacentRight ref=\"1\" drivingDir=\"same\"/><laneletType>{kind}</laneletType>"
        );
        let xml = format!(
            "<commonRoad commonRoadVersion=\"2020a\" timeStepSize=\"0.1\" benchmarkID=\"two\">{}{}\
             <planningProblem id=\"9\"><initialState><position><point><x>0</x><y>0</y></point>\
             </position><orientation><exact>0</exact></orientation><time><exact>0</exact></time>\
             <velocity><exact>20</exact></velocity></initialState></planningProblem></commonRoad>",
            lanelet(1, 0.0, "<adjacentLeft ref=\"2\" drivingDir=\"same\"/>"),
            lanelet(2, 3.5, &beside),
        );
        let scenario = Scenario::parse(&xml, "two").unwrap();
        let mut run = Run::of(&scenario, 1);
        // 3 m/s² to the left, until the body is in the other lane but not beyond it.
        while run.now().pose.position.y < 2.9 {
            run.send(0, 2, 0.0, 0.02);
            run.wait(10);
            assert!(run.now().time_s < 5.0, "it steers");
        }
        let excursion = run.world.metrics().excursion_max_m;
        assert_eq!(excursion > 1.5, is_outside, "{kind}: {excursion}");
        assert_eq!(excursion == 0.0, !is_outside, "{kind}: {excursion}");
    }
}
