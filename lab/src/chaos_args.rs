//! The arguments of `tandem chaos`.

use std::num::NonZero;
use std::path::PathBuf;

use clap::Args;
use tandem::board_kind::DemoBoard;
use tandem_page::json::JsonOption;

/// Arguments of `tandem chaos`.
#[derive(Debug, Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct ChaosArgs {
    /// How many faults
    #[arg(long, value_name = "N", default_value_t = 60)]
    pub(crate) count: u64,

    /// Seed that selects the faults
    #[arg(long, value_name = "S", default_value_t = 1)]
    pub(crate) seed: u64,

    /// Where the faults occur: in processes of this machine, or in emulated machines with firmware
    #[arg(long, value_enum, default_value_t = DemoBoard::Host)]
    pub(crate) board: DemoBoard,

    /// The number of the first fault
    #[arg(long, value_name = "N", default_value_t = 0)]
    pub(crate) from: u64,

    /// Try the faults of this TOML file, --count times
    #[arg(long, value_name = "FILE")]
    pub(crate) faults: Option<PathBuf>,

    /// Try each fault of the master and of the standby at 20 phases of the control cycle
    #[arg(long, conflicts_with_all = ["faults", "count"])]
    pub(crate) matrix: bool,

    /// Try only every N-th cell of the matrix
    #[arg(long, value_name = "N", default_value_t = NonZero::<u64>::MIN, requires = "matrix")]
    pub(crate) every: NonZero<u64>,

    /// Try only the fault with this number
    #[arg(long, value_name = "NUMBER", conflicts_with_all = ["from", "count", "every"])]
    pub(crate) only: Option<u64>,

    #[command(flatten)]
    #[allow(missing_docs)]
    pub(crate) json: JsonOption,

    /// Inject these faults in one drive and exit; internal, started by the campaign
    #[arg(long, hide = true, num_args = 2, value_names = ["FROM", "TO"])]
    pub(crate) drive: Option<Vec<u64>>,
}

const EXAMPLES: &str = "\
The faults are those of `tandem sim`. Each drive injects one fault after the other into a master and
a standby. After each, everything is restored, and the systems must be master and standby again. The
report has, for each class of faults, how long the other system needed to notice, and how long the
vehicle was without control, beside the bound that is computed. A gap beyond its bound is no
violation if the evidence shows that the machine itself stood still for that long.

  tandem chaos --count 200 --seed 7          random faults, about 4 s each
  tandem chaos --only 137 --seed 7           one of them again
  tandem chaos --matrix --every 10           each fault at some phases of the 10 ms cycle
  tandem chaos --board qemu --count 100      firmware in two emulated machines, in virtual time
  tandem chaos --faults my.toml --count 20   a file of `tandem sim --save`, where A is the system
                                             that drives, and B the standby

After Ctrl-C it reports what was done.";

impl ChaosArgs {
    /// Returns the arguments that make a drive omit the same cells of the matrix.
    pub(crate) fn every_arguments(&self) -> Vec<String> {
        match self.matrix {
            true => vec!["--every".to_owned(), self.every.to_string()],
            false => vec![],
        }
    }
}
