//! Sweeps all points at which power can be lost: `cargo xtask campaign power-cuts`.
//!
//! Each life between two losses of power is a separate process, so only the flash survives it. The
//! process reads the flash from standard input and writes it to standard output.
#![forbid(unsafe_code)]
#![allow(clippy::print_stdout, reason = "a command line prints")]

use anyhow::{Context, Result, bail};
use clap::Parser;
use std::io::{Read, Write};
use std::num::NonZero;
use std::path::PathBuf;
use std::process::{Command, ExitCode, Stdio};
use std::sync::Mutex;
use std::thread;
use strum::VariantArray as _;
use tandem_boot::{Launch, Slot};
use tandem_boot_host::Tear;
use tandem_boot_host::cuts::{
    CutCase, CutScenario, LifePlan, Stage, Swept, TickRange, WiringDefect, live, sweep,
};
use tandem_boot_host::life::{End, LifeOutcome};
use tandem_boot_host::{FlashTraits, SimulatedFlash};

/// Number of parts into which the ticks of a scenario are split.
const PARTS: u64 = 8;

#[derive(Parser)]
#[command(about = "Loses power at every point of an update, and counts the bricks")]
struct Arguments {
    /// Write {points, bricks} to this file
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
    /// Cut at every N-th tick of a scenario; 1 is every byte of every operation
    #[arg(long, default_value_t = 1)]
    every: u64,
    /// Sweep a bootloader with a defect instead; bricks must appear
    #[arg(long, value_parser = ["one-slot", "one-bank"])]
    broken: Option<String>,
    /// Type of flash: one that erases to 0xFF, or one that erases to 0 and has an ECC
    #[arg(long, default_value = "plain", value_parser = ["plain", "aurix"])]
    flash: String,
    /// Run one life and exit; internal, started by the sweep
    #[arg(long, hide = true, num_args = 5, value_names = ["SCENARIO", "ACTS", "SEED", "TICK", "TEAR"])]
    life: Option<Vec<u64>>,
}

fn main() -> Result<ExitCode> {
    let arguments = Arguments::parse();
    let defect = match arguments.broken.as_deref() {
        Some("one-slot") => Some(WiringDefect::OneSlot),
        Some(_) => Some(WiringDefect::OneBank),
        None => None,
    };
    let traits = match arguments.flash.as_str() {
        "aurix" => FlashTraits::AURIX,
        _ => FlashTraits::default(),
    };
    let case = |scenario| CutCase {
        scenario,
        defect,
        traits,
    };
    if let Some(life) = &arguments.life {
        live_one(life, case)?;
        return Ok(ExitCode::SUCCESS);
    }
    // Split all scenarios into parts of similar length, to keep the processors busy.
    let parts = |scenario| (0..PARTS).map(move |part| (scenario, part));
    let jobs = Mutex::new(
        CutScenario::VARIANTS
            .iter()
            .copied()
            .flat_map(parts)
            .collect::<Vec<_>>(),
    );
    let total = Mutex::new(Swept::default());
    let workers = thread::available_parallelism().map_or(1, NonZero::get);
    thread::scope(|scope| {
        let work = || -> Result<()> {
            loop {
                let Some((scenario, part)) = lock(&jobs).pop() else {
                    return Ok(());
                };
                let ticks = TickRange {
                    from: part * arguments.every,
                    every: PARTS * arguments.every,
                };
                let swept = sweep_scenario(case(scenario), ticks)?;
                if part == 0 {
                    println!("{scenario:?} swept");
                }
                let mut total = lock(&total);
                total.points += swept.points;
                total.double += swept.double;
                total.bricks.extend(swept.bricks);
            }
        };
        let workers: Vec<_> = (0..workers).map(|_| scope.spawn(work)).collect();
        workers
            .into_iter()
            .try_for_each(|worker| match worker.join() {
                Ok(result) => result,
                Err(_) => bail!("a worker panicked"),
            })
    })?;
    let total = lock(&total).clone();
    total
        .bricks
        .iter()
        .take(20)
        .for_each(|brick| println!("brick: {brick}"));
    let (points, bricks) = (total.points, total.bricks.len());
    println!(
        "{points} points, {} of them double cuts, {bricks} bricks",
        total.double
    );
    if let Some(path) = &arguments.json {
        let json = serde_json::json!({
            "points": points, "double_cuts": total.double, "bricks": bricks,
        });
        std::fs::write(path, json.to_string()).with_context(|| path.display().to_string())?;
    }
    let expected = defect.is_some() != total.bricks.is_empty();
    Ok(if expected {
        ExitCode::SUCCESS
    } else {
        ExitCode::FAILURE
    })
}

fn lock<T>(mutex: &Mutex<T>) -> std::sync::MutexGuard<'_, T> {
    mutex
        .lock()
        .unwrap_or_else(std::sync::PoisonError::into_inner)
}

fn sweep_scenario(case: CutCase, ticks: TickRange) -> Result<Swept> {
    let stage = Stage::new(case);
    let program = std::env::current_exe()?;
    sweep(&stage, ticks, |flash, step| {
        let (tick, tear) = step.cut.unwrap_or((u64::MAX, Tear::Clean));
        let life = [
            case.scenario as u64,
            step.acts.into(),
            step.seed,
            tick,
            tear as u64,
        ];
        let mut command = Command::new(&program);
        command
            .arg("--life")
            .args(life.map(|value| value.to_string()));
        if case.traits == FlashTraits::AURIX {
            command.args(["--flash", "aurix"]);
        }
        match case.defect {
            Some(WiringDefect::OneSlot) => drop(command.args(["--broken", "one-slot"])),
            Some(WiringDefect::OneBank) => drop(command.args(["--broken", "one-bank"])),
            None => {}
        }
        let mut child = command
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()?;
        // The process reads its whole input before it writes.
        let mut stdin = child.stdin.take().context("no standard input")?;
        let lines = stage.lines().concat();
        stdin.write_all(&(lines.len() as u32).to_le_bytes())?;
        stdin.write_all(&[lines.as_bytes(), flash].concat())?;
        drop(stdin);
        let output = child.wait_with_output()?;
        if !output.status.success() {
            bail!("a life ended with {}", output.status);
        }
        let life = decode(&output.stdout).context("the output of a life cannot be decoded")?;
        let (outcome, ticks, flash) = life;
        Ok((outcome, ticks, flash.with_traits(case.traits)))
    })
}

fn live_one(life: &[u64], case: impl Fn(CutScenario) -> CutCase) -> Result<()> {
    let [scenario, acts, seed, tick, tear] = life else {
        bail!("five numbers");
    };
    let scenario = CutScenario::from_repr(*scenario as usize).context("which scenario?")?;
    let tear = Tear::VARIANTS.get(*tear as usize).context("which tear?")?;
    let mut input = Vec::new();
    std::io::stdin().read_to_end(&mut input)?;
    let (length, rest) = input.split_first_chunk::<4>().context("no length")?;
    let lines = rest.split_at_checked(u32::from_le_bytes(*length) as usize);
    let (lines, flash) = lines.context("no lines")?;
    let lines = std::str::from_utf8(lines)?.split_inclusive('\n');
    let lines: Vec<String> = lines.map(str::to_owned).collect();
    let step = LifePlan {
        acts: *acts != 0,
        seed: *seed,
        cut: (*tick != u64::MAX).then_some((*tick, *tear)),
    };
    let lived = live(case(scenario), &lines, flash, step);
    let (outcome, ticks, flash) = lived.context("no flash")?;
    std::io::stdout().write_all(&encode(&outcome, ticks, &flash))?;
    Ok(())
}

/// Encodes the result of a life for the sweep: its end, its ticks, its flash.
fn encode(outcome: &LifeOutcome, ticks: u64, flash: &SimulatedFlash) -> Vec<u8> {
    let head = match outcome.end {
        End::PowerLost => [0, 0, 0],
        End::Waiting => [1, 0, 0],
        End::Brick => [2, 0, 0],
        End::Running(launch) => [
            3,
            launch.application as u8,
            launch.configuration.map_or(2, |slot| slot as u8),
        ],
    };
    [&head[..], &ticks.to_le_bytes(), &flash.save()].concat()
}

fn decode(bytes: &[u8]) -> Option<(LifeOutcome, u64, SimulatedFlash)> {
    let ([kind, application, configuration], rest) = bytes.split_first_chunk()?;
    let (ticks, flash) = rest.split_first_chunk()?;
    let end = match kind {
        0 => End::PowerLost,
        1 => End::Waiting,
        2 => End::Brick,
        _ => End::Running(Launch {
            application: Slot::from_repr(*application)?,
            configuration: Slot::from_repr(*configuration),
            version: 0,
            entries: [None; 3],
        }),
    };
    let outcome = LifeOutcome {
        end,
        refused: None,
        downloaded: false,
    };
    Some((
        outcome,
        u64::from_le_bytes(*ticks),
        SimulatedFlash::restore(flash)?,
    ))
}
