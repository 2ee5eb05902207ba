//! `tandem topics rate`, `age` and `loss`: a table of the frames of the bus, by id.

use std::io::Write;
use std::sync::atomic::AtomicBool;

use serde_json::{Value, json};
use tandem_board::Instant;
use tandem_topics::CanFrame;
use tandem_topics::endpoints::OUTPUTS;
use tandem_topics_host::gateway::{Gateway, IdReport};
use tandem_topics_host::listing::Listing;

use super::{MEASURES_S, Out, Watch, nothing, open, turn};
use crate::args::TopicsPlace;
use crate::failure::Failure;

/// A frame is late after this many of its periods.
const LATE_PERIODS: f64 = 5.0;

/// Which table.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Table {
    Rate,
    Age,
    Loss,
}

pub(super) fn run(
    table: Table,
    place: &TopicsPlace,
    stop: &AtomicBool,
    out: &mut Out<impl Write>,
) -> Result<(), Failure> {
    let mut node = open(place, &OUTPUTS)?;
    let (mut gateway, mut listing) = (Gateway::new(), Listing::default());
    let watch = Watch::new(place, Some(MEASURES_S), stop);
    while !watch.is_over() {
        turn(&mut node, &mut listing)?;
        while let Some(sample) = node.take(0) {
            if let Ok(frame) = CanFrame::decode(sample.payload()) {
                gateway.hear(node.now(), sample.writer, &frame);
            }
        }
    }
    let now = node.now();
    if gateway.reports().next().is_none() {
        let text = nothing(place, Some(OUTPUTS[0].topic), &listing);
        return Err(Failure::NothingHeard(text));
    }
    let text = if place.json {
        let rows = gateway
            .reports()
            .map(|(id, report)| object(now, id, report));
        serde_json::to_string_pretty(&rows.collect::<Vec<_>>())? + "\n"
    } else {
        text(table, now, &gateway)
    };
    out.print(&text)?;
    let counts = node.participant.reader_counts(0);
    if table == Table::Loss && counts.lost + counts.replaced > 0 {
        eprintln!(
            "samples that were lost on the way here: {}, and overwritten here: {}. LOST has those \
             of them that the other system did not publish either",
            counts.lost, counts.replaced
        );
    }
    if watch.is_interrupted() {
        return Err(Failure::CutShort);
    }
    Ok(())
}

/// An id as the bus has it: three hex digits, or eight if it is an extended one.
pub(super) fn hex(id: u32) -> String {
    match id >> 31 {
        0 => format!("{id:03X}"),
        _ => format!("{:08X}", id & 0x1FFF_FFFF),
    }
}

pub(super) fn name(report: &IdReport) -> &'static str {
    report.info.map_or("-", |info| info.name)
}

/// Frames a second; `None` before the second frame.
fn rate(report: &IdReport) -> Option<f64> {
    let span_s = report.last.since(report.first).as_ms_f64() / 1e3;
    (span_s > 0.0).then(|| (report.frames - 1) as f64 / span_s)
}

fn is_late(report: &IdReport, age_ms: f64) -> bool {
    report.period_ms > 0 && age_ms > LATE_PERIODS * f64::from(report.period_ms)
}

fn text(table: Table, now: Instant, gateway: &Gateway) -> String {
    let head = match table {
        Table::Rate => "  FRAMES   RATE/s  PERIOD ms  LONGEST ms",
        Table::Age => "   AGE ms  PERIOD ms",
        Table::Loss => "  FRAMES     LOST  LOST %    JUMPS  DAMAGED     OF A     OF B",
    };
    let mut text = format!("{:8}  {:22}{head}\n", "ID", "NAME");
    for (id, report) in gateway.reports() {
        text += &format!(
            "{:8}  {:22}{}\n",
            hex(id),
            name(report),
            row(table, now, report)
        );
    }
    text
}

fn row(table: Table, now: Instant, report: &IdReport) -> String {
    let frames = report.frames;
    let period = match report.period_ms {
        0 => "-".to_owned(),
        ms => ms.to_string(),
    };
    match table {
        Table::Rate => {
            let rate = rate(report).map_or("-".to_owned(), |rate| format!("{rate:.1}"));
            let longest = report.longest.as_ms_f64();
            format!("{frames:8}  {rate:>7}  {period:>9}  {longest:10.1}")
        }
        Table::Age => {
            let age_ms = now.since(report.last).as_ms_f64();
            let late = if is_late(report, age_ms) {
                "  LATE"
            } else {
                ""
            };
            format!("{age_ms:9.1}  {period:>9}{late}")
        }
        Table::Loss => {
            let IdReport {
                lost,
                jumps,
                damaged,
                samples: [a, b],
                ..
            } = report;
            let percent = 100.0 * *lost as f64 / (frames + lost).max(1) as f64;
            format!("{frames:8} {lost:8}  {percent:6.2} {jumps:8} {damaged:8} {a:8} {b:8}")
        }
    }
}

/// All figures of an id: the same for each table.
fn object(now: Instant, id: u32, report: &IdReport) -> Value {
    let age_ms = now.since(report.last).as_ms_f64();
    json!({
        "id": hex(id),
        "name": report.info.map(|info| info.name),
        "period_ms": report.period_ms,
        "frames": report.frames,
        "rate_hz": rate(report),
        "longest_ms": report.longest.as_ms_f64(),
        "age_ms": age_ms,
        "late": is_late(report, age_ms),
        "lost": report.lost,
        "jumps": report.jumps,
        "damaged": report.damaged,
        "samples": {"A": report.samples[0], "B": report.samples[1]},
    })
}
