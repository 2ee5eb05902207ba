//! `tandem-web`: shows a run live as a page on loopback, with buttons that inject and end faults.
//! `tandem web` replaces itself by this program, and `tandem run --web` starts it.
#![forbid(unsafe_code)]

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
use tandem::failure::Failure;
use tandem_board_host::services::Observer;
use tandem_page::command_line;
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
    match run(&args) {
        Ok(code) => code,
        Err(failure) => {
            failure.say();
            failure.code()
        }
    }
}

/// Serves the page until the run has ended, or a signal tells to end. Returns the exit status.
///
/// # Errors
/// [`Failure::Usage`] if no run publishes or the port is in use.
fn run(args: &WebArgs) -> Result<ExitCode, Failure> {
    let told = Told::default();
    signal_hook::flag::register(SIGINT, Arc::clone(&told.interrupted)).context("signals")?;
    signal_hook::flag::register(SIGTERM, Arc::clone(&told.over)).context("signals")?;
    let found = match args.wait {
        true => None,
        false => Some(Observer::on(args.run.name.as_deref()).map_err(Failure::usage)?),
    };
    let token = Token::new().map_err(Failure::Usage)?;
    let (orders, asked) = channel();
    let server = Server::start(args.port, token.clone(), orders).map_err(Failure::Usage)?;
    announce(args.json, &server, &token)?;
    let observer = match found {
        Some(observer) => Some(observer),
        None => wait_for(args.run.name.as_deref(), &told),
    };
    if let Some(observer) = observer {
        follow(observer, &server, &asked, &told)?;
    }
    Ok(match is_set(&told.interrupted) {
        true => ExitCode::from(INTERRUPTED),
        false => ExitCode::SUCCESS,
    })
}

/// What signals have told this program.
#[derive(Default)]
struct Told {
    /// Ctrl-C.
    interrupted: Arc<AtomicBool>,
    /// SIGTERM: the run is over.
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
fn announce(json: bool, server: &Server, token: &Token) -> Result<(), Failure> {
    let port = server.port();
    let url = format!("http://127.0.0.1:{port}/#{}", token.text());
    let text = match json {
        true => serde_json::to_string(&Start {
            url,
            token: token.text(),
            port,
        })
        .context("JSON")?,
        false => format!("live page: {url}"),
    };
    tandem::print(&(text + "\n")).map_err(Failure::Run)
}

/// Waits until the run publishes; `None` after a signal.
fn wait_for(name: Option<&str>, told: &Told) -> Option<Observer> {
    while !told.ends() {
        if let Ok(observer) = Observer::on(name) {
            return Some(observer);
        }
        std::thread::sleep(REFRESH);
    }
    None
}

/// Collects the state, shows it, and carries out orders, until the run has ended or a signal tells
/// to end.
fn follow(
    mut observer: Observer,
    server: &Server,
    asked: &Receiver<Order>,
    told: &Told,
) -> Result<(), Failure> {
    let mut history = History::new(observer.run().as_str());
    let mut hands = Hands::on(observer.run().clone());
    let mut polled = Instant::now();
    loop {
        let begin = Instant::now();
        history.tick(begin - polled);
        polled = begin;
        observer.poll(&mut |news| history.take(&news));
        if told.ends() {
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
                Err(RecvTimeoutError::Disconnected) => {
                    return Err(Failure::Run(anyhow::anyhow!("the server has ended")));
                }
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
