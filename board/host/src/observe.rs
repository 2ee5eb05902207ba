//! Reads the bus without affecting any process of the run.

use tandem_board::Received;
use tandem_peripherals::codec::{BusFrame, FRAME_WORDS, Sender};
use tandem_shm::{FitError, bare, broadcast};

use crate::backplane::{Backplane, RINGS};

/// Reads the frames on the bus from a run's backplane. The bus does not wait for this reader:
/// frames that the reader misses are lost only for the reader itself.
#[derive(Debug)]
pub struct BusTap {
    frames: broadcast::Receiver<'static, [u32; FRAME_WORDS]>,
}

impl BusTap {
    /// Starts with the next frame.
    ///
    /// # Errors
    /// If the backplane has a different layout from that of this build.
    pub fn new(backplane: Backplane) -> Result<Self, FitError> {
        let ring = RINGS.receive;
        let frames = bare::broadcast_receiver(backplane.ring(ring), ring.shape)?;
        Ok(Self { frames })
    }

    /// Returns the next frame that was on the bus, with its sender; `None` if there is none yet.
    /// Never blocks.
    pub fn try_next(&mut self) -> Option<(Sender, Received)> {
        // The bus may send during this call, so one call reads at most one frame per slot.
        for _ in 0..RINGS.receive.shape.slots() {
            match self.frames.receive() {
                Ok(None) => return None,
                Ok(Some((_, words))) => {
                    if let Some(frame) = BusFrame::decode(&words) {
                        return Some((frame.sender, frame.received));
                    }
                }
                Err(_lost) => {}
            }
        }
        None
    }
}
