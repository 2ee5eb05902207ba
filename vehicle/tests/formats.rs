//! CommonRoad files: both versions, every kind of value, and the errors of bad files.

#![allow(clippy::unwrap_used)]

use tandem_vehicle::commonroad::{self, Class, ProblemChoice, RoadMap};
use tandem_vehicle::geometry::Vec2;
use tandem_vehicle::{Scenario, ScenarioError};

const AREAS: &str = include_str!("../fixtures/commonroad/areas-2018b.xml");
const SIGN: &str = include_str!("../fixtures/commonroad/sign-2020a.xml");

fn map(text: &str) -> RoadMap {
    commonroad::parse(text, "test.xml").unwrap()
}

#[test]
fn version_2018b_with_areas_and_intervals() {
    let map = map(AREAS);
    assert_eq!(map.name, "ZAM_Areas-1_1_T-1");
    assert_eq!(map.lanelets.len(), 3);
    assert_eq!(map.lanelets[0].speed_limit, Some(25.5));
    assert_eq!(map.lanelets[0].left_neighbour, Some(3));
    assert_eq!(
        map.lanelets[1].right_neighbour, None,
        "opposite traffic is no neighbour"
    );
    assert_eq!((map.ego.t, map.ego.speed), (0.0, Some(22.0)));

    let truck = &map.obstacles[0];
    assert_eq!(
        (truck.class, truck.length, truck.width),
        (Class::Truck, 8.0, 2.5)
    );
    let [first, second] = &truck.states[..] else {
        panic!("{truck:?}")
    };
    assert_eq!(
        first.position,
        Vec2::new(60.0, 2.0),
        "the centre of the area"
    );
    assert!(
        (first.yaw - 0.1).abs() < 1e-12 && first.speed == Some(20.0),
        "midpoints"
    );
    assert!(
        first.t.abs() < 1e-12 && (second.t - 0.2).abs() < 1e-12,
        "since the ego's start"
    );
    assert_eq!(
        (second.position, second.speed),
        (Vec2::new(64.0, 2.0), None)
    );

    let pillar = &map.obstacles[1];
    assert_eq!(
        (pillar.class, pillar.length, pillar.is_static),
        (Class::Static, 1.0, true)
    );
    let polygon = &map.obstacles[2];
    assert_eq!((polygon.length, polygon.width), (4.0, 2.0));
    let centre = polygon.states[0].position;
    assert!(
        (centre - Vec2::new(120.0, -3.0)).norm() < 1e-6,
        "its centre, turned: {centre:?}"
    );
}

#[test]
fn version_2020a_with_sign_and_obstacles() {
    let map = map(SIGN);
    assert_eq!(map.lanelets[0].speed_limit, Some(13.89));
    assert_eq!(map.obstacles.len(), 2);
    assert!(map.obstacles[0].is_static && map.obstacles[0].class == Class::Car);
    assert_eq!(map.obstacles[1].class, Class::Motorcycle);
}

/// The driver's speed is that of the sign. Without a sign it is the highest speed in the file, of
/// any vehicle, but at least the speed limit of a town.
#[test]
fn the_set_speed_is_that_of_the_sign_or_else_of_the_traffic() {
    let unsigned = SIGN.replace("<trafficSignRef ref=\"70\"/>", "");
    let (before, ego) = unsigned.rsplit_once("<exact>12</exact>").unwrap();
    let of_ego = |speed: f64| format!("{before}<exact>{speed}</exact>{ego}");
    let of_other = |speed: f64| {
        let others = before.replace("<exact>12</exact>", &format!("<exact>{speed}</exact>"));
        format!("{others}<exact>12</exact>{ego}")
    };
    for (name, text, expected) in [
        ("the sign", SIGN.to_owned(), 13.89),
        ("a town", unsigned.clone(), 13.9),
        ("the ego", of_ego(17.0), 17.0),
        ("another", of_other(19.0), 19.0),
    ] {
        let scenario = Scenario::parse(&text, "test.xml").unwrap();
        assert_eq!(scenario.set_speed(), expected, "{name}");
    }
}

/// Each bad file is refused with its line, its element, and what to do.
#[test]
fn errors_name_file_line_element_and_a_way_out() {
    let cases = [
        (
            "commonRoadVersion=\"2018b\"",
            "commonRoadVersion=\"2099\"",
            "test.xml:3: <commonRoad>",
        ),
        (
            "timeStepSize=\"0.2\"",
            "timeStepSize=\"0\"",
            "timeStepSize 0e0; give seconds",
        ),
        (
            "timeStepSize=\"0.2\"",
            "timeStepSize=\"soon\"",
            "holds \"soon\"; give a finite number",
        ),
        (
            "<x>100</x><y>4</y>",
            "<x>inf</x><y>4</y>",
            "test.xml:5: <x> holds \"inf\"",
        ),
        (
            "<x>100</x><y>4</y>",
            "<x>1e200</x><y>4</y>",
            "test.xml:5: <x> holds \"1e200\"",
        ),
        (
            "<x>100</x><y>4</y>",
            "<x>100</x>",
            "test.xml:5: <point> lacks <y>; add <y>",
        ),
        (
            "<role>dynamic</role>",
            "<role>ghost</role>",
            "<obstacle id=\"10\"> has the role \"ghost\"",
        ),
        (
            "<lanelet id=\"2\">",
            "<lanelet id=\"two\">",
            "<lanelet id=\"two\"> refers to \"two\"",
        ),
        (
            "<lanelet id=\"2\">",
            "<lanelet>",
            "<lanelet> lacks the attribute \"id\"",
        ),
        (
            "<length>8</length>",
            "<length>-8</length>",
            "<length> is not positive",
        ),
        (
            "<velocity><exact>22<",
            "<velocity><exact>1000<",
            "faster than",
        ),
        (
            "timeStepSize=\"0.2\"",
            "timeStepSize=\"1e-308\"",
            "timeStepSize 1e-308; give seconds",
        ),
        (
            "<intervalStart>6<",
            "<intervalStart>1e7<",
            "<state> is more than a day away",
        ),
        (
            "<circle><radius>0.5</radius></circle>",
            "<star/>",
            "unknown shape <star>",
        ),
        (
            "<point><x>20</x><y>2.1</y></point>",
            "",
            "<position> is empty",
        ),
        (
            "planningProblem",
            "planningIssue",
            "<commonRoad> lacks <planningProblem>",
        ),
        (
            "<velocity><exact>22<",
            "<velocity><exact>-22<",
            "<initialState> begins backwards; give a velocity",
        ),
        (
            "<speedLimit>25.5<",
            "<speedLimit>-25.5<",
            "has a negative speed limit; give metres per second",
        ),
        ("</obstacle>", "", "not well-formed XML"),
    ];
    for (good, bad, expected) in cases {
        assert!(AREAS.contains(good), "{good}");
        let error = commonroad::parse(&AREAS.replace(good, bad), "test.xml").unwrap_err();
        assert!(
            error.to_string().contains(expected),
            "{error}\nlacks {expected:?}"
        );
        assert!(error.to_string().starts_with("test.xml:"), "{error}");
    }
}

/// An invalid part of a file is left out with a warning. The rest is used.
#[test]
fn what_cannot_be_used_is_left_out_with_a_warning() {
    let degenerate = "<lanelet id=\"9\"><leftBound><point><x>0</x><y>9</y></point><point><x>0</x>\
                      <y>9</y></point></leftBound><rightBound><point><x>0</x><y>8</y></point>\
                      <point><x>5</x><y>8</y></point></rightBound></lanelet><lanelet id=\"2\">";
    let cases = [
        (
            "<intervalStart>6<",
            "<intervalStart>-9<",
            "not later than the state before it",
        ),
        (
            "<lanelet id=\"2\">",
            degenerate,
            "<lanelet id=\"9\"> has a bound without length",
        ),
        (
            "</commonRoad>",
            "<planningProblem id=\"21\"/></commonRoad>",
            "is driven, the first of 2; --problem ID chooses another one",
        ),
    ];
    for (good, bad, expected) in cases {
        let used = map(&AREAS.replacen(good, bad, 1));
        let [warning] = &used.warnings[..] else {
            panic!("one warning: {:?}", used.warnings)
        };
        assert!(
            warning.starts_with("test.xml:") && warning.contains(expected),
            "{warning}"
        );
        assert_eq!(used.lanelets.len(), map(AREAS).lanelets.len());
    }
    assert!(map(AREAS).warnings.is_empty() && map(SIGN).warnings.is_empty());
}

/// Each planning problem of a file can be driven: by its place, or by its id. Without a choice the
/// first one is, and the warning says so.
#[test]
fn a_planning_problem_is_chosen() {
    let (first, rest) = SIGN.split_once("<planningProblem id=\"20\">").unwrap();
    let (problem, end) = rest.split_once("</planningProblem>").unwrap();
    let further = problem.replacen("<exact>12<", "<exact>9<", 1);
    let no_id = problem.replacen("<exact>12<", "<exact>7<", 1);
    let text = format!(
        "{first}<planningProblem id=\"20\">{problem}</planningProblem><planningProblem \
         id=\"-3\">{further}</planningProblem><planningProblem>{no_id}</planningProblem>{end}"
    );
    assert_eq!(commonroad::problem_ids(&text), [Some(20), Some(-3), None]);
    assert!(commonroad::problem_ids("<broken").is_empty());
    let chosen = |choice| commonroad::parse_problem(&text, "test.xml", choice);
    for (choice, speed, name) in [
        (ProblemChoice::First, 12.0, "planning problem 20 (1 of 3)"),
        (ProblemChoice::Id(20), 12.0, "planning problem 20 (1 of 3)"),
        (ProblemChoice::Id(-3), 9.0, "planning problem -3 (2 of 3)"),
        (
            ProblemChoice::Number(2),
            9.0,
            "planning problem -3 (2 of 3)",
        ),
        (
            ProblemChoice::Number(3),
            7.0,
            "planning problem 3 of 3, without an id",
        ),
    ] {
        let map = chosen(choice).unwrap();
        assert_eq!(map.ego.speed, Some(speed), "{choice:?}");
        assert_eq!(map.problem.to_string(), name);
        assert_eq!(
            map.warnings.len(),
            usize::from(choice == ProblemChoice::First)
        );
    }
    for choice in [
        ProblemChoice::Id(7),
        ProblemChoice::Number(0),
        ProblemChoice::Number(4),
    ] {
        let error = chosen(choice).unwrap_err().to_string();
        assert!(error.contains("choose one of 20, -3"), "{error}");
    }
    let many = "<planningProblem id=\"4\"/>".repeat(200);
    let many = text.replace("</commonRoad>", &format!("{many}</commonRoad>"));
    assert!(commonroad::parse(&many, "test.xml").is_err());
}

/// A zebra across the lane is no junction, and anything else across it is one that is named.
#[test]
fn a_zebra_across_the_lane_is_no_junction() {
    let lanelet = |id: u32, [left, right]: [[(f64, f64); 2]; 2], rest: &str| {
        let bound = |name: &str, points: [(f64, f64); 2]| {
            let point = |(x, y)| format!("<point><x>{x}</x><y>{y}</y></point>");
            format!("<{name}>{}</{name}>", points.map(point).concat())
        };
        let bounds = bound("leftBound", left) + &bound("rightBound", right);
        format!("<lanelet id=\"{id}\">{bounds}{rest}</lanelet>")
    };
    let own = [
        [(-50.0, 1.75), (400.0, 1.75)],
        [(-50.0, -1.75), (400.0, -1.75)],
    ];
    let across = [[(60.0, -8.0), (60.0, 8.0)], [(63.0, -8.0), (63.0, 8.0)]];
    for (kind, reason) in [
        ("crosswalk", None),
        (
            "sidewalk",
            Some("a junction (lanelet 2 at 90° to the lane) 60 m ahead of the start"),
        ),
    ] {
        let kind = format!("<laneletType>{kind}</laneletType>");
        let xml = format!(
            "<commonRoad commonRoadVersion=\"2020a\" timeStepSize=\"0.1\" benchmarkID=\"zebra\">{}{}\
             <planningProblem id=\"9\"><initialState><position><point><x>0</x><y>0</y></point>\
             </position><orientation><exact>0</exact></orientation><time><exact>0</exact></time>\
             <velocity><exact>20</exact></velocity></initialState></planningProblem></commonRoad>",
            lanelet(1, own, ""),
            lanelet(2, across, &kind),
        );
        let scenario = Scenario::parse(&xml, "zebra").unwrap();
        assert_eq!(scenario.outside_domain(), reason, "{kind}");
        assert!(scenario.warnings().is_empty(), "{:?}", scenario.warnings());
    }
}

/// Small files that could take long to read are refused with the reason, or read quickly: no case
/// takes seconds.
#[test]
fn files_that_ask_for_much_are_refused() {
    let point = |x: f64, y: f64| format!("<point><x>{x}</x><y>{y}</y></point>");
    let lanelet = |id: usize, x: f64, length: f64, rest: &str| {
        let bound = |y: f64| point(x, y) + &point(x + length, y);
        format!(
            "<lanelet id=\"{id}\"><leftBound>{}</leftBound><rightBound>{}</rightBound>{rest}\
             </lanelet>",
            bound(3.5),
            bound(0.0)
        )
    };
    let next = |id: usize| format!("<successor ref=\"{id}\"/>");
    let chain = (0..40).map(|i| lanelet(100 + i, 9e4 * i as f64, 9e4, &next(101 + i)));
    let jumps = (0..40).map(|i| lanelet(100 + i, 1e6 * i as f64, 50.0, &next(101 + i)));
    let same_place = (0..2_000).map(|i| lanelet(100 + i, 0.0, 50.0, ""));
    let rows = (0..6_000).map(|i| lanelet(100 + i, 0.0, 50.0, ""));
    let branches: String = (0..60).map(next).collect();
    let attributes: String = (0..9_000).map(|i| format!(" a{i}=\"\"")).collect();
    let with = |added: String| SIGN.replace("<trafficSign id", &(added + "<trafficSign id"));
    let cases = [
        (with(chain.collect()), "km long"),
        (with(rows.collect()), "more than 5000 <lanelet>"),
        (
            with(lanelet(100, 0.0, 50.0, &branches)),
            "more than 50 <successor>",
        ),
        (
            with(format!("<a{attributes}/>")),
            "more than 100 attributes",
        ),
        (" ".repeat(commonroad::FILE_MAX + 1), "larger than 32 MiB"),
        (with("<a/>".repeat(2_000_001)), "nodes limit"),
        (with("<obstacle/>".to_owned()), "lacks <role>"),
    ];
    for (text, expected) in cases {
        let error = Scenario::parse(&text, "test.xml").unwrap_err().to_string();
        assert!(error.contains(expected), "{error}\nlacks {expected:?}");
    }
    for text in [with(jumps.collect()), with(same_place.collect())] {
        let scenario = Scenario::parse(&text, "test.xml").unwrap();
        let length: usize = scenario
            .road()
            .lanes()
            .iter()
            .map(|l| l.lanelets.len())
            .sum();
        assert!(length < 2_100, "no lane leads over a gap: {length}");
    }
}

#[test]
fn unknown_names_and_unreadable_files_say_what_there_is() {
    let error = Scenario::load("cutin").unwrap_err().to_string();
    assert!(
        error.contains("did you mean \"cut-in\"") && error.contains("stop-and-go"),
        "{error}"
    );
    let error = Scenario::load("xyz").unwrap_err().to_string();
    assert!(!error.contains("did you mean"), "{error}");
    let error = Scenario::load("no/such/file.xml").unwrap_err();
    assert!(matches!(error, ScenarioError::Read { .. }), "{error}");
    assert!(error.to_string().contains("no/such/file.xml"), "{error}");
    let folder = env!("CARGO_MANIFEST_DIR");
    assert!(matches!(
        Scenario::load(folder),
        Err(ScenarioError::Read { .. })
    ));
}

#[test]
fn every_embedded_scenario_has_its_name() {
    assert_eq!(Scenario::names().len(), 7);
    for name in Scenario::names() {
        assert_eq!(Scenario::load(name).unwrap().name(), name);
    }
}
