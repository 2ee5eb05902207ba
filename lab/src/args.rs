//! The command line of this program: commands that `tandem` passes on.

use std::path::PathBuf;

use clap::{Args, Parser, Subcommand, ValueEnum};
use tandem::args::{BootDemoArgs, RunArgs};
use tandem::board_kind::DemoBoard;

use crate::boot_args::{BootloaderArgs, FlashArgs};
use crate::chaos_args::ChaosArgs;
use crate::sim::SimArgs;

/// What runs in virtual time or in emulators, campaigns of faults, and experiments: of `tandem`.
#[derive(Debug, Parser)]
#[command(name = "tandem", bin_name = "tandem", version, max_term_width = 100)]
pub(crate) struct Cli {
    /// What to do.
    #[command(subcommand)]
    pub(crate) command: Command,
}

/// The jobs.
#[derive(Debug, Subcommand)]
pub(crate) enum Command {
    /// Drive a scenario with both systems, and write a report
    Run(RunArgs),
    /// Publish a run for observers: what a run starts
    #[command(hide = true)]
    Publish,
    /// Drive a folder of scenarios in virtual time, and say how each went
    Judge(JudgeArgs),
    /// Try faults on the control cores of both systems, in virtual time
    Sim(SimArgs),
    /// Inject faults into the processes and wires of real runs, and report what each kind cost
    Chaos(ChaosArgs),
    /// Run the experiments of the thesis, and print its figures beside those of here
    Thesis(ThesisArgs),
    /// Show tasks of FreeRTOS as an oscilloscope would: their periods, and who keeps whom waiting
    RtosDemo(RtosDemoArgs),
    /// Download the smallest application over CAN to an empty controller, start it, and show the
    /// frames of its three cores
    BootDemo(BootDemoArgs),
    /// Sign an application and download it to a bootloader over CAN
    Flash(FlashArgs),
    /// Run the bootloader of one system on a flash file, and say what it would start
    Bootloader(BootloaderArgs),
}

/// Arguments of `tandem thesis`.
#[derive(Debug, Args)]
pub(crate) struct ThesisArgs {
    /// What the experiments run on
    #[arg(long, value_enum, default_value_t = ThesisBoard::Host)]
    pub(crate) board: ThesisBoard,

    /// Write the figures to this file, too
    #[arg(long, value_name = "FILE")]
    pub(crate) json: Option<PathBuf>,

    /// Draw the outputs of both systems over time into this file
    #[arg(long, value_name = "FILE")]
    pub(crate) svg: Option<PathBuf>,
}

/// Values of `--board` of `tandem thesis`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum ThesisBoard {
    /// Processes of this machine, in real time
    Host,
    /// Both systems in this process, in virtual time
    Sim,
    /// Firmware in emulated RISC-V machines, one for each system: an instruction takes 1 ns
    Qemu,
}

impl ThesisBoard {
    /// As the command line writes it.
    pub(crate) const fn name(self) -> &'static str {
        match self {
            Self::Host => "host",
            Self::Sim => "sim",
            Self::Qemu => "qemu",
        }
    }
}

/// Arguments of `tandem judge`.
#[derive(Debug, Args)]
pub(crate) struct JudgeArgs {
    /// The folder: every file *.xml in it is a CommonRoad scenario
    #[arg(value_name = "DIR")]
    pub(crate) folder: PathBuf,

    /// How long to drive each, in scenario time: 20, 20s, 1m
    #[arg(long, value_name = "TIME", default_value = "20s", value_parser = tandem::args::parse_duration)]
    pub(crate) duration: f64,

    /// Seed of the sensors' noise
    #[arg(long, default_value_t = 1)]
    pub(crate) seed: u64,

    /// Scenarios at the same time [default: one for each CPU]
    #[arg(long, value_name = "N")]
    pub(crate) jobs: Option<std::num::NonZero<usize>>,

    /// Write all figures to this file
    #[arg(long, value_name = "FILE")]
    pub(crate) json: Option<PathBuf>,

    /// Write an overview page with a picture of each drive to this file
    #[arg(long, value_name = "FILE")]
    pub(crate) html: Option<PathBuf>,
}

/// Arguments of `tandem rtos-demo`.
#[derive(Debug, Args)]
pub(crate) struct RtosDemoArgs {
    /// What the tasks run on
    #[arg(long, value_enum, default_value_t = DemoBoard::Host)]
    pub(crate) board: DemoBoard,

    /// The image for the emulated board [default: what `cargo xtask firmware build` made]
    #[arg(long, value_name = "FILE")]
    pub(crate) firmware: Option<PathBuf>,

    /// Write the pictures to this file, too
    #[arg(long, value_name = "FILE")]
    pub(crate) svg: Option<PathBuf>,
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::CommandFactory as _;

    /// `tandem` lists each command in the words with which this program explains it.
    #[test]
    fn both_command_lines_say_the_same() {
        Cli::command().debug_assert();
        let listed = tandem::args::Cli::command();
        for here in Cli::command()
            .get_subcommands()
            .filter(|it| !it.is_hide_set())
        {
            let there = listed.find_subcommand(here.get_name()).unwrap();
            let about = |command: &clap::Command| command.get_about().map(ToString::to_string);
            assert_eq!(about(here), about(there), "{}", here.get_name());
        }
    }
}
