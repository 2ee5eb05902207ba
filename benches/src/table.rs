//! The results as tables for the terminal, one for each group.

use crate::columns::{self, Column};
use crate::provider::{Headline, Provider};
use crate::result::{Results, Row};
use std::fmt::Write as _;
use tandem_page::format::{self, TimeUnit};

/// The narrowest terminal that the tables are made for, in columns.
pub(crate) const NARROWEST: usize = 80;
/// Width for an output that has none, such as a file or a pipe.
pub(crate) const USUAL: usize = 120;

const WIDTH: usize = 9;

impl Results {
    /// Returns the tables for a terminal of this width in columns.
    pub(crate) fn table(&self, width: usize) -> String {
        let width = width.max(NARROWEST);
        let mut text = self.heading();
        for (group, rows) in self.groups() {
            text.push('\n');
            text += &group_table(group, rows, width);
        }
        text.push('\n');
        for skipped in &self.skipped {
            // Writing to a string cannot fail.
            let _ = writeln!(text, "skipped: {}: {}", skipped.name, skipped.why);
        }
        if self.interrupted {
            text += "interrupted: fewer samples than planned\n";
        }
        text
    }

    fn heading(&self) -> String {
        let machine = &self.machine;
        let mut text = format!(
            "{}\nCPUs {} of {}, {}, {} build\n",
            machine.name(),
            machine.pinned(),
            machine.cpus,
            machine.scheduling,
            machine.build
        );
        if machine.build != "release" {
            text += "This is no release build: its figures say nothing about Tandem.\n";
        }
        if let Some(load) = &self.load {
            // Writing to a string cannot fail.
            let _ = writeln!(text, "background load: {load} processes on these CPUs");
        }
        if !self.noise.is_empty() {
            text.push('\n');
            text += &group_table("noise of the machine itself", &self.noise, NARROWEST);
        }
        text += &self.noise_in_words();
        text += "x: times the floor, the bare mechanism of the same run. And back: both ways.\n";
        text += "(in brackets): fewer than ten samples lie beyond this percentile. x p99.9: or fewer than \
                 ten\nturns were measured, or the floor's p99.9 is a stall, more than ten times its median.\n";
        text
    }

    /// Returns a sentence on the effect of the machine's noise on the figures; empty if it was not
    /// measured.
    pub(crate) fn noise_in_words(&self) -> String {
        let noise = self.noise.iter();
        let spins = noise.filter(|row| row.case().starts_with("cpu"));
        let worst = spins.max_by(|a, b| a.p99_9_ns.total_cmp(&b.p99_9_ns));
        worst.map_or(String::new(), |row| {
            format!(
                "A program that does nothing but read the clock on {} is held up for {} at worst: \
                 no tail\nof a case can be better than the machine's own.\n",
                row.case(),
                format::time(row.max_ns)
            )
        })
    }
}

fn group_table(group: &str, rows: &[Row], width: usize) -> String {
    let medians: Vec<f64> = rows.iter().map(|row| row.p50_ns).collect();
    let unit = TimeUnit::of(&medians);
    let head = format!("{group} ({})", unit.name());
    let names = rows.iter().map(|row| row.case().len() + 2);
    let names = names.chain([head.chars().count(), 22]).max().unwrap_or(22);
    let columns = fitting(rows, width.saturating_sub(names));
    let used = names + columns.len() * WIDTH;
    let what = rows.iter().map(|row| row.what.chars().count()).max();
    let with_what = what.is_some_and(|what| used + 3 + what <= width);
    let mut text = format!("{head:<names$}");
    for column in &columns {
        let _ = write!(text, "{:>WIDTH$}", column.head);
    }
    text.push('\n');
    let indent = names - 2;
    for row in rows {
        let _ = write!(text, "  {:<indent$}", row.case());
        for column in &columns {
            let cell = column.cell(row, |ns| unit.show(ns));
            let cell = cell.map(|cell| columns::bracketed(cell, column.is_chance(row)));
            let _ = write!(text, "{:>WIDTH$}", cell.as_deref().unwrap_or("-"));
        }
        if with_what {
            let _ = write!(text, "   {}", row.what);
        }
        text.push('\n');
        text += &facts(row, width);
    }
    text += &best_peer(rows).unwrap_or_default();
    text
}

/// Tandem's first case beside the fastest alternative.
fn best_peer(rows: &[Row]) -> Option<String> {
    let Headline { tandem, peer, .. } = Headline::of(rows)?;
    let peer = peer?;
    let factor = format::ratio(peer.p50_ns / tandem.p50_ns.max(1e-3));
    let provider = Provider::of(peer).look().name;
    Some(format!(
        "  best peer: {} ({provider}), {factor} times {}\n",
        peer.case(),
        tandem.case()
    ))
}

/// Returns the further facts of a row, as many in a line as fit.
fn facts(row: &Row, width: usize) -> String {
    let mut lines: Vec<String> = Vec::new();
    for fact in columns::facts(row) {
        match lines.last_mut() {
            Some(line) if line.chars().count() + fact.chars().count() + 9 <= width => {
                *line += &format!(" · {fact}");
            }
            _ => lines.push(fact),
        }
    }
    lines.iter().map(|line| format!("      {line}\n")).collect()
}

/// Returns the columns that these rows fill and that fit.
fn fitting(rows: &[Row], width: usize) -> Vec<&'static Column> {
    let ranks = (1..columns::PAGE).rev();
    let mut choices = ranks.map(|rank| columns::filled(rows, rank));
    let fitting = choices.find(|columns| columns.len() * WIDTH <= width);
    fitting.unwrap_or_else(|| columns::filled(rows, 0))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::result::{RoundTrip, Skipped};
    use crate::synthetic::{results, row};

    fn run() -> Results {
        let mut tandem = row("spin/tandem-of-some-length", 84.2);
        tandem.ratio_to_floor_p50 = Some(1.123);
        tandem.cpu_ns_per_message = Some(170.0);
        tandem.round_trip = Some(RoundTrip {
            p50_ns: 168.4,
            p99_ns: 200.0,
            p99_9_ns: 300.0,
        });
        let fact = "share of the least served".to_owned();
        tandem.facts.insert(fact, 0.31);
        let mut fifo = row("throughput/fifo-8B", 8.31);
        fifo.messages_per_second = Some(120_336_943.0);
        fifo.bytes_per_second = Some(962_695_544.0);
        let mut run = results(vec![row("spin/floor", 75.0), tandem, fifo]);
        run.noise.push(row("noise/cpu0", 12.0));
        run.skipped.push(Skipped {
            name: "sleep/ddsperf".to_owned(),
            why: "not installed".to_owned(),
        });
        run
    }

    #[test]
    fn no_line_is_wider_than_the_terminal() {
        for width in [80, 100, 120, 160] {
            let table = run().table(width);
            let figures = table.lines().skip_while(|line| !line.starts_with("spin"));
            for line in figures {
                assert!(line.chars().count() <= width, "{width}: {line}");
            }
        }
    }

    #[test]
    fn figures_stand_under_their_heads() {
        let table = run().table(120);
        let lines = table.lines();
        let lines: Vec<&str> = lines.skip_while(|line| !line.starts_with("spin")).collect();
        let figures = "p50 84.2|x p50 1.12|and back 168|CPU/msg 170".split('|');
        for (head, cell) in figures.filter_map(|figure| figure.rsplit_once(' ')) {
            let end = |line: &str, of: &str| line.find(of).map(|at| at + of.len());
            assert_eq!(end(lines[0], head), end(lines[2], cell), "{head}\n{table}");
        }
    }

    #[test]
    fn a_percentile_that_rests_on_chance_stands_in_brackets() {
        let mut run = run();
        assert!(!run.table(120).contains("(1"));
        let row = &mut run.results[0];
        row.samples = 5_000;
        row.facts.insert("naive p99.9, ns".to_owned(), 5.0);
        let tail = TimeUnit::Ns.show(row.p99_9_ns);
        let table = run.table(120);
        assert!(table.contains(&format!(" ({tail})")) && table.contains("(naive p99.9: 5.00 ns)"));
    }

    #[test]
    fn each_width_shows_what_fits() {
        let mut run = run();
        run.interrupted = true;
        let all = "tandem-of-some-length|fifo-8B|cpu0|120|963|share of the least served: 0.31|\
            skipped: sleep/ddsperf: not installed|interrupted|held up";
        let narrow = "p50|p99|p99.9|x p50|x p99.9";
        for (width, parts, expected) in [
            (80, narrow, true),
            (80, "p90|what spin/floor is", false),
            (120, all, true),
            (120, "best peer", false),
            (200, "what spin/floor is", true),
        ] {
            let table = run.table(width);
            for part in parts.split('|') {
                assert_eq!(table.contains(part), expected, "{part}\n{table}");
            }
        }
    }

    #[test]
    fn the_best_peer_is_named_under_its_group() {
        let mut run = run();
        for (name, ns) in [("spin/pipe", 300.0), ("spin/iceoryx2-pubsub", 168.4)] {
            run.results.insert(2, row(name, ns));
        }
        let line = "best peer: iceoryx2-pubsub (iceoryx2), 2.00 times tandem-of";
        assert!(run.table(80).contains(line), "{}", run.table(80));
    }
}
