//! Where the working data of a run lie: in the run's own shared memory, gone with its last process.

use std::path::PathBuf;

use tandem_board::SystemId;
use tandem_board_host::RunName;

/// The files of a run.
#[derive(Clone, Debug)]
pub(crate) struct RunFiles {
    run: RunName,
}

impl RunFiles {
    /// The files of this run.
    pub(crate) const fn of(run: RunName) -> Self {
        Self { run }
    }

    /// The log that the vehicle writes.
    pub(crate) fn log(&self) -> PathBuf {
        self.path("run.jsonl")
    }

    /// The CAN log.
    pub(crate) fn candump(&self) -> PathBuf {
        self.path("candump.log")
    }

    /// How the run stands, for those who watch.
    pub(crate) fn live(&self) -> PathBuf {
        self.path("live.json")
    }

    /// What the processes say when they fail.
    pub(crate) fn errors(&self) -> PathBuf {
        self.path("errors.txt")
    }

    /// Data flash of a system, unless a folder keeps it.
    pub(crate) fn flash(&self, system: SystemId) -> PathBuf {
        self.path(&format!("{system}.dflash"))
    }

    /// The board wipes what begins with the run's name.
    fn path(&self, name: &str) -> PathBuf {
        PathBuf::from(format!("/dev/shm/{}_{name}", self.run))
    }
}
