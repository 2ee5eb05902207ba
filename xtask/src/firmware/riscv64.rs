//! The images for QEMU's riscv64 `virt` machine.

use super::{build_dir, finish, machine, port, released};
use anyhow::{Context, Result};
use std::fs;
use std::path::Path;

const TARGET: &str = "riscv64imac-unknown-none-elf";
const QEMU: &str = "qemu-system-riscv64";
/// Doorbells by messages, and the timer apart from them: see `interrupts.rs` of the board.
const MACHINE: [&str; 5] = [
    "virt,aclint=on,aia=aplic-imsic",
    "-smp",
    "7",
    "-bios",
    "none",
];
const CONFORMANCE: &str = "rv64-conformance";
const IMAGES: [&str; 3] = [CONFORMANCE, "rv64-controller", "rv64-golden-replay"];

/// Builds all images, and puts them beside those of riscv32, where tests and `tandem` find them.
pub(super) fn build(root: &Path) -> Result<()> {
    crate::toolchain::demand(TARGET)?;
    let mut build = crate::cargo(&port(root), &["build", "--quiet", "--release"]);
    build
        .args(["--target", TARGET, "-p", "tandem-board-riscv64-virt"])
        .env("CARGO_TARGET_DIR", build_dir(root));
    crate::run(build)?;
    for image in IMAGES {
        let built = build_dir(root).join(TARGET).join("release").join(image);
        fs::copy(&built, released(root, image)).with_context(|| built.display().to_string())?;
    }
    Ok(())
}

/// Runs the conformance suite.
pub(super) fn conformance(root: &Path) -> Result<()> {
    let elf = released(root, CONFORMANCE);
    print!(
        "{}",
        finish(&mut machine(QEMU, &MACHINE, &elf, 0, (0, &[])))?
    );
    Ok(())
}
