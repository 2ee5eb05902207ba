//! `tandem thesis`: runs the experiments of chapter 6 of the thesis, and prints its figures beside
//! the measured ones.

mod emulated;
mod host;
mod outputs;
mod simulated;
mod two_cores;

use std::fmt::Write as _;

use anyhow::Context as _;
use serde::Serialize;
use tandem_board::Duration;
use tandem_record::gap::Bounds;
use tandem_record::verdict::{Beside, Figures, Limits, Rule};
use tandem_record::{RunLog, start};
use tandem_redundancy::Config;

use crate::args::{ThesisArgs, ThesisBoard};
use crate::{boot_demo, rtos_demo};
use outputs::{Done, Outputs};
use tandem::board_kind::DemoBoard;
use tandem::failure::Failure;
use two_cores::{Counted, Exchange};

/// The figures of the thesis, and the bounds for the measured figures.
const SYNC_NS: f64 = 660.0;
const SKEW_US: f64 = 572.0;
/// Both systems must receive the sync edge within one heartbeat period, or they miss the first
/// heartbeats.
const SKEW_BOUND_US: f64 = 1_000.0;
const RESET_MS: f64 = 2.08;
const POWER_MS: f64 = 4.04;
/// The control period. A response within it costs no control frame.
const RESPONSE_BOUND_MS: f64 = 10.0;
/// One tick of the kernel.
const PERIOD_BOUND_MS: f64 = 1.0;

/// Number of 4-byte messages in the experiment. One byte is the message's number, as in the thesis.
const MESSAGES: u32 = 250;
/// Number of increments by each core.
const INCREMENTS: u32 = 10_000;
const INCREMENTS_SIMULATED: u32 = 100;
/// Attempts to lose an increment. On a busy machine the two cores may not run at the same time.
const ATTEMPTS: u32 = 20;
/// Number of messages that are printed.
const SHOWN: usize = 11;

/// One result.
#[derive(Clone, Debug, Serialize)]
struct Row {
    name: &'static str,
    /// The figure of the thesis.
    thesis: f64,
    /// The measured figure.
    here: f64,
    /// The limit of `here`.
    bound: f64,
    unit: &'static str,
    ok: bool,
    /// Description of the measured figure.
    means: String,
}

impl Row {
    fn new(name: &'static str, [thesis, here, bound]: [f64; 3], unit: &'static str) -> Self {
        Self {
            name,
            thesis,
            here,
            bound,
            unit,
            ok: here <= bound,
            means: String::new(),
        }
    }

    fn means(self, means: impl Into<String>) -> Self {
        let means = means.into();
        Self { means, ..self }
    }

    /// Adds a condition that must also hold.
    fn and(self, also: bool) -> Self {
        let ok = self.ok && also;
        Self { ok, ..self }
    }
}

/// The rows, the text and the picture of the experiments.
#[derive(Default)]
struct Shown {
    rows: Vec<Row>,
    text: String,
    svg: Option<String>,
}

#[derive(Serialize)]
struct Json<'a> {
    board: ThesisBoard,
    results: &'a [Row],
}

/// Runs the experiments, prints their results, and writes the files.
///
/// # Errors
/// [`Failure::Run`] if an experiment cannot be run, [`Failure::Objections`] if a figure exceeds
/// its bound.
pub(crate) fn run(args: &ThesisArgs) -> Result<(), Failure> {
    let places = args.json.check_with([("--svg", args.svg.as_deref())]);
    let (json_to, [svg_to]) = places.map_err(Failure::usage)?;
    let shown = experiments(args)?;
    let mut text = shown.text;
    text += &table(&shown.rows);
    if let (Some(svg), Some(place), Some(path)) = (&shown.svg, svg_to, &args.svg) {
        place.write(svg)?;
        let _ = writeln!(text, "\npicture of the outputs: {}", path.display());
    }
    let json = Json {
        board: args.board,
        results: &shown.rows,
    };
    tandem::print(&json_to.write(&json, || text)?)?;
    let beyond = shown.rows.iter().filter(|row| !row.ok);
    let beyond: Vec<_> = beyond
        .map(|row| format!("{} is {:.3} {}", row.name, row.here, row.unit))
        .collect();
    if beyond.is_empty() {
        Ok(())
    } else {
        Err(Failure::Objections(beyond))
    }
}

fn experiments(args: &ThesisArgs) -> anyhow::Result<Shown> {
    let mut shown = Shown::default();
    match args.board {
        ThesisBoard::Host => {
            // Fork before any thread exists: a process with threads must not fork.
            let cpus = host::cpus()?;
            shown.exchange(
                &two_cores::exchanges(cpus, MESSAGES)?,
                "two processes on two CPUs, spinning",
            );
            let free = attempts(|| Ok(two_cores::counter(cpus, INCREMENTS, false)?))?;
            shown.count(&free, &two_cores::counter(cpus, INCREMENTS, true)?);
            let (log, beside, done) = host::takeovers()?;
            shown.start(&log, "this machine's time")?;
            shown.takeovers(&log, done, "this machine")?;
            shown.verdict(&log, &beside);
            shown.kernel(DemoBoard::Host)?;
            shown.download(DemoBoard::Host)?;
        }
        ThesisBoard::Sim => {
            let exchanges = simulated::exchanges(MESSAGES)?;
            let means = "the code of both ends on this machine; in virtual time it takes 0";
            shown.exchange(&exchanges, means);
            let count = |locked| simulated::counter(INCREMENTS_SIMULATED, locked);
            shown.count(&count(false)?, &count(true)?);
            let (log, done) = simulated::takeovers()?;
            shown.start(&log, "virtual time: a line of the simulator takes none")?;
            shown.takeovers(&log, done, "virtual time")?;
            shown.verdict(&log, &virtual_time(Duration::from_ms(1)));
            shown.periods(&rtos_demo::simulated()?, "the kernel's virtual time");
        }
        ThesisBoard::Qemu => {
            let (exchanges, [free, locked]) = emulated::two_cores()?;
            let means = "an instruction takes 1 ns; core 1 sleeps, and its doorbell wakes it";
            shown.exchange(&exchanges, means);
            shown.count(&free, &locked);
            shown.start(&emulated::start()?, "both systems in one machine")?;
            let (log, done) = emulated::takeovers()?;
            shown.takeovers(&log, done, "the emulator's time")?;
            // The bus, and the connections between the machines, move data once a millisecond.
            shown.verdict(&log, &virtual_time(Duration::from_ms(4)));
            shown.kernel(DemoBoard::Qemu)?;
            shown.download(DemoBoard::Qemu)?;
        }
    }
    Ok(shown)
}

/// Returns the data that the rules need besides a virtual-time recording: limits of profile rt.
/// `on_bus` is the longest delay from sending a frame to its arrival.
fn virtual_time(on_bus: Duration) -> Beside {
    Beside {
        bounds: Bounds::new(Limits::RT, on_bus, Duration::ZERO),
        product: Some(Config::rt()),
        ..Beside::default()
    }
}

/// Repeats the count without the lock until an increment is lost, which needs both cores to run at
/// the same time.
fn attempts(count: impl Fn() -> anyhow::Result<Counted>) -> anyhow::Result<Counted> {
    let mut counted = count()?;
    for _ in 1..ATTEMPTS {
        if counted.lost() > 0 {
            break;
        }
        counted = count()?;
    }
    Ok(counted)
}

impl Shown {
    /// 6.4.2: sends 4 bytes from core 0 to the woken task of core 1.
    fn exchange(&mut self, exchanges: &[Exchange], means: &str) {
        self.text += "6.4.2  4 bytes from core 0 to the task that they wake on core 1\n";
        self.text += "       core 0 sent    core 1 received       took\n";
        for exchange in exchanges.iter().take(SHOWN) {
            let bytes = |value: u32| {
                value
                    .to_le_bytes()
                    .map(|byte| format!("{byte:02X}"))
                    .join(" ")
            };
            let (sent, received) = (bytes(exchange.sent), bytes(exchange.received));
            let _ = writeln!(
                self.text,
                "       {sent}    {received}     {:7.0} ns",
                exchange.took_ns
            );
        }
        let mut took: Vec<f64> = exchanges.iter().map(|exchange| exchange.took_ns).collect();
        took.sort_by(f64::total_cmp);
        let median = took.get(took.len() / 2).copied().unwrap_or(f64::NAN);
        let worst = took.last().copied().unwrap_or(f64::NAN);
        let wrong = exchanges
            .iter()
            .filter(|exchange| exchange.sent != exchange.received)
            .count();
        let all = exchanges.len() == MESSAGES as usize && wrong == 0;
        let _ = writeln!(
            self.text,
            "       {} messages, {wrong} wrong; median {median:.0} ns, worst {worst:.0} ns\n",
            exchanges.len()
        );
        let row = Row::new("sync/4-bytes", [SYNC_NS, median, SYNC_NS], "ns");
        self.rows
            .push(row.means(format!("median; {means}")).and(all));
    }

    /// 6.4.3, figures 6.17 and 6.18: two cores increment one counter.
    fn count(&mut self, free: &Counted, locked: &Counted) {
        self.text += "6.4.3  two cores increment one counter: its value after each increment\n";
        for (what, counted) in [("without lock", free), ("with lock   ", locked)] {
            for (core, seen) in counted.seen.iter().enumerate() {
                let seen: Vec<_> = seen.iter().map(ToString::to_string).collect();
                let _ = writeln!(self.text, "       {what}  core {core}  {}", seen.join(" "));
            }
            let Counted {
                increments,
                counter,
                ..
            } = counted;
            let lost = counted.lost();
            let _ = writeln!(
                self.text,
                "       {what}  {increments} increments, counter {counter}: {lost} lost"
            );
        }
        self.text.push('\n');
        let row = Row::new("lock/counter", [0.0, f64::from(locked.lost()), 0.0], "lost");
        let means = format!(
            "increments lost with the lock, of {}; without it {} were",
            locked.increments,
            free.lost()
        );
        // Without the lock an increment must be lost, or the experiment shows nothing.
        self.rows.push(row.means(means).and(free.lost() > 0));
    }

    /// 6.5.1: measures the time between the ends of the start protocol in both systems.
    fn start(&mut self, log: &RunLog, means: &str) -> anyhow::Result<()> {
        let skew_ns = start::skew_ns(log);
        let skew_us = skew_ns.context("the systems did not start together")? as f64 * 1e-3;
        let _ = writeln!(
            self.text,
            "6.5.1  the systems left the start protocol {skew_us:.1} µs apart\n"
        );
        let row = Row::new("start/skew", [SKEW_US, skew_us, SKEW_BOUND_US], "µs");
        let means = format!("the two ends of the start protocol, {means}");
        self.rows.push(row.means(means));
        Ok(())
    }

    /// 6.5.2: shows the two takeovers with their four events.
    fn takeovers(&mut self, log: &RunLog, done: Done, clock: &'static str) -> anyhow::Result<()> {
        let outputs = Outputs::new(log, done, clock).context("a system did not take over")?;
        let _ = writeln!(
            self.text,
            "6.5.2  outputs of the systems over time, {clock}\n{}",
            outputs.events()
        );
        for (name, thesis, here) in [
            ("takeover/reset", RESET_MS, outputs.reset_ms()),
            ("takeover/power", POWER_MS, outputs.power_ms()),
        ] {
            let row = Row::new(name, [thesis, here, RESPONSE_BOUND_MS], "ms");
            let means = format!("from fault to takeover, {clock}");
            self.rows.push(row.means(means));
        }
        self.svg = Some(outputs.draw());
        Ok(())
    }

    /// Applies the rules of the verdict that are about the driving systems.
    fn verdict(&mut self, log: &RunLog, beside: &Beside) {
        let about_systems = [
            Rule::Gap,
            Rule::TwoMasters,
            Rule::BothTransmitted,
            Rule::StaleFrames,
            Rule::Needless,
            Rule::Limits,
        ];
        let mut verdict = Figures::of(log, beside, None).verdict(log, beside);
        verdict
            .findings
            .retain(|it| about_systems.contains(&it.rule));
        let broken = verdict.objections();
        let row = Row::new("takeover/verdict", [0.0, broken.len() as f64, 0.0], "rules");
        self.rows.push(row.means(match broken.is_empty() {
            true => "rules of a good run that the takeovers broke".to_owned(),
            false => broken.join("; "),
        }));
    }

    /// 6.4.1: runs the kernel's tests on a board of the demonstrations.
    fn kernel(&mut self, board: DemoBoard) -> anyhow::Result<()> {
        let pictures = rtos_demo::pictures(board, None)?;
        self.periods(&pictures, "periods of the outputs");
        Ok(())
    }

    /// 6.4.1: checks periods of 60, 40 and 20 ms, and preemption.
    fn periods(&mut self, pictures: &[rtos_demo::Picture], means: &str) {
        self.text += "6.4.1  tasks of FreeRTOS\n";
        for picture in pictures {
            self.text += &rtos_demo::show(picture);
        }
        let off_ms = pictures
            .first()
            .map_or(f64::NAN, rtos_demo::Picture::off_ms);
        let row = Row::new("rtos/periods", [0.0, off_ms, PERIOD_BOUND_MS], "ms");
        let means = format!("{means}: largest deviation of a mean from 60, 40, 20 ms");
        self.rows.push(row.means(means));
        let during = pictures
            .last()
            .map_or(f64::NAN, rtos_demo::Picture::changes_while_burning);
        let row = Row::new("rtos/preemption", [0.0, during, 0.0], "changes");
        let means = "changes of the lower tasks' outputs while the highest works";
        self.rows.push(row.means(means));
    }

    /// 6.3: shows a download and the first frame of each core. T-BOOT-8
    fn download(&mut self, board: DemoBoard) -> anyhow::Result<()> {
        let downloaded = boot_demo::experiment(board, None)?;
        let _ = writeln!(self.text, "6.3    {downloaded}");
        let frames = downloaded.frames.len() as f64;
        let cores = tandem_board::CoreId::COUNT as f64;
        let row = Row::new("boot/download", [3.0, frames, cores], "frames");
        self.rows
            .push(row.means("cores that sent a frame after the download"));
        Ok(())
    }
}

/// Returns a table of the results: the thesis's figure, the measured figure, and the bound.
fn table(rows: &[Row]) -> String {
    let mut text = format!(
        "{:<16} {:>9} {:>9} {:>9}  {:<7}     what is measured here\n",
        "", "thesis", "here", "bound", ""
    );
    for row in rows {
        let Row {
            name,
            thesis,
            here,
            bound,
            unit,
            ok,
            means,
        } = row;
        let ok = if *ok { "ok" } else { "no" };
        let number = |value: f64| match value {
            value if value == value.round() => format!("{value:.0}"),
            value => format!("{value:.2}"),
        };
        let (thesis, here, bound) = (number(*thesis), number(*here), number(*bound));
        let _ = writeln!(
            text,
            "{name:<16} {thesis:>9} {here:>9} {bound:>9}  {unit:<7}  {ok}  {means}"
        );
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    fn exchange(sent: u32, received: u32, took_ns: f64) -> Exchange {
        Exchange {
            sent,
            received,
            took_ns,
        }
    }

    #[test]
    fn a_wrong_value_or_a_missing_one_is_not_well() {
        let right: Vec<_> = (0..MESSAGES).map(|n| exchange(n, n, 100.0)).collect();
        let ok = |exchanges: &[Exchange]| {
            let mut shown = Shown::default();
            shown.exchange(exchanges, "a test");
            shown.rows[0].ok
        };
        assert!(ok(&right));
        assert!(!ok(&right[1..]));
        let mut wrong = right.clone();
        wrong[7].received = 0;
        assert!(!ok(&wrong));
        let slow: Vec<_> = (0..MESSAGES).map(|n| exchange(n, n, 700.0)).collect();
        assert!(!ok(&slow));
        assert!(!ok(&[]));
    }

    #[test]
    fn the_control_group_must_lose_increments_and_the_lock_none() {
        let counted = |counter| Counted {
            increments: 200,
            counter,
            seen: [vec![1], vec![1]],
        };
        for (free, locked, well) in [(150, 200, true), (200, 200, false), (150, 199, false)] {
            let mut shown = Shown::default();
            shown.count(&counted(free), &counted(locked));
            assert_eq!(shown.rows[0].ok, well, "{free} {locked}");
        }
    }

    /// T-SYNC-4, T-LOCK-2, T-RED-2, T-RED-8: the experiments in virtual time stay within their
    /// bounds.
    #[test]
    fn the_experiments_in_virtual_time_keep_their_bounds() {
        let mut shown = Shown::default();
        let count = |locked| simulated::counter(10, locked).unwrap();
        let (free, locked) = (count(false), count(true));
        // Figure 6.17: both cores read the same value, and both write the same incremented value.
        assert_eq!(free.seen[0], free.seen[1]);
        assert_eq!((free.counter, locked.counter), (10, 20));
        shown.count(&free, &locked);
        let exchanges = simulated::exchanges(MESSAGES).unwrap();
        let values = |of: fn(&Exchange) -> u32| exchanges.iter().map(of).collect::<Vec<_>>();
        assert_eq!(values(|it| it.sent), values(|it| it.received));
        assert_eq!(exchanges.len(), MESSAGES as usize);
        let (log, done) = simulated::takeovers().unwrap();
        shown.start(&log, "virtual time").unwrap();
        shown.takeovers(&log, done, "virtual time").unwrap();
        shown.verdict(&log, &virtual_time(Duration::from_ms(1)));
        let bad: Vec<_> = shown.rows.iter().filter(|row| !row.ok).collect();
        assert!(bad.is_empty(), "{bad:?}");
        assert_eq!(shown.rows.len(), 5);
    }
}
