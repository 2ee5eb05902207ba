//! The world: the ego, the others, the sensors, on one time line.

use std::iter;
use std::sync::Arc;

use tandem_board::SystemId;
use tandem_bus::{
    self as bus, CameraLanes, FrameTransmitter, GearCode, Message, ParkingBrakeCode, SensorHeader,
    SensorId,
};

use crate::actuators::{Actuators, FALLBACK_AFTER_NS, FALLBACK_DECELERATION, Request};
use crate::body::{Body, BodyWish};
use crate::commonroad::Class;
use crate::driver::{self, Driver, Habit, View};
use crate::emergency;
use crate::gate::{Acceptance, Gate};
use crate::geometry::{Footprint, Pose, Vec2, wrap_angle};
use crate::metrics::{HARD_BRAKING, LANE_GAP, Meter, NOTED_BRAKING, Sample, WorldMetrics};
use crate::plant::{self, BMW_320I};
use crate::road::{Foot, LaneId, Road, Rough};
use crate::route::{Here, Navigation};
use crate::scenario::Scenario;
use crate::sensors::{
    EgoTruth, LANES_PHASE_MS, Outbox, SENSOR_PERIOD_MS, SENSOR_PHASE_MS, SensorFault, SensorTiming,
    Sensors, Stamp,
};
use crate::traffic::{Leader, Movement, Participant, Traffic};

/// One tick of the world, ns.
const TICK_NS: u64 = 1_000_000;
/// The same in seconds.
const TICK_S: f64 = 1e-3;
/// Ticks between two moves of traffic and checks for collisions: 15 cm at 30 m/s.
const TRAFFIC_TICKS: u64 = 5;
/// Cycle of the ego's motion and of the driver's request, in ticks.
const MOTION_TICKS: u64 = 10;
/// Period of the vehicle's echo while no control frame is accepted, in ticks. An echo also follows
/// in the tick after each accepted frame, so that a system which missed that frame learns of it
/// before the frame is overdue.
const ECHO_TICKS: u64 = 10;
const DRIVER_TICKS: u64 = 100;
const DRIVER_PHASE: u64 = 3;
/// If the caller is later than this, ns, the world pauses for that delay: otherwise a frozen world
/// process would look like a vehicle without control.
const STALL_NS: u64 = 200_000_000;
/// The ego counts as being in the other lane when it is farther than this over the line, m.
const LANE_HYSTERESIS: f64 = 0.1;

/// A lane whose direction differs from the ego's by more than this is not its lane, rad.
const ALONG: f64 = 1.0;

/// How a world runs.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct WorldConfig {
    /// Seed of all noise.
    pub seed: u64,
}

/// Another vehicle in a [`WorldSnapshot`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct VehicleSnapshot {
    /// Its id in the scenario.
    pub id: i64,
    /// Kind.
    pub class: Class,
    /// Centre and heading.
    pub pose: Pose,
    /// m/s
    pub speed: f64,
    /// m/s²
    pub acceleration: f64,
    /// m
    pub length: f64,
    /// m
    pub width: f64,
    /// The lane that it is in.
    pub lane: LaneId,
    /// Whether it follows its recording, drives by itself, or stands.
    pub mode: Movement,
}

impl VehicleSnapshot {
    /// Returns the area that it covers.
    #[must_use]
    pub fn footprint(&self) -> Footprint {
        Footprint {
            pose: self.pose,
            length: self.length,
            width: self.width,
        }
    }
}

/// The world at one moment.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct WorldSnapshot {
    /// Scenario time, s: 0 until the first control frame is accepted.
    pub time_s: f64,
    /// A control frame has been accepted.
    pub running: bool,
    /// The ego's centre of gravity, used as its centre, and its heading.
    pub pose: Pose,
    /// m/s
    pub speed: f64,
    /// rad/s
    pub yaw_rate: f64,
    /// Longitudinal acceleration, m/s².
    pub acceleration: f64,
    /// Lateral acceleration, m/s², left positive.
    pub lateral_acceleration: f64,
    /// Road wheel angle, rad, left positive.
    pub steering_angle: f64,
    /// The gear that is engaged.
    pub gear: GearCode,
    /// State of the parking brake.
    pub parking_brake: ParkingBrakeCode,
    /// The request to the actuators, from the controller or, without one, from the vehicle itself.
    pub request: Request,
    /// No control frame was accepted for 100 ms: the steering is held and the brake is gently on.
    pub fallback: bool,
    /// The ego's lane.
    pub lane: LaneId,
    /// Arc length in that lane, m.
    pub station: f64,
    /// Offset from the lane's centre, m, left positive.
    pub lateral_offset: f64,
    /// Bumper distance to the leader in the ego's lane, m; infinite without one.
    pub gap: f64,
    /// Speed of that leader, m/s; 0 without one.
    pub leader_speed: f64,
    /// Time to collision with it, s; infinite if the ego is not closing in.
    pub ttc: f64,
    /// The ego overlaps another vehicle now.
    pub collides: bool,
    /// The last control frame that acted.
    pub accepted: Option<Acceptance>,
    /// The others that are present.
    pub vehicles: Vec<VehicleSnapshot>,
}

impl WorldSnapshot {
    /// Returns the area that the ego covers.
    #[must_use]
    pub fn footprint(&self) -> Footprint {
        Footprint {
            pose: self.pose,
            length: BMW_320I.length,
            width: BMW_320I.width,
        }
    }
}

/// The world outside of the controller. Deterministic: the same scenario, seed, frames and times
/// give a bit-identical run.
pub struct World {
    road: Arc<Road>,
    set_speed: f64,
    navigation: Navigation,
    driver: Driver,
    /// Whether the last control frame that acted says that the driver drives.
    by_hand: bool,
    state: plant::PlantState,
    actuators: Actuators,
    request: Request,
    body: Body,
    /// What the system that drives asks of gear and parking brake.
    body_wish: BodyWish,
    ego: EgoTruth,
    traffic: Traffic,
    sensors: Sensors,
    outbox: Outbox,
    gate: Gate,
    /// Width of the lane that the ego is in or nearest to; 0 if that lane runs the other way.
    lane_width: f64,
    /// Whether the ego is on a lane of the other direction.
    wrong_way: bool,
    /// How far its farthest corner is outside of all lanes of its direction, m.
    outside: f64,
    meter: Meter,
    transmitter: FrameTransmitter,
    snapshot: WorldSnapshot,
    /// Time of the next tick; `None` before the first call.
    next_ns: Option<u64>,
    /// Ticks since the first call, and ticks of the running world.
    ticks: u64,
    /// The tick of the last echo, and the arrival of the frame that it reported, ns.
    echoed: Option<(u64, Option<u64>)>,
    world_ticks: u64,
    stalled_ns: u64,
}

impl World {
    /// The world of this scenario at its start.
    #[must_use]
    pub fn new(scenario: &Scenario, config: WorldConfig) -> Self {
        let state = plant::PlantState {
            x: scenario.start.position.x,
            y: scenario.start.position.y,
            yaw: scenario.start.yaw,
            speed: scenario.start_speed,
            ..plant::PlantState::default()
        };
        let road = Arc::clone(&scenario.road);
        let (lane, place) = road.locate_start(scenario.start.position, scenario.start.yaw);
        let ego = EgoTruth {
            pose: scenario.start,
            speed: state.speed,
            lane,
            place,
            ..EgoTruth::default()
        };
        let traffic = Traffic::new(
            Arc::clone(&road),
            Arc::clone(&scenario.obstacles),
            &participant(&ego),
        );
        let mut world = Self {
            meter: Meter::new(traffic.vehicles().len(), Arc::clone(&scenario.goals)),
            snapshot: WorldSnapshot::default(),
            sensors: Sensors::new(config.seed),
            outbox: Outbox::default(),
            gate: Gate::new(),
            lane_width: 0.0,
            wrong_way: false,
            outside: 0.0,
            transmitter: FrameTransmitter::new(),
            set_speed: scenario.set_speed,
            navigation: Navigation::new(Arc::clone(&scenario.goals), scenario.set_speed),
            driver: Driver::default(),
            by_hand: false,
            request: Request::default(),
            body: Body::default(),
            body_wish: BodyWish::default(),
            actuators: Actuators::settled(Request::default()),
            next_ns: None,
            ticks: 0,
            echoed: None,
            world_ticks: 0,
            stalled_ns: 0,
            road,
            state,
            ego,
            traffic,
        };
        world.observe(true);
        world
    }

    /// Returns the state of the ego's plant.
    #[must_use]
    pub fn plant(&self) -> &plant::PlantState {
        &self.state
    }

    /// Sets the driver's actions in this run.
    pub fn set_driver(&mut self, habit: Habit) {
        self.driver = Driver::new(habit);
    }

    /// Makes the others drive their recorded tracks as they were: none reacts to the ego, and each
    /// disappears where its recording ends. Call it before the first step.
    pub fn replay_traffic(&mut self) {
        self.traffic = self.traffic.as_recorded(&participant(&self.ego));
        self.observe(true);
    }

    /// Sets which sensors fail in this run.
    pub fn set_sensor_faults(&mut self, faults: Vec<SensorFault>) {
        self.outbox.set_faults(faults);
    }

    /// Sets how the sensors' clocks differ from the vehicle's, and how long their lists take to the
    /// bus. They begin with the vehicle's clock and without a delay.
    pub fn set_sensor_timing(&mut self, timing: &[SensorTiming]) {
        self.sensors.set_timing(timing);
    }

    /// Receives a controller's frame at `now_ns` on the caller's clock. Returns the ruling on a
    /// control frame; `None` for other frames, which change nothing. The first control frame that
    /// is accepted and comes from a function that drives starts the world.
    pub fn on_frame(&mut self, now_ns: u64, id: u32, data: &[u8]) -> Option<Acceptance> {
        if let Some(wish) = self.gate.on_body(now_ns, id, data) {
            self.body_wish = BodyWish {
                gear: wish.gear,
                brake: wish.brake_request,
            };
            return None;
        }
        self.gate.set_speed(self.state.speed);
        let judged = self.gate.on_frame(now_ns, id, data)?;
        if let Some(control) = judged.command {
            self.driver
                .on_request(self.snapshot.time_s, control.takeover_request);
            self.snapshot.accepted = Some(judged.acceptance);
            self.by_hand = control.mode == bus::ModeCode::None;
            let stops = control.mode == bus::ModeCode::SafeStop;
            self.meter
                .function(self.snapshot.time_s, control.takeover_request, stops);
            if self.by_hand {
                return Some(judged.acceptance);
            }
            self.request = Request {
                steering_angle: f64::from(control.steering_angle),
                acceleration: f64::from(control.acceleration),
            };
            self.snapshot.running = true;
        }
        Some(judged.acceptance)
    }

    /// Receives a system's frame of time that was on the bus at `at_ns`, for the sensors.
    pub(crate) fn on_time_sync(&mut self, from: SystemId, at_ns: u64, data: &[u8]) {
        let time_s = self.snapshot.time_s;
        self.sensors.on_time_sync(from, at_ns, time_s, data);
    }

    /// Runs the world up to `now_ns`, in ticks of one millisecond, and passes on the frames that
    /// are due: id and data. Call it every millisecond; a late call catches up. After more than 200
    /// ms without a call the world stands still instead, see [`World::stalled_ns`].
    pub fn step(&mut self, now_ns: u64, emit: &mut dyn FnMut(u16, &[u8])) {
        let mut next = *self.next_ns.get_or_insert(now_ns);
        if now_ns.saturating_sub(next) > STALL_NS {
            self.stalled_ns += now_ns - next;
            next = now_ns;
        }
        while next <= now_ns {
            self.tick(next, emit);
            next += TICK_NS;
        }
        self.next_ns = Some(next);
    }

    /// Returns the time at which the world sends its next frame, ns, if no control frame arrives
    /// before: the time of a period, at least `now_ns`, at most [`MOTION_TICKS`] periods ahead.
    #[must_use]
    pub fn next_frame(&self, now_ns: u64) -> u64 {
        let next_ns = self.next_ns.unwrap_or(now_ns);
        let mut ahead = (0..MOTION_TICKS).map(|n| (self.ticks + n, next_ns + n * TICK_NS));
        let sends = ahead.find(|(tick, at_ns)| {
            let phase = tick % SENSOR_PERIOD_MS;
            self.is_echo_due(*tick, *at_ns)
                || tick.is_multiple_of(MOTION_TICKS)
                || tick % DRIVER_TICKS == DRIVER_PHASE
                || SENSOR_PHASE_MS.contains(&phase)
                || phase == LANES_PHASE_MS
                || self.outbox.is_due(*tick)
        });
        sends.map_or(next_ns, |(_, at_ns)| at_ns)
    }

    fn is_echo_due(&self, tick: u64, now_ns: u64) -> bool {
        let accepted_ns = self.gate.accepted().map(|last| last.at_ns);
        let is_due = |(at_tick, frame_ns)| frame_ns != accepted_ns || tick >= at_tick + ECHO_TICKS;
        self.echoed.is_none_or(is_due) || self.gate.is_overdue(now_ns)
    }

    /// Sends the echo at `now_ns`, if one is due.
    pub(crate) fn echo(&mut self, now_ns: u64, emit: &mut dyn FnMut(u16, &[u8])) {
        if self.is_echo_due(self.ticks, now_ns) {
            self.echoed = Some((self.ticks, self.gate.accepted().map(|last| last.at_ns)));
            let echo = Message::GateEcho(self.gate.echo(now_ns));
            let frame = self.transmitter.encode(&echo);
            emit(frame.id, frame.data());
        }
    }

    fn tick(&mut self, now_ns: u64, emit: &mut dyn FnMut(u16, &[u8])) {
        if self.snapshot.running {
            self.advance(now_ns);
        }
        self.transmit(now_ns, emit);
        self.ticks += 1;
    }

    /// Selects the request: the driver's if the driver drives; gentle braking without control
    /// frames.
    fn choose_request(&mut self, now_ns: u64) {
        let silence = self
            .gate
            .accepted()
            .map_or(0, |last| now_ns.saturating_sub(last.at_ns));
        self.snapshot.fallback = silence > FALLBACK_AFTER_NS;
        if self.by_hand {
            let now = &self.snapshot;
            let view = View {
                pose: now.pose,
                speed: now.speed,
                lane: now.lane,
                station: now.station,
                leader: Leader {
                    gap: now.gap,
                    speed: now.leader_speed,
                    acceleration: 0.0,
                },
            };
            self.request = driver::by_hand(&self.road, &view, self.set_speed);
        } else if self.snapshot.fallback {
            self.request.acceleration = -FALLBACK_DECELERATION;
        }
    }

    /// Moves the ego by the request for one millisecond.
    fn move_ego(&mut self) {
        if self.by_hand {
            self.body_wish = BodyWish::DRIVE;
        }
        self.body.step(self.body_wish, self.state.speed);
        let mut input = self.actuators.step(self.request, &self.state, &BMW_320I);
        input.acceleration = self.body.limit(input.acceleration, self.state.speed);
        let before = self.state;
        self.state = before.stepped(input, TICK_S, &BMW_320I);
        if self.state.speed < 0.0 {
            // The brake has stopped the vehicle, and nothing moves it backwards.
            self.state.speed = 0.0;
        }
        if self.state.speed < plant::KINEMATIC_BELOW {
            self.state.settle_slowly_rolling(&BMW_320I);
        }
        let speed = self.state.speed;
        let slip_rate = (self.state.slip_angle - before.slip_angle) / TICK_S;
        self.ego.long_acceleration = (speed - before.speed) / TICK_S;
        self.ego.lat_acceleration = speed * (self.state.yaw_rate + slip_rate);
        self.follow_plant();
    }

    /// Runs one millisecond of the running world.
    fn advance(&mut self, now_ns: u64) {
        self.choose_request(now_ns);
        self.move_ego();
        self.world_ticks += 1;
        let traffic_moves = self.world_ticks.is_multiple_of(TRAFFIC_TICKS);
        if traffic_moves {
            let time = self.world_ticks as f64 * TICK_S;
            let dt = TRAFFIC_TICKS as f64 * TICK_S;
            self.traffic.step(time, dt, &participant(&self.ego));
        }
        self.observe(traffic_moves);
        let domain_end = self.road.domain_end(self.ego.lane, self.ego.place.s);
        let brakes_hard = self.ego.long_acceleration < -HARD_BRAKING;
        let beside = if brakes_hard {
            self.nearest_in_front()
        } else {
            f64::INFINITY
        };
        let end = self.road.distance_to_end(self.ego.lane, self.ego.place.s);
        let domain_end = domain_end.map_or(f64::INFINITY, |(distance, _)| distance);
        if self.ego.long_acceleration < -NOTED_BRAKING {
            let ego = emergency::Ego {
                pose: self.ego.pose,
                speed: self.ego.speed,
                curvature: self.ego.yaw_rate / self.ego.speed.max(1.0),
                end: end.min(domain_end),
            };
            let now = &self.snapshot;
            let present = self.traffic.vehicles().iter().filter(|it| it.is_present());
            let others = present.map(|vehicle| &vehicle.participant);
            let needed = emergency::needed(&ego, (now.gap, now.leader_speed), others);
            self.meter.needs(self.snapshot.time_s, needed);
        }
        let lane_end = self.road.lane(self.ego.lane).end;
        let past_end = lane_end.map_or(0.0, |end| (self.ego.place.s - end).max(0.0));
        self.meter.step(&Sample {
            time_s: self.snapshot.time_s,
            parks: self.driver.parks(self.snapshot.time_s),
            speed: self.ego.speed,
            long_acceleration: self.ego.long_acceleration,
            lat_acceleration: self.ego.lat_acceleration,
            lane: self.ego.lane,
            offset: self.ego.place.d.hypot(past_end),
            width: self.lane_width,
            wrong_way: self.wrong_way,
            outside: self.outside,
            pose: self.ego.pose,
            gap: self.snapshot.gap,
            ttc: self.snapshot.ttc,
            beside,
            end,
            domain_end,
        });
    }

    /// Returns the distance to the nearest road user in front of the ego, m; infinite without one.
    fn nearest_in_front(&self) -> f64 {
        let frame = self.ego.pose.frame();
        let vehicles = self.snapshot.vehicles.iter();
        let places = vehicles.map(|vehicle| frame.to_local(vehicle.pose.position));
        let in_front = places.filter(|place| place.x > 0.0).map(Vec2::norm);
        in_front.fold(f64::INFINITY, f64::min)
    }

    /// Copies the plant's state and finds the lane.
    fn follow_plant(&mut self) {
        let state = &self.state;
        let pose = Pose {
            position: Vec2::new(state.x, state.y),
            yaw: wrap_angle(state.yaw),
        };
        let ego = &mut self.ego;
        (ego.pose, ego.speed, ego.yaw_rate) = (pose, state.speed, state.yaw_rate);
        (ego.slip_angle, ego.steering_angle) = (state.slip_angle, state.steering_angle);
        (ego.gear, ego.parking_brake) = (self.body.gear(), self.body.parking_brake());
        let lane = self.road.lane(ego.lane);
        ego.place = lane.project_near(pose.position, ego.place.s);
        let width = lane.width_at(ego.place.s);
        let outside = ego.place.d.abs() > width / 2.0 + LANE_HYSTERESIS;
        if outside || !lane.is_for_cars(ego.place.s) {
            (ego.lane, ego.place) = self.road.locate_car(pose.position, pose.yaw);
        }
        let lane = self.road.lane(ego.lane);
        let heading = lane.line.at(ego.place.s).heading;
        let along = wrap_angle(heading - pose.yaw).abs() < ALONG;
        let is_own = along && lane.is_for_cars(ego.place.s);
        self.lane_width = if is_own {
            lane.width_at(ego.place.s)
        } else {
            0.0
        };
        let off_lane = ego.place.d.abs() > self.lane_width / 2.0;
        if !off_lane {
            self.wrong_way = false;
        } else if self.world_ticks.is_multiple_of(TRAFFIC_TICKS) {
            self.wrong_way = self.road.is_oncoming(pose.position, pose.yaw);
        }
        let (sine, cosine) = wrap_angle(heading - pose.yaw).sin_cos();
        let half = (BMW_320I.length * sine.abs() + BMW_320I.width * cosine.abs()) / 2.0;
        if self.ego.place.d.abs() + half <= self.lane_width / 2.0 {
            self.outside = 0.0;
        } else if self.world_ticks.is_multiple_of(TRAFFIC_TICKS) {
            let corners = participant(&self.ego).footprint.corners();
            let outside = corners.map(|corner| self.outside_lanes(corner));
            self.outside = outside.into_iter().fold(0.0, f64::max);
        }
    }

    /// Returns how far a point is outside of all lanes of the ego's direction, m. A narrow gap
    /// between two of them counts as road.
    fn outside_lanes(&self, point: Vec2) -> f64 {
        let yaw = self.ego.pose.yaw;
        let own = self.road.lane(self.ego.lane);
        let near = own.project_near(point, self.ego.place.s);
        if own.is_for_cars(near.s) && near.d.abs() <= own.width_at(near.s) / 2.0 {
            return 0.0;
        }
        let (lane, place) = self.road.locate_car(point, yaw);
        let lane = self.road.lane(lane);
        let along = wrap_angle(lane.line.at(place.s).heading - yaw).abs() < ALONG;
        let width = if along && lane.is_for_cars(place.s) {
            lane.width_at(place.s)
        } else {
            0.0
        };
        let beyond = place.d.abs() - width / 2.0;
        let [left, right] = lane.beside(place.s);
        let beside = if place.d > 0.0 { left } else { right };
        if beside.is_some() && beyond <= LANE_GAP {
            return 0.0;
        }
        beyond.max(0.0)
    }

    /// Updates the snapshot.
    fn observe(&mut self, traffic_moved: bool) {
        let ego = participant(&self.ego);
        self.snapshot.time_s = self.world_ticks as f64 * TICK_S;
        if traffic_moved {
            let vehicles = self.traffic.vehicles();
            let time = self.snapshot.time_s;
            let reach = self.ego.place.d.abs() + BMW_320I.width / 2.0;
            let keeps_lane = reach < self.lane_width / 2.0;
            self.snapshot.collides = self.meter.collide(time, &ego, keeps_lane, vehicles);
            self.snapshot.vehicles.clear();
            let present = vehicles.iter().filter(|vehicle| vehicle.is_present());
            self.snapshot
                .vehicles
                .extend(present.map(|vehicle| VehicleSnapshot {
                    id: vehicle.id,
                    class: vehicle.class,
                    pose: vehicle.participant.footprint.pose,
                    speed: vehicle.participant.speed,
                    acceleration: vehicle.participant.acceleration,
                    length: vehicle.participant.footprint.length,
                    width: vehicle.participant.footprint.width,
                    lane: vehicle.lane,
                    mode: vehicle.mode,
                }));
            let leader = leader(&self.road, &self.ego, &mut self.traffic);
            (self.snapshot.gap, self.snapshot.leader_speed) = leader;
        }
        let (ego, snapshot) = (&self.ego, &mut self.snapshot);
        let closing = ego.speed - snapshot.leader_speed;
        let closes_in = snapshot.gap.is_finite() && closing > 0.1;
        snapshot.ttc = if closes_in {
            snapshot.gap.max(0.0) / closing
        } else {
            f64::INFINITY
        };
        (snapshot.pose, snapshot.speed, snapshot.yaw_rate) = (ego.pose, ego.speed, ego.yaw_rate);
        snapshot.acceleration = ego.long_acceleration;
        snapshot.lateral_acceleration = ego.lat_acceleration;
        snapshot.steering_angle = ego.steering_angle;
        (snapshot.gear, snapshot.parking_brake) = (ego.gear, ego.parking_brake);
        snapshot.request = self.request;
        (snapshot.lane, snapshot.station) = (ego.lane, ego.place.s);
        snapshot.lateral_offset = ego.place.d;
    }

    /// Sends the frames that are due in this tick.
    fn transmit(&mut self, now_ns: u64, emit: &mut dyn FnMut(u16, &[u8])) {
        self.echo(now_ns, emit);
        let Self {
            transmitter,
            sensors,
            outbox,
            ego,
            ticks,
            ..
        } = self;
        let mut send = |message: &Message| {
            let frame = transmitter.encode(message);
            emit(frame.id, frame.data());
        };
        if ticks.is_multiple_of(MOTION_TICKS) {
            send(&Message::EgoMotion(
                sensors.motion(ego, self.snapshot.running),
            ));
        }
        if *ticks % DRIVER_TICKS == DRIVER_PHASE {
            let time_s = self.snapshot.time_s;
            let here = Here {
                time_s,
                lane: ego.lane,
                place: ego.place,
                position: ego.pose.position,
            };
            let reached = self.meter.reached_s().is_some();
            let advice = self.navigation.advice(&self.road, &here, reached);
            let wish = self.driver.wish(time_s, &advice);
            send(&Message::DriverRequest(wish));
        }
        let now = (*ticks, self.snapshot.time_s);
        outbox.release(*ticks, &mut send);
        let phase = *ticks % SENSOR_PERIOD_MS;
        for sensor in SensorId::ALL
            .iter()
            .filter(|s| SENSOR_PHASE_MS[s.index()] == phase)
        {
            let Stamp {
                measured_at,
                time_state,
                delay_ms,
            } = sensors.stamp(*sensor, now_ns, now.1);
            let objects = sensors.objects(*sensor, ego, self.traffic.vehicles());
            let header = SensorHeader {
                object_count: objects.len() as u8,
                time_state,
                measured_at,
            };
            let header = Message::SensorHeader(*sensor, header);
            let objects = objects.iter().map(|of| Message::SensorObject(*sensor, *of));
            let list = iter::once(header).chain(objects);
            outbox.pass(now, (*sensor, delay_ms), list, &mut send);
        }
        if phase == LANES_PHASE_MS {
            let camera = SensorId::CameraFront;
            let stamp = sensors.stamp(camera, now_ns, now.1);
            let lanes = Message::CameraLanes(CameraLanes {
                time_state: stamp.time_state,
                measured_at: stamp.measured_at,
                ..sensors.lanes(ego, &self.road)
            });
            outbox.pass(now, (camera, stamp.delay_ms), iter::once(lanes), &mut send);
        }
    }

    /// Returns the world now.
    #[must_use]
    pub fn snapshot(&self) -> &WorldSnapshot {
        &self.snapshot
    }

    /// Returns the figures of the run so far.
    #[must_use]
    pub fn metrics(&self) -> WorldMetrics {
        let mut metrics = self.meter.metrics();
        let braked = self.traffic.vehicles().iter().map(|it| it.braked_for_ego);
        for hardest in braked.filter(|hardest| *hardest > 0.0) {
            metrics.forced_brakes += 1;
            metrics.forced_brake_max = metrics.forced_brake_max.max(hardest);
        }
        metrics
    }

    /// Returns the counts of the rulings on control frames.
    #[must_use]
    pub fn gate(&self) -> &Gate {
        &self.gate
    }

    /// Returns the lanes.
    #[must_use]
    pub fn road(&self) -> &Road {
        &self.road
    }

    /// Returns the speed that the driver requests, m/s.
    #[must_use]
    pub fn set_speed(&self) -> f64 {
        self.set_speed
    }

    /// Returns how long the world paused because [`World::step`] was not called, ns.
    #[must_use]
    pub fn stalled_ns(&self) -> u64 {
        self.stalled_ns
    }
}

/// Returns the ego as a participant of the traffic.
fn participant(ego: &EgoTruth) -> Participant {
    let footprint = Footprint {
        pose: ego.pose,
        length: BMW_320I.length,
        width: BMW_320I.width,
    };
    Participant {
        footprint,
        speed: ego.speed,
        acceleration: ego.long_acceleration,
    }
}

/// Returns the bumper distance and speed of the nearest vehicle ahead in the ego's lane: its centre
/// is in the lane, or it is in the way of the ego's body.
fn leader(road: &Road, ego: &EgoTruth, traffic: &mut Traffic) -> (f64, f64) {
    let lane = road.lane(ego.lane);
    let frame = ego.pose.frame();
    let mut nearest = (f64::INFINITY, 0.0);
    for index in 0..traffic.vehicles().len() {
        let vehicle = &traffic.vehicles()[index];
        let Participant {
            footprint, speed, ..
        } = vehicle.participant;
        let apart = frame.to_local(footprint.pose.position);
        let is_aside = apart.y.abs() > 20.0 + 0.3 * apart.x;
        if !vehicle.is_present() || apart.x <= 0.0 || apart.x > 300.0 || is_aside {
            continue;
        }
        let near = ego.place.s + apart.x;
        let side = (footprint.width + BMW_320I.width) / 2.0;
        if let Some(Rough { d, by, .. }) = traffic.rough(index, ego.lane, near)
            && d.abs() - by > lane.width_max / 2.0
            && (d - ego.place.d).abs() - by > side
        {
            continue;
        }
        let Foot { place, point } = traffic.foot(index, ego.lane, near);
        let in_lane = place.d.abs() < lane.width_at(place.s) / 2.0;
        let in_the_way = (place.d - ego.place.d).abs() < side;
        let gap = place.s - ego.place.s - (footprint.length + BMW_320I.length) / 2.0;
        if (in_lane || in_the_way) && place.s > ego.place.s && gap < nearest.0 {
            let along = wrap_angle(footprint.pose.yaw - point.heading).cos();
            nearest = (gap, speed * along);
        }
    }
    nearest
}
