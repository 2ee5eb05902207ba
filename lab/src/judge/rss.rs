//! Responsibility-sensitive safety: whether a situation was dangerous, who broke the rules, and
//! whether the vehicle could have avoided a collision.
//!
//! S. Shalev-Shwartz, S. Shammah, A. Shashua, "On a Formal Model of Safe and Scalable Self-driving
//! Cars", arXiv:1708.06374 (2017). This is an oracle of its own: it reads where everything was in
//! the drive, and nothing of what the driving functions computed. Decision 0047 has the reasons of
//! the parameters.

use std::f64::consts::FRAC_PI_2;
use std::fmt;

use serde::Serialize;
use tandem_vehicle::geometry::{Footprint, Pose, Vec2, wrap_angle};
use tandem_vehicle::road::{LaneId, Road};

/// What a road user may do, and must do at least: m/s² and s.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Conduct {
    /// Time until it responds.
    pub(super) response_s: f64,
    /// Largest acceleration until then.
    pub(super) accel_max: f64,
    /// Least braking from then on.
    pub(super) brake_min: f64,
    /// The same of one on its correct side, whom another meets head-on.
    pub(super) brake_min_correct: f64,
    /// Largest lateral acceleration until it responds, and least lateral braking from then on.
    pub(super) lat_accel_max: f64,
    pub(super) lat_brake_min: f64,
}

/// The vehicle.
pub(super) const OWN: Conduct = Conduct {
    response_s: 0.5,
    accel_max: 2.0,
    brake_min: 6.0,
    brake_min_correct: 6.0,
    lat_accel_max: 0.2,
    lat_brake_min: 0.8,
};
/// Everybody else.
pub(super) const OTHERS: Conduct = Conduct {
    response_s: 1.0,
    accel_max: 3.5,
    brake_min: 4.0,
    brake_min_correct: 3.0,
    lat_accel_max: 0.2,
    lat_brake_min: 0.8,
};
/// The hardest braking that anybody must reckon with, m/s².
const BRAKE_MAX: f64 = 8.0;
/// The hardest braking of the vehicle. A collision that this avoids was avoidable, m/s².
const HARDEST: f64 = 8.0;
/// The lateral room for sway within a lane, m.
const SWAY_M: f64 = 0.1;
/// Others farther away than this do not matter, m.
const FAR_M: f64 = 200.0;
/// A dangerous time continues if it is interrupted for no longer than this, s.
const SAME_DANGER_S: f64 = 0.5;
/// A slower vehicle stands, m/s.
const STANDING: f64 = 0.1;
/// A road user that is faster than this against the vehicle's lane comes towards it, m/s.
const COMES: f64 = 1.0;
/// Recorded accelerations are this uncertain, m/s².
const UNCERTAIN: f64 = 0.5;

/// Returns the safe distance of one that follows another in the same direction, m: definition 1 of
/// the paper. Speeds in m/s, not negative.
pub(super) fn same_direction(rear: f64, by: &Conduct, front: f64) -> f64 {
    (covered(rear, by, by.brake_min) - front * front / (2.0 * BRAKE_MAX)).max(0.0)
}

/// Returns the safe distance of two that meet head-on, m: definition 2 of the paper. Speeds in m/s,
/// neither negative. The first is on its correct side.
pub(super) fn opposite(correct: (f64, &Conduct), wrong: (f64, &Conduct)) -> f64 {
    covered(correct.0, correct.1, correct.1.brake_min_correct)
        + covered(wrong.0, wrong.1, wrong.1.brake_min)
}

/// Returns the safe lateral distance, m: definition 6 of the paper. Each speed is that towards the
/// other, m/s; negative if it moves away.
pub(super) fn lateral(a: (f64, &Conduct), b: (f64, &Conduct)) -> f64 {
    let covered = |(towards, by): (f64, &Conduct)| {
        let later = towards + by.response_s * by.lat_accel_max;
        let responding = (towards + later) / 2.0 * by.response_s;
        responding + later * later.abs() / (2.0 * by.lat_brake_min)
    };
    SWAY_M + (covered(a) + covered(b)).max(0.0)
}

/// Returns how far one gets that accelerates until it responds and then brakes, m.
fn covered(speed: f64, by: &Conduct, brake: f64) -> f64 {
    let later = speed + by.response_s * by.accel_max;
    (speed + later) / 2.0 * by.response_s + later * later / (2.0 * brake)
}

/// A road user at one time.
#[derive(Clone, Copy, Debug)]
pub(super) struct User {
    pub(super) id: i64,
    pub(super) footprint: Footprint,
    /// m/s along its heading.
    pub(super) speed: f64,
}

/// Where everything was at one time.
#[derive(Clone, Debug)]
pub(super) struct Moment {
    /// Scenario time, s.
    pub(super) time_s: f64,
    pub(super) own: User,
    /// The vehicle's lane, and its arc length there, m.
    pub(super) lane: LaneId,
    pub(super) station: f64,
    pub(super) others: Vec<User>,
    /// A collision that the vehicle caused began here.
    pub(super) hits: bool,
}

/// Two road users in the coordinates of the vehicle's lane.
#[derive(Clone, Copy, Debug)]
struct Relation {
    /// The other is ahead.
    is_ahead: bool,
    /// Distance along and across the lane, between their outlines, m; negative if they overlap.
    gap_m: f64,
    aside_m: f64,
    /// The other's speed along the lane, m/s.
    along: f64,
    /// Their lateral speeds towards each other, m/s.
    towards: [f64; 2],
    safe_gap_m: f64,
    safe_aside_m: f64,
}

impl Relation {
    /// `None`: they are too far apart to matter.
    fn of(road: &Road, moment: &Moment, other: &User) -> Option<Self> {
        let lane = road.lane(moment.lane);
        let own = &moment.own;
        let between = other.footprint.pose.position - own.footprint.pose.position;
        if between.norm() > FAR_M {
            return None;
        }
        let forward = Vec2::from_angle(own.footprint.pose.yaw);
        let near = [moment.station, moment.station + between.dot(forward)];
        let seen = [own, other].into_iter().zip(near).map(|(user, near)| {
            let Footprint {
                pose,
                length,
                width,
            } = user.footprint;
            let place = lane.project_near(pose.position, near);
            let (sine, cosine) = wrap_angle(pose.yaw - lane.at(place.s).heading).sin_cos();
            let half = |a: f64, b: f64| (a * cosine.abs() + b * sine.abs()) / 2.0;
            let velocity = [user.speed * cosine, user.speed * sine];
            (place, [half(length, width), half(width, length)], velocity)
        });
        let [(a, a_half, a_speed), (b, b_half, b_speed)] = seen.collect::<Vec<_>>()[..] else {
            return None;
        };
        let is_ahead = b.s >= a.s;
        let side = if b.d >= a.d { 1.0 } else { -1.0 };
        let towards = [a_speed[1] * side, -b_speed[1] * side];
        let (own, along) = (a_speed[0].max(0.0), b_speed[0]);
        let safe_gap_m = match (is_ahead, along < -STANDING) {
            (true, true) => opposite((own, &OWN), (-along, &OTHERS)),
            (true, false) => same_direction(own, &OWN, along.max(0.0)),
            // One that drives away from the vehicle, behind it.
            (false, true) => 0.0,
            (false, false) => same_direction(along.max(0.0), &OTHERS, own),
        };
        Some(Self {
            is_ahead,
            gap_m: (b.s - a.s).abs() - a_half[0] - b_half[0],
            aside_m: (b.d - a.d).abs() - a_half[1] - b_half[1],
            along,
            towards,
            safe_gap_m,
            safe_aside_m: lateral((towards[0], &OWN), (towards[1], &OTHERS)),
        })
    }

    const fn is_near_aside(&self) -> bool {
        self.aside_m < self.safe_aside_m
    }

    const fn is_near_along(&self) -> bool {
        self.gap_m < self.safe_gap_m
    }

    const fn is_dangerous(&self) -> bool {
        self.is_near_along() && self.is_near_aside()
    }
}

/// Who broke a rule before a collision.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub(super) enum Broke {
    Vehicle,
    Other,
    Both,
    Nobody,
}

impl fmt::Display for Broke {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Vehicle => "the vehicle broke the rule",
            Self::Other => "the other broke the rule",
            Self::Both => "both broke the rule",
            Self::Nobody => "nobody broke the rule",
        })
    }
}

/// A collision that the vehicle caused, as RSS sees it.
#[derive(Clone, Copy, Debug, Serialize)]
pub(crate) struct Collision {
    /// Scenario time, s, and the other's id in the file.
    pub(super) at_s: f64,
    pub(super) other: i64,
    /// When the situation became dangerous, s; the distance to the other then, and the safe one, m.
    pub(super) danger_from_s: f64,
    pub(super) gap_m: f64,
    pub(super) safe_gap_m: f64,
    /// Whether braking with 8 m/s² half a second after that would have avoided it.
    pub(super) avoidable: bool,
    pub(super) broke: Broke,
}

impl fmt::Display for Collision {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let what = if self.avoidable {
            "avoidable"
        } else {
            "unavoidable"
        };
        write!(
            f,
            "{what} collision with {} at {:.2} s: dangerous from {:.2} s, {:.1} m where {:.1} m are \
             safe; {}",
            self.other, self.at_s, self.danger_from_s, self.gap_m, self.safe_gap_m, self.broke
        )
    }
}

/// The judgement of a drive.
#[derive(Clone, Debug, Default, Serialize)]
pub(crate) struct Rss {
    /// The distance to another in the way minus the safe one, where that was smallest, m; `null` if
    /// nothing was in the way.
    pub(super) margin_m: Option<f64>,
    /// When that was, s, and the other's id in the file.
    pub(super) margin_at_s: Option<f64>,
    pub(super) margin_to: Option<i64>,
    /// Time for which anything ahead was dangerously close along and across the lane, s.
    pub(super) dangerous_s: f64,
    /// The collisions that the vehicle caused.
    pub(super) collisions: Vec<Collision>,
}

impl Rss {
    /// Judges the drive whose moments these are, in the order of time.
    pub(super) fn of(moments: &[Moment], road: &Road) -> Self {
        let mut it = Self::default();
        for (index, moment) in moments.iter().enumerate() {
            let relations = { moment.others.iter() }
                .filter_map(|other| Some((other.id, Relation::of(road, moment, other)?)));
            let mut is_dangerous = false;
            // A vehicle that stands can do no more.
            let moves = moment.own.speed >= STANDING;
            let in_the_way = |it: &Relation| moves && it.is_ahead && it.is_near_aside();
            for (id, relation) in relations.filter(|(_, it)| in_the_way(it)) {
                is_dangerous |= relation.is_dangerous();
                let margin_m = relation.gap_m - relation.safe_gap_m;
                if it.margin_m.is_none_or(|least| margin_m < least) {
                    (it.margin_m, it.margin_to) = (Some(margin_m), Some(id));
                    it.margin_at_s = Some(moment.time_s);
                }
            }
            let next_s = moments
                .get(index + 1)
                .map_or(moment.time_s, |next| next.time_s);
            it.dangerous_s += if is_dangerous {
                next_s - moment.time_s
            } else {
                0.0
            };
            if moment.hits {
                let hit = nearest(moment).map(|other| collision(moments, index, other, road));
                it.collisions.extend(hit);
            }
        }
        it
    }

    /// Returns how many collisions the vehicle could have avoided.
    pub(super) fn avoidable(&self) -> usize {
        self.collisions.iter().filter(|it| it.avoidable).count()
    }
}

/// Returns whom the vehicle hits at this moment.
fn nearest(moment: &Moment) -> Option<&User> {
    let own = &moment.own.footprint;
    let apart = |other: &User| (other.footprint.pose.position - own.pose.position).norm();
    let hit = |other: &&User| own.overlaps(&other.footprint);
    let first = moment.others.iter().find(hit);
    first.or_else(|| { moment.others.iter() }.min_by(|a, b| apart(a).total_cmp(&apart(b))))
}

/// Judges the collision with this other at `moments[hit]`.
fn collision(moments: &[Moment], hit: usize, other: &User, road: &Road) -> Collision {
    let relation = |index: usize| {
        let moment: &Moment = &moments[index];
        let other = moment.others.iter().find(|it| it.id == other.id)?;
        Relation::of(road, moment, other)
    };
    let mut begin = hit;
    for index in (0..hit).rev() {
        if relation(index).is_some_and(|it| it.is_dangerous()) {
            begin = index;
        } else if moments[begin].time_s - moments[index].time_s > SAME_DANGER_S {
            break;
        }
    }
    let at_begin = relation(begin);
    // A danger that begins from the side is of whom approaches: who steers there need not.
    let before = begin.checked_sub(1).and_then(relation);
    let towards = match &at_begin {
        Some(first) if before.is_some_and(|it| !it.is_near_aside()) => {
            let [own, others] = first.towards;
            let bound = OWN.lat_accel_max * OWN.response_s;
            [own > others.max(bound), others > own]
        }
        _ => [false; 2],
    };
    // Who comes is wrong unless it is in a lane of its own direction.
    let comes = at_begin.as_ref().is_some_and(|it| it.along < -COMES);
    let comes = comes && !keeps_its_lane(road, &moments[begin], other.id);
    Collision {
        at_s: moments[hit].time_s,
        other: other.id,
        danger_from_s: moments[begin].time_s,
        gap_m: at_begin.map_or(0.0, |it| it.gap_m),
        safe_gap_m: at_begin.map_or(0.0, |it| it.safe_gap_m),
        avoidable: is_avoidable(&moments[begin..], other.id) || towards[0],
        broke: who_broke(moments, [begin, hit], (towards, comes), &relation),
    }
}

/// Returns whether the vehicle would have stood before it touched the other, or would not have
/// touched it, if it had braked along its path with [`HARDEST`] after the response time.
fn is_avoidable(moments: &[Moment], other: i64) -> bool {
    let begin_s = moments[0].time_s;
    let mut path = vec![(0.0, moments[0].own.footprint.pose)];
    for moment in &moments[1..] {
        let (way, last) = path[path.len() - 1];
        let pose = moment.own.footprint.pose;
        path.push((way + (pose.position - last.position).norm(), pose));
    }
    let (mut way, mut speed) = (0.0, moments[0].own.speed);
    for (index, pair) in moments.windows(2).enumerate() {
        let dt = pair[1].time_s - pair[0].time_s;
        if pair[1].time_s - begin_s <= OWN.response_s {
            (way, speed) = (path[index + 1].0, pair[1].own.speed);
        } else {
            let later = (speed - HARDEST * dt).max(0.0);
            // Not farther than the vehicle really got.
            way = (way + (speed + later) / 2.0 * dt).min(path[index + 1].0);
            speed = later;
        }
        if speed < STANDING {
            return true;
        }
        let pose = at(&path, way);
        let own = Footprint {
            pose,
            ..pair[1].own.footprint
        };
        let touches = |it: &User| it.id == other && own.overlaps(&it.footprint);
        if pair[1].others.iter().any(touches) {
            return false;
        }
    }
    true
}

/// Returns the pose after this way along the path.
fn at(path: &[(f64, Pose)], way: f64) -> Pose {
    let after = path.partition_point(|(so_far, _)| *so_far < way);
    path[after.min(path.len() - 1)].1
}

/// Returns whether the centre of a road user is in a lane of its own direction.
fn keeps_its_lane(road: &Road, moment: &Moment, other: i64) -> bool {
    let Some(other) = moment.others.iter().find(|it| it.id == other) else {
        return false;
    };
    let pose = other.footprint.pose;
    let (lane, place) = road.locate(pose.position, pose.yaw);
    let lane = road.lane(lane);
    let along = wrap_angle(lane.at(place.s).heading - pose.yaw).abs() < FRAC_PI_2;
    along && lane.exists_at(place.s) && place.d.abs() <= 0.5 * lane.at(place.s).width
}

/// Finds who did not respond as the paper asks, from the beginning of the danger to the collision.
/// Who steered towards the other, or came in a lane of the other direction, did not.
fn who_broke(
    moments: &[Moment],
    [begin, hit]: [usize; 2],
    ([own_steers, other_steers], comes): ([bool; 2], bool),
    relation: &dyn Fn(usize) -> Option<Relation>,
) -> Broke {
    let (Some(first), begin_s) = (relation(begin), moments[begin].time_s) else {
        return Broke::Nobody;
    };
    // Over a tenth of a second, so that a recording in steps has a rate.
    let rate = |index: usize, value: &dyn Fn(usize) -> Option<f64>| {
        let since = |from: &usize| moments[index].time_s - moments[*from].time_s >= 0.1;
        let from = (0..index).rev().find(since)?;
        Some((value(index)? - value(from)?) / (moments[index].time_s - moments[from].time_s))
    };
    let own_rate = |index| rate(index, &|at| Some(moments[at].own.speed));
    let other_rate = |index| rate(index, &|at| relation(at).map(|it| it.along));
    let mut vehicle = own_steers;
    let mut other = other_steers || comes;
    for (index, moment) in moments.iter().enumerate().take(hit + 1).skip(begin) {
        let since_s = moment.time_s - begin_s;
        let own = own_rate(index).unwrap_or(0.0);
        let stands = moment.own.speed < STANDING;
        if first.is_ahead && !stands {
            vehicle |= since_s <= OWN.response_s && own > OWN.accel_max + UNCERTAIN;
            // The rate is over a tenth of a second.
            let responds = since_s > OWN.response_s + 0.1;
            vehicle |= responds && own > -(OWN.brake_min - UNCERTAIN);
        }
        other |= other_rate(index).is_some_and(|it| it < -(BRAKE_MAX + UNCERTAIN));
    }
    match (vehicle, other) {
        (true, true) => Broke::Both,
        (true, false) => Broke::Vehicle,
        (false, true) => Broke::Other,
        (false, false) => Broke::Nobody,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::PI;
    use tandem_vehicle::Scenario;

    /// Values of a program of others, Intel's ad-rss-lib: two that meet at 100 km/h need 365.55 m,
    /// and 406.32 m if the first is on its correct side. Its parameters are 3.5, 4 and 3 m/s², and
    /// response times of 1 and 2 s.
    #[test]
    fn distances_of_head_on_traffic_are_those_of_another_program() {
        let speed = 100.0 / 3.6;
        let slow = Conduct {
            response_s: 2.0,
            ..OTHERS
        };
        let correct = opposite((speed, &OTHERS), (speed, &slow));
        assert!((correct - 406.32).abs() < 0.01, "{correct}");
        let wrong = Conduct {
            brake_min_correct: 4.0,
            ..OTHERS
        };
        let both_wrong = opposite((speed, &wrong), (speed, &slow));
        assert!((both_wrong - 365.55).abs() < 0.01, "{both_wrong}");
    }

    /// By hand, from definition 1: behind a standing vehicle 20 * 0.5 + 0.25 + 21² / 12, behind one
    /// of equal speed 25 m less, and 0 behind one that is much faster.
    #[test]
    fn the_distance_behind_another_is_that_of_the_paper() {
        let behind = |front: f64| same_direction(20.0, &OWN, front);
        assert!((behind(0.0) - 47.0).abs() < 1e-9, "{}", behind(0.0));
        assert!((behind(20.0) - 22.0).abs() < 1e-9, "{}", behind(20.0));
        assert_eq!(same_direction(0.0, &OWN, 30.0), 0.0);
    }

    /// By hand, from definition 6. Side by side: 0.1 + (0.025 + 0.00625) + (0.1 + 0.025). Towards
    /// each other at 1 m/s: 0.1 + (0.525 + 1.21 / 1.6) + (1.1 + 1.44 / 1.6). Apart: the sway.
    #[test]
    fn the_distance_aside_is_that_of_the_paper() {
        let aside = |a: f64, b: f64| lateral((a, &OWN), (b, &OTHERS));
        for (a, b, expected) in [(0.0, 0.0, 0.25625), (1.0, 1.0, 3.38125), (-2.0, -2.0, 0.1)] {
            assert!((aside(a, b) - expected).abs() < 1e-9, "{}", aside(a, b));
        }
    }

    /// A drive on the straight road of a scenario: at each 20 ms the vehicle's way and speed, and
    /// the other's way, aside, speed and direction. It hits where the outlines first overlap.
    fn drive(states: impl Iterator<Item = ([f64; 2], [f64; 4])>) -> Rss {
        steer(states.map(|([way, speed], other)| ([way, 0.0, speed, 0.0], other)))
    }

    /// The same, with the vehicle's places and headings too.
    fn steer(states: impl Iterator<Item = ([f64; 4], [f64; 4])>) -> Rss {
        let scenario = Scenario::load("parking").unwrap();
        let road = scenario.road();
        let lane = LaneId(0);
        let start = 200.0;
        let user = |id: i64, [way, aside, speed, turned]: [f64; 4]| {
            let section = road.lane(lane).at(start + way);
            let left = Vec2::from_angle(section.heading).left();
            User {
                id,
                footprint: Footprint {
                    pose: Pose {
                        position: section.centre + left * aside,
                        yaw: section.heading + turned,
                    },
                    length: 4.5,
                    width: 1.8,
                },
                speed,
            }
        };
        let mut moments: Vec<Moment> = Vec::new();
        for (step, (own, other)) in states.enumerate() {
            let station = start + own[0];
            let (own, other) = (user(0, own), user(7, other));
            let touches = own.footprint.overlaps(&other.footprint);
            let touched = moments
                .last()
                .is_some_and(|last| last.own.footprint.overlaps(&last.others[0].footprint));
            moments.push(Moment {
                time_s: step as f64 * 0.02,
                own,
                lane,
                station,
                others: vec![other],
                hits: touches && !touched,
            });
        }
        Rss::of(&moments, road)
    }

    const STEPS: u32 = 400;

    /// A broken driver that does not brake at all, behind one that stands 80 m ahead.
    #[test]
    fn a_driver_that_does_not_brake_could_have_avoided_it() {
        let rss = drive((0..STEPS).map(|step| {
            let t = f64::from(step) * 0.02;
            ([20.0 * t, 20.0], [84.5, 0.0, 0.0, 0.0])
        }));
        let [hit] = rss.collisions[..] else {
            panic!("{rss:?}")
        };
        assert!(hit.avoidable && hit.broke == Broke::Vehicle, "{hit}");
        // It is dangerous below 47 m: from 33 m on, at 1.65 s; the collision is at 4 s.
        assert!(
            (hit.danger_from_s - 1.66).abs() < 0.03 && (hit.at_s - 4.0).abs() < 0.03,
            "{hit}"
        );
        assert!(rss.margin_m.is_some_and(|it| it < -40.0), "{rss:?}");
    }

    /// The leader stands at once, 20 m ahead at 20 m/s: physics asks for 10 + 25 m.
    #[test]
    fn a_leader_that_stands_at_once_is_unavoidable_only_if_it_is_near() {
        let follow = |gap: f64| {
            drive((0..STEPS).map(move |step| {
                let t = f64::from(step) * 0.02;
                let crash = t > 2.0;
                let since = (t - 2.5).max(0.0);
                let (way, speed) = match crash {
                    false => (20.0 * t, 20.0),
                    true => {
                        let braked = since.min(2.5);
                        (
                            20.0 * t.min(2.5) + 20.0 * braked - 4.0 * braked * braked,
                            20.0 - 8.0 * braked,
                        )
                    }
                };
                let ahead = 20.0 * t.min(2.0) + gap + 4.5;
                (
                    [way, speed],
                    [ahead, 0.0, if crash { 0.0 } else { 20.0 }, 0.0],
                )
            }))
        };
        let near = follow(25.0);
        let [hit] = near.collisions[..] else {
            panic!("{near:?}")
        };
        assert!(!hit.avoidable && hit.broke == Broke::Other, "{hit}");
        assert!(follow(36.0).collisions.is_empty());
    }

    /// Another that is 10 m/s slower begins to cut in 6 m ahead, at 1.5 m/s aside. The vehicle
    /// brakes with 8 m/s² half a second later, and still hits it.
    #[test]
    fn one_that_cuts_in_too_close_breaks_the_rule() {
        let rss = drive((0..STEPS).map(|step| {
            let t = f64::from(step) * 0.02;
            let cuts_in = (1.0..3.3).contains(&t);
            let aside = 3.5 - 1.5 * (t - 1.0).clamp(0.0, 2.3);
            let since = (t - 1.5).clamp(0.0, 2.5);
            let way = 20.0 * t.min(1.5) + 20.0 * since - 4.0 * since * since;
            let other = match cuts_in {
                true => [
                    10.0 * t + 20.5,
                    aside,
                    10.0_f64.hypot(1.5),
                    -(0.15_f64.atan()),
                ],
                false => [10.0 * t + 20.5, aside, 10.0, 0.0],
            };
            ([way, 20.0 - 8.0 * since], other)
        }));
        let [hit, ..] = rss.collisions[..] else {
            panic!("{rss:?}")
        };
        assert!(!hit.avoidable && hit.broke == Broke::Other, "{hit}");
        assert!((hit.danger_from_s - 1.0).abs() < 0.03, "{hit}");
    }

    /// Both have the same speed, side by side, and the vehicle steers into the other with 1.5 m/s.
    #[test]
    fn one_that_steers_into_another_could_have_avoided_it() {
        let rss = steer((0..STEPS).map(|step| {
            let t = f64::from(step) * 0.02;
            let since = (t - 1.0).max(0.0);
            let turned = if since > 0.0 { 0.075 } else { 0.0 };
            (
                [20.0 * t, 1.5 * since, 20.0, turned],
                [20.0 * t, 3.5, 20.0, 0.0],
            )
        }));
        let [hit, ..] = rss.collisions[..] else {
            panic!("{rss:?}")
        };
        assert!(hit.avoidable && hit.broke == Broke::Vehicle, "{hit}");
    }

    /// One comes in the vehicle's lane, which brakes as the paper asks.
    #[test]
    fn one_that_comes_in_the_wrong_lane_breaks_the_rule() {
        let rss = drive((0..STEPS).map(|step| {
            let t = f64::from(step) * 0.02;
            let since = (t - 0.5).clamp(0.0, 2.5);
            let way = 20.0 * t.min(0.5) + 20.0 * since - 4.0 * since * since;
            ([way, 20.0 - 8.0 * since], [60.0 - 15.0 * t, 0.0, 15.0, PI])
        }));
        let [hit, ..] = rss.collisions[..] else {
            panic!("{rss:?}")
        };
        assert!(hit.broke == Broke::Other, "{hit}");
    }
}
