//! The arguments of `tandem exec`.

use std::path::PathBuf;

use clap::{Args, Subcommand};
use tandem_page::json::JsonOption;

use crate::exec_sign::SignArgs;

const EXEC_EXAMPLES: &str = "\
A manifest, platform.toml:
  version = 1
  initial = \"drive\"
  fallback = \"limp\"

  [[process]]
  name = \"camera\"
  program = \"bin/camera\"             # relative to the manifest's folder
  ready = \"report\"                   # it says READY=1 on NOTIFY_SOCKET (systemd's protocol)
  ready-within = \"2s\"
  restart = { times = 3, pause = \"100ms\" }

  [[process]]
  name = \"fusion\"
  program = \"bin/fusion\"
  after = [\"camera\"]
  alive = { every = \"100ms\" }        # it says WATCHDOG=1 at least once in each cycle

  [[target]]
  name = \"drive\"
  processes = [\"fusion\"]             # and all that it depends on

  [[target]]
  name = \"limp\"
  processes = [\"camera\"]

Examples:
  tandem exec check platform.toml    says by line and key what is wrong; starts nothing
  tandem exec run platform.toml      runs it until Ctrl-C, or until nothing is left to run
  tandem exec ps platform.toml       in another terminal: what runs, and in which state
  tandem exec target platform.toml limp
  tandem exec sign platform.toml --key key.der      then run it with --anchor anchor.toml

docs/execution.md describes every key, and what happens when a process or the launcher fails.
It fails with 1 if the safe state or the unrecoverable state was entered; then all is cleaned up.";

/// Arguments of `tandem exec`.
#[derive(Debug, Args)]
#[command(after_help = EXEC_EXAMPLES)]
pub struct ExecArgs {
    /// What to do.
    #[command(subcommand)]
    pub command: ExecCommand,
}

/// The subcommands of `tandem exec`.
#[derive(Debug, Subcommand)]
pub enum ExecCommand {
    /// Run the processes of a manifest, supervised, until Ctrl-C
    Run(ExecRunArgs),
    /// Check a manifest, and that its programs may run; start nothing
    Check(ManifestArgs),
    /// List the processes of a manifest that runs
    Ps(ManifestArgs),
    /// Switch to another run target, and wait until all of it is ready
    Target(ExecTargetArgs),
    /// Sign the manifest, its programs and all that these need, for an anchor
    Sign(SignArgs),
    /// Launch; the guardian of `tandem exec run` starts this
    #[command(hide = true)]
    Launcher(ManifestArgs),
}

/// Which manifest.
#[derive(Clone, Debug, Args)]
pub struct ManifestArgs {
    /// The manifest
    pub manifest: PathBuf,

    /// Trust only what this anchor permits [default: trust all files as they are]
    #[arg(long, value_name = "FILE")]
    pub anchor: Option<PathBuf>,

    #[command(flatten)]
    #[allow(missing_docs)]
    pub json: JsonOption,
}

/// Arguments of `tandem exec run`.
#[derive(Debug, Args)]
pub struct ExecRunArgs {
    #[command(flatten)]
    #[allow(missing_docs)]
    pub of: ManifestArgs,

    /// Command of the pre-clean-up, in place of the manifest's; runs also if the manifest cannot be
    /// read
    #[arg(long, value_name = "COMMAND")]
    pub pre_clean_up: Option<String>,

    /// Command of the post-clean-up, in place of the manifest's; likewise
    #[arg(long, value_name = "COMMAND")]
    pub post_clean_up: Option<String>,
}

/// Arguments of `tandem exec target`.
#[derive(Debug, Args)]
pub struct ExecTargetArgs {
    /// The manifest
    pub manifest: PathBuf,

    /// The run target
    pub target: String,
}
