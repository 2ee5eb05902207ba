//! Radars and the camera's objects: field of view, occlusion, missed detections, noise.

use tandem_bus::{SensorId, SensorObject};

use super::{EgoTruth, Noise};
use crate::geometry::{Pose, Vec2, wrap_angle};
use crate::traffic::RoadUser;

/// Largest number of objects in a list; the nearest ones are kept.
const LIST_LEN: usize = 20;
/// An object is seen if at least this share of its angular extent is in the field of view and not
/// covered by nearer objects.
const SEEN_SHARE: f64 = 0.25;
/// Probability of detection up to 80 percent of the range; at the full range it is half of this.
const DETECTION: f64 = 0.985;

/// Part of a field of view: up to `range` m within `half_angle` rad to either side.
struct Lobe {
    range: f64,
    half_angle: f64,
}

/// Standard deviations of a sensor's errors.
struct Accuracy {
    /// Error of the distance, m, and its growth with distance.
    range: f64,
    range_growth: f64,
    /// rad
    angle: f64,
    /// Speed along the line of sight and across it, m/s.
    radial_speed: f64,
    tangential_speed: f64,
    /// m
    size: f64,
}

struct Model {
    /// In the vehicle frame.
    mount: Pose,
    lobes: &'static [Lobe],
    accuracy: Accuracy,
    /// Whether the sensor reports an object's class.
    classifies: bool,
}

/// The edges of an empty interval of directions.
const NOWHERE: (f64, f64) = (f64::INFINITY, f64::NEG_INFINITY);
const DEGREE: f64 = std::f64::consts::PI / 180.0;

const fn lobe(range: f64, degrees: f64) -> Lobe {
    let half_angle = degrees * DEGREE;
    Lobe { range, half_angle }
}

/// Long range radar: a narrow far lobe and a wide near one.
const FRONT_RADAR: &[Lobe] = &[lobe(250.0, 9.0), lobe(80.0, 45.0)];
const CORNER_RADAR: &[Lobe] = &[lobe(90.0, 75.0)];
const CAMERA: &[Lobe] = &[lobe(120.0, 26.0), lobe(60.0, 50.0)];

const FRONT_RADAR_ACCURACY: Accuracy = Accuracy {
    range: 0.15,
    range_growth: 0.000_5,
    angle: 0.2 * DEGREE,
    radial_speed: 0.1,
    tangential_speed: 0.6,
    size: 0.3,
};
const CORNER_RADAR_ACCURACY: Accuracy = Accuracy {
    range: 0.2,
    range_growth: 0.001,
    angle: 0.6 * DEGREE,
    radial_speed: 0.15,
    tangential_speed: 0.7,
    size: 0.35,
};
/// A camera measures directions well and distances badly.
const CAMERA_ACCURACY: Accuracy = Accuracy {
    range: 0.2,
    range_growth: 0.02,
    angle: 0.1 * DEGREE,
    radial_speed: 0.8,
    tangential_speed: 0.4,
    size: 0.15,
};

fn model(sensor: SensorId) -> Model {
    let (lobes, accuracy) = match sensor {
        SensorId::RadarFront => (FRONT_RADAR, FRONT_RADAR_ACCURACY),
        SensorId::CameraFront => (CAMERA, CAMERA_ACCURACY),
        _ => (CORNER_RADAR, CORNER_RADAR_ACCURACY),
    };
    let (x, y, degrees) = match sensor {
        SensorId::RadarFront => (2.2, 0.0, 0.0),
        SensorId::RadarFrontLeft => (2.0, 0.7, 45.0),
        SensorId::RadarFrontRight => (2.0, -0.7, -45.0),
        SensorId::RadarRearLeft => (-2.0, 0.7, 135.0),
        SensorId::RadarRearRight => (-2.0, -0.7, -135.0),
        SensorId::CameraFront => (0.6, 0.0, 0.0),
    };
    Model {
        mount: Pose {
            position: Vec2::new(x, y),
            yaw: degrees * DEGREE,
        },
        lobes,
        accuracy,
        classifies: sensor == SensorId::CameraFront,
    }
}

/// Directions of the right and the left edge of a vehicle, rad, in the frame of the sensor.
fn edges(centre: Vec2, corners: &[Vec2; 4]) -> (f64, f64) {
    let middle = centre.angle();
    // In front of the sensor the sides decide which corners are the edges.
    let side = |corner: &Vec2| centre.cross(*corner) / centre.dot(*corner);
    let is_in_front = corners.iter().all(|corner| centre.dot(*corner) > 0.0);
    let by_side = |a: &&Vec2, b: &&Vec2| side(a).total_cmp(&side(b));
    let ends = [
        corners.iter().min_by(by_side),
        corners.iter().max_by(by_side),
    ];
    let ends = ends.iter().flatten().copied().filter(|_| is_in_front);
    let all = corners.iter().filter(|_| !is_in_front);
    let offsets = ends
        .chain(all)
        .map(|corner| wrap_angle(corner.angle() - middle));
    let (right, left) = offsets.fold((0.0_f64, 0.0_f64), |(right, left), offset| {
        (right.min(offset), left.max(offset))
    });
    (middle + right, middle + left)
}

/// A vehicle as one sensor sees it.
struct Sight {
    index: usize,
    centre: Vec2,
    corners: [Vec2; 4],
    /// Whether a part of it is in the field of view, or nearly.
    in_view: bool,
    /// Square of the distance of the nearest corner, m².
    near: f64,
    /// Directions of its right and its left edge, rad.
    edges: (f64, f64),
}

/// One sensor that makes object lists.
pub(super) struct Detector {
    model: Model,
    /// Range and slope of the sides of each lobe, slightly enlarged.
    in_view: [(f64, f64); 2],
    noise: Noise,
    sights: Vec<Sight>,
    /// Directions that nearer objects cover: disjoint intervals.
    covered: Vec<(f64, f64)>,
    list: Vec<SensorObject>,
}

impl Detector {
    pub(super) fn new(sensor: SensorId, seed: u64) -> Self {
        let model = model(sensor);
        let mut in_view = [(0.0, 0.0); 2];
        for (wide, lobe) in in_view.iter_mut().zip(model.lobes) {
            *wide = (lobe.range * 1.001, lobe.half_angle.tan() * 1.001);
        }
        Self {
            model,
            in_view,
            noise: Noise::new(seed, sensor.index() as u64),
            sights: Vec::new(),
            covered: Vec::new(),
            list: Vec::with_capacity(LIST_LEN),
        }
    }

    /// Returns the object list at this moment, nearest first.
    pub(super) fn measure(&mut self, ego: &EgoTruth, vehicles: &[RoadUser]) -> &[SensorObject] {
        self.list.clear();
        let origin = Pose {
            position: ego.pose.to_world(self.model.mount.position),
            yaw: ego.pose.yaw + self.model.mount.yaw,
        };
        self.look(origin, vehicles);
        self.leave_out_aside();
        self.tell(origin, ego, vehicles)
    }

    /// Returns the list of the objects that are not hidden.
    fn tell(&mut self, origin: Pose, ego: &EgoTruth, vehicles: &[RoadUser]) -> &[SensorObject] {
        self.sights.sort_by(|a, b| a.near.total_cmp(&b.near));
        self.covered.clear();
        for sight in 0..self.sights.len() {
            let (index, edges) = (self.sights[sight].index, self.sights[sight].edges);
            let view = self.view(&self.sights[sight]);
            self.cover(edges);
            let Some(view) = view.filter(|_| self.list.len() < LIST_LEN) else {
                continue;
            };
            if let Some(object) = self.detect(origin, ego, &vehicles[index], view) {
                let index = self.list.len() as u8;
                self.list.push(SensorObject { index, ..object });
            }
        }
        &self.list
    }

    /// Collects the surrounding objects. Those outside the field of view have no edges yet.
    fn look(&mut self, origin: Pose, vehicles: &[RoadUser]) {
        let reach = self
            .model
            .lobes
            .iter()
            .map(|lobe| lobe.range)
            .fold(0.0, f64::max);
        self.sights.clear();
        let frame = origin.frame();
        for (index, vehicle) in vehicles.iter().enumerate().filter(|(_, v)| v.is_present()) {
            let footprint = &vehicle.participant.footprint;
            let centre = frame.to_local(footprint.pose.position);
            let farthest = reach + footprint.length;
            // Compares squares first: this excludes most of the others without a square root.
            if centre.dot(centre) > farthest * farthest * 1.001 || centre.norm() > farthest {
                continue;
            }
            let corners = footprint.corners_along(vehicle.frame.forward());
            let corners = corners.map(|corner| frame.to_local(corner));
            let near = corners.map(|corner| corner.dot(corner));
            let in_view = self.in_view.iter().any(|(range, slope)| {
                centre.dot(centre) < range * range
                    && corners.iter().any(|it| it.x > 0.0)
                    && corners.iter().any(|it| it.y <= slope * it.x)
                    && corners.iter().any(|it| -it.y <= slope * it.x)
            });
            self.sights.push(Sight {
                index,
                in_view,
                near: near.into_iter().fold(f64::INFINITY, f64::min),
                edges: if in_view {
                    edges(centre, &corners)
                } else {
                    NOWHERE
                },
                centre,
                corners,
            });
        }
    }

    /// Removes objects that cannot hide anything: those to the right or to the left of all that is
    /// seen of the objects in the field of view. The others get their edges.
    fn leave_out_aside(&mut self) {
        let widest = { self.model.lobes.iter() }.map(|lobe| lobe.half_angle);
        let widest = widest.fold(0.0, f64::max);
        let (right, left) = { self.sights.iter() }.fold(NOWHERE, |(right, left), sight| {
            let (low, high) = (sight.edges.0.max(-widest), sight.edges.1.min(widest));
            (right.min(low), left.max(high))
        });
        let is_empty = right > left;
        let (right, left) = (Vec2::from_angle(right), Vec2::from_angle(left));
        self.sights.retain_mut(|sight| {
            if sight.in_view {
                return true;
            }
            // Right and left exist, as the field of view is less than half a turn wide.
            let is_aside = sight.corners.iter().all(|it| right.cross(*it) < -1e-6)
                || sight.corners.iter().all(|it| left.cross(*it) > 1e-6);
            if is_empty || is_aside {
                return false;
            }
            sight.edges = edges(sight.centre, &sight.corners);
            true
        });
    }

    /// Returns the range of the lobes that see this object, m, and how far beside all of them its
    /// centre is, rad; `None` if no lobe sees it.
    fn view(&self, sight: &Sight) -> Option<(f64, f64)> {
        let (distance, angle) = (sight.centre.norm(), sight.centre.angle());
        let sees = |lobe: &&Lobe| {
            distance < lobe.range && self.seen_share(sight.edges, lobe.half_angle) >= SEEN_SHARE
        };
        let beside = |lobe: &Lobe| (angle.abs() - lobe.half_angle).max(0.0);
        let seen = { self.model.lobes.iter() }.filter(sees);
        seen.map(|lobe| (lobe.range, beside(lobe)))
            .reduce(|a, b| (a.0.max(b.0), a.1.min(b.1)))
    }

    /// Returns the share of these directions that is up to `half_angle` aside and not covered.
    fn seen_share(&self, (low, high): (f64, f64), half_angle: f64) -> f64 {
        let high = high.max(low + 1e-6);
        let (right, left) = (low.max(-half_angle), high.min(half_angle));
        let covered: f64 = { self.covered.iter() }
            .map(|(from, to)| (to.min(left) - from.max(right)).max(0.0))
            .sum();
        (left - right - covered) / (high - low)
    }

    /// Adds directions; overlapping intervals are merged.
    fn cover(&mut self, (mut low, mut high): (f64, f64)) {
        self.covered.retain(|(from, to)| {
            let overlaps = *from <= high && low <= *to;
            if overlaps {
                (low, high) = (low.min(*from), high.max(*to));
            }
            !overlaps
        });
        self.covered.push((low, high));
    }

    /// Returns the detection of one vehicle that is seen, if it is not missed. The part that is in
    /// the field of view tells where a centre beside it is: along the vehicle, the error grows by
    /// that distance, up to a quarter of its length.
    fn detect(
        &mut self,
        origin: Pose,
        ego: &EgoTruth,
        vehicle: &RoadUser,
        (range, beside): (f64, f64),
    ) -> Option<SensorObject> {
        let Model {
            mount,
            accuracy,
            classifies,
            ..
        } = &self.model;
        let footprint = &vehicle.participant.footprint;
        let local = origin.to_local(footprint.pose.position);
        let (distance, angle) = (local.norm(), local.angle());
        let fading = ((distance / range - 0.8) / 0.2).max(0.0);
        if !self.noise.chance(DETECTION * (1.0 - 0.5 * fading)) {
            return None;
        }
        let range_deviation = accuracy.range + accuracy.range_growth * distance;
        let measured = distance + self.noise.normal(range_deviation);
        let direction = angle + self.noise.normal(accuracy.angle);
        let hidden = (beside * distance).min(0.25 * footprint.length);
        let forward = ego.pose.unrotate(vehicle.frame.forward());
        let mut position = mount.to_world(Vec2::from_angle(direction) * measured);
        if hidden > 0.0 {
            position = position + forward * self.noise.normal(hidden);
        }

        let over_ground = vehicle.frame.forward() * vehicle.participant.speed;
        let relative = ego.pose.unrotate(over_ground - ego.velocity());
        let sight = Vec2::from_angle(angle + mount.yaw);
        let velocity = relative
            + sight * self.noise.normal(accuracy.radial_speed)
            + sight.left() * self.noise.normal(accuracy.tangential_speed);

        let (cos, sin) = (sight.x.abs(), sight.y.abs());
        let across = accuracy.angle * distance;
        let deviation = |cos: f64, sin: f64, forward: f64| {
            (range_deviation * cos)
                .hypot(across * sin)
                .hypot(hidden * forward) as f32
        };
        let class = if *classifies {
            vehicle.class
        } else {
            Default::default()
        };
        Some(SensorObject {
            index: 0,
            class,
            x: position.x as f32,
            y: position.y as f32,
            vx: velocity.x as f32,
            vy: velocity.y as f32,
            length: (footprint.length + self.noise.normal(accuracy.size)).max(0.1) as f32,
            width: (footprint.width + self.noise.normal(accuracy.size)).max(0.1) as f32,
            x_deviation: deviation(cos, sin, forward.x),
            y_deviation: deviation(sin, cos, forward.y),
        })
    }
}

#[cfg(test)]
mod tests {
    use chacha20::rand_core::Rng;

    use super::*;
    use crate::Scenario;
    use crate::commonroad::{Class, Obstacle, TimedState};
    use crate::traffic::{Participant, Traffic};

    /// The lists are the same whether objects to the side are left out or all objects are used.
    #[test]
    fn what_is_aside_hides_nothing() {
        let road = Scenario::load("free-lane").unwrap().road;
        let mut noise = Noise::new(1, 99);
        let mut random = |from: f64, to: f64| {
            from + (to - from) * (noise.0.next_u32() as f64 / f64::from(u32::MAX))
        };
        let (mut reported, mut left_out) = (0, 0);
        for world in 0..60 {
            let reach = [12.0, 40.0, 120.0][world % 3];
            let standing = |id| Obstacle {
                id,
                class: Class::Car,
                is_static: true,
                length: random(0.5, 15.0),
                width: random(0.5, 3.0),
                states: vec![TimedState {
                    t: 0.0,
                    position: Vec2::new(random(-reach, reach), random(-reach, reach)),
                    yaw: random(-3.0, 3.0),
                    speed: None,
                }],
            };
            let obstacles: Vec<Obstacle> = (0..30).map(standing).collect();
            let ego = EgoTruth::default();
            let body = obstacles[0].length;
            let footprint = crate::geometry::Footprint {
                pose: ego.pose,
                length: body,
                width: 1.0,
            };
            let ego_seen = Participant {
                footprint,
                speed: 0.0,
                acceleration: 0.0,
            };
            let traffic = Traffic::new(road.clone(), obstacles.into(), &ego_seen);
            for sensor in SensorId::ALL {
                let [mut one, mut all] = [7, 7].map(|seed| Detector::new(sensor, seed));
                let expected = {
                    let mount = all.model.mount;
                    all.look(mount, traffic.vehicles());
                    for sight in &mut all.sights {
                        sight.edges = edges(sight.centre, &sight.corners);
                    }
                    all.tell(mount, &ego, traffic.vehicles()).to_vec()
                };
                assert_eq!(
                    one.measure(&ego, traffic.vehicles()),
                    expected,
                    "{sensor:?}"
                );
                reported += expected.len();
                left_out += all.sights.len() - one.sights.len();
            }
        }
        assert!(reported > 500 && left_out > 2_000, "{reported} {left_out}");
    }
}
