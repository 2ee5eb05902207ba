//! The `tandem` command.
#![forbid(unsafe_code)]

use std::ffi::OsString;
use std::process::ExitCode;

use serde_json::json;
use tandem::args::{Cli, Command, ScenariosArgs, TimeBoard};
use tandem::beside::{Program, become_program};
use tandem::board_kind::{BoardKind, DemoBoard};
use tandem::failure::Failure;
use tandem::{
    boot_demo, clock_view, dflash, exec, grandmaster, injection, print, ps, publish, run, soc,
    topics,
};
use tandem_page::command_line;

fn main() -> ExitCode {
    tandem::program(|| {
        let words = words();
        let cli: Cli = command_line::parse(words.iter().cloned());
        command(cli.command, &words[1..])
    })
}

/// Returns the command line. Turns `help COMMAND` into `COMMAND --help`, because other programs
/// implement some of the commands.
fn words() -> Vec<OsString> {
    let mut words: Vec<_> = std::env::args_os().collect();
    if words.len() == 3 && words[1] == "help" {
        words.remove(1);
        words.push("--help".into());
    }
    words
}

fn command(command: Command, words: &[OsString]) -> Result<(), Failure> {
    match command {
        Command::Bench(_) => become_program(Program::Bench, words),
        Command::Foxglove(_) => become_program(Program::Foxglove, words),
        Command::Top(_) => become_program(Program::Top, words),
        Command::Web(_) => become_program(Program::Web, words),
        Command::CanLog(_)
        | Command::Completions(_)
        | Command::Man(_)
        | Command::Judge(_)
        | Command::Flash(_)
        | Command::Bootloader(_)
        | Command::Sim(_)
        | Command::Chaos(_)
        | Command::Thesis(_)
        | Command::RtosDemo(_) => become_program(Program::Lab, words),
        Command::Run(args) if args.board != BoardKind::Host => {
            run::check_board(&args).map_err(Failure::Usage)?;
            become_program(Program::Lab, words)
        }
        Command::Run(args) => run::run(&args),
        Command::BootDemo(args) if args.board != DemoBoard::Host => {
            become_program(Program::Lab, words)
        }
        Command::BootDemo(args) => {
            let json_to = args.json.check().map_err(Failure::usage)?;
            boot_demo::on_host()?.show(json_to).map_err(Failure::Run)
        }
        Command::Ps(args) => ps::run(&args),
        Command::Scenarios(args) => scenarios(&args),
        Command::Publish => publish::run().map_err(Failure::Run),
        Command::Soc(args) => soc::run(&args),
        Command::Grandmaster(args) => grandmaster::run(&args),
        Command::Cut(args) => injection::set_cut(&args, true),
        Command::Mend(args) => injection::set_cut(&args, false),
        Command::Power(args) => injection::power(&args),
        Command::Fault(args) => injection::fault(&args),
        Command::Topics(args) => topics::run(&args),
        Command::Exec(args) => exec::run(&args),
        Command::Time(args) if args.board == TimeBoard::Sim => become_program(Program::Lab, words),
        Command::Time(args) => clock_view::run(&args),
        Command::Dflash(args) => {
            let shown = dflash::run(&args)?;
            print(&shown).map_err(Failure::Run)
        }
    }
}

fn scenarios(args: &ScenariosArgs) -> Result<(), Failure> {
    let json_to = args.json.check().map_err(Failure::usage)?;
    let all = tandem_vehicle::Scenario::descriptions;
    let row = |(name, description)| json!({ "name": name, "description": description });
    let rows: Vec<_> = all().map(row).collect();
    let line = |(name, description)| format!("{name:14}  {description}\n");
    Ok(print(&json_to.write(&rows, || all().map(line).collect())?)?)
}
