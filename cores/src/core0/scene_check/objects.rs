//! The scene's objects ahead against the sensors' lists that core 0 hears, without tracks.
//!
//! The nearest object in each of three lanes that two sensors see must be in the scene, and the
//! scene's nearest object in the own lane must be in a list. Sensors that contradict each other
//! prove nothing against the scene.

use super::Finding;
use super::lanes::offset;
use crate::driving::control::driven_curvature;
use crate::driving::road::DEFAULT_LANE_WIDTH_M;
use crate::driving::types::{ClassCode, Object, Scene};
use crate::trace::Event;
use heapless::Vec;
use tandem_board::{Duration, Instant};
use tandem_bus::{SensorId, SensorObject};

const SENSORS: usize = SensorId::ALL.len();
/// The lanes on the right, the own one and that on the left.
const LANES: usize = 3;
const OWN_LANE: usize = 1;
/// What a finding names, as in [`Event::WrongScene`].
const PLACE: u8 = 5;
const SPEED_OF_OBJECT: u8 = 6;
const GHOST: u8 = 7;
/// The nearest objects of a list in each lane. Those behind them are hidden.
const KEPT: usize = 2;
/// A list that was measured earlier than this before the scene, or later after it, is not used.
const OLDEST: Duration = Duration::from_ms(120);
/// Objects are compared from here on, m …
const NEAREST_M: f32 = 3.0;
/// … as far as the camera sees the lane, or as far as this without a lane, m.
const WITHOUT_LANE_M: f32 = 40.0;
/// A track that no sensor sees any more may stay for 2 s up to this distance, m.
const BESIDE_M: f32 = 8.0;
/// Differences that are tolerated in addition to four standard deviations of the sensor: along and
/// across the road, m.
const PLACE_M: f32 = 1.0;
/// Up to this distance, m, the scene may have an object nearer by so much more, m: the sensors see
/// a vehicle that turns, or stands across the road, by other corners. Core 0 knows no shapes.
const CLOSE_M: f32 = 20.0;
const NEARER_M: f32 = 1.8;
/// Tolerated difference of the speed, m/s: the track follows hard braking late.
const SPEED: f32 = 2.0;
/// A sensor's object nearer to another's than this, m, is meant to be the same one.
const SAME_M: f32 = 8.0;
/// Limit of the accumulated excess over the tolerances, in tolerances.
const LIMIT: f32 = 2.0;
/// The most that one scene adds if it lacks an object, or removes: five scenes or more.
const MOST: f32 = 0.4;
/// What one scene adds for an object that no sensor sees: 1.7 s. A sound track is kept 0.8 s.
const UNSEEN: f32 = 0.06;
/// What one scene adds if most sensors contradict one: 1 s.
const CONTRADICTED: f32 = 0.1;

/// An object of a list at the time of the scene, in the vehicle's frame.
#[derive(Clone, Copy)]
struct Seen {
    sensor: usize,
    x: f32,
    y: f32,
    /// Over ground, m/s.
    vx: f32,
    /// Tolerances of x and y, m.
    tolerance: [f32; 2],
    size: [f32; 2],
    lane: Option<usize>,
    /// Another sensor sees it as well, and none sees it at another place.
    is_certain: bool,
}

impl Seen {
    fn agrees(&self, other: &Self) -> bool {
        let reach = self.tolerance[0] + other.tolerance[0] - 2.0 * PLACE_M;
        (self.x - other.x).abs() < reach && (self.y - other.y).abs() < DEFAULT_LANE_WIDTH_M
    }

    /// Returns the difference to an object of the scene as a share of the tolerance, what differs
    /// as in [`Event::WrongScene`], and its amount.
    fn difference(&self, object: &Object) -> (f32, u8, f32) {
        let (dx, dy) = (object.x - self.x, object.y - self.y);
        let dv = object.vx - self.vx;
        let nearer = self.tolerance[0] + if self.x < CLOSE_M { NEARER_M } else { 0.0 };
        let shares = [
            ((dx.abs() / nearer).max(dx / self.tolerance[0]), PLACE, dx),
            (dy.abs() / self.tolerance[1], PLACE, dy),
            (dv.abs() / SPEED, SPEED_OF_OBJECT, dv),
        ];
        // NaN is the greatest.
        let greatest = shares
            .into_iter()
            .max_by(|one, other| one.0.total_cmp(&other.0));
        greatest.unwrap_or_default()
    }

    const fn object(&self) -> Object {
        Object {
            id: u32::MAX,
            class: ClassCode::Unknown,
            x: self.x,
            y: self.y,
            vx: self.vx,
            vy: 0.0,
            ax: 0.0,
            ay: 0.0,
            length: self.size[0],
            width: self.size[1],
            lane: 0,
            cuts_in: false,
            approaching: 0,
        }
    }
}

#[derive(Default)]
struct List {
    at: Instant,
    objects: Vec<SensorObject, { KEPT * LANES }>,
}

type AllSeen = Vec<Seen, { SENSORS * KEPT * LANES }>;

/// The polynomial of the own lane's centre line, and how far it holds, m.
type View = ([f32; 4], f32);

pub(super) struct ObjectCheck {
    lists: [List; SENSORS],
    view: View,
    /// For each lane, how much the scenes lacked the nearest object.
    lacking: [f32; LANES],
    unseen: f32,
    contradicted: [f32; SENSORS],
    /// What the last scene lacks in the own lane.
    lacks: Option<Seen>,
}

/// Returns the lane of a point, if it lies ahead in one of the three lanes.
fn lane((line, range): &View, x: f32, y: f32) -> Option<usize> {
    let place = (y - offset(line, x)) / DEFAULT_LANE_WIDTH_M + 1.5;
    let is_ahead = (NEAREST_M..*range).contains(&x) && (0.0..LANES as f32).contains(&place);
    is_ahead.then_some(place as usize)
}

impl ObjectCheck {
    pub(super) fn new() -> Self {
        Self {
            lists: Default::default(),
            view: ([0.0; 4], 0.0),
            lacking: [0.0; LANES],
            unseen: 0.0,
            contradicted: [0.0; SENSORS],
            lacks: None,
        }
    }

    /// Begins the list of a sensor that was measured at `at`.
    pub(super) fn on_header(&mut self, at: Instant, sensor: SensorId) {
        self.lists[sensor.index()] = List {
            at,
            objects: Vec::new(),
        };
    }

    /// Takes an object; the nearest come first.
    pub(super) fn on_object(&mut self, sensor: SensorId, object: &SensorObject) {
        let lane_of = |it: &SensorObject| lane(&self.view, it.x, it.y);
        let Some(lane) = lane_of(object) else { return };
        let objects = &mut self.lists[sensor.index()].objects;
        if objects
            .iter()
            .filter(|it| lane_of(it) == Some(lane))
            .count()
            < KEPT
        {
            let _full = objects.push(*object);
        }
    }

    /// Compares a scene. `view`: the lane that core 0 sees. Returns the accumulated excess as a
    /// share of its limit, and what was found.
    pub(super) fn check(&mut self, scene: &Scene, view: Option<View>) -> (f32, Option<Finding>) {
        self.view = view.unwrap_or_else(|| {
            let bend = 0.5 * driven_curvature(&scene.ego);
            ([0.0, 0.0, bend, 0.0], WITHOUT_LANE_M)
        });
        let seen = self.seen(scene);
        let mut found = None;
        self.lacks = None;
        for lane in 0..LANES {
            let Some(nearest) = nearest(lane, scene, &seen) else {
                continue;
            };
            let (share, what, amount) = difference(nearest, &seen, &scene.objects);
            let sum = add(&mut self.lacking[lane], (share - 1.0).clamp(-MOST, MOST));
            found = found.or((sum >= LIMIT).then_some((what, amount)));
            if lane == OWN_LANE && share >= 1.0 {
                self.lacks = Some(*nearest);
            }
        }
        if let Some((is_seen, x)) = self.is_seen(scene, &seen) {
            let sum = add(&mut self.unseen, if is_seen { -MOST } else { UNSEEN });
            found = found.or((sum >= LIMIT).then_some((GHOST, x)));
        }
        let used = self.lacking.into_iter().fold(self.unseen, f32::max) / LIMIT;
        let finding = |(what, amount)| Finding {
            what,
            hearing: false,
            is_located: true,
            amount,
        };
        (used, found.map(finding))
    }

    /// Returns the objects of all lists at the time of the scene.
    fn seen(&mut self, scene: &Scene) -> AllSeen {
        let mut all = AllSeen::new();
        for (sensor, list) in self.lists.iter().enumerate() {
            if !self.is_fresh(sensor, scene) {
                continue;
            }
            let seconds =
                scene.at.since(list.at).as_secs_f32() - list.at.since(scene.at).as_secs_f32();
            let turn = scene.ego.yaw_rate * seconds;
            for object in &list.objects {
                let x = object.x + object.vx * seconds + turn * object.y;
                let y = object.y + object.vy * seconds - turn * object.x;
                // Cannot be full.
                let _ = all.push(Seen {
                    sensor,
                    x,
                    y,
                    vx: object.vx + scene.ego.speed,
                    tolerance: [object.x_deviation, object.y_deviation]
                        .map(|deviation| PLACE_M + 4.0 * deviation),
                    size: [object.length, object.width],
                    lane: lane(&self.view, x, y),
                    is_certain: false,
                });
            }
        }
        let mut judged = 0_u8;
        for index in 0..all.len() {
            let one = all[index];
            let (agree, contradict) = witnesses(&one, &all);
            all[index].is_certain = agree > 0 && contradict == 0;
            let bit = 1 << one.sensor;
            if one.lane == Some(OWN_LANE) && judged & bit == 0 {
                judged |= bit;
                let by = if contradict > agree {
                    CONTRADICTED
                } else {
                    -MOST
                };
                add(&mut self.contradicted[one.sensor], by);
            }
        }
        all
    }

    /// Returns the event of a sensor that most others contradict, once.
    pub(super) fn contradiction(&mut self) -> Option<Event> {
        let sensor = self.contradicted.iter().position(|sum| *sum >= LIMIT)?;
        self.contradicted[sensor] = f32::NEG_INFINITY;
        Some(Event::SensorContradicted {
            sensor: sensor as u8,
        })
    }

    /// Returns whether a sensor's list is of the scene's time, and the scene does not miss it.
    fn is_fresh(&self, sensor: usize, scene: &Scene) -> bool {
        let at = self.lists[sensor].at;
        let apart = scene.at.since(at).max(at.since(scene.at));
        apart < OLDEST && scene.missing & (1 << sensor) == 0
    }

    /// Returns whether a sensor sees the scene's nearest object in the own lane, and its distance.
    fn is_seen(&self, scene: &Scene, seen: &[Seen]) -> Option<(bool, f32)> {
        let sensors = [SensorId::RadarFront, SensorId::CameraFront];
        if !sensors.iter().all(|it| self.is_fresh(it.index(), scene)) {
            return None;
        }
        let mut objects = scene.objects.iter();
        let object = objects.find(|it| lane(&self.view, it.x, it.y) == Some(OWN_LANE))?;
        let is_seen = object.x < BESIDE_M || seen.iter().any(|it| it.difference(object).0 < 2.0);
        Some((is_seen, object.x))
    }

    /// Adds the object that the scene lacks.
    pub(super) fn correct(&self, scene: &mut Scene) {
        if let Some(lacks) = &self.lacks {
            if scene.objects.is_full() {
                scene.objects.pop();
            }
            let _fits = scene.objects.push(lacks.object());
        }
    }
}

/// Adds to a sum within its limits; returns it.
fn add(sum: &mut f32, by: f32) -> f32 {
    if *sum >= 0.0 {
        *sum = (*sum + by).clamp(0.0, LIMIT);
    }
    *sum
}

/// Returns how many other sensors see this object, and how many see it at another place.
fn witnesses(one: &Seen, seen: &[Seen]) -> (u8, u8) {
    let apart = |it: &&Seen| (it.x - one.x).abs();
    let others = (0..SENSORS).filter(|sensor| *sensor != one.sensor);
    let nearest = others.filter_map(|sensor| {
        let near = seen.iter().filter(|it| it.sensor == sensor);
        near.min_by(|a, b| apart(a).total_cmp(&apart(b)))
    });
    nearest.fold((0, 0), |(agree, contradict), it| {
        let agrees = one.agrees(it);
        let contradicts = !agrees && apart(&it) < SAME_M;
        (agree + u8::from(agrees), contradict + u8::from(contradicts))
    })
}

/// Returns the nearest certain object in a lane, as the most precise sensor has measured it.
fn nearest<'a>(lane: usize, scene: &Scene, seen: &'a [Seen]) -> Option<&'a Seen> {
    let farthest = scene.objects.last().filter(|_| scene.objects.is_full());
    let certain = seen.iter().filter(|it| it.is_certain);
    let in_lane = certain
        .clone()
        .filter(|it| it.lane == Some(lane) && farthest.is_none_or(|last| it.x < last.x));
    let nearest = in_lane.min_by(|a, b| a.x.total_cmp(&b.x))?;
    let alike = certain.filter(|it| it.agrees(nearest));
    alike.min_by(|a, b| a.tolerance[0].total_cmp(&b.tolerance[0]))
}

/// Returns the least difference of an object of the scene to what the precise sensors have measured
/// of `nearest`.
fn difference(nearest: &Seen, seen: &[Seen], objects: &[Object]) -> (f32, u8, f32) {
    let precise = seen.iter().filter(|it| {
        it.is_certain && it.agrees(nearest) && it.tolerance[0] <= 1.5 * nearest.tolerance[0]
    });
    let differences = precise.flat_map(|seen| objects.iter().map(|it| seen.difference(it)));
    let least = differences.min_by(|one, other| one.0.total_cmp(&other.0));
    // NaN differs.
    let least = least.filter(|it| it.0.is_finite());
    least.unwrap_or((f32::MAX, PLACE, nearest.x))
}
