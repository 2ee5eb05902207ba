//! Paths of the working files of a run: in the run's shared memory, which vanishes with its last
//! process, or in a folder.

use std::path::{Path, PathBuf};

use tandem_board::SystemId;
use tandem_board_host::RunName;

/// The files of a run.
#[derive(Clone, Debug)]
pub struct RunFiles {
    /// The common prefix of their paths.
    prefix: String,
}

impl RunFiles {
    /// The files of this run.
    pub fn of(run: &RunName) -> Self {
        // The board removes files whose name begins with the run's name.
        Self {
            prefix: format!("/dev/shm/{run}_"),
        }
    }

    /// The files of a run with its own folder.
    pub fn within(folder: &Path) -> Self {
        Self {
            prefix: format!("{}/", folder.display()),
        }
    }

    /// The recording that the vehicle writes.
    pub fn recording(&self) -> PathBuf {
        self.path("recording")
    }

    /// The current state of the run, for display.
    pub fn live(&self) -> PathBuf {
        self.path("live.json")
    }

    /// Error messages of processes.
    pub fn errors(&self) -> PathBuf {
        self.path("errors.txt")
    }

    /// Data flash of a system, unless the user keeps it in a folder.
    pub fn flash(&self, system: SystemId) -> PathBuf {
        self.path(&format!("{system}.dflash"))
    }

    /// Program flash of a system, unless the user keeps it in a folder.
    pub fn program_flash(&self, system: SystemId) -> PathBuf {
        self.path(&format!("{system}.pflash"))
    }

    /// The records that update a system.
    pub fn update(&self, system: SystemId) -> PathBuf {
        self.path(&format!("{system}.update"))
    }

    /// The results of the updates, one line each.
    pub fn updated(&self) -> PathBuf {
        self.path("updated.txt")
    }

    fn path(&self, name: &str) -> PathBuf {
        PathBuf::from(format!("{}{name}", self.prefix))
    }
}
