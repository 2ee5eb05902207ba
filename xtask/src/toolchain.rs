//! Installs the parts of the compiler without which a bare-metal build fails with E0463.
//!
//! There is no toolchain file, because rustup would then update the whole toolchain to add a
//! target, and a first drive on the host would wait for libraries that it does not need.

use anyhow::{Context as _, Result, ensure};
use std::path::Path;
use std::process::Command;

/// Installs the standard library of a target with rustup if it is missing. Without rustup this
/// fails and reports the command to run.
pub(crate) fn demand(target: &str) -> Result<()> {
    let rustc = std::env::var_os("RUSTC").unwrap_or_else(|| "rustc".into());
    let output = Command::new(rustc).args(["--print", "sysroot"]).output();
    let output = output.context("cannot start rustc")?;
    let sysroot = String::from_utf8_lossy(&output.stdout).trim().to_owned();
    let sysroot = Path::new(&sysroot);
    if has_library(sysroot, target).is_err() {
        // rustup prints its own errors to stderr; the check below finds a missing library.
        let _ = Command::new("rustup")
            .args(["target", "add", target])
            .status();
    }
    has_library(sysroot, target)
}

fn has_library(sysroot: &Path, target: &str) -> Result<()> {
    let library = sysroot.join("lib/rustlib").join(target).join("lib");
    ensure!(
        library.is_dir(),
        "the compiler in {} has no library for {target}: rustup target add {target}",
        sysroot.display()
    );
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_target_without_library_is_refused_with_the_command_that_installs_it() {
        let here = demand("none-such").unwrap_err().to_string();
        assert!(here.ends_with(": rustup target add none-such"), "{here}");
        // The host's own library is always installed.
        let host = Command::new("rustc")
            .args(["--print", "host-tuple"])
            .output();
        demand(String::from_utf8_lossy(&host.unwrap().stdout).trim()).unwrap();
    }
}
