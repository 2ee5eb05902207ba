//! The role of each system over time, from every entry of the log that shows it.

use tandem_board::{CoreId, SystemId};
use tandem_bus::{ModeCode, RoleCode};
use tandem_cores::trace::Event;
use tandem_vehicle::Ruling;

use crate::RunLog;
use crate::run_log::StatusFrame;

/// A system without a sign of life for this time counts as off, ns: two and a half status periods.
const SILENT_NS: u64 = 250_000_000;

/// A system that sent a control frame less than this ago drives, ns: ten periods.
const DRIVES_NS: u64 = 100_000_000;

/// The state of a system as a report shows it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RoleState {
    /// Shows no sign of life, because it is without power, in reset, or dead.
    Off,
    /// Has no role yet.
    Starting,
    /// Computes silently.
    Standby,
    /// Drives with the full function.
    Master,
    /// Drives alone, in degraded mode.
    Degraded,
    /// Stops the vehicle.
    SafeStop,
    /// Has failed and stays silent.
    Suspended,
    /// Drives as the SoC asks.
    Parking,
}

impl RoleState {
    /// All states, in the order of a legend.
    pub const ALL: [Self; 8] = [
        Self::Master,
        Self::Degraded,
        Self::Parking,
        Self::SafeStop,
        Self::Standby,
        Self::Starting,
        Self::Suspended,
        Self::Off,
    ];

    /// Returns its name in a legend.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Off => "off",
            Self::Starting => "starting",
            Self::Standby => "standby",
            Self::Master => "master",
            Self::Degraded => "degraded master",
            Self::SafeStop => "safe stop",
            Self::Suspended => "suspended",
            Self::Parking => "parking",
        }
    }

    /// Like [`RoleState::of`], from the codes of a trace record; `None` if a code is unknown.
    #[must_use]
    pub fn of_codes(role: u8, mode: u8) -> Option<Self> {
        let role = RoleCode::ALL.get(usize::from(role))?;
        Some(Self::of(*role, *ModeCode::ALL.get(usize::from(mode))?))
    }

    /// Returns the state that follows from a role and a function.
    #[must_use]
    pub const fn of(role: RoleCode, mode: ModeCode) -> Self {
        match (role, mode) {
            (RoleCode::Starting, _) => Self::Starting,
            (RoleCode::Standby, _) => Self::Standby,
            (RoleCode::Suspended, _) => Self::Suspended,
            (RoleCode::Master, ModeCode::DegradedL2) => Self::Degraded,
            (RoleCode::Master, ModeCode::SafeStop) => Self::SafeStop,
            (RoleCode::Master, ModeCode::Parking) => Self::Parking,
            (RoleCode::Master, ModeCode::L3 | ModeCode::None) => Self::Master,
        }
    }
}

/// A span of scenario time in which a system was in one state, s.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Span {
    /// Start of the span.
    pub from_s: f64,
    /// End of the span.
    pub to_s: f64,
    /// The state.
    pub state: RoleState,
}

/// Returns the states of one system, without gaps from the start to the end of the run.
#[must_use]
pub fn timeline(log: &RunLog, system: SystemId) -> Vec<Span> {
    let mut seen = observations(log, system);
    seen.sort_by_key(|(at_ns, _)| *at_ns);
    let end_s = log.driven_s();
    let mut spans: Vec<Span> = Vec::new();
    let mut push = |from_s: f64, to_s: f64, state: RoleState| {
        let (from_s, to_s) = (from_s.clamp(0.0, end_s), to_s.clamp(0.0, end_s));
        if from_s >= to_s {
            return;
        }
        match spans.last_mut() {
            Some(last) if last.state == state => last.to_s = to_s,
            _ => spans.push(Span {
                from_s,
                to_s,
                state,
            }),
        }
    };
    let first_s = seen.first().map_or(end_s, |(at_ns, _)| log.seconds(*at_ns));
    push(0.0, first_s, RoleState::Off);
    for (index, (at_ns, state)) in seen.iter().enumerate() {
        let from_s = log.seconds(*at_ns);
        let next_s = seen
            .get(index + 1)
            .map_or(end_s, |(next_ns, _)| log.seconds(*next_ns));
        // A suspended system does not report again, but stays suspended.
        if next_s - from_s > SILENT_NS as f64 * 1e-9 && *state != RoleState::Suspended {
            // Show the state for 10 ms, so that a single report is visible.
            let until_s = (from_s + 0.01).min(next_s);
            push(from_s, until_s, *state);
            push(until_s, next_s, RoleState::Off);
        } else {
            push(from_s, next_s, *state);
        }
    }
    spans
}

fn observations(log: &RunLog, system: SystemId) -> Vec<(u64, RoleState)> {
    let status = log.status.iter().filter(|status| status.system == system);
    let control = log
        .control
        .iter()
        .filter(|frame| frame.system == system && frame.ruling != Ruling::Invalid);
    let events = log
        .events
        .iter()
        .filter(|event| event.system == system && event.core == CoreId::CONTROL);
    let mut sent = control.clone().map(|frame| frame.at_ns).peekable();
    let mut sent_ns = None;
    // A master's status has the mode of its redundancy. What it drives, its control frames say.
    let mut is_said_better = |status: &StatusFrame| {
        while let Some(at_ns) = sent.next_if(|at_ns| *at_ns <= status.at_ns) {
            sent_ns = Some(at_ns);
        }
        let is_driving =
            sent_ns.is_some_and(|at_ns| status.at_ns.saturating_sub(at_ns) <= DRIVES_NS);
        status.role == RoleCode::Master && is_driving
    };
    let mut seen: Vec<(u64, RoleState)> = status
        .filter(|status| !is_said_better(status))
        .map(|status| (status.at_ns, RoleState::of(status.role, status.mode)))
        .collect();
    seen.extend(control.map(|frame| (frame.at_ns, RoleState::of(RoleCode::Master, frame.mode))));
    let off = log
        .power
        .iter()
        .filter(|power| power.system == system && !power.on);
    seen.extend(off.map(|power| (power.at_ns, RoleState::Off)));
    seen.extend(events.filter_map(|event| match event.event {
        Event::Role { role, mode, .. } => Some((event.at_ns, RoleState::of_codes(role, mode)?)),
        Event::Started { .. } => Some((event.at_ns, RoleState::Starting)),
        _ => None,
    }));
    seen
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::run_log::{ControlFrame, PowerChange};

    const SECOND_NS: u64 = 1_000_000_000;

    /// Returns a log: A drives for 2 s and loses power; B is its standby and then drives for 2 s.
    fn log() -> RunLog {
        let mut log = RunLog {
            start_ns: Some(SECOND_NS),
            end_ns: Some(5 * SECOND_NS),
            ..RunLog::default()
        };
        for tenth in 0..40 {
            let at_ns = SECOND_NS + tenth * SECOND_NS / 10;
            let mut say = |system, role, mode| {
                log.status.push(StatusFrame {
                    at_ns,
                    system,
                    role,
                    mode,
                    ability: tandem_bus::AbilityCode::All,
                });
            };
            if tenth < 20 {
                say(SystemId::A, RoleCode::Master, ModeCode::L3);
                say(SystemId::B, RoleCode::Standby, ModeCode::L3);
            } else {
                say(SystemId::B, RoleCode::Master, ModeCode::DegradedL2);
            }
        }
        log.power.push(PowerChange {
            at_ns: 3 * SECOND_NS,
            system: SystemId::A,
            on: false,
        });
        log
    }

    #[test]
    fn a_master_that_loses_power_is_off_and_the_other_goes_from_standby_to_degraded() {
        let log = log();
        let states = |system| -> Vec<RoleState> {
            let spans = timeline(&log, system).into_iter();
            spans.map(|span| span.state).collect()
        };
        assert_eq!(states(SystemId::A), [RoleState::Master, RoleState::Off]);
        assert_eq!(
            states(SystemId::B),
            [RoleState::Standby, RoleState::Degraded]
        );
        let off = timeline(&log, SystemId::A)[1];
        assert_eq!((off.from_s, off.to_s), (2.0, 4.0));
    }

    /// D-3: the control frames say that the master parks, and its status frames do not.
    #[test]
    fn a_master_that_parks_does_so_between_its_status_frames_too() {
        let mut log = log();
        for cycle in 0..200 {
            let at_ns = SECOND_NS + cycle * SECOND_NS / 100 - SECOND_NS / 200;
            log.control.push(ControlFrame {
                at_ns,
                sent_ns: at_ns,
                system: SystemId::A,
                term: 1,
                mode: ModeCode::Parking,
                asks: false,
                age_ns: None,
                ruling: Ruling::Accepted,
            });
        }
        let states: Vec<_> = timeline(&log, SystemId::A)
            .iter()
            .map(|it| it.state)
            .collect();
        assert_eq!(states, [RoleState::Parking, RoleState::Off]);
    }

    #[test]
    fn a_system_without_any_sign_was_off_all_the_time() {
        let mut log = log();
        log.status.clear();
        let spans = timeline(&log, SystemId::B);
        let all = Span {
            from_s: 0.0,
            to_s: 4.0,
            state: RoleState::Off,
        };
        assert_eq!(spans, [all]);
    }
}
