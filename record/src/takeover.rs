//! The analysis of takeovers: both systems, the evidence, the gap, and whether the old master had
//! failed.

use tandem_board::{CoreId, SystemId};
use tandem_bus::RoleCode;
use tandem_cores::trace::Event;
use tandem_redundancy::{Evidence, Phase};
use tandem_vehicle::Ruling;

use crate::run_log::{ControlFrame, CoreEvent};
use crate::{RunLog, ms_between};

/// A system was not silent if its control frames followed each other within this time, ms: one and
/// a half control periods.
const NOT_SILENT_MS: f64 = 15.0;
/// The same limit for status frames, which a system sends every 100 ms.
const STATUS_NOT_SILENT_MS: f64 = 150.0;
/// A core writes all events of one cycle within this time, ns.
const SAME_CYCLE_NS: u64 = 5_000_000;
/// The new master reports a takeover within this time after its first frame, ns.
const REPORT_WINDOW_NS: u64 = 100_000_000;
/// A control cycle that begins later than this has missed its slot: half a control period. A
/// healthy timer is late by tens of microseconds; a longer delay means that the core had no CPU.
const LATE_NS: u32 = 5_000_000;

/// One change of the system that the vehicle obeys.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Takeover {
    /// The system that drove before.
    pub from: SystemId,
    /// The system that drives now.
    pub to: SystemId,
    /// Time of the last accepted frame of the old master, ns.
    pub from_ns: u64,
    /// Time of the first accepted frame of the new master, ns.
    pub at_ns: u64,
    /// The evidence of the old master's failure that the new master reported.
    pub cause: Option<Evidence>,
    /// Time from the old master's last sign of life to the decision, ms, as the new master reports.
    pub detected_ms: Option<f64>,
    /// Time from the old master's last accepted frame to the new master's first, ms.
    pub gap_ms: f64,
    /// Whether the takeover was false: the old master had not failed.
    pub is_false: bool,
    /// Whether the old master later detected that it had been held up.
    pub held_up: bool,
}

/// Returns all changes of the system that the vehicle obeys, in order.
#[must_use]
pub fn takeovers(log: &RunLog) -> Vec<Takeover> {
    let accepted: Vec<&ControlFrame> = log.accepted().collect();
    accepted
        .windows(2)
        .filter(|pair| pair[0].system != pair[1].system)
        .map(|pair| {
            let (last, first) = (pair[0], pair[1]);
            let report = report_of(log, first.system, first.at_ns);
            let held_up = was_held_up(log, last.system, last.at_ns);
            let cause = report.and_then(|report| match report {
                Event::TookOver { cause, .. } => Some(cause),
                _ => None,
            });
            // A master that resigns has a fault, so the takeover is not false.
            let resigned = cause == Some(Evidence::MasterResigns);
            Takeover {
                from: last.system,
                to: first.system,
                from_ns: last.at_ns,
                at_ns: first.at_ns,
                cause,
                detected_ms: report.and_then(detected_ms),
                gap_ms: ms_between(last.at_ns, first.at_ns),
                is_false: !held_up && !resigned && old_master_lived_on(log, last, first.at_ns),
                held_up,
            }
        })
        .collect()
}

/// Returns the time from the last sign of life to the decision, ms, in a report of a takeover.
#[must_use]
pub fn detected_ms(report: Event) -> Option<f64> {
    match report {
        // A mute master still sends heartbeats.
        Event::TookOver {
            cause: Evidence::MasterMute,
            since_control_us,
            ..
        } => Some(f64::from(since_control_us) * 1e-3),
        // If the heartbeat lines were cut earlier, only the control frames count.
        Event::TookOver {
            since_heartbeat_us,
            since_control_us,
            ..
        } => Some(f64::from(since_heartbeat_us.min(since_control_us)) * 1e-3),
        _ => None,
    }
}

/// Tests whether this event is a control cycle whose frame was late.
#[must_use]
pub const fn is_late(event: Event) -> bool {
    matches!(event, Event::ControlCycle { lateness_ns, .. } if lateness_ns > LATE_NS)
}

/// Returns the new master's report of the takeover.
pub(crate) fn report_of(log: &RunLog, system: SystemId, near_ns: u64) -> Option<Event> {
    log.events
        .iter()
        .filter(|event| event.system == system && event.at_ns.abs_diff(near_ns) < REPORT_WINDOW_NS)
        .filter(|event| matches!(event.event, Event::TookOver { .. }))
        .min_by_key(|event| event.at_ns.abs_diff(near_ns))
        .map(|event| event.event)
}

/// Tests whether the old master detected, before it gave up its role, that it had been held up or
/// had skipped cycles. If so, it was as silent as a dead master, and the takeover was correct.
fn was_held_up(log: &RunLog, system: SystemId, last_ns: u64) -> bool {
    let since = || {
        let of_core_0 =
            |event: &&CoreEvent| event.system == system && event.core == CoreId::CONTROL;
        log.events
            .iter()
            .filter(of_core_0)
            .filter(|event| event.at_ns > last_ns)
    };
    let given_up = since().find(|event| matches!(event.event, Event::Role { .. }));
    given_up.is_some_and(|given_up| {
        since()
            .take_while(|event| event.at_ns <= given_up.at_ns + SAME_CYCLE_NS)
            .any(|event| match event.event {
                Event::Phase { to, .. } => to == Phase::Thawed,
                Event::DeadlineMiss { task, .. } => task.is_control(),
                event => is_late(event),
            })
    })
}

/// Tests whether the old master continued undisturbed. It did if it sent a further control frame in
/// time, or continued to send status frames as master or standby, without a break or a restart.
fn old_master_lived_on(log: &RunLog, last: &ControlFrame, takeover_ns: u64) -> bool {
    let restarted = |until_ns: u64| {
        log.events.iter().any(|event| {
            event.system == last.system
                && (last.at_ns..=until_ns).contains(&event.at_ns)
                && matches!(event.event, Event::Started { .. })
        })
    };
    let next_frame = log.control.iter().find(|frame| {
        frame.system == last.system
            && frame.at_ns > last.at_ns
            && matches!(frame.ruling, Ruling::Accepted | Ruling::Fenced)
            && frame.term <= last.term
    });
    if let Some(frame) = next_frame
        && ms_between(last.at_ns, frame.at_ns) < NOT_SILENT_MS
        && !restarted(frame.at_ns)
    {
        return true;
    }
    let of_old = || {
        log.status
            .iter()
            .filter(|status| status.system == last.system)
    };
    let before = of_old().rfind(|status| status.at_ns <= takeover_ns);
    let after = of_old().find(|status| status.at_ns > takeover_ns);
    match (before, after) {
        (Some(before), Some(after)) => {
            ms_between(before.at_ns, after.at_ns) < STATUS_NOT_SILENT_MS
                && matches!(after.role, RoleCode::Master | RoleCode::Standby)
                && !restarted(after.at_ns)
        }
        _ => false,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::run_log::StatusFrame;
    use tandem_bus::ModeCode;
    use tandem_cores::task_table::TaskCode;

    const A: SystemId = SystemId::A;
    const B: SystemId = SystemId::B;

    fn frame(at_ms: u64, system: SystemId, term: u32) -> ControlFrame {
        let at_ns = at_ms * 1_000_000;
        ControlFrame {
            at_ns,
            sent_ns: at_ns,
            system,
            term,
            mode: ModeCode::L3,
            asks: false,
            age_ns: None,
            ruling: Ruling::Accepted,
        }
    }

    fn fenced(at_ms: u64, system: SystemId, term: u32) -> ControlFrame {
        ControlFrame {
            ruling: Ruling::Fenced,
            ..frame(at_ms, system, term)
        }
    }

    fn event(at_ns: u64, system: SystemId, event: Event) -> CoreEvent {
        CoreEvent {
            at_ns,
            system,
            core: CoreId::CONTROL,
            event,
        }
    }

    fn log(control: Vec<ControlFrame>) -> RunLog {
        RunLog {
            control,
            start_ns: Some(0),
            ..RunLog::default()
        }
    }

    #[test]
    fn a_takeover_has_its_gap_and_the_report_of_the_new_master() {
        let mut log = log(vec![frame(0, A, 2), frame(10, A, 2), frame(23, B, 3)]);
        let report = |cause, since_heartbeat_us| Event::TookOver {
            cause,
            since_heartbeat_us,
            since_control_us: 11_000,
            term: 3,
        };
        for (cause, since_heartbeat_us, detected_ms) in [
            (Evidence::PeerOff, 2_000, 2.0),
            (Evidence::PeerOff, 129_000, 11.0),
            (Evidence::MasterMute, 2_000, 11.0),
        ] {
            log.events = vec![event(22_000_000, B, report(cause, since_heartbeat_us))];
            let found = takeovers(&log);
            assert_eq!(found.len(), 1);
            assert_eq!((found[0].from, found[0].to), (A, B));
            assert_eq!(found[0].cause, Some(cause));
            assert!((found[0].detected_ms.unwrap() - detected_ms).abs() < 1e-9);
            assert!((found[0].gap_ms - 13.0).abs() < 1e-9);
            assert!(!found[0].is_false);
        }
        log.events[0].at_ns = 500_000_000;
        assert_eq!(takeovers(&log)[0].cause, None, "another takeover's report");
    }

    #[test]
    fn a_takeover_from_a_master_that_sends_on_is_false() {
        let sends_on = [
            frame(0, A, 2),
            frame(10, A, 2),
            frame(14, B, 3),
            fenced(20, A, 2),
        ];
        assert!(takeovers(&log(sends_on.to_vec()))[0].is_false);
        // A master that later changes to Thawed was silent.
        let thaws = [
            frame(0, A, 2),
            frame(10, A, 2),
            frame(24, B, 3),
            fenced(90, A, 2),
        ];
        assert!(!takeovers(&log(thaws.to_vec()))[0].is_false);
    }

    #[test]
    fn a_master_that_says_it_was_held_up_had_failed() {
        let frames = [
            frame(0, A, 2),
            frame(10, A, 2),
            frame(23, B, 3),
            fenced(24, A, 2),
        ];
        let mut log = log(frames.to_vec());
        assert!(takeovers(&log)[0].is_false);
        let given_up = Event::Role {
            role: RoleCode::Standby as u8,
            mode: ModeCode::None as u8,
            term: 3,
        };
        let thawed = Event::Phase {
            from: Phase::Master,
            to: Phase::Thawed,
            on: Evidence::Stalled,
        };
        let late = Event::ControlCycle {
            lateness_ns: 9_000_000,
            execution_ns: 0,
            transmitted: false,
        };
        for found in [
            thawed,
            Event::DeadlineMiss {
                task: TaskCode::CONTROL,
                missed: 5,
            },
            late,
        ] {
            log.events = [given_up, found].map(|e| event(23_500_000, A, e)).to_vec();
            let takeover = takeovers(&log)[0];
            assert!(!takeover.is_false && takeover.held_up, "{takeover:?}");
        }
    }

    #[test]
    fn status_frames_without_a_break_tell_a_false_takeover_from_a_reset() {
        let status = |at_ms: u64| StatusFrame {
            at_ns: at_ms * 1_000_000,
            system: A,
            role: RoleCode::Standby,
            mode: ModeCode::None,
            ability: tandem_bus::AbilityCode::All,
        };
        let mut log = log(vec![frame(0, A, 2), frame(10, B, 3)]);
        log.status = vec![status(0), status(100)];
        assert!(takeovers(&log)[0].is_false);
        let started = Event::Started {
            generation: 2,
            cause: 3,
        };
        log.events.push(event(60_000_000, A, started));
        assert!(!takeovers(&log)[0].is_false);
    }
}
