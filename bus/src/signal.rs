//! One signal of a frame: where its bits are and what they mean.

use core::fmt;

/// The properties of every frame of the DBC.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FrameInfo {
    /// Standard CAN id.
    pub id: u16,
    /// Name in the DBC.
    pub name: &'static str,
    /// Length, bytes.
    pub len: usize,
    /// Period, ms.
    pub cycle_ms: u32,
}

/// Why a frame could not be decoded.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DecodeError {
    /// The DBC has no frame with this id.
    UnknownId,
    /// The frame is not as long as the DBC says.
    WrongLength,
    /// The signal of this name holds a value that is out of its range or not in its value table, or
    /// that contradicts the frame's id.
    InvalidSignal(&'static str),
}

impl fmt::Display for DecodeError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::UnknownId => f.write_str("no frame of the vehicle bus has this id"),
            Self::WrongLength => f.write_str("the frame does not have the length of the DBC"),
            Self::InvalidSignal(name) => write!(f, "the signal {name} has an invalid value"),
        }
    }
}

impl core::error::Error for DecodeError {}

/// A little endian (Intel) signal of up to 32 bits without offset; signed if `min` is negative.
pub(crate) struct Signal {
    pub(crate) name: &'static str,
    /// Position of the lowest bit; bit 0 is the lowest of byte 0.
    pub(crate) start: usize,
    /// Bits, 1 ..= 32.
    pub(crate) len: u32,
    /// Physical value of one step.
    pub(crate) factor: f32,
    /// Least raw value.
    pub(crate) min: i64,
    /// Greatest raw value.
    pub(crate) max: i64,
}

impl Signal {
    /// The raw value. `data` must hold the signal's bits.
    // With a signal that is known it is a few instructions.
    #[inline(always)]
    pub(crate) fn get(&self, data: &[u8]) -> Result<i64, DecodeError> {
        let mut window = 0;
        for (i, byte) in data[self.bytes()].iter().enumerate() {
            window |= u64::from(*byte) << (8 * i);
        }
        let unsigned = (window >> (self.start % 8)) & self.mask();
        let raw = if self.min < 0 {
            let unused = u64::BITS - self.len;
            (unsigned << unused) as i64 >> unused
        } else {
            unsigned as i64
        };
        if (self.min..=self.max).contains(&raw) {
            Ok(raw)
        } else {
            Err(self.invalid())
        }
    }

    /// The physical value.
    #[inline]
    pub(crate) fn get_physical(&self, data: &[u8]) -> Result<f32, DecodeError> {
        Ok(self.get(data)? as f32 * self.factor)
    }

    /// Writes the raw value, saturated to the signal's range. The bits must be zero before.
    pub(crate) fn put(&self, data: &mut [u8], raw: i64) {
        let unsigned = raw.clamp(self.min, self.max) as u64 & self.mask();
        let window = unsigned << (self.start % 8);
        for (i, byte) in data[self.bytes()].iter_mut().enumerate() {
            *byte |= (window >> (8 * i)) as u8;
        }
    }

    /// Puts the physical value rounded to the nearest step; NaN as 0.
    pub(crate) fn put_physical(&self, data: &mut [u8], value: f32) {
        self.put(data, round(value / self.factor));
    }

    /// The error that names this signal.
    pub(crate) const fn invalid(&self) -> DecodeError {
        DecodeError::InvalidSignal(self.name)
    }

    /// Greatest physical value.
    pub(crate) const fn greatest(&self) -> f32 {
        self.max as f32 * self.factor
    }

    fn bytes(&self) -> core::ops::RangeInclusive<usize> {
        self.start / 8..=(self.start + self.len as usize - 1) / 8
    }

    const fn mask(&self) -> u64 {
        (1 << self.len) - 1
    }
}

/// Nearest integer, halves away from zero, saturated; NaN gives 0. (`f32::round` needs `std`.)
fn round(value: f32) -> i64 {
    let whole = value as i64;
    let fraction = value - whole as f32;
    if fraction >= 0.5 {
        whole.saturating_add(1)
    } else if fraction <= -0.5 {
        whole.saturating_sub(1)
    } else {
        whole
    }
}
