//! `tandem-foxglove`: shows a run in Foxglove, from the services that it publishes, as a file
//! (MCAP) or live (WebSocket). `tandem foxglove` replaces itself by this program, and `tandem run
//! --mcap` and `--foxglove` start it beside the run.
#![forbid(unsafe_code)]

mod channels;
mod scene;
mod sinks;

use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant, SystemTime};

use anyhow::{Context as _, anyhow};
use clap::{Parser, Subcommand};
use signal_hook::consts::{SIGINT, SIGTERM};
use tandem::args::FoxgloveArgs;
use tandem::beside::Ready;
use tandem::failure::Failure;
use tandem::viewer::{self, ShownRun};
use tandem_board_host::clock;
use tandem_board_host::process_list;
use tandem_observers::Observer;
use tandem_page::command_line;

use channels::Channels;
use sinks::Sinks;

/// Delay of the next poll of the services.
const POLL: Duration = Duration::from_millis(10);
/// Interval at which a program without a run beside it checks whether the run still exists.
const CHECK: Duration = Duration::from_millis(500);

/// The part of `tandem` that this program implements.
#[derive(Debug, Parser)]
#[command(name = "tandem", bin_name = "tandem", version, max_term_width = 100)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Show a run in Foxglove: as an MCAP file, or live
    Foxglove(FoxgloveArgs),
}

fn main() -> ExitCode {
    let Cli { command } = command_line::parse(std::env::args_os());
    let Command::Foxglove(args) = command;
    Failure::status(run(&args).map(|()| ExitCode::SUCCESS))
}

fn run(args: &FoxgloveArgs) -> Result<(), Failure> {
    if args.beside {
        return beside(args).map_err(Failure::Run);
    }
    let mut observer = Observer::on(args.run.name.as_deref()).map_err(Failure::usage)?;
    let port = args.port.or(args.mcap.is_none().then_some(8765));
    let context = foxglove::Context::new();
    let mut channels = Channels::new(&context);
    let sinks = Sinks::open(&context, args.mcap.as_deref(), port).map_err(Failure::Usage)?;
    if let Some(port) = sinks.port() {
        eprintln!("{}", address(port));
    }
    let stop = Arc::new(AtomicBool::new(false));
    for signal in [SIGINT, SIGTERM] {
        signal_hook::flag::register(signal, Arc::clone(&stop)).context("Ctrl-C")?;
    }
    let run = observer.run().to_string();
    // A run in emulated machines has a time of its own, and no processes in the list.
    let is_listed = process_list::run_named(Some(&run)).is_ok();
    channels.set_utc(is_listed.then(utc_ahead_of_run).flatten());
    let mut checked = Instant::now();
    let mut is_over = || {
        if is_listed && checked.elapsed() > CHECK {
            checked = Instant::now();
            return process_list::run_named(Some(&run)).is_err();
        }
        stop.load(Ordering::Relaxed)
    };
    follow(&mut observer, &mut channels, &mut is_over);
    let interrupted = stop.load(Ordering::Relaxed);
    sinks
        .close(&channels.figures(observer.lost()))
        .map_err(Failure::Run)?;
    match interrupted {
        true => Err(Failure::CutShort),
        false => Ok(()),
    }
}

/// Shows the run that `tandem run` names, until it closes stdin.
fn beside(args: &FoxgloveArgs) -> anyhow::Result<()> {
    // Ctrl-C ends the run, and the run ends this program.
    let context = foxglove::Context::new();
    let mut channels = Channels::new(&context);
    let opened = Sinks::open(&context, args.mcap.as_deref(), args.port);
    let ready = match &opened {
        Ok(sinks) => Ready::At(sinks.port().map(address)),
        Err(error) => Ready::Refused(format!("{error:#}")),
    };
    ready.say()?;
    let Ok(sinks) = opened else {
        return Ok(());
    };
    let over = Arc::default();
    let shown = viewer::run_to_show(&over)?;
    let Some(ShownRun {
        mut observer,
        is_virtual,
    }) = shown
    else {
        return sinks.discard();
    };
    channels.set_utc((!is_virtual).then(utc_ahead_of_run).flatten());
    follow(&mut observer, &mut channels, &mut || {
        over.load(Ordering::Relaxed)
    });
    match channels.is_empty() {
        true => sinks.discard(),
        false => sinks.close(&channels.figures(observer.lost())),
    }
}

/// Shows what the run publishes until it is over, and then what is left.
fn follow(observer: &mut Observer, channels: &mut Channels, is_over: &mut dyn FnMut() -> bool) {
    loop {
        let over = is_over();
        observer.poll(&mut |news| channels.take(&news));
        if over {
            return;
        }
        std::thread::sleep(POLL);
    }
}

/// Returns where Foxglove finds the run.
fn address(port: u16) -> String {
    format!("Foxglove: open a connection to ws://localhost:{port}")
}

/// Returns how much later UTC is than the clock of a run on this machine, ns.
fn utc_ahead_of_run() -> Option<u64> {
    let today = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH);
    let ns = u64::try_from(today.ok()?.as_nanos()).ok()?;
    ns.checked_sub(clock::now().as_ns())
}

/// Makes a usage error of a problem with a file.
fn at(path: &std::path::Path, problem: impl std::fmt::Display) -> anyhow::Error {
    anyhow!("--mcap {}: {problem}", path.display())
}
