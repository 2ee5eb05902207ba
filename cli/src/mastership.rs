//! Who drove when: takeovers and their faults, read from the control frames that the vehicle saw.
//!
//! The acceptance log is taken as it is: nothing here trusts that terms fence as they should.

use crate::runlog::{ControlSeen, CoreEvent, Role, RunLog, System, Verdict, What};

/// A system whose control frames follow each other no later than this was not silent, ms: one and a
/// half control periods.
const NOT_SILENT_MS: f64 = 15.0;
/// Likewise for its status frames, which come every 100 ms.
const STATUS_NOT_SILENT_MS: f64 = 150.0;
/// What a core reports within this time it found out in one cycle, ns.
const SAME_CYCLE_NS: u64 = 5_000_000;
/// How far the report of a takeover may lie from the first frame of the new master, ns.
const REPORT_WINDOW_NS: u64 = 100_000_000;

/// One change of the system that is obeyed.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Takeover {
    /// Who drove before.
    pub(crate) from: System,
    /// Who drives now.
    pub(crate) to: System,
    /// First accepted frame of the new master, ns.
    pub(crate) at_ns: u64,
    /// By which sign the old master was taken for failed, as the new one reports it.
    pub(crate) cause: Option<String>,
    /// From its last sign of life to the decision, ms, as the new master reports it.
    pub(crate) detected_ms: Option<f64>,
    /// From the old master's last accepted frame to the new one's first, ms.
    pub(crate) gap_ms: f64,
    /// The old master had not failed.
    pub(crate) is_false: bool,
    /// The old master found later that it had been held up.
    pub(crate) held_up: bool,
}

/// All changes of the accepted system, in order.
pub(crate) fn takeovers(log: &RunLog) -> Vec<Takeover> {
    let accepted: Vec<&ControlSeen> = log.accepted().collect();
    accepted
        .windows(2)
        .filter(|pair| pair[0].system != pair[1].system)
        .map(|pair| {
            let (last, first) = (pair[0], pair[1]);
            let report = report_of(log, first.system, first.at_ns);
            let held_up = was_held_up(log, last.system, last.at_ns);
            Takeover {
                from: last.system,
                to: first.system,
                at_ns: first.at_ns,
                cause: report.map(|(cause, _)| cause.to_owned()),
                detected_ms: report.map(|(_, detected_ms)| detected_ms),
                gap_ms: ms_between(last.at_ns, first.at_ns),
                is_false: !held_up && old_master_lived_on(log, last, first.at_ns),
                held_up,
            }
        })
        .collect()
}

/// Time in which frames of both systems were accepted, ms.
///
/// A mastership, one system with one term, lasts from its first to its last accepted frame. Where
/// two masterships of different systems overlap in the order of the bus, there were two masters, up
/// to the frame that follows.
pub(crate) fn two_masters_ms(log: &RunLog) -> f64 {
    let accepted: Vec<&ControlSeen> = log.accepted().collect();
    let mut spans: Vec<(System, u32, usize, usize)> = Vec::new();
    for (index, frame) in accepted.iter().enumerate() {
        match spans
            .iter_mut()
            .find(|span| (span.0, span.1) == (frame.system, frame.term))
        {
            Some(span) => span.3 = index,
            None => spans.push((frame.system, frame.term, index, index)),
        }
    }
    let mut overlaps: Vec<(usize, usize)> = Vec::new();
    for (number, a) in spans.iter().enumerate() {
        for b in spans[number + 1..].iter().filter(|b| b.0 != a.0) {
            let (first, last) = (a.2.max(b.2), a.3.min(b.3));
            if first <= last {
                overlaps.push((first, (last + 1).min(accepted.len() - 1)));
            }
        }
    }
    overlaps.sort_unstable();
    let mut total_ms = 0.0;
    let mut counted_to = 0;
    for (first, last) in overlaps {
        let first = first.max(counted_to);
        if first < last {
            total_ms += ms_between(accepted[first].at_ns, accepted[last].at_ns);
            counted_to = last;
        }
    }
    total_ms
}

/// What the new master reported of the takeover: cause and time to detect.
fn report_of(log: &RunLog, system: System, near_ns: u64) -> Option<(&str, f64)> {
    log.events
        .iter()
        .filter(|event| event.system == system && event.at_ns.abs_diff(near_ns) < REPORT_WINDOW_NS)
        .filter_map(|event| match &event.what {
            What::TookOver { cause, detected_ms } => {
                Some((event.at_ns.abs_diff(near_ns), cause.as_str(), *detected_ms))
            }
            _ => None,
        })
        .min_by_key(|(distance, ..)| *distance)
        .map(|(_, cause, detected_ms)| (cause, detected_ms))
}

/// Whether the old master found, by the time at which it gave up its role, that it had been held up
/// or had left out cycles. Then it was silent as a dead one is, and the takeover was right.
fn was_held_up(log: &RunLog, system: System, last_ns: u64) -> bool {
    let since = || {
        let of_core_0 = |event: &&CoreEvent| event.system == system && event.core == 0;
        log.events
            .iter()
            .filter(of_core_0)
            .filter(|event| event.at_ns > last_ns)
    };
    let given_up = since().find(|event| matches!(event.what, What::RoleChanged { .. }));
    given_up.is_some_and(|given_up| {
        since()
            .take_while(|event| event.at_ns <= given_up.at_ns + SAME_CYCLE_NS)
            .any(|event| {
                use What::{DeadlineMiss, HeldUp, LateCycle};
                matches!(event.what, HeldUp | DeadlineMiss { .. } | LateCycle { .. })
            })
    })
}

/// Whether the old master went on as if nothing had happened: it sent a further control frame in
/// time, or its status frames went on without a break and without a restart, in a role that works.
fn old_master_lived_on(log: &RunLog, last: &ControlSeen, takeover_ns: u64) -> bool {
    let restarted = |until_ns: u64| {
        log.events.iter().any(|event| {
            event.system == last.system
                && (last.at_ns..=until_ns).contains(&event.at_ns)
                && matches!(event.what, What::Started { .. })
        })
    };
    let next_frame = log.control.iter().find(|frame| {
        frame.system == last.system
            && frame.at_ns > last.at_ns
            && frame.verdict != Verdict::Invalid
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
                && matches!(after.role, Role::Master | Role::Standby)
                && !restarted(after.at_ns)
        }
        _ => false,
    }
}

/// The span between two points on one clock, ms; negative if `to` is the earlier one.
pub(crate) fn ms_between(from_ns: u64, to_ns: u64) -> f64 {
    (to_ns as f64 - from_ns as f64) * 1e-6
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::runlog::{Mode, StatusSeen};

    fn frame(at_ms: u64, system: System, term: u32) -> ControlSeen {
        let at_ns = at_ms * 1_000_000;
        let (mode, verdict) = (Mode::L3, Verdict::Accepted);
        ControlSeen {
            at_ns,
            sent_ns: at_ns,
            system,
            term,
            mode,
            verdict,
        }
    }

    fn log(control: Vec<ControlSeen>) -> RunLog {
        RunLog {
            control,
            start_ns: Some(0),
            ..RunLog::default()
        }
    }

    #[test]
    fn a_clean_takeover_has_a_gap_and_no_second_master() {
        let mut log = log(vec![
            frame(0, System::A, 2),
            frame(10, System::A, 2),
            frame(23, System::B, 3),
        ]);
        log.events.push(CoreEvent {
            at_ns: 22_000_000,
            system: System::B,
            core: 0,
            what: What::TookOver {
                cause: "power".into(),
                detected_ms: 2.0,
            },
        });
        let found = takeovers(&log);
        assert_eq!(found.len(), 1);
        assert_eq!((found[0].from, found[0].to), (System::A, System::B));
        assert_eq!(found[0].cause.as_deref(), Some("power"));
        assert!((found[0].gap_ms - 13.0).abs() < 1e-9);
        assert!(!found[0].is_false);
        assert_eq!(two_masters_ms(&log), 0.0);
    }

    #[test]
    fn there_and_back_with_new_terms_are_two_takeovers_and_no_second_master() {
        let log = log(vec![
            frame(0, System::A, 2),
            frame(10, System::B, 3),
            frame(20, System::A, 4),
        ]);
        assert_eq!(takeovers(&log).len(), 2);
        assert_eq!(two_masters_ms(&log), 0.0);
    }

    /// T-RED-9: two masters are seen even if the fence that should prevent them is broken.
    #[test]
    fn frames_of_the_old_term_after_the_new_master_are_two_masters() {
        let log = log(vec![
            frame(0, System::A, 2),
            frame(10, System::B, 3),
            frame(15, System::A, 2),
            frame(20, System::B, 3),
            frame(25, System::A, 2),
            frame(30, System::B, 3),
            frame(40, System::B, 3),
        ]);
        // From B's first frame to the one that follows A's last.
        assert!((two_masters_ms(&log) - 20.0).abs() < 1e-9);
    }

    /// T-RED-9
    #[test]
    fn a_single_frame_of_another_master_counts_until_the_next_frame() {
        let log = log(vec![
            frame(0, System::A, 2),
            frame(5, System::B, 3),
            frame(10, System::A, 2),
        ]);
        assert!((two_masters_ms(&log) - 5.0).abs() < 1e-9);
    }

    #[test]
    fn a_takeover_from_a_master_that_goes_on_sending_is_false() {
        let mut fenced = frame(20, System::A, 2);
        fenced.verdict = Verdict::Fenced;
        let log = log(vec![
            frame(0, System::A, 2),
            frame(10, System::A, 2),
            frame(14, System::B, 3),
            fenced,
        ]);
        assert!(takeovers(&log)[0].is_false);
    }

    #[test]
    fn a_master_that_thaws_later_was_silent_and_is_no_false_takeover() {
        let mut fenced = frame(90, System::A, 2);
        fenced.verdict = Verdict::Fenced;
        let log = log(vec![
            frame(0, System::A, 2),
            frame(10, System::A, 2),
            frame(24, System::B, 3),
            fenced,
        ]);
        assert!(!takeovers(&log)[0].is_false);
    }

    #[test]
    fn a_master_that_says_it_was_held_up_had_failed() {
        let mut fenced = frame(24, System::A, 2);
        fenced.verdict = Verdict::Fenced;
        let mut log = log(vec![
            frame(0, System::A, 2),
            frame(10, System::A, 2),
            frame(23, System::B, 3),
            fenced,
        ]);
        assert!(takeovers(&log)[0].is_false);
        let late = What::LateCycle { late_ms: 9.0 };
        for what in [What::HeldUp, What::DeadlineMiss { missed: 5 }, late] {
            let given_up = What::RoleChanged {
                role: Role::Standby,
                mode: Mode::None,
                term: 3,
            };
            let event = |what| CoreEvent {
                at_ns: 23_500_000,
                system: System::A,
                core: 0,
                what,
            };
            log.events = vec![event(given_up), event(what)];
            let found = &takeovers(&log)[0];
            assert!(!found.is_false && found.held_up, "{found:?}");
        }
    }

    #[test]
    fn status_that_goes_on_tells_a_false_takeover_from_a_reset() {
        let status = |at_ms: u64| StatusSeen {
            at_ns: at_ms * 1_000_000,
            system: System::A,
            role: Role::Standby,
            mode: Mode::None,
            term: 3,
        };
        let mut log = log(vec![frame(0, System::A, 2), frame(10, System::B, 3)]);
        log.status = vec![status(0), status(100)];
        assert!(takeovers(&log)[0].is_false);
        log.events.push(CoreEvent {
            at_ns: 60_000_000,
            system: System::A,
            core: 0,
            what: What::Started {
                generation: 2,
                cause: "trap".into(),
            },
        });
        assert!(!takeovers(&log)[0].is_false);
    }
}
