//! Programs beside this one: commands that need what no drive needs, built when first asked for.

use std::ffi::OsString;
use std::os::unix::process::CommandExt as _;
use std::path::Path;
use std::process::Command;

use anyhow::{Context as _, anyhow};

use crate::failure::Failure;

/// A program that has the same command line, and some of the commands.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Program {
    /// The benchmark, with its peers.
    Bench,
    /// Virtual time, emulators, campaigns and experiments.
    Lab,
    /// The live view.
    Top,
}

impl Program {
    const fn name(self) -> &'static str {
        match self {
            Self::Bench => "tandem-bench",
            Self::Lab => "tandem-lab",
            Self::Top => "tandem-top",
        }
    }

    const fn package(self) -> &'static str {
        match self {
            Self::Bench => "tandem-benches",
            Self::Lab | Self::Top => self.name(),
        }
    }
}

/// Arguments of a command of another program, as that program reads them.
#[derive(Clone, Debug, clap::Args)]
#[command(disable_help_flag = true)]
pub struct Words {
    /// `--help` lists them
    #[arg(
        trailing_var_arg = true,
        allow_hyphen_values = true,
        value_name = "ARGUMENT"
    )]
    words: Vec<OsString>,
}

/// Becomes the program, with these arguments; returns only if it cannot. In a folder of cargo's
/// beside the sources, cargo builds it first: it is never older than the sources.
///
/// # Errors
/// [`Failure::Usage`] if it is missing or cannot be built.
pub fn become_program(program: Program, arguments: &[OsString]) -> Result<(), Failure> {
    let this = std::env::current_exe().context("where this program is");
    let folder = this.map_err(Failure::Usage)?.with_file_name("");
    build(program, &folder).map_err(Failure::Usage)?;
    let path = folder.join(program.name());
    let error = Command::new(&path).args(arguments).exec();
    let (shown, package) = (path.display(), program.package());
    Err(Failure::Usage(anyhow!(
        "{shown}: {error}; put it there: cargo build --release -p {package}"
    )))
}

fn build(program: Program, folder: &Path) -> anyhow::Result<()> {
    let sources = concat!(env!("CARGO_MANIFEST_DIR"), "/Cargo.toml");
    if !folder.join(".cargo-lock").exists() || !Path::new(sources).exists() {
        return Ok(());
    }
    let target = folder.parent().context("a target folder")?;
    let cargo = std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into());
    let mut command = Command::new(cargo);
    // Both packages: with the features of both, cargo uses what it has built for this program.
    command.args(["build", "--quiet", "-p", "tandem", "-p", program.package()]);
    command.args(["--bin", program.name(), "--manifest-path", sources]);
    command.arg("--target-dir").arg(target);
    if !cfg!(debug_assertions) {
        command.arg("--release");
    }
    if !folder.join(program.name()).exists() {
        eprintln!("building {}: once", program.name());
    }
    let status = command.status().with_context(|| format!("{command:?}"))?;
    anyhow::ensure!(status.success(), "{command:?} ended with {status}");
    Ok(())
}
