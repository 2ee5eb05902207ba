//! Tests whether the driving function fits the systems that were available.

use tandem_board::{CoreId, SupplyEvent, SystemId};
use tandem_bus::{AbilityCode, ModeCode, RoleCode};
use tandem_cores::trace::Event;
use tandem_redundancy::{Evidence, Phase};

use crate::RunLog;
use crate::roles::{RoleState, timeline};
use crate::run_log::{ControlFrame, CoreEvent, StatusFrame};

/// A system without a status frame for longer than this is not standby, ns: three and a half status
/// periods. The product's own master changes to degraded mode after the same time.
const THERE_NS: u64 = 350_000_000;
/// A standby counts as running at the end if its last report is at most this old, s.
const SIGN_S: f64 = 0.25;

/// A stop without a reason.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Stop {
    /// The vehicle stood for this long, s, although nothing was near ahead.
    Standing(f64),
    /// The function made its minimal-risk stop at this scenario time, s, although no core had
    /// reported a failure and the driver was not asked.
    SafeStop(f64),
}

/// Returns the stop of this run that has no reason, if there is one. A minimal-risk stop has a
/// reason if a failure, a late core or a stall of the bus preceded it.
#[must_use]
pub fn stop(log: &RunLog) -> Option<Stop> {
    let drive = &log.figures;
    let by_hand = || log.accepted().any(|frame| frame.mode == ModeCode::None);
    match (drive.safe_stop_s, drive.takeover_asked_s) {
        (None, None) if drive.standing_s > 0.0 && !by_hand() => {
            Some(Stop::Standing(drive.standing_s))
        }
        (Some(at_s), None) => {
            let late = log.events.iter().filter(|it| match it.event {
                Event::Phase { on, .. } => on == Evidence::Stalled,
                Event::DeadlineMiss { task, .. } => task.is_control(),
                _ => false,
            });
            let late = late.map(|event| event.at_ns);
            let stood = log.held_up.iter().map(|stall| stall.from_ns);
            let mut reasons = failure_ns(log).into_iter().chain(late).chain(stood);
            let has_reason = reasons.any(|at_ns| log.seconds(at_ns) <= at_s);
            (!has_reason).then_some(Stop::SafeStop(at_s))
        }
        _ => None,
    }
}

/// Returns the time of the first recorded failure, ns: a failure that a core reported or a supply
/// detected, or a system without power.
fn failure_ns(log: &RunLog) -> Option<u64> {
    let fails = |event: &Event| match *event {
        Event::Phase { on, .. } => matches!(
            on,
            Evidence::FaultReset | Evidence::FaultStop | Evidence::FaultSuspend
        ),
        Event::Sensors { missing } => missing != 0,
        Event::Agreement { stage, .. } => stage > 0,
        Event::WrongCommand { .. }
        | Event::WrongScene { .. }
        | Event::WrongTrajectory { .. }
        | Event::SensorLies { .. }
        | Event::ClockWrong { .. }
        | Event::CoreSilent { .. }
        | Event::SocSilent { .. }
        | Event::OutputFault { .. } => true,
        _ => false,
    };
    let died =
        |event: &SupplyEvent| matches!(event, SupplyEvent::CoreDied { .. } | SupplyEvent::Reset(_));
    let reported = log
        .events
        .iter()
        .filter(|it| fails(&it.event))
        .map(|it| it.at_ns);
    let seen = log.supplies.iter().filter(|it| died(&it.2)).map(|it| it.0);
    let off = log
        .power
        .iter()
        .filter(|power| !power.on)
        .map(|power| power.at_ns);
    reported.chain(seen).chain(off).min()
}

/// Returns the scenario time since which no system was a standby that could drive, s; `None` if one
/// was at the end of the run, or if no system ever drove.
#[must_use]
pub fn redundancy_lost_s(log: &RunLog) -> Option<f64> {
    let (from_s, to_s) = *alone(log).last()?;
    (to_s >= log.driven_s()).then_some(from_s)
}

/// Returns the spans of scenario time in which no system was a standby that could drive, s: from,
/// to. Shorter ones than the status frames show are left out. Empty if no system ever drove.
#[must_use]
pub fn alone(log: &RunLog) -> Vec<(f64, f64)> {
    if log.accepted().next().is_none() {
        return Vec::new();
    }
    let stood_by = SystemId::ALL.into_iter().flat_map(|it| stood_by(log, it));
    let mut stood_by: Vec<(f64, f64)> = stood_by.collect();
    stood_by.sort_by(|a, b| a.0.total_cmp(&b.0));
    let end_s = log.driven_s();
    let (mut alone, mut last_s) = (Vec::new(), 0.0_f64);
    for (from_s, to_s) in stood_by.into_iter().chain([(end_s, end_s)]) {
        if from_s - last_s > SIGN_S {
            alone.push((last_s, from_s));
        }
        last_s = last_s.max(to_s);
    }
    alone
}

/// Returns the spans of scenario time in which this system was a standby that could drive, s.
fn stood_by(log: &RunLog, system: SystemId) -> Vec<(f64, f64)> {
    let unable = unable(log, system);
    let spans = timeline(log, system).into_iter();
    let spans = spans.filter(|span| span.state == RoleState::Standby);
    let able = spans.flat_map(|span| {
        let mut from_s = span.from_s;
        let mut able = Vec::new();
        for (begin_s, end_s) in unable.iter().filter(|it| it.1 > span.from_s) {
            able.push((from_s, begin_s.min(span.to_s)));
            from_s = from_s.max(*end_s);
        }
        able.push((from_s, span.to_s));
        able
    });
    able.filter(|(from_s, to_s)| from_s < to_s).collect()
}

/// Returns the spans of scenario time in which this system reported that it could not drive, s. The
/// last one has no end if the system did so to the end.
fn unable(log: &RunLog, system: SystemId) -> Vec<(f64, f64)> {
    let is_unable =
        |it: &StatusFrame| matches!(it.ability, AbilityCode::StopOnly | AbilityCode::None);
    let mut of_system = log.status.iter().filter(|it| it.system == system);
    let mut spans = Vec::new();
    while let Some(first) = of_system.find(|it| is_unable(it)) {
        let able = of_system.find(|it| !is_unable(it));
        let until_s = able.map_or(f64::INFINITY, |it| log.seconds(it.at_ns));
        spans.push((log.seconds(first.at_ns), until_s));
    }
    spans
}

/// Returns the longest time in which the mode of the accepted frames did not fit the redundancy, s.
///
/// L3 needs a standby, and the status frames show whether there is one. A degraded master with a
/// standby needs a cause: a change of its phase, or a failure. A change of phase because the master
/// does not hear its standby is not a cause, because the standby's frames are on the bus.
#[must_use]
pub fn wrong_mode_s(log: &RunLog) -> f64 {
    let start_ns = log.start_ns.unwrap_or(0);
    let failure_ns = failure_ns(log).unwrap_or(u64::MAX);
    let of_core_0 = |event: &&CoreEvent| event.core == CoreId::CONTROL;
    let mut events = log.events.iter().filter(of_core_0).peekable();
    let mut status = log.status.iter().peekable();
    // For each system: its last status frame as master or standby, and whether its last change of
    // phase is a cause for degraded driving.
    let (mut seen, mut has_cause) = ([(start_ns, RoleCode::Starting); 2], [true; 2]);
    let (mut longest_ns, mut wrong): (u64, Option<(ControlFrame, u64)>) = (0, None);
    for frame in log.accepted() {
        while let Some(it) = status.next_if(|it| it.at_ns <= frame.at_ns) {
            if matches!(it.role, RoleCode::Standby | RoleCode::Master) {
                seen[it.system.index()] = (it.at_ns.max(start_ns), it.role);
            }
        }
        while let Some(it) = events.next_if(|it| it.at_ns <= frame.at_ns) {
            if let Event::Phase { to, on, .. } = it.event {
                has_cause[it.system.index()] = to != Phase::Master && on != Evidence::StandbyMute;
            }
        }
        let (seen_ns, role) = seen[frame.system.peer().index()];
        let stands_by =
            role == RoleCode::Standby && frame.at_ns.saturating_sub(seen_ns) <= THERE_NS;
        let has_cause = has_cause[frame.system.index()] || failure_ns <= frame.at_ns;
        let since_ns = match frame.mode {
            ModeCode::L3 if !stands_by => seen_ns,
            ModeCode::DegradedL2 if stands_by && !has_cause => frame.at_ns,
            _ => {
                wrong = None;
                continue;
            }
        };
        let is_same = |(first, _): &(ControlFrame, u64)| {
            (first.system, first.mode) == (frame.system, frame.mode)
        };
        let begun = wrong.filter(is_same).unwrap_or((*frame, since_ns));
        wrong = Some(begun);
        longest_ns = longest_ns.max(frame.at_ns.saturating_sub(begun.1));
    }
    longest_ns as f64 * 1e-9
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::run_log::{PowerChange, StatusFrame};
    use tandem_vehicle::Ruling;

    const MS: u64 = 1_000_000;
    const A: SystemId = SystemId::A;
    const B: SystemId = SystemId::B;

    /// Returns a log in which A drives in this mode for 10 s and B is standby until `until_ms`.
    fn log(mode: ModeCode, until_ms: u64) -> RunLog {
        let control = (0..1_000).map(|cycle| ControlFrame {
            at_ns: cycle * 10 * MS,
            sent_ns: cycle * 10 * MS,
            system: A,
            term: 2,
            mode,
            asks: false,
            age_ns: None,
            ruling: Ruling::Accepted,
        });
        let status = |system, role| {
            move |tenth| StatusFrame {
                at_ns: tenth * 100 * MS,
                system,
                role,
                mode,
                ability: tandem_bus::AbilityCode::All,
            }
        };
        let mut log = RunLog {
            start_ns: Some(0),
            end_ns: Some(10_000 * MS),
            control: control.collect(),
            status: (0..100).map(status(A, RoleCode::Master)).collect(),
            ..RunLog::default()
        };
        log.status
            .extend((0..until_ms / 100).map(status(B, RoleCode::Standby)));
        log.status.sort_by_key(|status| status.at_ns);
        log
    }

    fn phase(to: Phase, on: Evidence) -> CoreEvent {
        let from = Phase::Master;
        CoreEvent {
            at_ns: 1_000 * MS,
            system: A,
            core: CoreId::CONTROL,
            event: Event::Phase { from, to, on },
        }
    }

    #[test]
    fn redundancy_is_lost_from_the_last_time_at_which_a_system_stood_by() {
        assert_eq!(redundancy_lost_s(&log(ModeCode::L3, 10_000)), None);
        let lost_s = redundancy_lost_s(&log(ModeCode::L3, 6_000)).unwrap();
        assert!((lost_s - 6.0).abs() < 0.2, "{lost_s}");
        assert_eq!(redundancy_lost_s(&log(ModeCode::L3, 0)), Some(0.0));
        // A system that loses its power is off at once.
        let mut off = log(ModeCode::L3, 10_000);
        off.power.push(PowerChange {
            at_ns: 9_500 * MS,
            system: B,
            on: false,
        });
        off.status
            .retain(|status| status.system == A || status.at_ns < 9_500 * MS);
        assert_eq!(redundancy_lost_s(&off), Some(9.5));
        // A standby that can only stop is none; one that lacks a sensor is one.
        for (ability, lost_s) in [
            (AbilityCode::Lacks, None),
            (AbilityCode::StopOnly, Some(7.0)),
            (AbilityCode::None, Some(7.0)),
        ] {
            let mut blind = log(ModeCode::L3, 10_000);
            for status in &mut blind.status {
                if status.system == B && status.at_ns >= 7_000 * MS {
                    status.ability = ability;
                }
            }
            assert_eq!(redundancy_lost_s(&blind), lost_s);
            // It can drive again at the end.
            blind
                .status
                .iter_mut()
                .rev()
                .take(2)
                .for_each(|it| it.ability = AbilityCode::All);
            assert_eq!(redundancy_lost_s(&blind), None);
            assert_eq!(alone(&blind).len(), usize::from(lost_s.is_some()));
        }
        assert_eq!(redundancy_lost_s(&RunLog::default()), None);
    }

    /// B is without power from 3 s on, and stands by again from 7 s on.
    #[test]
    fn redundancy_that_returns_was_lost_for_a_span() {
        let mut returns = log(ModeCode::L3, 10_000);
        let is_off = |at_ns: u64| (3_000 * MS..7_000 * MS).contains(&at_ns);
        { &mut returns.status }.retain(|it| it.system == A || !is_off(it.at_ns));
        returns.power.push(PowerChange {
            at_ns: 3_000 * MS,
            system: B,
            on: false,
        });
        let spans = alone(&returns);
        let [(from_s, to_s)] = spans[..] else {
            panic!("{spans:?}")
        };
        assert!(
            (from_s - 3.0).abs() < 0.01 && (to_s - 7.0).abs() < 0.01,
            "{spans:?}"
        );
        assert_eq!(redundancy_lost_s(&returns), None);
    }

    #[test]
    fn l3_of_one_system_alone_is_a_wrong_mode() {
        assert!(wrong_mode_s(&log(ModeCode::L3, 10_000)) < 0.5);
        let alone_s = wrong_mode_s(&log(ModeCode::L3, 6_000));
        assert!((alone_s - 4.0).abs() < 0.2, "{alone_s}");
        assert_eq!(wrong_mode_s(&log(ModeCode::DegradedL2, 6_000)), 0.0);
    }

    #[test]
    fn a_degraded_master_beside_a_standby_needs_a_cause() {
        use Phase::{DegradedMaster, Master};
        for (phase_, is_wrong) in [
            (phase(Master, Evidence::HandshakeDone), true),
            (phase(DegradedMaster, Evidence::StandbyMute), true),
            (phase(DegradedMaster, Evidence::BeatsSilent), false),
            (phase(DegradedMaster, Evidence::StandbyUnable), false),
            (phase(DegradedMaster, Evidence::FaultStop), false),
        ] {
            let mut log = log(ModeCode::DegradedL2, 10_000);
            log.control.retain(|frame| frame.at_ns >= 1_000 * MS);
            log.events = vec![phase_];
            assert_eq!(wrong_mode_s(&log) > 8.0, is_wrong, "{phase_:?}");
            log.events.push(CoreEvent {
                event: Event::Sensors { missing: 1 },
                ..phase_
            });
            assert_eq!(wrong_mode_s(&log), 0.0, "it has lost a sensor");
        }
    }

    #[test]
    fn a_stop_needs_a_reason() {
        let mut log = log(ModeCode::L3, 10_000);
        assert_eq!(stop(&log), None);
        log.figures.standing_s = 2.5;
        assert_eq!(stop(&log), Some(Stop::Standing(2.5)));
        log.figures.safe_stop_s = Some(4.0);
        assert_eq!(stop(&log), Some(Stop::SafeStop(4.0)));
        log.events = vec![phase(Phase::DegradedMaster, Evidence::FaultStop)];
        assert_eq!(stop(&log), None);
        log.events[0].at_ns = 5_000 * MS;
        assert!(stop(&log).is_some(), "the failure came later");
        log.figures.takeover_asked_s = Some(3.0);
        assert_eq!(stop(&log), None);
    }
}
