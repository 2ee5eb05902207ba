//! The outcome of each fault of a run, from the recording: the analysis that judges every run.

use serde::{Deserialize, Serialize};
use tandem_board::SystemId;
use tandem_board_host::Wire;
use tandem_cores::trace::Event;
use tandem_record::gap::{
    Gap, both_transmitted_ms, hand_over_ms, hand_overs, periods, stale_frames,
};
use tandem_record::run_log::Stall;
use tandem_record::{RunLog, Takeover, ms_between, takeovers};
use tandem_sim::faults::{Fault, Kind, Row, Sequence, Way, row};

use super::Source;
use super::leg::Injected;
use tandem::metrics::{self, GapMetrics};
use tandem::run::Recorded;

/// The outcome of one sequence of faults.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Outcome {
    pub(super) number: u64,
    /// The fault, as `cut can of the master`.
    pub(super) class: String,
    /// Whether the fault leaves the frames of the system that drives as they are.
    pub(super) spares_control: bool,
    /// From the injection until the other system did something about it.
    pub(super) detection_ms: Option<f64>,
    /// The longest time without control. Beyond its bound without what stood still in it.
    pub(super) gap_ms: f64,
    /// The bound of that time: that of the sign which ended it.
    pub(super) bound_ms: f64,
    /// From the last control frame before the fault to the fault.
    pub(super) phase_ms: f64,
    pub(super) power_cycles: u32,
    /// Gaps that stalls of the machine explain, in words.
    pub(super) explained: Vec<String>,
    pub(super) violations: Vec<String>,
}

/// The outcome of each fault of a run, and the violations of the run as a whole.
///
/// # Errors
/// If a fault cannot be found again.
pub(super) fn judge(
    source: &Source<'_>,
    recorded: &Recorded<Vec<Injected>>,
) -> anyhow::Result<(Vec<Outcome>, Vec<String>)> {
    let (log, around) = (&recorded.log, &recorded.around);
    let run = Run {
        log,
        takeovers: takeovers(log),
        beyond: Vec::new(),
        stalls: [&around.machine.stalls[..], &log.held_up].concat(),
        bounds: &around.bounds,
    };
    let run = Run {
        beyond: metrics::gaps(log, &run.takeovers, around),
        ..run
    };
    let mut outcomes = Vec::new();
    for (index, injected) in recorded.done.iter().enumerate() {
        // What happens up to the next fault belongs to this one.
        let next = recorded.done.get(index + 1);
        let until_ns = next.map_or(u64::MAX, |next| next.at_ns);
        let (sequence, _) = source.sequence(injected.number)?;
        outcomes.push(run.outcome(&sequence, injected, until_ns));
    }
    let wrong = around.leftovers.iter();
    Ok((
        outcomes,
        wrong.map(|it| format!("left behind: {it}")).collect(),
    ))
}

/// How an old master learns of the new one. The later, the greater.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Hears {
    All,
    /// It is cut off the bus. Mended, it sends until it hears the next frame.
    WhenMended,
    /// Its receiver is dead.
    OverTheLink,
}

impl Hears {
    const fn under(kind: Kind) -> Self {
        match kind {
            Kind::Deaf => Self::OverTheLink,
            Kind::Cut(Wire::Can) | Kind::Flap(Wire::Can, _) => Self::WhenMended,
            _ => Self::All,
        }
    }
}

struct Run<'r> {
    log: &'r RunLog,
    takeovers: Vec<Takeover>,
    /// The gaps beyond their bounds.
    beyond: Vec<GapMetrics>,
    stalls: Vec<Stall>,
    bounds: &'r tandem_record::gap::Bounds,
}

impl Run<'_> {
    fn outcome(&self, sequence: &Sequence, injected: &Injected, until_ns: u64) -> Outcome {
        let (log, at_ns) = (self.log, injected.at_ns);
        let within = |ns: u64| (at_ns..until_ns).contains(&ns);
        let spares_control = spares_control(sequence);
        let mut times = periods(
            log,
            &self.takeovers,
            self.bounds,
            &self.stalls,
            [at_ns, until_ns],
        );
        // One that the next fault ends belongs to that.
        times.retain(|gap| gap.to_ns <= until_ns);
        let net_ms = |gap: &Gap| match gap.ms() > gap.bound_ms {
            true => gap.ms() - gap.stalled_ms,
            false => gap.ms(),
        };
        let longest = times.iter().max_by(|a, b| net_ms(a).total_cmp(&net_ms(b)));
        let (gap_ms, bound_ms) = longest.map_or((0.0, self.bounds.silent_ms), |gap| {
            (net_ms(gap), gap.bound_ms)
        });
        let last = log
            .accepted()
            .take_while(|frame| frame.at_ns <= at_ns)
            .last();
        let [from_s, until_s] = [at_ns, until_ns].map(|ns| log.seconds(ns));
        let of_this = |gap: &&GapMetrics| {
            let to_s = gap.at_s + gap.gap_ms * 1e-3;
            to_s > from_s && to_s <= until_s
        };
        let told = |gap: &GapMetrics| {
            let (ms, bound, by) = (gap.gap_ms, gap.bound_ms, &gap.ended_by);
            format!("{ms:.1} ms without control (bound {bound:.0} ms, ended by {by})")
        };
        let (explained, beyond): (Vec<&GapMetrics>, Vec<_>) = self
            .beyond
            .iter()
            .filter(of_this)
            .partition(|gap| gap.explained);
        // Where the bus stands still by a fault, that is no stall of the machine.
        let bus_hangs = |fault: &Fault| matches!(fault.kind, Kind::VehicleHangs(_));
        let is_machine = !sequence.faults.iter().any(bus_hangs);
        let explained = explained.into_iter().filter(|_| is_machine);
        let hears = sequence.faults.iter().map(|fault| Hears::under(fault.kind));
        let hears = hears.max().unwrap_or(Hears::All);
        let unexplained = |gap: &GapMetrics| match gap.evidence.is_empty() {
            true => told(gap),
            false => format!("{}; {} does not explain it", told(gap), gap.evidence),
        };
        let mut violations: Vec<String> = beyond.into_iter().map(unexplained).collect();
        violations.extend(self.of_masters(&within, spares_control, hears));
        if log.collisions_ns.iter().any(|ns| within(*ns)) {
            violations.push("the vehicle touched another one".to_owned());
        }
        if injected.healed_ns.is_none() {
            let roles = injected.roles;
            violations.push(format!("not master and standby again: {roles:?}"));
        }
        Outcome {
            number: injected.number,
            class: class(sequence),
            spares_control,
            detection_ms: self.detection_ms(sequence, injected, until_ns),
            gap_ms,
            bound_ms,
            phase_ms: last.map_or(0.0, |last| ms_between(last.at_ns, at_ns)),
            power_cycles: injected.power_cycles,
            explained: explained
                .map(|gap| format!("{}: {}", told(gap), gap.evidence))
                .collect(),
            violations,
        }
    }

    /// Violations by the systems that drove.
    fn of_masters(
        &self,
        within: &dyn Fn(u64) -> bool,
        spares_control: bool,
        hears: Hears,
    ) -> Vec<String> {
        let log = RunLog {
            control: self
                .log
                .control
                .iter()
                .filter(|frame| within(frame.at_ns))
                .copied()
                .collect(),
            ..RunLog::default()
        };
        let takeovers: Vec<Takeover> = self
            .takeovers
            .iter()
            .filter(|takeover| within(takeover.at_ns))
            .copied()
            .collect();
        let mut wrong = Vec::new();
        let two_ms = log.mastership().two_masters_ns() as f64 * 1e-6;
        if two_ms > 0.0 {
            wrong.push(format!("two masters for {two_ms:.1} ms"));
        }
        let both_ms = both_transmitted_ms(&log);
        let limits = &self.bounds.limits;
        let longest_ms = match hears {
            Hears::All => hand_over_ms(&takeovers),
            Hears::OverTheLink => {
                hand_overs(&takeovers) as f64 * limits.deaf_hand_over().as_ms_f64()
            }
            Hears::WhenMended => {
                let next_frame = limits.control_period + limits.poll_interval;
                takeovers.len() as f64 * next_frame.as_ms_f64()
            }
        };
        if both_ms > longest_ms {
            wrong.push(format!("both systems transmitted for {both_ms:.1} ms"));
        }
        let stale = stale_frames(&log, &takeovers, &self.stalls);
        if stale > 0 {
            wrong.push(format!("{stale} control frames too old to act"));
        }
        // A stalled machine is another matter: then the old master found that it was held up.
        let mut needless = takeovers.iter().filter(|it| !it.held_up);
        if spares_control && let Some(takeover) = needless.next_back() {
            let (from, cause) = (takeover.from, takeover.cause_in_words());
            wrong.push(format!("{from} was relieved, though it was sound: {cause}"));
        }
        wrong
    }

    /// From the injection to the first change of phase of the system that did not fail.
    fn detection_ms(&self, sequence: &Sequence, injected: &Injected, until_ns: u64) -> Option<f64> {
        let [fault] = &sequence.faults[..] else {
            return None;
        };
        let observer = match fault.way {
            _ if fault.kind.is_of_both() => return None,
            Way::Both => return None,
            Way::From(SystemId::A) => injected.driver.peer(),
            Way::From(SystemId::B) => injected.driver,
        };
        let at_ns = injected.at_ns + fault.at.as_ns();
        let noticed = self.log.events.iter().find(|event| {
            let is_change = matches!(event.event, Event::TookOver { .. } | Event::Phase { .. });
            event.system == observer && (at_ns..until_ns).contains(&event.at_ns) && is_change
        });
        noticed.map(|event| ms_between(at_ns, event.at_ns))
    }
}

/// Whether the faults leave the frames of the system that drives as they are, so that it must not
/// be relieved. A bus that stands still delivers them too late: the vehicle refuses them, and their
/// sender may go.
pub(super) fn spares_control(sequence: &Sequence) -> bool {
    sequence.faults.iter().all(|fault| {
        let spares = matches!(row(fault), Row::None | Row::Stall(_));
        spares && !matches!(fault.kind, Kind::VehicleHangs(_))
    })
}

/// The fault, in words.
pub(super) fn class(sequence: &Sequence) -> String {
    let of = |way| match way {
        Way::From(SystemId::A) => " of the master",
        Way::From(SystemId::B) => " of the standby",
        Way::Both => " both ways",
    };
    let words = sequence.faults.iter().map(|fault| {
        let label = fault.kind.label();
        match fault.kind.is_of_both() {
            true => label,
            false => label + of(fault.way),
        }
    });
    words.collect::<Vec<_>>().join(" + ")
}
