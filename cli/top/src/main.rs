//! `tandem-top`: shows a run live in a terminal of 80 by 24, with keys that inject and end faults.
//! `tandem top` replaces itself by this program.
#![forbid(unsafe_code)]

mod view;

use std::io::IsTerminal as _;
use std::process::ExitCode;
use std::time::Duration;

use anyhow::{Context as _, anyhow};
use ratatui::crossterm::event::{self, Event, KeyCode, KeyEventKind, KeyModifiers};
use tandem_observers::Observer;
use tandem_page::command_line;

use clap::{Parser, Subcommand};
use tandem::args::RunChoice;
use tandem::failure::Failure;

use tandem_board::SystemId;
use tandem_watch::{Hand, Hands, Picture};

use view::Desk;

/// Interval at which the screen is drawn.
const REFRESH: Duration = Duration::from_millis(100);

/// The part of `tandem` that this program implements.
#[derive(Debug, Parser)]
#[command(name = "tandem", bin_name = "tandem", version, max_term_width = 100)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Watch a run live, and inject faults by keys
    Top(RunChoice),
}

fn main() -> ExitCode {
    let Cli { command } = command_line::parse(std::env::args_os());
    let Command::Top(choice) = command;
    Failure::status(run(&choice).map(|()| ExitCode::SUCCESS))
}

/// Shows the run until the user presses q.
///
/// # Errors
/// [`Failure::Usage`] if stdout is not a terminal, or no run publishes.
fn run(choice: &RunChoice) -> Result<(), Failure> {
    if !std::io::stdout().is_terminal() {
        let reason = "tandem top needs a terminal; `tandem ps` lists the processes without one";
        return Err(Failure::Usage(anyhow!(reason)));
    }
    let observer = Observer::on(choice.name.as_deref());
    let mut observer = observer.map_err(Failure::usage)?;
    let mut terminal = ratatui::try_init().context("the terminal")?;
    let shown = show(&mut observer, &mut terminal);
    ratatui::restore();
    shown.map_err(Failure::Run)
}

fn show(observer: &mut Observer, terminal: &mut ratatui::DefaultTerminal) -> anyhow::Result<()> {
    let mut picture = Picture::new(observer.run().as_str());
    let mut hands = Hands::on(observer.run().clone());
    let mut desk = Desk {
        selected: SystemId::A,
        said: String::new(),
    };
    loop {
        observer.poll(&mut |news| picture.take(&news));
        terminal
            .draw(|frame| view::draw(&picture, &desk, frame))
            .context("the terminal")?;
        if !event::poll(REFRESH).context("the keyboard")? {
            picture.tick(REFRESH);
            continue;
        }
        let Event::Key(key) = event::read().context("the keyboard")? else {
            continue;
        };
        let interrupts = key.modifiers.contains(KeyModifiers::CONTROL);
        match key.code {
            _ if key.kind != KeyEventKind::Press => {}
            KeyCode::Char('q') | KeyCode::Esc => return Ok(()),
            KeyCode::Char('c') if interrupts => return Ok(()),
            KeyCode::Tab => desk.selected = desk.selected.peer(),
            KeyCode::Char(key) => {
                desk.said = match Hand::of_key(key) {
                    Some(hand) => match hands.lay(hand, desk.selected) {
                        Ok(begun) => begun,
                        Err(refused) => refused.to_string(),
                    },
                    None => format!("{key} is no key"),
                };
            }
            _ => {}
        }
    }
}
