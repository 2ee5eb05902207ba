//! Mutants: each is one small change of a crate, which its tests must notice.
//!
//! `.cargo/mutants.toml` lists the excluded code, and each change that no test can notice, with the
//! reasons.

use crate::{cargo, target_dir};
use anyhow::{Context, Result, bail};
use std::fs;
use std::path::Path;

const PACKAGES: [&str; 4] = [
    "tandem-boot",
    "tandem-bus",
    "tandem-redundancy",
    "tandem-shm",
];

/// Returns the share of a crate's mutants that compile, %, that the tests must notice at least.
fn caught_percent(package: &str) -> usize {
    if package == "tandem-boot" { 98 } else { 95 }
}

/// The tests of a crate take less time than this, even on a loaded machine.
const TIMEOUT_SECONDS: &str = "240";
/// The exit status of cargo-mutants: 0 all caught, 2 some missed, 3 time-outs. Others are errors.
const FOUND: [Option<i32>; 3] = [Some(0), Some(2), Some(3)];

/// Tests each `every`-th mutant of these packages (by default of all four), starting with number
/// `from`; another number selects other mutants.
pub(crate) fn run(root: &Path, packages: &[String], every: u32, from: u32) -> Result<()> {
    let version = cargo(root, &["mutants", "--version"]).output();
    if !version.is_ok_and(|output| output.status.success()) {
        println!("SKIPPED: mutants (cargo install --locked cargo-mutants)");
        return Ok(());
    }
    let mut packages: Vec<&str> = packages.iter().map(String::as_str).collect();
    if packages.is_empty() {
        packages.extend(PACKAGES);
    }
    let mut table =
        String::from("package             caught  timeout  missed  unviable     rate\n");
    let mut poor = Vec::new();
    for package in packages {
        let folder = target_dir(root).join("mutants").join(package);
        fs::create_dir_all(&folder).with_context(|| folder.display().to_string())?;
        let mut command = cargo(root, &["mutants", "--package", package, "--baseline=skip"]);
        // One is built while the tests of the other run.
        command.arg("--jobs=2");
        command.args(["--timeout", TIMEOUT_SECONDS, "--sharding=round-robin"]);
        command.arg(format!("--shard={from}/{every}"));
        command.arg("--output").arg(&folder);
        if package == "tandem-boot" {
            // The flash that fails and loses power is on the host's side.
            command.args(["--test-package", "tandem-boot,tandem-boot-host"]);
        }
        println!("$ {command:?}");
        let status = command.status().context("cargo mutants")?;
        if !FOUND.contains(&status.code()) {
            bail!("{command:?} ended with {status}");
        }
        let count = |name: &str| {
            let path = folder.join("mutants.out").join(name);
            let text = fs::read_to_string(&path).with_context(|| path.display().to_string())?;
            Ok::<_, anyhow::Error>(text.lines().count())
        };
        let (caught, timeout) = (count("caught.txt")?, count("timeout.txt")?);
        let (missed, unviable) = (count("missed.txt")?, count("unviable.txt")?);
        let (noticed, all) = (caught + timeout, caught + timeout + missed);
        let percent = caught_percent(package);
        if all == 0 || noticed * 100 < all * percent {
            poor.push(format!("{package} (less than {percent} %)"));
        }
        let rate = noticed as f64 * 100.0 / all.max(1) as f64;
        table += &format!(
            "{package:<18}{caught:>8}{timeout:>9}{missed:>8}{unviable:>10}{rate:>7.1} %\n"
        );
    }
    print!("{table}");
    if !poor.is_empty() {
        bail!("not noticed often enough: {}", poor.join(", "));
    }
    Ok(())
}
