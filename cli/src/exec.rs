//! `tandem exec`: runs the processes of a manifest, and shows them.

use std::os::unix::net::UnixStream;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use anyhow::{Context as _, anyhow};
use serde_json::Value;
use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM};
use tandem_exec_host::launcher::{self, GuardEnd, GuardPlan, PlatformState, ProcessLauncher, Told};
use tandem_manifest::Manifest;

use crate::args::{ExecArgs, ExecCommand, ExecRunArgs, ManifestArgs};
use crate::exec_sign;
use crate::failure::Failure;

/// Runs a subcommand.
///
/// # Errors
/// [`Failure::Usage`] if nothing was started; [`Failure::Run`] after a clean-up.
pub fn run(args: &ExecArgs) -> Result<(), Failure> {
    match &args.command {
        ExecCommand::Run(args) => guard(args),
        ExecCommand::Check(args) => check(args),
        ExecCommand::Ps(args) => ps(args),
        ExecCommand::Target(args) => {
            let answer = ask(&args.manifest, &format!("target {}", args.target))?;
            match answer.as_str() {
                "ok" => Ok(crate::print(&format!("{}: all ready\n", args.target))?),
                why => Err(Failure::Run(anyhow!("{why}"))),
            }
        }
        ExecCommand::Sign(args) => exec_sign::run(args),
        ExecCommand::Launcher(args) => launch(args),
    }
}

/// Sends each of these signals as a byte.
fn signals(of: &[i32]) -> anyhow::Result<UnixStream> {
    let (read, write) = UnixStream::pair().context("signals")?;
    for signal in of {
        let write = write.try_clone().context("signals")?;
        signal_hook::low_level::pipe::register(*signal, write).context("signals")?;
    }
    Ok(read)
}

fn guard(args: &ExecRunArgs) -> Result<(), Failure> {
    let of = &args.of;
    let mut command = tandem_board_host::this_program();
    command.args(["exec", "launcher"]).arg(&of.manifest);
    command.args(
        of.anchor
            .iter()
            .flat_map(|it| ["--anchor".as_ref(), it.as_os_str()]),
    );
    command.args(of.json.word());
    let words = |text: &Option<String>| {
        let text = text.as_deref().unwrap_or_default();
        text.split_whitespace().map(str::to_owned).collect()
    };
    let plan = GuardPlan {
        manifest: of.manifest.clone(),
        anchor: of.anchor.clone(),
        before: words(&args.pre_clean_up),
        after: words(&args.post_clean_up),
    };
    let interrupted = Arc::new(AtomicBool::new(false));
    signal_hook::flag::register(SIGINT, Arc::clone(&interrupted)).context("Ctrl-C")?;
    let stops = signals(&[SIGINT, SIGTERM, SIGHUP])?;
    let ended = launcher::guard(command, &plan, &stops, &mut |text| eprintln!("{text}"));
    match ended.context("the guardian")? {
        GuardEnd::Done if interrupted.load(Ordering::Relaxed) => Err(Failure::Interrupted),
        GuardEnd::Done => Ok(()),
        // The launcher has said why.
        GuardEnd::NothingStarted => Err(Failure::Usage(anyhow!("nothing was started"))),
        GuardEnd::CleanedUp(why, failed) if failed.is_empty() => {
            Err(Failure::Run(anyhow!("{why}: all processes are ended")))
        }
        GuardEnd::CleanedUp(why, failed) => {
            let failed = failed.join("; ");
            Err(Failure::Run(anyhow!(
                "{why}; the clean-up failed in parts: {failed}"
            )))
        }
    }
}

fn launch(args: &ManifestArgs) -> Result<(), Failure> {
    let mut lines = args.json.check().map_err(Failure::usage)?.lines();
    let stops = signals(&[SIGTERM])?;
    let opened = ProcessLauncher::open(&args.manifest, args.anchor.as_deref());
    let launcher = opened.map_err(Failure::usage)?;
    let mut tell = |told: &Told| {
        let line = lines.line(told, || format!("{told}\n"));
        // What is not heard is no reason to end processes.
        let _ = crate::print(&line.unwrap_or_default());
    };
    let ended = launcher.run(stops, true, &mut tell);
    let written = lines.finish();
    match ended {
        Ok(()) => Ok(written?),
        Err(why) => {
            eprintln!("{why}");
            if let Err(why) = written {
                eprintln!("{why}");
            }
            std::process::exit(i32::from(launcher::give_up(&why)));
        }
    }
}

fn check(args: &ManifestArgs) -> Result<(), Failure> {
    let json_to = args.json.check().map_err(Failure::usage)?;
    let checked = launcher::check(&args.manifest, args.anchor.as_deref());
    let manifest = checked.map_err(Failure::usage)?;
    let name = |at: &usize| manifest.processes[*at].name();
    let names = |of: &[usize]| of.iter().map(name).collect::<Vec<_>>().join(", ");
    let members = manifest.targets.iter().map(|target| {
        let members: Vec<_> = target.members.iter().map(name).collect();
        (target.name().to_owned(), members)
    });
    let members: std::collections::BTreeMap<_, _> = members.collect();
    let mut text = table(&["process", "after"], &rows(&manifest, &names));
    text.push('\n');
    let targets = manifest.targets.iter().enumerate().map(|(at, target)| {
        let is_fallback = manifest.fallback() == Some(at);
        let what = match (manifest.initial() == at, is_fallback) {
            (true, true) => "initial, fallback",
            (true, false) => "initial",
            (false, true) => "fallback",
            (false, false) => "",
        };
        vec![
            target.name().to_owned(),
            what.to_owned(),
            names(&target.members),
        ]
    });
    let targets: Vec<_> = targets.collect();
    text += &table(&["run target", "", "processes"], &targets);
    Ok(crate::print(&json_to.write(&members, || text)?)?)
}

fn rows(manifest: &Manifest, names: &dyn Fn(&[usize]) -> String) -> Vec<Vec<String>> {
    let processes = manifest.processes.iter();
    let row =
        |it: &tandem_manifest::ProcessPlan| vec![it.name().to_owned(), names(&it.dependencies)];
    processes.map(row).collect()
}

fn ask(manifest: &Path, request: &str) -> Result<String, Failure> {
    let shown = manifest.display();
    let missing = || format!("no launcher runs {shown}; `tandem exec run {shown}` starts one");
    let answer = launcher::ask(manifest, request).with_context(missing);
    answer.map_err(Failure::Usage)
}

fn ps(args: &ManifestArgs) -> Result<(), Failure> {
    let json_to = args.json.check().map_err(Failure::usage)?;
    let answer = ask(&args.manifest, "ps")?;
    let document: Value = serde_json::from_str(&answer).context("the launcher's answer")?;
    let state: PlatformState = serde_json::from_str(&answer).context("the launcher's answer")?;
    let rows = state.processes.into_iter().map(|it| {
        let pid = it.pid.map_or_else(String::new, |pid| pid.to_string());
        vec![
            it.process,
            it.state,
            pid,
            it.restarts.to_string(),
            it.status,
        ]
    });
    let rows: Vec<_> = rows.collect();
    let target = state.target.unwrap_or_else(|| "none".to_owned());
    let reached = if state.reached {
        "all ready"
    } else {
        "not reached yet"
    };
    let table = table(&["process", "state", "pid", "restarts", "status"], &rows);
    let text = || format!("run target {target}: {reached}\n\n{table}");
    Ok(crate::print(&json_to.write(&document, text)?)?)
}

/// Returns a table with columns as wide as their texts.
fn table(head: &[&str], rows: &[Vec<String>]) -> String {
    let head: Vec<String> = head.iter().map(|it| (*it).to_owned()).collect();
    let all = || std::iter::once(&head).chain(rows);
    let width = |column: usize| {
        let texts = all().filter_map(|row| Some(row.get(column)?.chars().count()));
        texts.max().unwrap_or(0)
    };
    let widths: Vec<usize> = (0..head.len()).map(width).collect();
    let line = |row: &Vec<String>| {
        let cells = row
            .iter()
            .zip(&widths)
            .map(|(text, width)| format!("{text:width$}"));
        let line = cells.collect::<Vec<_>>().join("  ");
        line.trim_end().to_owned() + "\n"
    };
    all().map(line).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn columns_are_as_wide_as_their_texts() {
        let rows = [
            vec!["a".to_owned(), "longer".to_owned()],
            vec!["bc".to_owned()],
        ];
        assert_eq!(table(&["x", "y"], &rows), "x   y\na   longer\nbc\n");
    }
}
