//! Samples as bytes, and the walk over a sample's members. Encoding and decoding share this walk.
//!
//! A payload is a representation (an identifier and options of two bytes each), the body and up to
//! three bytes of padding. XCDR1 and XCDR2 of the `@final` types of `idl/tandem.idl` differ only
//! in how members of 8 bytes are aligned. (OMG XTypes 1.3, 7.4 and 7.6.3.1.2)

use core::fmt;
use tandem_shm::{Corrupt, Payload};

/// Bytes of a payload before the body.
pub(crate) const HEAD: usize = 4;

/// Identifiers of the representations that are read.
const CDR_BE: u16 = 0;
const CDR_LE: u16 = 1;
const CDR2_BE: u16 = 6;
const CDR2_LE: u16 = 7;

/// Why a payload is not a sample, or why a sample cannot be written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CdrError {
    /// The representation has this identifier, which is not XCDR1 or XCDR2 of a `@final` type.
    Representation(u16),
    /// The payload ends before the last member.
    TooShort,
    /// More than padding follows the last member: the payload is of another type.
    TooLong,
    /// The member of this name holds a value that is out of its range or NaN, is not in its enum,
    /// or is a boolean other than 0 and 1.
    InvalidMember(&'static str),
}

impl fmt::Display for CdrError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Representation(id) => write!(f, "the representation {id:#06x} is not read"),
            Self::TooShort => f.write_str("the payload ends before the last member"),
            Self::TooLong => f.write_str("the payload is longer than its type"),
            Self::InvalidMember(name) => write!(f, "the member {name} has an invalid value"),
        }
    }
}

impl core::error::Error for CdrError {}

/// The bytes of a body.
enum Body<'a> {
    /// They become XCDR1, little-endian. They are zero.
    Written(&'a mut [u8]),
    Read(&'a [u8]),
}

/// A walk over the numbers of a sample in turn.
pub struct Walk<'a> {
    body: Body<'a>,
    at: usize,
    is_big_endian: bool,
    /// The strictest alignment, bytes.
    widest: usize,
}

impl Walk<'_> {
    /// Handles a number, little-endian: returns the one that the sample then has.
    fn number<const LEN: usize>(&mut self, mut number: [u8; LEN]) -> Result<[u8; LEN], CdrError> {
        let begin = self.at.next_multiple_of(LEN.clamp(1, self.widest));
        self.at = begin + LEN;
        match &mut self.body {
            Body::Written(bytes) => {
                let place = bytes.get_mut(begin..self.at);
                place.ok_or(CdrError::TooShort)?.copy_from_slice(&number);
            }
            Body::Read(bytes) => {
                let bytes = bytes.get(begin..self.at);
                number.copy_from_slice(bytes.ok_or(CdrError::TooShort)?);
                if self.is_big_endian {
                    number.reverse();
                }
            }
        }
        Ok(number)
    }
}

/// A Rust type for the value of a member, or for all members of a struct.
pub trait Field: Copy {
    const DEFAULT: Self;

    /// Replaces the value by what the walk returns for it; both must be values of this type.
    fn walk(&mut self, name: &'static str, walk: &mut Walk<'_>) -> Result<(), CdrError>;
}

macro_rules! field_of_number {
    ($($number:ty)*) => {$(
        impl Field for $number {
            const DEFAULT: Self = 0 as $number;

            fn walk(&mut self, _: &'static str, walk: &mut Walk<'_>) -> Result<(), CdrError> {
                *self = Self::from_le_bytes(walk.number(self.to_le_bytes())?);
                Ok(())
            }
        }
    )*};
}

// Each float has a range, and no range holds an infinity or NaN.
field_of_number!(u8 u16 u32 u64 f32);

impl Field for bool {
    const DEFAULT: Self = false;

    fn walk(&mut self, name: &'static str, walk: &mut Walk<'_>) -> Result<(), CdrError> {
        *self = match walk.number([u8::from(*self)])? {
            [0] => false,
            [1] => true,
            _ => return Err(CdrError::InvalidMember(name)),
        };
        Ok(())
    }
}

impl<F: Field, const LEN: usize> Field for [F; LEN] {
    const DEFAULT: Self = [F::DEFAULT; LEN];

    fn walk(&mut self, name: &'static str, walk: &mut Walk<'_>) -> Result<(), CdrError> {
        self.iter_mut()
            .try_for_each(|element| element.walk(name, walk))
    }
}

/// The enums of the IDL, of 32 bits. A struct begins with the first value.
macro_rules! enums {
    ($($(#[$doc:meta])* $name:ident[$count:literal] {
        $($(#[$about:meta])* $value:ident = $raw:literal,)+
    })+) => {$(
        $(#[$doc])*
        #[derive(Clone, Copy, Debug, PartialEq, Eq)]
        pub enum $name {
            $($(#[$about])* $value = $raw,)+
        }

        impl $name {
            /// Every value, in the order of the IDL.
            pub const ALL: [Self; $count] = [$(Self::$value,)+];
        }

        impl Field for $name {
            const DEFAULT: Self = Self::ALL[0];

            fn walk(&mut self, name: &'static str, walk: &mut Walk<'_>) -> Result<(), CdrError> {
                let mut raw = *self as u32;
                raw.walk(name, walk)?;
                let value = Self::ALL.into_iter().find(|value| *value as u32 == raw);
                *self = value.ok_or(CdrError::InvalidMember(name))?;
                Ok(())
            }
        }
    )+};
}
pub(crate) use enums;

/// The structs of the IDL, each with its type name, the length of its body and the walk over its
/// members; those that are protected end to end have a data id. A member may have a range.
macro_rules! structs {
    ($($(#[$doc:meta])* $name:ident[$type_name:literal, $len:literal $(, $data_id:literal)?] {$(
        $(#[$about:meta])* $member:ident: $type:ty $(= $range:expr)?,
    )+})+) => {$(
        $(#[$doc])*
        #[derive(Clone, Copy, Debug, PartialEq)]
        pub struct $name {
            $($(#[$about])* pub $member: $type,)+
        }

        impl Default for $name {
            fn default() -> Self {
                Field::DEFAULT
            }
        }

        impl Field for $name {
            const DEFAULT: Self = Self { $($member: Field::DEFAULT,)+ };

            fn walk(&mut self, _: &'static str, walk: &mut Walk<'_>) -> Result<(), CdrError> {
                $(
                    self.$member.walk(stringify!($member), walk)?;
                    $(if !($range).contains(&self.$member) {
                        return Err(CdrError::InvalidMember(stringify!($member)));
                    })?
                )+
                Ok(())
            }
        }

        impl TopicType for $name {
            const TYPE_NAME: &'static str = $type_name;
            const PAYLOAD_LEN: usize = cdr::HEAD + usize::next_multiple_of($len, 4);
            type Encoded = [u8; Self::PAYLOAD_LEN];

            fn encode(&self) -> Result<Self::Encoded, CdrError> {
                cdr::encode(self)
            }
        }

        impl Payload for $name {
            const WORDS: usize = usize::div_ceil($len, 4);

            fn store(&self, put: &mut impl FnMut(u32)) {
                cdr::store::<{ Self::PAYLOAD_LEN }>(self, put);
            }

            fn load(take: &mut impl FnMut() -> u32) -> Result<Self, Corrupt> {
                cdr::load::<{ Self::PAYLOAD_LEN }, _>(take)
            }
        }

        $(impl $name {
            /// Data id of the end-to-end protection. It differs from all data ids of the bus.
            pub const DATA_ID: u16 = $data_id;

            /// Sets the counter, and the CRC over all values. Call this last.
            ///
            /// # Errors
            /// As [`TopicType::encode`]; the sample is then unchanged.
            pub fn protect(&mut self, counter: u8) -> Result<(), CdrError> {
                let mut payload = self.encode()?;
                let body = &mut payload[cdr::HEAD..][..$len];
                e2e::protect(Self::DATA_ID, counter, body);
                self.crc = u16::from_le_bytes([body[0], body[1]]);
                self.counter = counter;
                Ok(())
            }

            /// Creates the checker of one sender of this type.
            #[must_use]
            pub const fn checker() -> Checker {
                Checker::new(Self::DATA_ID)
            }

            /// Judges the next sample of a sender by its CRC and its counter. The representation in
            /// which it arrived does not matter.
            pub fn check(&self, checker: &mut Checker) -> Check {
                // A sample with a value out of range was not decoded: it can have no right CRC.
                let judge = |payload: [u8; _]| checker.check(&payload[cdr::HEAD..][..$len]);
                self.encode().map_or(Check::CrcError, judge)
            }
        })?
    )+};
}
pub(crate) use structs;

/// A struct of the IDL. Its words in the LMU hold the body; a value out of range is stored as one
/// that no reader accepts.
pub trait TopicType: Field + Payload + Default {
    /// Name of the type as DDS knows it.
    const TYPE_NAME: &'static str;
    /// Length of a payload, bytes.
    const PAYLOAD_LEN: usize;
    /// The bytes of a payload.
    type Encoded: AsRef<[u8]>;

    /// Returns the payload: XCDR1, little-endian, with zeroes as padding.
    ///
    /// # Errors
    /// [`CdrError::InvalidMember`]: a value is out of range.
    fn encode(&self) -> Result<Self::Encoded, CdrError>;

    /// Reads a payload of XCDR1 or XCDR2, in either byte order. The contents of padding are
    /// ignored.
    ///
    /// # Errors
    /// [`CdrError`]: the payload is not a sample of this type.
    fn decode(payload: &[u8]) -> Result<Self, CdrError> {
        decode(payload)
    }
}

/// Returns the payload of a sample: the representation, the body, zeroes up to a multiple of four.
/// The options count these zeroes.
pub(crate) fn encode<const LEN: usize>(sample: &impl Field) -> Result<[u8; LEN], CdrError> {
    let mut payload = [0; LEN];
    let mut walk = Walk {
        body: Body::Written(&mut payload[HEAD..]),
        at: 0,
        is_big_endian: false,
        widest: 8,
    };
    let mut sample = *sample;
    sample.walk("", &mut walk)?;
    let padding = LEN - HEAD - walk.at;
    payload[..HEAD].copy_from_slice(&[0, CDR_LE as u8, 0, padding as u8]);
    Ok(payload)
}

/// Stores a body as words. All bytes 0xFF are no value of any type of the IDL.
pub(crate) fn store<const LEN: usize>(sample: &impl Field, put: &mut impl FnMut(u32)) {
    let payload = encode(sample).unwrap_or([0xFF; LEN]);
    for word in &payload.as_chunks().0[1..] {
        put(u32::from_le_bytes(*word));
    }
}

/// Reads a body from its words.
pub(crate) fn load<const LEN: usize, T: Field>(
    take: &mut impl FnMut() -> u32,
) -> Result<T, Corrupt> {
    let mut payload = [0; LEN];
    payload[1] = CDR_LE as u8;
    for word in &mut payload.as_chunks_mut().0[1..] {
        *word = take().to_le_bytes();
    }
    decode(&payload).map_err(|_| Corrupt)
}

/// Reads a payload.
///
/// The last two bits of the options count the bytes of padding at the end (XTypes 1.3, 7.6.3.1.2).
/// A writer of plain RTPS leaves them zero, but pads too: submessages are aligned to four bytes
/// (RTPS 2.5, 9.4.1). So up to three bytes behind the last member are padding. More are an error: a
/// `@final` type has the same members everywhere (XTypes 1.3, 7.2.3).
fn decode<T: Field>(payload: &[u8]) -> Result<T, CdrError> {
    let (head, rest) = payload.split_first_chunk().ok_or(CdrError::TooShort)?;
    let [id_high, id_low, _, options]: [u8; HEAD] = *head;
    let (is_big_endian, widest) = match u16::from_be_bytes([id_high, id_low]) {
        CDR_BE => (true, 8),
        CDR_LE => (false, 8),
        CDR2_BE => (true, 4),
        CDR2_LE => (false, 4),
        other => return Err(CdrError::Representation(other)),
    };
    let len = rest.len().saturating_sub(usize::from(options & 3));
    let mut walk = Walk {
        body: Body::Read(&rest[..len]),
        at: 0,
        is_big_endian,
        widest,
    };
    let mut sample = T::DEFAULT;
    sample.walk("", &mut walk)?;
    match rest.len() - walk.at {
        0..4 => Ok(sample),
        _ => Err(CdrError::TooLong),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A type with a member of 8 bytes, which the IDL does not have.
    #[derive(Clone, Copy, Debug, PartialEq)]
    struct Wide {
        octets: [u8; 3],
        wide: u64,
        last: u16,
    }

    impl Field for Wide {
        const DEFAULT: Self = WIDE;

        fn walk(&mut self, _: &'static str, walk: &mut Walk<'_>) -> Result<(), CdrError> {
            self.octets.walk("octets", walk)?;
            self.wide.walk("wide", walk)?;
            self.last.walk("last", walk)
        }
    }

    const WIDE: Wide = Wide {
        octets: [1, 2, 3],
        wide: 0x0807_0605_0403_0201,
        last: 0x0A09,
    };

    /// XTypes 1.3, 7.4: members of 8 bytes are aligned to 8 in XCDR1, and to 4 in XCDR2.
    #[test]
    fn a_member_of_8_bytes_is_aligned_to_4_in_xcdr2() {
        let xcdr1_le = [
            0, 1, 0, 2, 1, 2, 3, 0, 0, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 0, 0,
        ];
        let xcdr1_be = [
            0, 0, 0, 2, 1, 2, 3, 0, 0, 0, 0, 0, 8, 7, 6, 5, 4, 3, 2, 1, 10, 9, 0, 0,
        ];
        let xcdr2_le = [0, 7, 0, 2, 1, 2, 3, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 0, 0];
        let xcdr2_be = [0, 6, 0, 2, 1, 2, 3, 0, 8, 7, 6, 5, 4, 3, 2, 1, 10, 9, 0, 0];
        assert_eq!(encode(&WIDE), Ok(xcdr1_le));
        for payload in [&xcdr1_le[..], &xcdr1_be, &xcdr2_le, &xcdr2_be] {
            assert_eq!(decode(payload), Ok(WIDE), "{payload:?}");
        }
    }
}
