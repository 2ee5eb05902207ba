//! One scenario, driven by both systems in virtual time.

use std::cell::RefCell;
use std::collections::BTreeSet;
use std::path::Path;
use std::rc::Rc;

use serde::Serialize;
use tandem_board::{Duration, Instant, SystemId};
use tandem_board_sim::{Config, SimPair};
use tandem_processes::world_record;
use tandem_record::verdict::figures::of_drive;
use tandem_record::verdict::{Finding, Rule};
use tandem_sim::drive::poller;
use tandem_vehicle::commonroad::ProblemChoice;
use tandem_vehicle::geometry::Vec2;
use tandem_vehicle::road::{Frenet, Road, RoadLane};
use tandem_vehicle::{Scenario, ScenarioError, World, WorldMetrics};

use super::drive_log::Recording;
use super::lanelets::Lanelets;
use super::rss::{Moment, Rss, User};
use super::solution::Track;
use crate::args::{JudgeArgs, OtherTraffic};
use tandem::output::ReportFolder;

/// Intervals between points in the picture: of the ego's path, and of the road, m.
const PATH_STEP: Duration = Duration::from_ms(200);
const ROAD_STEP_M: f64 = 4.0;
/// Distance around the path up to which the picture shows the road, m.
const ROAD_AROUND_M: f64 = 40.0;
/// Interval between the moments that RSS judges, s.
const MOMENT_S: f64 = 0.02;
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
    /// Id of the planning problem; `null` if it has none, or the file cannot be read.
    pub(crate) problem: Option<i64>,
    /// Its place among the planning problems of the file, from 1, and their number.
    pub(crate) problem_number: usize,
    pub(crate) problem_count: usize,
    pub(crate) verdict: Verdict,
    /// Reason why it was refused or stopped; empty if driven.
    pub(crate) reason: String,
    /// Whether the ego touched another vehicle.
    pub(crate) collision: bool,
    /// Whether the ego caused one of the collisions.
    pub(crate) collision_by_ego: bool,
    /// Whether the ego was hit while it stood.
    pub(crate) hit_while_standing: bool,
    /// How far its farthest corner was outside of all lanes of its direction, m, and when, s.
    pub(crate) excursion_m: f64,
    pub(crate) excursion_at_s: f64,
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
    /// Where speed² over the radius of the lane was largest: that, m/s²; the speed, m/s; the
    /// radius, m; and when, s.
    pub(crate) curve: Curve,
    /// Types of the lanelets that its centre was on, as the file names them.
    pub(crate) lane_types: Vec<String>,
    /// Distance driven past the end of the map, where the road is invented, m.
    pub(crate) invented_m: f64,
    /// How many others had to brake with more than 1.5 m/s² for the ego, and the hardest of that.
    pub(crate) forced_brakes: u32,
    pub(crate) forced_brake_max: f64,
    /// Responsibility-sensitive safety.
    pub(crate) rss: Rss,
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

/// The sharpest curve for its speed. Of the lane, not of the path that was driven.
#[derive(Clone, Copy, Debug, Default, Serialize)]
pub(crate) struct Curve {
    pub(crate) lat_accel: f64,
    pub(crate) speed: f64,
    pub(crate) radius_m: Option<f64>,
    pub(crate) at_s: f64,
}

/// The content of the page's picture of a drive, m.
#[derive(Clone, Debug, Default)]
pub(crate) struct Picture {
    /// Left and right borders of lanes.
    pub(crate) lanes: Vec<[Vec<Vec2>; 2]>,
    pub(crate) path: Vec<Vec2>,
    /// The ego and the others at the worst moment, as corners.
    pub(crate) own: Option<[Vec2; 4]>,
    pub(crate) others: Vec<[Vec2; 4]>,
    /// That moment, in words.
    pub(crate) worst: String,
    pub(crate) hit_at: Option<Vec2>,
}

/// Drives each planning problem of the file in the folder, or the chosen one, and judges each.
/// With `out`, also writes the report of the drive.
///
/// # Errors
/// If the report cannot be written.
pub(crate) fn judge(
    args: &JudgeArgs,
    file: &str,
    out: Option<&ReportFolder>,
) -> anyhow::Result<Vec<Judgement>> {
    let path = args.folder.as_deref().unwrap_or(Path::new("")).join(file);
    let lanelets = Lanelets::read(&path);
    let ids = Scenario::problem_ids(&path);
    let count = ids.len().max(1);
    let is_chosen = |number: &usize| {
        let chosen = args.problem;
        chosen.is_none() || ids.iter().position(|id| *id == chosen) == Some(number - 1)
    };
    let judge = |number: usize| {
        let scenario = Scenario::read_problem(&path, ProblemChoice::Number(number));
        Ok(Judgement {
            problem: ids.get(number - 1).copied().flatten(),
            problem_number: number,
            problem_count: count,
            ..judge_scenario(args, file, scenario, &lanelets, out)?
        })
    };
    (1..=count).filter(is_chosen).map(judge).collect()
}

/// Drives this scenario, and judges the drive; a scenario that could not be read is refused.
///
/// # Errors
/// If the report cannot be written.
pub(super) fn judge_scenario(
    args: &JudgeArgs,
    file: &str,
    scenario: Result<Scenario, ScenarioError>,
    lanelets: &Lanelets,
    out: Option<&ReportFolder>,
) -> anyhow::Result<Judgement> {
    let scenario = match scenario {
        Ok(scenario) => scenario,
        Err(error) => return Ok(refused(file, error.to_string())),
    };
    if let Some(reason) = scenario.outside_domain() {
        let reason = format!("outside the operational design domain: {reason}");
        return Ok(Judgement {
            warnings: scenario.warnings().to_vec(),
            ..refused(file, reason)
        });
    }
    let seed = args.seed;
    let mut world = World::new(&scenario, tandem_vehicle::WorldConfig { seed });
    if args.traffic == OtherTraffic::Replay {
        world.replay_traffic();
    }
    let problem = scenario.planning_problem();
    let seen = Seen {
        track: args.solutions.as_ref().map(|_| Track::new(problem.step_s)),
        recording: out.map(|_| Recording::new(&scenario.title(), seed, args.duration)),
        ..Seen::default()
    };
    let (world, seen, ended) = drive(world, args.duration, seed, seen);
    let world = world.borrow();
    let Seen {
        track,
        recording,
        moments,
        curve,
        invented_m,
        mut picture,
        ..
    } = seen;
    if let (Some(recording), Some(out)) = (recording, out) {
        recording.write(&world, ended, out)?;
    }
    picture.lanes = lanes(world.road(), &picture.path);
    let mut lane_types = BTreeSet::new();
    for place in &picture.path {
        lanelets.add_types(*place, &mut lane_types);
    }
    let now = world.snapshot();
    let metrics = world.metrics();
    let rss = Rss::of(&moments, world.road());
    show_worst(&mut picture, &moments, &rss, &metrics);
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
    Ok(Judgement {
        rss,
        curve,
        invented_m,
        lane_types: lane_types.into_iter().collect(),
        verdict,
        reason,
        solution,
        goal_reached: has_goal.then_some(metrics.goal_reached_s.is_some()),
        goal_missed: missed,
        driven_s: now.time_s,
        warnings,
        picture,
        ..figures(file, &metrics)
    })
}

/// Puts the worst moment into the picture: a collision, else an excursion, else where the vehicle
/// was nearest to another for its speed, else the end.
fn show_worst(picture: &mut Picture, moments: &[Moment], rss: &Rss, metrics: &WorldMetrics) {
    let hit = moments.iter().find(|it| it.hits).map(|it| it.time_s);
    let end_s = moments.last().map_or(0.0, |it| it.time_s);
    let (at_s, what) = match (hit, rss.margin_at_s, rss.margin_m) {
        (Some(at_s), ..) => (at_s, "the collision".to_owned()),
        _ if metrics.excursion_max_m > 0.0 => {
            let what = format!("{:.2} m outside its lanes", metrics.excursion_max_m);
            (metrics.excursion_at_s, what)
        }
        (_, Some(at_s), Some(margin_m)) if margin_m < 0.0 => (
            at_s,
            format!("{:.1} m nearer than is safe (RSS)", -margin_m),
        ),
        (_, Some(at_s), Some(margin_m)) => {
            (at_s, format!("{margin_m:.1} m farther than must be (RSS)"))
        }
        _ => (end_s, "nothing was in the way; the end".to_owned()),
    };
    picture.worst = format!("worst at {at_s:.1} s: {what}");
    let apart = |moment: &&Moment| (moment.time_s - at_s).abs();
    let worst = moments.iter().min_by(|a, b| apart(a).total_cmp(&apart(b)));
    if let Some(worst) = worst {
        picture.own = Some(worst.own.footprint.corners());
        let others = worst.others.iter().map(|it| it.footprint.corners());
        picture.others = others.collect();
    }
}

pub(super) fn refused(file: &str, reason: String) -> Judgement {
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
        problem: None,
        problem_number: 1,
        problem_count: 1,
        verdict: Verdict::Refused,
        reason: String::new(),
        collision: metrics.collisions > 0,
        collision_by_ego: metrics.collisions_by_ego > 0,
        hit_while_standing: metrics.hit_while_standing > 0,
        excursion_m: metrics.excursion_max_m,
        excursion_at_s: metrics.excursion_at_s,
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
        curve: Curve::default(),
        lane_types: vec![],
        invented_m: 0.0,
        forced_brakes: metrics.forced_brakes,
        forced_brake_max: metrics.forced_brake_max,
        rss: Rss::default(),
        lane_changes: metrics.lane_changes,
        driven_s: 0.0,
        distance_m: metrics.distance_m,
        warnings: vec![],
        picture: Picture::default(),
        solution: None,
    }
}

/// What is kept of a drive.
#[derive(Default)]
struct Seen {
    track: Option<Track>,
    recording: Option<Recording>,
    moments: Vec<Moment>,
    curve: Curve,
    invented_m: f64,
    picture: Picture,
    collides: bool,
    caused: u32,
}

impl Seen {
    /// Takes the state of the world after a tick.
    fn see(&mut self, at: Instant, world: &World) {
        let now = world.snapshot();
        if let Some(track) = &mut self.track {
            track.see(now.time_s, world.plant());
        }
        if let Some(recording) = &mut self.recording {
            recording.see(at, world);
        }
        let begins = now.collides && !self.collides;
        self.collides = now.collides;
        if begins && self.picture.hit_at.is_none() {
            self.picture.hit_at = Some(now.pose.position);
        }
        let last_s = self.moments.last().map_or(-MOMENT_S, |it| it.time_s);
        // Also while another contact lasts.
        let caused = if now.collides {
            world.metrics().collisions_by_ego
        } else {
            self.caused
        };
        let hits = caused > self.caused;
        let is_event = begins || hits;
        if !now.running || (!is_event && now.time_s < last_s + MOMENT_S - 1e-9) {
            return;
        }
        self.caused = caused;
        let vehicles = now.vehicles.iter().map(|it| User {
            id: it.id,
            footprint: it.footprint(),
            speed: it.speed,
        });
        self.moments.push(Moment {
            time_s: now.time_s,
            own: User {
                id: 0,
                footprint: now.footprint(),
                speed: now.speed,
            },
            lane: now.lane,
            station: now.station,
            others: vehicles.collect(),
            hits,
        });
        if world.road().lane(now.lane).beyond_map(now.station) > 0.0 {
            self.invented_m += now.speed * (now.time_s - last_s).min(MOMENT_S);
        }
        let curvature = world.road().lane(now.lane).at(now.station).curvature.abs();
        let lat_accel = now.speed * now.speed * curvature;
        if lat_accel > self.curve.lat_accel {
            self.curve = Curve {
                lat_accel,
                speed: now.speed,
                radius_m: Some(1.0 / curvature),
                at_s: now.time_s,
            };
        }
    }
}

/// Drives with both systems in the world until `duration_s` of its time have passed. Returns what
/// `seen` has kept, and when the drive ended.
fn drive(
    world: World,
    duration_s: f64,
    seed: u64,
    seen: Seen,
) -> (Rc<RefCell<World>>, Seen, Instant) {
    let config = Config {
        seed,
        ..Config::default()
    };
    let shared = Rc::new(RefCell::new(world));
    let mut pair = SimPair::new(config, |board| poller(board, tandem_cores::Config::rt()));
    let ticked = Rc::clone(&shared);
    let seen = Rc::new(RefCell::new(seen));
    let sees = Rc::clone(&seen);
    pair.set_world(move |tick| {
        let at = tick.at;
        let (mut world, mut seen) = (ticked.borrow_mut(), sees.borrow_mut());
        world.run_period(at, tick, &mut |frame| {
            if let Some(recording) = &mut seen.recording {
                recording.hear(frame);
            }
        });
        seen.see(at, &world);
    });
    for system in SystemId::ALL {
        pair.power_on(system);
    }
    loop {
        pair.run_for(PATH_STEP);
        let traced = pair.take_trace().0;
        // Drop the records for observers, which are not needed here.
        pair.take_bus_log();
        let (world, mut seen) = (shared.borrow(), seen.borrow_mut());
        if let Some(recording) = &mut seen.recording {
            recording.trace(traced);
        }
        let now = world.snapshot();
        seen.picture.path.push(now.pose.position);
        let gives_up = !now.running && pair.now() > Instant::ORIGIN + GIVE_UP;
        if now.time_s >= duration_s || gives_up {
            break;
        }
    }
    let ended = pair.now();
    (shared, seen.take(), ended)
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
