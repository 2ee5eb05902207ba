//! Compares the reader, the goals and the overlaps of this crate with independent implementations:
//! commonroad-io and its drivability checker.
#![allow(clippy::unwrap_used)]

use std::fmt::Write as _;
use std::io::Write as _;
use std::path::Path;
use std::process::{Command, Stdio};
use std::thread;

use chacha20::ChaCha8Rng;
use chacha20::rand_core::{Rng as _, SeedableRng as _};
use tandem_vehicle::commonroad::{RoadMap, parse};
use tandem_vehicle::geometry::{Footprint, Pose, Vec2};

const ROOM: &str = env!("CARGO_MANIFEST_DIR");

/// Returns whether both packages are installed. Without them a test passes and prints that it was
/// skipped; with `TANDEM_REQUIRE_COMMONROAD=1` it fails.
fn installed_or_skip(test: &str) -> bool {
    let import = Command::new("python3")
        .args(["-c", "import commonroad, commonroad_dc.pycrcc"])
        .output();
    if import.is_ok_and(|output| output.status.success()) {
        return true;
    }
    let missing = "commonroad-io or commonroad-drivability-checker is not installed (pip install \
                   commonroad-io commonroad-drivability-checker)";
    let required = std::env::var_os("TANDEM_REQUIRE_COMMONROAD").is_some_and(|value| value == "1");
    assert!(!required, "{test}: {missing}");
    // Not captured by the test runner, so that a skipped test is visible.
    let _ = writeln!(std::io::stderr(), "{test}: skipped: {missing}");
    false
}

/// Runs the script on this input and returns the lines that it prints.
fn oracle(arguments: &[&str], input: String) -> Vec<String> {
    let mut child = Command::new("python3")
        .arg(format!("{ROOM}/tests/commonroad_oracle.py"))
        .args(arguments)
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let mut stdin = child.stdin.take().unwrap();
    // A separate thread: both pipes may be full at the same time.
    let writer = thread::spawn(move || stdin.write_all(input.as_bytes()));
    let output = child.wait_with_output().unwrap();
    assert!(output.status.success(), "{arguments:?}: {}", output.status);
    writer.join().unwrap().unwrap();
    let text = String::from_utf8(output.stdout).unwrap();
    text.lines().map(str::to_owned).collect()
}

/// Uniformly distributed numbers between limits.
struct Draw(ChaCha8Rng);

impl Draw {
    fn within(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * f64::from(self.0.next_u32()) / f64::from(u32::MAX)
    }
}

fn near(what: &str, ours: f64, theirs: &serde_json::Value) {
    let theirs = theirs.as_f64().unwrap();
    assert!((ours - theirs).abs() < 1e-6, "{what}: {ours} {theirs}");
}

fn compare(file: &str, ours: &RoadMap, theirs: &serde_json::Value) {
    near("step", ours.step_s, &theirs["step_s"]);
    let ego = &theirs["ego"];
    near("ego x", ours.ego.position.x, &ego[1]);
    near("ego y", ours.ego.position.y, &ego[2]);
    near("ego yaw", ours.ego.yaw, &ego[3]);
    near("ego speed", ours.ego.speed.unwrap(), &ego[4]);
    let start = ego[0].as_f64().unwrap();
    let lanelets = theirs["lanelets"].as_object().unwrap();
    assert_eq!(ours.lanelets.len(), lanelets.len(), "{file}");
    for lanelet in &ours.lanelets {
        let other = &lanelets[&lanelet.id.to_string()];
        for (bound, points) in [(&lanelet.left, &other[0]), (&lanelet.right, &other[1])] {
            assert_eq!(bound.len(), points.as_array().unwrap().len(), "{file}");
            for (index, point) in bound.iter().enumerate() {
                near("bound x", point.x, &points[index][0]);
                near("bound y", point.y, &points[index][1]);
            }
        }
        let mut successors = lanelet.successors.clone();
        successors.sort_unstable();
        assert_eq!(serde_json::json!(successors), other[2], "{file}");
    }
    let obstacles = theirs["obstacles"].as_object().unwrap();
    let moving: Vec<_> = ours.obstacles.iter().filter(|it| !it.is_static).collect();
    assert_eq!(moving.len(), obstacles.len(), "{file}");
    for obstacle in moving {
        let states = obstacles[&obstacle.id.to_string()].as_array().unwrap();
        for (ours_at, theirs_at) in obstacle.states.iter().zip(states) {
            let what = format!("{file} obstacle {}", obstacle.id);
            let step = theirs_at[0].as_f64().unwrap() - start;
            near(&what, step * ours.step_s, &serde_json::json!(ours_at.t));
            near(&what, ours_at.position.x, &theirs_at[1]);
            near(&what, ours_at.position.y, &theirs_at[2]);
            near(&what, ours_at.yaw, &theirs_at[3]);
            near(&what, ours_at.speed.unwrap(), &theirs_at[4]);
        }
        assert_eq!(obstacle.states.len(), states.len(), "{file}");
    }
}

/// Lanelets, traffic and the ego's start, of all embedded scenarios.
#[test]
fn commonroad_io_reads_the_same() {
    if !installed_or_skip("commonroad_io_reads_the_same") {
        return;
    }
    let listed = std::fs::read_dir(Path::new(ROOM).join("scenarios")).unwrap();
    let paths = listed.map(|entry| entry.unwrap().path().display().to_string());
    let files: Vec<String> = paths.filter(|path| path.ends_with(".xml")).collect();
    assert!(files.len() > 3, "{files:?}");
    let arguments: Vec<&str> = std::iter::once("read")
        .chain(files.iter().map(String::as_str))
        .collect();
    let theirs = oracle(&arguments, String::new());
    for (file, theirs) in files.iter().zip(theirs) {
        let ours = parse(&std::fs::read_to_string(file).unwrap(), file).unwrap();
        compare(file, &ours, &serde_json::from_str(&theirs).unwrap());
    }
}

/// 2,000 states around a goal with a turned rectangle, an interval across ±π, speeds and times.
#[test]
fn commonroad_io_calls_the_same_goals_reached() {
    if !installed_or_skip("commonroad_io_calls_the_same_goals_reached") {
        return;
    }
    let base = include_str!("../fixtures/commonroad/sign-2020a.xml");
    let begin = base.find("<goalState>").unwrap();
    let end = base.find("</goalState>").unwrap();
    let interval = |name: &str, low: f64, high: f64| {
        format!(
            "<{name}><intervalStart>{low}</intervalStart><intervalEnd>{high}</intervalEnd></{name}>"
        )
    };
    let goal = format!(
        "<goalState>{}<position><rectangle><length>30</length><width>8</width>\
         <orientation>0.4</orientation><center><x>100</x><y>3</y></center></rectangle></position>\
         {}{}",
        "<time><intervalStart>10</intervalStart><intervalEnd>40</intervalEnd></time>",
        interval("orientation", 2.6, 3.9),
        interval("velocity", 5.0, 12.0),
    );
    let text = format!("{}{goal}{}", &base[..begin], &base[end..]);
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("goal.xml").display().to_string();
    std::fs::write(&file, &text).unwrap();
    let map = parse(&text, &file).unwrap();
    assert!(map.warnings.is_empty(), "{:?}", map.warnings);
    let mut draw = Draw(ChaCha8Rng::seed_from_u64(1));
    let (mut input, mut ours) = (String::new(), Vec::new());
    for _ in 0..2_000 {
        let step = draw.within(5.0, 45.0).round();
        let (x, y) = (draw.within(85.0, 115.0), draw.within(-6.0, 12.0));
        let (yaw, speed) = (draw.within(-3.1, 3.1), draw.within(4.0, 13.0));
        writeln!(input, "{step} {x} {y} {yaw} {speed}").unwrap();
        let t = step * map.step_s;
        ours.push(map.goals[0].is_reached(t, Vec2::new(x, y), yaw, speed));
    }
    let theirs = oracle(&["goal", &file], input);
    let reached = ours.iter().filter(|it| **it).count();
    assert!(reached > 50, "{reached} reached");
    for (index, (ours, theirs)) in ours.iter().zip(&theirs).enumerate() {
        assert_eq!(*ours, theirs == "1", "state {index}");
    }
    assert_eq!(ours.len(), theirs.len());
}

/// 5,000 pairs of rectangles, about half of which overlap.
#[test]
fn the_drivability_checker_finds_the_same_overlaps() {
    if !installed_or_skip("the_drivability_checker_finds_the_same_overlaps") {
        return;
    }
    let mut draw = Draw(ChaCha8Rng::seed_from_u64(2));
    let mut rectangle = || Footprint {
        pose: Pose {
            position: Vec2::new(draw.within(-4.0, 4.0), draw.within(-4.0, 4.0)),
            yaw: draw.within(-3.1, 3.1),
        },
        length: draw.within(0.5, 12.0),
        width: draw.within(0.3, 2.6),
    };
    let pairs: Vec<_> = (0..5_000).map(|_| (rectangle(), rectangle())).collect();
    let mut input = String::new();
    for (a, b) in &pairs {
        for it in [a, b] {
            let Pose { position, yaw } = it.pose;
            let (x, y) = (position.x, position.y);
            write!(input, "{x} {y} {yaw} {} {} ", it.length, it.width).unwrap();
        }
        input.push('\n');
    }
    let theirs = oracle(&["overlap"], input);
    assert_eq!(theirs.len(), pairs.len());
    let overlaps = theirs.iter().filter(|it| *it == "1").count();
    assert!((1_000..4_000).contains(&overlaps), "{overlaps}");
    for ((a, b), theirs) in pairs.iter().zip(&theirs) {
        assert_eq!(a.overlaps(b), theirs == "1", "{a:?} {b:?}");
    }
}
