//! Both ends of the protected communication: the sender's counters and the receiver's checkers.

use core::fmt;

use crate::e2e::{Check, Checker};
use crate::{Encoded, FRAMES, FrameError, Message};

/// Encodes messages with the next counter of their id.
#[derive(Clone, Debug)]
pub struct FrameTransmitter {
    next: [u8; FRAMES.len()],
}

impl FrameTransmitter {
    /// Creates a transmitter whose counters start at 0.
    #[must_use]
    pub const fn new() -> Self {
        Self {
            next: [0; FRAMES.len()],
        }
    }

    /// Returns the frame to send. Call this once for each frame that is really sent: the receiver
    /// counts a skipped number as a lost frame.
    pub fn encode(&mut self, message: &Message) -> Encoded {
        let index = message.index();
        let counter = self.next[index];
        self.next[index] = counter.wrapping_add(1);
        message.encode(counter)
    }
}

impl Default for FrameTransmitter {
    fn default() -> Self {
        Self::new()
    }
}

/// Why a received frame must not be used.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum ReceiveError {
    /// The end-to-end protection refuses the frame.
    Protection(Check),
    /// The frame cannot be decoded.
    Decode(FrameError),
}

impl fmt::Display for ReceiveError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Protection(check) => write!(f, "end-to-end protection: {check:?}"),
            Self::Decode(error) => error.fmt(f),
        }
    }
}

impl core::error::Error for ReceiveError {}

/// Checks and decodes frames.
#[derive(Clone, Debug)]
pub struct FrameReceiver {
    checkers: [Checker; FRAMES.len()],
    lost: [u32; FRAMES.len()],
}

impl FrameReceiver {
    /// Creates a receiver that has received no frame.
    #[must_use]
    pub fn new() -> Self {
        Self {
            checkers: FRAMES.map(|frame| Checker::new(frame.id)),
            lost: [0; FRAMES.len()],
        }
    }

    /// Checks and decodes a frame with a standard id. A frame with a protection of its own is only
    /// decoded.
    ///
    /// # Errors
    /// [`ReceiveError::Decode`] for a frame that the DBC does not allow (the bus may carry other
    /// traffic), and [`ReceiveError::Protection`] for a frame that is damaged, repeated or out of
    /// sequence.
    pub fn receive(&mut self, id: u32, data: &[u8]) -> Result<Message, ReceiveError> {
        let index = FRAMES
            .iter()
            .position(|frame| u32::from(frame.id) == id)
            .ok_or(ReceiveError::Decode(FrameError::UnknownId))?;
        if data.len() != FRAMES[index].len {
            return Err(ReceiveError::Decode(FrameError::WrongLength));
        }
        if FRAMES[index].has_e2e {
            let check = self.checkers[index].check(data);
            if !check.is_accepted() {
                return Err(ReceiveError::Protection(check));
            }
            if let Check::OkSomeLost(lost) = check {
                self.lost[index] = self.lost[index].wrapping_add(lost.into());
            }
        }
        Message::decode(id, data).map_err(ReceiveError::Decode)
    }

    /// Returns how many frames were lost according to the counters; wraps around. Gaps that ended
    /// in [`Check::WrongSequence`] are not counted.
    #[must_use]
    pub fn lost(&self) -> u32 {
        let sum = |all: u32, of: &u32| all.wrapping_add(*of);
        self.lost.iter().fold(0, sum)
    }

    /// Returns how many of them are of the frame with this index in [`FRAMES`]; wraps around.
    ///
    /// # Panics
    /// If there is no such frame.
    #[must_use]
    pub const fn lost_of(&self, index: usize) -> u32 {
        self.lost[index]
    }
}

impl Default for FrameReceiver {
    fn default() -> Self {
        Self::new()
    }
}
