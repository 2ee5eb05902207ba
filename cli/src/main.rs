//! The tandem command.
#![forbid(unsafe_code)]

mod args;
mod bench;
mod board_kind;
mod boot;
mod boot_demo;
mod chaos;
mod chaos_args;
mod collected;
mod control_core;
mod core_process;
mod dflash;
mod emulated;
mod failure;
mod files;
mod flash;
mod hands;
mod judge;
mod live;
mod metrics;
mod output;
mod percentiles;
mod ps;
mod publish;
mod recorder;
mod report;
mod rtos_demo;
mod run;
mod run_config;
mod sim;
mod stall_watch;
mod summary;
#[cfg(test)]
mod synthetic;
mod thesis;
mod three_frames;
mod timeline;
mod top;
mod update;
mod vehicle;
mod world_record;

use std::alloc::System;
use std::io::{self, Write as _};
use std::process::ExitCode;

use anyhow::Context as _;
use clap::Parser as _;
use run_config::RunConfig;
use tandem_board_host::{InvalidArgs, ProcessArgs, supply};

use args::{Cli, Command};
use failure::Failure;
use tandem_rtos::host::TaskAllocator;

/// The tasks of a core share its thread, and with it the allocator.
#[global_allocator]
static ALLOCATOR: TaskAllocator<System> = TaskAllocator::new(System);

fn main() -> ExitCode {
    // The processes of a run are this program with hidden arguments.
    if let Some(args) = ProcessArgs::parse(std::env::args_os().skip(1)) {
        return match process(args) {
            Ok(()) => ExitCode::SUCCESS,
            Err(error) => {
                eprintln!("{error:#}");
                ExitCode::FAILURE
            }
        };
    }
    match command(Cli::parse().command) {
        Ok(()) => ExitCode::SUCCESS,
        Err(failure) => {
            failure.say();
            failure.code()
        }
    }
}

fn command(command: Command) -> Result<(), Failure> {
    match command {
        Command::Run(args) => run::run(&args),
        Command::Ps(args) => ps::run(&args).map_err(Failure::Run),
        Command::Scenarios => scenarios().map_err(Failure::Run),
        Command::Judge(args) => judge::run(&args),
        Command::Bench(args) => bench::run(&args),
        Command::BootDemo(args) => {
            let shown = boot_demo::experiment(args.board, args.images.as_deref());
            let shown = shown.map_err(Failure::Run)?;
            print(&shown.to_string()).map_err(Failure::Run)
        }
        Command::Flash(args) => flash::run(&args),
        Command::Bootloader(args) => flash::bootloader(&args).map_err(Failure::Run),
        Command::Sim(args) => sim::run(&args),
        Command::Chaos(args) => chaos::run(&args),
        Command::Top(args) => top::run(&args),
        Command::Publish => publish::run().map_err(Failure::Run),
        Command::Cut(args) => hands::set_cut(&args, true).map_err(Failure::Run),
        Command::Mend(args) => hands::set_cut(&args, false).map_err(Failure::Run),
        Command::Power(args) => hands::power(&args).map_err(Failure::Run),
        Command::Fault(args) => hands::fault(&args).map_err(Failure::Run),
        Command::Dflash(args) => {
            let shown = dflash::run(&args).map_err(Failure::Run)?;
            print(&shown).map_err(Failure::Run)
        }
        Command::Thesis(args) => thesis::run(&args),
        Command::RtosDemo(args) => {
            let shown = rtos_demo::run(&args).map_err(Failure::Run)?;
            print(&shown).map_err(Failure::Run)
        }
    }
}

/// One process of a run, until it ends.
fn process(args: Result<ProcessArgs, InvalidArgs>) -> anyhow::Result<()> {
    match args? {
        ProcessArgs::Supply(args) => {
            let system = args.system;
            supply::run(&args, &run::core_command).with_context(|| format!("supply {system}"))
        }
        ProcessArgs::Core(args) => {
            let of = args.identity;
            core_process::run(&args).with_context(|| format!("core {}{}", of.system, of.core))
        }
        ProcessArgs::Vehicle(args) => {
            let run = RunConfig::from_extra(&args.common.extra)?;
            match &run.demo {
                Some(files) => boot_demo::play(&args, files),
                None => vehicle::run(&args, &run),
            }
            .context("vehicle")
        }
    }
}

fn scenarios() -> anyhow::Result<()> {
    let mut text = String::new();
    for (name, description) in tandem_vehicle::Scenario::descriptions() {
        text += &format!("{name:14}  {description}\n");
    }
    print(&text)
}

/// Writes to stdout; a reader that has seen enough is no error.
fn print(text: &str) -> anyhow::Result<()> {
    match io::stdout().write_all(text.as_bytes()) {
        Err(error) if error.kind() != io::ErrorKind::BrokenPipe => Err(error).context("stdout"),
        _ => Ok(()),
    }
}
