//! The exact time for which a classic CAN frame occupies the bus.

use tandem_board::{CanFrame, CanId};

/// Bits between two frames.
const INTERFRAME: u32 = 3;
/// CRC delimiter, acknowledge slot and delimiter, end of frame. They contain no stuff bits.
const TRAILER: u32 = 1 + 2 + 7;

/// Returns the bit times from the start of a classic data frame to the earliest start of the next,
/// including the stuff bits of its content and the space between frames (ISO 11898-1).
///
/// # Panics
/// If the frame is a CAN FD frame.
#[must_use]
pub fn bits(frame: &CanFrame) -> u32 {
    assert!(!frame.is_fd(), "classic frames only");
    let mut stream = Vec::with_capacity(128);
    fn put(stream: &mut Vec<bool>, value: u32, count: u32) {
        stream.extend((0..count).rev().map(|bit| value >> bit & 1 == 1));
    }
    let mut push = |value, count| put(&mut stream, value, count);
    push(0, 1);
    match frame.id() {
        CanId::Standard(id) => {
            push(id.into(), 11);
            // RTR, IDE, r0
            push(0, 3);
        }
        CanId::Extended(id) => {
            push(id >> 18, 11);
            // SRR, IDE
            push(0b11, 2);
            push(id, 18);
            // RTR, r1, r0
            push(0, 3);
        }
    }
    push(frame.data().len() as u32, 4);
    frame.data().iter().for_each(|byte| push((*byte).into(), 8));
    let crc = stream.iter().fold(0u32, |crc, bit| {
        let next = *bit != (crc >> 14 & 1 == 1);
        (crc << 1 & 0x7FFF) ^ if next { 0x4599 } else { 0 }
    });
    put(&mut stream, crc, 15);
    let (mut run, mut last, mut stuffed) = (0, None, 0);
    for bit in &stream {
        run = if last == Some(*bit) { run + 1 } else { 1 };
        last = Some(*bit);
        if run == 5 {
            // The stuff bit has the opposite value and begins a new run.
            (stuffed, run, last) = (stuffed + 1, 1, Some(!*bit));
        }
    }
    stream.len() as u32 + stuffed + TRAILER + INTERFRAME
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The lengths of the standard, with the space between frames: without stuff bits 47 + 8 n bits
    /// (standard id) and 67 + 8 n (extended); at most one stuff bit per four bits.
    #[test]
    fn lengths_are_within_those_of_the_standard() {
        for len in 0..=8usize {
            for (id, fixed) in [
                (CanId::Standard(0x555), 47),
                (CanId::Standard(0), 47),
                (CanId::Extended(0x1555_5555), 67),
                (CanId::Extended(0), 67),
            ] {
                for byte in [0x55, 0x00, 0xFF, 0x3A] {
                    let frame = CanFrame::new(id, false, &[byte; 8][..len]).unwrap();
                    let plain = fixed + 8 * len as u32;
                    let stuffable = plain - TRAILER - INTERFRAME;
                    let bits = bits(&frame);
                    assert!(
                        (plain..=plain + (stuffable - 1) / 4).contains(&bits),
                        "{bits}"
                    );
                }
            }
        }
    }

    /// Counted by hand. Id 0 without data: 19 bits of 0, whose CRC is 15 bits of 0. A stuff bit of
    /// 1 follows each five of these 34 bits, so there are 6.
    #[test]
    fn stuff_bits_are_counted() {
        let zeros = CanFrame::new(CanId::Standard(0), false, &[]).unwrap();
        assert_eq!(bits(&zeros), 34 + 6 + TRAILER + INTERFRAME);
    }
}
