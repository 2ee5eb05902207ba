//! Whether the compiler has what a bare-metal build needs, said before the build fails with E0463.

use anyhow::{Context as _, Result, ensure};
use std::path::Path;
use std::process::Command;

/// Refuses a build for a target without its standard library, and says how to install it.
pub(crate) fn demand(target: &str) -> Result<()> {
    let rustc = std::env::var_os("RUSTC").unwrap_or_else(|| "rustc".into());
    let output = Command::new(rustc).args(["--print", "sysroot"]).output();
    let output = output.context("cannot start rustc")?;
    let sysroot = String::from_utf8_lossy(&output.stdout).trim().to_owned();
    has_library(Path::new(&sysroot), target)
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
        // The host's own library is always there.
        let host = Command::new("rustc")
            .args(["--print", "host-tuple"])
            .output();
        demand(String::from_utf8_lossy(&host.unwrap().stdout).trim()).unwrap();
    }
}
