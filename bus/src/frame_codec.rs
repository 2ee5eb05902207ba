//! Encodes messages as frames, and decodes frames.

use crate::signal::{Alter, Decode, Encode, List, MAX_LEN};
use crate::{CameraLanes, FRAMES, FrameError, FrameInfo, Message, e2e};

impl Message {
    /// Decodes a frame with a standard id. Does not check the end-to-end protection;
    /// [`FrameReceiver`](crate::FrameReceiver) checks and decodes.
    ///
    /// # Errors
    /// [`FrameError`]: the DBC does not contain the frame, or does not allow its length or a value.
    pub fn decode(id: u32, data: &[u8]) -> Result<Self, FrameError> {
        let mut message = u16::try_from(id)
            .ok()
            .and_then(Self::blank)
            .ok_or(FrameError::UnknownId)?;
        if data.len() != message.frame().len {
            return Err(FrameError::WrongLength);
        }
        let mut bytes = [0; MAX_LEN];
        bytes[..data.len()].copy_from_slice(data);
        message.walk(&mut Decode(&bytes))?;
        Ok(message)
    }

    /// Returns the frame, protected end to end with this counter; a frame with a protection of its
    /// own holds it in its values and has no counter.
    /// [`FrameTransmitter`](crate::FrameTransmitter) keeps the counters.
    ///
    /// Values out of range saturate, fractions round to nearest, NaN becomes 0.
    #[must_use]
    pub fn encode(&self, counter: u8) -> Encoded {
        let info = self.frame();
        let &FrameInfo { id, len, .. } = info;
        let mut bytes = [0; MAX_LEN];
        let mut message = *self;
        // Encoding never fails.
        let _ok = message.walk(&mut Encode(&mut bytes));
        info.protect(counter, &mut bytes[..len]);
        Encoded { id, len, bytes }
    }

    /// Replaces the value of one signal in a frame, by its DBC name, and protects the frame again
    /// with its own counter. `with` gets the physical value. NaN sets all bits of the signal; other
    /// values saturate. For faults: no product code alters a frame.
    ///
    /// # Errors
    /// [`FrameError`]: the DBC does not contain the frame or the signal, or not with this length.
    pub fn alter(
        id: u32,
        data: &mut [u8],
        name: &str,
        with: impl FnMut(f64) -> f64,
    ) -> Result<(), FrameError> {
        let blank = u16::try_from(id).ok().and_then(Self::blank);
        let mut message = blank.ok_or(FrameError::UnknownId)?;
        let info @ FrameInfo { len, .. } = *message.frame();
        if data.len() != len {
            return Err(FrameError::WrongLength);
        }
        let mut bytes = [0; MAX_LEN];
        bytes[..len].copy_from_slice(data);
        let mut alter = Alter {
            data: &mut bytes,
            name,
            with,
            is_found: false,
        };
        message.walk(&mut alter)?;
        if !alter.is_found {
            return Err(FrameError::UnknownSignal);
        }
        info.protect(data[2], &mut bytes[..len]);
        data.copy_from_slice(&bytes[..len]);
        Ok(())
    }

    /// Makes of a frame the one that would follow it, with another value of one signal: the
    /// `field`-th of [`Self::values`], or the counter if there is none. For faults, as
    /// [`Self::alter`].
    ///
    /// # Errors
    /// [`FrameError`]: the DBC does not contain the frame, or not with this length.
    pub fn forge(id: u32, data: &mut [u8], field: u8, value: f64) -> Result<(), FrameError> {
        let blank = u16::try_from(id).ok().and_then(Self::blank);
        let info = *blank.ok_or(FrameError::UnknownId)?.frame();
        if data.len() != info.len {
            return Err(FrameError::WrongLength);
        }
        let (mut index, mut name) = (0, None);
        if let Some(message) = blank {
            message.values(|signal, _| {
                name = if index == field { Some(signal) } else { name };
                index = index.saturating_add(1);
            });
        }
        let counter = match name {
            Some(_) => data[2].wrapping_add(1),
            None => value as u8,
        };
        info.protect(counter, data);
        name.map_or(Ok(()), |name| Self::alter(id, data, name, |_| value))
    }

    /// Returns the id of the frame.
    #[must_use]
    pub const fn id(&self) -> u16 {
        self.frame().id
    }

    /// Returns the properties of the frame that carries the message.
    #[inline(always)]
    #[must_use]
    pub const fn frame(&self) -> &'static FrameInfo {
        &FRAMES[self.index()]
    }

    /// Calls `each` with the DBC name and the physical value of each signal; flags and enums become
    /// numbers. Leaves out the end-to-end protection.
    pub fn values(&self, each: impl FnMut(&'static str, f64)) {
        let mut message = *self;
        // Listing never fails.
        let _ok = message.walk(&mut List(each));
    }
}

impl FrameInfo {
    /// Protects a frame end to end, if it has that protection.
    #[inline(always)]
    fn protect(&self, counter: u8, data: &mut [u8]) {
        if self.has_e2e {
            e2e::protect(self.id, counter, data);
        }
    }
}

impl CameraLanes {
    /// The value of `own_end`, `left_end` and `right_end` that means "no end in sight", m.
    pub const NO_END: f32 = Self::OWN_END.greatest();
    /// The value of `speed_limit` that means "none", m/s.
    pub const NO_SPEED_LIMIT: f32 = Self::SPEED_LIMIT.greatest();
}

/// A frame as it is on the bus: CAN FD with a standard id.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Encoded {
    /// Standard CAN id.
    pub id: u16,
    /// How many of `bytes` belong to the frame.
    pub len: usize,
    /// The data, zeroes from `len` on.
    pub bytes: [u8; MAX_LEN],
}

impl Encoded {
    /// Returns the data bytes.
    #[must_use]
    pub fn data(&self) -> &[u8] {
        &self.bytes[..self.len]
    }
}
