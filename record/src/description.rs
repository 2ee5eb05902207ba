//! Describes events in words, for readers of a report.

use tandem_board::{CanErrors, CanState, ResetCause, SupplyEvent};
use tandem_bus::{ModeCode, SensorId};
use tandem_cores::task_table::TaskCode;
use tandem_cores::trace::{Event, FloodSource};
use tandem_redundancy::{Evidence, Phase};
use tandem_timesync::TimeStatus;
use tandem_timesync::gptp::Why;

use crate::roles::RoleState;
use crate::takeover::{Takeover, detected_ms, is_late};

/// Tests whether a core or its scheduler writes this event in every cycle. Lists omit such events.
#[must_use]
pub const fn is_routine(event: &Event) -> bool {
    matches!(
        event,
        Event::ControlCycle { .. }
            | Event::Chain { .. }
            | Event::TaskIn { .. }
            | Event::TaskOut { .. }
            | Event::Wake { .. }
            | Event::Ring { .. }
            | Event::Woken { .. }
            | Event::Time { .. }
            | Event::TimeSample { .. }
    )
}

/// Returns a core's event in words; `None` for events of every cycle and events of a scheduler.
#[must_use]
pub fn core_event(event: Event) -> Option<String> {
    Some(match event {
        Event::Started { generation, cause } => {
            let cause = ResetCause::from_code(cause.into()).map_or("unknown cause", reset_cause);
            format!("starts, incarnation {generation}: {cause}")
        }
        Event::Role { role, mode, term } => {
            let full = mode == ModeCode::L3 as u8;
            let state = RoleState::of_codes(role, mode)?.name();
            format!("is {state}{}, term {term}", if full { ", L3" } else { "" })
        }
        Event::TookOver { cause, .. } => format!(
            "takes over: {}, detected in {:.2} ms",
            evidence(cause),
            detected_ms(event)?
        ),
        Event::Phase {
            to: Phase::Thawed, ..
        } => "was held up, and listens whether the other system drives by now".to_owned(),
        Event::Phase { from, to, on } => format!("from {from:?} to {to:?}: {}", evidence(on)),
        Event::ControlCycle { lateness_ns, .. } if is_late(event) => format!(
            "began a control cycle {:.1} ms late",
            f64::from(lateness_ns) * 1e-6
        ),
        Event::CoreSilent { core } => format!("core {core} of its own system does not answer"),
        Event::DeadlineMiss { task, missed } if task != TaskCode::ROLES => {
            let name = task.name().unwrap_or("a task");
            format!("{name}: left out {missed} cycle(s)")
        }
        Event::FramesLost { count } => {
            format!("lost {count} received CAN frame(s), which it did not fetch in time")
        }
        Event::Sensors { missing: 0 } => "all sensors are back".to_owned(),
        Event::Sensors { missing } => format!("lost or late: {}", names(missing)),
        Event::Ability { bits, missing } => match bits {
            0 => "can drive, and has all sensors".to_owned(),
            1 => format!("can drive without {}", names(missing)),
            2 => format!("can only stop the vehicle, without {}", names(missing)),
            _ => format!("can only brake, without {}", names(missing)),
        },
        Event::CanErrors { errors } => {
            let state = match errors.state() {
                CanState::ErrorActive => "error-active",
                CanState::ErrorPassive => "error-passive",
                CanState::BusOff => "bus-off",
            };
            let CanErrors {
                transmit,
                receive,
                bus_offs,
            } = errors;
            format!(
                "its CAN controller is {state}: {transmit} transmit, {receive} receive errors, \
                 bus-off {bus_offs} time(s)"
            )
        }
        Event::PeerFailed(true) => "considers the other system failed".to_owned(),
        Event::PeerFailed(false) => "no longer considers the other system failed".to_owned(),
        Event::Line { line, silent } => match (line, silent) {
            (1 | 2, true) => format!("heartbeat line {line} is silent"),
            (1 | 2, false) => format!("heartbeat line {line} is back"),
            (3, true) => "the power level line is broken: low, and the other lives".to_owned(),
            (3, false) => "the power level line is whole again".to_owned(),
            _ => "no edge came on the start line since the start".to_owned(),
        },
        Event::LinesSplit => "both heartbeat lines are cut, the other system lives".to_owned(),
        Event::CanSilent(true) => "hears nothing on CAN".to_owned(),
        Event::CanSilent(false) => "hears CAN again".to_owned(),
        Event::Ignored { term: 0 } => "ignored an implausible frame".to_owned(),
        Event::Ignored { term } => {
            format!("ignored the term {term}: outdated, or far and unexplained")
        }
        Event::TermRaised { term } => format!("raises its term to {term}"),
        Event::StateLost => "the state in flash was lost".to_owned(),
        Event::Refused { id: 0 } => "refused what the shared memory held".to_owned(),
        Event::Refused { id } => format!("refused a frame with id {id:03X}"),
        Event::Agreement { stage, percent } => match stage {
            0 => format!("the other system agrees; the difference used {percent} % of its limit"),
            1 => "the other system would command something else".to_owned(),
            _ => "the systems disagree without a known cause: stops the vehicle".to_owned(),
        },
        Event::WrongCommand { witness: 0 } => {
            "leaves: the vehicle did not obey what it sent".to_owned()
        }
        Event::WrongCommand { .. } => {
            "leaves: core 2 computes another command from the same inputs".to_owned()
        }
        Event::WrongScene {
            what,
            hearing,
            thousandths,
        } => {
            let wrong = if hearing {
                "core 0 hears"
            } else {
                "the scene has"
            };
            let (what, amount) = scene_value(what, thousandths);
            format!("leaves: {wrong} wrong {what}, by {amount}")
        }
        Event::PeerScene {
            what,
            own,
            thousandths,
        } => {
            let (what, amount) = scene_value(what, thousandths);
            let wrong = if own {
                "leaves: its own has jumped"
            } else {
                "stays"
            };
            format!("the scenes of both systems differ in {what}, by {amount}: {wrong}")
        }
        Event::WrongTrajectory { what, percent } => {
            let what = match what {
                0 => "begins elsewhere than the vehicle is",
                1 => "has points that no vehicle drives to",
                2 => "is beyond the limits of the vehicle",
                3 => "leaves the lane",
                _ => "passes through a vehicle ahead",
            };
            format!("leaves: its trajectory {what}, {percent} % of the limit")
        }
        Event::TrajectoryCheck { percent, .. } => {
            format!("a right trajectory used {percent} % of a limit")
        }
        Event::SceneCheck { percent } => {
            format!("the scene differs from the sensors by {percent} % of what is tolerated")
        }
        Event::SensorLies { what, thousandths } => {
            let (what, amount) = match what {
                5 => (
                    "acceleration",
                    format!("{:.3} m/s", f64::from(thousandths) / 1e3),
                ),
                6 => (
                    "yaw rate or steering angle",
                    format!("{:.3} rad/s", f64::from(thousandths) / 1e3),
                ),
                _ => scene_value(what, thousandths),
            };
            format!("stops: the sensor of {what} contradicts the others, by {amount}")
        }
        Event::SensorContradicted { sensor } => {
            let sensor = SensorId::ALL.get(usize::from(sensor));
            let name = sensor.map_or("a sensor", |sensor| sensor.name());
            format!("most other sensors see an object ahead at another place than {name}")
        }
        Event::WrongEcho => {
            "the vehicle's echo is wrong: the measured steering angle follows the command"
                .to_owned()
        }
        Event::FrameSilent { id, age_ms } => format!("frame {id:#05x} is silent for {age_ms} ms"),
        Event::FrameGaps { id, lost } => format!("frame {id:#05x}: {lost} lost by their counter"),
        Event::StampRefused {
            source,
            later,
            off_us,
        } => {
            let sensor = SensorId::ALL.get(usize::from(source));
            let name = sensor.map_or("CameraLanes", |sensor| sensor.name());
            let way = if later { "late" } else { "early" };
            let off_ms = f64::from(off_us) * 1e-3;
            format!("the time stamps of {name} are {off_ms:.1} ms too {way}: arrivals are used")
        }
        Event::TimeLeap {
            source,
            followed,
            by_us,
        } => {
            let source = time_source(source);
            let what = if followed { "follows a" } else { "finds a" };
            format!(
                "{what} leap of {source} by {:.3} ms",
                f64::from(by_us) * 1e-3
            )
        }
        Event::TimeDisagrees { apart_ns } => format!(
            "the grandmaster's time is {:.1} us later than that of the system that drives",
            f64::from(apart_ns) * 1e-3
        ),
        Event::OtherGrandmaster { others } => {
            format!("hears another grandmaster, which it does not follow: {others} messages")
        }
        Event::GrandmasterTime { why: 0 } => "hears the grandmaster's time".to_owned(),
        Event::GrandmasterTime { why } => {
            format!("has no time of the grandmaster: {}", no_grandmaster(why))
        }
        Event::SocSilent { topic } => {
            let topics = [
                "PowerControl",
                "LateralControl",
                "LongitudinalControl",
                "ParkingBrake",
            ];
            let topic = topics.get(usize::from(topic)).copied().unwrap_or("a topic");
            format!("stops: the SoC no longer commands, {topic} is silent or disabled")
        }
        Event::ClockWrong { of } => match of {
            0 => "leaves: its clock has drifted from the vehicle's and the other's".to_owned(),
            1 => "finds that the other system's clock has drifted".to_owned(),
            _ => "finds that the vehicle's clock has drifted".to_owned(),
        },
        Event::OutputFault { found: 1 } => "its output driver finds an open load".to_owned(),
        Event::OutputFault { .. } => "its output driver finds a short circuit".to_owned(),
        Event::Flood {
            source,
            times,
            beyond,
        } => format!(
            "is flooded by {}: limit reached {times} times, {beyond} beyond it",
            flood_source(source)
        ),
        _ => return None,
    })
}

/// Returns whom a clock follows, by the code of a [`TimeSource`](tandem_cores::core0::TimeSource).
#[must_use]
pub const fn time_source(code: u8) -> &'static str {
    match code {
        0 => "its own clock",
        1 => "the grandmaster",
        2 => "the other system",
        _ => "an unknown clock",
    }
}

/// Returns what a time is worth, by the bits of a [`TimeStatus`].
#[must_use]
pub fn time_status(bits: u8) -> &'static str {
    let has = |status: TimeStatus| bits & status.bits() != 0;
    if has(TimeStatus::TIMELEAP_FUTURE) {
        "leaps ahead"
    } else if has(TimeStatus::TIMELEAP_PAST) {
        "leaps back"
    } else if is_holdover(bits) {
        "holdover"
    } else if has(TimeStatus::SYNC_TO_GATEWAY) {
        "to a gateway"
    } else {
        "synchronised"
    }
}

/// Returns whether a time continues with the rate that was learned, by the bits of a
/// [`TimeStatus`].
#[must_use]
pub const fn is_holdover(bits: u8) -> bool {
    bits & TimeStatus::HOLDOVER.bits() != 0
}

/// Returns why the grandmaster is not followed, by the code of [`Event::GrandmasterTime`].
#[must_use]
pub fn no_grandmaster(code: u8) -> &'static str {
    let reasons = [
        (Why::Silent, "none is heard"),
        (Why::Malformed, "its messages are damaged"),
        (Why::OtherProfile, "its messages are of another profile"),
        (Why::OtherDomain, "its messages are of another domain"),
        (
            Why::OtherMaster,
            "another master than the right one is heard",
        ),
        (Why::NoAnnounce, "it sends no Announce"),
        (Why::OtherScale, "its time has another scale"),
        (Why::OtherGrandmaster, "another grandmaster is announced"),
        (Why::OneStep, "it sends Sync in one step"),
        (Why::NoFollowUp, "no Follow_Up is heard yet"),
        (Why::NoStamp, "the port does not tell when requests left"),
        (Why::NoAnswer, "requests for the delay are not answered yet"),
        (
            Why::ManyPeers,
            "several ports answer requests for the delay",
        ),
        (Why::WildRate, "its rate is impossible"),
        (Why::NegativeDelay, "the measured delay is negative"),
        (Why::DelayAboveThreshold, "the measured delay is too long"),
    ];
    let reason = reasons.iter().find(|(why, _)| *why as u8 + 1 == code);
    reason.map_or("for an unknown reason", |(_, text)| text)
}

/// Returns the names of what is missing.
fn names(missing: u8) -> String {
    let is_missing = |bit: usize| missing >> bit & 1 == 1;
    let sensors = SensorId::ALL.into_iter();
    let sensors = sensors.filter(|sensor| is_missing(sensor.index()));
    let mut names: Vec<_> = sensors.map(|sensor| format!("{sensor:?}")).collect();
    let others = [(6, "lanes"), (7, "the vehicle's motion")].into_iter();
    let others = others.filter(|(bit, _)| is_missing(*bit));
    names.extend(others.map(|(_, name)| name.to_owned()));
    names.join(", ")
}

const fn flood_source(source: FloodSource) -> &'static str {
    match source {
        FloodSource::Can => "CAN frames",
        FloodSource::Link => "datagrams on the link",
        FloodSource::StartLine => "edges on the start line",
        FloodSource::HeartbeatLines => "edges on a heartbeat line",
        FloodSource::Doorbell => "doorbells",
    }
}

impl Takeover {
    /// Returns [`Takeover::cause`] in words.
    #[must_use]
    pub fn cause_in_words(&self) -> &'static str {
        self.cause.map_or("not reported", evidence)
    }
}

/// Returns the name of a value of the scene, and an amount of it with its unit.
fn scene_value(what: u8, thousandths: u32) -> (&'static str, String) {
    let (what, unit) = match what {
        0 => ("lanes", "m"),
        1 => ("speed", "m/s"),
        2 => ("yaw rate", "rad/s"),
        3 => ("steering angle", "rad"),
        4 => ("slip angle", "rad"),
        5 => ("place of an object", "m"),
        6 => ("speed of an object", "m/s"),
        8 => ("acceleration", "m/s²"),
        _ => ("object that no sensor sees", "m"),
    };
    (what, format!("{:.3} {unit}", f64::from(thousandths) / 1e3))
}

/// Returns an event of a supply in words.
#[must_use]
pub fn supply_event(event: SupplyEvent) -> String {
    match event {
        SupplyEvent::CoreStarted { core, generation } => {
            format!("core {core} starts, incarnation {}", generation.0)
        }
        SupplyEvent::CoreDied { core, signal: 0 } => format!("core {core} died"),
        SupplyEvent::CoreDied { core, signal } => format!("core {core} died of signal {signal}"),
        SupplyEvent::Reset(cause) => format!("reset: {}", reset_cause(cause)),
        SupplyEvent::Suspended => "suspended".to_owned(),
    }
}

const fn reset_cause(cause: ResetCause) -> &'static str {
    match cause {
        ResetCause::PowerOn => "power-on",
        ResetCause::Software => "software",
        ResetCause::Watchdog => "watchdog",
        ResetCause::Trap => "trap or dead core",
        ResetCause::Download => "for a download",
        ResetCause::ErrorPin => "error pin",
        ResetCause::Undervoltage => "low rail of the supply",
    }
}

/// Returns the evidence for a change of phase, in words.
#[must_use]
pub const fn evidence(evidence: Evidence) -> &'static str {
    match evidence {
        Evidence::SyncHeard => "sync edge of the other system",
        Evidence::PeerRuns => "the other system is running",
        Evidence::HandshakeDone => "handshake done",
        Evidence::NoAnswer => "no system answered",
        Evidence::PeerOff => "power level fell and heartbeats ended",
        Evidence::PeerSilent => "heartbeats and control frames silent",
        Evidence::BeatsSilent => "heartbeats silent",
        Evidence::MasterMute => "no control frame reaches the vehicle",
        Evidence::HigherTerm => "the other system drives in a higher term",
        Evidence::BeatsBack => "heartbeats are back",
        Evidence::PeerStable => "the other system is back for good",
        Evidence::Stalled => "was held up",
        Evidence::ListenOver => "the other system has not taken over",
        Evidence::FaultReset => "own fault, a reset may cure it",
        Evidence::FaultStop => "own fault, stops the vehicle until the other drives",
        Evidence::FaultSuspend => "own fault that stays",
        Evidence::StandbyMute => "the standby is not heard on CAN",
        Evidence::MasterResigns => "the master resigns",
        Evidence::SyncStray => "the sync edge was a disturbance",
        Evidence::StandbyUnable => "the standby could only stop the vehicle",
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tandem_board::CoreId;

    #[test]
    fn events_are_described_in_plain_words() {
        let took_over = Event::TookOver {
            cause: Evidence::PeerOff,
            since_heartbeat_us: 830,
            since_control_us: 9_000,
            term: 3,
        };
        let cycle = |lateness_ns| Event::ControlCycle {
            lateness_ns,
            execution_ns: 1,
            transmitted: true,
        };
        let role = Event::Role {
            role: 1,
            mode: 1,
            term: 2,
        };
        for (event, words) in [
            (
                took_over,
                Some("takes over: power level fell and heartbeats ended, detected in 0.83 ms"),
            ),
            (role, Some("is master, L3, term 2")),
            (cycle(60_000), None),
            (cycle(9_000_000), Some("began a control cycle 9.0 ms late")),
            (
                Event::Ready {
                    task: TaskCode::STATUS,
                },
                None,
            ),
        ] {
            assert_eq!(core_event(event).as_deref(), words);
        }
        let died = SupplyEvent::CoreDied {
            core: CoreId::CONTROL,
            signal: 9,
        };
        assert_eq!(supply_event(died), "core 0 died of signal 9");
    }
}
