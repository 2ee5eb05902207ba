//! The time for which a frame occupies the CAN bus, exact to the bit. ISO 11898-1:2015
//!
//! A CAN FD frame uses two bit rates. It changes to the second rate within the BRS bit, and back
//! within the CRC delimiter, each time at the sample point. Both rates sample at the same fraction
//! of a bit, so these two bits together take as long as one bit of each rate.

use tandem_board::{CanFrame, CanId, Duration};

/// The bit rates of a bus.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct BitRates {
    /// Bit rate of the arbitration phase and of classic frames, bit/s.
    pub nominal: u32,
    /// Bit rate of the data phase of CAN FD, bit/s.
    pub data: u32,
}

impl BitRates {
    /// The rates in `docs/redundancy.md`: 500 kbit/s and 2 Mbit/s.
    pub const TANDEM: Self = Self {
        nominal: 500_000,
        data: 2_000_000,
    };

    /// Returns the time that these bits take.
    #[must_use]
    pub fn time(self, bits: Bits) -> Duration {
        let ns = |bits: u32, rate: u32| u64::from(bits) * 1_000_000_000 / u64::from(rate);
        Duration::from_ns(ns(bits.nominal, self.nominal) + ns(bits.data, self.data))
    }
}

/// Number of bits of a frame, including its stuff bits.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Bits {
    /// At the nominal bit rate.
    pub nominal: u32,
    /// At the bit rate of the data phase.
    pub data: u32,
}

impl Bits {
    /// The intermission between two frames.
    pub const INTERMISSION: Self = Self::nominal(3);
    /// After a bit error: error flag, its longest superposition, and the delimiter.
    pub const ERROR: Self = Self::nominal(6 + 6 + 8);
    /// ACK slot and delimiter, end of frame.
    const TRAILER: u32 = 2 + 7;

    const fn nominal(nominal: u32) -> Self {
        Self { nominal, data: 0 }
    }

    /// Counts the bits from the start of a frame to its end, without the intermission.
    #[must_use]
    pub fn of(frame: &CanFrame) -> Self {
        let mut stuffing = Stuffing::default();
        // Start of frame and identifier.
        stuffing.push(0, 1);
        match frame.id() {
            // RTR or RRS, IDE
            CanId::Standard(id) => {
                stuffing.push(id.into(), 11);
                stuffing.push(0b00, 2);
            }
            // SRR, IDE; RTR or RRS
            CanId::Extended(id) => {
                stuffing.push(id >> 18, 11);
                stuffing.push(0b11, 2);
                stuffing.push(id & 0x3_FFFF, 18);
                stuffing.push(0, 1);
            }
        }
        if frame.is_fd() {
            Self::of_fd(frame, stuffing)
        } else {
            Self::of_classic(frame, stuffing)
        }
    }

    fn of_fd(frame: &CanFrame, mut stuffing: Stuffing) -> Self {
        // FDF, res, BRS
        stuffing.push(0b101, 3);
        // A stuff bit after BRS has the rate of the data phase.
        let nominal = stuffing.bits - u32::from(stuffing.run == 0);
        // ESI, DLC
        stuffing.push(0, 1);
        stuffing.push(length_code(frame.data().len()), 4);
        frame
            .data()
            .iter()
            .for_each(|byte| stuffing.push((*byte).into(), 8));
        // At the end of the data, a fixed stuff bit replaces a regular one.
        let dynamic = stuffing.bits - u32::from(stuffing.run == 0);
        let crc = if frame.data().len() <= 16 { 17 } else { 21 };
        // Stuff bit count and checksum have a fixed stuff bit before each group of four bits.
        let checked = 4 + crc;
        Self {
            // The CRC delimiter here and BRS above together count as one bit of each rate.
            nominal: nominal + Self::TRAILER,
            data: dynamic - nominal + checked + checked.div_ceil(4) + 1,
        }
    }

    fn of_classic(frame: &CanFrame, mut stuffing: Stuffing) -> Self {
        // FDF or r0; an extended frame has r1 too.
        let reserved = if matches!(frame.id(), CanId::Standard(_)) {
            1
        } else {
            2
        };
        stuffing.push(0, reserved);
        stuffing.push(frame.data().len() as u32, 4);
        frame
            .data()
            .iter()
            .for_each(|byte| stuffing.push((*byte).into(), 8));
        stuffing.push(stuffing.crc_15.into(), 15);
        Self::nominal(stuffing.bits + 1 + Self::TRAILER)
    }
}

/// Returns the DLC of a valid CAN FD length.
const fn length_code(length: usize) -> u32 {
    match length {
        0..=8 => length as u32,
        12 => 9,
        16 => 10,
        20 => 11,
        24 => 12,
        32 => 13,
        48 => 14,
        _ => 15,
    }
}

/// Counts bits, including a stuff bit after each run of five equal bits.
#[derive(Clone, Copy, Default)]
struct Stuffing {
    bits: u32,
    last: u32,
    /// Length of the last run of equal bits; 0 directly after a stuff bit.
    run: u32,
    /// Whether a stuff bit begins the present run.
    stuffed: bool,
    /// The checksum of a classic frame, over the bits without stuff bits.
    crc_15: u16,
}

impl Stuffing {
    /// Adds the lowest `count` bits of `value`, the most significant first.
    fn push(&mut self, value: u32, count: u32) {
        for index in (0..count).rev() {
            let bit = value >> index & 1;
            self.bits += 1;
            let out = u32::from(self.crc_15 >> 14) ^ bit;
            self.crc_15 = self.crc_15 << 1 & 0x7FFF ^ if out == 1 { 0x4599 } else { 0 };
            if self.run == 0 && self.stuffed {
                // The preceding stuff bit is the complement of `last`.
                self.run = if bit == self.last { 1 } else { 2 };
            } else if self.run > 0 && bit == self.last {
                self.run += 1;
            } else {
                self.run = 1;
            }
            self.last = bit;
            self.stuffed = false;
            if self.run == 5 {
                self.bits += 1;
                (self.run, self.stuffed) = (0, true);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::string::String;
    use std::vec;

    fn frame(id: CanId, fd: bool, data: &[u8]) -> CanFrame {
        CanFrame::new(id, fd, data).unwrap()
    }

    /// Counts independently: writes the frame as text and finds the stuff bits by text search.
    fn oracle(frame: &CanFrame) -> Bits {
        let mut plain = String::from("0");
        match frame.id() {
            CanId::Standard(id) => plain += &std::format!("{id:011b}00"),
            CanId::Extended(id) => {
                plain += &std::format!("{:011b}11{:018b}0", id >> 18, id & 0x3FFFF);
            }
        }
        plain += "101";
        let brs = plain.len();
        let code = [0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64]
            .iter()
            .position(|length| *length == frame.data().len())
            .unwrap();
        plain += &std::format!("0{code:04b}");
        for byte in frame.data() {
            plain += &std::format!("{byte:08b}");
        }
        let (mut wire, mut nominal) = (String::new(), 0);
        for (index, bit) in plain.chars().enumerate() {
            if wire.ends_with("00000") || wire.ends_with("11111") {
                wire.push(if wire.ends_with('0') { '1' } else { '0' });
            }
            wire.push(bit);
            if index + 1 == brs {
                nominal = wire.len() as u32;
            }
        }
        let checked: u32 = if frame.data().len() > 16 { 32 } else { 27 };
        Bits {
            nominal: nominal + 9,
            data: wire.len() as u32 - nominal + checked + 1,
        }
    }

    /// Counted by hand. Identifier 0 and no data: 0 0000(1)0 0000(1)0 0 0 1 0 1 before the data
    /// phase, with the two stuff bits in brackets, then 0 0000. The last of these 5 bits is the
    /// fifth equal one, but the fixed stuff bit follows instead of another stuff bit.
    #[test]
    fn frames_have_the_bits_that_were_counted_by_hand() {
        let standard = CanId::Standard;
        // 17 + 2 stuff bits, ACK 2, end 7 | ESI and DLC 5, count 4, CRC 17, 6 fixed, delimiter.
        let empty = Bits::of(&frame(standard(0), true, &[]));
        assert_eq!(
            empty,
            Bits {
                nominal: 19 + 9,
                data: 5 + 27 + 1
            }
        );
        // No run of five equal bits: the shortest frame with 64 bytes.
        let longest = Bits::of(&frame(standard(0x555), true, &[0x55; 64]));
        assert_eq!(
            longest,
            Bits {
                nominal: 17 + 9,
                data: 5 + 512 + 32 + 1
            }
        );
        // 26 × 2 µs + 550 × 0.5 µs
        assert_eq!(BitRates::TANDEM.time(longest), Duration::from_us(327));
        // A classic frame without stuff bits has 47 bits with the intermission, 44 without, plus 8
        // for each byte; at most (34 + 8 n - 1) / 4 stuff bits (Davis, Burns, Bril, Lukkien 2007).
        for (data, most) in [
            (&[0_u8; 8][..], 111 + 24),
            (&[0x55; 8], 111 + 24),
            (&[], 47 + 8),
        ] {
            let bits = Bits::of(&frame(standard(0x2AA), false, data)).nominal + 3;
            assert!(bits >= 47 + 8 * data.len() as u32 && bits <= most, "{bits}");
        }
    }

    proptest! {
        #[test]
        fn a_frame_has_as_many_bits_as_its_text(
            extended: bool,
            id: u32,
            length in 0_usize..16,
            // Most of these bytes have long runs of equal bits.
            bytes in prop::collection::vec(prop_oneof![Just(0), Just(0xFF), any::<u8>()], 64),
        ) {
            let id = if extended {
                CanId::Extended(id & 0x1FFF_FFFF)
            } else {
                CanId::Standard((id & 0x7FF) as u16)
            };
            let lengths = vec![0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64];
            let frame = frame(id, true, &bytes[..lengths[length]]);
            prop_assert_eq!(Bits::of(&frame), oracle(&frame));
        }
    }
}
