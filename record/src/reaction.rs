//! Reaction and age: how soon the vehicle reacts to a measurement, and how old the data is then.

use tandem_board::SystemId;

use crate::RunLog;
use crate::run_log::ControlFrame;

/// How much earlier than its real time a measurement may seem to be, ns. The age in a control frame
/// is rounded. The world around an emulated machine advances in steps of 1 ms, so the time stamp
/// of a frame is up to one step early. Measurements are further apart than this.
const EARLY_NS: u64 = 1_100_000;

/// A measurement, and the first control frame that reflects it and takes effect.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Reacted {
    /// When it was measured, ns.
    pub measured_ns: u64,
    /// The frame's sender.
    pub system: SystemId,
    /// When the frame was sent, ns.
    pub sent_ns: u64,
    /// When the frame took effect, ns; not before the measurement.
    pub acted_ns: u64,
}

/// The two distributions, ms.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Reaction {
    /// Each measurement with its reaction, in the order of measuring.
    pub reacted: Vec<Reacted>,
    /// Time from each measurement until a control frame that reflects it first takes effect.
    pub reaction_ms: Vec<f64>,
    /// Age of the oldest measurement behind each control frame when the frame takes effect.
    pub age_ms: Vec<f64>,
}

/// Returns the reaction to each measurement, and the age of the data behind each control frame.
///
/// A control frame contains the age of its oldest measurement. This age omits the shortest delay of
/// the bus, but includes any longer wait for the bus. Without stamps in global time it also omits a
/// delay that all sensors have, which is added. The time of sending minus the age is a point in
/// time: the oldest measurement is the last one taken before it, even if it was sent later. A
/// measurement belongs to the last command whose oldest measurement is not newer than it. The
/// reaction ends when that command first takes effect.
#[must_use]
pub fn reaction(log: &RunLog) -> Reaction {
    let mut found = Reaction::default();
    let (measured_ns, unseen_ns) = (&log.measured_ns, log.sensor_time.unseen_ns());
    // The commands in the order in which they took effect. Each has the time of its oldest
    // measurement, and its first frame that took effect.
    let mut commands: Vec<(u64, &ControlFrame)> = Vec::new();
    for frame in log.accepted() {
        let Some(age_ns) = frame.age_ns else { continue };
        let told_ns = frame.sent_ns.saturating_sub(age_ns + unseen_ns);
        let newer = measured_ns.partition_point(|at_ns| *at_ns <= told_ns + EARLY_NS);
        let Some(oldest_ns) = newer.checked_sub(1).map(|index| measured_ns[index]) else {
            continue;
        };
        found
            .age_ms
            .push(frame.at_ns.saturating_sub(oldest_ns) as f64 * 1e-6);
        if commands.last().is_none_or(|last| last.0 < oldest_ns) {
            commands.push((oldest_ns, frame));
        }
    }
    for measured_ns in measured_ns {
        let after = commands.partition_point(|command| command.0 <= *measured_ns);
        // The last command is skipped: newer measurements may belong to a command after it.
        if let Some((_, frame)) = after.checked_sub(1).map(|index| commands[index])
            && after < commands.len()
        {
            let measured_ns = *measured_ns;
            let acted_ns = frame.at_ns.max(measured_ns);
            let (system, sent_ns) = (frame.system, frame.sent_ns);
            found
                .reaction_ms
                .push((acted_ns - measured_ns) as f64 * 1e-6);
            found.reacted.push(Reacted {
                measured_ns,
                system,
                sent_ns,
                acted_ns,
            });
        }
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;
    use tandem_bus::ModeCode;
    use tandem_vehicle::Ruling;

    const MS: u64 = 1_000_000;

    /// The shortest delay of the bus, which the controller neglects.
    const WAY_NS: u64 = MS / 2;

    /// Object lists at 0 and 15 ms of each round of 50 ms. Control frames every 10 ms. The command
    /// of a round first acts `acts_ms` after the round begins. The age in its frames places the
    /// first list of the round `WAY_NS - early_ns` after its real time.
    fn log_placed(acts_ms: u64, early_ns: u64) -> RunLog {
        let mut log = RunLog::default();
        for round in 0..20 {
            log.measured_ns
                .extend([0, 15].map(|phase| (round * 50 + phase) * MS));
        }
        for at_ms in (100 + acts_ms..900).step_by(10) {
            let oldest_ns = (at_ms - acts_ms) / 50 * 50 * MS + WAY_NS - early_ns;
            let sent_ns = at_ms * MS - 200_000;
            log.control.push(ControlFrame {
                at_ns: at_ms * MS,
                sent_ns,
                system: SystemId::A,
                term: 2,
                mode: ModeCode::L3,
                asks: false,
                // The age is rounded as in a real frame.
                age_ns: Some((sent_ns - oldest_ns) / 100_000 * 100_000 + 50_000),
                ruling: Ruling::Accepted,
            });
        }
        log
    }

    fn log(acts_ms: u64) -> RunLog {
        log_placed(acts_ms, 0)
    }

    #[test]
    fn each_measurement_acts_with_the_first_command_of_its_round() {
        let found = reaction(&log(20));
        let mut kinds = found.reaction_ms.clone();
        kinds.sort_by(f64::total_cmp);
        kinds.dedup();
        assert_eq!(kinds, [5.0, 20.0]);
        // 15 of the 16 commands have a successor; each of them reflects two lists.
        assert_eq!(found.reaction_ms.len(), 2 * 15);
        let mut ages = found.age_ms;
        ages.sort_by(f64::total_cmp);
        ages.dedup();
        assert_eq!(ages, [20.0, 30.0, 40.0, 50.0, 60.0]);
    }

    /// Because the clocks drift, a measurement may seem to be older than its list on the bus. A
    /// world that advances in steps makes it one step older. It must still belong to its own round.
    #[test]
    fn a_measurement_that_is_placed_early_stays_in_its_round() {
        for early_ns in [WAY_NS, WAY_NS + MS] {
            assert_eq!(reaction(&log_placed(20, early_ns)), reaction(&log(20)));
        }
    }

    #[test]
    fn a_core_that_holds_the_lists_back_is_late_and_old() {
        let (soon, late) = (reaction(&log(20)), reaction(&log(45)));
        let sum = |spans: &[f64]| spans.iter().sum::<f64>() / spans.len() as f64;
        assert!(sum(&late.reaction_ms) > sum(&soon.reaction_ms) + 24.0);
        assert!(sum(&late.age_ms) > sum(&soon.age_ms) + 24.0);
    }

    #[test]
    fn frames_without_effect_or_data_are_not_counted() {
        let mut silent = log(20);
        for (index, frame) in silent.control.iter_mut().enumerate() {
            match index % 2 {
                0 => frame.ruling = Ruling::Fenced,
                _ => frame.age_ns = None,
            }
        }
        assert_eq!(reaction(&silent), Reaction::default());
    }
}
