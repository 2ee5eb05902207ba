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

/// An operation on each number of a sample in turn.
pub(crate) trait Walk {
    /// Handles a number, little-endian: returns the one that the sample then has.
    fn number<const BYTES: usize>(&mut self, number: [u8; BYTES]) -> Result<[u8; BYTES], CdrError>;
}

/// Returns where a member begins that is not before `at`.
fn aligned(at: usize, bytes: usize, widest: usize) -> usize {
    at.next_multiple_of(bytes.clamp(1, widest))
}

/// Writes XCDR1, little-endian, into zeroed bytes.
struct Encode<'a> {
    body: &'a mut [u8],
    at: usize,
}

impl Walk for Encode<'_> {
    fn number<const BYTES: usize>(&mut self, number: [u8; BYTES]) -> Result<[u8; BYTES], CdrError> {
        let begin = aligned(self.at, BYTES, 8);
        self.at = begin + BYTES;
        let place = self.body.get_mut(begin..self.at);
        place.ok_or(CdrError::TooShort)?.copy_from_slice(&number);
        Ok(number)
    }
}

/// Reads any of the representations.
struct Decode<'a> {
    body: &'a [u8],
    at: usize,
    is_big_endian: bool,
    /// The strictest alignment, bytes.
    widest: usize,
}

impl Walk for Decode<'_> {
    fn number<const BYTES: usize>(&mut self, _: [u8; BYTES]) -> Result<[u8; BYTES], CdrError> {
        let begin = aligned(self.at, BYTES, self.widest);
        let rest = self.body.get(begin..).ok_or(CdrError::TooShort)?;
        let mut number = *rest.first_chunk().ok_or(CdrError::TooShort)?;
        self.at = begin + BYTES;
        if self.is_big_endian {
            number.reverse();
        }
        Ok(number)
    }
}

/// A Rust type for the value of a member.
pub(crate) trait Field: Copy {
    const DEFAULT: Self;

    /// Replaces the value by what the walk returns for it; both must be values of this type.
    fn walk(&mut self, name: &'static str, walk: &mut impl Walk) -> Result<(), CdrError>;
}

macro_rules! field_of_number {
    ($($number:ty)*) => {$(
        impl Field for $number {
            const DEFAULT: Self = 0 as $number;

            fn walk(&mut self, _: &'static str, walk: &mut impl Walk) -> Result<(), CdrError> {
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

    fn walk(&mut self, name: &'static str, walk: &mut impl Walk) -> Result<(), CdrError> {
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

    fn walk(&mut self, name: &'static str, walk: &mut impl Walk) -> Result<(), CdrError> {
        self.iter_mut()
            .try_for_each(|element| element.walk(name, walk))
    }
}

/// The enums of the IDL, of 32 bits; the first value is the default.
macro_rules! enums {
    ($($(#[$doc:meta])* $name:ident[$count:literal] {
        $(#[$first_about:meta])* $first:ident = $first_raw:literal,
        $($(#[$about:meta])* $value:ident = $raw:literal,)*
    })+) => {$(
        $(#[$doc])*
        #[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
        pub enum $name {
            $(#[$first_about])*
            #[default]
            $first = $first_raw,
            $($(#[$about])* $value = $raw,)*
        }

        impl $name {
            /// Every value, in the order of the IDL.
            pub const ALL: [Self; $count] = [Self::$first $(, Self::$value)*];
        }

        impl Field for $name {
            const DEFAULT: Self = Self::$first;

            fn walk(&mut self, name: &'static str, walk: &mut impl Walk) -> Result<(), CdrError> {
                let raw = u32::from_le_bytes(walk.number((*self as u32).to_le_bytes())?);
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
                Self { $($member: Field::DEFAULT,)+ }
            }
        }

        impl Record for $name {
            fn walk(&mut self, walk: &mut impl Walk) -> Result<(), CdrError> {
                $(
                    self.$member.walk(stringify!($member), walk)?;
                    $(if !($range).contains(&self.$member) {
                        return Err(CdrError::InvalidMember(stringify!($member)));
                    })?
                )+
                Ok(())
            }
        }

        impl $name {
            /// Name of the type as DDS knows it.
            pub const TYPE_NAME: &'static str = $type_name;
            /// Length of a payload, bytes.
            pub const PAYLOAD_LEN: usize = cdr::HEAD + usize::next_multiple_of($len, 4);

            /// Returns the payload: XCDR1, little-endian, with zeroes as padding.
            ///
            /// # Errors
            /// [`CdrError::InvalidMember`]: a value is out of range.
            pub fn encode(&self) -> Result<[u8; Self::PAYLOAD_LEN], CdrError> {
                Ok(cdr::payload(cdr::body::<$len>(self)?))
            }

            /// Reads a payload of XCDR1 or XCDR2, in either byte order. The contents of padding are
            /// ignored.
            ///
            /// # Errors
            /// [`CdrError`]: the payload is not a sample of this type.
            pub fn decode(payload: &[u8]) -> Result<Self, CdrError> {
                cdr::decode(payload)
            }
        }

        impl cdr::TopicType for $name {
            fn encode_for<R>(&self, to: impl FnOnce(&[u8]) -> R) -> Result<R, CdrError> {
                Ok(to(&self.encode()?))
            }

            fn decode_from(payload: &[u8]) -> Result<Self, CdrError> {
                cdr::decode(payload)
            }
        }

        impl tandem_shm::Payload for $name {
            const WORDS: usize = usize::div_ceil($len, 4);

            fn store(&self, put: &mut impl FnMut(u32)) {
                cdr::store::<$len>(self, put);
            }

            fn load(take: &mut impl FnMut() -> u32) -> Result<Self, tandem_shm::Corrupt> {
                cdr::load::<$len, _>(take)
            }
        }

        $(impl $name {
            /// Data id of the end-to-end protection. It differs from all data ids of the bus.
            pub const DATA_ID: u16 = $data_id;

            /// Sets the counter, and the CRC over all values. Call this last.
            ///
            /// # Errors
            /// As [`Self::encode`]; the sample is then unchanged.
            pub fn protect(&mut self, counter: u8) -> Result<(), CdrError> {
                let mut body = cdr::body::<$len>(self)?;
                e2e::protect(Self::DATA_ID, counter, &mut body);
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
                let body = cdr::body::<$len>(self);
                body.map_or(Check::CrcError, |body| checker.check(&body))
            }
        })?
    )+};
}
pub(crate) use structs;

/// A struct of the IDL, for code that is generic over them. Its words in the LMU hold the body; a
/// value out of range is stored as one that no reader accepts.
pub trait TopicType: Payload + Copy + Default {
    /// Passes the payload to `to`, and returns its result.
    ///
    /// # Errors
    /// [`CdrError::InvalidMember`]: a value is out of range.
    fn encode_for<R>(&self, to: impl FnOnce(&[u8]) -> R) -> Result<R, CdrError>;

    /// Reads a payload.
    ///
    /// # Errors
    /// [`CdrError`]: the payload is not a sample of this type.
    fn decode_from(payload: &[u8]) -> Result<Self, CdrError>;
}

/// A struct of the IDL.
pub(crate) trait Record: Copy + Default {
    fn walk(&mut self, walk: &mut impl Walk) -> Result<(), CdrError>;
}

/// Returns a sample in XCDR1, little-endian, without representation. `LEN` is the length of its
/// type.
pub(crate) fn body<const LEN: usize>(sample: &impl Record) -> Result<[u8; LEN], CdrError> {
    let mut body = [0; LEN];
    let mut sample = *sample;
    sample.walk(&mut Encode {
        body: &mut body,
        at: 0,
    })?;
    Ok(body)
}

/// Stores a body as words. All bytes 0xFF are no value of any type of the IDL.
pub(crate) fn store<const LEN: usize>(sample: &impl Record, put: &mut impl FnMut(u32)) {
    for bytes in body(sample).unwrap_or([0xFF; LEN]).chunks(4) {
        let mut word = [0; 4];
        word[..bytes.len()].copy_from_slice(bytes);
        put(u32::from_le_bytes(word));
    }
}

/// Reads a body from its words.
pub(crate) fn load<const LEN: usize, T: Record>(
    take: &mut impl FnMut() -> u32,
) -> Result<T, Corrupt> {
    let mut body = [0; LEN];
    for bytes in body.chunks_mut(4) {
        bytes.copy_from_slice(&take().to_le_bytes()[..bytes.len()]);
    }
    let mut sample = T::default();
    let mut decode = Decode {
        body: &body,
        at: 0,
        is_big_endian: false,
        widest: 8,
    };
    sample.walk(&mut decode).map_err(|_| Corrupt)?;
    Ok(sample)
}

/// Returns the payload of a body: the representation, the body, zeroes up to a multiple of four.
/// The options count these zeroes.
pub(crate) fn payload<const BODY: usize, const PAYLOAD: usize>(body: [u8; BODY]) -> [u8; PAYLOAD] {
    const { assert!(PAYLOAD - HEAD - BODY < 4) }
    let mut payload = [0; PAYLOAD];
    payload[..2].copy_from_slice(&CDR_LE.to_be_bytes());
    payload[3] = (PAYLOAD - HEAD - BODY) as u8;
    payload[HEAD..][..BODY].copy_from_slice(&body);
    payload
}

/// Reads a payload.
///
/// The last two bits of the options count the bytes of padding at the end (XTypes 1.3, 7.6.3.1.2).
/// A writer of plain RTPS leaves them zero, but pads too: submessages are aligned to four bytes
/// (RTPS 2.5, 9.4.1). So up to three bytes behind the last member are padding. More are an error: a
/// `@final` type has the same members everywhere (XTypes 1.3, 7.2.3).
pub(crate) fn decode<T: Record>(payload: &[u8]) -> Result<T, CdrError> {
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
    let mut decode = Decode {
        body: &rest[..len],
        at: 0,
        is_big_endian,
        widest,
    };
    let mut sample = T::default();
    sample.walk(&mut decode)?;
    if rest.len() - decode.at < 4 {
        Ok(sample)
    } else {
        Err(CdrError::TooLong)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A type with a member of 8 bytes, which the IDL does not have.
    #[derive(Clone, Copy, Debug, Default, PartialEq)]
    struct Wide {
        octets: [u8; 3],
        wide: u64,
        last: u16,
    }

    impl Record for Wide {
        fn walk(&mut self, walk: &mut impl Walk) -> Result<(), CdrError> {
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
        assert_eq!(body::<18>(&WIDE).map(payload), Ok(xcdr1_le));
        for payload in [&xcdr1_le[..], &xcdr1_be, &xcdr2_le, &xcdr2_be] {
            assert_eq!(decode(payload), Ok(WIDE), "{payload:?}");
        }
    }
}
