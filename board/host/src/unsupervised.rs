//! A system without a supply, for benchmarks: the caller itself starts the cores.

use std::path::PathBuf;

use tandem_board::{CoreId, Generation, Identity, SystemId};

use crate::args::{Common, CoreArgs, Schedule};
use crate::board::{AttachError, HostBoard};
use crate::flash_file::HostFlash;
use crate::isolation::Isolation;
use crate::memory;
use crate::name::RunName;

/// System A with power: LMU, doorbells and wires, but no supply that watches or resets its cores.
#[derive(Debug)]
pub struct UnsupervisedSystem {
    run: RunName,
    flash: PathBuf,
}

impl UnsupervisedSystem {
    /// Switches the system on in this place. Its memory is removed with the place.
    ///
    /// # Errors
    /// [`AttachError`] if shared memory or the data flash file cannot be created.
    pub fn power_on(isolation: &Isolation) -> Result<Self, AttachError> {
        let run = isolation.run().clone();
        let flash = PathBuf::from(format!("/dev/shm/{}.dflash", run.as_str()));
        memory::create(&run)?;
        HostFlash::prepare(&flash)?;
        Ok(Self { run, flash })
    }

    /// Returns the run, for further files that are removed with the place.
    #[must_use]
    pub const fn run(&self) -> &RunName {
        &self.run
    }

    /// Attaches the calling process as a core in this incarnation. Only once per process.
    ///
    /// # Errors
    /// [`AttachError`] if a part of the board cannot be mapped or opened.
    pub fn attach(&self, core: CoreId, generation: Generation) -> Result<HostBoard, AttachError> {
        HostBoard::attach(&CoreArgs {
            common: Common {
                run: self.run.clone(),
                schedule: Schedule::default(),
                network: None,
                extra: vec![],
            },
            identity: Identity {
                system: SystemId::A,
                core,
                generation,
            },
            flash: self.flash.clone(),
            application: None,
        })
    }
}
