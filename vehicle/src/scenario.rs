//! The start of a run: road, recorded vehicles, the ego's state. Embedded by name, or a file.

use std::io::Read as _;
use std::path::Path;
use std::sync::Arc;

use crate::commonroad::{self, Goal, Obstacle, PlanningProblem, ProblemChoice, RoadMap};
use crate::error::ScenarioError;
use crate::geometry::{Footprint, Pose};
use crate::plant::BMW_320I;
use crate::road::{Frenet, ROAD_MAX, Road, RoadLane, domain};
use crate::traffic::recording::{self, Track};

/// The driver's requested speed without a speed limit and without faster traffic, m/s (50 km/h).
const SET_SPEED_MIN: f64 = 13.9;

/// An object ahead in the lane at the start must be avoidable with this deceleration, m/s², after
/// this time, s. It is in the way if it leaves less lateral room than this, m.
const START_BRAKING: f64 = 8.0;
const START_DELAY_S: f64 = 0.3;
const START_ASIDE: f64 = 0.35;
/// A vehicle that moves faster than this across or against the lane, m/s, is not a leader.
const ALONG_LANE: f64 = 1.0;

/// The embedded scenarios: name, one-line description, CommonRoad XML.
const EMBEDDED: [(&str, &str, &str); 7] = [
    (
        "free-lane",
        "light traffic on three lanes with gentle curves",
        include_str!("../scenarios/free-lane.xml"),
    ),
    (
        "slow-leader",
        "a truck ahead at 22 m/s, the left lane is free in between",
        include_str!("../scenarios/slow-leader.xml"),
    ),
    (
        "cut-in",
        "a slower car cuts in closely, and another one later",
        include_str!("../scenarios/cut-in.xml"),
    ),
    (
        "lane-drop",
        "the own lane ends, the lane beside it has traffic with gaps",
        include_str!("../scenarios/lane-drop.xml"),
    ),
    (
        "hard-braking",
        "the leader brakes with 7 m/s² to walking pace, then goes on",
        include_str!("../scenarios/hard-braking.xml"),
    ),
    (
        "stop-and-go",
        "a jam: the traffic stops twice and starts again",
        include_str!("../scenarios/stop-and-go.xml"),
    ),
    (
        "parking",
        "an empty straight road; the vehicle stands, and may be parked",
        include_str!("../scenarios/parking.xml"),
    ),
];

/// A scenario, ready to run. Cheap to clone.
#[derive(Clone, Debug)]
pub struct Scenario {
    pub(crate) name: String,
    pub(crate) road: Arc<Road>,
    pub(crate) obstacles: Arc<[Obstacle]>,
    pub(crate) goals: Arc<[Goal]>,
    pub(crate) warnings: Vec<String>,
    outside: Option<String>,
    problem: PlanningProblem,
    pub(crate) start: Pose,
    pub(crate) start_speed: f64,
    pub(crate) set_speed: f64,
}

impl Scenario {
    /// Returns the names of the embedded scenarios.
    pub fn names() -> impl ExactSizeIterator<Item = &'static str> {
        EMBEDDED.iter().map(|(name, ..)| *name)
    }

    /// Returns the names of the embedded scenarios, each with one line about it.
    pub fn descriptions() -> impl ExactSizeIterator<Item = (&'static str, &'static str)> {
        EMBEDDED
            .iter()
            .map(|(name, description, _)| (*name, *description))
    }

    /// The embedded scenario with this name, or the one in the CommonRoad file with this path.
    ///
    /// # Errors
    /// Neither exists, or the file cannot be read or understood.
    pub fn load(name_or_path: &str) -> Result<Self, ScenarioError> {
        Self::load_problem(name_or_path, ProblemChoice::First)
    }

    /// The same with another planning problem than the first.
    ///
    /// # Errors
    /// As [`Scenario::load`]; also if there is no such planning problem.
    pub fn load_problem(name_or_path: &str, choice: ProblemChoice) -> Result<Self, ScenarioError> {
        if let Some((name, _, text)) = EMBEDDED.iter().find(|(name, ..)| *name == name_or_path) {
            let file = format!("embedded scenario {name}");
            let map = RoadMap {
                name: (*name).to_owned(),
                ..commonroad::parse_problem(text, &file, choice)?
            };
            return Self::new(map, file);
        }
        let path = Path::new(name_or_path);
        if !path.exists() && path.components().count() == 1 && path.extension().is_none() {
            let name = name_or_path.to_owned();
            return Err(ScenarioError::Unknown {
                nearest: nearest_name(&name),
                name,
                names: Self::names().collect(),
            });
        }
        Self::read_problem(path, choice)
    }

    /// The scenario in the CommonRoad file with this path.
    ///
    /// # Errors
    /// The file cannot be read or understood.
    pub fn read(path: &Path) -> Result<Self, ScenarioError> {
        Self::read_problem(path, ProblemChoice::First)
    }

    /// The same with another planning problem than the first.
    ///
    /// # Errors
    /// As [`Scenario::read`]; also if there is no such planning problem.
    pub fn read_problem(path: &Path, choice: ProblemChoice) -> Result<Self, ScenarioError> {
        let file = path.display().to_string();
        match read_limited(path) {
            Ok(text) => Self::new(commonroad::parse_problem(&text, &file, choice)?, file),
            Err(problem) => {
                let problem = problem.to_string();
                Err(ScenarioError::Read { file, problem })
            }
        }
    }

    /// Returns the id of each planning problem in the file with this path, `None` for one without
    /// an id; nothing if the file cannot be read.
    #[must_use]
    pub fn problem_ids(path: &Path) -> Vec<Option<i64>> {
        read_limited(path).map_or(vec![], |text| commonroad::problem_ids(&text))
    }

    /// The scenario in the text of a CommonRoad file; `file` is named in errors.
    ///
    /// # Errors
    /// The text cannot be understood.
    pub fn parse(text: &str, file: &str) -> Result<Self, ScenarioError> {
        Self::new(commonroad::parse(text, file)?, file.to_owned())
    }

    fn new(map: RoadMap, file: String) -> Result<Self, ScenarioError> {
        let road = Road::new(&map.lanelets).map_err(|length| ScenarioError::TooLong {
            file,
            length_km: length / 1e3,
            most_km: ROAD_MAX / 1e3,
        })?;
        let start = Pose {
            position: map.ego.position,
            yaw: map.ego.yaw,
        };
        let start_speed = map.ego.speed.unwrap_or(0.0).max(0.0);
        let (lane, place) = road.locate_start(start.position, start.yaw);
        let limit = road.lane(lane).at(place.s).speed_limit;
        let set_speed = if limit.is_finite() {
            limit
        } else {
            fastest(&map.obstacles).max(start_speed).max(SET_SPEED_MIN)
        };
        let outside = domain::refusal(&road, lane, place.s, place.d, start.yaw, start_speed);
        let mut warnings = map.warnings;
        if let (None, Some((distance, exit))) = (&outside, road.domain_end(lane, place.s)) {
            warnings.push(format!(
                "{}: the operational design domain ends {distance:.0} m ahead: {exit}",
                map.name
            ));
        }
        for obstacle in map.obstacles.iter().filter(|it| !it.is_static) {
            warnings.extend(recording::defect(&obstacle.states).map(|what| {
                let id = obstacle.id;
                format!("{}: a defect of the data: obstacle {id}: {what}", map.name)
            }));
        }
        let ego = Footprint {
            pose: start,
            length: BMW_320I.length,
            width: BMW_320I.width,
        };
        let mut obstacles = map.obstacles;
        obstacles.retain(|obstacle| {
            let overlaps = ego.overlaps(&footprint_at_start(obstacle));
            if overlaps {
                let id = obstacle.id;
                warnings.push(format!(
                    "{}: obstacle {id} overlaps the ego: left out",
                    map.name
                ));
            }
            !overlaps
        });
        let outside = outside.or_else(|| {
            let too_near = |it| too_near(road.lane(lane), place, start_speed, it);
            obstacles.iter().find_map(too_near)
        });
        Ok(Self {
            name: map.name,
            road: Arc::new(road),
            obstacles: obstacles.into(),
            goals: map.goals.into(),
            warnings,
            outside,
            problem: map.problem,
            start,
            start_speed,
            set_speed,
        })
    }

    /// Goals of the drive; the ego must reach one of them. Empty if the file names none.
    #[must_use]
    pub fn goals(&self) -> &[Goal] {
        &self.goals
    }

    /// Returns its name, and which planning problem of the file it is if there are several.
    #[must_use]
    pub fn title(&self) -> String {
        match self.problem.count {
            0 | 1 => self.name.clone(),
            _ => format!("{}, {}", self.name, self.problem),
        }
    }

    /// Returns which planning problem it is, and what a solution must repeat of it.
    #[must_use]
    pub fn planning_problem(&self) -> &PlanningProblem {
        &self.problem
    }

    /// Returns why the driving functions cannot drive this scenario: it starts outside of their
    /// operational design domain. `None` if it starts inside.
    #[must_use]
    pub fn outside_domain(&self) -> Option<&str> {
        self.outside.as_deref()
    }

    /// Parts of the file that are not used, with reasons, and where the domain ends; one line each.
    #[must_use]
    pub fn warnings(&self) -> &[String] {
        &self.warnings
    }

    /// Returns its name: that of the embedded scenario, or the file's benchmark id.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Returns the lanes.
    #[must_use]
    pub fn road(&self) -> &Road {
        &self.road
    }

    /// Returns the speed that the driver requests, m/s: the speed limit where the ego starts;
    /// without one, the highest speed in the file.
    #[must_use]
    pub fn set_speed(&self) -> f64 {
        self.set_speed
    }
}

/// Returns the text of a regular file. Reads no more than the parser accepts.
fn read_limited(path: &Path) -> std::io::Result<String> {
    // Opening a pipe would block until its writer opens it.
    if !path.metadata()?.is_file() {
        return Err(std::io::Error::other("not a regular file"));
    }
    let file = std::fs::File::open(path)?;
    let mut text = String::new();
    file.take(commonroad::FILE_MAX as u64 + 1)
        .read_to_string(&mut text)?;
    Ok(text)
}

/// Returns why the ego, at this place and speed, cannot avoid the obstacle by braking.
fn too_near(lane: &RoadLane, ego: Frenet, speed: f64, obstacle: &Obstacle) -> Option<String> {
    let footprint = footprint_at_start(obstacle);
    if footprint.length <= 0.0 {
        return None;
    }
    let motion = Track::new(&obstacle.states).motion(0.0);
    let velocity = if obstacle.is_static {
        0.0
    } else {
        motion.speed
    };
    let angle = motion.pose.yaw - lane.at(ego.s).heading;
    let (along, across) = (velocity * angle.cos(), velocity * angle.sin());
    if along < -ALONG_LANE || across.abs() > ALONG_LANE {
        return None;
    }
    let corners = footprint.corners().map(|corner| lane.project(corner));
    let rear = corners.iter().map(|it| it.s).fold(f64::INFINITY, f64::min);
    let sides = corners.iter().map(|it| it.d - ego.d);
    let (right, left) = sides.fold((f64::INFINITY, f64::NEG_INFINITY), |(right, left), d| {
        (right.min(d), left.max(d))
    });
    let reach = BMW_320I.width / 2.0 + START_ASIDE;
    let gap = rear - ego.s - BMW_320I.length / 2.0;
    let is_ahead = gap > 0.0 && right < reach && left > -reach;
    let closing = (speed - along).max(0.0);
    let needed = START_DELAY_S * closing + closing * closing / (2.0 * START_BRAKING);
    (is_ahead && gap < needed).then(|| {
        let id = obstacle.id;
        format!(
            "obstacle {id}, {gap:.0} m ahead of the start and {closing:.0} m/s slower, is too near \
             to brake for"
        )
    })
}

/// Returns the area that an obstacle covers when the ego starts; `None` if it is not there then.
fn footprint_at_start(obstacle: &Obstacle) -> Footprint {
    let track = Track::new(&obstacle.states);
    let (begin, end) = track.span();
    let over = obstacle.states.len() > 1 && end < 0.0;
    let present = obstacle.is_static || (begin <= 0.0 && !over);
    let motion = track.motion(0.0);
    let size = if present { 1.0 } else { 0.0 };
    Footprint {
        pose: motion.pose,
        length: obstacle.length * size,
        width: obstacle.width * size,
    }
}

fn fastest(obstacles: &[Obstacle]) -> f64 {
    let states = obstacles.iter().flat_map(|obstacle| &obstacle.states);
    states.filter_map(|state| state.speed).fold(0.0, f64::max)
}

/// Returns the embedded name that shares the most pairs of letters, if it shares at least half.
fn nearest_name(wanted: &str) -> Option<&'static str> {
    let pairs = |name: &str| -> Vec<[u8; 2]> {
        let name = name.to_lowercase();
        name.as_bytes()
            .windows(2)
            .map(|pair| [pair[0], pair[1]])
            .collect()
    };
    let wanted = pairs(wanted);
    let score = |name: &str| {
        let own = pairs(name);
        let shared = own.iter().filter(|pair| wanted.contains(pair)).count();
        2 * shared * 100 / (own.len() + wanted.len()).max(1)
    };
    Scenario::names()
        .map(|n| (score(n), n))
        .filter(|(s, _)| *s >= 50)
        .max()
        .map(|(_, n)| n)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::commonroad::{Class, TimedState};

    /// A scenario with an unavoidable collision is refused before the start: a vehicle stands or
    /// drives slowly close ahead, in the lane or a few centimetres beside the ego's path.
    #[test]
    fn who_is_too_near_to_brake_for_is_named() {
        let scenario = Scenario::load("free-lane").unwrap();
        let (lane, place) = scenario
            .road
            .locate_start(scenario.start.position, scenario.start.yaw);
        let lane = scenario.road.lane(lane);
        let named = |ahead: f64, d: f64, turn: f64, speed: f64| {
            let s = place.s + ahead;
            let state = TimedState {
                t: 0.0,
                position: lane.point(Frenet { s, d }),
                yaw: lane.at(s).heading + turn,
                speed: Some(speed),
            };
            let obstacle = Obstacle {
                id: 7,
                class: Class::Car,
                is_static: false,
                length: 4.0,
                width: 1.8,
                states: vec![state],
            };
            too_near(lane, place, 20.0, &obstacle)
        };
        let reason = named(29.0, 0.0, 0.0, 0.0).unwrap();
        assert!(reason.contains("obstacle 7, 25 m ahead"), "{reason}");
        for (name, what, expected) in [
            (
                "stands, and can be stopped for",
                named(40.0, 0.0, 0.0, 0.0),
                false,
            ),
            (
                "stands a hand's breadth aside",
                named(29.0, place.d + 1.9, 0.0, 0.0),
                true,
            ),
            (
                "stands a step aside",
                named(29.0, place.d + 2.2, 0.0, 0.0),
                false,
            ),
            ("slower, close ahead", named(5.5, 0.0, 0.0, 14.0), true),
            ("as fast, close ahead", named(5.5, 0.0, 0.0, 20.0), false),
            ("behind", named(-8.0, 0.0, 0.0, 0.0), false),
            ("crosses", named(29.0, 0.0, 1.5, 6.0), false),
            ("comes towards", named(29.0, 0.0, 3.1, 6.0), false),
        ] {
            assert_eq!(what.is_some(), expected, "{name}: {what:?}");
        }
    }
}
