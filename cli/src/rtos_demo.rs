//! `tandem rtos-demo`: two tests of the kernel as pictures of digital outputs. T-RTOS-3, T-RTOS-4
//!
//! Three tasks toggle an output each, as the thesis has them before an oscilloscope. The tasks note
//! each change with its time; the picture is drawn from these notes.

use anyhow::{Context as _, Result};
use plotters::prelude::*;
use std::fmt::Write as _;
use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;
use tandem_rtos::host::{deferred, elapsed_ns};
use tandem_rtos::{Clock, Kernel, Priority, TaskContext, TaskOptions, Ticks};

/// How long each test runs, ms.
const SPAN_MS: u32 = 360;
/// Columns of a trace in the terminal.
const COLUMNS: usize = 90;

/// What one task does to its output.
struct Channel {
    name: &'static str,
    priority: u8,
    period_ms: u32,
    /// Keeps its output up for so long by working, instead of toggling once in each period.
    burn_ms: Option<u64>,
}

const fn toggles(name: &'static str, priority: u8, period_ms: u32) -> Channel {
    Channel {
        name,
        priority,
        period_ms,
        burn_ms: None,
    }
}

/// T-RTOS-3.
const PERIODS: [Channel; 3] = [
    toggles("60 ms", 1, 60),
    toggles("40 ms", 2, 40),
    toggles("20 ms", 3, 20),
];
/// T-RTOS-4.
const PRIORITIES: [Channel; 3] = [
    Channel {
        name: "priority 3",
        priority: 3,
        period_ms: 30,
        burn_ms: Some(20),
    },
    toggles("priority 2", 2, 20),
    toggles("priority 1", 1, 10),
];

/// Times of the changes of each output, ms; all begin low.
type Changes = Vec<Vec<f64>>;

/// One picture.
struct Picture {
    title: &'static str,
    channels: &'static [Channel],
    changes: Changes,
}

/// Runs both tests and shows them; writes them to a file as well if there is one.
pub(crate) fn run(svg: Option<&Path>) -> Result<String> {
    let pictures = [
        picture(
            "T-RTOS-3: each task toggles its output once in its period",
            &PERIODS,
        )?,
        picture(
            "T-RTOS-4: the most urgent task works for 20 ms in each 30 ms",
            &PRIORITIES,
        )?,
    ];
    if let Some(path) = svg {
        let text = draw(&pictures).context("drawing")?;
        std::fs::write(path, text).with_context(|| path.display().to_string())?;
    }
    Ok(pictures.iter().map(show).collect())
}

fn picture(title: &'static str, channels: &'static [Channel]) -> Result<Picture> {
    let notes: Arc<Mutex<Changes>> = Arc::new(Mutex::new(vec![vec![]; channels.len()]));
    let kernel = Kernel::take()?;
    for (number, channel) in channels.iter().enumerate() {
        let notes = Arc::clone(&notes);
        let options = TaskOptions::new(channel.name, Priority::new(channel.priority));
        let note = move || {
            let at_ms = elapsed_ns() as f64 * 1e-6;
            // The lock is the standard library's: no other task may meet it.
            deferred(|| {
                notes.lock().unwrap_or_else(PoisonError::into_inner)[number].push(at_ms);
            });
        };
        kernel.spawn(&options, move |ctx| output(ctx, channel, note))?;
    }
    let end = TaskOptions::new("end", Priority::HIGHEST);
    kernel.spawn(&end, |ctx| {
        ctx.delay(Ticks(SPAN_MS));
        ctx.stop();
    })?;
    kernel.start(Clock::Wall)?;
    let changes = std::mem::take(&mut *notes.lock().unwrap_or_else(PoisonError::into_inner));
    Ok(Picture {
        title,
        channels,
        changes,
    })
}

/// A task, for ever.
fn output(ctx: &TaskContext, channel: &Channel, change: impl Fn()) {
    let mut wake = ctx.now();
    loop {
        change();
        if let Some(burn_ms) = channel.burn_ms {
            ctx.burn(Duration::from_millis(burn_ms));
            change();
        }
        ctx.delay_until(&mut wake, Ticks(channel.period_ms));
    }
}

impl Picture {
    /// Whether an output is up at this time.
    fn is_up(&self, channel: usize, at_ms: f64) -> bool {
        self.changes[channel]
            .iter()
            .filter(|change| **change <= at_ms)
            .count()
            % 2
            == 1
    }

    /// Shortest, mean and longest time between two changes in the same direction for who works, and
    /// between any two for who toggles; ms.
    fn periods(&self, channel: usize) -> Option<(f64, f64, f64)> {
        let step = 1 + usize::from(self.channels[channel].burn_ms.is_some());
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

    fn label(&self, channel: usize) -> String {
        let name = self.channels[channel].name;
        self.periods(channel).map_or_else(
            || name.to_owned(),
            |(min, mean, max)| format!("{name}: {mean:.2} ms ({min:.2} to {max:.2})"),
        )
    }
}

/// The picture for a terminal.
fn show(picture: &Picture) -> String {
    let mut text = format!("{}\n", picture.title);
    for channel in 0..picture.channels.len() {
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
    let _ = writeln!(text, "  0{:>half$}{:>half$} ms\n", SPAN_MS / 2, SPAN_MS);
    text
}

/// Both pictures as one SVG.
fn draw(pictures: &[Picture]) -> Result<String> {
    let mut text = String::new();
    {
        let root = SVGBackend::with_string(&mut text, (1000, 640)).into_drawing_area();
        root.fill(&WHITE)?;
        for (area, picture) in root.split_evenly((pictures.len(), 1)).iter().zip(pictures) {
            draw_one(area, picture)?;
        }
        root.present()?;
    }
    Ok(text)
}

fn draw_one<D>(area: &DrawingArea<D, plotters::coord::Shift>, picture: &Picture) -> Result<()>
where
    D: DrawingBackend,
    D::ErrorType: 'static,
{
    let count = picture.channels.len();
    let span = f64::from(SPAN_MS);
    let mut chart = ChartBuilder::on(area)
        .caption(picture.title, ("sans-serif", 18))
        .margin(12)
        .x_label_area_size(36)
        .build_cartesian_2d(0.0..span, 0.0..count as f64)?;
    let mesh = chart
        .configure_mesh()
        .disable_y_mesh()
        .disable_y_axis()
        .x_desc("ms")
        .draw();
    mesh?;
    for channel in 0..count {
        let base = (count - 1 - channel) as f64 + 0.1;
        let mut level = 0.0;
        let mut points = vec![(0.0, base)];
        for change in &picture.changes[channel] {
            points.push((*change, base + level));
            level = 0.5 - level;
            points.push((*change, base + level));
        }
        points.push((span, base + level));
        chart.draw_series(LineSeries::new(points, &Palette99::pick(channel)))?;
        let label = Text::new(
            picture.label(channel),
            (2.0, base + 0.8),
            ("sans-serif", 14),
        );
        chart.draw_series([label])?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn known() -> Picture {
        Picture {
            title: "known",
            channels: &PRIORITIES,
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
        let svg = draw(&[known()]).unwrap();
        assert!(roxmltree::Document::parse(&svg).is_ok(), "{svg}");
        for channel in &PRIORITIES {
            assert!(svg.contains(channel.name), "{svg}");
        }
        assert!(svg.matches("<polyline").count() >= 3, "{svg}");
    }
}
