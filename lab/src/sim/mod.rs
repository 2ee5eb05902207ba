//! `tandem sim`: injects faults into the control cores of both systems, in virtual time.

mod coverage;
mod merge;
mod outcome;
pub(crate) mod recording;
mod report;

use std::num::NonZero;
use std::path::PathBuf;
use std::process::Command;
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, bail};
use clap::Args;
use clap::builder::{PossibleValuesParser, TypedValueParser};
use rustix::time::{ClockId, clock_gettime};
use tandem_faults::{Group, Sequence, Site, known};
use tandem_page::json::JsonOption;
use tandem_page::output::OutputFile;
use tandem_redundancy::Config;
use tandem_sim::timing::Time;
use tandem_sim::{Around, Profile};

use crate::fault_file::FaultFile;
use crate::work;
use outcome::Outcome;
use report::Summary;
use tandem::failure::Failure;
use tandem::output::ReportFolder;
use tandem::print;

/// Number of sequences in one process. Each reset of a core leaves its board in memory.
const CHUNK: u64 = 100;

/// Arguments of `tandem sim`.
#[derive(Debug, Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct SimArgs {
    /// How many random sequences of faults, or how many seeds for --faults
    #[arg(long, value_name = "N", default_value_t = 1_000,
          value_parser = clap::value_parser!(u64).range(1..))]
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
    /// system, random ones, or each wrong value
    #[arg(long, value_parser = named(Group::ALL, Group::name), default_value = "random")]
    group: Vec<Group>,

    /// Of single faults and pairs, try only every N-th
    #[arg(long, value_name = "N", default_value_t = NonZero::<u64>::MIN)]
    every: NonZero<u64>,

    /// Limits of the redundancy
    #[arg(long, value_parser = named(timings(), |it| it.0), default_value = "rt")]
    timing: (&'static str, Config),

    /// Durations of jobs, frames and edges: none, typical ones, or the longest measured ones
    #[arg(long, value_parser = named(Time::ALL, Time::name), default_value = "ideal")]
    time: Time,

    /// Run cores 1 and 2 as well, and a vehicle in its lane behind another one
    #[arg(long)]
    closed_loop: bool,

    /// Print the table of faults and the states that they hit
    #[arg(long)]
    coverage: bool,

    /// Add up the --json files of other runs, and exit
    #[arg(long, value_name = "FILE", num_args = 1.., conflicts_with_all = ["faults", "only"])]
    merge: Vec<PathBuf>,

    /// Print the events of one sequence, such as random:137; with --faults, give only the seed
    #[arg(long, value_name = "GROUP:NUMBER", conflicts_with = "json")]
    only: Option<String>,

    /// With --only: write the faults of this sequence to a TOML file
    #[arg(long, value_name = "FILE", requires = "only")]
    save: Option<PathBuf>,

    /// With --only: write the report and the trace of this sequence to this folder, as for a run
    #[arg(long, value_name = "DIR", requires = "only")]
    out: Option<PathBuf>,

    #[command(flatten)]
    json: JsonOption,

    /// Run these sequences and exit; internal, started by the campaign
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
  tandem sim --group values --closed-loop      each wrong value of each core, 60 s each
  tandem sim --seeds 1000 --from 1000          the next thousand, as on another machine
  tandem sim --merge a.json b.json             both thousands as one";

/// Returns the limits of the redundancy, by the names of their profiles.
const fn timings() -> [(&'static str, Config); 3] {
    [
        ("chip", Config::chip()),
        ("rt", Config::rt()),
        ("desktop", Config::desktop()),
    ]
}

/// Returns a parser for an option whose values are these, by their names.
fn named<T, const N: usize>(
    all: [T; N],
    name: fn(T) -> &'static str,
) -> impl TypedValueParser<Value = T>
where
    T: Copy + Send + Sync + 'static,
{
    let of_name = move |given: String| all.into_iter().find(|it| name(*it) == given);
    PossibleValuesParser::new(all.map(name)).try_map(move |given| {
        of_name(given)
            .context("no such value")
            .map_err(anyhow::Error::into_boxed_dyn_error)
    })
}

impl SimArgs {
    fn profile(&self) -> Profile {
        Profile {
            time: self.time,
            around: if self.closed_loop {
                Around::CLOSED_LOOP
            } else {
                Around::Core0
            },
            ..self.timing.1.into()
        }
    }

    /// Returns the arguments that give another process the same profile.
    fn profile_arguments(&self) -> Vec<String> {
        let words = ["--timing", self.timing.0, "--time", self.time.name()];
        let closed_loop = self.closed_loop.then_some("--closed-loop");
        words
            .into_iter()
            .chain(closed_loop)
            .map(str::to_owned)
            .collect()
    }
}

/// The source of a campaign's sequences.
enum Source {
    Numbered(Group),
    File(FaultFile),
}

impl Source {
    fn name(&self) -> String {
        match self {
            Self::Numbered(group) => group.name().to_owned(),
            Self::File(file) => file.name(),
        }
    }

    fn sequence(&self, number: u64) -> Result<Sequence> {
        match self {
            Self::Numbered(group) => {
                if group.count().is_some_and(|count| number >= count) {
                    bail!("{}: there is no number {number}", group.name());
                }
                Ok(group.sequence(number))
            }
            Self::File(file) => file.sequence(number),
        }
    }

    /// Returns the first number, the number after the last, and the step.
    fn numbers(&self, arguments: &SimArgs) -> Result<(u64, u64, u64)> {
        let count = match self {
            Self::Numbered(group) => group.count(),
            Self::File(_) => None,
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

    /// Returns the arguments with which another process creates the same sequences.
    fn arguments(&self) -> [String; 2] {
        let option = match self {
            Self::Numbered(_) => "--group",
            Self::File(_) => "--faults",
        };
        [option.to_owned(), self.name()]
    }

    /// Returns the command that prints the events of the sequence with this number.
    fn repeats(&self, number: u64, arguments: &SimArgs) -> String {
        let which = match self {
            Self::Numbered(group) => format!("--only {}:{number}", group.name()),
            Self::File(file) => format!("--faults {} --only {number}", file.name()),
        };
        let profile = arguments.profile_arguments().join(" ");
        format!("tandem sim {which} {profile}")
    }
}

/// Runs the command.
pub(crate) fn run(arguments: &SimArgs) -> Result<(), Failure> {
    let sources = sources(arguments).map_err(Failure::Usage)?;
    let of_values = |source: &Source| matches!(source, Source::Numbered(Group::Values));
    if sources.iter().any(of_values) && !arguments.closed_loop {
        let what = "wrong values need a vehicle: add --closed-loop";
        return Err(Failure::Usage(anyhow::anyhow!(what)));
    }
    if let Some(one) = &arguments.only {
        return story(one, &sources, arguments);
    }
    if let (Some(chunk), [source]) = (&arguments.chunk, &sources[..]) {
        return run_chunk(source, chunk, arguments).map_err(Failure::Run);
    }
    let place = arguments.json.check().map_err(Failure::usage)?;
    if !arguments.merge.is_empty() {
        return merge::run(&arguments.merge, place);
    }
    let is_quiet = place.takes_stdout();
    let say = |text: &str| if is_quiet { Ok(()) } else { print(text) };
    let begin = Instant::now();
    let mut cpu_s = 0.0;
    let mut all = Summary::default();
    let mut groups = serde_json::Map::new();
    for source in &sources {
        let (outcomes, cpu) = campaign(source, arguments)?;
        cpu_s += cpu.as_secs_f64();
        let (text, summary) = report::of(source, &outcomes, arguments)?;
        say(&text)?;
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
    let figures = totals.json(groups, &ranges(&sources, arguments)?);
    let covered = || format!("{}{totals}\n", all.covered.text(arguments.coverage));
    print(&place.write(&figures, covered)?)?;
    if all.violated > 0 {
        let objection = format!("{} sequences violate what must be so", all.violated);
        return Err(Failure::Objections(vec![objection]));
    }
    Ok(())
}

/// Returns the ranges of numbers that were tried, by source.
fn ranges(sources: &[Source], arguments: &SimArgs) -> Result<Vec<merge::Range>> {
    let range = |source: &Source| {
        let (from, to, step) = source.numbers(arguments)?;
        let (timing, time) = (arguments.timing.0, arguments.time.name());
        let mut name = format!("{} {timing} {time}", source.name());
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

fn sources(arguments: &SimArgs) -> Result<Vec<Source>> {
    Ok(match &arguments.faults {
        Some(path) => vec![Source::File(FaultFile::read(path, Site::Simulator)?)],
        None => arguments
            .group
            .iter()
            .copied()
            .map(Source::Numbered)
            .collect(),
    })
}

/// Prints the events of one sequence, in order.
fn story(one: &str, sources: &[Source], arguments: &SimArgs) -> Result<(), Failure> {
    let find = || -> Result<Sequence> {
        if let [file @ Source::File(_)] = sources {
            return file.sequence(one.parse().context("--only: the seed, a number")?);
        }
        let (group, number) = one.split_once(':').context("--only GROUP:NUMBER")?;
        let Some(group) = Group::of_name(group) else {
            bail!("the groups are single, pair, random, swarm and values, not {group}");
        };
        Source::Numbered(group).sequence(number.parse().context("--only: a number")?)
    };
    let sequence = find().map_err(Failure::Usage)?;
    if let Some(path) = &arguments.save {
        let place = OutputFile::check("--save", path).map_err(Failure::usage)?;
        place.write(&sequence.to_toml()?)?;
    }
    let out = arguments
        .out
        .as_deref()
        .map(ReportFolder::check)
        .transpose();
    let out = out.map_err(Failure::Usage)?;
    let profile = arguments.profile();
    let (trial, mut bench) = profile.run(&sequence, true);
    let mut text = format!("{sequence}\n");
    if let Some(out) = &out {
        recording::write(&mut bench, out, profile)?;
    }
    for line in bench.story() {
        text.push_str(&line);
        text.push('\n');
    }
    if let Some((loss, bound)) = sequence.bound(&profile.bounds()) {
        let bound = bound + profile.time.allowance();
        text.push_str(&format!("bound {:.1} ms ({loss:?})\n", bound.as_ms_f64()));
    }
    text.push_str(&format!("{trial}, digest {:016x}\n", trial.digest));
    print(&text)?;
    let new = trial.violations.iter();
    let new = new.filter(|rule| known(&sequence, **rule, trial.aside_m).is_none());
    let new: Vec<String> = new.map(|rule| format!("{rule:?}")).collect();
    if new.is_empty() {
        Ok(())
    } else {
        Err(Failure::Objections(new))
    }
}

/// Runs a part of a campaign in this process, and prints a line for each sequence.
fn run_chunk(source: &Source, chunk: &[u64], arguments: &SimArgs) -> Result<()> {
    let (.., step) = source.numbers(arguments)?;
    for number in (chunk[0]..chunk[1]).step_by(usize::try_from(step)?) {
        let trial = arguments.profile().try_run(&source.sequence(number)?);
        print(&Outcome::new(number, trial).line()?)?;
    }
    let cpu = clock_gettime(ClockId::ProcessCPUTime);
    print(&format!("cpu {} {}\n", cpu.tv_sec, cpu.tv_nsec))
}

/// Runs the sequences in several processes in parallel. Also returns their CPU time.
fn campaign(source: &Source, arguments: &SimArgs) -> Result<(Vec<Outcome>, Duration)> {
    let (from, to, step) = source.numbers(arguments)?;
    let style = "{bar:24.cyan/dim} {pos} of {len} sequences, {per_sec}, {eta} left {msg}";
    let bar = work::bar((to - from).div_ceil(step), style)?;
    let chunk = CHUNK * step;
    let firsts = (from..to).step_by(usize::try_from(chunk)?);
    let done = work::on_threads(arguments.jobs, firsts, |first| {
        let until = first.saturating_add(chunk).min(to);
        let (outcomes, cpu) = run_in_process(source, [first, until], arguments)?;
        bar.inc(outcomes.len() as u64);
        Ok((outcomes, cpu))
    })?;
    bar.finish_and_clear();
    let (outcomes, spent): (Vec<_>, Vec<Duration>) = done.into_iter().unzip();
    Ok((outcomes.concat(), spent.iter().sum()))
}

fn run_in_process(
    source: &Source,
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
            "sequences {from} to {to}: only {} were reported",
            outcomes.len()
        );
    }
    Ok((outcomes, text.lines().find_map(cpu_of).unwrap_or_default()))
}

/// Parses the CPU time in the report of a process.
fn cpu_of(line: &str) -> Option<Duration> {
    let (s, ns) = line.strip_prefix("cpu ")?.split_once(' ')?;
    Some(Duration::new(s.parse().ok()?, ns.parse().ok()?))
}
