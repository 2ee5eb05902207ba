//! The shared memory of a run: all of it is created, and its pages reserved, before the first
//! process starts. A place that is too small refuses the run; it never stops one that drives.

use tandem_board::SystemId;

use crate::backplane::{Backplane, BackplaneError};
use crate::bell::{self, BellError};
use crate::board;
use crate::name::RunName;
use crate::segment::SegmentError;

/// Why the shared memory of a run cannot be had.
#[derive(Debug, thiserror::Error)]
pub enum MemoryError {
    /// The backplane.
    #[error(transparent)]
    Backplane(#[from] BackplaneError),
    /// The LMU of a system.
    #[error("LMU: {0}")]
    Lmu(#[from] SegmentError),
    /// The doorbell of a core.
    #[error(transparent)]
    Bell(#[from] BellError),
}

/// Creates the backplane, the LMU of both systems and the doorbells of all cores.
pub(crate) fn create(run: &RunName) -> Result<Backplane, MemoryError> {
    let backplane = Backplane::create(run)?;
    for system in SystemId::ALL {
        board::create_lmu(run, system)?;
    }
    bell::install(run)?;
    Ok(backplane)
}
