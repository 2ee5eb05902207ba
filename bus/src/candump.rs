//! Log lines in the format of `candump -L`: `(1436509052.249713) vcan0 0A0##1A1B2C3`.
//!
//! Classic CAN is `id#data`; CAN FD is `id##` with one hex digit of flags, then the data. A
//! standard id has three hex digits, an extended one eight.

use core::fmt;

/// CAN FD flag: the data were sent at the higher bit rate.
pub const BIT_RATE_SWITCH: u8 = 1;
/// CAN FD flag: the sender is error passive.
pub const ERROR_STATE: u8 = 2;

/// A CAN identifier.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Id {
    /// 0 ..= 0x7FF
    Standard(u16),
    /// 0 ..= 0x1FFF_FFFF
    Extended(u32),
}

/// One logged data frame. [`fmt::Display`] writes its line, without a line feed; [`Record::parse`]
/// reads it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Record<'a> {
    /// Whole seconds of the time stamp.
    pub seconds: u64,
    /// The rest of the time stamp, 0 ..= 999 999 µs.
    pub micros: u32,
    /// Name of the bus; no white space.
    pub interface: &'a str,
    /// Identifier.
    pub id: Id,
    /// The flags if it is a CAN FD frame: [`BIT_RATE_SWITCH`], [`ERROR_STATE`], up to 0xF.
    pub fd_flags: Option<u8>,
    len: u8,
    bytes: [u8; 64],
}

/// More data than a frame can carry: 8 bytes, 64 for CAN FD.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TooLong;

/// Why a line is not a data frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ParseError {
    /// Not `(seconds.micros)` with six digits of micros.
    Timestamp,
    /// No name of a bus.
    Interface,
    /// No `#`, or before it not three hex digits up to 7FF or eight up to 1FFFFFFF.
    Id,
    /// Not pairs of hex digits in a length that the kind of frame can have.
    Data,
    /// A remote frame: it has no data.
    Remote,
    /// Something follows the frame that is not a direction (`R` or `T`).
    Trailing,
}

impl fmt::Display for ParseError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Timestamp => "the line does not begin with a time stamp like (12.000345)",
            Self::Interface => "the name of the bus is missing",
            Self::Id => "the frame has no valid id",
            Self::Data => "the frame's data are not hex digits of a valid length",
            Self::Remote => "a remote frame has no data",
            Self::Trailing => "something follows the frame",
        })
    }
}

impl core::error::Error for ParseError {}

impl<'a> Record<'a> {
    /// A record at time 0 on `interface`; the time stamp is set by its fields.
    ///
    /// # Errors
    /// [`TooLong`] if the frame cannot carry the data.
    pub fn new(
        interface: &'a str,
        id: Id,
        fd_flags: Option<u8>,
        data: &[u8],
    ) -> Result<Self, TooLong> {
        if data.len() > longest(fd_flags) {
            return Err(TooLong);
        }
        let mut bytes = [0; 64];
        bytes[..data.len()].copy_from_slice(data);
        Ok(Self {
            seconds: 0,
            micros: 0,
            interface,
            id,
            fd_flags,
            len: data.len() as u8,
            bytes,
        })
    }

    /// The same record at this time in microseconds.
    #[must_use]
    pub const fn at_us(self, us: u64) -> Self {
        Self {
            seconds: us / 1_000_000,
            micros: (us % 1_000_000) as u32,
            ..self
        }
    }

    /// The data bytes.
    #[must_use]
    pub fn data(&self) -> &[u8] {
        &self.bytes[..usize::from(self.len)]
    }

    /// Reads one line, with or without white space around it.
    ///
    /// # Errors
    /// [`ParseError`] says which part of the line is wrong.
    pub fn parse(line: &'a str) -> Result<Self, ParseError> {
        let mut words = line.split_ascii_whitespace();
        let (seconds, micros) = words
            .next()
            .and_then(parse_timestamp)
            .ok_or(ParseError::Timestamp)?;
        let interface = words.next().ok_or(ParseError::Interface)?;
        let (id, rest) = words
            .next()
            .and_then(|w| w.split_once('#'))
            .ok_or(ParseError::Id)?;
        let id = parse_id(id).ok_or(ParseError::Id)?;
        if rest.starts_with('R') {
            return Err(ParseError::Remote);
        }
        let (fd_flags, data) = parse_flags(rest).ok_or(ParseError::Data)?;
        let mut bytes = [0; 64];
        let len = parse_hex(data, &mut bytes[..longest(fd_flags)]).ok_or(ParseError::Data)?;
        match (words.next(), words.next()) {
            (None | Some("R" | "T"), None) => {}
            _ => return Err(ParseError::Trailing),
        }
        Ok(Self {
            seconds,
            micros,
            interface,
            id,
            fd_flags,
            len: len as u8,
            bytes,
        })
    }
}

impl fmt::Display for Record<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "({:010}.{:06}) {} ",
            self.seconds, self.micros, self.interface
        )?;
        match self.id {
            Id::Standard(id) => write!(f, "{id:03X}#")?,
            Id::Extended(id) => write!(f, "{id:08X}#")?,
        }
        if let Some(flags) = self.fd_flags {
            write!(f, "#{:X}", flags & 0xF)?;
        }
        self.data()
            .iter()
            .try_for_each(|byte| write!(f, "{byte:02X}"))
    }
}

const fn longest(fd_flags: Option<u8>) -> usize {
    if fd_flags.is_some() { 64 } else { 8 }
}

fn parse_timestamp(word: &str) -> Option<(u64, u32)> {
    let (seconds, micros) = word.strip_prefix('(')?.strip_suffix(')')?.split_once('.')?;
    let digits = |s: &str| s.bytes().all(|b| b.is_ascii_digit());
    if !digits(seconds) || !digits(micros) || micros.len() != 6 {
        return None;
    }
    Some((seconds.parse().ok()?, micros.parse().ok()?))
}

fn parse_id(digits: &str) -> Option<Id> {
    if !digits.bytes().all(|b| b.is_ascii_hexdigit()) {
        return None;
    }
    let id = u32::from_str_radix(digits, 16).ok()?;
    match (digits.len(), id) {
        (3, 0..=0x7FF) => Some(Id::Standard(id as u16)),
        (8, 0..=0x1FFF_FFFF) => Some(Id::Extended(id)),
        _ => None,
    }
}

/// What follows the first `#`: data, or a second `#`, one digit of flags and data.
fn parse_flags(rest: &str) -> Option<(Option<u8>, &str)> {
    let Some(fd) = rest.strip_prefix('#') else {
        return Some((None, rest));
    };
    let flags = fd.chars().next()?.to_digit(16)?;
    Some((Some(flags as u8), &fd[1..]))
}

/// Fills `bytes` from pairs of hex digits and says how many there were.
fn parse_hex(digits: &str, bytes: &mut [u8]) -> Option<usize> {
    let digits = digits.as_bytes();
    if !digits.len().is_multiple_of(2) || digits.len() / 2 > bytes.len() {
        return None;
    }
    for (byte, pair) in bytes.iter_mut().zip(digits.chunks_exact(2)) {
        let high = char::from(pair[0]).to_digit(16)?;
        let low = char::from(pair[1]).to_digit(16)?;
        *byte = (high << 4 | low) as u8;
    }
    Some(digits.len() / 2)
}
