//! The arguments of the commands about the vehicle's time.

use std::net::Ipv4Addr;
use std::path::PathBuf;

use clap::{Args, ValueEnum};
use tandem_page::json::JsonOption;

use super::parse_duration;

const GRANDMASTER_EXAMPLES: &str = "\
Examples:
  tandem run --grandmaster           starts one beside the run, and prints its process id
  tandem time                        shows how the clocks of the run follow it
  kill -9 PID                        of the grandmaster: the clocks are in holdover
  tandem grandmaster                 another one in domain 0: the clocks follow it after 3 s

Ctrl-C ends it.";

/// Arguments of `tandem time`.
#[derive(Debug, Args)]
pub struct TimeArgs {
    /// The run, as in the last column of `tandem ps` [default: the only one]
    #[arg(value_name = "RUN")]
    pub run: Option<String>,

    /// What to show: a run of this machine, or drives in virtual time, which measure each link
    #[arg(long, value_enum, default_value_t = TimeBoard::Host)]
    pub board: TimeBoard,

    #[command(flatten)]
    #[allow(missing_docs)]
    pub json: JsonOption,

    /// How long to show the run [default: until it ends, or Ctrl-C]
    #[arg(long, value_name = "TIME", value_parser = parse_duration)]
    pub duration: Option<f64>,

    /// In virtual time: seed of the first drive
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
}

/// Values of `--board` of `tandem time`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum TimeBoard {
    /// A run of processes on this machine
    Host,
    /// Both systems, a vehicle and a grandmaster in virtual time
    Sim,
}

/// Arguments of `tandem grandmaster`.
#[derive(Debug, Args)]
#[command(after_help = GRANDMASTER_EXAMPLES)]
pub struct GrandmasterArgs {
    /// The domain of the run, as for `tandem run`
    #[arg(long, value_name = "N", default_value_t = 0,
          value_parser = clap::value_parser!(u16).range(0..=230))]
    pub domain: u16,

    /// Address of the network interface of that domain
    #[arg(long, value_name = "ADDRESS", default_value_t = Ipv4Addr::LOCALHOST)]
    pub interface: Ipv4Addr,

    /// The time that it gives
    #[arg(long, value_enum, default_value_t = GrandmasterScale::Tai)]
    pub scale: GrandmasterScale,

    /// How long to give the time [default: until Ctrl-C]
    #[arg(long, value_name = "TIME", value_parser = parse_duration)]
    pub duration: Option<f64>,

    /// The file that it writes; it ends when its standard input closes
    #[arg(long, hide = true)]
    pub leaves: Option<PathBuf>,

    /// Claim real time
    #[arg(long, hide = true)]
    pub realtime: bool,
}

/// Values of `--scale` and of `--grandmaster`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum, strum::Display)]
#[strum(serialize_all = "snake_case")]
pub enum GrandmasterScale {
    /// TAI, from the machine's clock at the start and 37 s
    Tai,
    /// The time since the machine was started
    Arbitrary,
}
