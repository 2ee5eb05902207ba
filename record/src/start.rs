//! The start protocol as the recording shows it. T-RED-2

use tandem_board::{CoreId, SystemId};
use tandem_cores::trace::Event;
use tandem_redundancy::Phase;

use crate::RunLog;

/// Returns the time between the moments at which the two systems left the start protocol, ns.
/// Returns `None` unless they left it as master and standby, within `TOGETHER_NS`.
#[must_use]
pub fn skew_ns(log: &RunLog) -> Option<u64> {
    let left = |system: SystemId| {
        let of_system = |event: &&crate::run_log::CoreEvent| {
            event.system == system && event.core == CoreId::CONTROL
        };
        let mut events = log.events.iter().filter(of_system);
        events.find_map(|event| match event.event {
            Event::Phase {
                from: Phase::Starting,
                to: to @ (Phase::Master | Phase::Standby),
                ..
            } => Some((event.at_ns, to)),
            _ => None,
        })
    };
    let [(a_ns, a), (b_ns, b)] = [left(SystemId::A)?, left(SystemId::B)?];
    let skew_ns = a_ns.abs_diff(b_ns);
    (a != b && skew_ns <= TOGETHER_NS).then_some(skew_ns)
}

/// Two systems that leave the protocol on the same sync edge do so within this time, ns.
const TOGETHER_NS: u64 = 100_000_000;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::run_log::CoreEvent;
    use tandem_redundancy::Evidence;

    #[test]
    fn skew_is_the_time_between_the_two_ends_of_the_start() {
        let leaves = |at_us: u64, system, to| CoreEvent {
            at_ns: at_us * 1_000,
            system,
            core: CoreId::CONTROL,
            event: Event::Phase {
                from: Phase::Starting,
                to,
                on: Evidence::Stalled,
            },
        };
        let log = |b_us, b| RunLog {
            events: vec![
                leaves(5_000, SystemId::A, Phase::Master),
                leaves(b_us, SystemId::B, b),
            ],
            ..RunLog::default()
        };
        assert_eq!(skew_ns(&log(5_572, Phase::Standby)), Some(572_000));
        assert_eq!(skew_ns(&log(4_428, Phase::Standby)), Some(572_000));
        assert_eq!(skew_ns(&log(5_572, Phase::Master)), None, "no pair");
        assert_eq!(
            skew_ns(&log(200_000, Phase::Standby)),
            None,
            "it joined later"
        );
        assert_eq!(skew_ns(&RunLog::default()), None);
    }
}
