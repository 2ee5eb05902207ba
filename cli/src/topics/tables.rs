//! `tandem topics rate`, `age` and `loss`: a table of the frames of the bus, by id.

use std::io::Write;
use std::sync::atomic::AtomicBool;

use serde::{Deserialize, Serialize};
use tandem_board::Instant;
use tandem_topics::endpoints::OUTPUTS;
use tandem_topics::{CanFrame, TopicType};
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
    let (mut gateway, mut listing) = (Gateway::default(), Listing::default());
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
    let rows = gateway
        .reports()
        .map(|(id, report)| IdFigures::of(now, id, report));
    out.document(&rows.collect::<Vec<_>>(), || text(table, now, &gateway))?;
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
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub(crate) struct IdFigures {
    /// Of the frame, as the bus has it: three or eight hex digits.
    pub(crate) id: String,
    /// Of the frame in the DBC.
    pub(crate) name: Option<String>,
    /// Of the DBC, or else what the sample states, ms; 0 if there is none.
    pub(crate) period_ms: u32,
    /// Frames that were given.
    pub(crate) frames: u64,
    /// Frames a second; `None` before the second frame.
    pub(crate) rate_hz: Option<f64>,
    /// The longest time between two frames, ms.
    pub(crate) longest_ms: f64,
    /// Time since the newest frame, ms.
    pub(crate) age_ms: f64,
    /// This time is too long for the period.
    pub(crate) late: bool,
    /// Frames that neither system has published.
    pub(crate) lost: u64,
    /// How often the counter went back, or too far ahead.
    pub(crate) jumps: u64,
    /// Samples with a wrong CRC.
    pub(crate) damaged: u64,
    /// Samples of both systems.
    pub(crate) samples: Samples,
}

/// Samples of the two systems.
#[derive(Clone, Copy, Debug, Default, Serialize, Deserialize)]
pub(crate) struct Samples {
    #[serde(rename = "A")]
    pub(crate) a: u64,
    #[serde(rename = "B")]
    pub(crate) b: u64,
}

impl IdFigures {
    pub(crate) fn of(now: Instant, id: u32, report: &IdReport) -> Self {
        let age_ms = now.since(report.last).as_ms_f64();
        let [a, b] = report.samples;
        Self {
            id: hex(id),
            name: report.info.map(|info| info.name.to_owned()),
            period_ms: report.period_ms,
            frames: report.frames,
            rate_hz: rate(report),
            longest_ms: report.longest.as_ms_f64(),
            age_ms,
            late: is_late(report, age_ms),
            lost: report.lost,
            jumps: report.jumps,
            damaged: report.damaged,
            samples: Samples { a, b },
        }
    }
}
