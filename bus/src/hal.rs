//! Frames from and for CAN drivers of a HAL, with the traits of `embedded-can`.

use embedded_can::{Frame, Id, StandardId};

use crate::{Encoded, FrameError, FrameReceiver, Message, ReceiveError};

impl Encoded {
    /// Returns this frame as one of a driver; `None` if the driver's frames have no room for it: a
    /// classic controller carries 8 bytes, and most frames of the DBC are longer.
    #[must_use]
    pub fn to_hal<F: Frame>(&self) -> Option<F> {
        F::new(StandardId::new(self.id)?, self.data())
    }
}

impl FrameReceiver {
    /// Like [`FrameReceiver::receive`], of a driver's frame.
    ///
    /// # Errors
    /// As [`FrameReceiver::receive`]; an extended id and a remote frame are
    /// [`FrameError::UnknownId`].
    pub fn receive_hal(&mut self, frame: &impl Frame) -> Result<Message, ReceiveError> {
        match frame.id() {
            Id::Standard(id) if !frame.is_remote_frame() => {
                self.receive(u32::from(id.as_raw()), frame.data())
            }
            _ => Err(ReceiveError::Decode(FrameError::UnknownId)),
        }
    }
}
