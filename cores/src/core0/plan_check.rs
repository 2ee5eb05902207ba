//! Checks each trajectory of core 2 before core 0 follows it. T-RED-9
//!
//! Core 0 makes no plan. It tests that the trajectory begins where the last one is now or where the
//! vehicle is, that a vehicle can drive it, that it stays between its present offset and the centre
//! of the lane to which it leads, and that it does not pass through the vehicle ahead. A trajectory
//! that fails is not followed. The limits and their reasons are in
//! `docs/decisions/0035-trajectory-check.md`.

use crate::driving::control::sample;
use crate::driving::math::{abs, cos, max, min, sin, wrap_angle};
use crate::driving::odometry::EgoPose;
use crate::driving::road::CentreLine;
use crate::driving::types::{
    Lanes, Maneuver, Object, Scene, TRAJECTORY_STEP_S, Trajectory, TrajectoryPoint,
};
use crate::driving::vehicle::WIDTH_M;
use crate::trace::Event;
use tandem_board::Duration;

/// This many trajectories in succession must be wrong: 150 ms. A wrong scene is found before.
const WRONG: u8 = 3;
/// An older trajectory is not continued, as in planning.
const CONTINUED: Duration = Duration::from_ms(300);
/// Largest distance of the first point from the vehicle: along and across in m, heading in rad,
/// speed in m/s. Planning restarts from the vehicle at 4 m, 0.8 m and 2.5 m/s.
const NEAR: [f32; 4] = [6.5, 1.3, 0.2, 4.0];
/// The same from the place where the last trajectory is now, or from the vehicle if planning
/// restarts there.
const JOINS: [f32; 4] = [0.8, 0.15, 0.03, 0.6];
/// Errors between two points, 0.1 s apart: way and sideward step in m, turn in rad, change of speed
/// in m/s.
const STEP: [f32; 4] = [0.3, 0.2, 0.02, 0.45];
/// Lateral and longitudinal acceleration, m/s², and speed, m/s.
const MOST: [f32; 3] = [8.0, 10.0, 70.0];
/// The trajectory may leave the range from its present offset to its goal by this much, m, and by
/// its first sideward speed times this, s: it first has to turn back.
const ASIDE: f32 = 0.5;
const TURNS_BACK_S: f32 = 1.5;
/// Every fifth point is compared with the lane.
const LANE_STEP: usize = 5;
/// The paths of two vehicles that overlap sideways by less do not count as one, m.
const BESIDE: f32 = 0.3;

/// The part of a trajectory that is wrong.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub(super) enum Part {
    Start,
    Step,
    Limit,
    Lane,
    Object,
}

/// The part with the largest share of its limit.
type Worst = (f32, Part);

/// What is known when a trajectory arrives.
pub(super) struct Known<'k> {
    /// The scene for which it was planned, as core 0 has checked it; `None` if that is another one.
    pub(super) scene: Option<&'k Scene>,
    /// The vehicle's motion is known.
    pub(super) moves: bool,
    /// The last trajectory that was right.
    pub(super) last: Option<&'k Trajectory>,
    /// How the vehicle has moved from the start of that trajectory to that of this one.
    pub(super) moved: EgoPose,
}

/// The check and what it has found.
#[derive(Default)]
pub(super) struct PlanCheck {
    wrong: u8,
    /// The vehicle's motion is known since the last trajectory.
    is_continued: bool,
    /// The largest share that was traced, in tenths.
    worst_tenths: u8,
}

impl PlanCheck {
    /// The vehicle's motion was unknown for a while: the next trajectory need not join the last.
    pub(super) fn interrupt(&mut self) {
        self.is_continued = false;
    }

    /// Checks a trajectory. Returns whether it may be followed, and an event to trace:
    /// [`Event::WrongTrajectory`] if core 2 is wrong. Then no further one is followed in this
    /// incarnation. `off_plan`: the vehicle is where no trajectory led it, and none is followed.
    /// Planning does not expect that, so a trajectory that does not begin at the vehicle is not
    /// taken, but says nothing about core 2.
    pub(super) fn check(
        &mut self,
        new: &Trajectory,
        known: &Known<'_>,
        off_plan: bool,
    ) -> (bool, Option<Event>) {
        let last = known.last.filter(|_| self.is_continued);
        let (share, part) = worst(new, &Known { last, ..*known });
        if self.wrong >= WRONG {
            return (false, None);
        }
        if share <= 1.0 {
            (self.wrong, self.is_continued) = (0, known.moves);
            let percent = (share * 100.0) as u8;
            let is_worst = percent / 10 > self.worst_tenths;
            self.worst_tenths = self.worst_tenths.max(percent / 10);
            return (
                true,
                is_worst.then_some(Event::TrajectoryCheck {
                    what: part as u8,
                    percent,
                }),
            );
        }
        if off_plan {
            self.interrupt();
            return (false, None);
        }
        self.wrong += 1;
        let event = Event::WrongTrajectory {
            what: part as u8,
            percent: (min(share, 1e6) * 100.0) as u32,
        };
        (false, (self.wrong == WRONG).then_some(event))
    }
}

/// Returns the largest share of the limits; a number that is not finite is beyond every limit.
fn share<const N: usize>(values: [f32; N], limits: [f32; N], part: Part) -> Worst {
    let shares = values.into_iter().zip(limits).map(|(value, limit)| {
        let share = abs(value) / limit;
        if share.is_finite() { share } else { f32::MAX }
    });
    (shares.fold(0.0, f32::max), part)
}

fn worst(new: &Trajectory, known: &Known<'_>) -> Worst {
    let greater = |one: Worst, other: Worst| if other.0 > one.0 { other } else { one };
    let mut worst = greater(start(new, known), limits(&new.points[0]));
    for pair in new.points.windows(2) {
        worst = greater(worst, greater(step(&pair[0], &pair[1]), limits(&pair[1])));
    }
    let Some(scene) = known.scene else {
        return worst;
    };
    if let Some(lanes) = &scene.lanes {
        worst = greater(worst, lane(new, lanes, scene.lane_offset));
    }
    let passed = scene.objects.iter().any(|object| passes(new, object));
    let is_wrong = passed && new.maneuver != Maneuver::Brake;
    greater(worst, (f32::from(u8::from(is_wrong)) * 2.0, Part::Object))
}

/// Compares the first point with the vehicle, and with the last trajectory.
fn start(new: &Trajectory, known: &Known<'_>) -> Worst {
    let first = &new.points[0];
    let Some(ego) = known.scene.filter(|_| known.moves).map(|scene| &scene.ego) else {
        return (0.0, Part::Start);
    };
    let aside = [
        first.x,
        first.y,
        wrap_angle(first.heading - ego.slip_angle),
        first.speed - max(ego.speed, 0.0),
    ];
    let near = share(aside, NEAR, Part::Start);
    let continued = known.last.filter(|last| {
        let age = new.at.since(last.at);
        new.at > last.at && age <= CONTINUED
    });
    let Some(last) = continued else {
        return near;
    };
    let planned = sample(last, new.at.since(last.at).as_secs_f32());
    let there = EgoPose {
        x: planned.x,
        y: planned.y,
        heading: planned.heading,
    }
    .seen_from(known.moved);
    let from_last = [
        first.x - there.x,
        first.y - there.y,
        wrap_angle(first.heading - there.heading),
        first.speed - planned.speed,
    ];
    let joins = share(from_last, JOINS, Part::Start);
    let restarts = share(aside, JOINS, Part::Start);
    (max(near.0, min(joins.0, restarts.0)), Part::Start)
}

/// Tests that a vehicle drives from one point to the next.
fn step(from: &TrajectoryPoint, to: &TrajectoryPoint) -> Worst {
    let turn = wrap_angle(to.heading - from.heading);
    let heading = from.heading + 0.5 * turn;
    let (sine, cosine) = (sin(heading), cos(heading));
    let (dx, dy) = (to.x - from.x, to.y - from.y);
    let way = 0.5 * (from.speed + to.speed) * TRAJECTORY_STEP_S;
    let errors = [
        cosine * dx + sine * dy - way,
        cosine * dy - sine * dx,
        turn - 0.5 * (from.curvature + to.curvature) * way,
        // The braking ends when the vehicle stands.
        if to.speed > 0.0 {
            to.speed - from.speed - 0.5 * (from.acceleration + to.acceleration) * TRAJECTORY_STEP_S
        } else {
            0.0
        },
    ];
    share(errors, STEP, Part::Step)
}

/// Tests the limits of the vehicle. A trajectory within them uses no share: hard braking is right.
fn limits(point: &TrajectoryPoint) -> Worst {
    let lateral = point.curvature * point.speed * point.speed;
    let values = [lateral, point.acceleration, point.speed];
    let (share, part) = share(values, MOST, Part::Limit);
    (if share > 1.0 { share } else { 0.0 }, part)
}

/// Tests that the trajectory stays between its present offset and that of its goal.
fn lane(new: &Trajectory, lanes: &Lanes, lane_offset: f32) -> Worst {
    let line = CentreLine::new(lanes);
    let offset = |point: &TrajectoryPoint| line.project(point.x, point.y).1;
    let first = &new.points[0];
    let now = offset(first);
    let sideward = abs(sin(first.heading - line.heading(first.x))) * first.speed;
    let centre_of = |beside: Option<f32>| 0.5 * (lanes.width + beside.unwrap_or(0.0));
    // A change that was begun goes on although the other lane has just ended.
    let [to_left, to_right] = match new.maneuver {
        Maneuver::Follow => [false, false],
        Maneuver::ChangeLeft => [true, false],
        Maneuver::ChangeRight => [false, true],
        // Also in a change to either side.
        Maneuver::Brake => [true, true],
    };
    let side = |goes: bool, to: Option<f32>| if goes { centre_of(to) } else { 0.0 };
    let left = max(max(now, lane_offset), side(to_left, lanes.left));
    let right = min(min(now, lane_offset), -side(to_right, lanes.right));
    let (left, right) = (max(left, 0.0), min(right, 0.0));
    let beyond = |point: &TrajectoryPoint| {
        let offset = offset(point);
        if offset.is_finite() {
            max(offset - left, right - offset)
        } else {
            f32::MAX
        }
    };
    let points = new.points.iter().step_by(LANE_STEP);
    let most = points.map(beyond).fold(0.0, max);
    share([most], [ASIDE + TURNS_BACK_S * sideward], Part::Lane)
}

/// Returns whether the trajectory passes through a vehicle ahead that keeps its motion.
fn passes(new: &Trajectory, object: &Object) -> bool {
    if object.x <= 0.0 || object.vx < 0.0 || object.lane != 0 {
        return false;
    }
    let wide = 0.5 * (object.width + WIDTH_M) - BESIDE;
    (LANE_STEP..new.points.len())
        .step_by(LANE_STEP)
        .any(|index| {
            let (t, point) = (index as f32 * TRAJECTORY_STEP_S, &new.points[index]);
            let way = (object.vx + 0.5 * max(object.ax, 0.0) * t) * t;
            point.x > object.x + way && abs(point.y - object.y - object.vy * t) < wide
        })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::driving::perception::Perception;
    use crate::driving::planning::Planner;
    use crate::driving::types::{ClassCode, Ego};
    use tandem_board::Instant;

    const SPEED: f32 = 25.0;

    fn scene(cycle: u32, objects: &[Object]) -> Scene {
        let at = Instant::ORIGIN + Duration::from_ms(u64::from(cycle) * 50);
        let lanes = Lanes {
            // Straight on with a vehicle ahead, else a bend.
            c: [0.1, 0.001, 2.5e-4, 0.0].map(|c| {
                if objects.is_empty() || c == 0.1 {
                    c
                } else {
                    0.0
                }
            }),
            left: Some(3.5),
            ..Lanes::alone(3.5, 80.0)
        };
        Scene {
            at,
            moment: None,
            measured: at,
            cycle,
            ego: Ego {
                speed: SPEED,
                yaw_rate: if objects.is_empty() {
                    5e-4 * SPEED
                } else {
                    0.0
                },
                ..Ego::default()
            },
            lanes: Some(lanes),
            set_speed: Some(SPEED),
            objects: objects.iter().copied().collect(),
            ..Perception::new().scene().clone()
        }
    }

    fn leader(x: f32) -> Object {
        Object {
            id: 1,
            class: ClassCode::Car,
            x,
            y: 0.1,
            vx: 15.0,
            vy: 0.0,
            ax: 0.0,
            ay: 0.0,
            length: 4.5,
            width: 1.8,
            lane: 0,
            cuts_in: false,
            approaching: 0,
        }
    }

    /// Plans 40 scenes; from the 20th on, `alter` changes the trajectory. Returns how many
    /// trajectories were followed from then on, and the finding.
    fn drive(
        objects: &[Object],
        alter: impl Fn(&mut Trajectory, &Trajectory),
    ) -> (u32, Option<Event>) {
        let (mut planner, mut check) = (Planner::new(), PlanCheck::default());
        let mut last: Option<Trajectory> = None;
        let (mut followed, mut found, mut first) = (0, None, None);
        for cycle in 0..40 {
            let scene = scene(cycle, objects);
            let mut new = planner.plan(&scene);
            if cycle >= 20 {
                let before = first.get_or_insert_with(|| new.clone());
                alter(&mut new, before);
            }
            let way = SPEED * 0.05;
            let since = last
                .as_ref()
                .map_or(0.0, |it| new.at.since(it.at).as_secs_f32());
            let turn = scene.ego.yaw_rate * since;
            let moved = EgoPose {
                x: way * since / 0.05,
                y: 0.5 * turn * way * since / 0.05,
                heading: turn,
            };
            let known = Known {
                scene: Some(&scene),
                moves: true,
                last: last.as_ref(),
                moved,
            };
            let (is_right, event) = check.check(&new, &known, false);
            assert!(is_right || cycle >= 20, "{cycle}: {event:?}");
            followed += u32::from(is_right && cycle >= 20);
            found = found.or(event.filter(|it| matches!(it, Event::WrongTrajectory { .. })));
            if is_right {
                last = Some(new);
            }
        }
        (followed, found)
    }

    fn aside(trajectory: &mut Trajectory, by: impl Fn(usize) -> f32) {
        for (index, point) in trajectory.points.iter_mut().enumerate() {
            point.y += by(index);
        }
    }

    /// T-RED-9: a wrong trajectory of core 2 is not followed, and the part that is wrong is named.
    #[test]
    fn a_wrong_trajectory_is_not_followed() {
        type Alter = fn(&mut Trajectory, &Trajectory);
        let faults: [(Part, Alter); 7] = [
            (Part::Start, |it, _| aside(it, |_| 0.5)),
            (Part::Start, |it, _| it.points[0].x = f32::NAN),
            (Part::Step, |it, _| {
                aside(it, |i| if i > 20 { 0.3 } else { 0.0 })
            }),
            (Part::Step, |it, _| {
                it.points.iter_mut().for_each(|p| p.curvature = 0.012)
            }),
            (Part::Step, |it, _| it.points[7].acceleration = -30.0),
            (Part::Lane, |it, _| {
                for point in &mut it.points {
                    // A circle that leaves the lane to the right.
                    let way = point.x;
                    point.y = -2e-3 * way * way;
                    point.heading = -4e-3 * way;
                    point.curvature = -4e-3;
                }
            }),
            (Part::Start, |it, first| {
                it.points = first.points.map(|point| TrajectoryPoint {
                    x: point.x + 3.0,
                    ..point
                })
            }),
        ];
        for (index, (part, fault)) in faults.into_iter().enumerate() {
            let (followed, found) = drive(&[], fault);
            assert_eq!(followed, 0, "{index}");
            let what = match found {
                Some(Event::WrongTrajectory { what, .. }) => what,
                other => panic!("{index}: {other:?}"),
            };
            assert_eq!(what, part as u8, "{index}");
        }
    }

    #[test]
    fn a_bend_that_no_vehicle_drives_is_beyond_the_limits() {
        let at = |speed| TrajectoryPoint {
            curvature: 0.02,
            speed,
            ..TrajectoryPoint::default()
        };
        assert!(limits(&at(19.0)).0 < 1.0);
        assert!(limits(&at(21.0)).0 > 1.0);
    }

    /// T-RED-9: a trajectory through the vehicle ahead is not followed, unless it brakes as hard as
    /// it can.
    #[test]
    fn a_trajectory_through_a_vehicle_is_not_followed() {
        let through = |it: &mut Trajectory, _: &Trajectory| {
            for (index, point) in it.points.iter_mut().enumerate() {
                (point.x, point.speed) = (SPEED * 0.1 * index as f32, SPEED);
                (point.y, point.heading, point.curvature) = (0.1, 0.0, 0.0);
                point.acceleration = 0.0;
            }
        };
        let (followed, found) = drive(&[leader(25.0)], through);
        let what = Part::Object as u8;
        assert!(matches!(found, Some(Event::WrongTrajectory { what: it, .. }) if it == what));
        assert_eq!(followed, 0);
        let (followed, _) = drive(&[leader(25.0)], |_, _| {});
        assert_eq!(followed, 20);
    }
}
