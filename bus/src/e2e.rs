//! End-to-end protection of AUTOSAR profile 5: a CRC and a counter in every frame.
//!
//! Bytes 0 and 1 hold a CRC-16/CCITT-FALSE, low byte first; byte 2 is a counter that increases by
//! one with every frame of an id and wraps around. The CRC covers all bytes from index 2, then the
//! data id, low byte first. The data id is the CAN id and is not sent, so a frame under a wrong id
//! is detected too. (AUTOSAR FO PRS E2EProtocol, "E2E Profile 5", offset 0.)

use crc::{CRC_16_IBM_3740, Crc};

/// Number of bytes that the protection takes at the beginning of a frame.
pub const HEADER_LEN: usize = 3;

/// How far the counter may jump: a frame after up to nine lost frames is still accepted.
///
/// Ten control frames take 100 ms. A receiver without a frame for that long has already timed out.
/// The counter only has to distinguish a plausible gap from a restarted or wrong sender.
pub const MAX_DELTA_COUNTER: u8 = 10;

/// CRC-16/CCITT-FALSE is called IBM-3740 in the catalogue of CRCs.
const CRC: Crc<u16> = Crc::<u16>::new(&CRC_16_IBM_3740);

/// Writes counter and CRC into a frame whose other bytes are final. A frame without room for them
/// stays unchanged.
pub fn protect(id: u16, counter: u8, data: &mut [u8]) {
    if data.len() < HEADER_LEN {
        return;
    }
    data[2] = counter;
    let crc = checksum(id, data).to_le_bytes();
    data[..2].copy_from_slice(&crc);
}

/// Returns the CRC over all bytes from index 2, followed by the data id.
fn checksum(id: u16, data: &[u8]) -> u16 {
    let mut digest = CRC.digest();
    digest.update(&data[2..]);
    digest.update(&id.to_le_bytes());
    digest.finalize()
}

/// The result of [`Checker::check`] for a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Check {
    /// The CRC is right and this is the first frame: the counter cannot be judged yet.
    Initial,
    /// The CRC is right and the counter is the next one.
    Ok,
    /// The CRC is right; this many frames before it were lost (fewer than [`MAX_DELTA_COUNTER`]).
    OkSomeLost(u8),
    /// The CRC is right, but the counter is that of the last frame: the frame is a repetition.
    Repeated,
    /// The CRC is right, but the counter jumped too far: frames were lost, or the sender restarted.
    /// The next frame is judged against this one.
    WrongSequence,
    /// The CRC is wrong, or the frame is too short to have one. The checker's state is unchanged.
    CrcError,
}

impl Check {
    /// Returns whether the frame may be used: [`Check::Initial`], `Ok` or `OkSomeLost`.
    #[must_use]
    pub const fn is_accepted(self) -> bool {
        matches!(self, Self::Initial | Self::Ok | Self::OkSomeLost(_))
    }
}

/// Checks the frames of one id.
///
/// | last counter | CRC | counter minus the last one | result | last counter afterwards |
/// |---|---|---|---|---|
/// | any | wrong | | `CrcError` | unchanged |
/// | none | right | | `Initial` | the frame's |
/// | some | right | 0 | `Repeated` | the frame's |
/// | some | right | 1 | `Ok` | the frame's |
/// | some | right | 2 ..= [`MAX_DELTA_COUNTER`] | `OkSomeLost` | the frame's |
/// | some | right | more | `WrongSequence` | the frame's |
#[derive(Clone, Copy, Debug)]
pub struct Checker {
    id: u16,
    last: Option<u8>,
}

impl Checker {
    /// Creates a checker for the frames of this id. The first frame gives [`Check::Initial`].
    #[must_use]
    pub const fn new(id: u16) -> Self {
        Self { id, last: None }
    }

    /// Judges the next received frame.
    pub fn check(&mut self, data: &[u8]) -> Check {
        if data.len() < HEADER_LEN || checksum(self.id, data).to_le_bytes() != data[..2] {
            return Check::CrcError;
        }
        let counter = data[2];
        let Some(last) = self.last.replace(counter) else {
            return Check::Initial;
        };
        match counter.wrapping_sub(last) {
            0 => Check::Repeated,
            1 => Check::Ok,
            delta @ 2..=MAX_DELTA_COUNTER => Check::OkSomeLost(delta - 1),
            _ => Check::WrongSequence,
        }
    }
}
