//! `cargo xtask outside`: projects of a user, in a folder of their own, that have the packages of
//! `cargo xtask package` and nothing else of this tree.

use crate::package::{PACKED, pack};
use anyhow::{Context as _, Result, ensure};
use std::fs;
use std::path::Path;
use std::process::{Command, Stdio};

/// The templates of the projects.
const TEMPLATES: &str = "tests/outside";
/// What the projects name, and what these name: a registry would have all of them.
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

/// A machine of QEMU that runs a project.
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

/// Makes both projects from the packages. Builds `two-cores` for each machine and runs it there;
/// tests `hal` on the host, and builds it for the machine that defmt is for. Fails unless each log
/// shows that system B took over.
pub(crate) fn run(root: &Path) -> Result<()> {
    pack(root, &USED, false)?;
    let folder = tempfile::Builder::new().prefix("outside-").tempdir()?;
    let folder = folder.path();
    let projects = ["two-cores", "hal"].map(|name| folder.join(name));
    for project in &projects {
        let name = project.file_name().unwrap_or_default();
        copy(&root.join(TEMPLATES).join(name), project)?;
        unpack(&root.join(PACKED), project)?;
    }
    let [two_cores, hal] = &projects;
    for machine in &MACHINES {
        crate::toolchain::demand(machine.target)?;
        let build = ["build", "--release", "--target", machine.target];
        cargo_in(two_cores, folder, &build)?;
        let program = folder.join("target").join(machine.target);
        let log = drive(machine, &program.join("release/outside"))?;
        println!("{}:\n{log}", machine.target);
        read_log(&log)?;
    }
    let results = cargo_in(hal, folder, &["test", "--release"])?;
    let passed: u32 = results.lines().filter_map(passed_in).sum();
    ensure!(passed > 0, "no test of the features for a HAL ran");
    cargo_in(
        hal,
        folder,
        &["build", "--release", "--target", MACHINES[1].target],
    )?;
    println!(
        "{} machines ran the packages; {passed} tests of their features for a HAL passed",
        MACHINES.len()
    );
    Ok(())
}

/// Returns the number of tests that passed, of a result of cargo test.
fn passed_in(line: &str) -> Option<u32> {
    let rest = line.strip_prefix("test result: ok. ")?;
    rest.split_once(" passed")?.0.parse().ok()
}

/// Runs cargo in a project, as a user would. Returns what it printed.
fn cargo_in(project: &Path, folder: &Path, arguments: &[&str]) -> Result<String> {
    let mut cargo = crate::cargo(project, arguments);
    cargo.args(["--quiet", "--locked", "--target-dir"]);
    cargo.arg(folder.join("target"));
    // This task, or the gate, has them for the tree.
    for variable in ["CARGO_TARGET_DIR", "RUSTFLAGS", "CARGO_ENCODED_RUSTFLAGS"] {
        cargo.env_remove(variable);
    }
    let output = cargo.stderr(Stdio::inherit()).output().context("cargo")?;
    let printed = String::from_utf8_lossy(&output.stdout).into_owned();
    ensure!(
        output.status.success(),
        "{cargo:?}: {}\n{printed}",
        output.status
    );
    Ok(printed)
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

    #[test]
    fn tests_that_passed_are_counted() {
        let result = "test result: ok. 4 passed; 0 failed; 0 ignored; 0 measured; 0 filtered out";
        assert_eq!(passed_in(result), Some(4));
        assert_eq!(passed_in("running 4 tests"), None);
    }
}
