//! `tandem time`: shows the vehicle's time of a run live, as an observer of what it publishes.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::io::{self, IsTerminal as _};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use anyhow::{Context as _, anyhow};
use serde::Serialize;
use signal_hook::consts::{SIGINT, SIGTERM};
use tandem_board_host::process_list::{self, RunError};
use tandem_observers::{ChainedClock, News, Observer, VehicleClocks};
use tandem_processes::percentiles::DeviationFigures;
use tandem_record::clocks::ChainClock;
use tandem_record::description::{is_holdover, no_grandmaster, time_source, time_status};

use crate::args::TimeArgs;
use crate::failure::Failure;
use crate::live::columns;

/// How often the run is polled.
const TURN: Duration = Duration::from_millis(50);
/// How often a line is printed, if stdout is no terminal.
const LINE_EVERY: Duration = Duration::from_secs(1);
/// After this time without news, the run may have ended.
const SILENT: Duration = Duration::from_secs(1);

/// Shows the time of the run until it ends, for a time, or until Ctrl-C.
///
/// # Errors
/// [`Failure::Usage`] if several runs are active or the file cannot be written;
/// [`Failure::NothingHeard`] if the run does not publish, or has no time;
/// [`Failure::CutShort`] at Ctrl-C.
pub fn run(args: &TimeArgs) -> Result<(), Failure> {
    let json_to = args.json.check().map_err(Failure::usage)?;
    let stop = Arc::new(AtomicBool::new(false));
    for signal in [SIGINT, SIGTERM] {
        signal_hook::flag::register(signal, Arc::clone(&stop)).context("Ctrl-C")?;
    }
    let mut observer = observer(args.run.as_deref())?;
    let run = observer.run().to_string();
    let mut screen = Screen::new(run.clone());
    let mut seen = Seen::default();
    let span = args.duration.map(Duration::from_secs_f64);
    let mut heard = Instant::now();
    while !stop.load(Ordering::Relaxed) && span.is_none_or(|span| screen.begin.elapsed() < span) {
        std::thread::sleep(TURN);
        let mut newest = None;
        observer.poll(&mut |news| {
            heard = Instant::now();
            if let News::Time(time) = news {
                seen.take(&time);
                newest = Some(time);
            }
        });
        if let Some(time) = newest
            && !json_to.takes_stdout()
        {
            screen.show(&time)?;
        }
        if heard.elapsed() > SILENT && process_list::run_named(Some(&run)).is_err() {
            break;
        }
    }
    if seen.clocks.is_empty() {
        return Err(Failure::NothingHeard(format!(
            "no clock of {run} has shown a time: a system has one once it drives, or 3 s later \
             if its run has a network (tandem run --domain) without a grandmaster"
        )));
    }
    crate::print(&json_to.write(&seen.figures(&run), String::new)?)?;
    match stop.load(Ordering::Relaxed) {
        true => Err(Failure::CutShort),
        false => Ok(()),
    }
}

/// Observes the run.
fn observer(name: Option<&str>) -> Result<Observer, Failure> {
    match process_list::run_named(name) {
        Ok(_) => {}
        Err(RunError::Several(names)) => {
            return Err(Failure::Usage(anyhow!(
                "several runs are active; name one of them, as in tandem time RUN: {names}"
            )));
        }
        Err(RunError::NoRun) => {
            let text = "no run is active; tandem run starts one, tandem time --board sim drives in \
                        virtual time";
            return Err(Failure::Usage(anyhow!(text)));
        }
        Err(error) => return Err(Failure::usage(error)),
    }
    Observer::on(name).map_err(|error| {
        Failure::NothingHeard(format!("the run does not publish its time (yet): {error}"))
    })
}

/// Where the time is shown: updated in place on a terminal, otherwise a line each second.
struct Screen {
    run: String,
    begin: Instant,
    is_terminal: bool,
    /// Lines that are on the terminal.
    lines: usize,
    printed: Option<Instant>,
}

impl Screen {
    fn new(run: String) -> Self {
        Self {
            run,
            begin: Instant::now(),
            is_terminal: io::stdout().is_terminal(),
            lines: 0,
            printed: None,
        }
    }

    fn show(&mut self, time: &VehicleClocks) -> anyhow::Result<()> {
        if self.is_terminal {
            // Cut at the terminal's width: a wrapped line could not be updated.
            let columns = columns(io::stdout());
            let mut text = match self.lines {
                0 => String::new(),
                lines => format!("\x1b[{lines}A\x1b[J"),
            };
            let table = format!("{}\n{}", self.run, table(time));
            for line in table.lines() {
                let _ = writeln!(text, "{line:.columns$}");
            }
            self.lines = table.lines().count();
            return crate::print(&text);
        }
        if self.printed.is_some_and(|at| at.elapsed() < LINE_EVERY) {
            return Ok(());
        }
        self.printed = Some(Instant::now());
        let elapsed_s = self.begin.elapsed().as_secs_f64();
        crate::print(&format!("{elapsed_s:6.1} s{}\n", line(time)))
    }
}

/// The clocks that have a time.
fn clocks(time: &VehicleClocks) -> impl Iterator<Item = (ChainClock, &ChainedClock)> {
    let all = ChainClock::ALL.into_iter().zip(&time.clocks);
    all.filter(|(_, clock)| clock.at_ns > 0)
}

fn us(ns: impl Into<f64>) -> f64 {
    ns.into() * 1e-3
}

/// How many sensors stamp in the vehicle's time, in holdover or not, and how many are heard.
fn sensors(time: &VehicleClocks) -> (usize, usize) {
    let count = |is_it: fn(&&u8) -> bool| time.sensors.iter().filter(is_it).count();
    (count(|it| matches!(it, 1 | 2)), count(|it| **it != u8::MAX))
}

/// The text, or a dash if the clock has heard no other one lately.
fn if_heard(clock: &ChainedClock, text: String) -> String {
    match clock.heard_ns {
        0 => "-".to_owned(),
        _ => text,
    }
}

fn offset(clock: &ChainedClock) -> String {
    if_heard(clock, format!("{:+.1}", us(clock.offset_ns)))
}

fn table(time: &VehicleClocks) -> String {
    let mut text = format!(
        "{:6}{:18}{:16}{:>11}{:>9}{:>10}{:>10}{:>8}\n",
        "CLOCK", "FOLLOWS", "STATUS", "OFFSET us", "RATE ppm", "DELAY us", "ERROR us", "HEARD s"
    );
    for (of, clock) in clocks(time) {
        let ago_s = time.at_ns.saturating_sub(clock.heard_ns) as f64 * 1e-9;
        let delay = (clock.delay_ns > 0).then(|| format!("{:.1}", us(clock.delay_ns)));
        let error = format!("{:.1}", us(clock.error_ns));
        let _ = writeln!(
            text,
            "{:6}{:18}{:16}{:>11}{:>+9.2}{:>10}{:>10}{:>8}",
            of.name(),
            time_source(clock.source),
            time_status(clock.status),
            offset(clock),
            us(clock.rate_ppb),
            delay.unwrap_or_else(|| "-".to_owned()),
            if_heard(clock, error),
            if_heard(clock, format!("{ago_s:.1}")),
        );
    }
    let (global, heard) = sensors(time);
    let _ = writeln!(
        text,
        "{}, {global} of {heard} sensors stamp in this time",
        together(time)
    );
    for (of, clock) in clocks(time) {
        if clock.why != 0 && clock.why != u8::MAX {
            let why = no_grandmaster(clock.why);
            let _ = writeln!(text, "{} has no time of the grandmaster: {why}", of.name());
        }
        if clock.leaps > 0 {
            let _ = writeln!(text, "{} has found {} leaps", of.name(), clock.leaps);
        }
    }
    text
}

/// How far A and B are apart, in time and in their control cycles.
fn together(time: &VehicleClocks) -> String {
    let apart = match time.apart_ns {
        i32::MIN => "A - B unknown".to_owned(),
        ns => format!("A - B {:+.1} us", us(ns)),
    };
    let (p50, p99) = (us(time.skew_p50_ns), us(time.skew_p99_ns));
    match time.cycles {
        0 => apart,
        _ => format!("{apart}, control cycles apart p50 {p50:.1} p99 {p99:.1} us"),
    }
}

fn line(time: &VehicleClocks) -> String {
    let mut text = String::new();
    for (of, clock) in clocks(time) {
        let _ = write!(
            text,
            "  {}: {}, {}, {} us",
            of.name(),
            time_source(clock.source),
            time_status(clock.status),
            offset(clock)
        );
    }
    let (global, heard) = sensors(time);
    text + &format!("  {}, sensors {global}/{heard}", together(time))
}

/// What was seen of one clock.
#[derive(Default)]
struct SeenClock {
    newest: ChainedClock,
    offsets_ns: Vec<i64>,
    /// In how many of these samples it was in holdover.
    holdovers: usize,
    samples: usize,
}

/// What was seen of a run.
#[derive(Default)]
struct Seen {
    clocks: BTreeMap<&'static str, SeenClock>,
    apart_ns: Vec<i64>,
    newest: VehicleClocks,
}

impl Seen {
    fn take(&mut self, time: &VehicleClocks) {
        self.newest = *time;
        if time.apart_ns != i32::MIN {
            self.apart_ns.push(time.apart_ns.into());
        }
        for (of, clock) in clocks(time) {
            let seen = self.clocks.entry(of.name()).or_default();
            if clock.heard_ns != seen.newest.heard_ns {
                seen.offsets_ns.push(clock.offset_ns.into());
            }
            seen.samples += 1;
            seen.holdovers += usize::from(is_holdover(clock.status));
            seen.newest = *clock;
        }
    }

    fn figures(&self, run: &str) -> SeenFigures {
        let clocks = self.clocks.iter().map(|(name, seen)| {
            let clock = &seen.newest;
            let figures = ClockFigures {
                follows: time_source(clock.source),
                status: time_status(clock.status),
                offset: DeviationFigures::of_ns(seen.offsets_ns.iter().copied()),
                rate_ppm: us(clock.rate_ppb),
                delay_us: us(clock.delay_ns),
                error_us: us(clock.error_ns),
                leaps: clock.leaps,
                holdover_percent: 100.0 * seen.holdovers as f64 / seen.samples.max(1) as f64,
            };
            (*name, figures)
        });
        let (global, heard) = sensors(&self.newest);
        SeenFigures {
            run: run.to_owned(),
            clocks: clocks.collect(),
            apart: DeviationFigures::of_ns(self.apart_ns.iter().copied()),
            cycles: self.newest.cycles,
            skew_p50_us: us(self.newest.skew_p50_ns),
            skew_p99_us: us(self.newest.skew_p99_ns),
            sensors: heard,
            sensors_in_this_time: global,
        }
    }
}

/// Figures of one clock, in the file of `--json`. Those without a spread are the newest.
#[derive(Debug, Serialize)]
struct ClockFigures {
    follows: &'static str,
    status: &'static str,
    offset: Option<DeviationFigures>,
    rate_ppm: f64,
    delay_us: f64,
    error_us: f64,
    leaps: u32,
    holdover_percent: f64,
}

/// The contents of the file of `--json`.
#[derive(Debug, Serialize)]
struct SeenFigures {
    run: String,
    clocks: BTreeMap<&'static str, ClockFigures>,
    /// Between A and B.
    apart: Option<DeviationFigures>,
    /// In the last 5 s, as the percentiles.
    cycles: u32,
    skew_p50_us: f64,
    skew_p99_us: f64,
    sensors: usize,
    sensors_in_this_time: usize,
}

#[cfg(test)]
mod tests {
    use super::*;
    use tandem_timesync::TimeStatus;

    /// A follows the grandmaster, B follows A and is in holdover, and there is no SoC.
    fn time() -> VehicleClocks {
        let a = ChainedClock {
            at_ns: 9_950_000_000,
            heard_ns: 9_800_000_000,
            offset_ns: -1_250,
            delay_ns: 7_200,
            error_ns: 17_200,
            rate_ppb: 310,
            source: 1,
            status: TimeStatus::GLOBAL_TIME_BASE.bits(),
            ..ChainedClock::default()
        };
        let b = ChainedClock {
            at_ns: 9_990_000_000,
            source: 2,
            status: TimeStatus::GLOBAL_TIME_BASE.bits() | TimeStatus::HOLDOVER.bits(),
            leaps: 2,
            why: 1,
            ..ChainedClock::default()
        };
        VehicleClocks {
            at_ns: 10_000_000_000,
            clocks: [a, b, ChainedClock::default()],
            apart_ns: 420,
            cycles: 499,
            skew_p50_ns: 8_800,
            skew_p99_ns: 150_500,
            sensors: [1, 1, 2, 0, 1, u8::MAX],
            ..VehicleClocks::default()
        }
    }

    /// S-1: the view names whom each clock follows and how well, and only clocks that have a time.
    #[test]
    fn the_view_shows_each_clock_and_how_far_both_systems_are_apart() {
        let table = table(&time());
        let lines: Vec<_> = table.lines().collect();
        let words = |line: usize| lines[line].split_whitespace().collect::<Vec<_>>().join(" ");
        assert_eq!(
            words(1),
            "A the grandmaster synchronised -1.2 +0.31 7.2 17.2 0.2"
        );
        assert_eq!(words(2), "B the other system holdover - +0.00 - - -");
        assert_eq!(
            lines[3..],
            [
                "A - B +0.4 us, control cycles apart p50 8.8 p99 150.5 us, 4 of 5 sensors stamp in \
                 this time",
                "B has no time of the grandmaster: none is heard",
                "B has found 2 leaps",
            ]
        );
        let columns = |line: &str| line.len();
        assert_eq!(
            columns(lines[1]),
            columns(lines[0]),
            "the columns stay in place"
        );
        let line = line(&time());
        assert!(
            line.contains("B: the other system, holdover, - us  A - B +0.4 us"),
            "{line}"
        );
    }

    /// S-1: the file has the spread of the offsets, each sample once, and the share of holdover.
    #[test]
    fn the_file_has_figures_of_all_that_was_seen() {
        let (mut seen, mut time) = (Seen::default(), time());
        seen.take(&time);
        seen.take(&time);
        time.clocks[0].heard_ns += 125_000_000;
        time.clocks[0].offset_ns = 3_000;
        time.clocks[1].status = TimeStatus::GLOBAL_TIME_BASE.bits();
        time.apart_ns = i32::MIN;
        seen.take(&time);
        let figures = serde_json::to_value(seen.figures("tandem-1-a")).unwrap();
        let a = &figures["clocks"]["A"];
        assert_eq!(a["offset"]["count"], 2);
        assert_eq!(a["offset"]["max_us"], 3.0);
        assert_eq!(a["follows"], "the grandmaster");
        let percent = figures["clocks"]["B"]["holdover_percent"].as_f64().unwrap();
        assert!((66.0..67.0).contains(&percent), "{percent}");
        assert_eq!(figures["apart"]["count"], 2);
        assert_eq!(figures["sensors_in_this_time"], 4);
        assert!(figures["clocks"]["SoC"].is_null());
    }
}
