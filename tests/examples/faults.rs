//! Tries faults on the control core in virtual time: `cargo xtask campaign faults`.
#![forbid(unsafe_code)]
#![allow(
    clippy::print_stdout,
    clippy::print_stderr,
    reason = "a command line prints"
)]

use anyhow::{Context, Result, bail};
use clap::{Parser, ValueEnum};
use serde_json::json;
use std::collections::{BTreeMap, BTreeSet};
use std::num::NonZero;
use std::path::PathBuf;
use std::process::{Command, ExitCode};
use std::sync::Mutex;
use std::thread;
use std::time::Instant;
use tandem_redundancy::Config;
use tandem_tests::faults::{Group, PHASES, Sequence, Violation};

/// Sequences that one process runs: each leaks the boards of its cores.
const CHUNK: u64 = 200;

#[derive(Parser)]
#[command(about = "Tries faults on the control core in virtual time")]
struct Arguments {
    /// How many random sequences
    #[arg(long, default_value_t = 100_000)]
    count: u64,
    /// The first random sequence; each further one has the next number
    #[arg(long, default_value_t = 0, value_name = "SEED")]
    from: u64,
    /// Only these sequences; may be repeated
    #[arg(long, value_enum)]
    group: Vec<Kind>,
    /// Of single faults and pairs, every N-th only
    #[arg(long, default_value_t = 1, value_name = "N")]
    every: u64,
    /// Tell the story of one sequence, as single:137
    #[arg(long, value_name = "GROUP:NUMBER")]
    only: Option<String>,
    /// Limits of the redundancy
    #[arg(long, value_enum, default_value = "rt")]
    timing: Timing,
    /// Write the figures to this file
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
    /// Run these and end: what the campaign starts
    #[arg(long, hide = true, num_args = 2, value_names = ["FROM", "TO"])]
    chunk: Option<Vec<u64>>,
}

#[derive(Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Kind {
    Single,
    Pair,
    Random,
}

impl Kind {
    const fn group(self) -> Group {
        match self {
            Self::Single => Group::Single,
            Self::Pair => Group::Pair,
            Self::Random => Group::Random,
        }
    }

    fn name(self) -> String {
        self.to_possible_value()
            .map_or_else(String::new, |value| value.get_name().to_owned())
    }
}

#[derive(Clone, Copy, ValueEnum)]
enum Timing {
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

/// What the campaign needs of one sequence.
#[derive(Clone, Debug)]
struct Outcome {
    number: u64,
    gap_ns: u64,
    suspended: u64,
    violations: Vec<Violation>,
}

impl Outcome {
    fn line(&self) -> String {
        let Self {
            number,
            gap_ns,
            suspended,
            violations,
        } = self;
        let codes: Vec<String> = Violation::ALL
            .iter()
            .enumerate()
            .filter(|(_, violation)| violations.contains(violation))
            .map(|(code, _)| code.to_string())
            .collect();
        format!("= {number} {gap_ns} {suspended} {}", codes.join(" "))
    }

    fn of(line: &str) -> Option<Self> {
        let mut words = line.strip_prefix("= ")?.split_whitespace();
        let mut number = || words.next()?.parse().ok();
        Some(Self {
            number: number()?,
            gap_ns: number()?,
            suspended: number()?,
            violations: words
                .map(|word| Violation::ALL.get(word.parse::<usize>().ok()?).copied())
                .collect::<Option<_>>()?,
        })
    }
}

fn main() -> Result<ExitCode> {
    let arguments = Arguments::parse();
    if let Some(one) = &arguments.only {
        return tell(one, arguments.timing);
    }
    if let (Some(chunk), [kind]) = (&arguments.chunk, &arguments.group[..]) {
        run_chunk(*kind, chunk, &arguments);
        return Ok(ExitCode::SUCCESS);
    }
    let groups = match &arguments.group[..] {
        [] => vec![Kind::Single, Kind::Pair, Kind::Random],
        some => some.to_vec(),
    };
    let begin = Instant::now();
    let mut figures = serde_json::Map::new();
    let mut violated = 0;
    for kind in groups {
        let outcomes = campaign(kind, &arguments)?;
        violated += report(kind, &outcomes, &arguments, &mut figures);
    }
    println!("{:.0} s", begin.elapsed().as_secs_f64());
    if let Some(path) = &arguments.json {
        std::fs::write(path, serde_json::to_string_pretty(&figures)?)
            .with_context(|| path.display().to_string())?;
    }
    Ok(ExitCode::from(u8::from(violated > 0)))
}

/// Tells what happens in one sequence.
fn tell(one: &str, timing: Timing) -> Result<ExitCode> {
    let (group, number) = one.split_once(':').context("GROUP:NUMBER")?;
    let Ok(kind) = Kind::from_str(group, true) else {
        bail!("the groups are single, pair and random, not {group}");
    };
    let sequence = kind.group().sequence(number.parse()?);
    println!("{sequence}");
    let (verdict, mut bench) = sequence.run(timing.limits(), true);
    bench.story().iter().for_each(|line| println!("{line}"));
    if let Some((row, bound)) = sequence.bound(&bench.config.redundancy) {
        println!("bound {:.1} ms ({row:?})", bound.as_ms_f64());
    }
    println!("{verdict}");
    Ok(ExitCode::from(u8::from(!verdict.violations.is_empty())))
}

fn run_chunk(kind: Kind, chunk: &[u64], arguments: &Arguments) {
    let step = if kind == Kind::Random {
        1
    } else {
        arguments.every as usize
    };
    for number in (chunk[0]..chunk[1]).step_by(step) {
        let verdict = kind
            .group()
            .sequence(number)
            .try_run(arguments.timing.limits());
        let outcome = Outcome {
            number,
            gap_ns: verdict.gap.as_ns(),
            suspended: verdict.suspended as u64,
            violations: verdict.violations,
        };
        println!("{}", outcome.line());
    }
}

/// Runs the sequences of a group on all processors.
fn campaign(kind: Kind, arguments: &Arguments) -> Result<Vec<Outcome>> {
    let (from, to) = match kind.group().count() {
        Some(count) => (0, count),
        None => (arguments.from, arguments.from + arguments.count),
    };
    let chunk = CHUNK
        * if kind == Kind::Random {
            1
        } else {
            arguments.every
        };
    let next = Mutex::new(from);
    let done = Mutex::new(Vec::new());
    let begin = Instant::now();
    let workers = thread::available_parallelism().map_or(1, NonZero::get);
    let work = || -> Result<()> {
        loop {
            let first = {
                let mut next = lock(&next);
                let first = *next;
                *next = (first + chunk).min(to);
                first
            };
            if first >= to {
                return Ok(());
            }
            let outcomes = run_in_process(kind, [first, (first + chunk).min(to)], arguments)?;
            let mut done = lock(&done);
            done.extend(outcomes);
            let bad = done
                .iter()
                .filter(|it: &&Outcome| !it.violations.is_empty());
            eprint!(
                "\r{}: {} of {} sequences, {} violated, {:.0} s ",
                kind.name(),
                done.len(),
                (to - from).div_ceil(chunk / CHUNK),
                bad.count(),
                begin.elapsed().as_secs_f64()
            );
        }
    };
    thread::scope(|scope| {
        let workers: Vec<_> = (0..workers).map(|_| scope.spawn(work)).collect();
        workers
            .into_iter()
            .try_for_each(|worker| match worker.join() {
                Ok(result) => result,
                Err(_) => bail!("a worker panicked"),
            })
    })?;
    eprintln!();
    let mut outcomes = core::mem::take(&mut *lock(&done));
    outcomes.sort_by_key(|outcome| outcome.number);
    Ok(outcomes)
}

fn run_in_process(kind: Kind, [from, to]: [u64; 2], arguments: &Arguments) -> Result<Vec<Outcome>> {
    let timing = arguments.timing.to_possible_value();
    let timing = timing.map_or_else(String::new, |value| value.get_name().to_owned());
    let output = Command::new(std::env::current_exe()?)
        .args(["--group", &kind.name(), "--timing", &timing])
        .args(["--every", &arguments.every.to_string()])
        .args(["--chunk", &from.to_string(), &to.to_string()])
        .output()?;
    if !output.status.success() {
        bail!("sequences {from} to {to} ended with {}", output.status);
    }
    let text = String::from_utf8(output.stdout)?;
    Ok(text.lines().filter_map(Outcome::of).collect())
}

fn lock<T>(mutex: &Mutex<T>) -> std::sync::MutexGuard<'_, T> {
    mutex
        .lock()
        .unwrap_or_else(std::sync::PoisonError::into_inner)
}

/// Classes of a violation that are printed, and sequences that are shrunk to find them.
const CLASSES: usize = 12;
const SHRUNK: usize = 40;

/// Prints what became of a group; how many sequences violate what is not known to be violated.
fn report(
    kind: Kind,
    outcomes: &[Outcome],
    arguments: &Arguments,
    figures: &mut serde_json::Map<String, serde_json::Value>,
) -> usize {
    let limits = arguments.timing.limits();
    if kind == Kind::Single {
        table(outcomes, &limits);
    }
    let suspended = outcomes.iter().filter(|it| it.suspended > 0).count();
    let name = kind.name();
    let (mut counts, mut known) = (BTreeMap::new(), BTreeMap::new());
    let mut bad = BTreeSet::new();
    for violation in Violation::ALL {
        let mut new = Vec::new();
        for outcome in outcomes
            .iter()
            .filter(|it| it.violations.contains(&violation))
        {
            let sequence = kind.group().sequence(outcome.number);
            match sequence.known(violation) {
                Some(why) => *known.entry(why).or_insert(0) += 1,
                None => new.push(sequence),
            }
        }
        if !new.is_empty() {
            println!("{name}: {violation:?} {}", new.len());
            print_classes(&name, violation, &new, limits);
            counts.insert(format!("{violation:?}"), new.len());
            bad.extend(new.iter().map(|sequence| sequence.number));
        }
    }
    println!(
        "{name}: {} sequences, {} violated, {suspended} end with a suspended system",
        outcomes.len(),
        bad.len()
    );
    for (why, count) in &known {
        println!("  known: {count} for {why}");
    }
    let gap_ns = outcomes.iter().map(|outcome| outcome.gap_ns).max();
    figures.insert(
        name,
        json!({
            "sequences": outcomes.len(), "violated": bad.len(), "suspended": suspended,
            "violations": counts, "known": known,
            "gap_max_ms": gap_ns.unwrap_or(0) as f64 * 1e-6,
        }),
    );
    bad.len()
}

/// Prints which faults lead to a violation, the most frequent first, with a line to repeat each.
fn print_classes(name: &str, violation: Violation, sequences: &[Sequence], limits: Config) {
    let mut classes: BTreeMap<String, Vec<u64>> = BTreeMap::new();
    for (index, sequence) in sequences.iter().enumerate() {
        let kinds = match sequence.group {
            Group::Random if index >= SHRUNK => continue,
            Group::Random => sequence.shrunk(limits, violation).kinds(),
            Group::Single | Group::Pair => sequence.kinds(),
        };
        classes.entry(kinds).or_default().push(sequence.number);
    }
    let mut classes: Vec<_> = classes.into_iter().collect();
    classes.sort_by_key(|(_, numbers)| std::cmp::Reverse(numbers.len()));
    for (kinds, numbers) in classes.iter().take(CLASSES) {
        let (count, first) = (numbers.len(), numbers[0]);
        println!("  {count:5} {kinds}: cargo xtask campaign faults --only {name}:{first}");
    }
}

/// The bound of each single fault beside what was measured.
fn table(outcomes: &[Outcome], limits: &Config) {
    println!("| fault | row | bound ms | longest gap ms | violated |");
    println!("|---|---|---|---|---|");
    for outcomes in outcomes.chunk_by(|a, b| a.number / PHASES == b.number / PHASES) {
        let Some(first) = outcomes.first() else {
            continue;
        };
        let sequence: Sequence = Group::Single.sequence(first.number);
        let fault = &sequence.faults[0];
        let bound = sequence.bound(limits).map_or_else(
            || "| ".to_owned(),
            |(row, bound)| format!("{row:?} | {:.0}", bound.as_ms_f64()),
        );
        let gap_ns = outcomes.iter().map(|outcome| outcome.gap_ns).max();
        let gap = gap_ns.unwrap_or(0) as f64 * 1e-6;
        let violations = Violation::ALL.into_iter().filter(|violation| {
            let violates = |outcome: &Outcome| outcome.violations.contains(violation);
            outcomes.iter().any(violates)
        });
        let violations: Vec<String> = violations.map(|it| format!("{it:?}")).collect();
        let count = outcomes
            .iter()
            .filter(|it| !it.violations.is_empty())
            .count();
        let violated = match count {
            0 => String::new(),
            count => format!("{count} of {}: {}", outcomes.len(), violations.join(", ")),
        };
        let (kind, way) = (fault.kind, fault.way);
        println!("| {kind:?} {way:?} | {bound} | {gap:.1} | {violated} |");
    }
}
