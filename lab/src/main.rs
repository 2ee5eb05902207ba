//! `tandem-lab`: the commands of `tandem` with dependencies that a drive does not need. `tandem`
//! builds this program with cargo, and then replaces itself with it.
#![forbid(unsafe_code)]

mod args;
mod boot_args;
mod boot_demo;
mod can_log;
mod chaos;
mod chaos_args;
mod command_line;
mod emulated;
mod fault_file;
mod flash_command;
mod flash_info;
mod judge;
mod rtos_demo;
mod sim;
mod square_waves;
mod thesis;
mod time;
mod work;

use std::process::ExitCode;

use tandem::board_kind::BoardKind;
use tandem::failure::Failure;
use tandem::{grandmaster, publish, run, soc};

use args::{Cli, Command};

fn main() -> ExitCode {
    tandem::program(|| {
        let cli: Cli = tandem_page::command_line::parse(std::env::args_os());
        command(cli.command)
    })
}

fn command(command: Command) -> Result<(), Failure> {
    match command {
        Command::Run(args) if args.board == BoardKind::Host => run::run(&args),
        Command::Run(args) => emulated::run(&args),
        Command::Soc(args) => soc::run(&args),
        Command::Grandmaster(args) => grandmaster::run(&args),
        Command::Publish => publish::run().map_err(Failure::Run),
        Command::Flash(args) => flash_command::run(&args),
        Command::Bootloader(args) => flash_command::bootloader(&args),
        Command::CanLog(args) => can_log::run(&args),
        Command::Completions(args) => command_line::print_completions(&args),
        Command::Man(args) => command_line::write_pages(&args),
        Command::Judge(args) => judge::run(&args),
        Command::Sim(args) => sim::run(&args),
        Command::Chaos(args) => chaos::run(&args),
        Command::Thesis(args) => thesis::run(&args),
        Command::Time(args) => time::run(&args),
        Command::RtosDemo(args) => rtos_demo::run(&args),
        Command::BootDemo(args) => {
            let json_to = args.json.check().map_err(Failure::usage)?;
            let shown = boot_demo::experiment(args.board, args.images.as_deref());
            shown?.show(json_to).map_err(Failure::Run)
        }
    }
}
