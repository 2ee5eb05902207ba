//! What the tests share: any message as a proptest strategy, and its values by their DBC names.

use proptest::prelude::*;
use tandem_bus::{
    Agreement, CameraLanes, Class, Control, DriverRequest, EgoMotion, GateEcho, Message, Mode,
    Role, Route, SensorHeader, SensorId, SensorObject, Status,
};

/// Any value, mostly within `limit`, so that the tests check the scaling and not only the
/// saturation.
fn within(limit: f32) -> impl Strategy<Value = f32> + Clone {
    let special = prop::sample::select(&[f32::NAN, f32::INFINITY, f32::NEG_INFINITY][..]);
    prop_oneof![8 => -limit..=limit, 1 => any::<f32>(), 1 => special]
}

fn control() -> impl Strategy<Value = Control> {
    let enums = (
        prop::sample::select(&Role::ALL[..]),
        prop::sample::select(&Mode::ALL[..]),
    );
    (
        enums,
        any::<(bool, u32)>(),
        within(0.7),
        within(33.0),
        (within(7000.0), any::<u16>()),
    )
        .prop_map(
            |(
                (role, mode),
                (takeover_request, term),
                steering_angle,
                acceleration,
                (command_age, sent_at),
            )| Control {
                role,
                mode,
                takeover_request,
                term,
                steering_angle,
                acceleration,
                command_age,
                sent_at,
            },
        )
}

fn status() -> impl Strategy<Value = Status> {
    let enums = (
        prop::sample::select(&Role::ALL[..]),
        prop::sample::select(&Mode::ALL[..]),
        prop::sample::select(&Agreement::ALL[..]),
    );
    (
        enums,
        any::<[bool; 4]>(),
        any::<u32>(),
        any::<[u16; 2]>(),
        any::<[u8; 3]>(),
    )
        .prop_map(
            |((role, mode, agreement), flags, term, resets, bytes)| Status {
                role,
                mode,
                agreement,
                sys_failure: flags[0],
                cpsys_failure: flags[1],
                line1_silent: flags[2],
                line2_silent: flags[3],
                failure_mode: bytes[0],
                term,
                abn_resets: resets[0],
                total_resets: resets[1],
                tracks: bytes[1],
                deadline_misses: bytes[2],
            },
        )
}

fn ego_motion() -> impl Strategy<Value = EgoMotion> {
    let accelerations = (within(70.0), within(70.0));
    (
        any::<bool>(),
        within(330.0),
        within(3.3),
        accelerations,
        within(0.7),
        within(0.7),
    )
        .prop_map(
            |(world_running, speed, yaw_rate, acceleration, steering_angle, slip_angle)| {
                EgoMotion {
                    world_running,
                    speed,
                    yaw_rate,
                    long_acceleration: acceleration.0,
                    lat_acceleration: acceleration.1,
                    steering_angle,
                    slip_angle,
                }
            },
        )
}

fn sensor_object() -> impl Strategy<Value = SensorObject> {
    let place = prop::array::uniform4(within(330.0));
    let size = (within(26.0), within(13.0), within(6.0), within(6.0));
    (
        any::<u8>(),
        prop::sample::select(&Class::ALL[..]),
        place,
        size,
    )
        .prop_map(
            |(index, class, [x, y, vx, vy], (length, width, x_deviation, y_deviation))| {
                SensorObject {
                    index,
                    class,
                    x,
                    y,
                    vx,
                    vy,
                    length,
                    width,
                    x_deviation,
                    y_deviation,
                }
            },
        )
}

fn camera_lanes() -> impl Strategy<Value = CameraLanes> {
    let c = (within(33.0), within(1.7), within(0.04), within(0.0004));
    let widths = prop::array::uniform3(within(6.0));
    let ends = prop::array::uniform3(within(7000.0));
    (
        any::<[bool; 4]>(),
        c,
        any::<u8>(),
        widths,
        ends,
        within(700.0),
    )
        .prop_map(
            |(flags, (c0, c1, c2, c3), view_range, widths, ends, speed_limit)| CameraLanes {
                valid: flags[0],
                left_exists: flags[1],
                right_exists: flags[2],
                ends_domain: flags[3],
                c0,
                c1,
                c2,
                c3,
                view_range,
                width: widths[0],
                left_width: widths[1],
                right_width: widths[2],
                own_end: ends[0],
                left_end: ends[1],
                right_end: ends[2],
                speed_limit,
            },
        )
}

/// Any message, including values that no frame can hold.
pub(crate) fn message() -> impl Strategy<Value = Message> {
    let sensor = prop::sample::select(&SensorId::ALL[..]);
    let header = any::<(u8, u32)>().prop_map(|(object_count, measured_at)| SensorHeader {
        object_count,
        measured_at,
    });
    let route = prop::sample::select(vec![Route::Free, Route::Left, Route::Right, Route::Keep]);
    let request = (any::<[bool; 3]>(), route, within(700.0), within(2.0)).prop_map(
        |([engage, overrides, near_gap], route, set_speed, lane_offset)| DriverRequest {
            engage,
            overrides,
            route,
            near_gap,
            set_speed,
            lane_offset,
        },
    );
    let numbers = any::<(u32, u8, u8, u8)>();
    let echo = (numbers, within(7000.0), within(0.7), within(33.0)).prop_map(
        |((term, obeyed_counter, refused, sent_at), term_age, steering_angle, acceleration)| {
            GateEcho {
                refused,
                term,
                term_age,
                obeyed_counter,
                sent_at,
                steering_angle,
                acceleration,
            }
        },
    );
    prop_oneof![
        echo.prop_map(Message::GateEcho),
        (0..2_u8, control()).prop_map(|(system, control)| Message::Control { system, control }),
        (0..2_u8, status()).prop_map(|(system, status)| Message::Status { system, status }),
        ego_motion().prop_map(Message::EgoMotion),
        request.prop_map(Message::DriverRequest),
        (sensor.clone(), header).prop_map(|(sensor, h)| Message::SensorHeader(sensor, h)),
        (sensor, sensor_object()).prop_map(|(sensor, o)| Message::SensorObject(sensor, o)),
        camera_lanes().prop_map(Message::CameraLanes),
    ]
}

/// The physical values of a message by their DBC names; enums and flags as numbers.
pub(crate) fn values(message: &Message) -> Vec<(&'static str, f64)> {
    match message {
        Message::Control { system, control } => {
            let framing = [("System", f64::from(*system))];
            control.values().into_iter().chain(framing).collect()
        }
        Message::Status { status, .. } => status.values().into(),
        Message::GateEcho(echo) => echo.values().into(),
        Message::EgoMotion(motion) => motion.values().into(),
        Message::DriverRequest(request) => request.values().into(),
        Message::SensorHeader(_, header) => header.values().into(),
        Message::SensorObject(_, object) => object.values().into(),
        Message::CameraLanes(lanes) => lanes.values().into(),
    }
}
