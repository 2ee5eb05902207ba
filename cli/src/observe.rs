//! What the vehicle, the bus and the cores report, in the words of the run log.

use tandem_board::Traced;
use tandem_bus::Message;
use tandem_cores::trace::{Event, FloodSource};
use tandem_redundancy::{Evidence, Phase};
use tandem_vehicle::geometry::Vec2;
use tandem_vehicle::road::{Frenet, Road};
use tandem_vehicle::{Acceptance, Metrics, VehicleSnapshot};

use crate::runlog::{
    ControlSeen, CoreEvent, Figures, Lane, Mode, Other, Role, StatusSeen, System, Verdict, What,
};

/// The road is recorded so far back and ahead of the vehicle, m, in steps of [`ROAD_STEP_M`].
const ROAD_BACK_M: f64 = 100.0;
const ROAD_AHEAD_M: f64 = 400.0;
const ROAD_STEP_M: f64 = 4.0;
/// Lanes that are further aside are other roads, m.
const ROAD_ASIDE_M: f64 = 30.0;

const fn system(index: u8) -> System {
    if index == 0 { System::A } else { System::B }
}

const fn role(role: tandem_bus::Role) -> Role {
    match role {
        tandem_bus::Role::Starting => Role::Starting,
        tandem_bus::Role::Master => Role::Master,
        tandem_bus::Role::Standby => Role::Standby,
        tandem_bus::Role::Suspended => Role::Suspended,
    }
}

const fn mode(mode: tandem_bus::Mode) -> Mode {
    match mode {
        tandem_bus::Mode::None => Mode::None,
        tandem_bus::Mode::L3 => Mode::L3,
        tandem_bus::Mode::DegradedL2 => Mode::DegradedL2,
        tandem_bus::Mode::SafeStop => Mode::SafeStop,
    }
}

/// A control frame that the vehicle has judged; `message` is what it holds.
pub(crate) fn control(seen: Acceptance, sent_ns: u64, message: Option<&Message>) -> ControlSeen {
    ControlSeen {
        at_ns: seen.at_ns,
        sent_ns,
        system: system(seen.system),
        term: seen.term,
        mode: match message {
            Some(Message::Control { control, .. }) => mode(control.mode),
            _ => Mode::None,
        },
        verdict: match seen.verdict {
            tandem_vehicle::Verdict::Accepted => Verdict::Accepted,
            tandem_vehicle::Verdict::Fenced => Verdict::Fenced,
            tandem_vehicle::Verdict::NotMaster => Verdict::NotMaster,
            tandem_vehicle::Verdict::Invalid => Verdict::Invalid,
        },
    }
}

/// A status frame; `None` if it is another one.
pub(crate) fn status(at_ns: u64, message: &Message) -> Option<StatusSeen> {
    match message {
        Message::Status {
            system: index,
            status,
        } => Some(StatusSeen {
            at_ns,
            system: system(*index),
            role: role(status.role),
            mode: mode(status.mode),
            term: status.term,
        }),
        _ => None,
    }
}

/// A control cycle that begins later than this has missed its slot: half a control period. Punctual
/// timers are late by tens of microseconds; this much is a CPU that was taken away.
const LATE_NS: u32 = 5_000_000;

/// A core's trace record; `None` if it has no meaning or comes in every cycle without a use here.
pub(crate) fn event(traced: Traced) -> Option<CoreEvent> {
    let what = match Event::decode(traced.record)? {
        Event::Started { generation, cause } => {
            let causes = ["power-on", "software", "watchdog", "trap"];
            let cause = causes.get(usize::from(cause)).unwrap_or(&"unknown cause");
            What::Started {
                generation,
                cause: (*cause).to_owned(),
            }
        }
        Event::Role {
            role: role_code,
            mode: mode_code,
            term,
        } => What::RoleChanged {
            role: role(*tandem_bus::Role::ALL.get(usize::from(role_code))?),
            mode: mode(*tandem_bus::Mode::ALL.get(usize::from(mode_code))?),
            term,
        },
        Event::TookOver {
            cause,
            since_heartbeat_us,
            since_control_us,
            ..
        } => What::TookOver {
            // A mute master's heart goes on beating.
            detected_ms: f64::from(match cause {
                Evidence::MasterMute => since_control_us,
                _ => since_heartbeat_us,
            }) * 1e-3,
            cause: evidence_in_words(cause).to_owned(),
        },
        Event::Chain { latency_ns, .. } => What::ChainDone {
            latency_ms: f64::from(latency_ns) * 1e-6,
        },
        Event::Phase {
            to: Phase::Thawed, ..
        } => What::HeldUp,
        Event::ControlCycle { lateness_ns, .. } if lateness_ns > LATE_NS => What::LateCycle {
            late_ms: f64::from(lateness_ns) * 1e-6,
        },
        Event::CoreSilent { core } => What::CoreSilent { core },
        Event::DeadlineMiss { missed } => What::DeadlineMiss { missed },
        other => What::Note { text: note(other)? },
    };
    let (system, core) = (System::from(traced.system), traced.core.index() as u8);
    Some(CoreEvent {
        at_ns: traced.at.as_ns(),
        system,
        core,
        what,
    })
}

/// An event in words, for a timeline; `None` if it has a form of its own there.
pub(crate) fn words(event: Event) -> Option<String> {
    Some(match event {
        Event::Started { generation, .. } => format!("starts, life {generation}"),
        Event::Role { term, .. } => format!("new role, term {term}"),
        Event::TookOver { cause, .. } => format!("takes over: {}", evidence_in_words(cause)),
        Event::CoreSilent { core } => format!("core {core} does not answer"),
        Event::DeadlineMiss { missed } => format!("{missed} control cycle(s) left out"),
        other => note(other)?,
    })
}

/// An event that no figure needs, in words.
fn note(event: Event) -> Option<String> {
    Some(match event {
        Event::Phase { from, to, on } => {
            format!("from {from:?} to {to:?}: {}", evidence_in_words(on))
        }
        Event::PeerFailed(true) => "takes the other system for failed".to_owned(),
        Event::PeerFailed(false) => "no longer takes the other system for failed".to_owned(),
        Event::Line { line, silent: true } => format!("heartbeat line {line} is silent"),
        Event::Line {
            line,
            silent: false,
        } => format!("heartbeat line {line} is back"),
        Event::LinesSplit => "both heartbeat lines are cut, the other system lives".to_owned(),
        Event::CanSilent(true) => "hears nothing on CAN".to_owned(),
        Event::CanSilent(false) => "hears CAN again".to_owned(),
        Event::Ignored { term: 0 } => "has ignored an implausible frame".to_owned(),
        Event::Ignored { term } => format!("has ignored a frame of the outdated term {term}"),
        Event::TermRaised { term } => format!("raises its term to {term}"),
        Event::StateLost => "the state in flash was lost".to_owned(),
        Event::Refused { id: 0 } => "has refused what the shared memory held".to_owned(),
        Event::Refused { id } => format!("has refused a frame with id {id:03X}"),
        Event::Flood {
            source,
            times,
            beyond,
        } => format!(
            "is flooded by {}: limit reached {times} times, {beyond} beyond it",
            flood_source_in_words(source)
        ),
        Event::Started { .. }
        | Event::Role { .. }
        | Event::TookOver { .. }
        | Event::ControlCycle { .. }
        | Event::Chain { .. }
        | Event::CoreSilent { .. }
        | Event::DeadlineMiss { .. }
        | Event::TaskIn { .. }
        | Event::TaskOut { .. }
        | Event::Ready { .. }
        | Event::IrqIn { .. }
        | Event::IrqOut { .. }
        | Event::Interrupted { .. }
        | Event::Wake { .. }
        | Event::Woken { .. }
        | Event::Ring { .. }
        | Event::Stack { .. }
        | Event::Held { .. } => return None,
    })
}

const fn flood_source_in_words(source: FloodSource) -> &'static str {
    match source {
        FloodSource::Can => "CAN frames",
        FloodSource::Link => "datagrams on the link",
        FloodSource::StartLine => "edges on the start line",
        FloodSource::HeartbeatLines => "edges on a heartbeat line",
        FloodSource::Doorbell => "doorbells",
    }
}

const fn evidence_in_words(evidence: Evidence) -> &'static str {
    match evidence {
        Evidence::SyncHeard => "sync edge of the other system",
        Evidence::PeerRuns => "the other system is running",
        Evidence::HandshakeDone => "handshake done",
        Evidence::NobodyThere => "nobody has answered",
        Evidence::PeerOff => "power level fell",
        Evidence::PeerSilent => "heartbeats and control frames silent",
        Evidence::BeatsSilent => "heartbeats silent",
        Evidence::MasterMute => "control frames missing",
        Evidence::HigherTerm => "the other system drives in a higher term",
        Evidence::BeatsBack => "heartbeats are back",
        Evidence::PeerStable => "the other system is back for good",
        Evidence::Stalled => "was held up",
        Evidence::ListenOver => "the other system has not taken over",
        Evidence::FaultReset => "own fault, a reset may cure it",
        Evidence::FaultStop => "own fault while alone",
        Evidence::FaultSuspend => "own fault that stays",
    }
}

/// The vehicle's own figures.
pub(crate) fn figures(metrics: &Metrics) -> Figures {
    let finite = |value: f64| Some(value).filter(|value| value.is_finite());
    Figures {
        collisions: metrics.collisions,
        lateral_error_max_m: metrics.lateral_error_max_m,
        lane_changes: metrics.lane_changes,
        gap_min_m: finite(metrics.gap_min_m),
        ttc_min_s: finite(metrics.ttc_min_s),
        accel_max: metrics.acceleration_max,
        brake_max: metrics.deceleration_max,
        lat_accel_max: metrics.lateral_acceleration_max,
        jerk_p99: metrics.jerk_p99,
        distance_m: metrics.distance_m,
    }
}

/// Another vehicle.
pub(crate) fn other(vehicle: &VehicleSnapshot) -> Other {
    Other {
        x: vehicle.pose.position.x,
        y: vehicle.pose.position.y,
        heading: vehicle.pose.yaw,
        length: vehicle.length,
        width: vehicle.width,
    }
}

/// The lanes around a point.
pub(crate) fn lanes(road: &Road, near: Vec2) -> Vec<Lane> {
    let count = ((ROAD_BACK_M + ROAD_AHEAD_M) / ROAD_STEP_M) as u32;
    let around = |lane: &tandem_vehicle::road::Lane| {
        let place = lane.project(near);
        let mut borders = Lane::default();
        let stations =
            (0..=count).map(|step| place.s - ROAD_BACK_M + f64::from(step) * ROAD_STEP_M);
        for s in stations.filter(|s| lane.exists_at(*s)) {
            let half = lane.at(s).width / 2.0;
            let at = |d: f64| {
                let point = lane.point(Frenet { s, d });
                // A tenth of a metre is finer than any screen.
                [
                    (point.x * 10.0).round() / 10.0,
                    (point.y * 10.0).round() / 10.0,
                ]
            };
            borders.left.push(at(half));
            borders.right.push(at(-half));
        }
        (place.d.abs() <= ROAD_ASIDE_M && borders.left.len() > 1).then_some(borders)
    };
    road.lanes().iter().filter_map(around).collect()
}
