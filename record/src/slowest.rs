//! Where the slowest percent of the reactions spent its time, part by part, from bus and trace.

use serde::{Deserialize, Serialize};
use tandem_board::CoreId;
use tandem_cores::trace::Event;

use crate::RunLog;
use crate::reaction::{Reacted, reaction};
use crate::run_log::Stall;

/// The parts of a reaction, in the order of time.
const PARTS: [&str; 4] = [
    "measurement to core 1",
    "cores 1, 2, 0",
    "trajectory to control frame",
    "frame to vehicle",
];

/// One of [`PARTS`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Part {
    /// From where to where.
    pub part: String,
    /// Median over all reactions, ms.
    pub p50_ms: f64,
    /// Median over the slowest percent, ms.
    pub slowest_ms: f64,
}

/// The parts of all reactions beside those of the slowest percent.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Slowest {
    /// In the order of time.
    pub parts: Vec<Part>,
    /// The reactions in the slowest percent; at least 1.
    pub count: usize,
    /// Those of them during which the machine or the bus stalled.
    pub stalled: usize,
    /// The 99th percentile of the reactions without a stall, ms; `None` if each met one.
    pub p99_unstalled_ms: Option<f64>,
}

/// Returns the account of the slowest percent; `None` if no reaction has its chain in the trace.
/// `stalls` are those of the machine; those of the bus are in the recording.
///
/// The chain of a command is the last one that ended in its system before the command was sent.
/// Core 1's acquisition is its end minus its latency.
#[must_use]
pub fn slowest(log: &RunLog, stalls: &[Stall]) -> Option<Slowest> {
    let met_stall = |one: &Reacted| {
        let mut all = stalls.iter().chain(&log.held_up);
        all.any(|stall| stall.from_ns < one.acted_ns && one.measured_ns < stall.to_ns)
    };
    let chains: Vec<_> = log
        .events
        .iter()
        .filter(|event| event.core == CoreId::CONTROL)
        .filter_map(|event| match event.event {
            Event::Chain { latency_ns, .. } => Some((event.system, event.at_ns, latency_ns)),
            _ => None,
        })
        .collect();
    let parts = |one: &Reacted| -> Option<[f64; PARTS.len()]> {
        let ended = chains.partition_point(|(_, at_ns, _)| *at_ns <= one.sent_ns);
        let own = chains[..ended].iter().rev();
        let (_, ended_ns, latency_ns) = own.clone().find(|(system, ..)| *system == one.system)?;
        let acquired_ns = ended_ns.checked_sub(u64::from(*latency_ns))?;
        let ends = [
            one.measured_ns,
            acquired_ns,
            *ended_ns,
            one.sent_ns,
            one.acted_ns,
        ];
        Some(std::array::from_fn(|at| {
            crate::ms_between(ends[at], ends[at + 1])
        }))
    };
    let mut all: Vec<_> = reaction(log)
        .reacted
        .into_iter()
        .filter_map(|one| {
            Some((
                one.acted_ns - one.measured_ns,
                parts(&one)?,
                met_stall(&one),
            ))
        })
        .collect();
    all.sort_by_key(|(took_ns, ..)| *took_ns);
    let count = all.len().div_ceil(100);
    let slow = &all[all.len() - count..];
    let median = |of: &[(u64, [f64; PARTS.len()], bool)], part: usize| {
        let mut times: Vec<f64> = of.iter().map(|(_, parts, _)| parts[part]).collect();
        times.sort_by(f64::total_cmp);
        times[times.len() / 2]
    };
    let part = |(at, name): (usize, &&str)| Part {
        part: (*name).to_owned(),
        p50_ms: median(&all, at),
        slowest_ms: median(slow, at),
    };
    let calm: Vec<u64> = all.iter().filter(|of| !of.2).map(|of| of.0).collect();
    let p99 = calm.get((calm.len() * 99).div_ceil(100).saturating_sub(1));
    (!all.is_empty()).then(|| Slowest {
        parts: PARTS.iter().enumerate().map(part).collect(),
        count,
        stalled: slow.iter().filter(|of| of.2).count(),
        p99_unstalled_ms: p99.map(|ns| *ns as f64 * 1e-6),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::run_log::{ControlFrame, CoreEvent, Stood};
    use tandem_board::SystemId;
    use tandem_bus::ModeCode;
    use tandem_vehicle::Ruling;

    const MS: u64 = 1_000_000;

    /// 300 rounds of 50 ms: core 1 begins 2 ms after the measurement, the chain takes 3 ms, the
    /// frame leaves 1 ms later and arrives after 0.5 ms. In each hundredth round the named part
    /// takes 9 ms more; the trace of system B, which sends nothing, has other chains.
    fn log(slow_part: usize) -> RunLog {
        let mut log = RunLog::default();
        for round in 0..300 {
            let measured_ns = (100 + round * 50) * MS;
            let mut takes = [2 * MS, 3 * MS, MS, MS / 2];
            takes[slow_part] += if round % 100 == 50 { 9 * MS } else { 0 };
            let acquired_ns = measured_ns + takes[0];
            let ended_ns = acquired_ns + takes[1];
            let sent_ns = ended_ns + takes[2];
            log.measured_ns.push(measured_ns);
            for (system, at_ns) in [(SystemId::A, ended_ns), (SystemId::B, ended_ns + 1000)] {
                let latency_ns = (at_ns - acquired_ns) as u32;
                let event = Event::Chain {
                    latency_ns,
                    cycle: round as u32,
                };
                let core = CoreId::CONTROL;
                log.events.push(CoreEvent {
                    at_ns,
                    system,
                    core,
                    event,
                });
            }
            log.control.push(ControlFrame {
                at_ns: sent_ns + takes[3],
                sent_ns,
                system: SystemId::A,
                term: 2,
                mode: ModeCode::L3,
                asks: false,
                age_ns: Some(sent_ns - measured_ns),
                ruling: Ruling::Accepted,
            });
        }
        log
    }

    #[test]
    fn the_part_that_was_slow_is_named() {
        for part in 0..PARTS.len() {
            let found = slowest(&log(part), &[]).unwrap();
            assert_eq!((found.count, found.stalled), (3, 0));
            for (at, one) in found.parts.iter().enumerate() {
                let usual = [2.0, 3.0, 1.0, 0.5][at];
                let slow = usual + if at == part { 9.0 } else { 0.0 };
                assert!((one.p50_ms - usual).abs() < 1e-6, "{one:?}");
                assert!((one.slowest_ms - slow).abs() < 1e-6, "{one:?}");
            }
        }
    }

    #[test]
    fn a_stall_explains_what_it_overlaps() {
        // The slow round 50 began at 2600 ms.
        let (from_ns, to_ns) = (2603 * MS, 2612 * MS);
        let of = Stood::Cpu(0);
        let found = slowest(&log(1), &[Stall { of, from_ns, to_ns }]).unwrap();
        assert_eq!((found.count, found.stalled), (3, 1));
        assert_eq!(slowest(&RunLog::default(), &[]), None);
    }
}
