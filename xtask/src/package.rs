//! `cargo xtask package`: the crates that others may depend on, packed as for a registry and built
//! from their packages.

use anyhow::{Context as _, Result, ensure};
use serde_json::Value;
use std::path::Path;
use std::process::Command;

/// Builds the same crates with the oldest compiler that their manifests permit, if rustup has it.
fn build_with_oldest(root: &Path, metadata: &[Value], names: &[&str]) -> Result<()> {
    let oldest = metadata.iter().find_map(|it| it["rust_version"].as_str());
    let oldest = oldest.context("no rust-version")?;
    let toolchain = format!("{oldest}.0");
    let has = Command::new("rustup")
        .args(["run", &toolchain, "rustc", "--version"])
        .output();
    if !has.is_ok_and(|it| it.status.success()) {
        println!("Rust {toolchain} is not installed: rustup toolchain install {toolchain}");
        return Ok(());
    }
    let mut command = Command::new("rustup");
    command
        .args([
            "run",
            &toolchain,
            "cargo",
            "check",
            "--quiet",
            "--locked",
            "--all-features",
        ])
        .current_dir(root);
    command
        .env_remove("RUSTC")
        .env_remove("RUSTDOC")
        .env_remove("CARGO");
    command
        .arg("--target-dir")
        .arg(root.join("target/packages"));
    for name in names {
        command.args(["-p", name]);
    }
    ensure!(
        command.status()?.success(),
        "Rust {toolchain} does not build them"
    );
    println!("built with Rust {toolchain}, the oldest that they permit");
    Ok(())
}

/// The folder of the packages, relative to the root.
pub(crate) const PACKED: &str = "target/packages/package";

/// Returns the crates whose manifest permits to publish them.
fn for_others(root: &Path) -> Result<Vec<Value>> {
    let arguments = ["metadata", "--format-version=1", "--no-deps", "--locked"];
    let output = crate::cargo(root, &arguments).output()?;
    ensure!(output.status.success(), "cargo metadata failed");
    let metadata: Value = serde_json::from_slice(&output.stdout)?;
    let all = metadata["packages"].as_array().context("no packages")?;
    let ours = all.iter().filter(|it| it["publish"].is_null());
    let ours: Vec<Value> = ours.cloned().collect();
    ensure!(!ours.is_empty(), "no crate may be published");
    Ok(ours)
}

/// Writes the packages of these crates to [`PACKED`]. With `verify`, builds each from its package,
/// with the packages of the others.
pub(crate) fn pack(root: &Path, names: &[&str], verify: bool) -> Result<()> {
    let mut command = crate::cargo(root, &["package", "--quiet", "--locked", "--allow-dirty"]);
    // Of its own: beside it, the tests may be built.
    command
        .arg("--target-dir")
        .arg(root.join("target/packages"));
    if !verify {
        command.arg("--no-verify");
    }
    for name in names {
        command.args(["-p", name]);
    }
    // Cargo warns of each patch in .cargo/config.toml that these builds do not need.
    let output = command.output().context("cargo package")?;
    let told = String::from_utf8_lossy(&output.stderr);
    ensure!(output.status.success(), "cargo package failed:\n{told}");
    Ok(())
}

/// Returns the names of the crates that others may depend on.
pub(crate) fn names(root: &Path) -> Result<Vec<String>> {
    let ours = for_others(root)?;
    let names = ours.iter().filter_map(|it| it["name"].as_str());
    Ok(names.map(str::to_owned).collect())
}

/// Packs every crate whose manifest permits to publish it, and builds each from its package, with
/// the others' packages. Publishes nothing.
pub(crate) fn run(root: &Path) -> Result<()> {
    let ours = for_others(root)?;
    let names: Vec<&str> = ours.iter().filter_map(|it| it["name"].as_str()).collect();
    for package in &ours {
        let missing = ["description", "license", "readme", "rust_version"];
        let missing = missing.iter().find(|key| package[**key].is_null());
        let (name, lists) = (&package["name"], ["keywords", "categories"]);
        let empty = lists
            .iter()
            .find(|key| package[**key] == Value::Array(vec![]));
        let lacks = missing.or(empty);
        ensure!(lacks.is_none(), "{name}: its Cargo.toml lacks {lacks:?}");
        // The first look of a reader; that of capi is in C.
        let manifest = package["manifest_path"].as_str().context("no path")?;
        let examples = Path::new(manifest).with_file_name("examples");
        ensure!(examples.is_dir(), "{name}: no example");
    }
    pack(root, &names, true)?;
    println!(
        "{} crates packed and built: {}",
        names.len(),
        names.join(", ")
    );
    build_with_oldest(root, &ours, &names)
}
