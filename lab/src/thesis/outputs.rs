//! Figure 6.21 of the thesis: a digital output of each system over time, and the response times
//! between their edges.
//!
//! The output of a system is high while the system drives. It falls when the system fails. The
//! other system's output rises after that system has detected the failure and taken over.

use tandem_board::{CoreId, SystemId};
use tandem_bus::RoleCode;
use tandem_cores::trace::Event;
use tandem_page::svg::Color;
use tandem_record::{RunLog, ms_between};

use crate::square_waves::{self, SquareWaves, Trace};

/// Times of the two injected faults, ns on the run's clock.
#[derive(Clone, Copy, Debug)]
pub(super) struct Done {
    /// Reset of system A, the first master.
    pub(super) reset_ns: u64,
    /// Power loss of system B, which is master by then.
    pub(super) off_ns: u64,
}

/// The outputs of a run in which master A is reset and later master B loses its power.
#[derive(Clone, Debug)]
pub(super) struct Outputs {
    /// Edges of A and of B, ns; the initial levels are low.
    edges: [Vec<u64>; 2],
    done: Done,
    end_ns: u64,
    begin_ns: u64,
    clock: &'static str,
}

/// Returns the time at which core 0 of a system first recorded after `from_ns` that it is master.
fn leads(log: &RunLog, system: SystemId, from_ns: u64) -> Option<u64> {
    let of_system = log
        .events
        .iter()
        .filter(|event| event.system == system && event.core == CoreId::CONTROL);
    let master = RoleCode::Master as u8;
    of_system
        .filter(|event| event.at_ns >= from_ns)
        .find(|event| matches!(event.event, Event::Role { role, .. } if role == master))
        .map(|event| event.at_ns)
}

impl Outputs {
    /// Reads the outputs from a recording; `None` if a system did not take over.
    pub(super) fn new(log: &RunLog, done: Done, clock: &'static str) -> Option<Self> {
        let begins = leads(log, SystemId::A, 0)?;
        let second = leads(log, SystemId::B, done.reset_ns)?;
        let third = leads(log, SystemId::A, done.off_ns)?;
        let last = log.events.last().map_or(third, |event| event.at_ns);
        Some(Self {
            edges: [
                vec![begins, done.reset_ns, third],
                vec![second, done.off_ns],
            ],
            done,
            end_ns: last,
            begin_ns: begins.saturating_sub(500_000_000),
            clock,
        })
    }

    /// Returns the time from the reset of A to the takeover by B, ms.
    pub(super) fn reset_ms(&self) -> f64 {
        ms_between(self.done.reset_ns, self.edges[1][0])
    }

    /// Returns the time from B's loss of power to the takeover by A, ms.
    pub(super) fn power_ms(&self) -> f64 {
        ms_between(self.done.off_ns, self.edges[0][2])
    }

    /// Returns the events of the experiment, one line each.
    pub(super) fn events(&self) -> String {
        let at_s = |ns: u64| self.at_s(ns);
        format!(
            "  {:8.3} s  A drives, B is its standby\n\
             \x20 {:8.3} s  A is reset: its output falls\n\
             \x20 {:8.3} s  B has detected it and drives: its output rises, {:.2} ms later\n\
             \x20 {:8.3} s  B loses its power, with A as standby again: its output falls\n\
             \x20 {:8.3} s  A has detected it and drives: its output rises, {:.2} ms later\n",
            at_s(self.edges[0][0]),
            at_s(self.done.reset_ns),
            at_s(self.edges[1][0]),
            self.reset_ms(),
            at_s(self.done.off_ns),
            at_s(self.edges[0][2]),
            self.power_ms(),
        )
    }

    /// Draws the outputs over time.
    pub(super) fn draw(&self) -> String {
        let trace = |system: SystemId, color, at_ns, took_ms: f64, what| Trace {
            color,
            label: format!("system {system}"),
            changes: self.edges[system.index()]
                .iter()
                .map(|ns| self.at_s(*ns))
                .collect(),
            note: Some((
                self.at_s(at_ns),
                format!("{took_ms:.2} ms after the {what}"),
            )),
        };
        let Done { reset_ns, off_ns } = self.done;
        let (a, b) = (SystemId::A, SystemId::B);
        square_waves::file(&[SquareWaves {
            title: "Digital outputs: high while the system drives".to_owned(),
            axis: format!("s of {}", self.clock),
            span: self.at_s(self.end_ns),
            traces: vec![
                trace(a, Color::A, off_ns, self.power_ms(), "loss of B's power"),
                trace(b, Color::B, reset_ns, self.reset_ms(), "reset of A"),
            ],
        }])
    }

    /// Returns a time since the beginning of the picture, s.
    fn at_s(&self, ns: u64) -> f64 {
        (ns as f64 - self.begin_ns as f64) * 1e-9
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tandem_record::run_log::CoreEvent;

    #[test]
    fn responses_are_the_times_between_the_edges() {
        let role = |at_ms: u64, system, role: RoleCode| CoreEvent {
            at_ns: at_ms * 1_000_000,
            system,
            core: CoreId::CONTROL,
            event: Event::Role {
                role: role as u8,
                mode: 1,
                term: 2,
            },
        };
        let mut log = RunLog {
            events: vec![
                role(1_000, SystemId::A, RoleCode::Master),
                role(1_001, SystemId::B, RoleCode::Standby),
                role(4_002, SystemId::B, RoleCode::Master),
                role(6_000, SystemId::A, RoleCode::Standby),
                role(9_005, SystemId::A, RoleCode::Master),
            ],
            ..RunLog::default()
        };
        let done = Done {
            reset_ns: 4_000_000_000,
            off_ns: 9_000_000_000,
        };
        let outputs = Outputs::new(&log, done, "a test").unwrap();
        assert_eq!((outputs.reset_ms(), outputs.power_ms()), (2.0, 5.0));
        let svg = outputs.draw();
        assert!(roxmltree::Document::parse(&svg).is_ok(), "{svg}");
        assert!(svg.contains("5.00 ms after the loss"), "{svg}");
        // A recording without the second takeover gives no result.
        log.events.pop();
        assert!(Outputs::new(&log, done, "a test").is_none());
    }
}
