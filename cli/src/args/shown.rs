//! The arguments of the commands that show a run live. The programs `tandem-foxglove` and
//! `tandem-web` implement them.

use std::path::PathBuf;

use clap::Args;
use tandem_page::json::JsonOption;

use super::RunChoice;

const FOXGLOVE_EXAMPLES: &str = "\
Examples:
  tandem run --mcap run.mcap         records a run from its start
  tandem run --foxglove              shows it live: open ws://localhost:8765 in Foxglove
  tandem foxglove                    shows a run that drives already, until it ends, or Ctrl-C
  tandem foxglove --mcap rest.mcap   records the rest of it

In Foxglove, import the layout cli/foxglove/layout.json. docs/foxglove.md describes the channels.";

const WEB_EXAMPLES: &str = "\
The page shows roles, lane, gaps and events. Its buttons do what the keys of `tandem top` do; they
need the token, which the printed address contains after the `#`. Other programs may use the same
server: GET /state is the state as JSON, GET /events a stream of it (server-sent events), and

  curl -H 'Authorization: Bearer TOKEN' -H 'Content-Type: application/json' \\
       -d '{\"hand\": \"kill-supply\", \"system\": \"master\"}' http://127.0.0.1:PORT/hands";

/// Arguments of `tandem foxglove`.
#[derive(Debug, Args)]
#[command(after_help = FOXGLOVE_EXAMPLES)]
pub struct FoxgloveArgs {
    /// The run
    #[command(flatten)]
    pub run: RunChoice,

    /// Record to this file; an existing one must be an MCAP file
    #[arg(long, value_name = "FILE")]
    pub mcap: Option<PathBuf>,

    /// Show live at this port of this machine; 0 chooses one [default: 8765 without --mcap]
    #[arg(long, value_name = "PORT")]
    pub port: Option<u16>,

    /// `tandem run` names the run on stdin, and ends this program by closing it
    #[arg(long, hide = true)]
    pub beside: bool,
}

/// Arguments of `tandem web`.
#[derive(Debug, Args)]
#[command(after_help = WEB_EXAMPLES)]
pub struct WebArgs {
    /// Port on 127.0.0.1 [default: a free one]
    #[arg(
        long,
        value_name = "PORT",
        default_value_t = 0,
        hide_default_value = true
    )]
    pub port: u16,

    /// `tandem run` names the run on stdin, and ends this program by closing it
    #[arg(long, hide = true)]
    pub beside: bool,

    #[command(flatten)]
    #[allow(missing_docs)]
    pub json: JsonOption,

    /// The run
    #[command(flatten)]
    pub run: RunChoice,
}
