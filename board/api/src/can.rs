//! The CAN / CAN FD controller.

use crate::Instant;

/// A CAN identifier: standard (11 bit) or extended (29 bit).
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum CanId {
    /// 0 ..= 0x7FF
    Standard(u16),
    /// 0 ..= 0x1FFF_FFFF
    Extended(u32),
}

/// A classic CAN or CAN FD data frame. `new` checks it, so the bus can carry every `CanFrame`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct CanFrame {
    id: CanId,
    fd: bool,
    len: u8,
    data: [u8; 64],
}

/// The id is out of range, or the length is not valid for CAN (0..=8) or CAN FD (0..=8, 12, 16, 20,
/// 24, 32, 48, 64).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct InvalidFrame;

impl core::fmt::Display for InvalidFrame {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str("the id or the length is not valid for CAN or CAN FD")
    }
}

impl core::error::Error for InvalidFrame {}

impl CanFrame {
    /// Makes a frame with these data; a CAN FD frame if `fd`.
    ///
    /// # Errors
    /// [`InvalidFrame`] if the bus cannot carry the id or the length.
    pub fn new(id: CanId, fd: bool, data: &[u8]) -> Result<Self, InvalidFrame> {
        let id_ok = match id {
            CanId::Standard(id) => id <= 0x7FF,
            CanId::Extended(id) => id <= 0x1FFF_FFFF,
        };
        let len_ok = match data.len() {
            0..=8 => true,
            12 | 16 | 20 | 24 | 32 | 48 | 64 => fd,
            _ => false,
        };
        if !id_ok || !len_ok {
            return Err(InvalidFrame);
        }
        let mut bytes = [0; 64];
        bytes[..data.len()].copy_from_slice(data);
        Ok(Self {
            id,
            fd,
            len: data.len() as u8,
            data: bytes,
        })
    }

    /// Returns the identifier.
    #[must_use]
    pub const fn id(&self) -> CanId {
        self.id
    }

    /// Returns whether this is a CAN FD frame.
    #[must_use]
    pub const fn is_fd(&self) -> bool {
        self.fd
    }

    /// Returns the data bytes.
    #[must_use]
    pub fn data(&self) -> &[u8] {
        &self.data[..self.len as usize]
    }
}

/// The transmit buffer is full; the frame was not accepted.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct TransmitFull;

impl core::fmt::Display for TransmitFull {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str("the transmit buffer is full")
    }
}

impl core::error::Error for TransmitFull {}

/// A frame received from the bus.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Received {
    /// The frame.
    pub frame: CanFrame,
    /// When the frame was on the bus, on the receiver's clock.
    pub at: Instant,
}

/// Error state of a CAN controller (ISO 11898-1, fault confinement).
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum CanState {
    /// Both error counters are below 128.
    ErrorActive,
    /// An error counter is 128 or more.
    ErrorPassive,
    /// The transmit counter has exceeded 255: the controller sends nothing until the bus has
    /// carried 128 sequences of 11 recessive bits.
    BusOff,
}

/// The error counters of a CAN controller.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct CanErrors {
    /// Transmit error counter, 0 ..= 256; 256 while the controller is bus-off.
    pub transmit: u16,
    /// Receive error counter.
    pub receive: u8,
    /// How many times the controller became bus-off; wraps around.
    pub bus_offs: u8,
}

impl CanErrors {
    /// The transmit counter of a controller that is bus-off.
    pub const BUS_OFF: u16 = 256;
    /// A controller with a counter of this or more is error-passive.
    pub const PASSIVE: u16 = 128;

    /// Returns the state that follows from the counters.
    #[must_use]
    pub const fn state(self) -> CanState {
        if self.transmit >= Self::BUS_OFF {
            CanState::BusOff
        } else if self.transmit >= Self::PASSIVE || self.receive as u16 >= Self::PASSIVE {
            CanState::ErrorPassive
        } else {
            CanState::ErrorActive
        }
    }

    /// Packs the counters into one word, so that they are read together.
    #[must_use]
    pub const fn to_word(self) -> u32 {
        self.transmit as u32 | (self.receive as u32) << 16 | (self.bus_offs as u32) << 24
    }

    /// The inverse of [`CanErrors::to_word`].
    #[must_use]
    pub const fn from_word(word: u32) -> Self {
        let [low, high, receive, bus_offs] = word.to_le_bytes();
        Self {
            transmit: u16::from_le_bytes([low, high]),
            receive,
            bus_offs,
        }
    }
}

/// A CAN controller with its own receive FIFO. Frames arrive in bus order; a core does not receive
/// its own frames.
pub trait Can {
    /// Puts a frame into the transmit buffer. One at a time. Frames of one core are sent in order.
    ///
    /// # Errors
    /// [`TransmitFull`] if the buffer is full.
    fn try_send(&self, frame: &CanFrame) -> Result<(), TransmitFull>;

    /// Sends like [`Can::try_send`], and makes the controller record when the frame was on the bus:
    /// [`Can::stamp`]. (M_CAN: an entry of the transmit event FIFO.) One at a time. S-4
    ///
    /// # Errors
    /// [`TransmitFull`] if the buffer is full.
    fn try_send_stamped(&self, frame: &CanFrame) -> Result<(), TransmitFull>;

    /// Returns when the newest frame passed to [`Can::try_send_stamped`] was on the bus, on this
    /// system's clock. One at a time. S-4
    ///
    /// `None` while the frame waits, for ever if it was refused, discarded or lost, and if this
    /// incarnation of the core has passed none. It is the instant of [`Received::at`] at the
    /// receivers: exactly, except where a board says how far the two may differ.
    fn stamp(&self) -> Option<Instant>;

    /// Discards the frames of this core that wait in the transmit buffer. One at a time.
    ///
    /// A frame that is already on its way to the bus is still sent. Of the frames passed to
    /// `try_send` before this call, the first few may therefore still be sent; the others are never
    /// sent. A frame passed to `try_send` after this call is sent as usual.
    fn discard_unsent(&self);

    /// Returns the next received frame. One at a time.
    fn try_receive(&self) -> Option<Received>;

    /// Sets whether a received frame ends [`Board::wait`](crate::Board::wait); off at start. Any
    /// context.
    fn wake_on_receive(&self, on: bool);

    /// Returns how many frames were lost because this core did not fetch them in time; wraps
    /// around. Any context.
    fn overruns(&self) -> u32;

    /// Returns the error counters. Any context. A controller that is bus-off recovers by itself; a
    /// reset of the system clears its counters.
    fn errors(&self) -> CanErrors;
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn counters_mean_a_state_and_survive_their_word() {
        use CanState::{BusOff, ErrorActive, ErrorPassive};
        for (transmit, receive, state) in [
            (0, 0, ErrorActive),
            (127, 127, ErrorActive),
            (128, 0, ErrorPassive),
            (0, 128, ErrorPassive),
            (255, 255, ErrorPassive),
            (256, 0, BusOff),
        ] {
            let errors = CanErrors {
                transmit,
                receive,
                bus_offs: 9,
            };
            assert_eq!(errors.state(), state, "{errors:?}");
            assert_eq!(CanErrors::from_word(errors.to_word()), errors);
        }
    }
}
