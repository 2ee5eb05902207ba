//! `tandem-web`: shows a run live as a page on loopback, with buttons that inject and end faults.
//! `tandem web` replaces itself by this program, and `tandem run --web` starts it.
#![forbid(unsafe_code)]

mod connections;
mod fragments;
mod history;
mod live_page;
mod server;
mod state;
mod token;

use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, channel};
use std::time::{Duration, Instant};

use anyhow::Context as _;
use clap::{Parser, Subcommand};
use serde::Serialize;
use signal_hook::consts::{SIGINT, SIGTERM};
use tandem::args::WebArgs;
use tandem::beside::Ready;
use tandem::failure::Failure;
use tandem::viewer::{self, ShownRun};
use tandem_observers::Observer;
use tandem_page::command_line;
use tandem_page::json::JsonOutput;
use tandem_watch::Hands;

use history::History;
use server::{Order, Server};
use token::Token;

/// Interval at which the state is collected and sent.
const REFRESH: Duration = Duration::from_millis(100);
/// Time for which the page still hears that the run has ended.
const FAREWELL: Duration = Duration::from_millis(500);
/// Exit status after Ctrl-C.
const INTERRUPTED: u8 = 130;

/// The part of `tandem` that this program implements.
#[derive(Debug, Parser)]
#[command(name = "tandem", bin_name = "tandem", version, max_term_width = 100)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Show a run live as a web page on this machine, with buttons that inject faults
    Web(WebArgs),
}

/// What `--json` prints.
#[derive(Serialize)]
struct Start<'a> {
    url: String,
    token: &'a str,
    port: u16,
}

fn main() -> ExitCode {
    let Cli { command } = command_line::parse(std::env::args_os());
    let Command::Web(args) = command;
    Failure::status(run(&args))
}

/// Serves the page until the run has ended, or a signal tells to end. Returns the exit status.
///
/// # Errors
/// [`Failure::Usage`] if no run publishes or the port is in use.
fn run(args: &WebArgs) -> Result<ExitCode, Failure> {
    let told = Told::default();
    signal_hook::flag::register(SIGINT, Arc::clone(&told.interrupted)).context("signals")?;
    signal_hook::flag::register(SIGTERM, Arc::clone(&told.over)).context("signals")?;
    if args.beside {
        return beside(args.port, &told).map_err(Failure::Run);
    }
    let json_to = args.json.check().map_err(Failure::usage)?;
    let observer = Observer::on(args.run.name.as_deref()).map_err(Failure::usage)?;
    let (server, asked, token) = serve(args.port).map_err(Failure::Usage)?;
    announce(json_to, &server, &token)?;
    follow(observer, true, &server, &asked, &told).map_err(Failure::Run)?;
    Ok(match is_set(&told.interrupted) {
        true => ExitCode::from(INTERRUPTED),
        false => ExitCode::SUCCESS,
    })
}

/// Shows the run that `tandem run` names, until it closes stdin.
fn beside(port: u16, told: &Told) -> anyhow::Result<ExitCode> {
    let served = serve(port);
    let ready = match &served {
        Ok((server, _, token)) => Ready::At(Some(address(server, token))),
        Err(error) => Ready::Refused(format!("--web: {error:#}")),
    };
    ready.say()?;
    if let Ok((server, asked, _)) = served
        && let Some(ShownRun { observer, .. }) = viewer::run_to_show(&told.over)?
    {
        follow(observer, false, &server, &asked, told)?;
    }
    Ok(ExitCode::SUCCESS)
}

/// Starts the server. Also returns the orders that arrive, and the token that they need.
fn serve(port: u16) -> anyhow::Result<(Server, Receiver<Order>, Token)> {
    let token = Token::new()?;
    let (orders, asked) = channel();
    let server = Server::start(port, token.clone(), orders)?;
    Ok((server, asked, token))
}

/// What signals have told this program.
#[derive(Default)]
struct Told {
    /// Ctrl-C.
    interrupted: Arc<AtomicBool>,
    /// SIGTERM, or `tandem run` has closed stdin: the run is over.
    over: Arc<AtomicBool>,
}

impl Told {
    fn ends(&self) -> bool {
        is_set(&self.interrupted) || is_set(&self.over)
    }
}

fn is_set(flag: &AtomicBool) -> bool {
    flag.load(Ordering::Relaxed)
}

/// Prints where the page is, and the token.
fn announce(json_to: JsonOutput, server: &Server, token: &Token) -> Result<(), Failure> {
    let start = Start {
        url: url(server, token),
        token: token.text(),
        port: server.port(),
    };
    let mut lines = json_to.lines();
    let line = lines.line(&start, || address(server, token) + "\n")?;
    lines.finish()?;
    tandem::print(&line).map_err(Failure::Run)
}

fn url(server: &Server, token: &Token) -> String {
    format!("http://127.0.0.1:{}/#{}", server.port(), token.text())
}

/// Returns where the page is, in words.
fn address(server: &Server, token: &Token) -> String {
    format!("live page: {}", url(server, token))
}

/// Collects the state, shows it, and carries out orders, until the run has ended or a signal tells
/// to end. `by_silence`: a run that publishes nothing for 2 s has ended; otherwise `told` says so.
fn follow(
    mut observer: Observer,
    by_silence: bool,
    server: &Server,
    asked: &Receiver<Order>,
    told: &Told,
) -> anyhow::Result<()> {
    let mut history = History::new(observer.run().as_str());
    let mut hands = Hands::on(observer.run().clone());
    let mut polled = Instant::now();
    loop {
        let begin = Instant::now();
        if by_silence {
            history.tick(begin - polled);
        }
        polled = begin;
        // The state of before the poll: what the run has published until then is shown.
        let ends = told.ends();
        observer.poll(&mut |news| history.take(&news));
        if ends {
            history.picture.end();
        }
        server.show(&history);
        if history.picture.has_ended() {
            std::thread::sleep(FAREWELL);
            return Ok(());
        }
        // An order is carried out at once, the state is sent on time.
        let deadline = begin + REFRESH;
        loop {
            match asked.recv_timeout(deadline.saturating_duration_since(Instant::now())) {
                Ok(order) => order.carry_out(&mut hands, &mut history),
                Err(RecvTimeoutError::Timeout) => break,
                Err(RecvTimeoutError::Disconnected) => anyhow::bail!("the server has ended"),
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::CommandFactory as _;

    /// `tandem` and this program describe the command in the same words.
    #[test]
    fn both_command_lines_say_the_same() {
        Cli::command().debug_assert();
        let (here, there) = (Cli::command(), tandem::args::Cli::command());
        let about = |command: &clap::Command| {
            let web = command.find_subcommand("web").unwrap();
            web.get_about().unwrap().to_string()
        };
        assert_eq!(about(&here), about(&there));
    }
}
