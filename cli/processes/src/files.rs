//! Paths of the working files of a run. They are in the run's shared memory, which is removed with
//! the run's last process, or in a folder.

use std::path::{Path, PathBuf};

use tandem_board::SystemId;
use tandem_board_host::RunName;

/// The files of a run.
#[derive(Clone, Debug)]
pub struct RunFiles {
    /// The common prefix of all paths.
    prefix: String,
}

impl RunFiles {
    /// Returns the paths in the shared memory of this run.
    pub fn of(run: &RunName) -> Self {
        // The board removes files whose name begins with the run's name.
        Self {
            prefix: format!("/dev/shm/{run}_"),
        }
    }

    /// Returns the paths in this folder.
    pub fn within(folder: &Path) -> Self {
        Self {
            prefix: format!("{}/", folder.display()),
        }
    }

    /// Returns the path of the recording that the vehicle writes.
    pub fn recording(&self) -> PathBuf {
        self.path("recording")
    }

    /// Returns the path of the current state of the run, for display.
    pub fn live(&self) -> PathBuf {
        self.path("live.json")
    }

    /// Returns the path of the error messages of processes.
    pub fn errors(&self) -> PathBuf {
        self.path("errors.txt")
    }

    /// Returns the path of a system's data flash, unless the user keeps it in a folder.
    pub fn flash(&self, system: SystemId) -> PathBuf {
        self.path(&format!("{system}.dflash"))
    }

    /// Returns the path of a system's program flash, unless the user keeps it in a folder.
    pub fn program_flash(&self, system: SystemId) -> PathBuf {
        self.path(&format!("{system}.pflash"))
    }

    /// Returns the path of the records that update a system.
    pub fn update(&self, system: SystemId) -> PathBuf {
        self.path(&format!("{system}.update"))
    }

    /// Returns the path of a tester's private key, unless the user keeps it in a folder.
    pub fn tester(&self) -> PathBuf {
        self.path("tester.der")
    }

    /// Returns the path of the results of the updates, one line each.
    pub fn updated(&self) -> PathBuf {
        self.path("updated.txt")
    }

    /// Returns the path of what the SoC's process leaves.
    pub fn soc(&self) -> PathBuf {
        self.path("soc.json")
    }

    /// Returns the path of the recording of the SoC's time.
    pub fn soc_time(&self) -> PathBuf {
        self.path("soc-time")
    }

    /// Returns the path of what the grandmaster's process leaves.
    pub fn grandmaster(&self) -> PathBuf {
        self.path("grandmaster.json")
    }

    fn path(&self, name: &str) -> PathBuf {
        PathBuf::from(format!("{}{name}", self.prefix))
    }
}
