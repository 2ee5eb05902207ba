//! `tandem sim`: faults on the control cores of both systems, in virtual time.

mod coverage;
mod merge;
mod outcome;
mod recording;
mod report;

use std::fs;
use std::num::NonZero;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::Mutex;
use std::thread;
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, bail};
use clap::{Args, ValueEnum};
use indicatif::{ProgressBar, ProgressStyle};
use rustix::time::{ClockId, clock_gettime};
use tandem_page::output::OutputFile;
use tandem_redundancy::Config;
use tandem_sim::faults::{Around, Fault, Group, Profile, Sequence};
use tandem_sim::timing::Time;

use outcome::Outcome;
use report::Summary;
use tandem::failure::Failure;
use tandem::output::ReportFolder;
use tandem::print;

/// Sequences that one process runs: each reset of a core leaves its board in memory.
const CHUNK: u64 = 100;

/// Arguments of `tandem sim`.
#[derive(Debug, Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct SimArgs {
    /// How many random sequences of faults, or how many seeds for --faults
    #[arg(long, value_name = "N", default_value_t = 1_000)]
    seeds: u64,

    /// The first seed; each further one is the next number
    #[arg(long, value_name = "S", default_value_t = 0)]
    from: u64,

    /// How many processes at a time [default: one for each CPU]
    #[arg(long, value_name = "J")]
    jobs: Option<NonZero<usize>>,

    /// Try the faults of this TOML file instead of random ones
    #[arg(long, value_name = "FILE", conflicts_with = "group")]
    faults: Option<PathBuf>,

    /// Which sequences: each single fault at 20 moments of the control cycle, all pairs within one
    /// system, or random ones
    #[arg(long, value_enum, default_values_t = [Kind::Random])]
    group: Vec<Kind>,

    /// Of single faults and pairs, every N-th only
    #[arg(long, value_name = "N", default_value_t = NonZero::<u64>::MIN)]
    every: NonZero<u64>,

    /// Limits of the redundancy
    #[arg(long, value_enum, default_value_t = Timing::Rt)]
    timing: Timing,

    /// What takes time: nothing, what is usual, or as much as was ever measured
    #[arg(long, value_enum, default_value_t = Takes::Ideal)]
    time: Takes,

    /// Run cores 1 and 2 as well, and a vehicle in its lane behind another one
    #[arg(long)]
    closed_loop: bool,

    /// Print the table of faults and the states that they hit
    #[arg(long)]
    coverage: bool,

    /// Add up what other runs wrote with --json, and end
    #[arg(long, value_name = "FILE", num_args = 1.., conflicts_with_all = ["faults", "only"])]
    merge: Vec<PathBuf>,

    /// Tell what happens in one sequence, as random:137; with --faults, the seed alone
    #[arg(long, value_name = "GROUP:NUMBER")]
    only: Option<String>,

    /// With --only: write the faults of this sequence to a TOML file
    #[arg(long, value_name = "FILE", requires = "only")]
    save: Option<PathBuf>,

    /// With --only: write the report and the trace of this sequence to this folder, as of a run
    #[arg(long, value_name = "DIR", requires = "only")]
    out: Option<PathBuf>,

    /// Write {seeds, violations, simulated_s, wall_s, ratio, cpu_s, digest, groups} to this file
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,

    /// Run these sequences and end: what the campaign starts
    #[arg(long, hide = true, num_args = 2, value_names = ["FROM", "TO"])]
    chunk: Option<Vec<u64>>,
}

const EXAMPLES: &str = "\
Core 0 of both systems, its state store and the vehicle's gate are the real ones. Cores 1 and 2 only
count cycles; with --closed-loop they drive a vehicle. A sequence is judged while it runs and after
everything works again: gap, terms, role, flash; lane, distance and collisions.

  tandem sim --seeds 2000                      random sequences of up to eight faults
  tandem sim --group single                    each fault at 20 moments, with its bound
  tandem sim --only random:137 --save my.toml  one of them as a story, and as a file to change
  tandem sim --faults my.toml --seeds 20       that file
  tandem sim --group swarm --time typical      each seed chooses kinds of faults; things take time
  tandem sim --group swarm --closed-loop       all cores, and a vehicle behind another one
  tandem sim --seeds 1000 --from 1000          the next thousand, as on another machine
  tandem sim --merge a.json b.json             both thousands as one

Exit status: 0 if no sequence violates what must be so, 1 if one does, 2 if an argument or a file is
wrong.";

/// Sequences by number.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum Kind {
    Single,
    Pair,
    Random,
    Swarm,
}

/// The model of time.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum Takes {
    Ideal,
    Typical,
    Worst,
}

impl Takes {
    const fn time(self) -> Time {
        match self {
            Self::Ideal => Time::Ideal,
            Self::Typical => Time::Typical,
            Self::Worst => Time::Worst,
        }
    }
}

impl SimArgs {
    fn profile(&self) -> Profile {
        Profile {
            limits: self.timing.limits(),
            time: self.time.time(),
            around: if self.closed_loop {
                Around::ClosedLoop
            } else {
                Around::Core0
            },
        }
    }

    /// The arguments with which another process has the same profile.
    fn profile_arguments(&self) -> Vec<String> {
        let mut words = vec!["--timing".to_owned(), name_of(self.timing)];
        words.extend(["--time".to_owned(), name_of(self.time)]);
        words.extend(self.closed_loop.then(|| "--closed-loop".to_owned()));
        words
    }
}

impl Kind {
    const fn group(self) -> Group {
        match self {
            Self::Single => Group::Single,
            Self::Pair => Group::Pair,
            Self::Random => Group::Random,
            Self::Swarm => Group::Swarm,
        }
    }
}

/// Limits of the redundancy.
#[derive(Clone, Copy, Debug, ValueEnum)]
pub(crate) enum Timing {
    Chip,
    Rt,
    Desktop,
}

impl Timing {
    const fn limits(self) -> Config {
        match self {
            Self::Chip => Config::chip(),
            Self::Rt => Config::rt(),
            Self::Desktop => Config::desktop(),
        }
    }
}

/// The name of a value on the command line.
fn name_of(value: impl ValueEnum) -> String {
    let value = value.to_possible_value();
    value.map_or_else(String::new, |value| value.get_name().to_owned())
}

/// Sequences that belong together.
enum Source<'a> {
    Numbered(Kind),
    File { path: &'a Path, text: String },
}

impl Source<'_> {
    fn name(&self) -> String {
        match self {
            Self::Numbered(kind) => name_of(*kind),
            Self::File { path, .. } => path.display().to_string(),
        }
    }

    fn sequence(&self, number: u64) -> Result<Sequence> {
        match self {
            Self::Numbered(kind) => {
                let group = kind.group();
                if group.count().is_some_and(|count| number >= count) {
                    bail!("{}: there is no number {number}", name_of(*kind));
                }
                Ok(group.sequence(number))
            }
            Self::File { path, text } => {
                let sequence = Sequence::from_toml(text, number)
                    .with_context(|| path.display().to_string())?;
                let not_here = |it: &&Fault| !it.kind.is_for_simulator();
                if let Some(fault) = sequence.faults.iter().find(not_here) {
                    let (path, what) = (path.display(), fault.kind.label());
                    bail!("{path}: {what}: only processes suffer it, see `tandem chaos`");
                }
                Ok(sequence)
            }
        }
    }

    /// The first number, the one after the last, and the step.
    fn numbers(&self, arguments: &SimArgs) -> Result<(u64, u64, u64)> {
        let count = match self {
            Self::Numbered(kind) => kind.group().count(),
            Self::File { .. } => None,
        };
        if let Some(count) = count {
            return Ok((0, count, arguments.every.get()));
        }
        let to = arguments.from.checked_add(arguments.seeds);
        Ok((
            arguments.from,
            to.context("--from and --seeds are too large")?,
            1,
        ))
    }

    /// The arguments by which another process finds the same sequences.
    fn arguments(&self) -> [String; 2] {
        match self {
            Self::Numbered(kind) => ["--group".to_owned(), name_of(*kind)],
            Self::File { path, .. } => ["--faults".to_owned(), path.display().to_string()],
        }
    }

    /// The command that tells one of them.
    fn repeats(&self, number: u64, arguments: &SimArgs) -> String {
        let which = match self {
            Self::Numbered(kind) => {
                vec!["--only".to_owned(), format!("{}:{number}", name_of(*kind))]
            }
            Self::File { .. } => {
                let mut words = self.arguments().to_vec();
                words.extend(["--only".to_owned(), number.to_string()]);
                words
            }
        };
        let profile = arguments.profile_arguments();
        format!("tandem sim {} {}", which.join(" "), profile.join(" "))
    }
}

/// Runs the command.
pub(crate) fn run(arguments: &SimArgs) -> Result<(), Failure> {
    let sources = sources(arguments).map_err(Failure::Usage)?;
    if let Some(one) = &arguments.only {
        return tell(one, &sources, arguments);
    }
    if let (Some(chunk), [source]) = (&arguments.chunk, &sources[..]) {
        return run_chunk(source, chunk, arguments).map_err(Failure::Run);
    }
    let [place] = OutputFile::check_all([("--json", arguments.json.as_deref())])
        .map_err(|error| Failure::Usage(error.into()))?;
    if !arguments.merge.is_empty() {
        return merge::run(&arguments.merge, place);
    }
    let begin = Instant::now();
    let mut cpu_s = 0.0;
    let mut all = Summary::default();
    let mut groups = serde_json::Map::new();
    for source in &sources {
        let (outcomes, cpu) = campaign(source, arguments).map_err(Failure::Run)?;
        cpu_s += cpu.as_secs_f64();
        let (text, summary) = report::of(source, &outcomes, arguments).map_err(Failure::Run)?;
        print(&text).map_err(Failure::Run)?;
        groups.insert(source.name(), summary.json());
        all.add(&summary);
    }
    let (wall_s, simulated_s) = (
        begin.elapsed().as_secs_f64(),
        all.simulated_ns as f64 * 1e-9,
    );
    let totals = merge::Totals {
        seeds: all.sequences,
        violations: all.violated,
        simulated_s,
        wall_s,
        cpu_s,
        digest: all.digest,
    };
    print(&format!(
        "{}{totals}\n",
        all.covered.text(arguments.coverage)
    ))
    .map_err(Failure::Run)?;
    if let Some(place) = place {
        let figures = totals.json(groups, &ranges(&sources, arguments).map_err(Failure::Run)?);
        let written = place.write(&format!("{figures:#}\n"));
        written.map_err(|error| Failure::Run(error.into()))?;
    }
    if all.violated > 0 {
        let objection = format!("{} sequences violate what must be so", all.violated);
        return Err(Failure::Objections(vec![objection]));
    }
    Ok(())
}

/// Which numbers of which sequences were tried.
fn ranges(sources: &[Source<'_>], arguments: &SimArgs) -> Result<Vec<merge::Range>> {
    let range = |source: &Source<'_>| {
        let (from, to, step) = source.numbers(arguments)?;
        let mut name = source.name();
        for setting in [name_of(arguments.timing), name_of(arguments.time)] {
            name = format!("{name} {setting}");
        }
        if arguments.closed_loop {
            name.push_str(" closed-loop");
        }
        Ok(merge::Range {
            name,
            from,
            to,
            step,
        })
    };
    sources.iter().map(range).collect()
}

fn sources(arguments: &SimArgs) -> Result<Vec<Source<'_>>> {
    let Some(path) = &arguments.faults else {
        return Ok(arguments
            .group
            .iter()
            .map(|kind| Source::Numbered(*kind))
            .collect());
    };
    let text = fs::read_to_string(path).with_context(|| path.display().to_string())?;
    let source = Source::File { path, text };
    source.sequence(0)?;
    Ok(vec![source])
}

/// Tells what happens in one sequence.
fn tell(one: &str, sources: &[Source<'_>], arguments: &SimArgs) -> Result<(), Failure> {
    let find = || -> Result<Sequence> {
        if let [file @ Source::File { .. }] = sources {
            return file.sequence(one.parse().context("--only: the seed, a number")?);
        }
        let (group, number) = one.split_once(':').context("--only GROUP:NUMBER")?;
        let Ok(kind) = Kind::from_str(group, true) else {
            bail!("the groups are single, pair, random and swarm, not {group}");
        };
        Source::Numbered(kind).sequence(number.parse().context("--only: a number")?)
    };
    let sequence = find().map_err(Failure::Usage)?;
    if let Some(path) = &arguments.save {
        let place = OutputFile::check("--save", path);
        let place = place.map_err(|error| Failure::Usage(error.into()))?;
        let text = sequence.to_toml();
        let text = text.map_err(|error| Failure::Run(error.into()))?;
        place
            .write(&text)
            .map_err(|error| Failure::Run(error.into()))?;
    }
    let out = arguments
        .out
        .as_deref()
        .map(ReportFolder::check)
        .transpose();
    let out = out.map_err(Failure::Usage)?;
    let (verdict, mut bench) = sequence.run(arguments.profile(), true);
    let mut text = format!("{sequence}\n");
    if let Some(out) = &out {
        let written = recording::write(&mut bench, out, arguments.profile());
        written.map_err(Failure::Run)?;
    }
    for line in bench.story() {
        text.push_str(&line);
        text.push('\n');
    }
    if let Some((row, bound)) = sequence.bound(&bench.config.redundancy) {
        let bound = bound + bench.time.allowance();
        text.push_str(&format!("bound {:.1} ms ({row:?})\n", bound.as_ms_f64()));
    }
    text.push_str(&format!("{verdict}, digest {:016x}\n", verdict.digest));
    print(&text).map_err(Failure::Run)?;
    let new: Vec<String> = verdict
        .violations
        .iter()
        .filter(|violation| sequence.known(**violation).is_none())
        .map(|violation| format!("{violation:?}"))
        .collect();
    if new.is_empty() {
        Ok(())
    } else {
        Err(Failure::Objections(new))
    }
}

/// What another process of the campaign does: a line for each sequence.
fn run_chunk(source: &Source<'_>, chunk: &[u64], arguments: &SimArgs) -> Result<()> {
    let (.., step) = source.numbers(arguments)?;
    for number in (chunk[0]..chunk[1]).step_by(usize::try_from(step)?) {
        let verdict = source.sequence(number)?.try_run(arguments.profile());
        print(&format!("{}\n", Outcome::new(number, verdict).line()))?;
    }
    let cpu = clock_gettime(ClockId::ProcessCPUTime);
    print(&format!("cpu {} {}\n", cpu.tv_sec, cpu.tv_nsec))
}

/// Runs the sequences in processes, some at a time.
/// Also returns the processors' time.
fn campaign(source: &Source<'_>, arguments: &SimArgs) -> Result<(Vec<Outcome>, Duration)> {
    let (from, to, step) = source.numbers(arguments)?;
    let chunk = CHUNK * step;
    let cpus = thread::available_parallelism();
    let chunks = usize::try_from((to - from).div_ceil(chunk)).unwrap_or(usize::MAX);
    let jobs = arguments
        .jobs
        .or(cpus.ok())
        .map_or(1, NonZero::get)
        .min(chunks);
    let bar = ProgressBar::new((to - from).div_ceil(step));
    let style = "{bar:24.cyan/dim} {pos} of {len} sequences, {per_sec}, {eta} left {msg}";
    bar.set_style(ProgressStyle::with_template(style)?);
    bar.enable_steady_tick(Duration::from_millis(200));
    let (next, done) = (Mutex::new(from), Mutex::new(Vec::new()));
    let spent = Mutex::new(Duration::ZERO);
    let work = || -> Result<()> {
        loop {
            let first = {
                let mut next = lock(&next);
                let first = *next;
                *next = first.saturating_add(chunk).min(to);
                first
            };
            if first >= to {
                return Ok(());
            }
            let until = first.saturating_add(chunk).min(to);
            let (outcomes, cpu) = run_in_process(source, [first, until], arguments)?;
            bar.inc(outcomes.len() as u64);
            lock(&done).extend(outcomes);
            *lock(&spent) += cpu;
        }
    };
    thread::scope(|scope| {
        let workers: Vec<_> = (0..jobs).map(|_| scope.spawn(work)).collect();
        workers
            .into_iter()
            .try_for_each(|worker| match worker.join() {
                Ok(result) => result,
                Err(_) => bail!("a worker panicked"),
            })
    })?;
    bar.finish_and_clear();
    let mut outcomes = core::mem::take(&mut *lock(&done));
    outcomes.sort_by_key(|outcome| outcome.number);
    let spent = *lock(&spent);
    Ok((outcomes, spent))
}

fn run_in_process(
    source: &Source<'_>,
    [from, to]: [u64; 2],
    arguments: &SimArgs,
) -> Result<(Vec<Outcome>, Duration)> {
    let output = Command::new(std::env::current_exe()?)
        .arg("sim")
        .args(source.arguments())
        .args(arguments.profile_arguments())
        .args(["--every", &arguments.every.to_string()])
        .args(["--chunk", &from.to_string(), &to.to_string()])
        .output()?;
    if !output.status.success() {
        let said = String::from_utf8_lossy(&output.stderr);
        bail!(
            "sequences {from} to {to} ended with {}: {said}",
            output.status
        );
    }
    let text = String::from_utf8(output.stdout)?;
    let outcomes: Vec<Outcome> = text.lines().filter_map(Outcome::of).collect();
    let (.., step) = source.numbers(arguments)?;
    if outcomes.len() as u64 != (to - from).div_ceil(step) {
        bail!(
            "sequences {from} to {to}: only {} were told",
            outcomes.len()
        );
    }
    Ok((outcomes, text.lines().find_map(cpu_of).unwrap_or_default()))
}

/// The processor's time that a process tells.
fn cpu_of(line: &str) -> Option<Duration> {
    let (s, ns) = line.strip_prefix("cpu ")?.split_once(' ')?;
    Some(Duration::new(s.parse().ok()?, ns.parse().ok()?))
}

fn lock<T>(mutex: &Mutex<T>) -> std::sync::MutexGuard<'_, T> {
    mutex
        .lock()
        .unwrap_or_else(std::sync::PoisonError::into_inner)
}
