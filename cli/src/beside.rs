//! Programs beside this one: commands that need what no drive needs, built when first asked for.

use std::ffi::{OsStr, OsString};
use std::os::unix::process::CommandExt as _;
use std::path::Path;
use std::process::Command;
use std::time::{Duration, Instant};

use anyhow::{Context as _, anyhow};

use crate::failure::Failure;

/// Cargo takes less to find that nothing is to be built.
const NOTHING_TO_BUILD: Duration = Duration::from_millis(500);
const LOOK_AGAIN: Duration = Duration::from_millis(5);

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
pub struct PassedArguments {
    /// `--help` lists them
    #[arg(
        trailing_var_arg = true,
        allow_hyphen_values = true,
        value_name = "ARGUMENT"
    )]
    words: Vec<OsString>,
}

/// Becomes the program, with these arguments; returns only if it cannot. In a folder of cargo's
/// beside the sources, cargo builds it first: it is never older than the sources. Where cargo
/// cannot, the program that lies there is as old as a line on stderr says.
///
/// # Errors
/// [`Failure::Usage`] if it is missing.
pub fn become_program(program: Program, arguments: &[OsString]) -> Result<(), Failure> {
    let this = std::env::current_exe().context("where this program is");
    let folder = this.map_err(Failure::Usage)?.with_file_name("");
    let path = folder.join(program.name());
    let is_there = path.exists();
    match build(program, &folder) {
        Err(error) if is_there => eprintln!("{} may be old: {error:#}", path.display()),
        built => built.map_err(Failure::Usage)?,
    }
    let error = Command::new(&path).args(arguments).exec();
    let (shown, package) = (path.display(), program.package());
    Err(Failure::Usage(anyhow!(
        "{shown}: {error}; put it there: cargo build --release -p {package}"
    )))
}

fn build(program: Program, folder: &Path) -> anyhow::Result<()> {
    let sources = Path::new(env!("CARGO_MANIFEST_DIR"));
    if !folder.join(".cargo-lock").exists() || !sources.join("Cargo.toml").exists() {
        return Ok(());
    }
    let target = folder.parent().context("a target folder")?;
    let profile = match folder.file_name().and_then(OsStr::to_str) {
        Some("debug") => "dev",
        Some(name) => name,
        None => anyhow::bail!("{} is no folder of a profile", folder.display()),
    };
    let cargo = std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into());
    let mut command = Command::new(cargo);
    // Both packages: with the features of both, cargo uses what it has built for this program.
    command.args(["build", "--quiet", "-p", "tandem", "-p", program.package()]);
    command.args(["--bin", program.name(), "--profile", profile]);
    command.arg("--target-dir").arg(target);
    // The settings of the sources' folder count, and not those of the caller's.
    command.current_dir(sources);
    let mut cargo = command.spawn().with_context(|| format!("{command:?}"))?;
    let patience = Instant::now() + NOTHING_TO_BUILD;
    while cargo.try_wait()?.is_none() && Instant::now() < patience {
        std::thread::sleep(LOOK_AGAIN);
    }
    if cargo.try_wait()?.is_none() {
        eprintln!("building {}", program.name());
    }
    let status = cargo.wait()?;
    anyhow::ensure!(status.success(), "{command:?} ended with {status}");
    Ok(())
}
