//! Reads CommonRoad XML, versions 2018b and 2020a, into plain data.
//!
//! Format: <https://commonroad.in.tum.de>. In a state, an interval is read as its midpoint and an
//! area as its centre. Not read: intersections, traffic lights and occupancy sets; phantom and
//! environment obstacles, because they are not traffic.
//!
//! **Limits.** No input file may cost more than seconds and a few hundred MB; each limit below is
//! far above every published scenario. A part that cannot be used is left out with a warning
//! ([`RoadMap::warnings`]) if the rest of the file is valid without it.

use std::cell::RefCell;
use std::collections::HashMap;

use roxmltree::{Document, Node, ParsingOptions};

use crate::error::ScenarioError;
use crate::geometry::{Vec2, wrap_angle};

mod goal;
mod problem;
mod users;

pub use goal::{Area, Goal, Nearest};
pub use problem::{PlanningProblem, ProblemChoice, problem_ids};
/// Kind of an obstacle.
pub use tandem_bus::ClassCode as Class;

/// Largest accepted file, bytes: the largest published scenarios have 10 MB.
pub const FILE_MAX: usize = 32 << 20;
/// Largest accepted number of XML nodes: each takes about 100 bytes.
const NODES_MAX: u32 = 2_000_000;
/// Largest accepted number of attributes of an XML element: the parser compares all pairs.
const ATTRIBUTES_MAX: usize = 100;
/// Largest accepted number of lanelets in a file.
const LANELETS_MAX: usize = 5_000;
/// Largest accepted number of predecessors, or of successors, of a lanelet.
const BRANCHES_MAX: usize = 50;
/// Largest accepted number of obstacles: every step checks all pairs of vehicles.
const OBSTACLES_MAX: usize = 1_000;
/// Number of places of a goal that are used; further ones are ignored.
const PLACES_MAX: usize = 30;
/// Largest accepted numeric value, also of coordinates (m): no map is farther from its origin.
const NUMBER_MAX: f64 = 1e8;
/// Longest accepted lanelet, m: a longer one is a typing error and would fill the memory.
const LANELET_MAX: f64 = 1e5;
/// Highest accepted speed of a vehicle, m/s.
const SPEED_MAX: f64 = 150.0;
/// Limits of the time step, s.
const STEP_RANGE: core::ops::RangeInclusive<f64> = 1e-3..=60.0;
/// Latest accepted time, s: a day.
const TIME_MAX: f64 = 86_400.0;
/// States of an obstacle that are closer in time than this count as one state, s.
const STATE_APART: f64 = 1e-3;
/// Number of warnings that are kept; one more warning gives the total number.
const WARNINGS_MAX: usize = 20;

/// A piece of lane between two bounds.
#[derive(Clone, Debug, PartialEq)]
pub struct Lanelet {
    /// Its id in the file.
    pub id: i64,
    /// Left bound in driving direction, at least two points.
    pub left: Vec<Vec2>,
    /// Right bound in driving direction, at least two points.
    pub right: Vec<Vec2>,
    /// Ids of the lanelets that lead into this one.
    pub predecessors: Vec<i64>,
    /// Ids of the lanelets that follow this one.
    pub successors: Vec<i64>,
    /// The neighbour to the left if it has the same driving direction.
    pub left_neighbour: Option<i64>,
    /// The neighbour to the right if it has the same driving direction.
    pub right_neighbour: Option<i64>,
    /// m/s
    pub speed_limit: Option<f64>,
    /// Cars must not drive here: by its type, or because it is for other users only.
    pub is_refused: bool,
    /// Persons cross other lanes here: a zebra.
    pub is_crosswalk: bool,
}

/// A place at one time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TimedState {
    /// Seconds since the ego's start.
    pub t: f64,
    /// Centre, m.
    pub position: Vec2,
    /// rad
    pub yaw: f64,
    /// m/s along `yaw`; `None` where the file gives none.
    pub speed: Option<f64>,
}

/// Another road user, or an object on the road.
#[derive(Clone, Debug, PartialEq)]
pub struct Obstacle {
    /// Its id in the file.
    pub id: i64,
    /// Kind.
    pub class: Class,
    /// Whether it never moves.
    pub is_static: bool,
    /// m, along its heading.
    pub length: f64,
    /// m, across its heading.
    pub width: f64,
    /// At least one state, with ascending times.
    pub states: Vec<TimedState>,
}

/// The content of a file.
#[derive(Clone, Debug, PartialEq)]
pub struct RoadMap {
    /// `benchmarkID`
    pub name: String,
    /// At least one.
    pub lanelets: Vec<Lanelet>,
    /// All road users except the ego.
    pub obstacles: Vec<Obstacle>,
    /// Where the ego starts, from the chosen planning problem, at t = 0.
    pub ego: TimedState,
    /// Goals of that planning problem; the ego must reach one of them. May be empty.
    pub goals: Vec<Goal>,
    /// Time between two steps of the file, s.
    pub step_s: f64,
    /// Which planning problem it is.
    pub problem: PlanningProblem,
    /// Parts of the file that are not used, with reasons.
    pub warnings: Vec<String>,
}

type Result<T> = core::result::Result<T, ScenarioError>;

/// Size of an obstacle and the place of its centre in the obstacle's own frame.
struct Shape {
    length: f64,
    width: f64,
    centre: Vec2,
}

/// Reads the text of a CommonRoad file with its first planning problem; errors name `file`.
///
/// # Errors
/// The error names the file, the line, the element, and what to do.
pub fn parse(text: &str, file: &str) -> Result<RoadMap> {
    parse_problem(text, file, ProblemChoice::First)
}

/// Reads the text of a CommonRoad file with this planning problem; errors name `file`.
///
/// # Errors
/// As [`parse`]; also if the file has no such planning problem.
pub fn parse_problem(text: &str, file: &str, choice: ProblemChoice) -> Result<RoadMap> {
    Reader {
        document: &document(text, file)?,
        file,
        warnings: RefCell::default(),
    }
    .map(choice)
}

/// Reads the elements of a file, within the limits of a file.
fn document<'a>(text: &'a str, file: &str) -> Result<Document<'a>> {
    let refused = |line, problem: String| ScenarioError::Xml {
        file: file.to_owned(),
        line,
        problem,
    };
    if text.len() > FILE_MAX {
        return Err(ScenarioError::TooLarge {
            file: file.to_owned(),
            most_mib: FILE_MAX >> 20,
        });
    }
    if let Some(line) = tag_with_many_attributes(text) {
        let problem = format!("an element has more than {ATTRIBUTES_MAX} attributes");
        return Err(refused(line, problem));
    }
    let options = ParsingOptions {
        nodes_limit: NODES_MAX,
        ..ParsingOptions::default()
    };
    Document::parse_with_options(text, options)
        .map_err(|error| refused(error.pos().row, error.to_string()))
}

/// Returns the line of the first tag with more than [`ATTRIBUTES_MAX`] attributes.
fn tag_with_many_attributes(text: &str) -> Option<u32> {
    let (mut line, mut signs, mut in_tag) = (1, 0, false);
    let bytes = text.as_bytes();
    for (index, byte) in bytes.iter().enumerate() {
        match byte {
            b'\n' => line += 1,
            b'<' => {
                let next = bytes.get(index + 1).copied().unwrap_or_default();
                (in_tag, signs) = (!b"!?/".contains(&next), 0);
            }
            b'>' => in_tag = false,
            b'=' if in_tag => {
                signs += 1;
                if signs > ATTRIBUTES_MAX {
                    return Some(line);
                }
            }
            _ => {}
        }
    }
    None
}

/// A document with the file name for its errors.
struct Reader<'a, 'input> {
    document: &'a Document<'input>,
    file: &'a str,
    /// The parts that were left out, and their total number.
    warnings: RefCell<(Vec<String>, usize)>,
}

type Element<'a, 'input> = Node<'a, 'input>;

impl<'a, 'input> Reader<'a, 'input> {
    fn map(&self, choice: ProblemChoice) -> Result<RoadMap> {
        let root = self.document.root_element();
        if root.tag_name().name() != "commonRoad" {
            return Err(self.error(
                root,
                "is no CommonRoad file",
                "give a file whose root is <commonRoad>",
            ));
        }
        let version = self.attribute(root, "commonRoadVersion")?;
        if !["2018b", "2020a"].contains(&version) {
            let problem = format!("has commonRoadVersion {version:?}");
            let advice = "convert the file to version 2018b or 2020a";
            return Err(self.error(root, &problem, advice));
        }
        let step_s = self.parsed(root, self.attribute(root, "timeStepSize")?)?;
        if !STEP_RANGE.contains(&step_s) {
            let problem = format!("has the timeStepSize {step_s:e}");
            return Err(self.error(root, &problem, "give seconds, 0.001 to 60"));
        }
        let limits = self.speed_signs(root)?;
        self.at_most(root, "lanelet", LANELETS_MAX)?;
        let mut lanelets = Vec::new();
        for node in elements(root, "lanelet") {
            lanelets.extend(self.lanelet(node, &limits)?);
        }
        if lanelets.is_empty() {
            return Err(self.error(
                root,
                "has no <lanelet>",
                "add the lanes that the ego drives on",
            ));
        }
        let (problem, number, count) = self.problem(root, choice)?;
        let start = self.child(problem, "initialState")?;
        let ego = self.state(start, step_s, None)?;
        if ego.speed.is_some_and(|speed| speed < 0.0) {
            return Err(self.error(start, "begins backwards", "give a velocity of 0 or more"));
        }
        if ego.t.abs() > TIME_MAX {
            return Err(self.error(problem, "starts later than a day", "give time steps"));
        }
        let goals = self.goals(problem, step_s, ego.t, &lanelets);
        let problem = PlanningProblem {
            id: self.id(problem, "id").ok(),
            number,
            count,
            version: version.to_owned(),
            yaw: self.value(self.child(start, "orientation")?)?,
            first_step: (ego.t / step_s).round() as i64,
            step_s,
        };
        let mut obstacles = Vec::new();
        for node in root.children().filter(Node::is_element) {
            let is_static = match node.tag_name().name() {
                "staticObstacle" => true,
                "dynamicObstacle" => false,
                "obstacle" => match self.text(self.child(node, "role")?) {
                    "static" => true,
                    "dynamic" => false,
                    role => {
                        let problem = format!("has the role {role:?}");
                        return Err(self.error(node, &problem, "give static or dynamic"));
                    }
                },
                _ => continue,
            };
            obstacles.push(self.obstacle(node, is_static, step_s)?);
            if obstacles.len() > OBSTACLES_MAX {
                let problem = format!("has more than {OBSTACLES_MAX} obstacles");
                return Err(self.error(root, &problem, "keep those near the ego"));
            }
        }
        for state in obstacles
            .iter_mut()
            .flat_map(|obstacle| &mut obstacle.states)
        {
            state.t -= ego.t;
        }
        let name = root
            .attribute("benchmarkID")
            .unwrap_or(self.file)
            .to_owned();
        Ok(RoadMap {
            name,
            lanelets,
            obstacles,
            ego: TimedState { t: 0.0, ..ego },
            goals,
            step_s,
            problem,
            warnings: self.take_warnings(),
        })
    }

    /// Records that a part of the file is not used.
    fn warn(&self, node: Element<'_, '_>, problem: &str) {
        self.note(node, problem, "it is left out");
    }

    /// Records what the user should know about a part of the file.
    fn note(&self, node: Element<'_, '_>, problem: &str, advice: &str) {
        let (kept, count) = &mut *self.warnings.borrow_mut();
        *count += 1;
        if *count <= WARNINGS_MAX {
            kept.push(self.error(node, problem, advice).to_string());
        }
    }

    fn take_warnings(&self) -> Vec<String> {
        let (mut kept, count) = self.warnings.take();
        if count > WARNINGS_MAX {
            let more = count - WARNINGS_MAX;
            kept.push(format!("{}: and {more} more of the kind", self.file));
        }
        kept
    }

    /// # Errors
    /// If `node` has more than `most` children of this name.
    fn at_most(&self, node: Element<'_, '_>, name: &str, most: usize) -> Result<()> {
        if elements(node, name).count() > most {
            let problem = format!("has more than {most} <{name}>");
            return Err(self.error(node, &problem, "give the part of the map that is driven"));
        }
        Ok(())
    }

    /// Ids and values (m/s) of the speed limit signs: version 2020a stores them outside the
    /// lanelets.
    fn speed_signs(&self, root: Element<'_, '_>) -> Result<HashMap<i64, f64>> {
        let mut limits = HashMap::new();
        for sign in elements(root, "trafficSign") {
            let id = self.id(sign, "id")?;
            for element in elements(sign, "trafficSignElement") {
                let kind = self.text(self.child(element, "trafficSignID")?);
                // Maximum speed: in Germany and the fictitious Zamunda, then in the USA.
                if ["274", "R2-1"].contains(&kind) {
                    let value = self.number(self.child(element, "additionalValue")?)?;
                    limits.entry(id).or_insert(value);
                }
            }
        }
        Ok(limits)
    }

    /// Reads a lanelet. `None`, with a warning, if a bound has no length.
    fn lanelet(
        &self,
        node: Element<'_, '_>,
        limits: &HashMap<i64, f64>,
    ) -> Result<Option<Lanelet>> {
        let bound = |name| -> Result<Option<Vec<Vec2>>> {
            let bound = self.child(node, name)?;
            let mut points = self.points(bound)?;
            if points.len() < 2 {
                return Err(self.error(bound, "has fewer than two points", "give the whole bound"));
            }
            points.dedup_by(|a, b| (*a - *b).norm() < 1e-3);
            if points.windows(2).map(|w| (w[1] - w[0]).norm()).sum::<f64>() > LANELET_MAX {
                return Err(self.error(bound, "is longer than 100 km", "check its coordinates"));
            }
            Ok((points.len() > 1).then_some(points))
        };
        let (Some(left), Some(right)) = (bound("leftBound")?, bound("rightBound")?) else {
            self.warn(node, "has a bound without length");
            return Ok(None);
        };
        for name in ["predecessor", "successor"] {
            self.at_most(node, name, BRANCHES_MAX)?;
        }
        let reference = |node| self.id(node, "ref");
        let references = |name| {
            elements(node, name)
                .map(reference)
                .collect::<Result<Vec<_>>>()
        };
        let neighbour = |name| {
            let is_same = |n: &Element<'_, '_>| n.attribute("drivingDir") == Some("same");
            let same = elements(node, name).find(is_same);
            same.map(reference).transpose()
        };
        let signs = references("trafficSignRef")?;
        let signed = signs.iter().find_map(|id| limits.get(id).copied());
        let own = optional(node, "speedLimit", |n| self.number(n))?;
        if own.or(signed).is_some_and(|limit| limit < 0.0) {
            let hint = "give metres per second, 0 or more";
            return Err(self.error(node, "has a negative speed limit", hint));
        }
        Ok(Some(Lanelet {
            id: self.id(node, "id")?,
            left,
            right,
            predecessors: references("predecessor")?,
            successors: references("successor")?,
            left_neighbour: neighbour("adjacentLeft")?,
            right_neighbour: neighbour("adjacentRight")?,
            speed_limit: own.or(signed).filter(|limit| *limit > 0.0),
            is_refused: self.is_refused(node),
            is_crosswalk: self.is_crosswalk(node),
        }))
    }

    fn obstacle(&self, node: Element<'_, '_>, is_static: bool, step_s: f64) -> Result<Obstacle> {
        let shape = self.shape(self.child(node, "shape")?)?;
        let mut states = vec![self.state(self.child(node, "initialState")?, step_s, Some(0.0))?];
        if let Some(trajectory) = elements(node, "trajectory").next() {
            for state in elements(trajectory, "state") {
                let next = self.state(state, step_s, None)?;
                let last = &states[states.len() - 1];
                let passed = next.t - last.t;
                if passed < STATE_APART {
                    // Some files repeat the initial state as the first of the trajectory.
                    if next.position != last.position || passed < 0.0 {
                        self.warn(state, "is not later than the state before it");
                    }
                    continue;
                }
                if (next.position - last.position).norm() > 2.0 * SPEED_MAX * passed + 10.0 {
                    self.warn(
                        state,
                        "jumps; the vehicle drives on by itself from there: it",
                    );
                    break;
                }
                states.push(next);
            }
        }
        for state in &mut states {
            let forward = Vec2::from_angle(state.yaw);
            state.position =
                state.position + forward * shape.centre.x + forward.left() * shape.centre.y;
        }
        let class = match self.text(self.child(node, "type")?) {
            "car" | "taxi" | "parkedVehicle" => Class::Car,
            "truck" | "bus" | "train" | "priorityVehicle" => Class::Truck,
            "motorcycle" | "bicycle" => Class::Motorcycle,
            "pedestrian" => Class::Pedestrian,
            "constructionZone" | "roadBoundary" | "building" | "pillar" | "median_strip" => {
                Class::Static
            }
            _ => Class::Unknown,
        };
        let (length, width) = (shape.length, shape.width);
        Ok(Obstacle {
            id: self.id(node, "id")?,
            class,
            is_static,
            length,
            width,
            states,
        })
    }

    /// Returns the box around all shapes, in the obstacle's frame.
    fn shape(&self, node: Element<'_, '_>) -> Result<Shape> {
        let mut corners = Vec::new();
        for shape in node.children().filter(Node::is_element) {
            match shape.tag_name().name() {
                "rectangle" => corners.extend(self.rectangle(shape)?),
                "circle" => {
                    let diameter = 2.0 * self.extent(shape, "radius")?;
                    corners.extend(corners_of(self.centre(shape)?, 0.0, diameter, diameter));
                }
                "polygon" => corners.extend(self.points(shape)?),
                name => {
                    let problem = format!("holds the unknown shape <{name}>");
                    return Err(self.error(node, &problem, "use rectangle, circle or polygon"));
                }
            }
        }
        let (low, high) = bounds(&corners);
        let (length, width) = (high.x - low.x, high.y - low.y);
        if !(length > 0.0 && width > 0.0) {
            return Err(self.error(node, "has no extent", "give a shape with a positive size"));
        }
        Ok(Shape {
            length,
            width,
            centre: low.lerp(high, 0.5),
        })
    }

    /// Returns the corners of a `<rectangle>` in the order around it.
    fn rectangle(&self, node: Element<'_, '_>) -> Result<[Vec2; 4]> {
        let yaw = optional(node, "orientation", |n| self.number(n))?.unwrap_or_default();
        let (length, width) = (self.extent(node, "length")?, self.extent(node, "width")?);
        Ok(corners_of(self.centre(node)?, yaw, length, width))
    }

    /// Returns the centre of a `<rectangle>` or `<circle>`; the origin if none is given.
    fn centre(&self, node: Element<'_, '_>) -> Result<Vec2> {
        Ok(optional(node, "center", |n| self.point(n))?.unwrap_or_default())
    }

    fn points(&self, node: Element<'_, '_>) -> Result<Vec<Vec2>> {
        elements(node, "point").map(|n| self.point(n)).collect()
    }

    fn extent(&self, shape: Element<'_, '_>, name: &str) -> Result<f64> {
        let node = self.child(shape, name)?;
        let extent = self.number(node)?;
        if extent <= 0.0 {
            return Err(self.error(node, "is not positive", "give metres > 0"));
        }
        Ok(extent)
    }

    /// Reads a state; `default_yaw` is used for things that may lack an orientation.
    fn state(
        &self,
        node: Element<'_, '_>,
        step_s: f64,
        default_yaw: Option<f64>,
    ) -> Result<TimedState> {
        let yaw = match (elements(node, "orientation").next(), default_yaw) {
            (None, Some(yaw)) => yaw,
            _ => wrap_angle(self.value(self.child(node, "orientation")?)?),
        };
        let time = optional(node, "time", |n| self.value(n))?.unwrap_or_default() * step_s;
        if time.abs() > TIME_MAX {
            return Err(self.error(node, "is more than a day away", "give time steps"));
        }
        Ok(TimedState {
            t: time,
            position: self.place(self.child(node, "position")?)?,
            yaw,
            speed: optional(node, "velocity", |n| self.speed(n))?,
        })
    }

    /// Reads the goals of a planning problem. Leaves out, with a warning, one that cannot be read.
    fn goals(
        &self,
        problem: Element<'_, '_>,
        step_s: f64,
        start: f64,
        lanelets: &[Lanelet],
    ) -> Vec<Goal> {
        let goal = |node| -> Result<Goal> {
            let range = |name| optional(node, name, |n| self.range(n));
            let (mut areas, mut places) = (Vec::new(), Vec::new());
            if let Some(position) = elements(node, "position").next() {
                for element in position.children().filter(Node::is_element) {
                    let Some((area, points)) = self.area(element, lanelets)? else {
                        continue;
                    };
                    places.extend(points);
                    areas.push(area);
                }
                places.truncate(PLACES_MAX);
                if areas.is_empty() {
                    return Err(self.error(position, "names no known place", "name a lanelet"));
                }
            }
            let time = range("time")?;
            Ok(Goal {
                areas,
                places,
                time: time.map(|(from, to)| (from * step_s - start, to * step_s - start)),
                yaw: range("orientation")?,
                speed: range("velocity")?,
            })
        };
        let mut goals = Vec::new();
        for node in elements(problem, "goalState").take(BRANCHES_MAX) {
            match goal(node) {
                Ok(goal) => goals.push(goal),
                Err(error) => self.warn(node, &format!("cannot be understood ({error})")),
            }
        }
        goals
    }

    /// Reads a part of the plane, and points on the way through it; `None` for a lanelet that is
    /// not in the file.
    fn area(
        &self,
        node: Element<'_, '_>,
        lanelets: &[Lanelet],
    ) -> Result<Option<(Area, Vec<Vec2>)>> {
        let area = match node.tag_name().name() {
            "lanelet" | "laneletref" | "laneletRef" => {
                let id = self.id(node, "ref")?;
                let lanelet = lanelets.iter().find(|lanelet| lanelet.id == id);
                return Ok(lanelet.map(|lanelet| {
                    let back = lanelet.right.iter().rev();
                    let area = Area::Polygon(lanelet.left.iter().chain(back).copied().collect());
                    let middle = |share: f64| {
                        let at =
                            |bound: &[Vec2]| bound[(share * (bound.len() - 1) as f64) as usize];
                        at(&lanelet.left).lerp(at(&lanelet.right), 0.5)
                    };
                    (area, [0.0, 0.5, 1.0].map(middle).into())
                }));
            }
            "circle" => Area::Circle {
                centre: self.centre(node)?,
                radius: self.extent(node, "radius")?,
            },
            "rectangle" => Area::Polygon(self.rectangle(node)?.into()),
            "polygon" => Area::Polygon(self.points(node)?),
            name => {
                let problem = format!("is the unknown area <{name}>");
                return Err(self.error(node, &problem, "use a lanelet, rectangle or circle"));
            }
        };
        let centre = area.centre();
        Ok(Some((area, vec![centre])))
    }

    /// Reads a point, or the centre of an area.
    fn place(&self, node: Element<'_, '_>) -> Result<Vec2> {
        let Some(place) = node.children().find(Node::is_element) else {
            return Err(self.error(node, "is empty", "give a <point>, <rectangle> or <circle>"));
        };
        match place.tag_name().name() {
            "point" => self.point(place),
            "rectangle" | "circle" => self.centre(place),
            "polygon" => {
                let (low, high) = bounds(&self.points(place)?);
                Ok(low.lerp(high, 0.5))
            }
            name => {
                let problem = format!("is given as <{name}>");
                Err(self.error(node, &problem, "give a <point>, <rectangle> or <circle>"))
            }
        }
    }

    fn point(&self, node: Element<'_, '_>) -> Result<Vec2> {
        let x = self.number(self.child(node, "x")?)?;
        let y = self.number(self.child(node, "y")?)?;
        Ok(Vec2::new(x, y))
    }

    /// Reads `<exact>`, or the middle of `<intervalStart>` and `<intervalEnd>`.
    fn value(&self, node: Element<'_, '_>) -> Result<f64> {
        let (start, end) = self.range(node)?;
        Ok((start + end) / 2.0)
    }

    /// Reads `<intervalStart>` and `<intervalEnd>`, or uses `<exact>` as both.
    fn range(&self, node: Element<'_, '_>) -> Result<(f64, f64)> {
        if let Some(exact) = elements(node, "exact").next() {
            let exact = self.number(exact)?;
            return Ok((exact, exact));
        }
        let start = self.number(self.child(node, "intervalStart")?)?;
        let end = self.number(self.child(node, "intervalEnd")?)?;
        Ok((start, end))
    }

    fn child<'n, 'i>(&self, node: Element<'n, 'i>, name: &str) -> Result<Element<'n, 'i>> {
        elements(node, name).next().ok_or_else(|| {
            let advice = format!("add <{name}> to it");
            self.error(node, &format!("lacks <{name}>"), &advice)
        })
    }

    fn attribute<'n>(&self, node: Element<'n, '_>, name: &str) -> Result<&'n str> {
        node.attribute(name).ok_or_else(|| {
            let advice = format!("add {name}=\"…\" to it");
            self.error(node, &format!("lacks the attribute {name:?}"), &advice)
        })
    }

    fn id(&self, node: Element<'_, '_>, attribute: &str) -> Result<i64> {
        let text = self.attribute(node, attribute)?;
        let problem = |_| {
            let problem = format!("refers to {text:?}");
            self.error(node, &problem, "give a whole number as id")
        };
        text.trim().parse().map_err(problem)
    }

    /// Reads a speed that a road vehicle can have.
    fn speed(&self, node: Element<'_, '_>) -> Result<f64> {
        let speed = self.value(node)?;
        if speed.abs() > SPEED_MAX {
            let problem = format!("is faster than {SPEED_MAX} m/s");
            return Err(self.error(node, &problem, "give metres per second"));
        }
        Ok(speed)
    }

    fn number(&self, node: Element<'_, '_>) -> Result<f64> {
        self.parsed(node, self.text(node))
    }

    fn parsed(&self, node: Element<'_, '_>, text: &str) -> Result<f64> {
        match text.trim().parse::<f64>() {
            Ok(number) if number.abs() <= NUMBER_MAX => Ok(number),
            _ => Err(self.error(
                node,
                &format!("holds {text:?}"),
                "give a finite number up to 1e8",
            )),
        }
    }

    fn text<'n>(&self, node: Element<'n, '_>) -> &'n str {
        node.text().map_or("", str::trim)
    }

    fn error(&self, node: Element<'_, '_>, problem: &str, advice: &str) -> ScenarioError {
        let id = node
            .attribute("id")
            .map_or(String::new(), |id| format!(" id=\"{id}\""));
        ScenarioError::Element {
            file: self.file.to_owned(),
            line: self.document.text_pos_at(node.range().start).row,
            element: format!("<{}{id}>", node.tag_name().name()),
            problem: problem.to_owned(),
            advice: advice.to_owned(),
        }
    }
}

fn elements<'a, 'i: 'a>(
    node: Element<'a, 'i>,
    name: &str,
) -> impl Iterator<Item = Element<'a, 'i>> {
    node.children()
        .filter(move |child| child.has_tag_name(name))
}

/// Applies `read` to the first child of this name; `None` if there is none.
fn optional<'a, 'i: 'a, T>(
    node: Element<'a, 'i>,
    name: &str,
    read: impl FnOnce(Element<'a, 'i>) -> Result<T>,
) -> Result<Option<T>> {
    elements(node, name).next().map(read).transpose()
}

/// Returns the corners of a rectangle in the order around it.
fn corners_of(centre: Vec2, yaw: f64, length: f64, width: f64) -> [Vec2; 4] {
    let along = Vec2::from_angle(yaw) * (length / 2.0);
    let across = Vec2::from_angle(yaw).left() * (width / 2.0);
    [
        along + across,
        along - across,
        -along - across,
        across - along,
    ]
    .map(|corner| centre + corner)
}

/// Returns the corners of the box around the points; an empty box for none.
fn bounds(points: &[Vec2]) -> (Vec2, Vec2) {
    let Some(&first) = points.first() else {
        return Default::default();
    };
    points.iter().fold((first, first), |(low, high), p| {
        (
            Vec2::new(low.x.min(p.x), low.y.min(p.y)),
            Vec2::new(high.x.max(p.x), high.y.max(p.y)),
        )
    })
}
