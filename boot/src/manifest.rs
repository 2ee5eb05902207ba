//! The manifest of an image, which is the first 256 bytes of its place, and its signature.
//!
//! | bytes | what (little endian) |
//! |---|---|
//! | 0..4 | `TNDM` |
//! | 4 | format, 1 |
//! | 5 | kind: 0 application, 1 configuration, 2 bootloader |
//! | 6 | number of parts, 1 to 3 |
//! | 7 | number of the key that signed it |
//! | 8..12 | the hardware that it is for |
//! | 12..16 | version |
//! | 16..20 | length of the body: everything after these 256 bytes |
//! | 20..24 | CRC-32 of the body |
//! | 24 | the lowest key accepted after this image has approved itself |
//! | 25 | 1: approves itself only together with the same release of the other system |
//! | 26 | security counter: the board's rises to it when the application approves itself |
//! | 27 | 0 |
//! | 28..32 | CRC-32 of bytes 0..28 |
//! | 32..44 | entries of cores 0, 1, 2: offsets from the image's place; 0 for none |
//! | 44..164 | three parts: offset, length, SHA-256; unused ones are 0 |
//! | 164..168 | the lowest bootloader that an application needs |
//! | 168..172 | the lowest configuration that an application needs |
//! | 172..192 | 0 |
//! | 192..256 | Ed25519 signature of bytes 0..192 |

#[cfg(test)]
pub(crate) mod tests;

use crate::map::{ImageKind, PAGE_BYTES};
use crate::page::{self, checksum, word};
use tandem_board::CoreId;

/// Bytes of a manifest with its signature.
pub const MANIFEST_BYTES: usize = 256;
/// The signed bytes of a manifest.
pub const SIGNED_BYTES: usize = 192;
/// Offset of an image's body in its place.
pub const BODY_OFFSET: u32 = MANIFEST_BYTES as u32;
/// The most parts of an image: one for each core.
pub const MAX_PARTS: usize = 3;
/// The hardware that this loader runs on: TC297 on Tandem's carrier.
pub const HARDWARE: u32 = 0x0297_0001;

pub(crate) const MAGIC: [u8; 4] = *b"TNDM";
const FORMAT: u8 = 1;

/// A run of bytes in an image.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ImagePart {
    /// Offset from the image's place; at least [`BODY_OFFSET`].
    pub offset: u32,
    /// Length in bytes; 0 for none.
    pub length: u32,
    /// Digest of its bytes.
    pub sha256: [u8; 32],
}

/// The description of an image.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Manifest {
    /// Its kind.
    pub kind: ImageKind,
    /// Number of the key that signed it.
    pub key: u8,
    /// Keys below this are refused after the image has approved itself.
    pub lowest_key: u8,
    /// It approves itself only when the other system, too, has recorded that this release works.
    pub paired: bool,
    /// An application with a lower number than the board's counter never boots again.
    pub security_counter: u8,
    /// The hardware that it is for.
    pub hardware: u32,
    /// Version, ascending with every release.
    pub version: u32,
    /// Number of bytes after the manifest.
    pub length: u32,
    /// CRC-32 of these bytes, for the boot ROM.
    pub crc: u32,
    /// Entry of each core, as an offset from the image's place; 0 for a core that is not started.
    pub entries: [u32; CoreId::COUNT],
    /// The parts in ascending order; the first one of length 0 ends the list.
    pub parts: [ImagePart; MAX_PARTS],
    /// The lowest version of the bootloader that an application needs.
    pub needs_bootloader: u32,
    /// The lowest version of the configuration that an application needs; 0 needs none.
    pub needs_configuration: u32,
}

/// Why bytes are not a manifest.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum ManifestError {
    /// The magic number is wrong.
    Magic,
    /// The format, the kind or the number of parts is unknown, or the checksum is wrong.
    Format,
    /// Parts overlap, are out of order or outside the body, or an entry is outside the parts.
    Layout,
}

impl core::fmt::Display for ManifestError {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str(match self {
            Self::Magic => "the magic number is wrong",
            Self::Format => "its format is unknown, or its checksum is wrong",
            Self::Layout => "its parts overlap, are out of order or outside of it",
        })
    }
}

impl core::error::Error for ManifestError {}

fn are_zero<'b>(mut bytes: impl Iterator<Item = &'b u8>) -> bool {
    bytes.all(|byte| *byte == 0)
}

impl Manifest {
    /// Returns the parts in use.
    pub fn parts(&self) -> impl Iterator<Item = &ImagePart> {
        self.parts.iter().take_while(|part| part.length > 0)
    }

    /// Encodes the signed bytes.
    #[must_use]
    pub fn encode(&self) -> [u8; SIGNED_BYTES] {
        let mut bytes = [0; SIGNED_BYTES];
        bytes[..4].copy_from_slice(&MAGIC);
        bytes[4] = FORMAT;
        bytes[5] = self.kind as u8;
        bytes[6] = self.parts().count() as u8;
        bytes[7] = self.key;
        let words = [self.hardware, self.version, self.length, self.crc];
        let (places, _) = bytes[8..].as_chunks_mut::<4>();
        for (place, word) in places.iter_mut().zip(words) {
            *place = word.to_le_bytes();
        }
        bytes[24] = self.lowest_key;
        bytes[25] = u8::from(self.paired);
        bytes[26] = self.security_counter;
        let crc = checksum(&bytes[..28]);
        bytes[28..32].copy_from_slice(&crc.to_le_bytes());
        for (place, entry) in bytes[32..44]
            .as_chunks_mut::<4>()
            .0
            .iter_mut()
            .zip(self.entries)
        {
            *place = entry.to_le_bytes();
        }
        let (places, _) = bytes[44..164].as_chunks_mut::<40>();
        for (place, part) in places.iter_mut().zip(self.parts()) {
            place[..4].copy_from_slice(&part.offset.to_le_bytes());
            place[4..8].copy_from_slice(&part.length.to_le_bytes());
            place[8..].copy_from_slice(&part.sha256);
        }
        bytes[164..168].copy_from_slice(&self.needs_bootloader.to_le_bytes());
        bytes[168..172].copy_from_slice(&self.needs_configuration.to_le_bytes());
        bytes
    }

    /// Decodes the output of [`Manifest::encode`]. Refuses all other bytes.
    ///
    /// # Errors
    /// [`ManifestError`] says what is wrong with the bytes.
    pub fn decode(bytes: &[u8; SIGNED_BYTES]) -> Result<Self, ManifestError> {
        let word = |at: usize| word(bytes, at);
        if bytes[..4] != MAGIC {
            return Err(ManifestError::Magic);
        }
        let count = usize::from(bytes[6]);
        let unused = bytes[27..28].iter().chain(&bytes[172..]);
        let page = bytes.first_chunk().and_then(Self::seal);
        let sound = bytes[4] == FORMAT && count <= MAX_PARTS && bytes[25] <= 1 && page.is_some();
        // Each manifest has one encoding.
        if !sound || !are_zero(unused) {
            return Err(ManifestError::Format);
        }
        let mut manifest = Self {
            kind: ImageKind::from_repr(bytes[5]).ok_or(ManifestError::Format)?,
            key: bytes[7],
            lowest_key: bytes[24],
            paired: bytes[25] == 1,
            security_counter: bytes[26],
            hardware: word(8),
            version: word(12),
            length: word(16),
            crc: word(20),
            entries: [word(32), word(36), word(40)],
            parts: [ImagePart::default(); MAX_PARTS],
            needs_bootloader: word(164),
            needs_configuration: word(168),
        };
        let end = BODY_OFFSET.checked_add(manifest.length);
        let (end, mut free) = (end.ok_or(ManifestError::Layout)?, BODY_OFFSET);
        let mut inside = manifest.entries.map(|entry| entry == 0);
        let (parts, _) = bytes[44..164].as_chunks::<40>();
        for (index, bytes) in parts.iter().enumerate() {
            if index >= count {
                if !are_zero(bytes.iter()) {
                    return Err(ManifestError::Format);
                }
                continue;
            }
            let part = &mut manifest.parts[index];
            (part.offset, part.length) = (page::word(bytes, 0), page::word(bytes, 4));
            part.sha256.copy_from_slice(&bytes[8..]);
            if part.length == 0 {
                return Err(ManifestError::Format);
            }
            let part_end = part.offset.checked_add(part.length);
            let part_end = part_end.ok_or(ManifestError::Layout)?;
            if part.offset < free || part_end > end {
                return Err(ManifestError::Layout);
            }
            for (entry, inside) in manifest.entries.iter().zip(&mut inside) {
                *inside |= (part.offset..part_end).contains(entry);
            }
            free = part_end;
        }
        // The body ends with its last part.
        if free != end || count == 0 || inside.contains(&false) {
            return Err(ManifestError::Layout);
        }
        Ok(manifest)
    }

    /// Returns the length and CRC-32 of the body, which the boot ROM reads from a bootloader's
    /// first page. `None` if the page is not the first one of a manifest.
    #[must_use]
    pub fn seal(page: &[u8; PAGE_BYTES]) -> Option<(u32, u32)> {
        let word = |at: usize| word(page, at);
        let sound = page[..4] == MAGIC && checksum(&page[..28]) == word(28);
        sound.then(|| (word(16), word(20)))
    }
}
