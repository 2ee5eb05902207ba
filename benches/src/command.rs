//! `tandem bench`: its arguments and its outputs.

use crate::cases::{self, Candidate, Comparison};
use crate::compare;
use crate::exec;
use crate::load::Load;
use crate::measure::{self, Measurement};
use crate::page;
use crate::result::Results;
use crate::{table, worker};
use anyhow::{Context as _, anyhow, bail};
use indicatif::{ProgressBar, ProgressStyle};
use std::path::PathBuf;
use std::time::Instant;
use tandem_board_host::{UnsupervisedSystem, isolation};
use tandem_page::json::JsonOption;
use tandem_page::output::OutputFolder;

const EXAMPLES: &str = "\
Examples:
  tandem bench --quick                        all groups, roughly; the table alone
  tandem bench spin sleep --json a.json --html a.html
                                              two groups in full, with the page of curves
Every group has a floor: the bare mechanism, such as a cache line or a futex, between the same
CPUs in the same run. Read the ratios to it (x p50 and x p99.9); the times are the machine's.
Ctrl-C ends the measurement: what was measured so far is shown and written.
After a change of the code, `tandem bench compare --against OLD` says what became slower.

It fails with 1 if nothing could be measured.";

const COMPARE_EXAMPLES: &str = "\
Examples:
  cp target/release/tandem-bench old; git switch my-change; cargo build --release
  target/release/tandem bench compare --against ./old spin
                                              exits with 1 if Tandem became slower
  tandem bench compare --against ./old --json | jq .slower
Both programs measure in turn, in pairs of short runs. A change counts if it is beyond what pairs
differ by chance, and larger than 2 %. Floors and peers are shown, and do not count.

It fails with 1 if something of Tandem became slower, and with 2 if OLD cannot measure, or no case
was measured in all runs.";

/// Arguments of `tandem bench`.
#[derive(Clone, Debug, clap::Args)]
#[command(args_conflicts_with_subcommands = true, after_help = EXAMPLES)]
pub struct BenchArgs {
    /// Something other than measuring.
    #[command(subcommand)]
    pub command: Option<BenchCommand>,

    /// Take half a minute instead of four: fewer samples, the same cases
    #[arg(long, conflicts_with = "seconds")]
    pub quick: bool,

    /// Take this many seconds, and at least one turn of each case
    #[arg(long, value_name = "SECONDS", value_parser = clap::value_parser!(u16).range(1..=3600))]
    pub seconds: Option<u16>,

    /// The CPUs of the two ends [default: the first two that this process may use]
    #[arg(long, value_name = "NEAR,FAR", value_delimiter = ',')]
    pub cpus: Vec<usize>,

    /// Give the ends SCHED_FIFO, like the cores of a run
    #[arg(long)]
    pub realtime: bool,

    /// Measure beside this many processes that spin or write memory, on both CPUs in turn
    #[arg(long, value_name = "spin|memory:N")]
    pub load: Option<Load>,

    #[command(flatten)]
    #[allow(missing_docs)]
    pub json: JsonOption,

    /// Write a page with percentile curves and tables to this file
    #[arg(long, value_name = "FILE")]
    pub html: Option<PathBuf>,

    /// Write a distribution for each case, in ns, to this folder: for HdrHistogram plotters
    #[arg(long, value_name = "DIR")]
    pub hgrm: Option<PathBuf>,

    /// Which groups to measure [default: all]
    #[arg(value_enum, value_name = "GROUP")]
    pub groups: Vec<Comparison>,
}

/// What `tandem bench` can do besides measuring.
#[derive(Clone, Debug, clap::Subcommand)]
pub enum BenchCommand {
    /// Say what changed between two runs, beyond noise
    Compare(CompareArgs),
    /// Two redundant clients at 1 kHz: exits with 1 if a stall of the machine does not explain an
    /// overrun
    Overruns {
        /// How long
        #[arg(long, default_value_t = 60, value_parser = clap::value_parser!(u16).range(1..=3600))]
        seconds: u16,
    },
}

/// Arguments of `tandem bench compare`.
#[derive(Clone, Debug, clap::Args)]
#[command(after_help = COMPARE_EXAMPLES)]
pub struct CompareArgs {
    /// The program before the change: a `tandem` that has `bench --seconds`
    #[arg(long, value_name = "OLD")]
    pub against: PathBuf,

    /// Pairs of runs: at least 6 are needed to show a change, 11 if all groups are compared
    #[arg(long, default_value_t = 12, value_parser = clap::value_parser!(u8).range(2..=16))]
    pub pairs: u8,

    /// Seconds of a run
    #[arg(long, default_value_t = 4, value_parser = clap::value_parser!(u16).range(1..=3600))]
    pub seconds: u16,

    #[command(flatten)]
    #[allow(missing_docs)]
    pub json: JsonOption,

    /// Which groups to compare [default: all]
    #[arg(value_enum, value_name = "GROUP")]
    pub groups: Vec<Comparison>,
}

/// Why there are no figures, and the exit status for it.
#[derive(Debug)]
pub struct NoFigures {
    /// 1; or 2 if the command line, an input or the machine did not permit it and nothing was
    /// started; or 130 after Ctrl-C.
    pub status: u8,
    /// The problem, and its remedy.
    pub why: anyhow::Error,
}

impl<E: Into<anyhow::Error>> From<E> for NoFigures {
    fn from(error: E) -> Self {
        let why = error.into();
        Self { status: 1, why }
    }
}

fn usage(error: impl Into<anyhow::Error>) -> NoFigures {
    let why = error.into();
    NoFigures { status: 2, why }
}

/// The text for stdout, and a further message with its exit status.
pub type Printed = (String, Option<(String, u8)>);

/// Runs the command with these arguments.
///
/// Call it before the process has threads.
///
/// # Errors
/// [`NoFigures`]. Nothing is written then, unless the error says so.
pub fn bench(args: &BenchArgs) -> Result<Printed, NoFigures> {
    match &args.command {
        Some(BenchCommand::Compare(args)) => compare(args),
        Some(BenchCommand::Overruns { seconds }) => overruns(*seconds),
        None => run(args),
    }
}

/// Measures, and writes the outputs that `args` names. Ctrl-C ends the measurement early. The
/// figures measured so far are still written.
fn run(args: &BenchArgs) -> Result<Printed, NoFigures> {
    let files = args.json.check_with([("--html", args.html.as_deref())]);
    let (json, [html]) = files.map_err(usage)?;
    let folder = args.hgrm.as_deref();
    let folder = folder.map(|path| OutputFolder::check("--hgrm", path));
    let folder = folder.transpose().map_err(usage)?;
    let cpus = ends(&args.cpus).map_err(usage)?;
    // Before the ends get SCHED_FIFO: the load runs without it.
    let load = args.load.map(|load| load.start(cpus)).transpose();
    let load = load.context("--load")?;
    if args.realtime && !worker::ask_for_realtime() {
        return Err(usage(anyhow!(
            "--realtime: SCHED_FIFO was refused; raise RLIMIT_RTPRIO (`ulimit -r 80`) or leave it out"
        )));
    }
    let isolation = isolation::enter()?;
    // Leaked, because the forked processes of the batches use it until they exit.
    let system = Box::leak(Box::new(UnsupervisedSystem::power_on(&isolation)?));
    let begin = Instant::now();
    let all = measure(system, args, cpus);
    let duration_s = begin.elapsed().as_secs_f64();
    isolation.wipe();
    drop(load);
    let mut results = Results::new(&all, &cpus, duration_s, measure::was_interrupted());
    results.load = args.load.map(|load| load.to_string());
    if results.results.is_empty() && results.noise.is_empty() {
        return Err(nothing(&results));
    }
    const NOT_WRITTEN: &str = "measured, but not written";
    let width = terminal_size::terminal_size().map(|(width, _)| usize::from(width.0));
    let table = || results.table(width.unwrap_or(table::USUAL));
    let shown = json.write(&results, table).context(NOT_WRITTEN)?;
    if let Some(place) = html {
        place.write(&page::page(&results)).context(NOT_WRITTEN)?;
    }
    if let Some(folder) = folder {
        let measured = all.iter().filter(|one| !one.times.is_empty());
        let files: Vec<_> = measured.map(|one| distribution(one, &results)).collect();
        folder.fill(&files).context(NOT_WRITTEN)?;
    }
    let why = "interrupted: these are the figures so far".to_owned();
    let besides = results.interrupted.then_some((why, 130));
    Ok((shown, besides))
}

/// Name and text of the file for HdrHistogram plotters.
fn distribution(of: &Measurement, results: &Results) -> (String, String) {
    let name = of.case.full_name().replace('/', "-") + ".hgrm";
    // Picoseconds, shown in nanoseconds.
    let mut text = tandem_page::hgrm::text(&of.times, 1e-3);
    if results.interrupted {
        text += "#[Interrupted: fewer samples than planned]\n";
    }
    (name, text)
}

/// Returns the CPUs of the near and the far end.
fn ends(asked: &[usize]) -> anyhow::Result<[usize; 2]> {
    let usable = core_affinity::get_core_ids().unwrap_or_default();
    let usable: Vec<usize> = usable.iter().map(|cpu| cpu.id).collect();
    match (asked, &usable[..]) {
        ([], [near, far, ..]) => Ok([*near, *far]),
        ([near, far], _) if near != far && asked.iter().all(|cpu| usable.contains(cpu)) => {
            Ok([*near, *far])
        }
        ([], _) => bail!(
            "the benchmark needs two CPUs, and this process may use {}",
            usable.len()
        ),
        _ => bail!("--cpus: name two of the CPUs that this process may use: {usable:?}"),
    }
}

fn nothing(results: &Results) -> NoFigures {
    if results.interrupted {
        let why = anyhow!("interrupted before anything was measured; nothing was written");
        return NoFigures { status: 130, why };
    }
    let skipped = results.skipped.iter();
    let why = skipped.map(|case| format!("{}: {}", case.name, case.why));
    let why = why.collect::<Vec<String>>().join("; ");
    anyhow!("nothing could be measured: {why}").into()
}

fn measure(
    system: &'static UnsupervisedSystem,
    args: &BenchArgs,
    cpus: [usize; 2],
) -> Vec<Measurement> {
    let wanted = |case: &Candidate| args.groups.is_empty() || args.groups.contains(&case.group);
    let span = match args.seconds {
        Some(seconds) => measure::Span::of_seconds(seconds),
        None if args.quick => measure::QUICK,
        None => measure::FULL,
    };
    let bar = progress_bar();
    let all = measure::run(
        system,
        cases::all().filter(wanted),
        cpus,
        span,
        |passed, case| {
            bar.set_position((passed * STEPS) as u64);
            bar.set_message(case.full_name());
        },
    );
    bar.finish_and_clear();
    all
}

/// Fails if an overrun of activations is not explained.
fn overruns(seconds: u16) -> Result<Printed, NoFigures> {
    let cpus = ends(&[]).map_err(usage)?;
    let isolation = isolation::enter()?;
    let measured = exec::overruns::run(isolation.run(), cpus, seconds);
    isolation.wipe();
    let (shown, unexplained) = measured?;
    let why = format!("overruns without a stall of the machine: {unexplained}");
    Ok((shown, (unexplained > 0.0).then_some((why, 1))))
}

/// Steps of the progress bar.
const STEPS: f64 = 1000.0;

fn progress_bar() -> ProgressBar {
    let bar = ProgressBar::new(STEPS as u64);
    if let Ok(style) = ProgressStyle::with_template("{bar:30} {eta} left  {msg}") {
        bar.set_style(style);
    }
    bar
}

/// Measures with the program before the change and with this one in turn, and compares.
fn compare(args: &CompareArgs) -> Result<Printed, NoFigures> {
    let place = args.json.check().map_err(usage)?;
    let this = std::env::current_exe().context("cannot run /proc/self/exe");
    let programs = [&args.against, &this.map_err(usage)?];
    let groups = args.groups.iter().map(|group| group.name());
    let options = ["--seconds".to_owned(), args.seconds.to_string()];
    let options: Vec<String> = options.into_iter().chain(groups).collect();
    let bar = progress_bar();
    let mut pairs = Vec::new();
    for pair in 0..args.pairs {
        bar.set_position((f64::from(pair) / f64::from(args.pairs) * STEPS) as u64);
        bar.set_message(format!("pair {} of {}", pair + 1, args.pairs));
        let run = |at: usize| compare::figures_of(programs[at], &options).map_err(usage);
        // Alternate which build measures first.
        let first = usize::from(pair % 2);
        let mut runs = [run(first)?, run(1 - first)?];
        runs.rotate_left(first);
        pairs.push(runs);
    }
    bar.finish_and_clear();
    let comparison = compare::compare(&pairs).map_err(usage)?;
    let shown = place.write(&comparison, || comparison.table());
    let shown = shown.context("compared, but not written")?;
    let slower = comparison.slower.join(", ");
    let why = format!("slower beyond noise: {slower}");
    Ok((shown, (!slower.is_empty()).then_some((why, 1))))
}
