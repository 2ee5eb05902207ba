//! `cargo xtask release`: what must pass before a version of the crates for others is published.

use anyhow::{Context as _, Result, ensure};
use std::path::Path;
use std::process::Command;

/// Packs the crates, then compares what they offer with an earlier revision: a change that can
/// break a user needs a higher version (docs/decisions/0043). Publishes nothing.
pub(crate) fn run(root: &Path, baseline: Option<String>) -> Result<()> {
    crate::package::run(root)?;
    let Some(baseline) = baseline.or_else(|| last_tag(root)) else {
        println!("SKIPPED: cargo-semver-checks: no tag v* to compare with (--baseline REVISION)");
        return Ok(());
    };
    let has = Command::new("cargo")
        .args(["semver-checks", "--version"])
        .output();
    if !has.is_ok_and(|it| it.status.success()) {
        println!("SKIPPED: cargo-semver-checks: cargo install --locked cargo-semver-checks");
        return Ok(());
    }
    let mut command = crate::cargo(root, &["semver-checks", "--baseline-rev", &baseline]);
    command.env_remove("RUSTC").env_remove("RUSTDOC");
    // Of its own, as for `package`.
    command.env("CARGO_TARGET_DIR", root.join("target/packages"));
    for name in crate::package::names(root)? {
        command.args(["-p", &name]);
    }
    let status = command.status().context("cargo semver-checks")?;
    ensure!(
        status.success(),
        "what the crates offer has changed since {baseline} in a way that needs a higher version"
    );
    println!("no change since {baseline} that the version does not announce");
    Ok(())
}

/// Returns the last tag of a version before this commit.
fn last_tag(root: &Path) -> Option<String> {
    let mut git = Command::new("git");
    git.args(["describe", "--tags", "--abbrev=0", "--match", "v*"]);
    let output = git.current_dir(root).output().ok()?;
    let tag = String::from_utf8_lossy(&output.stdout).trim().to_owned();
    (output.status.success() && !tag.is_empty()).then_some(tag)
}
