//! The comparison as a table for the terminal.

use super::{ALPHA, Compared, Comparison, Relative, SMALLEST_CHANGE, Verdict};
use std::fmt::Write as _;
use tandem_page::format::Unit;

/// Signs of a relative change: `+10.2 %`.
fn percent(change: f64) -> String {
    let percent = change * 100.0;
    let decimals = usize::from(percent.abs() < 99.95);
    // No "-0.0".
    let percent = if percent.abs() < 0.05 { 0.0 } else { percent };
    format!("{percent:+.decimals$} %")
}

fn change(relative: Option<Relative>) -> String {
    relative.map_or("-".to_owned(), |relative| percent(relative.change))
}

fn interval(relative: Option<Relative>) -> String {
    let end = |end: Option<f64>| end.map_or("?".to_owned(), percent);
    relative.map_or("-".to_owned(), |relative| {
        format!("{} .. {}", end(relative.low), end(relative.high))
    })
}

const fn verdict(case: &Compared, verdict: Verdict) -> &'static str {
    match verdict {
        _ if case.is_floor => "(the machine)",
        Verdict::Faster => "FASTER",
        Verdict::Slower => "SLOWER",
        Verdict::NoChange => "no change",
    }
}

impl Comparison {
    /// The table for the terminal, 100 columns wide, and what it comes to.
    #[must_use]
    pub fn table(&self) -> String {
        let mut text = String::new();
        // Writing to a string cannot fail.
        let _ = writeln!(text, "A: {}\nB: {}", self.a.display(), self.b.display());
        for remark in &self.remarks {
            let _ = writeln!(text, "note: {remark}");
        }
        for cases in self.cases.chunk_by(|a, b| a.group == b.group) {
            let times: Vec<f64> = cases.iter().map(|case| case.p50.a_ns).collect();
            let unit = Unit::of(&times);
            let head = format!("{} ({})", cases[0].group, unit.name());
            let _ = writeln!(
                text,
                "\n{head:<24}      {:>8} {:>8} {:>9} {:>21} {:>9}  verdict",
                "A", "B", "change", "95 % interval", "to floor"
            );
            for case in cases {
                for (percentile, of) in case.changes() {
                    let name = if percentile == "p50" {
                        case.name.split_once('/').map_or("", |(_, name)| name)
                    } else {
                        ""
                    };
                    let _ = writeln!(
                        text,
                        "  {name:<22} {percentile:>4} {:>8} {:>8} {:>9} {:>21} {:>9}  {}",
                        unit.show(of.a_ns),
                        unit.show(of.b_ns),
                        change(of.time),
                        interval(of.time),
                        change(of.ratio),
                        verdict(case, of.verdict)
                    );
                }
            }
        }
        text + &self.summary()
    }

    fn summary(&self) -> String {
        let mut text = String::from("\n");
        for (names, where_) in [
            (&self.only_in_a, "only in A"),
            (&self.only_in_b, "only in B"),
        ] {
            if !names.is_empty() {
                let _ = writeln!(text, "{where_}: {}", names.join(", "));
            }
        }
        for (names, word) in [(&self.slower, "slower"), (&self.faster, "faster")] {
            if !names.is_empty() {
                let _ = writeln!(text, "{word}: {}", names.join(", "));
            }
        }
        if !self.peers_changed.is_empty() {
            let _ = writeln!(
                text,
                "changed although their code did not, by the luck of a run: {}",
                self.peers_changed.join(", ")
            );
        }
        let ours = |case: &&Compared| !case.is_floor && !case.is_peer;
        let judged = self.cases.iter().filter(ours).count();
        let _ = writeln!(
            text,
            "{judged} cases of Tandem: {} slower, {} faster, the others show no change beyond noise.",
            self.slower.len(),
            self.faster.len()
        );
        let _ = writeln!(
            text,
            "A change counts if times and ratios to the floor agree on it (Welch's test on the \
             batches,\np <= {ALPHA} after Holm), and if it is larger than what each run \
             drifted by itself and than {:.0} %.",
            SMALLEST_CHANGE * 100.0
        );
        text
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn changes_are_written_with_their_sign() {
        let shown = [0.1023, -0.05, -0.0001, 2.5].map(percent);
        assert_eq!(shown, ["+10.2 %", "-5.0 %", "+0.0 %", "+250 %"]);
        let unbounded = Relative {
            change: 0.1,
            low: None,
            high: Some(0.2),
        };
        assert_eq!(interval(Some(unbounded)), "? .. +20.0 %");
    }
}
