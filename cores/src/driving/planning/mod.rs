//! Decision and planning (core 2): from the scene to a trajectory. T-CHIP-3
//!
//! M. Werling, J. Ziegler, S. Kammel, S. Thrun, "Optimal Trajectory Generation for Dynamic Street
//! Scenarios in a Frenét Frame", ICRA 2010. The motion along and across the road are chosen one
//! after the other: a path towards the goal of the behaviour decision, then the cheapest motion
//! along it. Every plan begins where the last plan is now, not at the measured state, so that
//! consecutive plans join smoothly. The plan moves towards the measured state slowly.

mod behaviour;
mod lateral;
mod longitudinal;
mod polynomial;
mod prediction;

use heapless::Vec;

use super::control::{driven_curvature, sample};
use super::knowledge::{Knowledge, PLAN_POINTS, STARTING_CYCLES};
use super::math::{abs, bound, max, min, sqrt, wrap_angle};
use super::odometry::{EgoPose, motion};
use super::road::{CentreLine, DEFAULT_LANE_WIDTH_M, FrenetFrame};
use super::types::{
    Ego, Lanes, MAX_OBJECTS, Maneuver, Scene, TRAJECTORY_SAMPLES, TRAJECTORY_STEP_S, Trajectory,
    TrajectoryPoint,
};
use super::vehicle::{LENGTH_M, WIDTH_M};
use behaviour::{Behaviour, Goal, Intent, Side, Situation};
use lateral::{Path, Station, to_cartesian, to_frenet};
use longitudinal::{COMFORTABLE_BRAKING, Corridor, Manner, Profile, STEP_S, STEPS, cheapest};
use polynomial::Jet;
use prediction::Predicted;
use tandem_board::{Duration, Instant};

/// An older plan is not continued, s.
const MAX_PLAN_AGE_S: f32 = 0.3;
/// The vehicle's time has leapt if a span differs by this from that of this system's clock.
const LEAP: Duration = Duration::from_ms(1);
/// When the vehicle is this far from its plan, planning restarts from the measured state, m, m,
/// m/s.
const MAX_ASIDE_M: f32 = 0.8;
const MAX_BEHIND_M: f32 = 4.0;
const MAX_SPEED_ERROR: f32 = 2.5;
/// Share of the difference by which the plan moves to the measured state in each cycle.
const DRAW: f32 = 0.04;
/// With the vehicle's time, a plan continues the last one on this grid: m, rad, 1/m, m/s, m/s². So
/// plans of two systems that have begun differently become the same bits.
const GRID: [f32; 5] = [1e-4, 1e-5, 1e-7, 1e-4, 1e-4];
/// Lateral acceleration in curves, m/s².
const CURVE_ACCELERATION: f32 = 2.0;
/// Braking before a bend, m/s², and how much earlier it begins, s: plans reach a speed later than
/// they aim at it.
const CURVE_BRAKING: f32 = 1.3;
const CURVE_DELAY_S: f32 = 0.6;
/// A view of at least this range counts as full, m: it needs no limit of speed.
const FULL_VIEW_M: f32 = 78.0;
/// The vehicle must be able to slow down to this speed, m/s, with this braking, m/s², at this
/// distance before the end of the view, m.
const UNSEEN_BEND_SPEED: f32 = 6.3;
const UNSEEN_BRAKING: f32 = 1.5;
const UNSEEN_MARGIN_M: f32 = 4.0;
/// Distance kept to the end of a lane: room to steer into the next one, m.
const END_MARGIN_M: f32 = 15.0;
/// The least such distance, where a larger one would need hard braking, m.
const END_LEAST_M: f32 = 1.0;
/// While a gap is sought, the end of the lane counts only in the first steps of a plan, up to this
/// time, s, and the vehicle brakes for it with this deceleration, m/s².
const SEEKING_S: f32 = 2.0;
const SEEKING_BRAKING: f32 = 2.8;
/// When a stop before the end needs this braking, m/s², the end counts in all steps.
const SEEKING_UNTIL: f32 = 2.0;
/// The body stays this far from the lane's border if the driver asks for a place off centre, m.
const BORDER_M: f32 = 0.2;
/// Lateral room that counts as free, m.
const SIDE_MARGIN_M: f32 = 0.35;
/// A road user that comes towards the vehicle is expected to return to its own lane if they would
/// meet later than this, s. One that is wholly in the vehicle's lane counts as soon as the vehicle
/// has to brake for it: with this braking, m/s², and this much before, s.
const MEETING_S: f32 = 2.5;
const MEETING_BRAKING: f32 = 3.5;
const MEETING_DELAY_S: f32 = 1.5;
/// It is then expected nearer by its way in this time, s: the vehicle stands before they meet.
const MEETING_STANDS_S: f32 = 1.2;
/// Its centre is then within this share of the lane's width from the middle: within the view, and
/// up to twice as far.
const WHOLLY: (f32, f32) = (0.3, 0.2);
/// A road user that crosses ahead or comes towards the vehicle has been passed when it is this far
/// behind, m.
const PASSED_M: f32 = 1.0;
/// Objects farther away along the road are ignored, m.
const FARTHEST_M: f32 = 220.0;
const FARTHEST_BEHIND_M: f32 = 90.0;
/// Durations of the return to the lane's centre, s.
const KEEP_S: [f32; 3] = [2.0, 3.0, 4.5];
/// The shortest distance for that return, m.
const KEEP_MIN_M: f32 = 10.0;

/// Decides and plans, with the memory of the last plan.
#[derive(Clone, Debug)]
pub struct Planner {
    behaviour: Behaviour,
    last: Option<Last>,
    /// Plans so far.
    plans: u32,
}

#[derive(Clone, Debug)]
struct Last {
    trajectory: Trajectory,
    /// The scene's moment.
    moment: Option<Instant>,
    ego: Ego,
    line: Option<CentreLine>,
}

impl Last {
    /// Returns how much later the scene is: in the vehicle's time, unless that has leapt.
    fn age(&self, scene: &Scene) -> Duration {
        let age = scene.at.since(self.trajectory.at);
        let moments = scene.moment.zip(self.moment);
        let shared = moments.map(|(now, last)| now.since(last));
        let is_right = |shared: &Duration| (*shared - age).max(age - *shared) < LEAP;
        shared.filter(is_right).unwrap_or(age)
    }
}

impl Default for Planner {
    fn default() -> Self {
        Self::new()
    }
}

/// The road and what is on it, for one plan.
struct View {
    frame: FrenetFrame,
    objects: Vec<Predicted, MAX_OBJECTS>,
    lanes: Option<Lanes>,
}

/// Returns the nearest state on [`GRID`].
fn on_grid(point: &TrajectoryPoint) -> TrajectoryPoint {
    let near = |value: f32, step: f32| libm::rintf(value / step) * step;
    let [place, angle, curvature, speed, acceleration] = GRID;
    TrajectoryPoint {
        x: near(point.x, place),
        y: near(point.y, place),
        heading: near(point.heading, angle),
        curvature: near(point.curvature, curvature),
        speed: near(point.speed, speed),
        acceleration: near(point.acceleration, acceleration),
    }
}

impl Planner {
    /// A planner without a plan to continue.
    #[must_use]
    pub fn new() -> Self {
        Self {
            behaviour: Behaviour::new(),
            last: None,
            plans: 0,
        }
    }

    /// Returns whether [`Planner::recall`] still accepts knowledge.
    #[must_use]
    pub const fn is_starting(&self) -> bool {
        self.plans < STARTING_CYCLES
    }

    /// Continues the plan of another system, if this one is newly started: the next plan joins it.
    /// Each plan is made for this system's scene and obeys its limits.
    pub fn recall(&mut self, received: &Knowledge) {
        let Some(plan) = received.plan.as_ref().filter(|_| self.is_starting()) else {
            return;
        };
        self.behaviour = Behaviour::recall(plan.memory);
        // A plan is continued for less time than these samples cover.
        let points = core::array::from_fn(|index| plan.points[index.min(PLAN_POINTS - 1)]);
        self.last = Some(Last {
            trajectory: Trajectory {
                at: received.at,
                measured: received.at,
                // Core 0 never follows this plan.
                cycle: 0,
                maneuver: Maneuver::Follow,
                memory: plan.memory,
                points,
            },
            moment: None,
            ego: received.ego,
            line: received.line.as_ref().map(CentreLine::received),
        });
    }

    /// Returns the last plan, and the vehicle's motion at its start; `None` before the first.
    #[must_use]
    pub fn last(&self) -> Option<(&Trajectory, &Ego)> {
        let last = self.last.as_ref()?;
        Some((&last.trajectory, &last.ego))
    }

    /// Returns the trajectory for this scene. Always returns one: in the worst case, full braking
    /// along the lane. Without lanes it continues the present curve and slows down.
    pub fn plan(&mut self, scene: &Scene) -> Trajectory {
        let line = match &scene.lanes {
            Some(lanes) => CentreLine::new(lanes),
            None => CentreLine::of_curvature(driven_curvature(&scene.ego)),
        };
        let (start, moved) = self.start(scene);
        self.watch_lines(scene, &line);

        let frame = FrenetFrame::new(line);
        let mut objects = Vec::new();
        for object in &scene.objects {
            let predicted = Predicted::new(object, &frame);
            if (-FARTHEST_BEHIND_M..FARTHEST_M).contains(&predicted.s) {
                // Cannot be full: a scene holds no more.
                let _ = objects.push(predicted);
            }
        }
        let view = View {
            frame,
            objects,
            lanes: scene.lanes,
        };
        let (s, d) = view.frame.project(start.x, start.y);
        let road = view.frame.reference(s);
        let station = to_frenet(&start, s, d, &road);
        let along = 1.0
            / max(
                sqrt(1.0 + station.offset.first * station.offset.first),
                1e-3,
            );
        let first = Jet {
            value: 0.0,
            first: start.speed * along,
            second: start.acceleration * along,
            third: 0.0,
        };
        let desired = desired_speeds(scene, &view.frame, s);
        let desired_speed = desired[0];

        let width = view.lanes.map_or(DEFAULT_LANE_WIDTH_M, |lanes| lanes.width);
        let room = max(0.5 * (width - WIDTH_M) - BORDER_M, 0.0);
        let goal = match &view.lanes {
            Some(lanes) => {
                let situation = Situation {
                    lanes,
                    objects: &view.objects,
                    speed: start.speed,
                    next_speed: max(start.speed + 1.5 * min(start.acceleration, 0.0), 0.0),
                    desired_speed,
                    offset: d,
                    route: scene.route,
                };
                let goal = self.behaviour.decide(&situation, moved);
                match self.behaviour.intent {
                    Intent::Change { crossed: false, .. } => goal,
                    _ => Goal {
                        offset: bound(scene.lane_offset, room),
                        ..goal
                    },
                }
            }
            None => {
                self.behaviour = Behaviour::new();
                Goal {
                    offset: d,
                    rest_m: None,
                    end: f32::INFINITY,
                    sought: None,
                }
            }
        };
        let along = |goal: &Goal, path: &Path, before: Option<&Profile>| {
            let mut corridor = Corridor::free(desired_speed);
            corridor.desired = desired;
            corridor.near_gap = scene.near_gap;
            choose_profile(&view, (&station, &first), path, goal, before, corridor)
        };
        let drive = |goal: &Goal| {
            let path = choose_path(&station, goal, first.first, room);
            let (profile, manner) = along(goal, &path, None);
            (path, profile, manner)
        };
        let (mut path, mut profile, mut manner) = drive(&goal);
        if self.behaviour.is_leaving() && view.touches(&station, &path, &profile) {
            // So far the present speed was assumed. A vehicle that brakes moves aside later.
            (profile, manner) = along(&goal, &path, Some(&profile));
        }
        if self.behaviour.is_leaving() && view.touches(&station, &path, &profile) {
            let kept = drive(&Goal {
                offset: 0.0,
                rest_m: None,
                end: view.lanes.map_or(f32::INFINITY, |lanes| lanes.own_end),
                sought: None,
            });
            // Staying behind a vehicle that brakes is no better than going around it.
            let is_worse = view.objects.iter().any(|object| {
                touches(object, &station, &path, &profile)
                    && !touches(object, &station, &kept.0, &kept.1)
            });
            if is_worse {
                self.behaviour.abort();
                (path, profile, manner) = kept;
            }
        }

        let trajectory = Trajectory {
            at: scene.at,
            measured: scene.measured,
            cycle: scene.cycle,
            maneuver: self.maneuver(&profile, manner),
            memory: self.behaviour.memory(),
            points: points(&view.frame, &station, &path, &profile),
        };
        let line = scene.lanes.as_ref().map(CentreLine::new);
        self.plans = self.plans.saturating_add(1);
        self.last = Some(Last {
            trajectory: trajectory.clone(),
            moment: scene.moment,
            ego: scene.ego,
            line,
        });
        trajectory
    }

    /// Returns the state that the new plan begins with, in the scene's frame, and the distance
    /// driven since the last plan, m.
    fn start(&self, scene: &Scene) -> (TrajectoryPoint, f32) {
        let measured = TrajectoryPoint {
            x: 0.0,
            y: 0.0,
            heading: scene.ego.slip_angle,
            curvature: driven_curvature(&scene.ego),
            speed: max(scene.ego.speed, 0.0),
            acceleration: scene.ego.acceleration,
        };
        let Some(last) = &self.last else {
            return (measured, 0.0);
        };
        let age = last.age(scene).as_secs_f32();
        if age > MAX_PLAN_AGE_S || scene.at <= last.trajectory.at {
            return (measured, 0.0);
        }
        let step = motion(&last.ego, &scene.ego, age);
        let planned = sample(&last.trajectory, age);
        let pose = EgoPose {
            x: planned.x,
            y: planned.y,
            heading: planned.heading,
        }
        .seen_from(step);
        if abs(pose.y) > MAX_ASIDE_M
            || abs(pose.x) > MAX_BEHIND_M
            || abs(planned.speed - scene.ego.speed) > MAX_SPEED_ERROR
        {
            return (measured, step.x);
        }
        let aside = wrap_angle(measured.heading - pose.heading);
        let start = TrajectoryPoint {
            x: pose.x * (1.0 - DRAW),
            y: pose.y * (1.0 - DRAW),
            heading: pose.heading + DRAW * aside,
            curvature: planned.curvature,
            speed: planned.speed + DRAW * (measured.speed - planned.speed),
            acceleration: planned.acceleration,
        };
        match scene.moment {
            Some(_) => (on_grid(&start), step.x),
            None => (start, step.x),
        }
    }

    /// Notices when the ego lane has become another one: its centre line jumps aside.
    fn watch_lines(&mut self, scene: &Scene, line: &CentreLine) {
        let (Some(last), Some(lanes)) = (&self.last, &scene.lanes) else {
            return;
        };
        let Some(before) = last.line else { return };
        let age = last.age(scene).as_secs_f32();
        let step = motion(&last.ego, &scene.ego, age);
        let jump = line.project(0.0, 0.0).1 - before.project(step.x, step.y).1;
        if abs(jump) > 0.5 * lanes.width {
            // If the vehicle is now right of the centre, its own lane is the former left one.
            self.behaviour
                .crossed_line(if jump < 0.0 { 1.0 } else { -1.0 });
        }
    }

    fn maneuver(&self, profile: &Profile, manner: Manner) -> Maneuver {
        let hardest = min(profile.at(0.3).second, profile.at(0.8).second);
        let brakes = hardest < -COMFORTABLE_BRAKING;
        match self.behaviour.intent {
            _ if brakes && manner == Manner::Emergency => Maneuver::Brake,
            Intent::Change {
                side: Side::Left, ..
            } => Maneuver::ChangeLeft,
            Intent::Change {
                side: Side::Right, ..
            } => Maneuver::ChangeRight,
            Intent::Keep => Maneuver::Follow,
        }
    }
}

/// Returns the speed that driver, signs and curves allow, now and at each step, m/s: before a bend
/// it falls as the bend comes nearer. Without lanes it is 0; without a request of the driver, the
/// present speed counts as requested.
fn desired_speeds(scene: &Scene, frame: &FrenetFrame, s: f32) -> [f32; STEPS] {
    let Some(lanes) = &scene.lanes else {
        return [0.0; STEPS];
    };
    let set = scene.set_speed.unwrap_or(max(scene.ego.speed, 0.0));
    let near = CURVE_DELAY_S * max(scene.ego.speed, 0.0);
    let (curve, in_curve) = frame.bend_speed(s, near, CURVE_ACCELERATION, CURVE_BRAKING);
    let known = min(min(set, lanes.speed_limit), unseen_speed(lanes.view_range));
    core::array::from_fn(|step| {
        let falls = CURVE_BRAKING * step as f32 * STEP_S;
        max(min(known, max(curve - falls, min(in_curve, curve))), 0.0)
    })
}

/// Returns the speed that is safe for the unseen road, m/s: if the camera sees only part of its
/// range, the lane bends, and beyond the view it may bend as sharply as the domain permits.
fn unseen_speed(view_range_m: f32) -> f32 {
    if view_range_m >= FULL_VIEW_M {
        return f32::INFINITY;
    }
    let room = max(view_range_m - UNSEEN_MARGIN_M, 0.0);
    sqrt(UNSEEN_BEND_SPEED * UNSEEN_BEND_SPEED + 2.0 * UNSEEN_BRAKING * room)
}

/// Returns the distance within which to stop for a lane that ends in `end` m: with room to steer
/// into the next lane if that needs no hard braking.
fn stop_before(end: f32, speed: f32) -> f32 {
    let nearest = end - END_LEAST_M - 0.5 * LENGTH_M;
    let comfortable = speed * speed / (2.0 * SEEKING_BRAKING) + 0.5 * speed;
    max(
        end - END_MARGIN_M - 0.5 * LENGTH_M,
        min(comfortable, nearest),
    )
}

/// Returns the cheapest path to the goal, in a lane with this much room on either side, m.
fn choose_path(from: &Station, goal: &Goal, speed: f32, room: f32) -> Path {
    if let Some(rest_m) = goal.rest_m {
        return Path::new(from, goal.offset, rest_m);
    }
    let candidate = |time: f32| Path::new(from, goal.offset, max(time * speed, KEEP_MIN_M));
    let mut best = candidate(KEEP_S[0]);
    let mut least = lateral::cost(&best, speed, room);
    for &time in &KEEP_S[1..] {
        let path = candidate(time);
        let cost = lateral::cost(&path, speed, room);
        if cost < least {
            (best, least) = (path, cost);
        }
    }
    best
}

/// Returns the cheapest motion along the path among all road users, from this place and motion.
/// `before`: the motion that determines the offset at each step; `None`: the present speed is kept.
fn choose_profile(
    view: &View,
    (station, start): (&Station, &Jet),
    path: &Path,
    goal: &Goal,
    before: Option<&Profile>,
    mut corridor: Corridor,
) -> (Profile, Manner) {
    let aside_at = |t: f32| {
        let way = before.map_or(start.first * t, |profile| profile.at(t).value);
        path.at(station.s + way).value
    };
    corridor.seeks = goal.sought.is_some();
    // A gap is sought as long as the vehicle can still stop gently.
    let room = goal.end - station.s - END_MARGIN_M - 0.5 * LENGTH_M;
    let seeks =
        goal.sought.is_some() && start.first * start.first < 2.0 * SEEKING_UNTIL * max(room, 0.0);
    if goal.sought.is_some() {
        corridor.end_braking = SEEKING_BRAKING;
    }
    let half = 0.5 * view.lanes.map_or(DEFAULT_LANE_WIDTH_M, |lanes| lanes.width);
    let own_end = view.lanes.map_or(f32::INFINITY, |lanes| lanes.own_end);
    let aside: [f32; STEPS] = core::array::from_fn(|step| aside_at((step + 1) as f32 * STEP_S));
    for (step, aside) in aside.iter().enumerate() {
        let t = (step + 1) as f32 * STEP_S;
        let in_goal_lane = abs(aside - goal.offset) < half;
        let end = if in_goal_lane { goal.end } else { own_end };
        // While a gap is sought, the end of the lane counts only in the first steps.
        if end < f32::INFINITY && (!seeks || t < SEEKING_S) {
            corridor.stop[step] = stop_before(end - station.s, start.first);
            corridor.end[step] = end - station.s - END_LEAST_M - 0.5 * LENGTH_M;
        }
    }
    let sought = goal.sought.and_then(|(centre, from)| {
        let in_lane = |object: &&Predicted| abs(object.d - centre) < half && object.s >= from;
        let nearer = |a: &&Predicted, b: &&Predicted| {
            a.s.partial_cmp(&b.s).unwrap_or(core::cmp::Ordering::Equal)
        };
        view.objects.iter().filter(in_lane).min_by(nearer)
    });
    // The vehicle stops before the end of its lane, and so before everything that stands beyond it.
    // An oncoming road user counts only if it is within the view and near.
    let seen = view.lanes.map_or(0.0, |lanes| lanes.view_range);
    let comes = |object: &Predicted| {
        let share = if object.s < seen { WHOLLY.0 } else { WHOLLY.1 };
        let is_in_lane = abs(object.d) < share * 2.0 * half && object.s < 2.0 * seen;
        object.is_oncoming() && is_in_lane
    };
    let is_early = |object: &Predicted| {
        let is_against = comes(object);
        let stops_s = start.first / MEETING_BRAKING + MEETING_DELAY_S;
        let from_s = if is_against {
            max(stops_s, MEETING_S)
        } else {
            MEETING_S
        };
        let away = object.s - station.s;
        let is_seen = is_against || object.s <= seen;
        object.is_oncoming() && (!is_seen || away > from_s * (start.first - object.speed))
    };
    let is_sought = |object: &Predicted| sought.is_some_and(|it| core::ptr::eq(it, object));
    let concerns = |object: &&Predicted| {
        (object.s > station.s || is_sought(object))
            && !(object.s > own_end && object.speed < 1.0)
            && !is_early(object)
    };
    for object in view.objects.iter().filter(concerns) {
        let is_sought = is_sought(object);
        // For a vehicle beside the ego, make room gently: braking cannot stop it from swerving in.
        let away = object.s - station.s;
        let is_aside = abs(object.d - station.offset.value) > object.half_width + 0.5 * WIDTH_M;
        let is_beside = away < object.half_length + 0.5 * LENGTH_M && (is_aside || away <= 0.0);
        let reach = object.half_width + 0.5 * WIDTH_M + SIDE_MARGIN_M;
        let nearer = if comes(object) {
            -MEETING_STANDS_S * object.speed
        } else {
            0.0
        };
        // One that crosses may stop in the lane: it counts once the vehicle needs the way to brake.
        let braking_way = start.first * (MEETING_DELAY_S + 0.5 * start.first / MEETING_BRAKING);
        let mut stands: Option<f32> = None;
        for (step, aside) in aside.iter().enumerate() {
            let t = (step + 1) as f32 * STEP_S;
            let is_aside = abs(object.across(t) - aside) >= reach;
            if is_aside && !is_sought {
                if let Some(bound) = stands {
                    corridor.limit(step, bound, 0.0);
                }
                continue;
            }
            let (s, speed) = object.along(t);
            let bound = s - object.half_length - 0.5 * LENGTH_M - station.s - nearer;
            let passed = object.passes()
                && start.first * t > s - station.s + object.half_length + 0.5 * LENGTH_M + PASSED_M;
            let is_in_the_way = !is_aside && !passed;
            if is_in_the_way && !is_beside {
                corridor.limit(step, bound, speed);
                if object.crosses() && bound > 0.0 && bound < braking_way {
                    stands = stands.or(Some(bound));
                }
            } else if is_sought || is_in_the_way {
                corridor.seek(step, bound, speed);
            }
        }
    }
    cheapest(start, &corridor)
}

impl View {
    fn touches(&self, station: &Station, path: &Path, profile: &Profile) -> bool {
        let mut objects = self.objects.iter();
        objects.any(|object| touches(object, station, path, profile))
    }
}

/// Returns whether the plan touches the object, which is beside or ahead of the vehicle.
fn touches(object: &Predicted, station: &Station, path: &Path, profile: &Profile) -> bool {
    let length = object.half_length + 0.5 * LENGTH_M;
    let width = object.half_width + 0.5 * WIDTH_M + 0.1;
    object.s > station.s - length
        && (1..=20).any(|step| {
            let t = step as f32 * 0.2;
            let s = station.s + profile.at(t).value;
            abs(object.along(t).0 - s) < length + 0.5
                && abs(object.across(t) - path.at(s).value) < width
        })
}

/// Samples of the plan in the vehicle frame.
fn points(
    frame: &FrenetFrame,
    station: &Station,
    path: &Path,
    profile: &Profile,
) -> [TrajectoryPoint; TRAJECTORY_SAMPLES] {
    let mut points = [TrajectoryPoint::default(); TRAJECTORY_SAMPLES];
    let mut way = 0.0;
    for (index, point) in points.iter_mut().enumerate() {
        let motion = profile.at(index as f32 * TRAJECTORY_STEP_S);
        // Polynomials that end at standstill may swing back by millimetres.
        way = max(way, motion.value);
        let s = station.s + way;
        *point = to_cartesian(&frame.reference(s), &path.at(s), &motion);
    }
    points
}
