//! Log lines in the format of `candump -L`: `(1436509052.249713) vcan0 0A0##1A1B2C3`.
//!
//! Classic CAN is `id#data`; CAN FD is `id##` with one hex digit of flags, then the data. A
//! standard id has three hex digits, an extended one eight.

use core::fmt;

/// CAN FD flag: the data were sent at the higher bit rate.
const BIT_RATE_SWITCH: u8 = 1;

/// A CAN identifier.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Id {
    /// 0 ..= 0x7FF
    Standard(u16),
    /// 0 ..= 0x1FFF_FFFF
    Extended(u32),
}

/// One logged data frame. [`fmt::Display`] writes its line, without a line feed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct CandumpFrame<'a> {
    /// Time at which it was on the bus, µs since 1970.
    pub at_us: u64,
    /// Name of the bus; no white space.
    pub interface: &'a str,
    /// Identifier.
    pub id: Id,
    /// Whether it is a CAN FD frame, with its data at the higher bit rate.
    pub is_fd: bool,
    /// The data bytes: at most 8, or 64 for CAN FD.
    pub data: &'a [u8],
}

impl fmt::Display for CandumpFrame<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (seconds, micros) = (self.at_us / 1_000_000, self.at_us % 1_000_000);
        write!(f, "({seconds:010}.{micros:06}) {} ", self.interface)?;
        match self.id {
            Id::Standard(id) => write!(f, "{id:03X}#")?,
            Id::Extended(id) => write!(f, "{id:08X}#")?,
        }
        if self.is_fd {
            write!(f, "#{BIT_RATE_SWITCH:X}")?;
        }
        self.data
            .iter()
            .try_for_each(|byte| write!(f, "{byte:02X}"))
    }
}

#[cfg(test)]
mod tests {
    extern crate std;
    use super::*;
    use std::string::ToString as _;

    #[test]
    fn writes_what_candump_writes() {
        let fd = CandumpFrame {
            at_us: 1_436_509_052_249_713,
            interface: "vcan0",
            id: Id::Standard(0x0A0),
            is_fd: true,
            data: &[0x1A, 0x2B, 0xC3],
        };
        let line = "(1436509052.249713) vcan0 0A0##11A2BC3";
        assert_eq!(fd.to_string(), line);
        let classic = CandumpFrame {
            at_us: 12_000_345,
            interface: "can1",
            id: Id::Extended(0x0CFF_0127),
            is_fd: false,
            data: &[0xE2, 0x30],
        };
        let line = "(0000000012.000345) can1 0CFF0127#E230";
        assert_eq!(classic.to_string(), line);
    }
}
