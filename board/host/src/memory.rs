//! The shared memory of a run. All of it is created, and its pages are reserved, before the first
//! process starts. If there is not enough room, the run does not start; a run that has started
//! cannot run out of shared memory.

use core::sync::atomic::AtomicU32;

use tandem_board::SystemId;

use crate::backplane::{Backplane, BackplaneError};
use crate::doorbell::{self, DoorbellError};
use crate::name::RunName;
use crate::segment::{Segment, SegmentError};

/// Words of the LMU: 32 KiB, as on the TC297. T-CHIP-1
pub const LMU_WORDS: usize = 8192;

/// Why the shared memory of a run cannot be created.
#[derive(Debug, thiserror::Error)]
pub enum MemoryError {
    /// The backplane could not be created.
    #[error(transparent)]
    Backplane(#[from] BackplaneError),
    /// The LMU of a system could not be created.
    #[error("LMU: {0}")]
    Lmu(#[from] SegmentError),
    /// The doorbell of a core could not be created.
    #[error(transparent)]
    Doorbell(#[from] DoorbellError),
}

/// Creates the backplane, the LMU of both systems and the doorbells of all cores.
pub(crate) fn create(run: &RunName) -> Result<Backplane, MemoryError> {
    let backplane = Backplane::create(run)?;
    for system in SystemId::ALL {
        Segment::<LMU_WORDS>::create(run, &lmu_name(system))?;
    }
    doorbell::install(run)?;
    Ok(backplane)
}

fn lmu_name(system: SystemId) -> String {
    format!("lmu-{system}")
}

/// Maps the LMU of a system until this process ends.
pub(crate) fn open_lmu(
    run: &RunName,
    system: SystemId,
) -> Result<&'static [AtomicU32], SegmentError> {
    let segment = Segment::<LMU_WORDS>::open(run, &lmu_name(system))?;
    Ok(Box::leak(Box::new(segment)).words())
}
