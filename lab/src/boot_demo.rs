//! `tandem boot-demo` on any of its boards. T-BOOT-8

use std::fs;
use std::path::{Path, PathBuf};

use anyhow::Context as _;
use tandem::board_kind::DemoBoard;
use tandem::boot_demo::{Downloaded, NAME, SYSTEM, download, on_host};
use tandem_board_qemu::{BootFrom, EmulatedWorld};
use tandem_boot_host::{FlashFile, SigningKey, records};
use tandem_processes::boot;

use crate::emulated;

/// Runs the experiment. `images` is the folder of the images for the emulated board; `None`
/// selects the output folder of `cargo xtask firmware build`.
///
/// # Errors
/// If the board does not start, the download is refused, or a frame does not arrive.
pub(crate) fn experiment(board: DemoBoard, images: Option<&Path>) -> anyhow::Result<Downloaded> {
    match board {
        DemoBoard::Host => on_host(),
        DemoBoard::Qemu => on_qemu(images, &boot::new_key()?),
    }
}

fn on_qemu(images: Option<&Path>, key: &SigningKey) -> anyhow::Result<Downloaded> {
    let image = |name: &str| {
        let chosen = images.map(|folder| folder.join(name));
        emulated::image(name, chosen.as_deref())
    };
    let (bootloader, application) = (image("bootloader")?, image("slot-frames")?);
    let elf = fs::read(&application).with_context(|| application.display().to_string())?;
    let lines = records(NAME, &[&emulated::of_elf(&elf, 1, key)?]);
    let folder = tempfile::tempdir().context("a folder for the program flash")?;
    let flash = folder.path().join("A.pflash");
    FlashFile::open(&flash).with_context(|| flash.display().to_string())?;
    let mut world = emulated_system(&bootloader, flash, key)?;
    download(&mut world, lines).with_context(|| world.log())
}

fn emulated_system(
    bootloader: &Path,
    flash: PathBuf,
    key: &SigningKey,
) -> anyhow::Result<EmulatedWorld> {
    let from = BootFrom {
        flash,
        public: key.public(),
        tester: None,
    };
    Ok(EmulatedWorld::start_booting(
        bootloader,
        false,
        &[(SYSTEM, from)],
    )?)
}
