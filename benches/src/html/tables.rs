//! The figures of a group as a table.

use super::curves::{at, first_of_tandem};
use super::scale::Scale;
use crate::family::Family;
use crate::figures;
use crate::result::Row;
use maud::{Markup, html};

/// The figure of a row, if it has one.
type Cell = Box<dyn Fn(&Row) -> Option<String>>;

/// A column: its head, what it means, and its cells.
struct Column {
    head: String,
    title: &'static str,
    cell: Cell,
    /// Share of the samples that lie beyond this figure, if that matters.
    beyond: Option<f64>,
}

/// Ratios that are told apart; dots beyond stand at the edge.
const SHOWN: (f64, f64) = (0.3, 30.0);
/// A percentile with fewer samples than this beyond it rests on chance.
const FEW: f64 = 10.0;

impl Column {
    /// Whether the figure of this row rests on a handful of samples.
    fn is_chance(&self, row: &Row) -> bool {
        let beyond = self.beyond.map(|beyond| beyond * row.samples as f64);
        beyond.is_some_and(|beyond| beyond < FEW)
    }
}

fn columns(rows: &[&Row]) -> Vec<Column> {
    let time = |head: &str, title, of: fn(&Row) -> Option<f64>| Column {
        head: head.to_owned(),
        title,
        cell: Box::new(move |row| of(row).map(figures::time)),
        beyond: None,
    };
    let percentile = |head, title, beyond, of| Column {
        beyond: Some(beyond),
        ..time(head, title, of)
    };
    let other = |head: &str, title, cell: fn(&Row) -> Option<String>| Column {
        head: head.to_owned(),
        title,
        cell: Box::new(cell),
        beyond: None,
    };
    let all = vec![
        percentile("p50", "median", 0.5, |row| Some(row.p50_ns)),
        percentile("p90", "one in ten takes longer", 0.1, |row| {
            Some(row.p90_ns)
        }),
        percentile("p99", "one in a hundred takes longer", 0.01, |row| {
            Some(row.p99_ns)
        }),
        percentile("p99.9", "one in a thousand takes longer", 0.001, |row| {
            Some(row.p99_9_ns)
        }),
        time("max", "the longest of all", |row| Some(row.max_ns)),
        other("× p50", "median over the floor's median", |row| {
            row.ratio_to_floor_p50.map(figures::ratio)
        }),
        other("× p99.9", "99.9th percentile over the floor's", |row| {
            row.ratio_to_floor_p99_9.map(figures::ratio)
        }),
        time("and back", "median of the round trip", |row| {
            row.round_trip.map(|trip| trip.p50_ns)
        }),
        other("messages/s", "at the median", |row| {
            row.messages_per_second.map(figures::count)
        }),
        other("MB/s", "payload at the median", |row| {
            row.bytes_per_second.map(|rate| figures::number(rate / 1e6))
        }),
        time("CPU", "CPU time of all ends per message", |row| {
            row.cpu_ns_per_message
        }),
        other(
            "memory",
            "of the ends: shared, and growth of private",
            |row| row.memory_bytes.map(figures::bytes),
        ),
        other("samples", "number of times measured", |row| {
            Some(figures::count(row.samples as f64))
        }),
    ];
    let filled = |column: &Column| rows.iter().any(|row| (column.cell)(row).is_some());
    all.into_iter().filter(filled).collect()
}

/// The table of a group, with the ratios as dots where it has a floor.
pub(super) fn group(rows: &[&Row]) -> Markup {
    let columns = columns(rows);
    let ratios = rows
        .iter()
        .flat_map(|row| [row.ratio_to_floor_p50, row.ratio_to_floor_p99_9]);
    let scale = Scale::within(ratios.flatten().chain([1.0]), SHOWN, 6.0, 134.0);
    let scale = scale.filter(|_| rows.iter().any(|row| row.is_floor()));
    let first = first_of_tandem(rows);
    html! {
        div.wide {
            table {
                tr {
                    th {}
                    @if scale.is_some() { th title="filled: median; hollow: p99.9; line: the floor" {
                        "over the floor"
                    } }
                    @for column in &columns { th.num title=(column.title) { (column.head) } }
                }
                @for row in rows {
                    tr.main[first == Some(row.name.as_str())] {
                        td.case {
                            i class=(Family::of(row).class()) {}
                            b { (row.case()) }
                            div.what { (row.what) }
                            @for (name, value) in &row.facts {
                                div.what { (figures::fact(name, *value)) }
                            }
                        }
                        @if let Some(scale) = &scale { td { (dots(row, scale)) } }
                        @for column in &columns {
                            td.num.rare[column.is_chance(row)] {
                                ((column.cell)(row).unwrap_or_else(|| "–".to_owned()))
                            }
                        }
                    }
                }
            }
        }
    }
}

/// The ratios of a row: a line at 1, a dot for the median, a circle for the tail.
fn dots(row: &Row, scale: &Scale) -> Markup {
    let one = at(scale.at(1.0));
    let place = |ratio: Option<f64>| ratio.map(|ratio| scale.at(ratio));
    let (median, tail) = (
        place(row.ratio_to_floor_p50),
        place(row.ratio_to_floor_p99_9),
    );
    html! {
        svg.dots viewBox="0 0 140 16" aria-hidden="true" {
            line.one x1=(one) x2=(one) y1="0" y2="16" {}
            g class=(format!("dot {}", Family::of(row).class())) {
                @if let (Some(median), Some(tail)) = (median, tail) {
                    line.span x1=(at(median)) x2=(at(tail)) y1="8" y2="8" {}
                }
                @if let Some(tail) = tail { circle.tail cx=(at(tail)) cy="8" r="3.5" {} }
                @if let Some(median) = median { circle cx=(at(median)) cy="8" r="4.5" {} }
            }
        }
    }
}

/// The table of the machine's own noise.
pub(super) fn noise(rows: &[&Row]) -> Markup {
    html! {
        div.wide {
            table {
                tr {
                    th {}
                    @for head in ["p50", "p99", "p99.9", "max"] { th.num { (head) } }
                }
                @for row in rows {
                    tr {
                        td.case { b { (row.case()) } div.what { (row.what) } }
                        @for ns in [row.p50_ns, row.p99_ns, row.p99_9_ns, row.max_ns] {
                            td.num { (figures::time(ns)) }
                        }
                    }
                }
            }
        }
    }
}
