//! `tandem bench`: builds and starts `tandem-bench`, which nothing else of the command needs.

use std::ffi::OsString;
use std::os::unix::process::CommandExt as _;
use std::path::Path;
use std::process::Command;

use anyhow::{Context as _, anyhow};

use crate::failure::Failure;

/// Arguments of `tandem bench`, as `tandem-bench` reads them.
#[derive(Clone, Debug, clap::Args)]
#[command(disable_help_flag = true)]
pub(crate) struct BenchArgs {
    /// `--help` lists them
    #[arg(
        trailing_var_arg = true,
        allow_hyphen_values = true,
        value_name = "ARGUMENT"
    )]
    words: Vec<OsString>,
}

/// Becomes `tandem-bench`. In a folder of cargo's beside the sources, cargo builds it first: it is
/// never older than the sources.
pub(crate) fn run(args: &BenchArgs) -> Result<(), Failure> {
    let usage = |error: anyhow::Error| Failure::Usage(error);
    let this = std::env::current_exe().context("where this program is");
    let folder = this.map_err(usage)?.with_file_name("");
    build(&folder).map_err(usage)?;
    let program = folder.join("tandem-bench");
    let error = Command::new(&program).args(&args.words).exec();
    let shown = program.display();
    Err(Failure::Usage(anyhow!(
        "{shown}: {error}; put it there: cargo build --release -p tandem-benches"
    )))
}

fn build(folder: &Path) -> anyhow::Result<()> {
    let sources = concat!(env!("CARGO_MANIFEST_DIR"), "/Cargo.toml");
    if !folder.join(".cargo-lock").exists() || !Path::new(sources).exists() {
        return Ok(());
    }
    let target = folder.parent().context("a target folder")?;
    let cargo = std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into());
    let mut command = Command::new(cargo);
    // Both packages: with the features of both, cargo uses what it has built for this program.
    command.args(["build", "--quiet", "-p", "tandem", "-p", "tandem-benches"]);
    command.args(["--bin", "tandem-bench", "--manifest-path", sources]);
    command.arg("--target-dir").arg(target);
    if !cfg!(debug_assertions) {
        command.arg("--release");
    }
    if !folder.join("tandem-bench").exists() {
        eprintln!("building tandem-bench, with its peers: once");
    }
    let status = command.status().with_context(|| format!("{command:?}"))?;
    anyhow::ensure!(status.success(), "{command:?} ended with {status}");
    Ok(())
}
