//! Starts the programs that implement the commands whose dependencies a drive does not need. Each
//! program is built at its first use.

use std::ffi::{OsStr, OsString};
use std::os::unix::process::CommandExt as _;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{Duration, Instant};

use anyhow::{Context as _, anyhow};

use crate::failure::Failure;

/// Cargo takes less time than this if everything is up to date.
const UP_TO_DATE_WITHIN: Duration = Duration::from_millis(500);
const POLL_INTERVAL: Duration = Duration::from_millis(5);

/// A separate program that implements some of the commands of `tandem`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Program {
    /// The benchmarks, with the libraries that they compare.
    Bench,
    /// The bus of a run on a SocketCAN interface.
    Can,
    /// Runs in Foxglove, with its SDK.
    Foxglove,
    /// Virtual time, emulators, campaigns and experiments.
    Lab,
    /// The live view in a terminal.
    Top,
    /// The live view in a browser.
    Web,
}

impl Program {
    const fn name(self) -> &'static str {
        match self {
            Self::Bench => "tandem-bench",
            Self::Can => "tandem-can",
            Self::Foxglove => "tandem-foxglove",
            Self::Lab => "tandem-lab",
            Self::Top => "tandem-top",
            Self::Web => "tandem-web",
        }
    }

    const fn package(self) -> &'static str {
        match self {
            Self::Bench => "tandem-benches",
            Self::Can | Self::Foxglove | Self::Lab | Self::Top | Self::Web => self.name(),
        }
    }
}

/// Arguments of a command that another program implements, passed on unchanged.
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

/// Replaces this process by the program, with these arguments. Returns only on failure.
///
/// If this program runs from cargo's target folder and its sources exist, cargo first rebuilds the
/// other program if needed. If cargo fails, the existing program runs, with a warning on stderr.
///
/// # Errors
/// [`Failure::Usage`] if the program is missing.
pub fn become_program(program: Program, arguments: &[OsString]) -> Result<(), Failure> {
    let path = built(program).map_err(Failure::Usage)?;
    let error = Command::new(&path).args(arguments).exec();
    Err(Failure::Usage(missing(program, &path, &error)))
}

/// Returns the error that the program does not start.
pub(crate) fn missing(program: Program, path: &Path, error: &std::io::Error) -> anyhow::Error {
    let (shown, package) = (path.display(), program.package());
    anyhow!("{shown}: {error}; build it: cargo build --release -p {package}")
}

/// Returns the path of the program, built as [`become_program`] describes.
///
/// # Errors
/// If it does not exist, and cargo fails.
pub(crate) fn built(program: Program) -> anyhow::Result<PathBuf> {
    let folder = this_file()?.with_file_name("");
    let path = folder.join(program.name());
    let is_there = path.exists();
    match build(program, &folder) {
        Err(error) if is_there => eprintln!("{} may be out of date: {error:#}", path.display()),
        built => built?,
    }
    Ok(path)
}

/// Returns the path of this program's file. If the program runs from a sealed copy in memory, that
/// is the path by which it was started.
fn this_file() -> anyhow::Result<PathBuf> {
    let this = std::env::current_exe().context("where this program is")?;
    match this.as_os_str().as_encoded_bytes().starts_with(b"/memfd:") {
        true => Ok(std::env::args_os().next().context("its name")?.into()),
        false => Ok(this),
    }
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
        None => anyhow::bail!("{} is not the folder of a build profile", folder.display()),
    };
    let cargo = std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into());
    let mut command = Command::new(cargo);
    // Name both packages, so that cargo selects the same features as for this program and reuses
    // its build.
    command.args(["build", "--quiet", "-p", "tandem", "-p", program.package()]);
    command.args(["--bin", program.name(), "--profile", profile]);
    command.arg("--target-dir").arg(target);
    // Use cargo's configuration in the source folder, not the one in the caller's folder.
    command.current_dir(sources);
    let mut cargo = command.spawn().with_context(|| format!("{command:?}"))?;
    let deadline = Instant::now() + UP_TO_DATE_WITHIN;
    while cargo.try_wait()?.is_none() && Instant::now() < deadline {
        std::thread::sleep(POLL_INTERVAL);
    }
    if cargo.try_wait()?.is_none() {
        eprintln!("building {}", program.name());
    }
    let status = cargo.wait()?;
    anyhow::ensure!(status.success(), "{command:?} ended with {status}");
    Ok(())
}
