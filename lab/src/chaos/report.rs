//! The result of a campaign, as one screen of text and as figures.

use std::collections::BTreeMap;
use std::fmt::Write as _;

use serde_json::json;

use super::Source;
use super::recording_judge::Outcome;
use tandem_processes::percentiles::Spans;

/// Upper limits of the histogram's columns, ms. One more column has no upper limit.
const COLUMNS_MS: [f64; 7] = [10.5, 11.5, 13.0, 15.0, 17.0, 19.0, 21.0];
const BARS: [char; 8] = ['▁', '▂', '▃', '▄', '▅', '▆', '▇', '█'];
/// Number of violations that are printed one by one. The figures contain all.
const SHOWN: usize = 12;

/// The result of a campaign.
#[derive(Default)]
pub(super) struct Found {
    pub(super) outcomes: Vec<Outcome>,
    /// Violations of runs as a whole, each with the command that repeats it.
    pub(super) wrong: Vec<String>,
}

/// The figures of one class of faults.
struct Class<'o> {
    of: Vec<&'o Outcome>,
    detection: Spans,
    gap: Spans,
    bound_ms: f64,
}

impl<'o> Class<'o> {
    fn new(of: Vec<&'o Outcome>) -> Self {
        Self {
            detection: Spans::from_ms(of.iter().filter_map(|it| it.detection_ms)),
            gap: Spans::from_ms(of.iter().map(|it| it.gap_ms)),
            bound_ms: of.iter().map(|it| it.bound_ms).fold(0.0, f64::max),
            of,
        }
    }

    /// Draws one column for each range of gaps. Its height is the share of gaps in that range.
    fn histogram(&self) -> String {
        let mut counts = [0_usize; COLUMNS_MS.len() + 1];
        for outcome in &self.of {
            let column = COLUMNS_MS.iter().position(|end| outcome.gap_ms <= *end);
            counts[column.unwrap_or(COLUMNS_MS.len())] += 1;
        }
        let bar = |count: &usize| match count * BARS.len() {
            0 => '·',
            count => BARS[((count - 1) / self.of.len()).min(BARS.len() - 1)],
        };
        counts.iter().map(bar).collect()
    }

    fn line(&self, name: &str) -> String {
        let three = |spans: &Spans| {
            let ms = |percent| spans.percentile_ms(percent);
            [50.0, 99.0, 100.0]
                .map(|percent| ms(percent).map_or("-".to_owned(), |ms| format!("{ms:.1}")))
        };
        let [d50, d99, dmax] = three(&self.detection);
        let [g50, g99, gmax] = three(&self.gap);
        let (n, bound, histogram) = (self.of.len(), self.bound_ms, self.histogram());
        format!(
            "{name:34} {n:4} {d50:>7} {d99:>7} {dmax:>7} {g50:>6} {g99:>6} {gmax:>6} {bound:>6.1} {histogram}"
        )
    }
}

/// Counts the faults with a violation, and the violations of runs as a whole.
pub(super) fn violated(found: &Found) -> usize {
    let bad = found.outcomes.iter().filter(|it| !it.violations.is_empty());
    bad.count() + found.wrong.len()
}

fn classes<'o>(
    outcomes: &'o [Outcome],
    name: impl Fn(&Outcome) -> String,
) -> BTreeMap<String, Class<'o>> {
    let mut of: BTreeMap<String, Vec<&Outcome>> = BTreeMap::new();
    for outcome in outcomes {
        of.entry(name(outcome)).or_default().push(outcome);
    }
    let class = |(name, of)| (name, Class::new(of));
    of.into_iter().map(class).collect()
}

/// Returns the name of a row on the terminal. Faults that do not affect the control frames share
/// two rows.
fn row_of(outcome: &Outcome) -> String {
    let of_standby = outcome.class.ends_with(" of the standby");
    match outcome.spares_control {
        true if of_standby => "~ all kinds of the standby".to_owned(),
        true => "~ kinds that spare the control frames".to_owned(),
        false => outcome.class.clone(),
    }
}

/// Returns the report for the terminal.
pub(super) fn text(source: &Source, found: &Found) -> String {
    let mut text = String::new();
    let mut line = |words: String| {
        let _ = writeln!(text, "{words}");
    };
    line(format!(
        "{:34} {:>4} {:^23} {:^20} {:>6} gap: ms up to",
        "", "", "noticed after ms", "without control ms", "bound"
    ));
    line(format!(
        "{:34} {:>4} {:>7} {:>7} {:>7} {:>6} {:>6} {:>6} {:>6} 10.5|11.5|13|15|17|19|21|more",
        "fault", "n", "p50", "p99", "max", "p50", "p99", "max", "ms"
    ));
    for (name, class) in classes(&found.outcomes, row_of) {
        line(class.line(name.trim_start_matches("~ ")));
    }
    let bad: Vec<&Outcome> = found
        .outcomes
        .iter()
        .filter(|it| !it.violations.is_empty())
        .collect();
    for outcome in bad.iter().take(SHOWN) {
        let (what, repeats) = (
            outcome.violations.join("; "),
            source.repeats(outcome.number),
        );
        line(format!("VIOLATED {}: {what}: {repeats}", outcome.class));
    }
    for wrong in &found.wrong {
        line(format!("VIOLATED {wrong}"));
    }
    let explained: Vec<(&Outcome, &String)> = found
        .outcomes
        .iter()
        .flat_map(|of| of.explained.iter().map(move |words| (of, words)))
        .collect();
    for (outcome, words) in explained.iter().take(SHOWN) {
        line(format!(
            "machine stalled, fault {}: {words}",
            outcome.number
        ));
    }
    let cycles: u32 = found.outcomes.iter().map(|it| it.power_cycles).sum();
    line(format!(
        "{} faults, {} violated; {} gaps beyond their bound, explained by stalls of the machine; {cycles} \
         power cycles of a system that had suspended itself",
        found.outcomes.len(),
        violated(found),
        explained.len(),
    ));
    text
}

/// Returns the figures for `--json`.
pub(super) fn json(source: &Source, found: &Found) -> serde_json::Value {
    let classes: Vec<_> = classes(&found.outcomes, |outcome| outcome.class.clone())
        .iter()
        .map(|(name, class)| {
            let (detection, gap) = (&class.detection, &class.gap);
            json!({
                "name": name, "n": class.of.len(),
                "detection_p50_ms": detection.percentile_ms(50.0),
                "detection_p99_ms": detection.percentile_ms(99.0),
                "detection_max_ms": detection.max_ms(),
                "gap_p50_ms": gap.percentile_ms(50.0), "gap_p99_ms": gap.percentile_ms(99.0),
                "gap_max_ms": gap.max_ms(), "bound_ms": class.bound_ms,
            })
        })
        .collect();
    let faults: Vec<_> = found
        .outcomes
        .iter()
        .map(|of| {
            json!({
                "number": of.number, "class": of.class, "phase_ms": of.phase_ms,
                "detection_ms": of.detection_ms, "gap_ms": of.gap_ms, "bound_ms": of.bound_ms,
                "explained": of.explained, "violations": of.violations,
                "repeats": source.repeats(of.number),
            })
        })
        .collect();
    json!({
        "faults": found.outcomes.len(), "violations": violated(found), "classes": classes,
        "of_runs": found.wrong, "each": faults,
    })
}

#[cfg(test)]
mod tests {
    use super::super::SourceKind;
    use super::*;
    use tandem_faults::Site;

    fn outcome(number: u64, class: &str, gap_ms: f64) -> Outcome {
        Outcome {
            number,
            class: class.to_owned(),
            spares_control: class.ends_with("standby"),
            detection_ms: Some(gap_ms - 5.0),
            gap_ms,
            bound_ms: 21.0,
            phase_ms: 1.0,
            power_cycles: 0,
            explained: vec![],
            violations: vec![],
        }
    }

    #[test]
    fn a_violation_is_printed_with_the_command_that_repeats_it() {
        let source = Source {
            kind: SourceKind::Drawn { seed: 7 },
            site: Site::Processes,
        };
        let mut found = Found {
            outcomes: vec![
                outcome(1, "power-loss of the master", 14.0),
                outcome(2, "power-loss of the master", 24.0),
                outcome(3, "power-loss of the standby", 11.0),
                outcome(4, "deaf of the standby", 10.0),
            ],
            wrong: vec![],
        };
        assert_eq!(violated(&found), 0);
        found.outcomes[1].violations = vec!["24.0 ms without control".to_owned()];
        let printed = text(&source, &found);
        assert!(
            printed.contains("tandem chaos --seed 7 --only 2"),
            "{printed}"
        );
        assert!(printed.contains("4 faults, 1 violated"), "{printed}");
        assert!(
            printed.contains("·▄··"),
            "one of two up to 15 ms: {printed}"
        );
        let figures = json(&source, &found);
        assert_eq!(
            (&figures["faults"], &figures["violations"]),
            (&json!(4), &json!(1))
        );
        let names: Vec<_> = figures["classes"]
            .as_array()
            .into_iter()
            .flatten()
            .collect();
        assert_eq!(names.len(), 3);
        assert_eq!(names[1]["name"], "power-loss of the master");
        assert!((names[1]["gap_max_ms"].as_f64().unwrap_or(0.0) - 24.0).abs() < 0.01);
    }

    /// The report of a thousand faults of all kinds fits on one screen.
    #[test]
    fn the_report_of_a_thousand_faults_is_one_screen() {
        let source = Source {
            kind: SourceKind::Drawn { seed: 7 },
            site: Site::Processes,
        };
        let outcomes = (0..1_000).map(|number| {
            let (sequence, _) = source.sequence(number).expect("a sequence");
            let class = super::super::recording_judge::class(&sequence);
            let spares_control = sequence.spares_the_master();
            Outcome {
                spares_control,
                ..outcome(number, &class, 11.0)
            }
        });
        let found = Found {
            outcomes: outcomes.collect(),
            wrong: vec![],
        };
        let printed = text(&source, &found);
        let lines = printed.lines().count();
        assert!(lines <= 40, "{lines}\n{printed}");
    }
}
