//! Text and RAM of images, from the sections of their ELF files.

use super::{Image, TARGET, build_dir, cargo_build, cargo_build_package, released};
use anyhow::{Context, Result, ensure};
use clap::ValueEnum as _;
use std::fs;
use std::path::Path;

/// Text of RPMsg-Lite 5.4, in bytes: both ends with one endpoint each, its static interface, no
/// assertions, for riscv32imac by gcc 12.2 with `-Os`, unused functions removed. The functions of
/// the C library are not counted.
const RPMSG_LITE_TEXT: u32 = 2_762;

/// Text of RPMsg-Lite as its publisher states it for a Cortex-M, in bytes.
const RPMSG_LITE_PUBLISHED: u32 = 2_926;

/// The image with the participant of topics, and its limits: 16 KiB of text, 2 KiB of state.
const TOPICS: &str = "size-topics";
const TOPICS_TEXT: u32 = 16 << 10;
const TOPICS_STATE: u32 = 2 << 10;

/// The image with the time of the vehicle, and its limits: 25 KiB of text, 1.25 KiB of state.
const TIME: &str = "size-time";
const TIME_TEXT: u32 = 25 << 10;
const TIME_STATE: u32 = 1_280;

/// A bootloader's bank without the manifest at its start, in bytes.
const BANK_BYTES: u32 = (32 << 10) - 256;
/// The thesis's bootloader: 25.3 KiB, in bytes.
const THESIS_BYTES: u32 = 25_907;

/// Sizes of an image, in bytes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
struct Size {
    /// Code.
    text: u32,
    /// Constants, and the initial values of variables.
    constants: u32,
    /// Variables of all harts, without stacks, LMU, and the carrier's memory.
    ram: u32,
}

/// Prints a table of all images, of `shm` alone, and of the bootloader.
///
/// # Errors
/// If the bootloader does not fit in its bank, or the participant of topics or the time exceeds its
/// limits or can panic.
pub(super) fn run(root: &Path) -> Result<()> {
    let mut arguments = vec!["--profile", "size"];
    for image in ["size-none", "size-messages", "size-shm", TOPICS, TIME] {
        arguments.extend(["--bin", image]);
    }
    cargo_build(root, &arguments)?;
    let path = |name| build_dir(root).join(TARGET).join("size").join(name);
    let alone = |name| of(&path(name));
    let none = alone("size-none")?;
    println!(
        "{:<44} {:>7} {:>9} {:>7}",
        "bytes", "text", "constants", "RAM"
    );
    let line = |name: &str, size: Size| {
        let Size {
            text,
            constants,
            ram,
        } = size;
        println!("{name:<44} {text:>7} {constants:>9} {ram:>7}");
    };
    for (name, image) in [
        ("shm: mailbox and FIFO, both ends (opt s)", "size-messages"),
        ("shm: every primitive once (opt s)", "size-shm"),
        ("topics: the controller's participant (opt s)", TOPICS),
        ("time: base, gPTP slave, pulse, CAN (opt s)", TIME),
    ] {
        let with = alone(image)?;
        let size = Size {
            text: with.text.saturating_sub(none.text),
            constants: with.constants.saturating_sub(none.constants),
            ram: with.ram.saturating_sub(none.ram),
        };
        line(name, size);
        let limits = [
            (TOPICS, TOPICS_TEXT, TOPICS_STATE),
            (TIME, TIME_TEXT, TIME_STATE),
        ];
        let Some((_, text, state)) = limits.into_iter().find(|(of, ..)| *of == image) else {
            continue;
        };
        ensure!(
            size.text <= text && size.ram <= state,
            "{image} may have {text} bytes of text and {state} of state"
        );
        ensure!(
            panics(&path(image))? <= panics(&path("size-none"))?,
            "{image} can panic: it links a function of core::panicking"
        );
    }
    println!(
        "{:<44} {RPMSG_LITE_TEXT:>7}",
        "RPMsg-Lite, both ends (gcc -Os)"
    );
    for (name, size) in on_thumb(root)? {
        line(name, size);
    }
    println!(
        "{:<44} {RPMSG_LITE_PUBLISHED:>7}",
        "RPMsg-Lite, as published for Cortex-M"
    );
    let of_boot = bootloader(root)?;
    line("bootloader without drivers (opt z)", of_boot);
    let used = of_boot.text + of_boot.constants;
    println!(
        "{:<44} {used:>7} of {BANK_BYTES} for it and its drivers; the thesis's, without trust: {THESIS_BYTES}",
        "  in its bank, S0 and S1"
    );
    for image in Image::value_variants() {
        let size = of(&released(root, &image.name()))?;
        line(&format!("image {}", image.name()), size);
    }
    Ok(())
}

/// Builds the images of a Cortex-M33. Returns what mailbox and FIFO add to an image that only
/// starts, and to one that copies memory and can panic as well.
fn on_thumb(root: &Path) -> Result<[(&'static str, Size); 2]> {
    super::an521::build(root, &["--profile", "size"])?;
    let folder = build_dir(root).join(super::an521::TARGET).join("size");
    let sizes = |name: &str| of(&folder.join(format!("an521-size-{name}")));
    let with = sizes("messages")?;
    let beside = |without: Size| Size {
        text: with.text.saturating_sub(without.text),
        constants: with.constants.saturating_sub(without.constants),
        ram: 0,
    };
    Ok([
        (
            "mailbox and FIFO, Cortex-M33 (opt s)",
            beside(sizes("none")?),
        ),
        (
            "  in an image with memcpy and panics",
            beside(sizes("support")?),
        ),
    ])
}

/// Builds the bootloader without a board. Its linker script refuses an image larger than its bank.
fn bootloader(root: &Path) -> Result<Size> {
    let arguments = ["-p", "tandem-boot-size", "--profile", "boot"];
    cargo_build_package(root, &arguments)?;
    of(&build_dir(root).join(TARGET).join("boot/tandem-boot-size"))
}

/// Returns how many functions an image has that begin a panic, by the names of its symbols.
fn panics(elf: &Path) -> Result<usize> {
    const PANICKING: &[u8] = b"4core9panicking";
    let bytes = fs::read(elf).with_context(|| elf.display().to_string())?;
    let windows = bytes.windows(PANICKING.len());
    Ok(windows.filter(|name| *name == PANICKING).count())
}

fn of(elf: &Path) -> Result<Size> {
    let bytes = fs::read(elf).with_context(|| elf.display().to_string())?;
    size_of(&bytes).with_context(|| format!("{}: no 32-bit ELF file", elf.display()))
}

/// Reads the section headers of a little-endian 32-bit ELF file (TIS ELF 1.2, figure 1-8).
fn size_of(elf: &[u8]) -> Option<Size> {
    const ALLOCATED: u32 = 2;
    const EXECUTABLE: u32 = 4;
    const NO_BITS: u32 = 8;
    let word = |at: usize| Some(u32::from_le_bytes(*elf.get(at..)?.first_chunk()?));
    let half = |at: usize| Some(u16::from_le_bytes(*elf.get(at..)?.first_chunk()?));
    (elf.get(..5)? == b"\x7fELF\x01").then_some(())?;
    let (table, each) = (word(0x20)? as usize, usize::from(half(0x2E)?));
    let (count, names) = (usize::from(half(0x30)?), usize::from(half(0x32)?));
    let names_at = word(table + names * each + 0x10)? as usize;
    let mut size = Size::default();
    for header in (0..count).map(|index| table + index * each) {
        let (kind, flags) = (word(header + 4)?, word(header + 8)?);
        let bytes = word(header + 0x14)?;
        let name = elf.get(names_at + word(header)? as usize..)?;
        let is = |wanted: &[u8]| name.starts_with(wanted) && name.get(wanted.len()) == Some(&0);
        if flags & ALLOCATED == 0 {
            continue;
        }
        if flags & EXECUTABLE != 0 {
            size.text += bytes;
        } else if kind != NO_BITS {
            size.constants += bytes;
        }
        if is(b".data") || is(b".bss") {
            size.ram += bytes;
        }
    }
    Some(size)
}
