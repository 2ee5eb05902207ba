//! `tandem rtos-demo`: draws digital outputs in two tests of the kernel. T-RTOS-3, T-RTOS-4
//!
//! Each of three tasks toggles an output; the thesis shows these outputs on an oscilloscope. The
//! tasks record the time of each change, in this process or as firmware in an emulated machine.
//! The picture is drawn from these records.

use anyhow::{Result, ensure};
use serde::Serialize;
use std::fmt::Write as _;
use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError};
use tandem_page::svg::Color;
use tandem_rtos::demo::{COMPLETE, Output, OutputEdge, SPAN_MS, TESTS, Test, toggle};
use tandem_rtos::host::{deferred, elapsed_ns};
use tandem_rtos::{Kernel, Priority, TaskOptions, TickSource};

use crate::args::RtosDemoArgs;
use crate::emulated;
use crate::square_waves::{self, SquareWaves, Trace};
use tandem::board_kind::DemoBoard;
use tandem::failure::Failure;

/// Number of columns of a trace in the terminal.
const COLUMNS: usize = 90;
/// Colours of the outputs.
const COLORS: [Color; 3] = [Color::A, Color::B, Color::GOOD];
/// Longest time between an output's change and its record, ms.
const EDGE_MS: f64 = 0.05;
/// The image of this demonstration.
const IMAGE: &str = "rtos-demo";
const HERE: &str = "this machine's time";
const VIRTUAL: &str = "virtual time";
const EMULATED: &str = "the emulator's time (QEMU, riscv32): an instruction takes 1 ns";

/// Times of the changes of each output, ms. All outputs begin low.
type Changes = Vec<Vec<f64>>;

/// One picture.
pub(crate) struct Picture {
    test: &'static Test,
    /// The clock that measured the times, in words.
    clock: &'static str,
    changes: Changes,
}

/// A picture in the output of `--json`.
#[derive(Debug, Serialize)]
struct PictureRow {
    id: &'static str,
    title: &'static str,
    clock: &'static str,
    span_ms: u32,
    outputs: Vec<OutputRow>,
}

/// An output in the output of `--json`.
#[derive(Debug, Serialize)]
struct OutputRow {
    name: &'static str,
    period_ms: u32,
    changes_ms: Vec<f64>,
}

impl From<&Picture> for PictureRow {
    fn from(picture: &Picture) -> Self {
        let Picture {
            test,
            clock,
            changes,
        } = picture;
        let row = |(output, changes): (&Output, &Vec<f64>)| OutputRow {
            name: output.name,
            period_ms: output.period_ms,
            changes_ms: changes.clone(),
        };
        Self {
            id: test.id,
            title: test.title,
            clock,
            span_ms: SPAN_MS,
            outputs: test.outputs.iter().zip(changes).map(row).collect(),
        }
    }
}

/// Runs both tests and prints the pictures. Also writes them to the file of `--svg`, if given.
///
/// # Errors
/// [`Failure::Usage`] if a file cannot be written, [`Failure::Run`] if a test cannot be run.
pub(crate) fn run(args: &RtosDemoArgs) -> Result<(), Failure> {
    let places = args.json.check_with([("--svg", args.svg.as_deref())]);
    let (json_to, [svg_to]) = places.map_err(Failure::usage)?;
    let pictures = pictures(args.board, args.firmware.as_deref())?;
    if let Some(place) = svg_to {
        place.write(&draw(&pictures))?;
    }
    let rows: Vec<PictureRow> = pictures.iter().map(PictureRow::from).collect();
    let text = || pictures.iter().map(show).collect();
    Ok(tandem::print(&json_to.write(&rows, text)?)?)
}

/// Runs both tests on this board. `firmware` is the image for the emulated board.
///
/// # Errors
/// If the kernel or the emulator does not start, or the image is missing.
pub(crate) fn pictures(board: DemoBoard, firmware: Option<&Path>) -> Result<Vec<Picture>> {
    match board {
        DemoBoard::Host => TESTS
            .iter()
            .map(|test| here(test, TickSource::Wall))
            .collect(),
        DemoBoard::Qemu => {
            let image = emulated::image(IMAGE, firmware)?;
            pictures_of(&tandem_board_qemu::run_to_end(&image)?)
        }
    }
}

/// Runs both tests in this process, in virtual time.
///
/// # Errors
/// If the kernel does not start.
pub(crate) fn simulated() -> Result<Vec<Picture>> {
    TESTS
        .iter()
        .map(|test| here(test, TickSource::Virtual))
        .collect()
}

/// Converts the log of the firmware to pictures.
fn pictures_of(log: &str) -> Result<Vec<Picture>> {
    ensure!(
        log.lines().any(|line| line == COMPLETE),
        "the firmware did not reach its end, or has another version: {log}"
    );
    let mut pictures: Vec<_> = TESTS
        .iter()
        .map(|test| Picture {
            test,
            clock: EMULATED,
            changes: vec![vec![]; test.outputs.len()],
        })
        .collect();
    for edge in log.lines().filter_map(OutputEdge::parse) {
        pictures[edge.test].changes[edge.output].push(edge.at_ns as f64 * 1e-6);
    }
    Ok(pictures)
}

/// Runs a test in this process.
fn here(test: &'static Test, clock: TickSource) -> Result<Picture> {
    let notes: Arc<Mutex<Changes>> = Arc::new(Mutex::new(vec![vec![]; test.outputs.len()]));
    let kernel = Kernel::take()?;
    for (number, output) in test.outputs.iter().enumerate() {
        let notes = Arc::clone(&notes);
        let options = TaskOptions::new(output.name, Priority::new(output.priority));
        let note = move || {
            let at_ms = elapsed_ns() as f64 * 1e-6;
            // The mutex is the standard library's, so no other task may run while it is held.
            deferred(|| {
                notes.lock().unwrap_or_else(PoisonError::into_inner)[number].push(at_ms);
            });
        };
        kernel.spawn(&options, move |ctx| toggle(ctx, output, ctx.now(), note))?;
    }
    kernel.start(clock)?;
    let mut changes = std::mem::take(&mut *notes.lock().unwrap_or_else(PoisonError::into_inner));
    for output in &mut changes {
        output.retain(|at_ms| *at_ms <= f64::from(SPAN_MS));
    }
    Ok(Picture {
        test,
        clock: match clock {
            TickSource::Wall => HERE,
            TickSource::Virtual => VIRTUAL,
        },
        changes,
    })
}

impl Picture {
    /// Returns true if an output is high at this time.
    fn is_up(&self, channel: usize, at_ms: f64) -> bool {
        self.changes[channel]
            .iter()
            .filter(|change| **change <= at_ms)
            .count()
            % 2
            == 1
    }

    /// Returns the shortest, mean and longest period, ms: between two changes in the same direction
    /// for a task that works, between any two changes for a task that toggles.
    fn periods(&self, channel: usize) -> Option<(f64, f64, f64)> {
        let step = 1 + usize::from(self.test.outputs[channel].burn_ms.is_some());
        let starts: Vec<f64> = self.changes[channel]
            .iter()
            .copied()
            .step_by(step)
            .collect();
        let periods: Vec<f64> = starts.windows(2).map(|pair| pair[1] - pair[0]).collect();
        let count = periods.len();
        (count > 0).then(|| {
            (
                periods.iter().copied().fold(f64::MAX, f64::min),
                periods.iter().sum::<f64>() / count as f64,
                periods.iter().copied().fold(0.0, f64::max),
            )
        })
    }

    /// Returns the largest deviation of an output's mean period from its task's period, ms; NaN if
    /// an output never changed.
    pub(crate) fn off_ms(&self) -> f64 {
        let off = (0..self.test.outputs.len()).map(|channel| {
            let asked_ms = f64::from(self.test.outputs[channel].period_ms);
            self.periods(channel)
                .map_or(f64::NAN, |(_, mean_ms, _)| (mean_ms - asked_ms).abs())
        });
        off.fold(0.0, |worst, off| if off <= worst { worst } else { off })
    }

    /// Counts the changes of the lower tasks' outputs while the highest task worked.
    pub(crate) fn changes_while_burning(&self) -> f64 {
        let lower = self.changes[1..].iter().flatten();
        // Exclude changes near an edge, where the highest task may have just begun or ended.
        let within = |at_ms: &&f64| {
            [-EDGE_MS, EDGE_MS]
                .iter()
                .all(|margin| self.is_up(0, **at_ms + margin))
        };
        lower.filter(within).count() as f64
    }

    fn traces(&self) -> Vec<Trace> {
        let channels = COLORS.into_iter().zip(&self.changes).enumerate();
        let trace = |(channel, (color, changes)): (usize, (Color, &Vec<f64>))| Trace {
            color,
            label: self.label(channel),
            changes: changes.clone(),
            note: None,
        };
        channels.map(trace).collect()
    }

    fn title(&self) -> String {
        format!("{}: {}", self.test.id, self.test.title)
    }

    fn label(&self, channel: usize) -> String {
        let Output {
            name, period_ms, ..
        } = self.test.outputs[channel];
        let Some((min, mean, max)) = self.periods(channel) else {
            return name.to_owned();
        };
        // The mean period of a preempted task depends on where the picture ends.
        if max - min > f64::from(period_ms) / 2.0 {
            let count = self.changes[channel].len();
            format!("{name}: preempted, {min:.2} to {max:.2} ms apart, {count} in {SPAN_MS} ms")
        } else {
            format!("{name}: {mean:.2} ms ({min:.2} to {max:.2})")
        }
    }
}

/// Returns the picture for a terminal.
pub(crate) fn show(picture: &Picture) -> String {
    let mut text = format!("{}\n", picture.title());
    for channel in 0..picture.test.outputs.len() {
        let level = |column: usize| {
            let at_ms = (column as f64 + 0.5) * f64::from(SPAN_MS) / COLUMNS as f64;
            if picture.is_up(channel, at_ms) {
                '▔'
            } else {
                '▁'
            }
        };
        let trace: String = (0..COLUMNS).map(level).collect();
        let _ = writeln!(text, "  {trace}  {}", picture.label(channel));
    }
    let half = COLUMNS / 2;
    let _ = writeln!(
        text,
        "  0{:>half$}{:>half$} ms of {}\n",
        SPAN_MS / 2,
        SPAN_MS,
        picture.clock
    );
    text
}

/// Returns the pictures as one SVG.
fn draw(pictures: &[Picture]) -> String {
    let waves = pictures.iter().map(|picture| SquareWaves {
        title: picture.title(),
        axis: format!("ms of {}", picture.clock),
        span: f64::from(SPAN_MS),
        traces: picture.traces(),
    });
    square_waves::file(&waves.collect::<Vec<_>>())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn known() -> Picture {
        Picture {
            test: &TESTS[1],
            clock: EMULATED,
            changes: vec![
                vec![0.0, 20.0, 30.0, 50.0, 61.0, 81.0],
                vec![20.5, 50.5],
                vec![21.0],
            ],
        }
    }

    #[test]
    fn levels_and_periods_are_those_of_the_changes() {
        let picture = known();
        assert!(picture.is_up(0, 10.0) && !picture.is_up(0, 25.0) && picture.is_up(0, 30.0));
        let (min, mean, max) = picture.periods(0).unwrap();
        assert_eq!((min, mean, max), (30.0, 30.5, 31.0));
        assert_eq!(picture.periods(1), Some((30.0, 30.0, 30.0)));
        assert_eq!(picture.periods(2), None);
    }

    #[test]
    fn pictures_have_a_trace_for_each_output() {
        let text = show(&known());
        assert_eq!(text.lines().filter(|line| line.contains('▁')).count(), 3);
        let svg = draw(&[known()]);
        assert!(roxmltree::Document::parse(&svg).is_ok(), "{svg}");
        for output in &TESTS[1].outputs {
            assert!(svg.contains(output.name), "{svg}");
        }
        for shown in [&svg, &text] {
            assert!(shown.contains("time (QEMU, riscv32)"), "{shown}");
        }
        assert_eq!(svg.matches("stroke-linejoin").count(), 3, "{svg}");
    }

    #[test]
    fn what_firmware_logs_becomes_pictures() {
        let edges = "edge T-RTOS-3 2 20000100\nedge T-RTOS-4 0 300\nedge T-RTOS-4 0 20000300\n";
        let pictures = pictures_of(&format!("{edges}{COMPLETE}\n")).unwrap();
        assert_eq!(pictures[0].changes, [vec![], vec![], vec![20.0001]]);
        assert!(pictures[1].is_up(0, 10.0) && !pictures[1].is_up(0, 20.1));
        // An incomplete log is refused.
        assert!(pictures_of(edges).is_err());
    }
}
