//! The images for QEMU's mps2-an521, two Cortex-M33: builds and runs all of them.

use super::{build_dir, ended, machine, port};
use anyhow::{Context, Result, bail, ensure};
use std::path::Path;

pub(super) const TARGET: &str = "thumbv8m.main-none-eabi";
const QEMU: &str = "qemu-system-arm";
/// The address from which the images read their straps; see link.x.
const STRAPS_AT: u32 = 0x8000_0000;

// The exit codes of a case of the suite; see an521-conformance.rs.
const PASSED: i32 = 0;
const SKIPPED: i32 = 2;
const NO_SUCH_CASE: i32 = 3;

/// One instruction takes 32 ns.
const SHIFT: u32 = 5;
/// Time slices of each core, in ticks of 50 ns, with which the primitives run. The emulator ignores
/// shorter ones, and a broken lock would pass the test.
const TURNS: [u32; 8] = [97, 131, 179, 211, 307, 397, 499, 997];

pub(super) fn run(root: &Path) -> Result<()> {
    build(root, &["--release"])?;
    conformance(root)?;
    primitives(root)?;
    takeovers(root)
}

/// Builds all images with this profile.
pub(super) fn build(root: &Path, profile: &[&str]) -> Result<()> {
    crate::toolchain::demand(TARGET)?;
    let mut build = crate::cargo(&port(root), &["build", "--quiet"]);
    build
        .args(["--target", TARGET, "-p", "tandem-board-mps2-an521"])
        .args(profile)
        .env("CARGO_TARGET_DIR", build_dir(root));
    crate::run(build)
}

/// Makes a system hang at 20 moments of its 10 ms control period, each with a different phase
/// between the polls of the two systems.
fn takeovers(root: &Path) -> Result<()> {
    for (run, hangs_us) in (0..).zip((137..10_000).step_by(500)) {
        let phase_us = run * 350 % 1_000;
        let straps = [hangs_us, phase_us];
        let log = play(root, "an521-takeover", &straps, &[PASSED])?.1;
        print!("{log}");
    }
    Ok(())
}

/// Runs every case that two cores can run, each on a freshly started machine.
fn conformance(root: &Path) -> Result<()> {
    let (mut passed, mut skipped) = (0, 0);
    for case in 0.. {
        let known = [PASSED, SKIPPED, NO_SUCH_CASE];
        let (status, log) = play(root, "an521-conformance", &[case], &known)?;
        print!("{log}");
        match status {
            PASSED => passed += 1,
            SKIPPED => skipped += 1,
            _ => break,
        }
    }
    ensure!(passed > 0, "no case of the suite ran");
    println!("conformance on two processors: {passed} passed, {skipped} skipped, 0 failed");
    Ok(())
}

/// Runs the primitives under several schedules; with a broken lock some of them must fail.
fn primitives(root: &Path) -> Result<()> {
    const FAILED: i32 = 1;
    let mut caught = 0;
    for turns in TURNS {
        let (_, log) = play(root, "an521-primitives", &[turns, 0], &[PASSED])?;
        print!("turns of {turns:>3} ticks: {log}");
        let broken = play(root, "an521-primitives", &[turns, 1], &[PASSED, FAILED])?;
        caught += i32::from(broken.0 == FAILED);
    }
    let of = TURNS.len();
    println!("a broken lock was caught under {caught} of {of} schedules");
    ensure!(
        caught > 0,
        "a broken lock passes: the schedules explore nothing"
    );
    Ok(())
}

/// Runs an image until it ends. Fails if its exit status is not one of `good`.
fn play(root: &Path, image: &str, straps: &[u32], good: &[i32]) -> Result<(i32, String)> {
    let elf = build_dir(root).join(TARGET).join("release").join(image);
    let an521 = [
        "mps2-an521",
        "-semihosting-config",
        "enable=on,target=native",
    ];
    let mut command = machine(QEMU, &an521, &elf, SHIFT, (STRAPS_AT, straps));
    let (status, log) = ended(&mut command).with_context(|| {
        format!("{QEMU}: apt-get install --no-install-recommends qemu-system-arm")
    })?;
    match status.code() {
        Some(code) if good.contains(&code) => Ok((code, log)),
        _ => bail!("{image} {straps:?} ended with {status}:\n{log}"),
    }
}
