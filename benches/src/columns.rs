//! The figures of a row, for the terminal and for the page.

use crate::result::Row;
use tandem_page::format;

/// A figure of a row: a time in ns, or something else in words.
pub(crate) enum Figure {
    /// A time, ns.
    Time(fn(&Row) -> Option<f64>),
    /// Anything else.
    Text(fn(&Row) -> Option<String>),
}

/// One column of figures.
pub(crate) struct Column {
    /// Its head.
    pub(crate) head: &'static str,
    /// What it means.
    pub(crate) title: &'static str,
    /// What it shows.
    pub(crate) figure: Figure,
    /// 0 is always shown, 1 to 4 where the terminal is wide enough, [`PAGE`] on the page alone.
    pub(crate) rank: u8,
    /// Share of the samples that lie beyond this figure, where it is a percentile.
    beyond: Option<f64>,
}

/// Rank of what only the page shows.
pub(crate) const PAGE: u8 = 5;
/// A percentile with fewer samples than this beyond it rests on chance.
const FEW: f64 = 10.0;

const fn time(
    head: &'static str,
    title: &'static str,
    rank: u8,
    of: fn(&Row) -> Option<f64>,
) -> Column {
    Column {
        head,
        title,
        figure: Figure::Time(of),
        rank,
        beyond: None,
    }
}

const fn percentile(
    head: &'static str,
    title: &'static str,
    rank: u8,
    beyond: f64,
    of: fn(&Row) -> Option<f64>,
) -> Column {
    Column {
        beyond: Some(beyond),
        ..time(head, title, rank, of)
    }
}

const fn text(
    head: &'static str,
    title: &'static str,
    rank: u8,
    of: fn(&Row) -> Option<String>,
) -> Column {
    Column {
        head,
        title,
        figure: Figure::Text(of),
        rank,
        beyond: None,
    }
}

/// In the order of showing.
const COLUMNS: [Column; 13] = [
    percentile("p50", "median", 0, 0.5, |row| Some(row.p50_ns)),
    percentile("p90", "one in 10 takes longer", 4, 0.1, |row| {
        Some(row.p90_ns)
    }),
    percentile("p99", "one in 100 takes longer", 0, 0.01, |row| {
        Some(row.p99_ns)
    }),
    percentile("p99.9", "one in 1000 takes longer", 0, 0.001, |row| {
        Some(row.p99_9_ns)
    }),
    time("max", "the longest of all", 3, |row| Some(row.max_ns)),
    text("x p50", "median over the floor's median", 0, |row| {
        row.ratio_to_floor_p50.map(format::ratio)
    }),
    Column {
        beyond: Some(0.001),
        ..text("x p99.9", "99.9th percentile over the floor's", 0, |row| {
            row.ratio_to_floor_p99_9.map(format::ratio)
        })
    },
    time("and back", "median of the round trip", 1, |row| {
        row.round_trip.map(|trip| trip.p50_ns)
    }),
    text("M msg/s", "messages per second at the median", 0, |row| {
        row.messages_per_second
            .map(|rate| format::number(rate / 1e6))
    }),
    text("MB/s", "payload at the median", 1, |row| {
        row.bytes_per_second.map(|rate| format::number(rate / 1e6))
    }),
    time("CPU/msg", "CPU time of all ends per message", 2, |row| {
        row.cpu_ns_per_message
    }),
    text(
        "memory",
        "of the ends: shared, and growth of private",
        PAGE,
        |row| row.memory_bytes.map(format::bytes),
    ),
    text("samples", "number of times measured", PAGE, |row| {
        Some(format::count(row.samples as f64))
    }),
];

impl Column {
    /// The figure of this row, its time shown by `time`; `None` if the row has none.
    pub(crate) fn cell(&self, row: &Row, time: impl Fn(f64) -> String) -> Option<String> {
        match self.figure {
            Figure::Time(of) => of(row).map(time),
            Figure::Text(of) => of(row),
        }
    }

    /// Whether the figure of this row rests on a handful of samples.
    pub(crate) fn is_chance(&self, row: &Row) -> bool {
        let beyond = self.beyond.map(|beyond| beyond * row.samples as f64);
        beyond.is_some_and(|beyond| beyond < FEW)
    }
}

/// The columns of at most this rank that one of these rows fills.
pub(crate) fn filled(rows: &[&Row], rank: u8) -> Vec<&'static Column> {
    let is_filled = |column: &&Column| {
        column.rank <= rank
            && rows
                .iter()
                .any(|row| column.cell(row, format::time).is_some())
    };
    COLUMNS.iter().filter(is_filled).collect()
}
