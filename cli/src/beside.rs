//! Starts the programs that implement the commands whose dependencies a drive does not need. Each
//! program is built at its first use.

use std::ffi::{OsStr, OsString};
use std::io::{BufRead as _, BufReader, Write as _};
use std::os::unix::process::CommandExt as _;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::time::{Duration, Instant};

use anyhow::{Context as _, anyhow};
use serde::{Deserialize, Serialize};

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

/// What a program beside a run says, in one line of JSON on stdout, when it has opened its files,
/// ports and interfaces.
#[derive(Debug, Serialize, Deserialize)]
pub enum Ready {
    /// It is ready; what a person must know to use it, in words.
    At(Option<String>),
    /// It cannot open one of them; why.
    Refused(String),
}

impl Ready {
    /// Says it to `tandem run`.
    ///
    /// # Errors
    /// If stdout cannot be written.
    pub fn say(&self) -> anyhow::Result<()> {
        let line = serde_json::to_string(self).context("an answer")?;
        crate::print(&(line + "\n"))
    }
}

/// A program beside a run, as seen by `tandem run`. The run does not depend on it. It ends when its
/// stdin closes; dropping this closes it.
pub(crate) struct Attendant {
    process: Child,
    /// What it is, in words.
    what: &'static str,
    /// It is killed if it needs longer to end.
    ends_within: Duration,
}

impl Attendant {
    /// Starts the program, and waits until it is ready. Cargo may first have to build it. Prints on
    /// stderr what it says.
    ///
    /// # Errors
    /// [`Failure::Usage`] if the program does not start, or refuses. Then nothing is left behind.
    pub(crate) fn start(
        program: Program,
        what: &'static str,
        words: Vec<OsString>,
        ends_within: Duration,
    ) -> Result<Self, Failure> {
        let path = built(program).map_err(Failure::Usage)?;
        let process = Command::new(&path)
            .args(words)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            // Ctrl-C in the terminal must not reach the program, because the run ends it.
            .process_group(0)
            .spawn();
        let missing = |error| Failure::Usage(missing(program, &path, &error));
        let mut attendant = Self {
            process: process.map_err(missing)?,
            what,
            ends_within,
        };
        match attendant.answer().map_err(Failure::Usage)? {
            Ready::Refused(why) => Err(Failure::Usage(anyhow!("{why}"))),
            Ready::At(place) => {
                // Also with `--quiet`: nothing else tells a port that the program has chosen.
                if let Some(place) = place {
                    eprintln!("{place}");
                }
                Ok(attendant)
            }
        }
    }

    fn answer(&mut self) -> anyhow::Result<Ready> {
        let out = self.process.stdout.take().context("a pipe")?;
        let mut line = String::new();
        BufReader::new(out).read_line(&mut line)?;
        serde_json::from_str(&line).with_context(|| format!("the {} ended", self.what))
    }

    /// Writes a line to its stdin.
    pub(crate) fn tell(&mut self, line: &str) {
        if let Some(stdin) = &mut self.process.stdin {
            // If the program has died, its end says so. One line always fits into the pipe.
            let _ = writeln!(stdin, "{line}");
        }
    }

    /// Ends the program. Says if it has failed.
    pub(crate) fn end(mut self) {
        match self.close() {
            Ok(status) if !status.success() => {
                eprintln!("warning: the {} ended with {status}", self.what);
            }
            _ => {}
        }
    }

    /// Closes its stdin. Kills it if it does not end.
    fn close(&mut self) -> std::io::Result<ExitStatus> {
        drop(self.process.stdin.take());
        let begin = Instant::now();
        while self.process.try_wait()?.is_none() {
            if begin.elapsed() > self.ends_within {
                self.process.kill()?;
            }
            std::thread::sleep(POLL_INTERVAL);
        }
        self.process.wait()
    }
}

impl Drop for Attendant {
    fn drop(&mut self) {
        // If it has ended, this has no effect.
        let _ = self.close();
    }
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
fn missing(program: Program, path: &Path, error: &std::io::Error) -> anyhow::Error {
    let (shown, package) = (path.display(), program.package());
    anyhow!("{shown}: {error}; build it: cargo build --release -p {package}")
}

/// Returns the path of the program, built as [`become_program`] describes.
///
/// # Errors
/// If it does not exist, and cargo fails.
fn built(program: Program) -> anyhow::Result<PathBuf> {
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
