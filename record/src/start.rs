//! The start protocol as the recording shows it. T-RED-2

use tandem_board::{CoreId, SystemId};
use tandem_cores::trace::Event;
use tandem_redundancy::Phase;

use crate::RunLog;
use crate::run_log::CoreEvent;

/// Returns the time between the moments at which the two systems saw the edge on which they left
/// the start protocol, ns. Returns `None` unless they left it as master and standby, within
/// `TOGETHER_NS`.
///
/// A system sees the edge when a pass over its tasks begins, and the change is recorded when the
/// pass has acted on it, which takes the master longer than the standby.
#[must_use]
pub fn skew_ns(log: &RunLog) -> Option<u64> {
    let left = |system: SystemId| {
        let of_system =
            |event: &&CoreEvent| event.system == system && event.core == CoreId::CONTROL;
        let mut events = log.events.iter().filter(of_system);
        events.find_map(|event| match event.event {
            Event::Phase {
                from: Phase::Starting,
                to: to @ (Phase::Master | Phase::Standby),
                ..
            } => Some((seen_ns(log, event), to)),
            _ => None,
        })
    };
    let [(a_ns, a), (b_ns, b)] = [left(SystemId::A)?, left(SystemId::B)?];
    let skew_ns = a_ns.abs_diff(b_ns);
    (a != b && skew_ns <= TOGETHER_NS).then_some(skew_ns)
}

/// Returns when the task began that recorded this event; the event's own time without a task.
fn seen_ns(log: &RunLog, event: &CoreEvent) -> u64 {
    let begins = log.trace.iter().filter_map(|traced| {
        let is_here = traced.system == event.system && traced.core == event.core;
        let begins = matches!(Event::decode(traced.record), Some(Event::TaskIn { .. }));
        let at_ns = traced.at.as_ns();
        (is_here && begins && at_ns <= event.at_ns).then_some(at_ns)
    });
    begins.max().unwrap_or(event.at_ns)
}

/// Two systems that leave the protocol on the same sync edge do so within this time, ns.
const TOGETHER_NS: u64 = 100_000_000;

#[cfg(test)]
mod tests {
    use super::*;
    use tandem_board::{Instant, Traced};
    use tandem_cores::task_table::TaskCode;
    use tandem_cores::trace::Begin;
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
        // A pass that began 30 µs before it recorded the change, and a later one.
        let begins = |at_us: u64, system| Traced {
            at: Instant::from_ns(at_us * 1_000),
            system,
            core: CoreId::CONTROL,
            record: Event::TaskIn {
                task: TaskCode(0),
                begin: Begin::Goes,
            }
            .encode(),
        };
        let mut with_passes = log(5_572, Phase::Standby);
        with_passes.trace = vec![
            begins(3_000, SystemId::A),
            begins(4_970, SystemId::A),
            begins(5_400, SystemId::A),
            begins(5_570, SystemId::B),
        ];
        assert_eq!(skew_ns(&with_passes), Some(600_000));
    }
}
