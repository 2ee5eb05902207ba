//! A campaign: runs its drives one after the other, each in a separate process.

use std::io::{BufRead as _, BufReader, Read as _};
use std::process::{Child, Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use anyhow::{Context as _, bail};
use rustix::process::{Pid, Signal, kill_process};
use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM};

use super::pipe::Line;
use super::recording_judge::Outcome;
use super::report::Found;
use super::{Source, report};
use crate::chaos_args::ChaosArgs;
use crate::work;
use tandem::failure::Failure;
use tandem::print;

/// Number of faults in one drive. The recording of a longer drive would fill the memory.
const FAULTS_OF_A_RUN: usize = 100;

/// Injects the faults with these numbers, and prints a report.
///
/// # Errors
/// Returns the [`Failure`] whose exit status the command documents.
pub(super) fn run(source: &Source, numbers: &[u64], args: &ChaosArgs) -> Result<(), Failure> {
    let place = args.json.check().map_err(Failure::usage)?;
    let interrupted = Arc::new(AtomicBool::new(false));
    for signal in [SIGINT, SIGTERM, SIGHUP] {
        signal_hook::flag::register(signal, Arc::clone(&interrupted))
            .context("listening to signals")?;
    }
    let found = inject(source, numbers, args, &interrupted)?;
    let figures = report::json(source, &found);
    print(&place.write(&figures, || report::text(source, &found))?)?;
    let violated = report::violated(&found);
    if violated > 0 {
        let objection = format!("{violated} faults violate a rule");
        return Err(Failure::Objections(vec![objection]));
    }
    if interrupted.load(Ordering::Relaxed) {
        return Err(match found.outcomes.len() {
            0 => Failure::Interrupted,
            _ => Failure::CutShort,
        });
    }
    Ok(())
}

fn inject(
    source: &Source,
    numbers: &[u64],
    args: &ChaosArgs,
    interrupted: &AtomicBool,
) -> anyhow::Result<Found> {
    let style = "{bar:24.cyan/dim} {pos} of {len} faults, {per_sec}, {eta} left {msg}";
    let bar = work::bar(numbers.len() as u64, style)?;
    let mut found = Found::default();
    let mut left = numbers;
    while let Some(first) = left.first()
        && !interrupted.load(Ordering::Relaxed)
    {
        let part = &left[..left.len().min(FAULTS_OF_A_RUN)];
        let done = found.outcomes.len() as u64;
        let ended = one_drive(source, part, args, interrupted, &|count| {
            bar.set_position(done + count);
        });
        let (outcomes, wrong) = match ended {
            Ok(ended) => ended,
            // Report the results of the earlier drives.
            Err(error) if done > 0 => {
                found.wrong.push(format!("faults from {first}: {error:#}"));
                break;
            }
            Err(error) => return Err(error),
        };
        left = &left[outcomes.len()..];
        let repeats = source.repeats(*first);
        found
            .wrong
            .extend(wrong.into_iter().map(|it| format!("{it}: from {repeats}")));
        if outcomes.is_empty() && !interrupted.load(Ordering::Relaxed) {
            let never = "never master and standby: no fault was injected";
            found.wrong.push(format!("{never}: {repeats}"));
            break;
        }
        found.outcomes.extend(outcomes);
        let violated = report::violated(&found);
        if violated > 0 {
            bar.set_message(format!("{violated} violated"));
        }
    }
    bar.finish_and_clear();
    Ok(found)
}

/// Runs one drive to its end, in a child process.
fn one_drive(
    source: &Source,
    numbers: &[u64],
    args: &ChaosArgs,
    interrupted: &AtomicBool,
    done: &dyn Fn(u64),
) -> anyhow::Result<(Vec<Outcome>, Vec<String>)> {
    let (Some(first), Some(last)) = (numbers.first(), numbers.last()) else {
        bail!("no fault");
    };
    let mut child = Command::new(std::env::current_exe()?)
        .arg("chaos")
        .args(source.arguments())
        .args(["--drive", &first.to_string(), &(last + 1).to_string()])
        .args(args.every_arguments())
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .context("starting a run")?;
    let ended = follow(&mut child, interrupted, done);
    if !matches!(ended, Ok(Some(_))) {
        // On SIGTERM the child process ends its run.
        signal(&child, Signal::TERM);
    }
    let mut said = String::new();
    if let Some(stderr) = &mut child.stderr {
        let _ = stderr.read_to_string(&mut said);
    }
    let status = child.wait().context("a run")?;
    let said = said.trim();
    match ended? {
        Some(ended) if status.success() => {
            if !said.is_empty() {
                eprintln!("{said}");
            }
            Ok(ended)
        }
        _ => bail!("a run ended with {status}: {said}"),
    }
}

/// Reads the reports of a drive until it ends.
fn follow(
    child: &mut Child,
    interrupted: &AtomicBool,
    done: &dyn Fn(u64),
) -> anyhow::Result<Option<(Vec<Outcome>, Vec<String>)>> {
    let stdout = child.stdout.take().context("a pipe")?;
    let (lines, reported) = std::sync::mpsc::channel();
    let reader = std::thread::spawn(move || {
        for line in BufReader::new(stdout).lines().map_while(Result::ok) {
            if lines.send(line).is_err() {
                return;
            }
        }
    });
    let mut asked = false;
    let ended = loop {
        if interrupted.load(Ordering::Relaxed) && !asked {
            asked = true;
            // Ctrl-C also reaches the child. Send only one signal: a second one kills the vehicle.
            signal(child, Signal::TERM);
        }
        let line = match reported.recv_timeout(Duration::from_millis(50)) {
            Ok(line) => line,
            Err(std::sync::mpsc::RecvTimeoutError::Timeout) => continue,
            Err(std::sync::mpsc::RecvTimeoutError::Disconnected) => break None,
        };
        match serde_json::from_str(&line).with_context(|| line.clone())? {
            Line::Done(count) => done(count),
            Line::Hold(ms) => {
                signal(child, Signal::STOP);
                std::thread::sleep(Duration::from_millis(ms.unsigned_abs().into()));
                signal(child, Signal::CONT);
            }
            Line::Ended(outcomes, wrong) => break Some((outcomes, wrong)),
        }
    };
    drop(reported);
    let _ = reader.join();
    Ok(ended)
}

fn signal(child: &Child, signal: Signal) {
    // This fails if the process has ended.
    let _ = kill_process(Pid::from_child(child), signal);
}
