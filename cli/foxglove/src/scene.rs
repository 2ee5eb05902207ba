//! Foxglove's messages from the values of a run: poses, boxes, lines. Units are m and rad, as in
//! Foxglove.

use foxglove::messages::{
    Color, CubePrimitive, Duration, FrameTransform, LinePrimitive, Point3, Pose, PoseInFrame,
    Quaternion, SceneEntity, SceneEntityDeletion, SceneUpdate, TextPrimitive, Timestamp, Vector3,
    line_primitive, scene_entity_deletion,
};
use tandem_bus::ClassCode;
use tandem_cores::driving::types::{Lanes, Object, Scene, Trajectory};

/// The frame of the scenario's road.
pub(crate) const MAP: &str = "map";
/// The frame of the vehicle: ISO 8855, origin at the centre of gravity.
pub(crate) const VEHICLE: &str = "vehicle";

/// A perceived entity disappears after this time without a new one, ns: six periods.
const LIFETIME_NS: u32 = 300_000_000;
/// Height of vehicles, which no sensor measures, m.
const HEIGHT_M: f64 = 1.5;
/// Length and width of the controlled vehicle as it is drawn, m.
const EGO_M: [f64; 2] = [4.5, 1.8];

const fn colour(r: f64, g: f64, b: f64) -> Color {
    Color { r, g, b, a: 0.9 }
}
const EGO: Color = colour(0.2, 0.5, 1.0);
const OTHER: Color = colour(0.7, 0.7, 0.7);
const CUTS_IN: Color = colour(1.0, 0.5, 0.1);
const BORDER: Color = colour(0.9, 0.9, 0.9);
const WAY: Color = colour(0.2, 0.8, 0.4);

/// Returns a point in time, ns since 1970, as Foxglove has it.
pub(crate) fn timestamp(ns: u64) -> Timestamp {
    let seconds = u32::try_from(ns / 1_000_000_000).unwrap_or(u32::MAX);
    Timestamp::new(seconds, (ns % 1_000_000_000) as u32)
}

fn turned(yaw: f64) -> Quaternion {
    let (z, w) = (yaw / 2.0).sin_cos();
    Quaternion {
        x: 0.0,
        y: 0.0,
        z,
        w,
    }
}

fn pose(x: f64, y: f64, z: f64, yaw: f64) -> Pose {
    Pose {
        position: Some(Vector3 { x, y, z }),
        orientation: Some(turned(yaw)),
    }
}

/// The pose of the vehicle on the map.
pub(crate) fn pose_on_map(ns: u64, x: f64, y: f64, heading: f64) -> PoseInFrame {
    PoseInFrame {
        timestamp: Some(timestamp(ns)),
        frame_id: MAP.to_owned(),
        pose: Some(pose(x, y, 0.0, heading)),
    }
}

/// The same as a transform, by which Foxglove places what the vehicle perceives.
pub(crate) fn transform(ns: u64, x: f64, y: f64, heading: f64) -> FrameTransform {
    FrameTransform {
        timestamp: Some(timestamp(ns)),
        parent_frame_id: MAP.to_owned(),
        child_frame_id: VEHICLE.to_owned(),
        translation: Some(Vector3 { x, y, z: 0.0 }),
        rotation: Some(turned(heading)),
    }
}

fn entity(ns: u64, id: &str) -> SceneEntity {
    SceneEntity {
        timestamp: Some(timestamp(ns)),
        frame_id: VEHICLE.to_owned(),
        id: id.to_owned(),
        lifetime: Some(Duration::new(0, LIFETIME_NS)),
        ..SceneEntity::default()
    }
}

fn only(ns: u64, entities: Vec<SceneEntity>) -> SceneUpdate {
    // An entity that is no longer there must not stay until its lifetime ends.
    let all = SceneEntityDeletion {
        timestamp: Some(timestamp(ns)),
        r#type: scene_entity_deletion::Type::All.into(),
        id: String::new(),
    };
    SceneUpdate {
        deletions: vec![all],
        entities,
    }
}

fn cube(pose: Pose, length: f64, width: f64, color: Color) -> CubePrimitive {
    CubePrimitive {
        pose: Some(pose),
        size: Some(Vector3 {
            x: length,
            y: width,
            z: HEIGHT_M,
        }),
        color: Some(color),
    }
}

fn line(points: Vec<Point3>, thickness: f64, color: Color) -> LinePrimitive {
    LinePrimitive {
        r#type: line_primitive::Type::LineStrip.into(),
        pose: Some(pose(0.0, 0.0, 0.0, 0.0)),
        thickness,
        points,
        color: Some(color),
        ..LinePrimitive::default()
    }
}

/// The vehicle itself.
pub(crate) fn ego(ns: u64) -> SceneUpdate {
    let [length, width] = EGO_M;
    let body = cube(pose(0.0, 0.0, HEIGHT_M / 2.0, 0.0), length, width, EGO);
    let entity = SceneEntity {
        frame_locked: true,
        cubes: vec![body],
        ..entity(ns, "ego")
    };
    only(ns, vec![entity])
}

/// The confirmed tracks of a scene, each with its number, class, speed and lane.
pub(crate) fn tracks(ns: u64, scene: &Scene) -> SceneUpdate {
    let entities = scene.objects.iter().map(|object| track(ns, object));
    only(ns, entities.collect())
}

fn track(ns: u64, object: &Object) -> SceneEntity {
    let (x, y) = (f64::from(object.x), f64::from(object.y));
    let yaw = tandem_watch::yaw(object);
    let color = if object.cuts_in { CUTS_IN } else { OTHER };
    let (length, width) = (f64::from(object.length), f64::from(object.width));
    let speed = object.vx.hypot(object.vy);
    let text = format!(
        "{} {} {speed:.1} m/s, lane {:+}",
        object.id,
        class_name(object.class),
        object.lane
    );
    let label = TextPrimitive {
        pose: Some(pose(x, y, HEIGHT_M + 0.5, 0.0)),
        billboard: true,
        font_size: 0.8,
        scale_invariant: false,
        color: Some(BORDER),
        text,
    };
    SceneEntity {
        cubes: vec![cube(pose(x, y, HEIGHT_M / 2.0, yaw), length, width, color)],
        texts: vec![label],
        ..entity(ns, &format!("track-{}", object.id))
    }
}

/// Returns the name of a class.
pub(crate) fn class_name(class: ClassCode) -> String {
    format!("{class:?}").to_lowercase()
}

/// The borders of the perceived lanes, as far as the camera sees them.
pub(crate) fn lanes(ns: u64, lanes: Option<&Lanes>) -> SceneUpdate {
    let Some(lanes) = lanes else {
        return only(ns, Vec::new());
    };
    let lines = tandem_watch::borders(lanes, 0.0, f32::INFINITY).into_iter();
    let lines = lines.map(|border| {
        let points = border.into_iter().map(|(x, y)| point(x, y));
        line(points.collect(), 0.15, BORDER)
    });
    let entity = SceneEntity {
        lines: lines.collect(),
        ..entity(ns, "lanes")
    };
    only(ns, vec![entity])
}

/// The planned way of the next 4 s.
pub(crate) fn trajectory(ns: u64, trajectory: &Trajectory) -> SceneUpdate {
    let points = trajectory.points.iter().map(|it| point(it.x, it.y));
    let entity = SceneEntity {
        lines: vec![line(points.collect(), 0.4, WAY)],
        ..entity(ns, "trajectory")
    };
    only(ns, vec![entity])
}

fn point(x: f32, y: f32) -> Point3 {
    Point3 {
        x: x.into(),
        y: y.into(),
        z: 0.05,
    }
}
