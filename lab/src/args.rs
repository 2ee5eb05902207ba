//! The command line of this program. `tandem` passes its arguments on.

use std::path::PathBuf;

use clap::{Args, Parser, Subcommand, ValueEnum};
use serde::Serialize;
use tandem::args::{BootDemoArgs, GrandmasterArgs, RunArgs, SocArgs, TimeArgs};
use tandem::board_kind::DemoBoard;
use tandem_page::json::JsonOption;

use crate::boot_args::{BootloaderArgs, FlashArgs};
use crate::chaos_args::ChaosArgs;
use crate::sim::SimArgs;

/// The commands of `tandem` for virtual time, emulators, fault campaigns and experiments
#[derive(Debug, Parser)]
#[command(name = "tandem", bin_name = "tandem", version, max_term_width = 100)]
pub(crate) struct Cli {
    /// What to do.
    #[command(subcommand)]
    pub(crate) command: Command,
}

/// The commands.
#[derive(Debug, Subcommand)]
pub(crate) enum Command {
    /// Drive a scenario with both systems, and write a report
    Run(RunArgs),
    /// Publish a run for observers; internal, started by `tandem run`
    #[command(hide = true)]
    Publish,
    /// Park the vehicle of a run; internal, started by `tandem run --soc`
    #[command(hide = true)]
    Soc(SocArgs),
    /// Give the time to a run; internal, started by `tandem run --grandmaster`
    #[command(hide = true)]
    Grandmaster(GrandmasterArgs),
    /// Convert the CAN log of a run to a format of Vector's tools: ASC or BLF
    CanLog(CanLogArgs),
    /// Drive a folder of scenarios in virtual time and judge each drive
    Judge(JudgeArgs),
    /// Try faults on the control cores of both systems, in virtual time
    Sim(SimArgs),
    /// Inject faults into the processes and wires of real runs, and report the gap of each kind
    Chaos(ChaosArgs),
    /// Run the thesis's experiments and print its figures beside the measured ones
    Thesis(ThesisArgs),
    /// Show the vehicle's time: whom each clock follows, its offset, rate and status
    Time(TimeArgs),
    /// Show FreeRTOS tasks as an oscilloscope would: their periods and their preemption
    RtosDemo(RtosDemoArgs),
    /// Download the smallest application over CAN to an empty controller, start it, and show a
    /// frame of each core
    BootDemo(BootDemoArgs),
    /// Sign an application and download it to a bootloader over CAN
    Flash(FlashArgs),
    /// Run the bootloader of one system on a flash file, and print what it would start
    Bootloader(BootloaderArgs),
    /// Print the completions of all commands for a shell
    Completions(CompletionsArgs),
    /// Write the man pages of all commands to a folder
    Man(ManArgs),
}

/// Arguments of `tandem completions`.
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  tandem completions bash > ~/.local/share/bash-completion/completions/tandem
  tandem completions fish > ~/.config/fish/completions/tandem.fish")]
pub(crate) struct CompletionsArgs {
    /// The shell
    #[arg(value_enum)]
    pub(crate) shell: clap_complete::Shell,
}

/// Arguments of `tandem man`.
#[derive(Debug, Args)]
pub(crate) struct ManArgs {
    /// The folder, created if needed; `man -l DIR/tandem-run.1` shows one of its pages
    #[arg(value_name = "DIR")]
    pub(crate) folder: PathBuf,
}

/// Arguments of `tandem thesis`.
#[derive(Debug, Args)]
pub(crate) struct ThesisArgs {
    /// What the experiments run on
    #[arg(long, value_enum, default_value_t = ThesisBoard::Host)]
    pub(crate) board: ThesisBoard,

    #[command(flatten)]
    #[allow(missing_docs)]
    pub(crate) json: JsonOption,

    /// Draw the outputs of both systems over time into this file
    #[arg(long, value_name = "FILE")]
    pub(crate) svg: Option<PathBuf>,
}

/// Values of `--board` of `tandem thesis`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, ValueEnum)]
#[serde(rename_all = "lowercase")]
pub(crate) enum ThesisBoard {
    /// Processes on this machine, in real time
    Host,
    /// Both systems in this process, in virtual time
    Sim,
    /// Firmware in emulated RISC-V machines, one for each system: an instruction takes 1 ns
    Qemu,
}

/// Arguments of `tandem can-log`.
#[derive(Debug, Args)]
pub(crate) struct CanLogArgs {
    /// The log in candump format, or the folder of a report that contains one
    #[arg(value_name = "LOG")]
    pub(crate) log: PathBuf,

    /// The file to write; its name ends in .asc or .blf. Each bus of the log is a channel: the
    /// first is channel 1
    #[arg(value_name = "FILE")]
    pub(crate) file: PathBuf,
}

/// Arguments of `tandem judge`.
#[derive(Clone, Debug, Args)]
pub(crate) struct JudgeArgs {
    /// A folder of CommonRoad scenarios, every file *.xml in it, or one such file
    #[arg(value_name = "DIR|FILE", required_unless_present = "variants")]
    pub(crate) folder: Option<PathBuf>,

    /// Make this many scenarios of the classes that recorded roads lack, from --seed, and judge
    /// them; with DIR, write them there as files, and judge nothing
    #[arg(
        long,
        value_name = "N",
        value_parser = clap::value_parser!(u32).range(1..=100_000),
        conflicts_with_all = ["html", "solutions", "out"]
    )]
    pub(crate) variants: Option<u32>,

    /// Of one file with several planning problems: drive the one with this id [default: all]
    #[arg(
        long,
        value_name = "ID",
        allow_negative_numbers = true,
        conflicts_with = "variants"
    )]
    pub(crate) problem: Option<i64>,

    /// How long to drive each scenario, in scenario time: 20, 20s, 1m
    #[arg(long, value_name = "TIME", default_value = "20s", value_parser = tandem::args::parse_duration)]
    pub(crate) duration: f64,

    /// Seed of the sensors' noise
    #[arg(long, default_value_t = 1)]
    pub(crate) seed: u64,

    /// What the other road users do
    #[arg(long, value_enum, default_value_t = OtherTraffic::React)]
    pub(crate) traffic: OtherTraffic,

    /// Scenarios to drive in parallel [default: one for each CPU]
    #[arg(long, value_name = "N")]
    pub(crate) jobs: Option<std::num::NonZero<usize>>,

    #[command(flatten)]
    #[allow(missing_docs)]
    pub(crate) json: JsonOption,

    /// Write an overview page with a picture of each drive to this file
    #[arg(long, value_name = "FILE")]
    pub(crate) html: Option<PathBuf>,

    /// Write each drive as a CommonRoad solution to this folder: solution_NAME for the file NAME,
    /// and solution_STEM-ID.xml for each of several planning problems of a file STEM.xml
    #[arg(long, value_name = "DIR")]
    pub(crate) solutions: Option<PathBuf>,

    /// Of one drive: write its report to this folder, as for a run
    #[arg(long, value_name = "DIR")]
    pub(crate) out: Option<PathBuf>,
}

/// Values of `--traffic` of `tandem judge`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum OtherTraffic {
    /// They leave their recording and brake for the vehicle where they must; each is counted
    React,
    /// They drive their recorded tracks as they were, and disappear at the end of these
    Replay,
}

/// Arguments of `tandem rtos-demo`.
#[derive(Debug, Args)]
pub(crate) struct RtosDemoArgs {
    /// What the tasks run on
    #[arg(long, value_enum, default_value_t = DemoBoard::Host)]
    pub(crate) board: DemoBoard,

    /// The image for the emulated board [default: built by `cargo xtask firmware build`]
    #[arg(long, value_name = "FILE")]
    pub(crate) firmware: Option<PathBuf>,

    #[command(flatten)]
    #[allow(missing_docs)]
    pub(crate) json: JsonOption,

    /// Also write the pictures to this file
    #[arg(long, value_name = "FILE")]
    pub(crate) svg: Option<PathBuf>,
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::CommandFactory as _;

    /// `tandem` and this program describe each command in the same words.
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
