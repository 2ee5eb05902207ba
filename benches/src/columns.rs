//! The figures of a row, for the terminal and for the page.

use crate::result::Row;
use Figure::{Text, Time};
use tandem_page::format;

/// A figure of a row: a time in ns, or a text.
pub(crate) enum Figure {
    Time(fn(&Row) -> Option<f64>),
    Text(fn(&Row) -> Option<String>),
}

/// One column of figures.
pub(crate) struct Column {
    pub(crate) head: &'static str,
    pub(crate) title: &'static str,
    /// 0 is always shown, 1 to 4 if the terminal is wide enough, [`PAGE`] only on the page.
    rank: u8,
    /// Share of the samples that lie beyond this figure; 1 if it is not a percentile.
    beyond: f64,
    figure: Figure,
}

/// Rank of columns that only the page shows.
pub(crate) const PAGE: u8 = 5;
const TAIL_RATIO: &str = "x p99.9";
/// A percentile is unreliable if fewer samples than this lie beyond it. A ratio of tails is
/// unreliable if it was measured in fewer turns than this.
const FEW: f64 = 10.0;

/// In display order: head, meaning, rank, share beyond, figure.
#[rustfmt::skip]
const COLUMNS: [Column; 12] = [
    column("p50", "median", 0, 0.5, Time(|row| Some(row.p50_ns))),
    column("p90", "one in 10 takes longer", 4, 0.1, Time(|row| Some(row.p90_ns))),
    column("p99", "one in 100 takes longer", 0, 0.01, Time(|row| Some(row.p99_ns))),
    column("p99.9", "one in 1000 takes longer", 0, 0.001, Time(|row| Some(row.p99_9_ns))),
    column("max", "the longest of all", 3, 1.0, Time(|row| Some(row.max_ns))),
    column("x p50", "median over the floor's median", 0, 1.0,
        Text(|row| row.ratio_to_floor_p50.map(format::ratio))),
    column(TAIL_RATIO, "99.9th percentile over the floor's", 0, 0.001,
        Text(|row| row.ratio_to_floor_p99_9.map(format::ratio))),
    column("and back", "median of the round trip", 1, 1.0,
        Time(|row| row.round_trip.map(|trip| trip.p50_ns))),
    column("M msg/s", "messages per second at the median", 0, 1.0,
        Text(|row| row.messages_per_second.map(|rate| format::number(rate / 1e6)))),
    column("MB/s", "payload at the median", 1, 1.0,
        Text(|row| row.bytes_per_second.map(|rate| format::number(rate / 1e6)))),
    column("CPU/msg", "CPU time of all ends per message", 2, 1.0, Time(|row| row.cpu_ns_per_message)),
    column("samples", "number of times measured", PAGE, 1.0,
        Text(|row| Some(format::count(row.samples as f64)))),
];

const fn column(
    head: &'static str,
    title: &'static str,
    rank: u8,
    beyond: f64,
    figure: Figure,
) -> Column {
    Column {
        head,
        title,
        rank,
        beyond,
        figure,
    }
}

impl Column {
    /// Returns the figure of this row as text; `time` formats a time. `None` if the row has none.
    pub(crate) fn cell(&self, row: &Row, time: impl Fn(f64) -> String) -> Option<String> {
        match self.figure {
            Time(of) => of(row).map(time),
            Text(of) => of(row),
        }
    }

    /// Returns whether the figure of this row is unreliable: too few samples; for a ratio of tails
    /// also too few turns (a stall affects a whole turn), or a stalled floor.
    pub(crate) fn is_chance(&self, row: &Row) -> bool {
        let few_turns = (row.batch_p50_ns.len() as f64) < FEW;
        is_chance(self.beyond, row)
            || (self.head == TAIL_RATIO && (few_turns || row.has_stalled_floor()))
    }
}

/// Returns whether the share `beyond` of this row's samples is too few samples.
pub(crate) fn is_chance(beyond: f64, row: &Row) -> bool {
    beyond * (row.samples as f64) < FEW
}

/// Returns the further facts of a row in words: the states of the line, the range of a further run,
/// and what the case notes, with unreliable percentiles in brackets.
pub(crate) fn facts(row: &Row) -> impl Iterator<Item = String> {
    let states = row.modes.iter().map(|mode| {
        let compared = if mode.is_compared { " (compared)" } else { "" };
        let ratio = mode.ratio_to_floor_p50.map(format::ratio);
        format!(
            "line at {}{compared}, {:.0} % of batches: {}, x {}",
            format::time(mode.line_ns),
            100.0 * mode.share,
            format::time(mode.p50_ns),
            ratio.as_deref().unwrap_or("-")
        )
    });
    let range = row.ratio_range_p50.filter(|_| !row.is_floor());
    let range = range.map(|[low, high]| {
        let [low, high] = [low, high].map(format::ratio);
        format!("nine turns in ten: x {low} to {high}")
    });
    let noted = row.facts.iter().map(|(name, value)| {
        let fact = format::fact(name, *value);
        let is_of = |column: &&Column| name.ends_with(&format!(" {}, ns", column.head));
        let column = COLUMNS.iter().find(is_of);
        bracketed(fact, column.is_some_and(|column| column.is_chance(row)))
    });
    states.chain(range).chain(noted)
}

/// Returns the text of a figure, in brackets if the figure has too few samples.
pub(crate) fn bracketed(text: String, is_chance: bool) -> String {
    if is_chance { format!("({text})") } else { text }
}

/// Returns the columns up to this rank that at least one of these rows fills.
pub(crate) fn filled(rows: &[Row], rank: u8) -> Vec<&'static Column> {
    let fills = |column: &Column, row: &Row| column.cell(row, format::time).is_some();
    let columns = COLUMNS.iter().filter(|column| column.rank <= rank);
    columns
        .filter(|column| rows.iter().any(|row| fills(column, row)))
        .collect()
}
