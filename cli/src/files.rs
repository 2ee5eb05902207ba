//! Where the working data of a run lie: in the run's own shared memory, gone with its last process,
//! or in a folder.

use std::path::{Path, PathBuf};

use tandem_board::SystemId;
use tandem_board_host::RunName;

/// The files of a run.
#[derive(Clone, Debug)]
pub struct RunFiles {
    /// The beginning of all their paths.
    prefix: String,
}

impl RunFiles {
    /// The files of this run.
    pub fn of(run: &RunName) -> Self {
        // The board wipes what begins with the run's name.
        Self {
            prefix: format!("/dev/shm/{run}_"),
        }
    }

    /// The files of a run that has a folder of its own.
    pub fn within(folder: &Path) -> Self {
        Self {
            prefix: format!("{}/", folder.display()),
        }
    }

    /// The recording that the vehicle writes.
    pub fn recording(&self) -> PathBuf {
        self.path("recording")
    }

    /// How the run stands, for those who watch.
    pub fn live(&self) -> PathBuf {
        self.path("live.json")
    }

    /// The messages of processes that fail.
    pub fn errors(&self) -> PathBuf {
        self.path("errors.txt")
    }

    /// Data flash of a system, unless a folder keeps it.
    pub fn flash(&self, system: SystemId) -> PathBuf {
        self.path(&format!("{system}.dflash"))
    }

    /// Program flash of a system, unless a folder keeps it.
    pub fn program_flash(&self, system: SystemId) -> PathBuf {
        self.path(&format!("{system}.pflash"))
    }

    /// The records of an update of a system.
    pub fn update(&self, system: SystemId) -> PathBuf {
        self.path(&format!("{system}.update"))
    }

    /// How the updates ended, a line each.
    pub fn updated(&self) -> PathBuf {
        self.path("updated.txt")
    }

    fn path(&self, name: &str) -> PathBuf {
        PathBuf::from(format!("{}{name}", self.prefix))
    }
}
