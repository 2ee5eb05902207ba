//! `tandem run --board qemu`: the controller as firmware in emulated machines, in virtual time.

use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::{Context as _, ensure};
use signal_hook::consts::{SIGINT, SIGTERM};
use tandem_board_qemu::{EmulatedWorld, Layout};
use tandem_vehicle::Scenario;

use crate::args::{BoardKind, RunArgs};
use crate::files::RunFiles;
use crate::live::Progress;
use crate::recorder::Recorder;
use crate::run_config::RunConfig;
use crate::vehicle::{self, Ended};

/// Where `cargo xtask firmware build` puts the images, seen from the folder of this program's.
const IMAGES: &str = "firmware/riscv32imac-unknown-none-elf/release";

/// The image that is to run: the one of this name, unless a person chose another.
///
/// # Errors
/// If there is none.
pub(crate) fn image(name: &str, chosen: Option<&Path>) -> anyhow::Result<PathBuf> {
    let image = match chosen {
        Some(image) => image.to_owned(),
        None => std::env::current_exe()
            .context("where this program lies")?
            .ancestors()
            .nth(2)
            .context("this program lies in no build folder: name the image by --firmware")?
            .join(IMAGES)
            .join(name),
    };
    ensure!(
        image.is_file(),
        "there is no image at {}: build it by `cargo xtask firmware build`, or name one by \
         --firmware",
        image.display()
    );
    // The emulator works in a folder of its own.
    std::fs::canonicalize(&image).with_context(|| image.display().to_string())
}

/// The controller's image.
///
/// # Errors
/// If there is none.
pub(crate) fn controller(args: &RunArgs) -> anyhow::Result<PathBuf> {
    image("controller", args.firmware.as_deref())
}

/// Drives to the end; a line on how the time went, or `None` if a person ended it.
///
/// # Errors
/// If the emulator cannot be started, hangs or fails.
pub(crate) fn drive(
    args: &RunArgs,
    config: &RunConfig,
    files: &RunFiles,
) -> anyhow::Result<Option<String>> {
    let layout = match args.board {
        BoardKind::QemuOne => Layout::One,
        BoardKind::Host | BoardKind::Qemu => Layout::Two,
    };
    let scenario = Scenario::load(&config.scenario)?;
    let image = controller(args)?;
    let world = EmulatedWorld::start(&image, layout, config.reintegrate)?;
    if !args.quiet {
        for (pid, systems) in world.processes() {
            let names: Vec<_> = systems.iter().map(ToString::to_string).collect();
            eprintln!("emulator of {}: process {pid}", names.join(" and "));
        }
    }
    let recorder = Recorder::create(files)?;
    let begin = Instant::now();
    let progress = (!args.quiet).then(|| Progress::show(files.live(), config.duration_s));
    for signal in [SIGINT, SIGTERM] {
        signal_hook::flag::register(signal, world.stop_flag()).context("watching for Ctrl-C")?;
    }
    let ended = vehicle::drive(config, &scenario, world, recorder);
    if let Some(progress) = progress {
        progress.end();
    }
    if ended? == Ended::Stopped {
        return Ok(None);
    }
    Ok(Some(format!(
        "firmware in {} (QEMU, riscv32): time is the emulator's, an instruction takes 1 ns; the run \
         took {:.0} s of this machine's",
        match layout {
            Layout::One => "one emulated machine, core 0 without a kernel",
            Layout::Two => "two emulated machines, core 0 under FreeRTOS",
        },
        begin.elapsed().as_secs_f64()
    )))
}
