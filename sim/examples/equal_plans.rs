//! Counts how many plans of core 2 are bit-equal in both systems, and what differs in the others.
//! Arguments: seconds; drift of B's clock, ppb; `typical`, if jobs, wires and frames take time;
//! then scenarios, without any the embedded ones.
#![allow(clippy::print_stdout, reason = "its output is its purpose")]

use std::cell::RefCell;
use std::collections::BTreeMap;
use std::rc::Rc;

use tandem_board::{Board, CoreId, Duration, Instant};
use tandem_board_sim::{Config, Poller, SimBoard};
use tandem_cores::driving::types::{Object, Scene, Trajectory};
use tandem_cores::layout::{ControllerMap, SCENE, TRAJECTORY};
use tandem_cores::words::Payload;
use tandem_sim::drive::Drive;
use tandem_sim::time_chain::poller;
use tandem_sim::timing::Time;
use tandem_vehicle::Scenario;

/// What one system planned, in order.
type Plans = Rc<RefCell<[Vec<(Scene, Trajectory)>; 2]>>;

/// A core 2 whose plans are kept, each with its scene.
fn planner(board: &'static SimBoard, mut core: Poller, plans: &Plans) -> Poller {
    let plans = Rc::clone(plans);
    let system = board.identity().system.index();
    Box::new(move |polled| {
        let next = core(polled);
        let newest = || {
            let lmu = ControllerMap::attach(board).ok()?;
            let (_, scene) = SCENE.reader(&lmu.map).ok()?.read().ok()?;
            let (_, plan) = TRAJECTORY.reader(&lmu.map).ok()?.read().ok()?;
            (scene.cycle == plan.cycle).then_some((scene, plan))
        };
        if let Some(newest) = newest() {
            let kept = &mut plans.borrow_mut()[system];
            if kept
                .last()
                .is_none_or(|last| last.1.cycle != newest.1.cycle)
            {
                kept.push(newest);
            }
        }
        next
    })
}

fn words(value: &impl Payload) -> Vec<u32> {
    let mut words = vec![];
    value.store(&mut |word| words.push(word));
    words
}

/// Names the parts of two scenes that are not bit-equal, in the order in which they are computed.
fn differences(a: &Scene, b: &Scene) -> Vec<&'static str> {
    let ego = [a, b].map(|scene| format!("{:?}", scene.ego));
    let lanes = [a, b].map(|scene| format!("{:?}", scene.lanes));
    let objects = |part: fn(&Object) -> String| {
        [a, b].map(|scene| scene.objects.iter().map(part).collect::<Vec<_>>())
    };
    let differs = |part| {
        let [one, two] = objects(part);
        one != two
    };
    let parts = [
        ("instant", a.moment != b.moment),
        ("missing", a.missing != b.missing),
        ("camera line", a.camera.c != b.camera.c),
        ("ego", ego[0] != ego[1]),
        ("lanes", lanes[0] != lanes[1]),
        ("objects' number", a.objects.len() != b.objects.len()),
        ("ids", differs(|it| it.id.to_string())),
        ("places", differs(|it| format!("{} {}", it.x, it.y))),
        ("velocities", differs(|it| format!("{} {}", it.vx, it.vy))),
        (
            "accelerations",
            differs(|it| format!("{} {}", it.ax, it.ay)),
        ),
        ("sizes", differs(|it| format!("{} {}", it.length, it.width))),
        (
            "others",
            differs(|it| {
                format!(
                    "{:?} {} {} {}",
                    it.class, it.lane, it.cuts_in, it.approaching
                )
            }),
        ),
    ];
    parts
        .into_iter()
        .filter_map(|(name, differs)| differs.then_some(name))
        .collect()
}

/// Plans of the first 10 s: the systems start at different times.
const SETTLED: usize = 200;

/// Without the parts that are times or counts of one system.
fn content(mut plan: Trajectory) -> Vec<u32> {
    (plan.at, plan.measured, plan.cycle) = (Instant::ORIGIN, Instant::ORIGIN, 0);
    words(&plan)
}

fn main() {
    let mut arguments = std::env::args().skip(1);
    let seconds = arguments
        .next()
        .and_then(|text| text.parse().ok())
        .unwrap_or(60_u64);
    let drift_ppb = arguments
        .next()
        .and_then(|text| text.parse().ok())
        .unwrap_or(0);
    let mut scenarios: Vec<String> = arguments.collect();
    let before = scenarios.len();
    scenarios.retain(|name| name != "typical");
    let time = match scenarios.len() < before {
        true => Time::Typical,
        false => Time::Ideal,
    };
    if scenarios.is_empty() {
        scenarios = Scenario::names().map(str::to_owned).collect();
    }
    for scenario in scenarios {
        let plans = Plans::default();
        let kept = Rc::clone(&plans);
        let mut settings = Config {
            seed: 1,
            wires: time.wires(),
            ..Config::default()
        };
        settings.clocks[1].drift_ppb = drift_ppb;
        let mut drive = Drive::on_board(&scenario, settings, move |board| {
            let core = poller(board, time);
            if board.identity().core != CoreId::PLANNING {
                return core;
            }
            let board: &'static SimBoard = Box::leak(Box::new(board.clone()));
            planner(board, core, &kept)
        });
        drive.run_for(Duration::from_ms(seconds * 1_000));
        report(&scenario, &plans.borrow());
    }
}

fn report(scenario: &str, [a, b]: &[Vec<(Scene, Trajectory)>; 2]) {
    let (mut pairs, mut equal, mut same_scene, mut offsets) = (0_usize, 0_usize, 0_usize, vec![]);
    let (mut last, mut last_plan, mut settled) = (0, 0, [0, 0]);
    let mut why = BTreeMap::<String, usize>::new();
    let mut apart = [vec![], vec![]];
    // The clocks of the systems have different origins. Both hear the same camera lines.
    let line = |scene: &Scene| scene.camera.c.map(f32::to_bits);
    let origins = a.iter().find_map(|(scene, _)| {
        let (other, _) = b.iter().find(|(other, _)| line(other) == line(scene))?;
        Some(other.camera.at.as_ns() as i64 - scene.camera.at.as_ns() as i64)
    });
    let Some(origins) = origins else { return };
    for (scene, plan) in a {
        let late = |other: &Trajectory| other.at.as_ns() as i64 - plan.at.as_ns() as i64 - origins;
        let near = |other: &&(Scene, Trajectory)| late(&other.1).abs() < 25_000_000;
        let Some((other_scene, other)) = b.iter().find(near) else {
            continue;
        };
        pairs += 1;
        offsets.push(late(other).unsigned_abs());
        let is_equal = content(plan.clone()) == content(other.clone());
        equal += usize::from(is_equal);
        if pairs > SETTLED {
            settled = [settled[0] + 1, settled[1] + usize::from(is_equal)];
        }
        let mut found = differences(scene, other_scene);
        same_scene += usize::from(found.is_empty());
        let parts = [
            (
                "PLAN: maneuver",
                format!("{:?}", plan.maneuver) != format!("{:?}", other.maneuver),
            ),
            (
                "PLAN: memory",
                format!("{:?}", plan.memory) != format!("{:?}", other.memory),
            ),
            (
                "PLAN: points",
                format!("{:?}", plan.points) != format!("{:?}", other.points),
            ),
        ];
        found.extend(
            parts
                .into_iter()
                .filter_map(|(name, differs)| differs.then_some(name)),
        );
        if !found.is_empty() {
            last = last.max(pairs);
            if plan
                .points
                .iter()
                .zip(&other.points)
                .any(|(one, two)| one != two)
            {
                last_plan = pairs;
            }
        }
        *why.entry(found.join(", ")).or_default() += 1;
        let points = plan.points.iter().zip(&other.points);
        let far = points
            .clone()
            .map(|(one, two)| (one.x - two.x).hypot(one.y - two.y));
        apart[0].push(far.fold(0.0, f32::max));
        apart[1].push(
            points
                .map(|(one, two)| (one.speed - two.speed).abs())
                .fold(0.0, f32::max),
        );
    }
    apart.iter_mut().for_each(|all| all.sort_by(f32::total_cmp));
    let far = |all: &[f32], part: f64| all.get((all.len() as f64 * part) as usize).copied();
    offsets.sort_unstable();
    let at = |part: f64| {
        offsets
            .get((offsets.len() as f64 * part) as usize)
            .map_or(0, |ns| ns / 1_000)
    };
    println!(
        "{scenario}: {pairs} pairs, {equal} plans equal, {same_scene} scenes equal; instants apart \
         p50 {} p99 {} µs",
        at(0.5),
        at(0.99)
    );
    for (what, all) in [("points, m", &apart[0]), ("speed, m/s", &apart[1])] {
        let [p50, p99] = [0.5, 0.99].map(|part| far(all, part));
        println!(
            "    {what}: apart p50 {p50:?}, p99 {p99:?}, max {:?}",
            all.last()
        );
    }
    println!("    after the first 10 s: {} of {}", settled[1], settled[0]);
    println!("    the last that differs: number {last}; in its points: {last_plan}");
    for (why, count) in why {
        println!("    {count:6} differ in: {why}");
    }
}
