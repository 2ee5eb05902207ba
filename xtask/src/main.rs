//! Every developer task as `cargo xtask …`.
#![forbid(unsafe_code)]
#![allow(clippy::print_stdout, reason = "a command line prints")]

mod broken;
mod failure_modes;
mod figures;
mod firmware;
mod instructions;
mod licences;
mod mutants;
mod names;
mod outside;
mod package;
mod release;
mod requirements;
mod rooms;
mod rta;
mod sizes;
mod suites;
mod task_tables;
mod test_runner;
mod tidy;
mod toolchain;
mod topics;
mod weakened;

use anyhow::{Context, Result, bail, ensure};
use clap::{Parser, Subcommand};
use std::env;
use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode};

/// Crates that run in firmware: no_std, without dependencies on a board.
const PORTABLE: [&str; 8] = [
    "tandem-shm",
    "tandem-bus",
    "tandem-board",
    "tandem-peripherals",
    "tandem-redundancy",
    "tandem-boot",
    "tandem-cores",
    "tandem-capi",
];
/// The crates that contain the RTOS, each with the only bare-metal target that has its port.
const RTOS: [(&str, &str); 2] = [
    ("tandem-rtos", "riscv32imac-unknown-none-elf"),
    ("tandem-runtime", "riscv32imac-unknown-none-elf"),
];
/// Bare-metal targets that every portable crate builds for.
const BARE_METAL: [&str; 3] = [
    "riscv32imac-unknown-none-elf",
    "thumbv7em-none-eabihf",
    "thumbv8m.main-none-eabi",
];

#[derive(Parser)]
#[command(about = "Developer tasks of Tandem")]
struct Arguments {
    #[command(subcommand)]
    task: Task,
}

#[derive(Subcommand)]
enum Task {
    /// Run all tests of the workspace, with cargo-nextest if it is installed, and list what failed
    Test,
    /// Check the licences and sources of all dependencies against deny.toml
    Licences,
    /// Pack the crates that others may depend on, and build each from its package
    Package,
    /// What precedes a release: `package`, then compare what the crates offer with the last release
    /// (needs cargo-semver-checks), which must not break a user within one version
    Release {
        /// The revision to compare with [default: the last tag v*]
        #[arg(long, value_name = "REVISION")]
        baseline: Option<String>,
    },
    /// Build, run and test projects outside the tree that have only the packages: on two cores of
    /// RISC-V and on a Cortex-M4 under QEMU, and with the features for a HAL
    Outside,
    /// Check the house rules: permitted dependencies, file heads and sizes, unsafe code only where
    /// allowed, shared names, the lines of each room
    Tidy {
        /// Write the current number of lines of each room to the table in docs/rooms.md
        #[arg(long)]
        save: bool,
    },
    /// List the requirements and the tests that name them
    Requirements {
        /// Exit with an error if no test names one of these requirements: all whose id begins with
        /// PREFIX, for example T-RED or T-RED-4
        #[arg(long, value_name = "PREFIX", value_delimiter = ',')]
        require: Vec<String>,
    },
    /// Build every portable crate for the bare-metal targets
    BareMetal,
    /// Write the header for firmware in C from the crate `tandem-capi`
    CHeader {
        /// Only report whether the header is stale
        #[arg(long)]
        check: bool,
    },
    /// Write the code of `tandem-bus` from `bus/dbc/tandem.dbc`
    Dbc {
        /// Only report whether the code is stale
        #[arg(long)]
        check: bool,
    },
    /// Write the types of `tandem-topics` from `topics/idl/tandem.idl`
    Idl {
        /// Only report whether the code is stale
        #[arg(long)]
        check: bool,
    },
    /// Model-check the primitives of shm with loom
    Loom {
        /// Relax each memory ordering in turn: a model must fail (twenty minutes)
        #[arg(long)]
        weakened: bool,
        /// Only orderings in functions whose name contains this text
        #[arg(long, requires = "weakened", default_value = "")]
        only: String,
        /// Also the models that take half a minute or more
        #[arg(long, conflicts_with = "weakened")]
        long: bool,
    },
    /// Run the tests of shm under Miri, for 64 and 32 bits, and those of its interface for C
    Miri {
        /// Only for a 32-bit target, like the firmware
        #[arg(long)]
        quick: bool,
    },
    /// Build, run and measure the bare-metal images under QEMU
    #[command(subcommand)]
    Firmware(firmware::Firmware),
    /// Compute the worst response times of core 0's tasks from the metrics.json of a run, and write
    /// them into docs/rtos-tasks.md
    Rta {
        /// The run's metrics.json
        metrics: PathBuf,
        /// The cost of a task switch, and of the entry of an interrupt, in µs: `tandem bench rtos`
        #[arg(long, value_name = "US")]
        overhead_us: f64,
    },
    /// Build broken variants of the product (tests/broken/*.patch), and check that each one fails
    /// the test that it names
    Broken {
        /// Only variants whose name contains this text
        #[arg(default_value = "")]
        name: String,
        /// Only report whether all patches apply
        #[arg(long)]
        check: bool,
    },
    /// Write docs/figures.md from the measurements in docs/figures and firmware-port/baseline.json
    Figures {
        /// First copy these figures: a file of `tandem bench --json`, of a release build
        #[arg(long, value_name = "FILE")]
        bench: Option<PathBuf>,
        /// First copy these figures: the metrics.json of a run
        #[arg(long, value_name = "FILE")]
        run: Option<PathBuf>,
        /// Only report whether the page is stale
        #[arg(long)]
        check: bool,
    },
    /// Run the suites and oracles of other projects, and print what passed
    Suites {
        /// Write the table to docs/suites.md
        #[arg(long)]
        save: bool,
        /// Run none; only report whether the page fits the suites
        #[arg(long, conflicts_with = "save")]
        check: bool,
    },
    /// Count the host instructions of the primitives under valgrind, and compare them with
    /// benches/two-cores/instructions.json
    Instructions {
        /// Replace the table with these counts
        #[arg(long)]
        save: bool,
    },
    /// Write the tables of tasks in docs/ from the task table in the code
    #[command(name = "task-tables")]
    Tables {
        /// Only report whether a table is stale
        #[arg(long)]
        check: bool,
    },
    /// Long tests that a person starts; CI runs short ones of each
    #[command(subcommand)]
    Campaign(Campaign),
}

#[derive(Subcommand)]
enum Campaign {
    /// Kill a process of a starting run repeatedly, then start normally
    StartupKills {
        /// How many starts to kill
        #[arg(long, default_value_t = 200)]
        count: u32,
    },
    /// Judge the times of runs with real processes: takeovers within their bounds. Reports how
    /// often it tried again because the machine stalled
    Processes {
        /// How often to repeat each drive
        #[arg(long, default_value_t = 3)]
        rounds: u32,
    },
    /// Run random task sets on FreeRTOS and compare their schedules with a model's
    RtosSoak {
        /// How long, in minutes
        #[arg(long, default_value_t = 10)]
        minutes: u32,
        /// The number of the first set; each further one has the next number
        #[arg(long, default_value_t = 1)]
        seed: u64,
    },
    /// Cut the power at every byte of every flash operation of an update, and again while the
    /// controller recovers; each incarnation is a separate process. Fails if a cut bricks it
    PowerCuts {
        /// Write {points, bricks} to this file
        #[arg(long, value_name = "FILE")]
        json: Option<PathBuf>,
        /// Cut only at every N-th moment
        #[arg(long, default_value_t = 1)]
        every: u64,
        /// Test a bootloader with this defect instead; fails if no controller is bricked
        #[arg(long, value_name = "one-slot|one-bank")]
        broken: Option<String>,
        /// Type of flash: aurix erases to 0, and has an ECC
        #[arg(long, value_name = "plain|aurix")]
        flash: Option<String>,
    },
    /// Change good download files in many ways and count those that the bootloader wrongly accepts
    Mutations {
        /// How many files
        #[arg(long, default_value_t = 100_000)]
        count: u64,
        /// Write {files, wrong} to this file
        #[arg(long, value_name = "FILE")]
        json: Option<PathBuf>,
        /// Accept unsigned files; fails if none is accepted wrongly
        #[arg(long)]
        monitor: bool,
    },
    /// Damage good inputs in many ways: their readers must refuse or use each, within 5 s and 1 GB
    Fuzz {
        /// The readers, by their names in tests/fuzz/src/lib.rs; all if none is given
        targets: Vec<String>,
        /// How many inputs for each
        #[arg(long, default_value_t = 100_000)]
        count: u64,
        /// The number of the first input; the same number always produces the same input
        #[arg(long, default_value_t = 0)]
        seed: u64,
        /// Instead, search each reader with libFuzzer for this many seconds; needs cargo-fuzz and
        /// a nightly compiler
        #[arg(long, conflicts_with_all = ["count", "seed"])]
        seconds: Option<u64>,
    },
    /// Simulate sequences of faults with and without optimisation: every frame and event must be
    /// the same, to the bit
    SimDigest {
        /// How many sequences, for each setting of time, with and without the closed loop
        #[arg(long, default_value_t = 20)]
        count: u64,
    },
    /// Drive without a fault in virtual time. Fails if a system finds anything wrong
    FreeDrives {
        /// How many hours in all, in drives of 10 minutes
        #[arg(long, default_value_t = 8)]
        hours: u32,
        /// The scenarios, by name or CommonRoad file [default: the embedded ones]
        scenarios: Vec<String>,
    },
    /// Lie to all cores of both systems, one signal after the other. Fails if the vehicle gets
    /// farther off its lane than documented
    WrongInBoth,
    /// Stop a core of a system at each access to shared memory, while it drives and while it starts
    Stops {
        /// Stop only at each N-th access
        #[arg(long, default_value_t = 97)]
        every: usize,
    },
    /// Explore every state that two systems reach with this many faults of systems and wires
    States {
        /// How many faults in each sequence
        #[arg(long, default_value_t = 2)]
        faults: u32,
    },
    /// Change one expression or function at a time (needs cargo-mutants): fails if the tests of the
    /// crate miss more than 5 % of the changes (tandem-boot: 2 %)
    Mutants {
        /// Only these packages; by default tandem-boot, tandem-bus, tandem-redundancy and
        /// tandem-shm
        packages: Vec<String>,
        /// Only each N-th change
        #[arg(long, default_value_t = 1)]
        every: u32,
        /// The first change, below N; another number selects other changes
        #[arg(long, default_value_t = 0)]
        from: u32,
    },
    /// Exchange topics with Cyclone DDS and dust_dds: each pair of writer and reader, with late
    /// readers, loss and a quality of service that does not fit. Prints the table of all cells
    Topics {
        /// Write {cells, passed, skipped} to this file
        #[arg(long, value_name = "FILE")]
        json: Option<PathBuf>,
    },
    /// Lose, double, swap, delay and corrupt messages of time, let clocks jump, and lie, in random
    /// sequences. Fails if a reader's time goes back, leaps or stops untold, or a stated error is
    /// exceeded without a liar
    Time {
        /// How many sequences
        #[arg(long, default_value_t = 100_000)]
        count: u64,
        /// The number of the first sequence; the same number always produces the same one
        #[arg(long, default_value_t = 0)]
        first: u64,
        /// Write {sequences, violations} to this file
        #[arg(long, value_name = "FILE")]
        json: Option<PathBuf>,
    },
    /// Kill, freeze and end the processes of a platform at random, also its launcher, its guardian,
    /// redundant clients and their masters. Fails if something is left behind, if an activation is
    /// wrong, or if outputs differ
    Launch {
        /// How many kills
        #[arg(long, default_value_t = 10_000)]
        count: u64,
        /// Repeats the choices of an earlier campaign [default: a new one]
        #[arg(long)]
        seed: Option<u64>,
        /// Write {kills, violations} to this file
        #[arg(long, value_name = "FILE")]
        json: Option<PathBuf>,
    },
    /// Two redundant clients at 1 kHz. Fails if an overrun is not explained by a stall of the
    /// machine
    Activations {
        /// How long, in seconds
        #[arg(long, default_value_t = 60)]
        seconds: u32,
    },
    /// Damage each part of a signed platform, and replace each part between check and start.
    /// Fails if a process runs what was not signed. Prints what a check costs
    Tamper {
        /// Write {cases, accepted} to this file
        #[arg(long, value_name = "FILE")]
        json: Option<PathBuf>,
    },
    /// Compare the tick of FreeRTOS, and the periods of three tasks, with the clock
    RtosDrift {
        /// How long, in seconds
        #[arg(long, default_value_t = 60)]
        seconds: u32,
    },
}

fn main() -> ExitCode {
    match execute() {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error:#}");
            ExitCode::FAILURE
        }
    }
}

fn execute() -> Result<()> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"))
        .parent()
        .context("xtask has no parent")?;
    match Arguments::parse().task {
        Task::Test => test_runner::test(root),
        Task::Licences => licences::run(root),
        Task::Release { baseline } => release::run(root, baseline),
        Task::Outside => outside::run(root),
        Task::Package => package::run(root),
        Task::Tidy { save } => tidy::run(root, save),
        Task::Requirements { require } => requirements::run(root, &require),
        Task::Broken { name, check } => broken::run(root, &name, check),
        Task::BareMetal => bare_metal(root),
        Task::CHeader { check } => {
            generated(root, "tandem-capi", "header", "TANDEM_WRITE_HEADER", check)
        }
        Task::Dbc { check } => generated(root, "tandem-bus", "dbc", "TANDEM_WRITE_DBC", check),
        Task::Idl { check } => generated(root, "tandem-topics", "idl", "TANDEM_WRITE_IDL", check),
        Task::Loom {
            weakened: false,
            long,
            ..
        } => loom(root, long),
        Task::Loom { only, .. } => weakened::run(root, &only),
        Task::Miri { quick } => miri(root, quick),
        Task::Figures { bench, run, check } => {
            figures::run(root, bench.as_deref(), run.as_deref(), check)
        }
        Task::Suites { save, check } => suites::run(root, save, check),
        Task::Instructions { save } => instructions::run(root, save),
        Task::Firmware(task) => firmware::run(root, task),
        Task::Rta {
            metrics,
            overhead_us,
        } => rta::run(root, &metrics, overhead_us),
        Task::Tables { check } => task_tables::run(root, check),
        Task::Campaign(campaign) => start(root, campaign),
    }
}

/// Starts a campaign.
fn start(root: &Path, campaign: Campaign) -> Result<()> {
    // Runs one test of a package and shows its output. The test reads these environment variables.
    let test = |package: &str, file: &str, name: &str, variables: &[(&str, u64)]| {
        let mut command = cargo(root, &["test", "--release", "-p", package, "--test", file]);
        command.args([name, "--", "--nocapture"]);
        command.envs(
            variables
                .iter()
                .map(|(name, value)| (name, value.to_string())),
        );
        command
    };
    // Runs an example with these options; those without a value are omitted.
    let trial = |name: &str, options: &[(&str, Option<String>)]| {
        let mut command = example(root, "release", name)?;
        for (option, value) in options {
            command.args(value.iter().flat_map(|value| [*option, value]));
        }
        Ok::<_, anyhow::Error>(command)
    };
    let shown = |path: Option<PathBuf>| path.map(|path| path.display().to_string());
    run(match campaign {
        Campaign::StartupKills { count } => {
            let count = ("TANDEM_STARTUP_KILLS", count.into());
            test("tandem", "processes", "any_start", &[count])
        }
        Campaign::Processes { rounds } => {
            let rounds = ("TANDEM_PROCESS_ROUNDS", rounds.into());
            let mut command = test("tandem", "processes", "bounds::", &[rounds]);
            command.arg("--ignored");
            command
        }
        Campaign::RtosSoak { minutes, seed } => {
            let seconds = ("TANDEM_RTOS_SOAK_SECONDS", u64::from(minutes) * 60);
            let variables = [seconds, ("TANDEM_RTOS_SOAK_SEED", seed)];
            test("tandem-rtos", "soak", "random_task_sets", &variables)
        }
        Campaign::RtosDrift { seconds } => {
            let seconds = ("TANDEM_RTOS_DRIFT_SECONDS", seconds.into());
            let name = "the_tick_does_not_drift";
            let mut command = test("tandem-rtos", "scheduling", name, &[seconds]);
            command.arg("three_tasks_run_with_their_periods");
            command
        }
        Campaign::PowerCuts {
            json,
            every,
            broken,
            flash,
        } => {
            let every = ("--every", Some(every.to_string()));
            trial(
                "power_cuts",
                &[
                    every,
                    ("--json", shown(json)),
                    ("--broken", broken),
                    ("--flash", flash),
                ],
            )?
        }
        Campaign::Mutations {
            count,
            json,
            monitor,
        } => {
            let count = ("--count", Some(count.to_string()));
            let mut command = trial("mutations", &[count, ("--json", shown(json))])?;
            command.args(monitor.then_some("--monitor"));
            command
        }
        Campaign::Fuzz {
            targets,
            seconds: Some(seconds),
            ..
        } => {
            return search(root, &targets, seconds);
        }
        Campaign::Fuzz {
            targets,
            count,
            seed,
            ..
        } => {
            let mut command = trial("mutate", &[])?;
            command
                .args([seed.to_string(), count.to_string()])
                .args(targets);
            command
        }
        Campaign::Stops { every } => {
            let every = ("TANDEM_EVERY", every as u64);
            let command = test("tandem-tests", "stops", "at_each_access", &[every]);
            with_cfg(root, command, "stepped")
        }
        Campaign::States { faults } => {
            let name = "every_state_of_bounded_faults_is_safe_and_leads_to_a_driver";
            let faults = ("TANDEM_EXPLORE", faults.into());
            test("tandem-redundancy", "pair", name, &[faults])
        }
        Campaign::FreeDrives { hours, scenarios } => {
            let mut command = trial("free_drives", &[])?;
            command.arg(hours.to_string()).args(scenarios);
            command
        }
        Campaign::Topics { json } => return topics::run(root, json.as_deref()),
        Campaign::Time { count, first, json } => {
            let variables = [
                ("TANDEM_TIME_SEQUENCES", count),
                ("TANDEM_TIME_FIRST", first),
            ];
            let name = "no_reader_is_deceived_untold";
            let mut command = test("tandem-timesync-host", "sequences", name, &variables);
            if let Some(json) = json {
                // The test runs in the folder of its package.
                let json =
                    std::path::absolute(&json).with_context(|| json.display().to_string())?;
                command.env("TANDEM_TIME_JSON", json);
            }
            command
        }
        Campaign::Launch { count, seed, json } => {
            let name = "random_kills_leave_nothing_behind";
            let mut command = test(
                "tandem-exec-host",
                "kills",
                name,
                &[("TANDEM_KILLS", count)],
            );
            command.envs(seed.map(|seed| ("TANDEM_KILLS_SEED", seed.to_string())));
            if let Some(json) = json {
                // The test runs in the folder of its package.
                let json =
                    std::path::absolute(&json).with_context(|| json.display().to_string())?;
                command.env("TANDEM_KILLS_JSON", json);
            }
            command
        }
        Campaign::Activations { seconds } => {
            let mut command = cargo(root, &["run", "--release", "-p", "tandem-benches", "--"]);
            command.args(["overruns", "--seconds", &seconds.to_string()]);
            command
        }
        Campaign::Tamper { json } => {
            let name = "every_changed_part_is_refused";
            let mut command = test("tandem-exec-host", "tamper", name, &[]);
            command.arg("--ignored");
            if let Some(json) = json {
                // The test runs in the folder of its package.
                let json =
                    std::path::absolute(&json).with_context(|| json.display().to_string())?;
                command.env("TANDEM_TAMPER_JSON", json);
            }
            command
        }
        Campaign::WrongInBoth => trial("wrong_in_both", &[])?,
        Campaign::SimDigest { count } => return sim_digest(root, count),
        Campaign::Mutants {
            packages,
            every,
            from,
        } => {
            return mutants::run(root, &packages, every, from);
        }
    })
}

/// Returns the cargo that runs this program. If it was started without cargo, returns the first
/// cargo in the search path.
fn cargo_program() -> OsString {
    env::var_os("CARGO").unwrap_or_else(|| "cargo".into())
}

/// Returns a cargo command in the workspace's root.
fn cargo(root: &Path, arguments: &[&str]) -> Command {
    let mut command = Command::new(cargo_program());
    command.current_dir(root).args(arguments);
    command
}

fn run(mut command: Command) -> Result<()> {
    println!("$ {command:?}");
    succeed(&mut command)
}

/// Runs a command that must end with success.
fn succeed(command: &mut Command) -> Result<()> {
    let status = command
        .status()
        .with_context(|| format!("cannot start {command:?}"))?;
    ensure!(status.success(), "{command:?} ended with {status}");
    Ok(())
}

/// Returns the output of a command that must end with success.
fn output(command: &mut Command) -> Result<String> {
    let output = command
        .output()
        .with_context(|| format!("cannot start {command:?}"))?;
    let said = String::from_utf8_lossy(&output.stderr);
    ensure!(
        output.status.success(),
        "{command:?} ended with {}: {said}",
        output.status
    );
    Ok(String::from_utf8(output.stdout)?)
}

/// Returns the text of a file of the repository.
fn read(path: impl AsRef<Path>) -> Result<String> {
    let path = path.as_ref();
    std::fs::read_to_string(path).with_context(|| path.display().to_string())
}

fn write(path: impl AsRef<Path>, text: &str) -> Result<()> {
    let path = path.as_ref();
    std::fs::write(path, text).with_context(|| path.display().to_string())
}

/// Returns a JSON file of the repository.
fn read_json(path: impl AsRef<Path>) -> Result<serde_json::Value> {
    let path = path.as_ref();
    serde_json::from_str(&read(path)?).with_context(|| path.display().to_string())
}

fn write_json(path: impl AsRef<Path>, value: &serde_json::Value) -> Result<()> {
    write(path, &(serde_json::to_string_pretty(value)? + "\n"))
}

/// Returns the files that git lists, by their paths in the repository.
fn git_files(root: &Path, arguments: &[&str]) -> Result<Vec<String>> {
    let mut git = Command::new("git");
    let listed = output(
        git.current_dir(root)
            .args(["ls-files", "-z"])
            .args(arguments),
    )?;
    let files = listed.split_terminator('\0').map(str::to_owned);
    Ok(files.filter(|file| root.join(file).exists()).collect())
}

/// Selects all files that are tracked or not ignored.
const PRESENT: [&str; 3] = ["--cached", "--others", "--exclude-standard"];

fn bare_metal(root: &Path) -> Result<()> {
    for target in BARE_METAL {
        toolchain::demand(target)?;
        let rtos = RTOS.iter().filter(|(_, has_port)| *has_port == target);
        let packages: Vec<&str> = PORTABLE
            .into_iter()
            .chain(rtos.map(|(name, _)| *name))
            .collect();
        let mut command = cargo(root, &["build", "--quiet", "--profile", "bare-metal"]);
        command.args(["--target", target]);
        command.args(packages.iter().flat_map(|package| ["-p", package]));
        // Not the default folder: cargo locks that during a build, and the tests are built there.
        command.env("CARGO_TARGET_DIR", firmware::build_dir(root));
        run(command)?;
        println!("{} build for {target}", packages.join(", "));
    }
    Ok(())
}

/// Runs a test that writes a generated file if the variable is set, and otherwise compares it.
fn generated(root: &Path, package: &str, test: &str, write: &str, check: bool) -> Result<()> {
    let mut command = cargo(root, &["test", "--quiet", "-p", package, "--test", test]);
    if !check {
        command.env(write, "1");
    }
    run(command)
}

fn loom(root: &Path, long: bool) -> Result<()> {
    let arguments = ["test", "--release", "-p", "tandem-shm", "--test", "loom*"];
    let mut command = cargo(root, &arguments);
    if long {
        command.args(["--", "--include-ignored"]);
    }
    run(with_cfg(root, command, "loom"))
}

/// Adds this `--cfg`, and a separate target folder: in the shared one the flag would cause a full
/// rebuild.
fn with_cfg(root: &Path, mut command: Command, cfg: &str) -> Command {
    command
        .env("RUSTFLAGS", format!("--cfg {cfg}"))
        .env("CARGO_TARGET_DIR", target_dir(root).join(cfg));
    command
}

fn miri(root: &Path, quick: bool) -> Result<()> {
    const BITS_64: &str = "x86_64-unknown-linux-gnu";
    const BITS_32: &str = "i686-unknown-linux-gnu";
    let all = [
        &["-p", "tandem-shm", "--target", BITS_64][..],
        &["-p", "tandem-shm", "--target", BITS_32],
        &["-p", "tandem-capi", "--test", "calls", "--target", BITS_32],
    ];
    for tests in all.into_iter().skip(usize::from(quick)) {
        // The `cargo` of this process belongs to the stable toolchain; the shim chooses nightly.
        let mut command = Command::new("cargo");
        command
            .current_dir(root)
            .env_remove("RUSTUP_TOOLCHAIN")
            .env_remove("CARGO")
            .args(["+nightly", "miri", "test"])
            .args(tests)
            .env("CARGO_TARGET_DIR", target_dir(root).join("miri"));
        run(command)?;
    }
    Ok(())
}

/// Builds an example in this profile; its paths are relative to the caller's folder. Builds the
/// whole workspace, as the tests do: for one package cargo would choose other features of
/// dependencies, and rebuild many of them.
fn example(root: &Path, profile: &str, name: &str) -> Result<Command> {
    let mut build = cargo(root, &["build", "--quiet", "--workspace"]);
    build.args(["--profile", profile, "--example", name]);
    succeed(&mut build)?;
    let folder = if profile == "dev" { "debug" } else { profile };
    let examples = target_dir(root).join(folder).join("examples");
    Ok(Command::new(examples.join(name)))
}

fn sim_digest(root: &Path, count: u64) -> Result<()> {
    let digests = |profile| output(example(root, profile, "digest")?.arg(count.to_string()));
    let (dev, release) = (digests("dev")?, digests("release")?);
    print!("{release}");
    if dev != release || release.is_empty() {
        bail!("the profile dev gives others:\n{dev}");
    }
    Ok(())
}

/// Runs libFuzzer on each of these targets. It keeps interesting inputs in `target/fuzz`.
fn search(root: &Path, targets: &[String], seconds: u64) -> Result<()> {
    let corpora = root.join("tests/fuzz/corpus");
    let mut all = Vec::new();
    for entry in std::fs::read_dir(&corpora).context("tests/fuzz/corpus")? {
        all.push(entry?.file_name().to_string_lossy().into_owned());
    }
    all.sort();
    let targets = if targets.is_empty() { &all } else { targets };
    for target in targets {
        let found = target_dir(root).join("fuzz").join(target);
        std::fs::create_dir_all(&found).with_context(|| found.display().to_string())?;
        // The stable toolchain's cargo does not pass `+nightly` on.
        let mut command = Command::new("rustup");
        command.args(["run", "nightly", "cargo", "fuzz", "run"]);
        command.args(["--fuzz-dir", "tests/fuzz/libfuzzer", "any"]);
        command.args([found, corpora.join(target)]);
        command.arg("--");
        command.arg(format!("-max_total_time={seconds}"));
        command.args(["-timeout=5", "-rss_limit_mb=1024", "-max_len=8192"]);
        command.env("TANDEM_FUZZ_TARGET", target).current_dir(root);
        command.env_remove("RUSTUP_TOOLCHAIN");
        run(command)?;
    }
    Ok(())
}

fn target_dir(root: &Path) -> PathBuf {
    let folder = std::env::var_os("CARGO_TARGET_DIR").unwrap_or_else(|| "target".into());
    root.join(folder)
}
