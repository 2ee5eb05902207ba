//! The position of a signal's bits, and the walk over a frame's signals. Encoding, decoding and
//! listing share this walk.

use core::fmt;
use core::ops::RangeInclusive;

/// The properties of a frame of the DBC.
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
    /// Whether [`e2e`](crate::e2e) protects it. Else the frame has a protection of its own, which
    /// is a part of its values: its reader checks it.
    pub has_e2e: bool,
}

impl FrameInfo {
    pub(crate) const fn new(id: u16, name: &'static str, len: usize, cycle_ms: u32) -> Self {
        Self {
            id,
            name,
            len,
            cycle_ms,
            has_e2e: true,
        }
    }

    /// Returns the same frame with a protection of its own.
    pub(crate) const fn without_e2e(self) -> Self {
        Self {
            has_e2e: false,
            ..self
        }
    }
}

/// Why a frame could not be decoded.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum FrameError {
    /// The DBC has no frame with this id.
    UnknownId,
    /// The frame is not as long as the DBC says.
    WrongLength,
    /// The frame has no signal of this name.
    UnknownSignal,
    /// The signal of this name holds a value that is out of its range or not in its value table, or
    /// that contradicts the frame's id.
    InvalidSignal(&'static str),
}

impl fmt::Display for FrameError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::UnknownId => f.write_str("no frame of the vehicle bus has this id"),
            Self::WrongLength => f.write_str("the frame does not have the length of the DBC"),
            Self::UnknownSignal => f.write_str("the frame has no signal of this name"),
            Self::InvalidSignal(name) => write!(f, "the signal {name} has an invalid value"),
        }
    }
}

impl core::error::Error for FrameError {}

/// Bytes of the longest frame of CAN FD.
pub(crate) const MAX_LEN: usize = 64;

/// A signal of up to 32 bits without offset; signed if `min` is negative. It is little endian
/// (Intel); one of whole bytes may be big endian (Motorola).
#[derive(Debug)]
pub(crate) struct Signal {
    name: &'static str,
    /// Position of the lowest bit, of the first byte's if it is big endian; bit 0 is the lowest of
    /// byte 0.
    start: usize,
    /// Number of bits, 1 ..= 32.
    len: u32,
    /// Least raw value.
    min: i64,
    /// Greatest raw value.
    max: i64,
    /// Physical value of one step.
    factor: f32,
    /// Whether the first byte is the highest.
    is_big_endian: bool,
}

impl Signal {
    /// Creates a signal whose raw value equals its physical value.
    pub(crate) const fn new(
        name: &'static str,
        start: usize,
        len: u32,
        range: RangeInclusive<i64>,
    ) -> Self {
        Self {
            name,
            start,
            len,
            min: *range.start(),
            max: *range.end(),
            factor: 1.0,
            is_big_endian: false,
        }
    }

    /// Returns the same signal with its highest byte first. It fills whole bytes.
    pub(crate) const fn big_endian(self) -> Self {
        Self {
            is_big_endian: true,
            ..self
        }
    }

    /// Returns the same signal with steps of this size.
    pub(crate) const fn in_steps_of(self, factor: f32) -> Self {
        Self { factor, ..self }
    }

    /// Returns the greatest physical value.
    pub(crate) const fn greatest(&self) -> f32 {
        self.max as f32 * self.factor
    }

    // For a constant signal this compiles to a few instructions.
    #[inline(always)]
    fn get(&self, data: &[u8; MAX_LEN]) -> Result<i64, FrameError> {
        let mut window = 0;
        for (i, byte) in data[self.bytes()].iter().enumerate() {
            window |= u64::from(*byte) << (8 * i);
        }
        let unsigned = (self.ordered(window) >> (self.start % 8)) & self.mask();
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

    /// Writes the raw value, saturated to the signal's range. The bits must be zero before.
    #[inline(always)]
    fn put(&self, data: &mut [u8; MAX_LEN], raw: i64) {
        let unsigned = raw.clamp(self.min, self.max) as u64 & self.mask();
        let window = self.ordered(unsigned << (self.start % 8));
        for (i, byte) in data[self.bytes()].iter_mut().enumerate() {
            *byte |= (window >> (8 * i)) as u8;
        }
    }

    const fn invalid(&self) -> FrameError {
        FrameError::InvalidSignal(self.name)
    }

    fn bytes(&self) -> RangeInclusive<usize> {
        self.start / 8..=(self.start + self.len as usize - 1) / 8
    }

    /// Turns the signal's bytes round if it is big endian.
    const fn ordered(&self, bytes: u64) -> u64 {
        if self.is_big_endian {
            bytes.swap_bytes() >> (u64::BITS - self.len)
        } else {
            bytes
        }
    }

    const fn mask(&self) -> u64 {
        (1 << self.len) - 1
    }
}

/// A Rust type for the value of a signal.
pub(crate) trait Field: Copy {
    /// Returns the raw value; it may be out of the signal's range.
    fn to_raw(self, signal: &Signal) -> i64;

    /// Returns the value; `None` if it is not in the value table. `raw` is in the signal's range.
    fn from_raw(signal: &Signal, raw: i64) -> Option<Self>;

    /// Returns the physical value.
    fn physical(self) -> f64;
}

macro_rules! field_of_integer {
    ($($integer:ty)*) => {$(
        impl Field for $integer {
            fn to_raw(self, _: &Signal) -> i64 {
                i64::from(self)
            }

            fn from_raw(_: &Signal, raw: i64) -> Option<Self> {
                // The signal is not wider than its Rust type.
                Some(raw as Self)
            }

            fn physical(self) -> f64 {
                f64::from(self)
            }
        }
    )*};
}

field_of_integer!(u8 u16 u32);

impl Field for bool {
    fn to_raw(self, _: &Signal) -> i64 {
        i64::from(self)
    }

    fn from_raw(_: &Signal, raw: i64) -> Option<Self> {
        Some(raw != 0)
    }

    fn physical(self) -> f64 {
        f64::from(u8::from(self))
    }
}

/// Values are rounded to the nearest step; NaN becomes 0.
impl Field for f32 {
    fn to_raw(self, signal: &Signal) -> i64 {
        round(self / signal.factor)
    }

    fn from_raw(signal: &Signal, raw: i64) -> Option<Self> {
        Some(raw as Self * signal.factor)
    }

    fn physical(self) -> f64 {
        f64::from(self)
    }
}

/// An enum generated from a value table.
pub(crate) trait ValueTable: Copy + 'static {
    /// Every value.
    const VALUES: &'static [Self];

    fn raw(self) -> u8;
}

impl<T: ValueTable> Field for T {
    fn to_raw(self, _: &Signal) -> i64 {
        i64::from(self.raw())
    }

    fn from_raw(_: &Signal, raw: i64) -> Option<Self> {
        let mut values = T::VALUES.iter().copied();
        values.find(|value| i64::from(value.raw()) == raw)
    }

    fn physical(self) -> f64 {
        f64::from(self.raw())
    }
}

/// The enums of the DBC's value tables; the first value is the default.
macro_rules! value_tables {
    ($($(#[$doc:meta])* $name:ident[$count:literal] {
        $first:ident = $first_raw:literal $(, $value:ident = $raw:literal)*
    })+) => {$(
        $(#[$doc])*
        #[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
        #[cfg_attr(feature = "defmt", derive(defmt::Format))]
        pub enum $name {
            #[doc = concat!("Coded as ", $first_raw, ".")]
            #[default]
            $first = $first_raw,
            $(#[doc = concat!("Coded as ", $raw, ".")] $value = $raw,)*
        }

        impl $name {
            /// Every value, in the order of the DBC.
            pub const ALL: [Self; $count] = [Self::$first $(, Self::$value)*];

            /// Returns the value that is coded as `raw`; `None` if there is none.
            #[must_use]
            pub fn from_raw(raw: u8) -> Option<Self> {
                Self::ALL.into_iter().find(|value| *value as u8 == raw)
            }
        }

        impl $crate::signal::ValueTable for $name {
            const VALUES: &'static [Self] = &Self::ALL;

            fn raw(self) -> u8 {
                self as u8
            }
        }
    )+};
}
pub(crate) use value_tables;

/// The structs of the DBC's messages, each with its ids, its signals and the walk over them. A
/// signal has a name, a first bit, a length, a range of raw values, and the value of one step.
macro_rules! layouts {
    ($($(#[$doc:meta])* $name:ident $ids:tt {$(
        $(#[$about:meta])*
        $field:ident: $type:ident = $signal:ident($($place:expr),+ $(; $step:literal)?)
            $(.$order:ident())?,
    )+})+) => {$(
        $(#[$doc])*
        #[derive(Clone, Copy, Debug, Default, PartialEq)]
        pub struct $name {
            $($(#[$about])* pub $field: $type,)+
        }

        impl $name {
            layouts!(@ids $ids);
            $(pub(crate) const $signal: Signal = Signal::new($($place),+)
                $(.in_steps_of($step))?$(.$order())?;)+

            fn walk(&mut self, walk: &mut impl Walk) -> Result<(), FrameError> {
                $(walk.field(&Self::$signal, &mut self.$field)?;)+
                Ok(())
            }
        }
    )+};
    (@ids [$id:literal]) => {
        /// Id of the frame.
        pub const ID: u16 = $id;
        layouts!(@all [$id]);
    };
    (@ids $ids:tt) => {
        layouts!(@all $ids);
    };
    (@all $ids:tt) => {
        /// Ids of the frames with this layout, in the order of the DBC.
        pub const IDS: [u16; $ids.len()] = $ids;
    };
}
pub(crate) use layouts;

/// An operation on each signal of a frame in turn.
pub(crate) trait Walk {
    /// Handles a signal that is a field of the message.
    fn field<F: Field>(&mut self, signal: &Signal, value: &mut F) -> Result<(), FrameError>;

    /// Handles a signal whose value follows from the frame's id.
    #[inline]
    fn implied(&mut self, signal: &Signal, raw: u8) -> Result<(), FrameError> {
        let mut value = raw;
        self.field(signal, &mut value)?;
        if value == raw {
            Ok(())
        } else {
            Err(signal.invalid())
        }
    }
}

/// Writes all signals into zeroed bytes. Never fails.
pub(crate) struct Encode<'a>(pub(crate) &'a mut [u8; MAX_LEN]);

impl Walk for Encode<'_> {
    #[inline(always)]
    fn field<F: Field>(&mut self, signal: &Signal, value: &mut F) -> Result<(), FrameError> {
        signal.put(self.0, value.to_raw(signal));
        Ok(())
    }
}

/// Reads all signals.
pub(crate) struct Decode<'a>(pub(crate) &'a [u8; MAX_LEN]);

impl Walk for Decode<'_> {
    #[inline(always)]
    fn field<F: Field>(&mut self, signal: &Signal, value: &mut F) -> Result<(), FrameError> {
        let raw = signal.get(self.0)?;
        *value = F::from_raw(signal, raw).ok_or(signal.invalid())?;
        Ok(())
    }
}

/// Replaces the value of the signal of this name.
pub(crate) struct Alter<'a, C> {
    pub(crate) data: &'a mut [u8; MAX_LEN],
    pub(crate) name: &'a str,
    pub(crate) with: C,
    pub(crate) is_found: bool,
}

impl<C: FnMut(f64) -> f64> Walk for Alter<'_, C> {
    fn field<F: Field>(&mut self, signal: &Signal, _: &mut F) -> Result<(), FrameError> {
        if signal.name == self.name {
            self.is_found = true;
            let factor = f64::from(signal.factor);
            let value = (self.with)(signal.get(self.data)? as f64 * factor);
            let mask = signal.ordered(signal.mask() << (signal.start % 8));
            let bits = if value.is_nan() {
                signal.mask()
            } else {
                let steps = value / factor;
                let raw = (if steps < 0.0 {
                    steps - 0.5
                } else {
                    steps + 0.5
                }) as i64;
                raw.clamp(signal.min, signal.max) as u64 & signal.mask()
            };
            let window = signal.ordered(bits << (signal.start % 8));
            for (i, byte) in self.data[signal.bytes()].iter_mut().enumerate() {
                *byte = *byte & !((mask >> (8 * i)) as u8) | (window >> (8 * i)) as u8;
            }
        }
        Ok(())
    }

    fn implied(&mut self, signal: &Signal, mut raw: u8) -> Result<(), FrameError> {
        self.field(signal, &mut raw)
    }
}

/// Calls the closure with the name and the physical value of each signal. Never fails.
pub(crate) struct List<C>(pub(crate) C);

impl<C: FnMut(&'static str, f64)> Walk for List<C> {
    fn field<F: Field>(&mut self, signal: &Signal, value: &mut F) -> Result<(), FrameError> {
        (self.0)(signal.name, value.physical());
        Ok(())
    }
}

/// Rounds halves away from zero and saturates; NaN gives 0. (`f32::round` needs `std`.)
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

#[cfg(test)]
mod tests {
    extern crate std;
    use super::*;
    use proptest::prelude::*;

    /// Generates signals at any place, of any length, range and step.
    fn signal() -> impl Strategy<Value = Signal> {
        let place = (24_usize..200, 1_u32..=32, any::<bool>());
        (place, any::<(u32, u32)>(), 1e-8_f32..10.0).prop_map(
            |((start, len, is_signed), (one, other), factor)| {
                let lowest = if is_signed { -(1_i64 << (len - 1)) } else { 0 };
                let within = |seed: u32| lowest + i64::from(seed) % (1 << len);
                let (one, other) = (within(one), within(other));
                let min = one.min(other).min(if is_signed { -1 } else { 0 });
                Signal::new("Any", start, len, min..=one.max(other)).in_steps_of(factor)
            },
        )
    }

    proptest! {
        /// For any value written, reading returns the nearest one that the signal can hold. No
        /// other bit of the frame changes.
        #[test]
        fn values_saturate_and_round(signal in signal(), value: f32, raw: i64) {
            let mut data = [0; MAX_LEN];
            signal.put(&mut data, raw);
            prop_assert_eq!(signal.get(&data), Ok(raw.clamp(signal.min, signal.max)));
            let ones: u32 = data.iter().map(|byte| byte.count_ones()).sum();
            let own = (signal.get(&data).unwrap() as u64 & signal.mask()).count_ones();
            prop_assert_eq!(ones, own);

            let mut data = [0; MAX_LEN];
            signal.put(&mut data, value.to_raw(&signal));
            let steps = if value.is_nan() { 0.0 } else { f64::from(value / signal.factor) };
            let nearest = steps.clamp(signal.min as f64, signal.max as f64);
            let read = signal.get(&data).unwrap() as f64;
            prop_assert!((read - nearest).abs() <= 0.5, "{value}: {read} for {nearest}");
        }
    }
}
