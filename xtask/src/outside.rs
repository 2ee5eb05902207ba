//! `cargo xtask outside`: a project of a user, in a folder of its own, that has the packages of
//! `cargo xtask package` and nothing else of this tree.

use crate::package::{PACKED, pack};
use anyhow::{Context as _, Result, ensure};
use std::fs;
use std::path::Path;
use std::process::Command;

/// The template of the project.
const TEMPLATE: &str = "tests/outside";
/// What the project names, and what these name: a registry would have all of them.
const USED: [&str; 4] = [
    "tandem-board",
    "tandem-bus",
    "tandem-redundancy",
    "tandem-shm",
];
/// All crates have the version of xtask.
const VERSION: &str = env!("CARGO_PKG_VERSION");
/// The log must have these lines, in this order; each is a part of its line.
const LOG: [&str; 6] = [
    "A: Starting -> Master",
    "A: stops",
    "B: Standby -> DegradedMaster",
    ", 0 refused",
    "vehicle: longest gap",
    "PASS",
];

/// A machine of QEMU that runs the project.
struct Machine {
    target: &'static str,
    emulator: &'static str,
    arguments: &'static [&'static str],
}

const MACHINES: [Machine; 2] = [
    Machine {
        target: "riscv32imac-unknown-none-elf",
        emulator: "qemu-system-riscv32",
        arguments: &["-machine", "virt", "-smp", "2", "-bios", "none"],
    },
    Machine {
        target: "thumbv7em-none-eabihf",
        emulator: "qemu-system-arm",
        arguments: &["-machine", "mps2-an386", "-semihosting"],
    },
];

/// Makes the project from the packages, builds it for both targets, and runs it. Fails unless each
/// log shows that system B took over.
pub(crate) fn run(root: &Path) -> Result<()> {
    pack(root, &USED, false)?;
    let project = tempfile::Builder::new().prefix("outside-").tempdir()?;
    let project = project.path();
    copy(&root.join(TEMPLATE), project)?;
    unpack(&root.join(PACKED), project)?;
    for machine in &MACHINES {
        crate::toolchain::demand(machine.target)?;
        let arguments = ["build", "--quiet", "--locked", "--release", "--target"];
        let mut build = crate::cargo(project, &arguments);
        build.arg(machine.target);
        // Cargo would take them from this task, or from the gate.
        for variable in ["CARGO_TARGET_DIR", "RUSTFLAGS", "CARGO_ENCODED_RUSTFLAGS"] {
            build.env_remove(variable);
        }
        ensure!(
            build.status()?.success(),
            "it does not build for {}",
            machine.target
        );
        let built = project.join("target").join(machine.target);
        let log = drive(machine, &built.join("release/outside"))?;
        println!("{}:\n{log}", machine.target);
        read_log(&log)?;
    }
    println!(
        "{} machines ran the project from the packages",
        MACHINES.len()
    );
    Ok(())
}

/// Runs the program until it ends the machine, and returns its log. Fails unless the program ends
/// with success within a minute.
fn drive(machine: &Machine, program: &Path) -> Result<String> {
    let mut qemu = Command::new("timeout");
    qemu.args(["60", machine.emulator]).args(machine.arguments);
    qemu.args(["-nographic", "-monitor", "none", "-serial", "stdio"]);
    // An instruction takes 2^5 ns of the emulated time: a busy host changes no time of the log.
    qemu.args(["-icount", "shift=5,sleep=off", "-kernel"])
        .arg(program);
    let output = qemu.output().context(machine.emulator)?;
    let log = String::from_utf8_lossy(&output.stdout).into_owned();
    let told = String::from_utf8_lossy(&output.stderr);
    let (name, status) = (machine.emulator, output.status);
    ensure!(status.success(), "{name} ends with {status}:\n{log}{told}");
    Ok(log)
}

fn read_log(log: &str) -> Result<()> {
    let mut lines = log.lines();
    for part in LOG {
        let found = lines.any(|line| line.contains(part));
        ensure!(found, "the log lacks {part:?}, or has it too early");
    }
    Ok(())
}

/// Copies the template; its `Cargo.toml.in` becomes the manifest.
fn copy(from: &Path, to: &Path) -> Result<()> {
    fs::create_dir_all(to)?;
    for entry in fs::read_dir(from)? {
        let entry = entry?;
        let place = to.join(entry.file_name());
        if entry.file_type()?.is_dir() {
            copy(&entry.path(), &place)?;
        } else {
            fs::copy(entry.path(), place)?;
        }
    }
    Ok(())
}

/// Unpacks the packages into `vendor/`, and writes the manifest that names them.
fn unpack(packed: &Path, project: &Path) -> Result<()> {
    let vendor = project.join("vendor");
    fs::create_dir_all(&vendor)?;
    let mut patches = String::new();
    for name in USED {
        let folder = format!("{name}-{VERSION}");
        let file = packed.join(format!("{folder}.crate"));
        let mut tar = Command::new("tar");
        tar.arg("-xzf").arg(&file).arg("-C").arg(&vendor);
        ensure!(
            tar.status()?.success(),
            "{} cannot be unpacked",
            file.display()
        );
        patches += &format!("{name} = {{ path = \"vendor/{folder}\" }}\n");
    }
    let manifest = fs::read_to_string(project.join("Cargo.toml.in"))?;
    let manifest = manifest
        .replace("@version@", VERSION)
        .replace("@patches@", patches.trim_end());
    fs::write(project.join("Cargo.toml"), manifest)?;
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_log_without_the_takeover_or_with_a_refused_frame_is_no_success() {
        let good = "7 ms A: Starting -> Master (HandshakeDone)\n1000 ms A: stops\n\
            1017 ms B: Standby -> DegradedMaster (PeerSilent)\n\
            vehicle: 99 commands of A, then 98 of B, 0 refused\n\
            vehicle: longest gap 18017 us, bound 20000 us\nPASS\n";
        read_log(good).unwrap();
        for line in good.lines() {
            read_log(&good.replace(line, "")).unwrap_err();
        }
        read_log(&good.replace(" 0 refused", " 10 refused")).unwrap_err();
        read_log("").unwrap_err();
    }
}
