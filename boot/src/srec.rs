//! Motorola S-records, and their reassembly from CAN frames. T-BOOT-4

use crate::page::checksum;

/// Bytes of the longest record without its line end: `S`, type, and 256 bytes in hex.
const MAX_LINE: usize = 2 + 2 * 256;
/// The largest number of data bytes in a record: an S1 record of 255 bytes.
pub const MAX_DATA: usize = 252;

/// Data bytes of a copy record.
const COPY_BYTES: usize = 6;

/// The type of a record.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SRecordType {
    /// S0: text about the file; the address is unused.
    Header,
    /// S1, S2, S3: data at an address.
    Data,
    /// S4, reserved in the format, is our own: copy bytes of the flash to an address. The data are
    /// the offset of the bytes and their number, 4 and 2 bytes, the high byte first.
    Copy,
    /// S5, S6: the address is the number of data records before it.
    Count,
    /// S7, S8, S9: the address is the entry; ends the file.
    Entry,
}

/// Why a line is not an S-record.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SRecordError {
    /// It does not begin with `S` and a digit.
    Type,
    /// The number of digits does not match its length field, or is too small for the address.
    Length,
    /// A character is not a hex digit.
    Digit,
    /// The checksum is wrong.
    Checksum,
}

impl core::fmt::Display for SRecordError {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str(match self {
            Self::Type => "it does not begin with S and a digit",
            Self::Length => "its length field does not match it",
            Self::Digit => "a character is not a hex digit",
            Self::Checksum => "its checksum is wrong",
        })
    }
}

impl core::error::Error for SRecordError {}

/// One record with a valid checksum.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SRecord {
    /// Its type.
    pub record_type: SRecordType,
    /// Address, count or entry, depending on the type.
    pub address: u32,
    /// The checksum of its line, by which a repeated record is known.
    pub(crate) print: u32,
    len: u8,
    bytes: [u8; MAX_DATA],
}

impl SRecord {
    /// Parses a line without its line end.
    ///
    /// # Errors
    /// [`SRecordError`] if it is not a record. A corrupted record may fail with any of them;
    /// request it again.
    pub fn parse(line: &[u8]) -> Result<Self, SRecordError> {
        let [b'S', digit, hex @ ..] = line else {
            return Err(SRecordError::Type);
        };
        let (record_type, address_bytes) = match digit {
            b'0' => (SRecordType::Header, 2),
            b'1' => (SRecordType::Data, 2),
            b'2' => (SRecordType::Data, 3),
            b'3' => (SRecordType::Data, 4),
            b'4' => (SRecordType::Copy, 4),
            b'5' => (SRecordType::Count, 2),
            b'6' => (SRecordType::Count, 3),
            b'7' => (SRecordType::Entry, 4),
            b'8' => (SRecordType::Entry, 3),
            b'9' => (SRecordType::Entry, 2),
            _ => return Err(SRecordError::Type),
        };
        let mut bytes = [0; 256];
        let (pairs, odd) = hex.as_chunks::<2>();
        if !odd.is_empty() || pairs.len() > bytes.len() {
            return Err(SRecordError::Length);
        }
        for (byte, [high, low]) in bytes.iter_mut().zip(pairs) {
            *byte = nibble(*high)? << 4 | nibble(*low)?;
        }
        let bytes = &bytes[..pairs.len()];
        let [length, content @ .., _] = bytes else {
            return Err(SRecordError::Length);
        };
        if usize::from(*length) != bytes.len() - 1 || content.len() < address_bytes {
            return Err(SRecordError::Length);
        }
        // The checksum is the ones' complement of the other bytes' sum, so the total is 0xFF.
        if bytes.iter().fold(0u8, |sum, byte| sum.wrapping_add(*byte)) != 0xFF {
            return Err(SRecordError::Checksum);
        }
        let (address, data) = content.split_at(address_bytes);
        if record_type == SRecordType::Copy && data.len() != COPY_BYTES {
            return Err(SRecordError::Length);
        }
        if !data.is_empty() && matches!(record_type, SRecordType::Count | SRecordType::Entry) {
            return Err(SRecordError::Length);
        }
        let mut record = Self {
            record_type,
            address: address
                .iter()
                .fold(0, |sum, byte| sum << 8 | u32::from(*byte)),
            print: checksum(line),
            len: data.len() as u8,
            bytes: [0; MAX_DATA],
        };
        record.bytes[..data.len()].copy_from_slice(data);
        Ok(record)
    }

    /// Returns what a copy record copies: the offset in the flash, and the number of bytes.
    pub(crate) fn copied(&self) -> (u32, u32) {
        let [a, b, c, d, high, low, ..] = self.bytes;
        let length = u16::from_be_bytes([high, low]);
        (u32::from_be_bytes([a, b, c, d]), length.into())
    }

    /// Returns the data; empty for a count and an entry.
    #[must_use]
    pub fn data(&self) -> &[u8] {
        &self.bytes[..usize::from(self.len)]
    }
}

const fn nibble(digit: u8) -> Result<u8, SRecordError> {
    match digit {
        b'0'..=b'9' => Ok(digit - b'0'),
        b'A'..=b'F' => Ok(digit - b'A' + 10),
        b'a'..=b'f' => Ok(digit - b'a' + 10),
        _ => Err(SRecordError::Digit),
    }
}

/// Joins the data of CAN frames into lines. A frame that begins with `S` always begins a record.
/// `\n` ends the record; bytes after `\n` in a frame are padding.
#[derive(Clone, Debug)]
pub struct Assembler {
    line: [u8; MAX_LINE],
    /// Length of the line so far; larger than the buffer if the line is too long.
    len: usize,
    /// Whether the first frame of the record was received.
    begun: bool,
}

impl Default for Assembler {
    fn default() -> Self {
        Self {
            line: [0; MAX_LINE],
            len: 0,
            begun: false,
        }
    }
}

impl Assembler {
    /// Takes the data of one frame. Returns the record that ends in this frame, if one does.
    ///
    /// # Errors
    /// [`SRecordError`] inside `Some` if the completed line is not a record.
    pub fn push(&mut self, data: &[u8]) -> Option<Result<SRecord, SRecordError>> {
        if data.first() == Some(&b'S') {
            (self.len, self.begun) = (0, true);
        }
        let ends = data.iter().position(|byte| *byte == b'\n');
        for byte in &data[..ends.unwrap_or(data.len())] {
            if let Some(place) = self.line.get_mut(self.len) {
                *place = *byte;
            }
            // A length beyond the buffer and the carriage return marks a line that is too long.
            self.len = (self.len + 1).min(MAX_LINE + 2);
        }
        ends?;
        let (len, begun) = (self.len, self.begun);
        (self.len, self.begun) = (0, false);
        if !begun {
            return Some(Err(SRecordError::Type));
        }
        if len > MAX_LINE + 1 {
            return Some(Err(SRecordError::Length));
        }
        let line = &self.line[..len.min(MAX_LINE)];
        Some(SRecord::parse(line.strip_suffix(b"\r").unwrap_or(line)))
    }

    /// Returns whether a record has begun and not ended.
    #[must_use]
    pub const fn is_inside(&self) -> bool {
        self.begun || self.len > 0
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::format;
    use std::string::String;
    use std::vec::Vec;

    fn line(digit: u8, address: &[u8], data: &[u8]) -> String {
        let mut bytes = Vec::from([(address.len() + data.len() + 1) as u8]);
        bytes.extend(address.iter().chain(data));
        let sum = bytes.iter().fold(0u8, |sum, byte| sum.wrapping_add(*byte));
        bytes.push(!sum);
        let hex: String = bytes.iter().map(|byte| format!("{byte:02X}")).collect();
        format!("S{digit}{hex}")
    }

    /// T-BOOT-4: reads the lines of the thesis's figure 3.4 that are printed completely.
    #[test]
    fn records_of_the_thesis_are_read() {
        let header = SRecord::parse(b"S01600004D756C7469636F72655F746573742E737265633B").unwrap();
        assert_eq!(header.record_type, SRecordType::Header);
        assert_eq!(header.data(), b"Multicore_test.srec");
        let entry = SRecord::parse(b"S705A00E00202C").unwrap();
        assert_eq!(entry.record_type, SRecordType::Entry);
        assert_eq!(entry.address, 0xA00E_0020);
    }

    /// T-BOOT-4
    #[test]
    fn each_type_has_its_address() {
        for (digit, address, record_type) in [
            (0, 2, SRecordType::Header),
            (1, 2, SRecordType::Data),
            (2, 3, SRecordType::Data),
            (3, 4, SRecordType::Data),
            (5, 2, SRecordType::Count),
            (6, 3, SRecordType::Count),
            (7, 4, SRecordType::Entry),
            (8, 3, SRecordType::Entry),
            (9, 2, SRecordType::Entry),
        ] {
            let bytes = &[0xA1, 0xB2, 0xC3, 0xD4][..address];
            let record = SRecord::parse(line(digit, bytes, &[]).as_bytes()).unwrap();
            assert_eq!(record.record_type, record_type);
            let expected = bytes
                .iter()
                .fold(0, |sum, byte| sum << 8 | u32::from(*byte));
            assert_eq!(record.address, expected);
        }
        for other in ["", "S", "s1030000FC", "X1030000FC", ":00000001FF"] {
            assert_eq!(SRecord::parse(other.as_bytes()), Err(SRecordError::Type));
        }
    }

    /// U-5: a copy record has a source and a length, high byte first, and nothing else.
    #[test]
    fn a_copy_names_its_source_and_its_length() {
        let data = [0x00, 0x04, 0x01, 0x00, 0x10, 0x02];
        let to = [0x00, 0x10, 0x01, 0x00];
        let record = SRecord::parse(line(4, &to, &data).as_bytes()).unwrap();
        assert_eq!(record.record_type, SRecordType::Copy);
        assert_eq!(
            (record.address, record.copied()),
            (0x10_0100, (0x4_0100, 0x1002))
        );
        for wrong in [&data[..5], &[0; 7], &[]] {
            let refused = SRecord::parse(line(4, &to, wrong).as_bytes());
            assert_eq!(refused, Err(SRecordError::Length));
        }
    }

    /// T-BOOT-4: the longest record is accepted, even after a line that is too long.
    #[test]
    fn the_longest_record_fits() {
        let text = line(1, &[0x12, 0x34], &[0x5A; MAX_DATA]);
        let mut assembler = Assembler::default();
        let too_long = format!("{text}0");
        for (text, ok) in [(&too_long, false), (&text, true)] {
            let all = format!("{text}\r\n");
            let mut last = None;
            for chunk in all.as_bytes().chunks(8) {
                assert_eq!(last, None);
                last = assembler.push(chunk);
            }
            assert_eq!(last.unwrap().is_ok(), ok);
            assert!(!assembler.is_inside());
        }
    }

    /// T-BOOT-4: a lost frame makes its record invalid; the next record is read correctly.
    #[test]
    fn a_lost_frame_costs_one_record() {
        let text = format!("{}\r\n", line(3, &[0xA0, 4, 0, 0], &[7; 16]));
        let frames: Vec<&[u8]> = text.as_bytes().chunks(8).collect();
        for lost in 0..frames.len() {
            let mut assembler = Assembler::default();
            let mut results = Vec::new();
            for (index, frame) in frames.iter().enumerate() {
                if index != lost {
                    results.extend(assembler.push(frame));
                }
            }
            for frame in &frames {
                results.extend(assembler.push(frame));
            }
            let good = results.iter().filter(|result| result.is_ok()).count();
            assert_eq!(good, 1, "frame {lost} lost: {results:?}");
        }
    }

    proptest! {
        /// T-BOOT-4: a written record is read back, with upper-case or lower-case digits.
        #[test]
        fn what_is_written_is_read(
            address: u32,
            data in prop::collection::vec(any::<u8>(), 0..=250),
            lower: bool,
        ) {
            let mut text = line(3, &address.to_be_bytes(), &data);
            if lower {
                text = text.to_lowercase().replacen('s', "S", 1);
            }
            let record = SRecord::parse(text.as_bytes()).unwrap();
            prop_assert_eq!(record.address, address);
            prop_assert_eq!(record.data(), &data[..]);
        }

        /// T-BOOT-4: one changed character is detected.
        #[test]
        fn a_changed_character_is_noticed(
            data in prop::collection::vec(any::<u8>(), 1..40),
            place: prop::sample::Index,
            new in 0..16usize,
        ) {
            let text = line(3, &[0xA0, 4, 0, 0], &data);
            let place = 2 + place.index(text.len() - 2);
            let mut changed = text.clone().into_bytes();
            changed[place] = b"0123456789ABCDEF"[new];
            if changed != text.as_bytes() {
                prop_assert!(SRecord::parse(&changed).is_err());
            }
        }

        #[test]
        fn any_frames_are_survived(frames: Vec<[u8; 8]>) {
            let mut assembler = Assembler::default();
            for frame in frames {
                let _ = assembler.push(&frame);
            }
        }
    }
}
