//! The CAN / CAN FD controller.

use crate::Instant;

/// A CAN identifier: standard (11 bit) or extended (29 bit).
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum CanId {
    /// 0 ..= 0x7FF
    Standard(u16),
    /// 0 ..= 0x1FFF_FFFF
    Extended(u32),
}

/// A classic CAN or CAN FD data frame. Construction checks it, so a `CanFrame` is always sendable.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct CanFrame {
    id: CanId,
    fd: bool,
    len: u8,
    data: [u8; 64],
}

/// The id is out of range, or the length is not one of CAN (0..=8) or CAN FD (0..=8, 12, 16, 20,
/// 24, 32, 48, 64).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct InvalidFrame;

impl CanFrame {
    /// A frame with these data; CAN FD if `fd`.
    ///
    /// # Errors
    /// [`InvalidFrame`] if the id or the length is not one that the bus can carry.
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

    /// The identifier.
    #[must_use]
    pub const fn id(&self) -> CanId {
        self.id
    }

    /// Whether it is a CAN FD frame.
    #[must_use]
    pub const fn is_fd(&self) -> bool {
        self.fd
    }

    /// The data bytes.
    #[must_use]
    pub fn data(&self) -> &[u8] {
        &self.data[..self.len as usize]
    }
}

/// The transmit buffer is full; the frame was not taken.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TransmitFull;

/// A frame received from the bus.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Received {
    /// The frame.
    pub frame: CanFrame,
    /// When it was on the bus, on the receiver's clock.
    pub at: Instant,
}

/// A CAN controller with its own receive FIFO. Frames arrive in bus order; a core does not receive
/// its own frames.
pub trait Can {
    /// Hands a frame to the transmit buffer. One at a time. Frames of one core leave in order.
    ///
    /// # Errors
    /// [`TransmitFull`] if the buffer is full.
    fn try_send(&self, frame: &CanFrame) -> Result<(), TransmitFull>;

    /// Discards this core's frames that wait in the transmit buffer. One at a time.
    ///
    /// A frame that is already on its way to the bus is still sent. So of the frames handed over
    /// before this call, the first few may be sent, and the others never. A frame handed over after
    /// this call is sent as usual.
    fn discard_unsent(&self);

    /// The next received frame. One at a time.
    fn try_receive(&self) -> Option<Received>;

    /// Whether a received frame ends [`Board::wait`](crate::Board::wait); off at start. Any
    /// context.
    fn wake_on_receive(&self, on: bool);

    /// How many frames were lost because this core did not fetch them in time; wraps around. Any
    /// context.
    fn overruns(&self) -> u32;
}
