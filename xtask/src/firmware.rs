//! The bare-metal images: build, run and measure them under QEMU.

mod an521;
mod example;
mod riscv64;
mod size;

use crate::{cargo, read_json, succeed, target_dir, write_json};
use anyhow::{Context, Result, bail, ensure};
use clap::{Subcommand, ValueEnum};
use serde_json::{Value, json};
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitStatus, Stdio};
use std::time::{Duration, Instant};

const TARGET: &str = "riscv32imac-unknown-none-elf";
const QEMU: &str = "qemu-system-riscv32";
/// An image is killed after this time; none here takes as long, even on a busy machine.
const LIMIT: Duration = Duration::from_secs(300);
/// How much worse than the baseline a measurement may be, in percent.
const TOLERANCE_PERCENT: u64 = 5;
/// The longest permitted time of a mailbox signal, in multiples of its floor.
const MAILBOX_PER_FLOOR: u64 = 2;
/// The floor of each way to wake a core: the cost of waking without passing any data. The key is
/// the first part of a path's name.
const FLOORS: [(&str, &str); 10] = [
    ("wfi", "wfi/floor"),
    ("doorbell", "doorbell/floor"),
    ("mailbox", "doorbell/floor"),
    ("heapless", "doorbell/floor"),
    ("embassy", "doorbell/floor"),
    ("freertos", "doorbell/floor"),
    ("channel", "doorbell/floor"),
    ("fifo", "doorbell/floor"),
    ("interrupt", "interrupt/floor"),
    ("task", "task/floor"),
];

/// Returns the floor of a path, if there is one.
pub(crate) fn floor_of(path: &str) -> Option<&'static str> {
    let (kind, _) = path.split_once('/')?;
    let (_, floor) = FLOORS.iter().find(|(of, _)| *of == kind)?;
    Some(floor)
}

#[derive(Subcommand)]
pub(crate) enum Firmware {
    /// Build all images
    Build,
    /// Run an image under QEMU and print its log
    Run {
        /// The image
        image: Image,
    },
    /// Build and run the images for two Cortex-M33 (QEMU's mps2-an521)
    An521,
    /// Run the conformance suite on both RISC-V boards, and drive with the controller as firmware
    Test {
        /// Leave out the update of both systems while they drive, which takes over a minute
        #[arg(long)]
        quick: bool,
    },
    /// Build and run an example in another language beside cores in Rust, and measure its library
    Example {
        /// The language
        language: Language,
    },
    /// Print the text and RAM of `shm` alone and of each image
    Size,
    /// Run the tests of lock, mailbox, pool and channels under every schedule of a sweep, and check
    /// that a broken lock is caught
    Explore {
        /// How many lengths of a time slice; each with four offsets between the harts
        #[arg(long, default_value_t = 100)]
        lengths: u32,
    },
    /// Count the instructions of the paths between cores, and compare them with the baseline
    Bench {
        /// Write the figures here: compiler, emulator, and results of {name, min, max, floor}
        #[arg(long, value_name = "FILE")]
        json: Option<PathBuf>,
        /// Make these figures the baseline
        #[arg(long)]
        save: bool,
    },
}

/// The language of an example.
#[derive(Clone, Copy, ValueEnum)]
pub(crate) enum Language {
    /// C99, for riscv64-unknown-elf-gcc
    C,
}

/// An image of firmware-port/riscv32-virt.
#[derive(Clone, Copy, ValueEnum)]
pub(crate) enum Image {
    /// The paths between cores, in instructions
    Bench,
    /// From a FreeRTOS task on core 0 to bare core 1 and back, in instructions
    BenchRtos,
    /// What core 0 spends on the time of the vehicle, in instructions
    BenchTime,
    /// Boot ROM, bootloader and carrier; `tandem boot-demo --board qemu` starts it
    Bootloader,
    /// The conformance suite, each case on two freshly powered systems
    Conformance,
    /// The whole controller; `tandem run --board qemu` starts it
    Controller,
    /// The driving functions over recorded frames; `test` supplies them
    GoldenReplay,
    /// Core 0 of each system greets everyone on the Ethernet, and echoes what it receives
    NetworkEcho,
    /// The whole controller for slot A
    SlotController,
    /// The whole controller for slot B: an update
    SlotControllerB,
    /// Three cores that each send a frame, for a slot
    SlotFrames,
    /// Tasks of FreeRTOS that toggle outputs; `tandem rtos-demo --board qemu` draws them
    RtosDemo,
    /// The primitives of the LMU under hundreds of schedules
    Schedules,
    /// Experiments of the thesis between two cores; `tandem thesis --board qemu` shows them
    Thesis,
}

impl Image {
    /// Returns its name on the command line.
    fn name(self) -> String {
        let value = self.to_possible_value();
        value.map_or_else(String::new, |value| value.get_name().to_owned())
    }
}

pub(crate) fn run(root: &Path, task: Firmware) -> Result<()> {
    if !matches!(task, Firmware::An521 | Firmware::Example { .. }) {
        build(root)?;
    }
    match task {
        Firmware::An521 => an521::run(root),
        Firmware::Example {
            language: Language::C,
        } => example::run(root),
        Firmware::Build => Ok(()),
        Firmware::Run { image } => {
            print!("{}", run_image(root, image, 0, &[])?);
            Ok(())
        }
        Firmware::Test { quick } => test(root, quick),
        Firmware::Size => size::run(root),
        Firmware::Explore { lengths } => explore(root, lengths),
        Firmware::Bench { json, save } => bench(root, json.as_deref(), save),
    }
}

fn port(root: &Path) -> PathBuf {
    root.join("firmware-port")
}

/// Returns the folder for all bare-metal builds.
pub(crate) fn build_dir(root: &Path) -> PathBuf {
    target_dir(root).join("firmware")
}

/// Builds all images.
fn build(root: &Path) -> Result<()> {
    let mut arguments = vec!["--release"];
    let names: Vec<String> = Image::value_variants().iter().map(|i| i.name()).collect();
    for name in &names {
        arguments.extend(["--bin", name]);
    }
    cargo_build(root, &arguments)?;
    // The bootloader for a bank has 32 KiB, and its linker script refuses a larger one.
    let small = [
        "--profile",
        "boot",
        "--no-default-features",
        "--bin",
        BANK_LOADER,
    ];
    cargo_build(root, &small)?;
    let built = build_dir(root).join(TARGET).join("boot").join(BANK_LOADER);
    fs::copy(&built, released(root, BANK_LOADER)).with_context(|| built.display().to_string())?;
    riscv64::build(root)
}

/// The image for a bank of the program flash.
const BANK_LOADER: &str = "bank-loader";

/// Builds images of the board.
fn cargo_build(root: &Path, arguments: &[&str]) -> Result<()> {
    let board = ["-p", "tandem-board-riscv32-virt"];
    cargo_build_package(root, &[&board, arguments].concat())
}

fn cargo_build_package(root: &Path, arguments: &[&str]) -> Result<()> {
    crate::toolchain::demand(TARGET)?;
    let mut command = cargo(&port(root), &["build", "--quiet", "--target", TARGET]);
    command.env("CARGO_TARGET_DIR", build_dir(root));
    succeed(command.args(arguments))
}

/// The address from which the images read their straps; see link.x.
const STRAPS_AT: u32 = 0x8090_0000;

/// Returns the path of a file that was built for release.
fn released(root: &Path, name: &str) -> PathBuf {
    build_dir(root).join(TARGET).join("release").join(name)
}

/// Returns the command for an emulated machine with this image, and these words at an address. The
/// machine is deterministic: an instruction takes 2^`shift` ns, and time jumps when all sleep.
fn machine(qemu: &str, machine: &[&str], elf: &Path, shift: u32, words: (u32, &[u32])) -> Command {
    let mut command = Command::new(qemu);
    command.arg("-machine").args(machine);
    command.args([
        "-display", "none", "-monitor", "none", "-serial", "stdio", "-icount",
    ]);
    command
        .arg(format!("shift={shift},sleep=off"))
        .arg("-kernel")
        .arg(elf);
    for (at, value) in (words.0..).step_by(4).zip(words.1) {
        let word = format!("loader,addr={at:#x},data={value},data-len=4");
        command.args(["-device", &word]);
    }
    command
}

/// Runs an image until it ends, and returns its log.
fn run_image(root: &Path, image: Image, shift: u32, straps: &[u32]) -> Result<String> {
    let virt = ["virt", "-smp", "7", "-bios", "none"];
    let elf = released(root, &image.name());
    finish(&mut machine(QEMU, &virt, &elf, shift, (STRAPS_AT, straps)))
}

fn test(root: &Path, quick: bool) -> Result<()> {
    print!("{}", run_image(root, Image::Conformance, 0, &[])?);
    riscv64::conformance(root)?;
    // The whole workspace, as in all other tests: with one package cargo would rebuild much more.
    let mut command = cargo(root, &["test", "--workspace"]);
    let files = [
        "identical",
        "feeds",
        "live",
        "network",
        "outputs",
        "shown",
        "tasks",
        "time",
        "topics",
        "chip",
        "emulated",
    ];
    for file in files.into_iter().chain(["emulated_bootloader"]) {
        command.args(["--test", file]);
    }
    command.args(["--", "--ignored", "--test-threads", "1"]);
    if quick {
        println!("SKIPPED: the update of both emulated systems (cargo xtask firmware test)");
        command.args([
            "--skip",
            "both_emulated_systems_are_updated_while_they_drive",
        ]);
    }
    command.env("TANDEM_IMAGES", released(root, ""));
    crate::run(command)
}

/// Strap `Mode` of the schedules: the lock is broken.
const BROKEN_LOCK: u32 = 1;
/// A tick of the timer is 25 instructions, so that time slices can end at any instruction.
const SCHEDULES_SHIFT: u32 = 2;

fn explore(root: &Path, lengths: u32) -> Result<()> {
    for mode in [0, BROKEN_LOCK] {
        let straps = [mode, lengths];
        let log = run_image(root, Image::Schedules, SCHEDULES_SHIFT, &straps)?;
        print!("{log}");
    }
    Ok(())
}

/// Runs a command that ends by itself with success, and returns what it printed.
fn finish(command: &mut Command) -> Result<String> {
    let (status, log) = ended(command).with_context(|| {
        format!("{QEMU}: apt-get install --no-install-recommends qemu-system-misc")
    })?;
    ensure!(status.success(), "{command:?} ended with {status}:\n{log}");
    Ok(log)
}

/// Runs a command that ends by itself, and returns how it ended and what it printed.
fn ended(command: &mut Command) -> Result<(ExitStatus, String)> {
    let mut child = command
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .spawn()
        .context("cannot start")?;
    let mut output = child.stdout.take().context("the log is piped")?;
    let reader = std::thread::spawn(move || {
        let mut log = String::new();
        std::io::Read::read_to_string(&mut output, &mut log).map(|_| log)
    });
    let begin = Instant::now();
    let status = loop {
        if let Some(status) = child.try_wait()? {
            break status;
        }
        if begin.elapsed() > LIMIT {
            child.kill()?;
        }
        std::thread::sleep(Duration::from_millis(5));
    };
    match reader.join() {
        Ok(log) => Ok((status, log.context("the log is text")?)),
        Err(_) => bail!("the log could not be read"),
    }
}

/// One measurement.
struct Figure {
    name: String,
    min: u64,
    max: u64,
}

fn figures_of(log: &str) -> Result<Vec<Figure>> {
    let lines = log.lines().filter_map(|line| line.strip_prefix("bench "));
    let figure = |line: &str| {
        let mut words = line.split(' ');
        Some(Figure {
            name: words.next()?.to_owned(),
            min: words.next()?.parse().ok()?,
            max: words.next()?.parse().ok()?,
        })
    };
    lines
        .map(|line| figure(line).with_context(|| format!("no figure: {line}")))
        .collect()
}

fn bench(root: &Path, json: Option<&Path>, save: bool) -> Result<()> {
    let mut figures = Vec::new();
    for image in [Image::Bench, Image::BenchRtos, Image::BenchTime] {
        let log = run_image(root, image, 0, &[])?;
        let again = run_image(root, image, 0, &[])?;
        ensure!(log == again, "two runs differ:\n{log}\n{again}");
        let measured = figures_of(&log)?;
        ensure!(!measured.is_empty(), "the image measured nothing:\n{log}");
        figures.extend(measured);
    }
    let row = |Figure { name, min, max }: &Figure| json!({ "name": name, "min": min, "max": max, "floor": floor_of(name) });
    let results = json!({
        "unit": "instructions",
        "compiler": version("rustc")?,
        "emulator": version(QEMU)?,
        "results": figures.iter().map(row).collect::<Vec<Value>>(),
    });
    let baseline_file = port(root).join("baseline.json");
    for file in json
        .into_iter()
        .chain(save.then_some(baseline_file.as_path()))
    {
        write_json(file, &results)?;
    }
    let baseline = read_json(&baseline_file).context("make a baseline with --save")?;
    let compiler = baseline["compiler"].as_str().unwrap_or_default();
    let baseline = baseline["results"]
        .as_array()
        .context("no results in the baseline")?;
    println!("instructions, over 1000 rounds of one deterministic run (icount, shift 0)");
    println!("{}; the baseline: {compiler}", version("rustc")?);
    println!(
        "{:<28} {:>7} {:>7} {:>13} {:>12}",
        "", "min", "max", "baseline", "over floor"
    );
    let mut worse = Vec::new();
    for Figure { name, min, max } in &figures {
        let known = baseline.iter().find(|entry| entry["name"] == name.as_str());
        let known = known.and_then(|entry| Some([entry["min"].as_u64()?, entry["max"].as_u64()?]));
        let shown = known.map_or("new".to_owned(), |[min, max]| format!("{min} {max}"));
        let floor = floor_of(name).and_then(|floor| figures.iter().find(|f| f.name == floor));
        let over = floor.map_or(String::new(), |floor| {
            format!("{:.2}", *min as f64 / floor.min as f64)
        });
        println!("{name:<28} {min:>7} {max:>7} {shown:>13} {over:>12}");
        let is_worse = |now: u64, then: u64| now * 100 > then * (100 + TOLERANCE_PERCENT);
        if known.is_some_and(|[least, most]| is_worse(*min, least) || is_worse(*max, most)) {
            worse.push(name.as_str());
        }
    }
    for entry in baseline {
        let name = entry["name"].as_str().unwrap_or_default();
        let measured = figures.iter().any(|figure| figure.name == name);
        ensure!(measured, "{name} is in the baseline and was not measured");
    }
    ensure!(
        worse.is_empty(),
        "worse than the baseline by more than {TOLERANCE_PERCENT} %: {}",
        worse.join(", ")
    );
    floor_holds(&figures)
}

/// Returns the version that a program prints, in one line.
pub(crate) fn version(program: &str) -> Result<String> {
    let output = Command::new(program).arg("--version").output();
    let output = output.with_context(|| format!("cannot start {program}"))?;
    let text = String::from_utf8_lossy(&output.stdout);
    Ok(text.lines().next().unwrap_or_default().to_owned())
}

/// Checks that a safe mailbox signal takes at most twice as long as its doorbell alone.
fn floor_holds(figures: &[Figure]) -> Result<()> {
    let figure = |name: &str| {
        let figure = figures.iter().find(|figure| figure.name == name);
        figure.with_context(|| format!("{name} was not measured"))
    };
    let (floor, signal) = (
        figure("doorbell/floor")?,
        figure("mailbox/signal-to-handler")?,
    );
    let (min, max) = (
        ("min", signal.min, floor.min),
        ("max", signal.max, floor.max),
    );
    for (which, signal, floor) in [min, max] {
        ensure!(
            signal <= MAILBOX_PER_FLOOR * floor,
            "{which}: a mailbox signal takes {signal} instructions, more than \
             {MAILBOX_PER_FLOOR} times the {floor} of its doorbell alone"
        );
    }
    Ok(())
}
