//! What may run: until parts are signed, each file as it is (E-4).

use std::os::fd::OwnedFd;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::Arc;

/// Why something may not run.
#[derive(Debug, thiserror::Error)]
pub enum TrustError {
    /// A file could not be read.
    #[error("{path}: {source}")]
    Read {
        /// The file.
        path: PathBuf,
        /// The error of the operating system.
        source: std::io::Error,
    },
}

/// What was checked: a manifest and the programs beside it.
#[derive(Debug)]
pub struct Platform {
    folder: PathBuf,
    manifest: Vec<u8>,
}

/// A command that runs the checked bytes.
#[derive(Debug)]
pub struct TrustedCommand {
    /// The command.
    pub command: Command,
    /// Descriptors that it must inherit.
    pub keep: Vec<Arc<OwnedFd>>,
}

impl Platform {
    /// Reads the manifest and checks it against the anchor.
    ///
    /// # Errors
    /// If a file cannot be read, or is not what was signed.
    pub fn open(manifest: &Path, _anchor: Option<&Path>) -> Result<Self, TrustError> {
        let read = std::fs::read(manifest).map_err(|source| TrustError::Read {
            path: manifest.to_owned(),
            source,
        });
        Ok(Self {
            folder: manifest.parent().unwrap_or(Path::new("")).to_owned(),
            manifest: read?,
        })
    }

    /// Returns the checked bytes of the manifest.
    #[must_use]
    pub fn manifest(&self) -> &[u8] {
        &self.manifest
    }

    /// Returns the command that runs this program.
    ///
    /// # Errors
    /// If the program cannot be read, or is not what was signed.
    pub fn command(&self, program: &Path) -> Result<TrustedCommand, TrustError> {
        Ok(TrustedCommand {
            command: Command::new(self.folder.join(program)),
            keep: vec![],
        })
    }
}
