//! The role of each system over time, from everything in the log that shows it.

use crate::runlog::{Mode, Role, RunLog, System, Verdict, What};

/// A system of which nothing was seen for this long was off, ns: two and a half status periods.
const SILENT_NS: u64 = 250_000_000;

/// What a system is, as a person tells it apart.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum State {
    /// Not seen: without power, in reset, or dead.
    Off,
    /// Not yet in a role.
    Starting,
    /// Computes silently.
    Standby,
    /// Drives with the full function.
    Master,
    /// Drives alone, degraded.
    Degraded,
    /// Stops the vehicle.
    SafeStop,
    /// Has failed and stays silent.
    Suspended,
}

impl State {
    /// All states, in the order of a legend.
    pub(crate) const ALL: [Self; 7] = [
        Self::Master,
        Self::Degraded,
        Self::SafeStop,
        Self::Standby,
        Self::Starting,
        Self::Suspended,
        Self::Off,
    ];

    /// What a legend calls it.
    pub(crate) const fn name(self) -> &'static str {
        match self {
            Self::Off => "off",
            Self::Starting => "starting",
            Self::Standby => "standby",
            Self::Master => "master",
            Self::Degraded => "degraded master",
            Self::SafeStop => "safe stop",
            Self::Suspended => "suspended",
        }
    }

    /// The state that a role and a function make.
    pub(crate) const fn of(role: Role, mode: Mode) -> Self {
        match (role, mode) {
            (Role::Starting, _) => Self::Starting,
            (Role::Standby, _) => Self::Standby,
            (Role::Suspended, _) => Self::Suspended,
            (Role::Master, Mode::DegradedL2) => Self::Degraded,
            (Role::Master, Mode::SafeStop) => Self::SafeStop,
            (Role::Master, Mode::L3 | Mode::None) => Self::Master,
        }
    }
}

/// A time in which a system was in one state: scenario time in s.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Span {
    /// From.
    pub(crate) from_s: f64,
    /// To.
    pub(crate) to_s: f64,
    /// The state.
    pub(crate) state: State,
}

/// The states of one system, without gaps from the start to the end of the run.
pub(crate) fn timeline(log: &RunLog, system: System) -> Vec<Span> {
    let mut seen = observations(log, system);
    seen.sort_by_key(|(at_ns, _)| *at_ns);
    let end_s = log.driven_s();
    let mut spans: Vec<Span> = Vec::new();
    let mut push = |from_s: f64, to_s: f64, state: State| {
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
    push(0.0, first_s, State::Off);
    for (index, (at_ns, state)) in seen.iter().enumerate() {
        let from_s = log.seconds(*at_ns);
        let next_s = seen
            .get(index + 1)
            .map_or(end_s, |(next_ns, _)| log.seconds(*next_ns));
        // Suspended is the last word: such a system need not say it again.
        if next_s - from_s > SILENT_NS as f64 * 1e-9 && *state != State::Suspended {
            // It shows its state for an instant, so that a single sign of life is not lost.
            let until_s = (from_s + 0.01).min(next_s);
            push(from_s, until_s, *state);
            push(until_s, next_s, State::Off);
        } else {
            push(from_s, next_s, *state);
        }
    }
    spans
}

fn observations(log: &RunLog, system: System) -> Vec<(u64, State)> {
    let status = log.status.iter().filter(|status| status.system == system);
    let control = log
        .control
        .iter()
        .filter(|frame| frame.system == system && frame.verdict != Verdict::Invalid);
    let events = log
        .events
        .iter()
        .filter(|event| event.system == system && event.core == 0);
    let mut seen: Vec<(u64, State)> = status
        .map(|status| (status.at_ns, State::of(status.role, status.mode)))
        .collect();
    seen.extend(control.map(|frame| (frame.at_ns, State::of(Role::Master, frame.mode))));
    let off = log
        .power
        .iter()
        .filter(|power| power.system == system && !power.on);
    seen.extend(off.map(|power| (power.at_ns, State::Off)));
    seen.extend(events.filter_map(|event| match event.what {
        What::RoleChanged { role, mode, .. } => Some((event.at_ns, State::of(role, mode))),
        What::Started { .. } => Some((event.at_ns, State::Starting)),
        _ => None,
    }));
    seen
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::synthetic;

    #[test]
    fn a_master_that_loses_power_is_off_and_the_other_goes_from_standby_to_degraded() {
        let log = synthetic::with_takeover(20.0);
        let states = |system| -> Vec<State> {
            timeline(&log, system)
                .into_iter()
                .map(|span| span.state)
                .collect()
        };
        assert_eq!(states(System::A), [State::Master, State::Off]);
        assert_eq!(states(System::B), [State::Standby, State::Degraded]);
        let off = timeline(&log, System::A)[1];
        assert!((off.from_s - 10.0).abs() < 0.03, "{off:?}");
        assert!((off.to_s - 20.0).abs() < 1e-6);
    }

    #[test]
    fn a_system_that_nobody_saw_was_off_all_the_time() {
        let mut log = synthetic::with_takeover(4.0);
        log.status.clear();
        log.control.clear();
        log.events.clear();
        let spans = timeline(&log, System::B);
        assert_eq!(
            spans,
            [Span {
                from_s: 0.0,
                to_s: 4.0,
                state: State::Off
            }]
        );
    }
}
