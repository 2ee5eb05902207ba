//! One scenario, driven by both systems in virtual time.

use std::cell::RefCell;
use std::path::Path;
use std::rc::Rc;

use serde::Serialize;
use tandem_board::{Duration, Instant, SystemId};
use tandem_board_sim::{Config, SimPair};
use tandem_processes::world_record;
use tandem_record::verdict::figures::of_drive;
use tandem_record::verdict::{Finding, Rule};
use tandem_sim::drive::poller;
use tandem_vehicle::geometry::Vec2;
use tandem_vehicle::road::{Frenet, Road, RoadLane};
use tandem_vehicle::{Scenario, ScenarioError, World, WorldMetrics};

use super::solution::Track;
use crate::args::JudgeArgs;

/// Intervals between points in the picture: of the ego's path, and of the road, m.
const PATH_STEP: Duration = Duration::from_ms(200);
const ROAD_STEP_M: f64 = 4.0;
/// Distance around the path up to which the picture shows the road, m.
const ROAD_AROUND_M: f64 = 40.0;
/// A drive ends if no control frame was accepted by this time.
const GIVE_UP: Duration = Duration::from_ms(15_000);

/// A vehicle slower than this is standing, m/s.
const STANDING: f64 = 0.1;
/// A standing vehicle that is this close to the end of the domain has stopped because of it, m.
const STOPPED_BEFORE_M: f64 = 50.0;

/// The verdict on a scenario.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub(crate) enum Verdict {
    /// It was driven to the end of the requested time.
    Driven,
    /// The vehicle stopped because the end of its operational design domain was ahead.
    Stopped,
    /// The scenario was not started.
    Refused,
}

/// The judgement of one file. Scripts rely on the names.
#[derive(Clone, Debug, Serialize)]
pub(crate) struct Judgement {
    /// Name of the file in its folder.
    pub(crate) file: String,
    pub(crate) verdict: Verdict,
    /// Reason why it was refused or stopped; empty if driven.
    pub(crate) reason: String,
    /// Whether the ego touched another vehicle.
    pub(crate) collision: bool,
    /// Whether the ego caused one of the collisions.
    pub(crate) collision_by_ego: bool,
    /// Whether the ego was hit while it stood.
    pub(crate) hit_while_standing: bool,
    /// Largest distance of its centre from all lanes of its direction, m.
    pub(crate) excursion_m: f64,
    /// Whether a goal of the file was reached in time; `null` if the file has none.
    pub(crate) goal_reached: Option<bool>,
    /// The smallest distance to a goal during its time interval, if none was reached; else empty.
    pub(crate) goal_missed: String,
    /// Time driven outside the operational design domain, s.
    pub(crate) outside_domain_s: f64,
    /// Times of the function's first takeover request, and of its automatic safe stop, s.
    pub(crate) takeover_asked_s: Option<f64>,
    pub(crate) safe_stop_s: Option<f64>,
    /// Time on lanes of the other direction, s.
    pub(crate) wrong_way_s: f64,
    /// Time for which it stood although nothing ahead required it, s.
    pub(crate) standing_s: f64,
    pub(crate) lateral_error_max_m: f64,
    pub(crate) brake_max: f64,
    /// Reason why it braked with more than 4 m/s²; empty if it did not.
    pub(crate) brake_reason: String,
    /// Largest jerk over 100 ms, m/s³.
    pub(crate) jerk_max: f64,
    /// `brake_max` and `jerk_max` outside emergencies (situations that need more than 3 m/s²).
    pub(crate) calm_brake_max: f64,
    pub(crate) calm_jerk_max: f64,
    pub(crate) lat_accel_max: f64,
    pub(crate) lane_changes: u32,
    /// Scenario time driven, s, and distance driven, m.
    pub(crate) driven_s: f64,
    pub(crate) distance_m: f64,
    /// The rules of the verdict that the drive broke.
    pub(crate) findings: Vec<Finding>,
    /// The parts of the file that are not used.
    pub(crate) warnings: Vec<String>,
    #[serde(skip)]
    pub(crate) picture: Picture,
    /// The drive as a CommonRoad solution, if one was requested.
    #[serde(skip)]
    pub(crate) solution: Option<String>,
}

/// The content of the page's picture of a drive, m.
#[derive(Clone, Debug, Default)]
pub(crate) struct Picture {
    /// Left and right borders of lanes.
    pub(crate) lanes: Vec<[Vec<Vec2>; 2]>,
    pub(crate) path: Vec<Vec2>,
    /// The other vehicles at the end, as corners.
    pub(crate) others: Vec<[Vec2; 4]>,
    pub(crate) hit_at: Option<Vec2>,
}

/// Drives the file of the folder, and judges the drive.
pub(crate) fn judge(args: &JudgeArgs, file: &str) -> Judgement {
    let scenario = args.folder.as_deref().unwrap_or(Path::new("")).join(file);
    judge_scenario(args, file, Scenario::read(&scenario))
}

/// Drives this scenario, and judges the drive; a scenario that could not be read is refused.
pub(super) fn judge_scenario(
    args: &JudgeArgs,
    file: &str,
    scenario: Result<Scenario, ScenarioError>,
) -> Judgement {
    let scenario = match scenario {
        Ok(scenario) => scenario,
        Err(error) => return refused(file, error.to_string()),
    };
    if let Some(reason) = scenario.outside_domain() {
        return refused(
            file,
            format!("outside the operational design domain: {reason}"),
        );
    }
    let seed = args.seed;
    let world = World::new(&scenario, tandem_vehicle::WorldConfig { seed });
    let problem = scenario.planning_problem();
    let track = args.solutions.as_ref().map(|_| Track::new(problem.step_s));
    let (world, mut picture, track) = drive(world, args.duration, seed, track);
    let world = world.borrow();
    picture.lanes = lanes(world.road(), &picture.path);
    let now = world.snapshot();
    let corners = |v: &tandem_vehicle::VehicleSnapshot| v.footprint().corners();
    picture.others = now.vehicles.iter().map(corners).collect();
    let metrics = world.metrics();
    let exit = world.road().domain_end(now.lane, now.station);
    let (verdict, reason) = match exit {
        Some((distance, exit)) if now.speed < STANDING && distance < STOPPED_BEFORE_M => {
            (Verdict::Stopped, format!("{exit} {distance:.0} m ahead"))
        }
        _ => (Verdict::Driven, String::new()),
    };
    let has_goal = !scenario.goals().is_empty();
    let missed = match (metrics.goal_reached_s, metrics.goal_nearest) {
        (None, Some(it)) => format!(
            "goal missed by {:.1} m at {:.1} s with {:.1} m/s",
            it.distance_m, it.at_s, it.speed
        ),
        _ => String::new(),
    };
    let mut warnings = scenario.warnings().to_vec();
    let until_s = metrics.goal_reached_s.unwrap_or(now.time_s);
    let solution = track.map(|track| track.solution(scenario.name(), problem, until_s));
    let solution = solution.and_then(|it| it.map_err(|why| warnings.push(why)).ok());
    Judgement {
        verdict,
        reason,
        solution,
        goal_reached: has_goal.then_some(metrics.goal_reached_s.is_some()),
        goal_missed: missed,
        driven_s: now.time_s,
        warnings,
        picture,
        ..figures(file, &metrics)
    }
}

fn refused(file: &str, reason: String) -> Judgement {
    Judgement {
        reason,
        ..figures(file, &WorldMetrics::default())
    }
}

fn figures(file: &str, metrics: &WorldMetrics) -> Judgement {
    let mut findings = of_drive(&world_record::figures(metrics));
    findings.extend(Rule::Stopped.exceeded(metrics.standing_s));
    Judgement {
        findings,
        file: file.to_owned(),
        verdict: Verdict::Refused,
        reason: String::new(),
        collision: metrics.collisions > 0,
        collision_by_ego: metrics.collisions_by_ego > 0,
        hit_while_standing: metrics.hit_while_standing > 0,
        excursion_m: metrics.excursion_max_m,
        goal_reached: None,
        goal_missed: String::new(),
        outside_domain_s: metrics.outside_domain_s,
        takeover_asked_s: metrics.takeover_asked_s,
        safe_stop_s: metrics.safe_stop_s,
        wrong_way_s: metrics.wrong_way_s,
        standing_s: metrics.standing_s,
        lateral_error_max_m: metrics.lateral_error_max_m,
        brake_max: metrics.deceleration_max,
        brake_reason: metrics.hard_braking.map_or(String::new(), |it| it.reason()),
        jerk_max: metrics.jerk_max.0,
        calm_brake_max: metrics.calm_deceleration_max,
        calm_jerk_max: metrics.calm_jerk_max,
        lat_accel_max: metrics.lateral_acceleration_max,
        lane_changes: metrics.lane_changes,
        driven_s: 0.0,
        distance_m: metrics.distance_m,
        warnings: vec![],
        picture: Picture::default(),
        solution: None,
    }
}

/// Drives with both systems in the world until `duration_s` of its time have passed, and appends to
/// the track.
fn drive(
    world: World,
    duration_s: f64,
    seed: u64,
    track: Option<Track>,
) -> (Rc<RefCell<World>>, Picture, Option<Track>) {
    let config = Config {
        seed,
        ..Config::default()
    };
    let shared = Rc::new(RefCell::new(world));
    let mut pair = SimPair::new(config, |board| poller(board, tandem_cores::Config::rt()));
    let ticked = Rc::clone(&shared);
    let track = Rc::new(RefCell::new(track));
    let appended = Rc::clone(&track);
    pair.set_world(move |tick| {
        let at = tick.at;
        let mut world = ticked.borrow_mut();
        world.run_period(at, tick, &mut |_| {});
        if let Some(track) = &mut *appended.borrow_mut() {
            track.see(world.snapshot().time_s, world.plant());
        }
    });
    for system in SystemId::ALL {
        pair.power_on(system);
    }
    let mut picture = Picture::default();
    loop {
        pair.run_for(PATH_STEP);
        // Drop the records for observers, which are not needed here.
        pair.take_trace();
        pair.take_bus_log();
        let world = shared.borrow();
        let now = world.snapshot();
        picture.path.push(now.pose.position);
        if now.collides && picture.hit_at.is_none() {
            picture.hit_at = Some(now.pose.position);
        }
        let gives_up = !now.running && pair.now() > Instant::ORIGIN + GIVE_UP;
        if now.time_s >= duration_s || gives_up {
            break;
        }
    }
    let track = track.take();
    (shared, picture, track)
}

/// Returns the borders of the lanes around the path.
fn lanes(road: &Road, path: &[Vec2]) -> Vec<[Vec<Vec2>; 2]> {
    let around = |lane: &RoadLane| {
        let stations = path.iter().step_by(5).map(|point| lane.project(*point).s);
        let (from, to) = stations.fold((f64::INFINITY, f64::NEG_INFINITY), |(from, to), s| {
            (from.min(s), to.max(s))
        });
        let mut borders = [vec![], vec![]];
        let mut s = from - ROAD_AROUND_M;
        while s < to + ROAD_AROUND_M {
            let section = lane.at(s);
            let near = |point: &&Vec2| (**point - section.centre).norm() < ROAD_AROUND_M;
            if lane.exists_at(s) && path.iter().any(|point| near(&point)) {
                for (border, side) in borders.iter_mut().zip([0.5, -0.5]) {
                    let d = side * section.width;
                    border.push(lane.point(Frenet { s, d }));
                }
            }
            s += ROAD_STEP_M;
        }
        (borders[0].len() > 1).then_some(borders)
    };
    road.lanes().iter().filter_map(around).collect()
}
