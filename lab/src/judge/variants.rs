//! Made scenarios of the classes that recorded motorways do not have, as CommonRoad files.
//!
//! A variant is a class with drawn numbers: speed, gap, curvature, distances. Each is avoidable by
//! construction: what the vehicle meets is at least as far away as [`stop_m`] needs.

use std::fmt::Write as _;

use tandem_faults::Draw;
use tandem_vehicle::geometry::Vec2;

use super::drive::{Judgement, Verdict};

/// Width of the lanes, m.
const WIDTH_M: f64 = 3.5;
/// Distance between two points of a bound, m.
const STEP_M: f64 = 2.0;
/// Where roads begin, m: the ego starts at 0.
const BEGIN_M: f64 = -60.0;
/// Interval of recorded states, s, and how long recordings last, s.
const STATE_S: f64 = 0.1;
const RECORDED_S: f64 = 30.0;
/// Braking with which each variant can be avoided, m/s², and the time until it acts, s.
const BRAKING: f64 = 6.0;
const REACTION_S: f64 = 0.7;
/// Largest excursion of a good drive, m, largest jerk outside emergencies, m/s³, and lateral
/// acceleration in bends, m/s².
const EXCURSION_M: f64 = 0.1;
const CALM_JERK: f64 = 10.0;
const LATERAL: f64 = 2.2;

/// What a variant tests.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Class {
    /// A vehicle comes towards the ego in its own lane.
    WrongWay,
    /// A bicycle crosses and stops in the lane.
    CrossingStops,
    /// The leader stands at once, as after a crash.
    LeaderStands,
    /// Bends of a radius of 20 m and more, without traffic.
    Bends,
    /// The lane ends beside a lane with traffic of equal speed.
    EndBesideTraffic,
    /// The lane ends beside one that is not for cars.
    EndBesideRefused,
    /// A vehicle cuts in, 3 to 6 m ahead.
    CutIn,
}

impl Class {
    const ALL: [Self; 7] = [
        Self::WrongWay,
        Self::CrossingStops,
        Self::LeaderStands,
        Self::Bends,
        Self::EndBesideTraffic,
        Self::EndBesideRefused,
        Self::CutIn,
    ];

    const fn name(self) -> &'static str {
        match self {
            Self::WrongWay => "wrong-way",
            Self::CrossingStops => "crossing-stops",
            Self::LeaderStands => "leader-stands",
            Self::Bends => "bends",
            Self::EndBesideTraffic => "end-beside-traffic",
            Self::EndBesideRefused => "end-beside-refused",
            Self::CutIn => "cut-in",
        }
    }
}

/// A made scenario.
#[derive(Debug)]
pub(super) struct Variant {
    pub(super) class: Class,
    pub(super) name: String,
    /// CommonRoad XML.
    pub(super) text: String,
}

/// Returns `count` variants, the classes in turn. A seed and a number always give the same one.
pub(super) fn variants(count: u32, seed: u64) -> Vec<Variant> {
    (0..count as usize)
        .map(|number| variant(number, seed))
        .collect()
}

fn variant(number: usize, seed: u64) -> Variant {
    let class = Class::ALL[number % Class::ALL.len()];
    let mut draw = Drawn(Draw::new(seed.wrapping_mul(1 << 32) ^ number as u64));
    let mut file = File::default();
    let made = match class {
        Class::WrongWay => wrong_way(&mut file, &mut draw),
        Class::CrossingStops => crossing_stops(&mut file, &mut draw),
        Class::LeaderStands => leader_stands(&mut file, &mut draw),
        Class::Bends => bends(&mut file, &mut draw),
        Class::EndBesideTraffic => end_beside_traffic(&mut file, &mut draw),
        Class::EndBesideRefused => end_beside_refused(&mut file, &mut draw),
        Class::CutIn => cut_in(&mut file, &mut draw),
    };
    let name = format!("{number:04}-{}-{made}", class.name());
    Variant {
        class,
        text: file.text(&name),
        name,
    }
}

/// Distance in which the ego stops from this speed, m.
fn stop_m(speed: f64) -> f64 {
    speed * REACTION_S + speed * speed / (2.0 * BRAKING)
}

fn wrong_way(file: &mut File, draw: &mut Drawn) -> String {
    let (own, other) = (
        draw.of(&[8.0, 14.0, 20.0, 25.0]),
        draw.of(&[4.0, 8.0, 12.0]),
    );
    let share = draw.between(1.0, 2.5);
    let stop_s = REACTION_S + own / BRAKING;
    let apart = 10.0 + share * (stop_m(own) + other * stop_s);
    let from = draw.of(&[0.0, 3.0]);
    let radius = draw.of(&[f64::INFINITY, 400.0, -250.0]);
    let path = road(&[(700.0, 1.0 / radius)]);
    let lanes = draw.of(&[1, 2]);
    file.lanes(&path, lanes, 600.0);
    file.start(own, own);
    // It is where the ego would be from `from` on, at this distance.
    let start = apart + from * (own + other);
    let track = Track::new(start, 0.0, -other).held(RECORDED_S);
    file.user("car", (4.5, 1.8), &path, &track);
    format!("v{own:.0}-u{other:.0}-x{share:.1}-lanes{lanes}-r{radius:.0}")
}

fn crossing_stops(file: &mut File, draw: &mut Drawn) -> String {
    let (own, across) = (
        draw.of(&[8.0, 11.0, 14.0, 20.0]),
        draw.of(&[1.2, 2.0, 3.5, 5.0]),
    );
    let share = draw.between(1.0, 2.5);
    let side = draw.of(&[1.0, -1.0]);
    let stops = draw.of(&[-0.8, 0.0, 0.8]);
    let path = road(&[(500.0, 0.0)]);
    file.lanes(&path, 1, 400.0);
    file.start(own, own);
    // It enters the lane when the ego is this far away.
    let begins = draw.of(&[1.0, 2.5, 4.0]);
    let place = 6.0 + begins * own + share * stop_m(own);
    let way = side * WIDTH_M / 2.0 - stops;
    let waits = side * across * begins;
    let entered = (way / across).abs();
    let track = Track::across(place, side * WIDTH_M / 2.0 + waits, -side * across)
        .held(begins + entered)
        .stopped();
    file.user("bicycle", (1.8, 0.6), &path, &track);
    format!("v{own:.0}-u{across:.1}-x{share:.1}-at{stops:.1}")
}

fn leader_stands(file: &mut File, draw: &mut Drawn) -> String {
    let speed = draw.of(&[8.0, 14.0, 20.0, 25.0, 30.0]);
    // Nearer than it can stop at the start, it has time to fall back.
    let share = draw.between(0.6, 1.5);
    let after = if share < 1.0 {
        14.0
    } else {
        draw.of(&[3.0, 6.0, 9.0])
    };
    let path = road(&[(1_200.0, 0.0)]);
    file.lanes(&path, 1, 1_100.0);
    file.start(speed, speed);
    let gap = 4.5 + 3.0 + share * stop_m(speed);
    let track = Track::new(gap, 0.0, speed).held(after).stopped();
    file.user("car", (4.5, 1.8), &path, &track);
    format!("v{speed:.0}-x{share:.1}-t{after:.0}")
}

fn bends(file: &mut File, draw: &mut Drawn) -> String {
    let radius = draw.of(&[20.5, 22.0, 25.0, 30.0, 40.0, 60.0, 100.0, 200.0]);
    let speed = draw.of(&[6.0, 10.0, 14.0, 20.0, 25.0, 30.0]);
    let side = draw.of(&[1.0, -1.0]);
    let angle = draw.between(0.4, 2.8);
    // Slowing down for the bend takes 2 m/s².
    let slow = (speed * speed - LATERAL * radius).max(0.0) / 4.0 + speed + 10.0;
    let before = slow * draw.between(1.0, 1.6);
    let bend = |side: f64| (angle * radius, side / radius);
    let parts = [
        (before, 0.0),
        bend(side),
        (draw.of(&[10.0, 40.0, 120.0]), 0.0),
    ];
    let s_bend = draw.of(&[false, true]);
    let further = [bend(-side), (400.0, 0.0)];
    let path = if s_bend {
        road(&[&parts[..], &further].concat())
    } else {
        road(&[&parts[..2], &further[1..]].concat())
    };
    file.lanes(&path, 1, f64::INFINITY);
    file.start(speed, speed.max(14.0));
    format!(
        "r{radius:.1}-v{speed:.0}-a{angle:.1}-d{before:.0}-s{}",
        u8::from(s_bend)
    )
}

fn end_beside_traffic(file: &mut File, draw: &mut Drawn) -> String {
    let speed = draw.of(&[14.0, 20.0, 25.0]);
    let gap = draw.of(&[12.0, 25.0, 50.0]);
    let known = draw.of(&[200.0, 250.0, 350.0]);
    let shift = draw.between(0.0, 1.0);
    let path = road(&[(1_200.0, draw.of(&[0.0, 1.0 / 800.0, -1.0 / 800.0]))]);
    file.ending(&path, known, 1_100.0, "highway", "");
    file.start(speed, speed);
    let spacing = gap + 4.5;
    let mut s = BEGIN_M + spacing * shift;
    while s < 350.0 {
        let track = Track::new(s, WIDTH_M, speed).held(RECORDED_S);
        file.user("car", (4.5, 1.8), &path, &track);
        s += spacing;
    }
    format!("v{speed:.0}-gap{gap:.0}-end{known:.0}-x{shift:.1}")
}

fn end_beside_refused(file: &mut File, draw: &mut Drawn) -> String {
    let speed = draw.of(&[8.0, 14.0, 20.0, 25.0]);
    let known = draw.between(1.2, 3.0) * (stop_m(speed) + 10.0);
    let (kind, only) = draw.of(&[
        ("sidewalk", ""),
        ("bicycleLane", ""),
        ("busLane", ""),
        ("shoulder", ""),
        ("urban", "bicycle"),
        ("urban", "pedestrian"),
        ("urban", "bus"),
    ]);
    let path = road(&[(700.0, draw.of(&[0.0, 1.0 / 500.0, -1.0 / 500.0]))]);
    file.ending(&path, known, 600.0, kind, only);
    file.start(speed, speed);
    format!("{kind}{only}-v{speed:.0}-end{known:.0}")
}

fn cut_in(file: &mut File, draw: &mut Drawn) -> String {
    let speed = draw.of(&[10.0, 15.0, 20.0, 25.0, 30.0]);
    let slower = draw.between(0.0, 3.0);
    let gap = draw.between(3.0, 6.0);
    let (waits, lasts) = (draw.between(1.0, 4.0), draw.of(&[2.5, 3.5, 5.0]));
    let path = road(&[(1_000.0, draw.of(&[0.0, 1.0 / 600.0, -1.0 / 600.0]))]);
    file.lanes(&path, 2, 900.0);
    file.start(speed, speed);
    // At the middle of the change it is this far ahead of where the ego would be.
    let ahead = gap + 4.5 + slower * (waits + lasts / 2.0);
    let track = Track::new(ahead, WIDTH_M, speed - slower)
        .held(waits)
        .aside(-WIDTH_M, lasts)
        .held(RECORDED_S);
    file.user("car", (4.5, 1.8), &path, &track);
    format!("v{speed:.0}-dv{slower:.1}-gap{gap:.1}-in{lasts:.1}")
}

/// Draws numbers.
struct Drawn(Draw);

impl Drawn {
    fn of<T: Copy>(&mut self, choices: &[T]) -> T {
        choices[self.0.below(choices.len() as u64) as usize]
    }

    fn between(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * self.0.below(1_001) as f64 / 1e3
    }
}

/// A centre line: points every [`STEP_M`] with their headings, from [`BEGIN_M`] on.
type Path = Vec<(Vec2, f64)>;

/// Returns the line of these parts, each with its length, m, and its curvature, 1/m, after a
/// straight piece before the ego's start.
fn road(parts: &[(f64, f64)]) -> Path {
    let mut path = vec![(Vec2::new(BEGIN_M, 0.0), 0.0)];
    let first = (-BEGIN_M, 0.0);
    for (length, curvature) in [first].iter().chain(parts) {
        let count = (length / STEP_M).round().max(1.0);
        let step = length / count;
        for _ in 0..count as usize {
            let (point, heading) = path[path.len() - 1];
            let chord = Vec2::from_angle(heading + curvature * step / 2.0) * step;
            path.push((point + chord, heading + curvature * step));
        }
    }
    path
}

/// Returns the point at station `s` and offset `d` of the path, m, and the heading there.
fn place(path: &Path, s: f64, d: f64) -> (Vec2, f64) {
    let at = ((s - BEGIN_M) / STEP_M).clamp(0.0, (path.len() - 2) as f64);
    let (index, share) = (at as usize, at.fract());
    let ((a, from), (b, to)) = (path[index], path[index + 1]);
    let heading = from + (to - from) * share;
    (
        a.lerp(b, share) + Vec2::from_angle(heading).left() * d,
        heading,
    )
}

/// The track of another road user: station, offset, and their changes, at each [`STATE_S`].
struct Track {
    states: Vec<[f64; 4]>,
    crosses: bool,
}

impl Track {
    fn new(s: f64, d: f64, speed: f64) -> Self {
        let states = vec![[s, d, speed, 0.0]];
        Self {
            states,
            crosses: false,
        }
    }

    fn across(s: f64, d: f64, speed: f64) -> Self {
        let states = vec![[s, d, 0.0, speed]];
        Self {
            states,
            crosses: true,
        }
    }

    fn moved(mut self, span_s: f64, across: impl Fn(f64) -> Option<f64>) -> Self {
        for step in 0..(span_s / STATE_S).round() as usize {
            let [s, d, along, aside] = self.states[self.states.len() - 1];
            let aside = across(step as f64 * STATE_S).unwrap_or(aside);
            let next = [s + along * STATE_S, d + aside * STATE_S, along, aside];
            self.states.push(next);
        }
        self
    }

    /// Goes on like this.
    fn held(self, span_s: f64) -> Self {
        self.moved(span_s, |_| None)
    }

    /// Moves aside by this, m, within a time, s: a raised cosine in the lateral speed.
    fn aside(self, by: f64, span_s: f64) -> Self {
        let turn = std::f64::consts::TAU / span_s;
        let mut track = self.moved(span_s, |t| {
            Some(by / span_s * (1.0 - (turn * (t + STATE_S / 2.0)).cos()))
        });
        let last = track.states.len() - 1;
        track.states[last][3] = 0.0;
        track
    }

    /// Stands from now on.
    fn stopped(mut self) -> Self {
        let last = self.states.len() - 1;
        let [s, d, ..] = self.states[last];
        self.states[last] = [s, d, 0.0, 0.0];
        self.held(RECORDED_S)
    }
}

/// A CommonRoad file in the making.
#[derive(Default)]
struct File {
    lanelets: String,
    signs: String,
    users: String,
    ego: String,
    count: usize,
}

impl File {
    /// Writes a lanelet from station `from` to `to` at the offset `d`, m; `further` are more
    /// elements in it.
    fn lanelet(&mut self, id: u32, path: &Path, (from, to): (f64, f64), d: f64, further: &str) {
        let inside = |index: &usize| {
            let s = BEGIN_M + *index as f64 * STEP_M;
            (from - 1e-6..=to + 1e-6).contains(&s)
        };
        let indices: Vec<usize> = (0..path.len()).filter(inside).collect();
        let bound = |side: f64| -> String {
            let point = |index: &usize| {
                let (centre, heading) = path[*index];
                let p = centre + Vec2::from_angle(heading).left() * (d + side * WIDTH_M / 2.0);
                format!("<point><x>{:.4}</x><y>{:.4}</y></point>", p.x, p.y)
            };
            indices.iter().map(point).collect()
        };
        let (left, right) = (bound(1.0), bound(-1.0));
        let _ = writeln!(
            self.lanelets,
            "<lanelet id=\"{id}\"><leftBound>{left}</leftBound><rightBound>{right}</rightBound>\
             {further}</lanelet>"
        );
    }

    /// Lanes side by side, the right one being the ego's, up to this station.
    fn lanes(&mut self, path: &Path, count: u32, to: f64) {
        for lane in 0..count {
            let beside =
                |name: &str, id: u32| format!("<{name} ref=\"{id}\" drivingDir=\"same\"/>");
            let mut further = String::new();
            if lane + 1 < count {
                further += &beside("adjacentLeft", lane + 2);
            }
            if lane > 0 {
                further += &beside("adjacentRight", lane);
            }
            let span = (f64::NEG_INFINITY, to);
            self.lanelet(lane + 1, path, span, f64::from(lane) * WIDTH_M, &further);
        }
    }

    /// The ego's lane ends at this station; the one to the left, of this kind and for these users,
    /// continues.
    fn ending(&mut self, path: &Path, end: f64, to: f64, kind: &str, only: &str) {
        let end = (end / STEP_M).round() * STEP_M;
        let of = |kind: &str, only: &str| {
            let mut text = format!("<laneletType>{kind}</laneletType>");
            if !only.is_empty() {
                text += &format!("<userOneWay>{only}</userOneWay>");
            }
            text
        };
        let beside = |name: &str, id: u32| format!("<{name} ref=\"{id}\" drivingDir=\"same\"/>");
        let own = beside("adjacentLeft", 2) + &of("highway", "");
        let first = beside("adjacentRight", 1) + &of(kind, only);
        let before = (f64::NEG_INFINITY, end);
        self.lanelet(1, path, before, 0.0, &own);
        self.lanelet(
            2,
            path,
            before,
            WIDTH_M,
            &format!("<successor ref=\"3\"/>{first}"),
        );
        let next = format!("<predecessor ref=\"2\"/>{}", of(kind, only));
        self.lanelet(3, path, (end, to), WIDTH_M, &next);
    }

    /// The ego's start at station 0 with this speed, and the speed limit, m/s.
    fn start(&mut self, speed: f64, limit: f64) {
        let sign = format!(
            "<trafficSign id=\"90\"><trafficSignElement><trafficSignID>274</trafficSignID>\
             <additionalValue>{limit}</additionalValue></trafficSignElement></trafficSign>\n"
        );
        self.signs = sign;
        let reference = "<trafficSignRef ref=\"90\"/></lanelet>";
        self.lanelets = self.lanelets.replace("</lanelet>", reference);
        self.ego = state("initialState", 0.0, (Vec2::default(), 0.0), speed);
    }

    fn user(&mut self, kind: &str, (length, width): (f64, f64), path: &Path, track: &Track) {
        self.count += 1;
        let on_road = |of: &&[f64; 4]| of[0] >= BEGIN_M;
        let states: Vec<String> = { track.states.iter() }
            .take_while(on_road)
            .enumerate()
            .map(|(step, of)| {
                let [s, d, along, across] = *of;
                let (point, heading) = place(path, s, d);
                let first = track.states[0];
                let (turn, speed) = if track.crosses {
                    (
                        first[3].signum() * std::f64::consts::FRAC_PI_2,
                        across.abs(),
                    )
                } else if first[2] < 0.0 {
                    (std::f64::consts::PI, along.abs())
                } else if along > 0.0 {
                    ((across / along).atan(), along.hypot(across))
                } else {
                    (0.0, 0.0)
                };
                let name = if step == 0 { "initialState" } else { "state" };
                state(name, step as f64, (point, heading + turn), speed)
            })
            .collect();
        let id = 100 + self.count;
        let _ = writeln!(
            self.users,
            "<dynamicObstacle id=\"{id}\"><type>{kind}</type><shape><rectangle>\
             <length>{length}</length><width>{width}</width></rectangle></shape>{}\
             <trajectory>{}</trajectory></dynamicObstacle>",
            states[0],
            states[1..].concat(),
        );
    }

    fn text(&self, name: &str) -> String {
        let Self {
            lanelets,
            signs,
            users,
            ego,
            ..
        } = self;
        format!(
            "<?xml version=\"1.0\" encoding=\"UTF-8\"?>\n\
             <commonRoad timeStepSize=\"{STATE_S}\" commonRoadVersion=\"2020a\" \
             benchmarkID=\"{name}\">\n{lanelets}{signs}{users}\
             <planningProblem id=\"9\">{ego}</planningProblem>\n</commonRoad>\n"
        )
    }
}

/// Writes a state.
fn state(name: &str, step: f64, (point, yaw): (Vec2, f64), speed: f64) -> String {
    let value = |name: &str, value: String| format!("<{name}><exact>{value}</exact></{name}>");
    format!(
        "<{name}><position><point><x>{:.4}</x><y>{:.4}</y></point></position>{}{}{}</{name}>",
        point.x,
        point.y,
        value("orientation", format!("{yaw:.5}")),
        value("time", format!("{step:.0}")),
        value("velocity", format!("{speed:.4}")),
    )
}

/// Returns what is wrong with the drive of a variant; empty if it is good.
pub(super) fn violations(class: Class, it: &Judgement) -> Vec<String> {
    let mut found = vec![];
    let mut find = |wrong: bool, what: String| {
        if wrong {
            found.push(what);
        }
    };
    find(
        it.verdict == Verdict::Refused,
        format!("refused: {}", it.reason),
    );
    find(
        it.collision_by_ego,
        "a collision that the vehicle caused".to_owned(),
    );
    find(
        it.excursion_m > EXCURSION_M,
        format!("excursion of {:.2} m", it.excursion_m),
    );
    find(
        it.calm_jerk_max > CALM_JERK,
        format!("jerk of {:.1} m/s³", it.calm_jerk_max),
    );
    if class == Class::Bends {
        find(
            it.lat_accel_max > LATERAL,
            format!("{:.2} m/s² sideways", it.lat_accel_max),
        );
    }
    let stands_at_end = it.verdict == Verdict::Stopped && it.takeover_asked_s.is_none();
    find(
        stands_at_end,
        "stopped without asking the driver".to_owned(),
    );
    found
}

/// Returns one line for each class: drives, collisions, excursions, jerks, and the worst figures.
pub(super) fn table(judged: &[(Class, Judgement)]) -> String {
    let mut text = format!(
        "{:20} drives  bad  collisions  excursion  calm jerk  lateral  braking\n",
        "class"
    );
    for class in Class::ALL {
        let of = || judged.iter().filter(|it| it.0 == class).map(|it| &it.1);
        let most = |value: fn(&Judgement) -> f64| of().map(value).fold(0.0, f64::max);
        // Writing to a string cannot fail.
        let _ = writeln!(
            text,
            "{:20} {:6}  {:3}  {:10}  {:7.2} m  {:9.1}  {:7.2}  {:7.1}",
            class.name(),
            of().count(),
            of().filter(|it| !violations(class, it).is_empty()).count(),
            of().filter(|it| it.collision_by_ego).count(),
            most(|it| it.excursion_m),
            most(|it| it.calm_jerk_max),
            most(|it| it.lat_accel_max),
            most(|it| it.brake_max),
        );
    }
    text
}
