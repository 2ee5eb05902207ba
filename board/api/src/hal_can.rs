//! Frames and ids from and for CAN drivers of a HAL, with the traits of `embedded-can`.

use embedded_can::{ExtendedId, Frame, Id, StandardId};

use crate::{CanFrame, CanId, InvalidFrame};

impl From<Id> for CanId {
    fn from(id: Id) -> Self {
        match id {
            Id::Standard(id) => Self::Standard(id.as_raw()),
            Id::Extended(id) => Self::Extended(id.as_raw()),
        }
    }
}

impl TryFrom<CanId> for Id {
    type Error = InvalidFrame;

    /// # Errors
    /// [`InvalidFrame`] for a number that is out of its range; the id of a [`CanFrame`] never is.
    fn try_from(id: CanId) -> Result<Self, InvalidFrame> {
        let id = match id {
            CanId::Standard(id) => StandardId::new(id).map(Self::Standard),
            CanId::Extended(id) => ExtendedId::new(id).map(Self::Extended),
        };
        id.ok_or(InvalidFrame)
    }
}

/// A frame of more than 8 bytes is one of CAN FD; one of up to 8 bytes is classic.
/// [`CanFrame::new`] chooses. Here is no remote frame: CAN FD has none.
impl Frame for CanFrame {
    fn new(id: impl Into<Id>, data: &[u8]) -> Option<Self> {
        Self::new(id.into().into(), data.len() > 8, data).ok()
    }

    /// Returns `None`.
    fn new_remote(_id: impl Into<Id>, _dlc: usize) -> Option<Self> {
        None
    }

    fn is_extended(&self) -> bool {
        matches!(self.id(), CanId::Extended(_))
    }

    fn is_remote_frame(&self) -> bool {
        false
    }

    fn id(&self) -> Id {
        // A frame was checked when it was made; 0 is never reached.
        Self::id(self)
            .try_into()
            .unwrap_or(Id::Standard(StandardId::ZERO))
    }

    /// Returns the number of data bytes, up to 64; not the code that stands for it on the bus.
    fn dlc(&self) -> usize {
        Self::data(self).len()
    }

    fn data(&self) -> &[u8] {
        Self::data(self)
    }
}

impl CanFrame {
    /// Takes the frame of a driver: classic up to 8 bytes, CAN FD above.
    ///
    /// # Errors
    /// [`InvalidFrame`] for a remote frame, and for a length that the bus cannot carry.
    pub fn from_hal(frame: &impl Frame) -> Result<Self, InvalidFrame> {
        if frame.is_remote_frame() {
            return Err(InvalidFrame);
        }
        let data = frame.data();
        Self::new(frame.id().into(), data.len() > 8, data)
    }

    /// Returns this frame as one of a driver; `None` if the driver's frames have no room for it.
    #[must_use]
    pub fn to_hal<F: Frame>(&self) -> Option<F> {
        F::new(Frame::id(self), self.data())
    }
}
