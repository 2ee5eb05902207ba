//! Converts the state of the world to entries of a recording.

use tandem_record::log::{Comfort, DriveFigures, Lane, Other, RoadPiece, Sample, VehicleRecord};
use tandem_vehicle::geometry::Vec2;
use tandem_vehicle::road::{Frenet, Road};
use tandem_vehicle::{VehicleSnapshot, World, WorldMetrics};

/// The recorded road extends from this far behind the vehicle to this far ahead of it, m.
const ROAD_BACK_M: f64 = 100.0;
const ROAD_AHEAD_M: f64 = 400.0;
const ROAD_STEP_M: f64 = 4.0;
/// Lanes farther to the side belong to other roads, m.
const ROAD_ASIDE_M: f64 = 30.0;
/// Ticks between two records of the world's state, of the other vehicles, and of the road.
const SAMPLE_TICKS: u64 = 20;
const OTHERS_TICKS: u64 = 100;
const ROAD_TICKS: u64 = 5_000;
/// The road is also recorded in the first tick of a drive, until this time, s.
const FIRST_S: f64 = 0.0015;

/// Converts the vehicle's own figures.
#[must_use]
pub fn figures(metrics: &WorldMetrics) -> DriveFigures {
    let finite = |value: f64| Some(value).filter(|value| value.is_finite());
    DriveFigures {
        collisions: metrics.collisions,
        collisions_by_ego: metrics.collisions_by_ego,
        hit_while_standing: metrics.hit_while_standing,
        excursion_max_m: metrics.excursion_max_m,
        forced_brakes: metrics.forced_brakes,
        forced_brake_max: metrics.forced_brake_max,
        wrong_way_s: metrics.wrong_way_s,
        standing_s: metrics.standing_s,
        goal_reached_s: metrics.goal_reached_s,
        outside_domain_s: metrics.outside_domain_s,
        takeover_asked_s: metrics.takeover_asked_s,
        safe_stop_s: metrics.safe_stop_s,
        lateral_error_max_m: metrics.lateral_error_max_m,
        lane_changes: metrics.lane_changes,
        lead_gap_min_m: finite(metrics.gap_min_m),
        ttc_min_s: finite(metrics.ttc_min_s),
        distance_m: metrics.distance_m,
        comfort: Comfort {
            accel_max: metrics.acceleration_max,
            brake_max: metrics.deceleration_max,
            lat_accel_max: metrics.lateral_acceleration_max,
            calm_brake_max: metrics.calm_deceleration_max,
            jerk_p99: metrics.jerk_p99,
            jerk_max: metrics.jerk_max.0,
            calm_jerk_max: metrics.calm_jerk_max,
        },
        brake_reason: metrics.hard_braking.map(|it| it.reason()),
    }
}

/// Converts the state of the world at this time, ns; `others`: with the other vehicles.
#[must_use]
pub fn sample(world: &World, at_ns: u64, others: bool) -> Sample {
    let now = world.snapshot();
    let gap = Some(now.gap).filter(|gap| gap.is_finite());
    let vehicles = now.vehicles.iter().filter(|_| others);
    Sample {
        at_ns,
        x: now.pose.position.x,
        y: now.pose.position.y,
        heading: now.pose.yaw,
        speed: now.speed,
        set_speed: Some(world.set_speed()),
        accel: now.acceleration,
        lat_accel: now.lateral_acceleration,
        lane: now.lane.0,
        lateral_error: now.lateral_offset,
        lead_gap: gap,
        closing_speed: gap.map(|_| now.speed - now.leader_speed),
        others: vehicles.map(other).collect(),
    }
}

/// Returns what is recorded of a world that runs, at this tick of a millisecond and time, ns: the
/// road and the state, each where it is due.
pub fn at_tick(world: &World, at_ns: u64, tick: u64) -> impl Iterator<Item = VehicleRecord> {
    let is_due = |ticks| tick.is_multiple_of(ticks);
    let road = is_due(ROAD_TICKS) || world.snapshot().time_s <= FIRST_S;
    let road = road.then(|| VehicleRecord::Road(road_piece(world, at_ns)));
    let state = is_due(SAMPLE_TICKS)
        .then(|| VehicleRecord::Sample(sample(world, at_ns, is_due(OTHERS_TICKS))));
    road.into_iter().chain(state)
}

/// Converts the road around the ego vehicle at this time, ns.
fn road_piece(world: &World, at_ns: u64) -> RoadPiece {
    let lanes = lanes(world.road(), world.snapshot().pose.position);
    RoadPiece { at_ns, lanes }
}

/// Converts the state of another vehicle.
fn other(vehicle: &VehicleSnapshot) -> Other {
    Other {
        x: vehicle.pose.position.x,
        y: vehicle.pose.position.y,
        heading: vehicle.pose.yaw,
        length: vehicle.length,
        width: vehicle.width,
    }
}

/// Returns the lanes around a point.
fn lanes(road: &Road, near: Vec2) -> Vec<Lane> {
    let count = ((ROAD_BACK_M + ROAD_AHEAD_M) / ROAD_STEP_M) as u32;
    let around = |lane: &tandem_vehicle::road::RoadLane| {
        let place = lane.project(near);
        let mut borders = Lane::default();
        let stations =
            (0..=count).map(|step| place.s - ROAD_BACK_M + f64::from(step) * ROAD_STEP_M);
        for s in stations.filter(|s| lane.exists_at(*s)) {
            let half = lane.at(s).width / 2.0;
            let at = |d: f64| {
                let point = lane.point(Frenet { s, d });
                // Round to a tenth of a metre, which is finer than any screen shows.
                [
                    (point.x * 10.0).round() / 10.0,
                    (point.y * 10.0).round() / 10.0,
                ]
            };
            borders.left.push(at(half));
            borders.right.push(at(-half));
        }
        (place.d.abs() <= ROAD_ASIDE_M && borders.left.len() > 1).then_some(borders)
    };
    road.lanes().iter().filter_map(around).collect()
}
