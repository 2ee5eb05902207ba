//! Computes the outcome of each fault from the recording, with the analysis that judges every run.

use serde::{Deserialize, Serialize};
use tandem_board_host::Wire;
use tandem_cores::trace::Event;
use tandem_faults::{Fault, Kind, Observed, Scope, Sequence, Way};
use tandem_record::gap::{
    Bounds, HAND_OVER_MS, both_transmitted_ms, hand_over_ms, hand_overs, periods, stale_frames,
};
use tandem_record::run_log::Stall;
use tandem_record::verdict::figures::{GapFigures, both_transmitted};
use tandem_record::verdict::{Finding, Rule, Watch};
use tandem_record::{RunLog, Takeover, ms_between, takeovers};
use tandem_vehicle::gate::Acceptance;

use super::Source;
use super::round::Injected;
use tandem::run::Recorded;

/// The outcome of one sequence of faults.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Outcome {
    pub(super) number: u64,
    /// The fault in words, for example `cut can of the master`.
    pub(super) class: String,
    /// Whether the control frames of the driving system are unaffected by the fault.
    pub(super) spares_control: bool,
    /// Time from the injection until the other system reacted, ms.
    pub(super) detection_ms: Option<f64>,
    /// The longest time without control, ms, without the parts that stalls excuse.
    pub(super) gap_ms: f64,
    /// The bound of that time, ms; it depends on the evidence that ended the gap.
    pub(super) bound_ms: f64,
    /// Time from the last control frame before the fault to the fault, ms.
    pub(super) phase_ms: f64,
    pub(super) power_cycles: u32,
    /// Gaps that stalls of the machine explain, in words.
    pub(super) explained: Vec<String>,
    pub(super) violations: Vec<String>,
}

/// Returns the outcome of each fault of a run, and the violations of the run as a whole.
///
/// # Errors
/// If the sequence of a fault cannot be created again.
pub(super) fn judge(
    source: &Source,
    recorded: &Recorded<Vec<Injected>>,
) -> anyhow::Result<(Vec<Outcome>, Vec<String>)> {
    let (log, beside) = (&recorded.log, &recorded.around.beside);
    let run = Run {
        log,
        takeovers: takeovers(log),
        stalls: beside.evidence(log),
        bounds: &beside.bounds,
        watch: beside.watch,
    };
    let mut outcomes = Vec::new();
    for (index, injected) in recorded.done.iter().enumerate() {
        // All events until the next fault belong to this fault.
        let next = recorded.done.get(index + 1);
        let until_ns = next.map_or(u64::MAX, |next| next.at_ns);
        let (sequence, _) = source.sequence(injected.number)?;
        outcomes.push(run.outcome(&sequence, injected, until_ns));
    }
    let left = beside.leftovers.iter();
    let mut wrong: Vec<String> = left.map(|it| format!("left behind: {it}")).collect();
    let limits = beside.product.iter();
    let limits = limits.flat_map(|product| Finding::of_limits(beside.bounds.limits, product));
    wrong.extend(limits.map(|finding| finding.to_string()));
    Ok((outcomes, wrong))
}

/// How an old master learns of the new one, from the earliest to the latest.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Hears {
    All,
    /// It is cut off from the bus. After the repair it sends until it receives the next frame.
    WhenRepaired,
    /// Its receiver is dead, so it learns of the new master over the link.
    OverTheLink,
}

impl Hears {
    const fn under(kind: Kind) -> Self {
        match kind {
            Kind::Deaf => Self::OverTheLink,
            Kind::Cut { wire: Wire::Can }
            | Kind::Flap {
                wire: Wire::Can, ..
            } => Self::WhenRepaired,
            _ => Self::All,
        }
    }
}

struct Run<'r> {
    log: &'r RunLog,
    takeovers: Vec<Takeover>,
    stalls: Vec<Stall>,
    bounds: &'r Bounds,
    watch: Watch,
}

impl Run<'_> {
    fn outcome(&self, sequence: &Sequence, injected: &Injected, until_ns: u64) -> Outcome {
        let (log, at_ns) = (self.log, injected.at_ns);
        let within = |ns: u64| (at_ns..until_ns).contains(&ns);
        let mut times = periods(
            log,
            &self.takeovers,
            self.bounds,
            &self.stalls,
            [at_ns, until_ns],
        );
        // A gap that ends after the next fault belongs to that fault.
        times.retain(|gap| gap.to_ns <= until_ns);
        let longest = times
            .iter()
            .max_by(|a, b| a.net_ms().total_cmp(&b.net_ms()));
        let (gap_ms, bound_ms) = longest.map_or((0.0, self.bounds.silent_ms), |gap| {
            (gap.net_ms(), gap.bound_ms)
        });
        let last = log
            .accepted()
            .take_while(|frame| frame.at_ns <= at_ns)
            .last();
        let beyond = times.iter().filter(|gap| gap.ms() > gap.bound_ms);
        let beyond = beyond.map(|gap| GapFigures::of(log, gap).finding());
        let (excused, mut findings): (Vec<Finding>, Vec<_>) = beyond.partition(|it| it.excused);
        // A bus that a fault stops is not a stall of the machine.
        let bus_hangs = |fault: &Fault| matches!(fault.kind, Kind::VehicleHangs(_));
        let is_machine = !sequence.faults.iter().any(bus_hangs);
        let excused = excused.into_iter().filter(|_| is_machine);
        let hears = sequence.faults.iter().map(|fault| Hears::under(fault.kind));
        let hears = hears.max().unwrap_or(Hears::All);
        findings.extend(self.of_masters(&within, sequence, hears));
        if injected.healed_ns.is_none() {
            let words = format!("not master and standby again: {:?}", injected.roles);
            findings.push(Finding::new(Rule::NoStandby, [1.0, 0.0], words));
        }
        let violation = |finding: &Finding| match self.watch {
            Watch::Ordinary => format!("not judged: no real time: {finding}"),
            Watch::Virtual | Watch::Urgent => finding.to_string(),
        };
        Outcome {
            number: injected.number,
            class: class(sequence),
            spares_control: sequence.spares_the_master(),
            detection_ms: self.detection_ms(sequence, injected, until_ns),
            gap_ms,
            bound_ms,
            phase_ms: last.map_or(0.0, |last| ms_between(last.at_ns, at_ns)),
            power_cycles: injected.power_cycles,
            explained: excused.map(|finding| finding.to_string()).collect(),
            violations: findings.iter().map(violation).collect(),
        }
    }

    /// Returns the findings about the systems that drove.
    fn of_masters(
        &self,
        within: &dyn Fn(u64) -> bool,
        sequence: &Sequence,
        hears: Hears,
    ) -> Vec<Finding> {
        let log = RunLog {
            control: self
                .log
                .control
                .iter()
                .filter(|frame| within(frame.at_ns))
                .copied()
                .collect(),
            header: self.log.header.clone(),
            ..RunLog::default()
        };
        let takeovers: Vec<Takeover> = self
            .takeovers
            .iter()
            .filter(|takeover| within(takeover.at_ns))
            .copied()
            .collect();
        let acted = log.accepted().map(|frame| Acceptance {
            at_ns: frame.at_ns,
            system: frame.system.index() as u8,
            term: frame.term,
            ruling: frame.ruling,
        });
        // Ignore takeovers from a master that a stall of the machine held up.
        let mut relieved = takeovers.iter().filter(|it| !it.held_up);
        let observed = Observed {
            faults: &sequence.faults,
            acted: &acted.collect::<Vec<_>>(),
            changes: relieved.clone().count(),
            collisions: self
                .log
                .collisions_ns
                .iter()
                .filter(|ns| within(**ns))
                .count(),
        };
        let mut found = observed.findings();
        let needless = found.iter_mut().find(|it| it.rule == Rule::Needless);
        if let (Some(needless), Some(takeover)) = (needless, relieved.next_back()) {
            let (from, cause) = (takeover.from, takeover.cause_in_words());
            needless.words = format!("{from} was relieved, though it was sound: {cause}");
        }
        let permitted_ms = match hears {
            Hears::All => hand_over_ms(&takeovers),
            Hears::OverTheLink => {
                let one_ms = self.bounds.limits.deaf_hand_over.as_ms_f64();
                hand_overs(&takeovers) as f64 * one_ms
            }
            // The repaired master sends until it receives the next frame.
            Hears::WhenRepaired => takeovers.len() as f64 * HAND_OVER_MS,
        };
        let mut kinds = sequence.faults.iter().map(|fault| fault.kind);
        if !kinds.any(Kind::forges_control) {
            found.extend(both_transmitted(both_transmitted_ms(&log), permitted_ms));
        }
        let stale = stale_frames(&log, &takeovers, &self.stalls);
        found.extend(Rule::StaleFrames.exceeded(stale as f64));
        found
    }

    /// Returns the time from the injection to the first change of phase of the healthy system.
    fn detection_ms(&self, sequence: &Sequence, injected: &Injected, until_ns: u64) -> Option<f64> {
        let [fault] = &sequence.faults[..] else {
            return None;
        };
        let observer = match fault.way {
            _ if fault.kind.facts().scope == Scope::Shared => return None,
            Way::Both => return None,
            Way::A => injected.driver.peer(),
            Way::B => injected.driver,
        };
        let at_ns = injected.at_ns + fault.at.as_ns();
        let noticed = self.log.events.iter().find(|event| {
            let is_change = matches!(event.event, Event::TookOver { .. } | Event::Phase { .. });
            event.system == observer && (at_ns..until_ns).contains(&event.at_ns) && is_change
        });
        noticed.map(|event| ms_between(at_ns, event.at_ns))
    }
}

/// Returns the fault in words.
pub(super) fn class(sequence: &Sequence) -> String {
    let of = |way| match way {
        Way::A => " of the master",
        Way::B => " of the standby",
        Way::Both => " both ways",
    };
    let words = sequence.faults.iter().map(|fault| {
        let label = fault.kind.label();
        match fault.kind.facts().scope {
            Scope::Shared => label,
            Scope::System | Scope::Wire => label + of(fault.way),
        }
    });
    words.collect::<Vec<_>>().join(" + ")
}
