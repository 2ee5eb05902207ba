//! Creates signed images, and converts them to S-records.

use sha2::{Digest, Sha256};
use std::fmt::Write as _;
use tandem_boot::{
    BODY_OFFSET, FLASH_BYTES, FlashRegion, HARDWARE, ImagePart, ImageTarget, MANIFEST_BYTES,
    MAX_PARTS, Manifest, SIGNED_BYTES, SRecord, SRecordType, offset_of,
};

/// Data bytes of one record, as objcopy and srec_cat write them.
pub const RECORD_DATA: usize = 16;

/// A private key: its number in the bootloader's list, and its seed.
#[derive(Clone, Copy)]
pub struct SigningKey {
    /// The number of its public key in the bootloader.
    pub number: u8,
    /// The private key of 32 bytes (RFC 8032).
    pub seed: [u8; 32],
}

/// Shows the number alone.
impl std::fmt::Debug for SigningKey {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "SigningKey {{ number: {}, .. }}", self.number)
    }
}

impl SigningKey {
    /// Signs bytes.
    #[must_use]
    pub fn sign(&self, message: &[u8]) -> [u8; 64] {
        salty::Keypair::from(&self.seed).sign(message).to_bytes()
    }

    /// Returns the public key.
    #[must_use]
    pub fn public(&self) -> [u8; 32] {
        salty::Keypair::from(&self.seed).public.to_bytes()
    }
}

/// Why a file cannot be converted to an image.
#[derive(Debug, thiserror::Error, PartialEq, Eq)]
pub enum PackageError {
    /// A line is not a record.
    #[error("line {line} is not an S-record: {why:?}")]
    Line {
        /// The number of the line, from 1.
        line: usize,
        /// What is wrong with it.
        why: tandem_boot::SRecordError,
    },
    /// The number in a count record is wrong.
    #[error("line {line} counts {counted} data records, but {found} precede it")]
    Count {
        /// The number of the line, from 1.
        line: usize,
        /// The number in the record.
        counted: u32,
        /// The number of data records.
        found: u32,
    },
    /// The file is a difference to another one.
    #[error(
        "line {line} copies from the flash: sign the whole file, and make the difference after that"
    )]
    Copy {
        /// The number of the line, from 1.
        line: usize,
    },
    /// Two records have data for the same address.
    #[error("address {address:#010X} has data twice")]
    Overlap {
        /// The address.
        address: u32,
    },
    /// The file has no data.
    #[error("the file holds no data")]
    Empty,
    /// The file is not an ELF file of a 32-bit little-endian machine.
    #[error("not an ELF file of a 32-bit little-endian machine")]
    Elf,
    /// The data are not all in one place for images, or begin in the first 256 bytes of the place.
    #[error(
        "data at offset {offset:#08X}: an image must lie in one slot, after the first 256 bytes, \
         which are for the manifest"
    )]
    Place {
        /// Offset in the flash.
        offset: u32,
    },
}

/// The content of a file of S-records.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Content {
    /// Separate runs of bytes at ascending addresses.
    pub runs: Vec<(u32, Vec<u8>)>,
    /// The entry; 0 or `None` if the file has none.
    pub entry: Option<u32>,
}

impl Content {
    /// Parses S-records in any order.
    ///
    /// # Errors
    /// [`PackageError`] names the line or the address.
    pub fn parse(text: &str) -> Result<Self, PackageError> {
        let mut content = Self::default();
        let mut found = 0;
        let mut runs: Vec<(u32, Vec<u8>)> = Vec::new();
        for (index, line) in text.lines().enumerate() {
            if line.trim().is_empty() {
                continue;
            }
            let line_number = index + 1;
            let record = SRecord::parse(line.trim_end().as_bytes());
            let record = record.map_err(|why| PackageError::Line {
                line: line_number,
                why,
            })?;
            match record.record_type {
                SRecordType::Header => {}
                SRecordType::Copy => return Err(PackageError::Copy { line: line_number }),
                SRecordType::Data => {
                    found += 1;
                    runs.push((record.address, record.data().to_vec()));
                }
                SRecordType::Count if record.address == found => {}
                SRecordType::Count => {
                    return Err(PackageError::Count {
                        line: line_number,
                        counted: record.address,
                        found,
                    });
                }
                SRecordType::Entry => content.entry = Some(record.address),
            }
        }
        runs.retain(|(_, data)| !data.is_empty());
        runs.sort_by_key(|(address, _)| *address);
        for (address, data) in runs {
            match content.runs.last_mut() {
                Some((start, bytes)) if u64::from(*start) + bytes.len() as u64 > address.into() => {
                    return Err(PackageError::Overlap { address });
                }
                Some((start, bytes))
                    if u64::from(*start) + bytes.len() as u64 == address.into() =>
                {
                    bytes.extend(data);
                }
                _ => content.runs.push((address, data)),
            }
        }
        Ok(content)
    }
}

/// An image as stored in its place, the manifest first.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Image {
    /// Its place.
    pub target: ImageTarget,
    /// Its manifest.
    pub manifest: Manifest,
    /// All bytes from the start of the place.
    pub bytes: Vec<u8>,
}

/// The properties of an image besides its bytes.
#[derive(Clone, Copy, Debug, Default)]
pub struct ReleaseInfo {
    /// Version, ascending with every release.
    pub version: u32,
    /// Entries of the cores, as offsets from the image's place; 0 for none.
    pub entries: [u32; 3],
    /// Keys below this are retired.
    pub lowest_key: u8,
    /// As in [`Manifest::paired`].
    pub paired: bool,
    /// As in [`Manifest::security_counter`].
    pub security_counter: u8,
    /// As in [`Manifest::needs_bootloader`].
    pub needs_bootloader: u32,
    /// As in [`Manifest::needs_configuration`].
    pub needs_configuration: u32,
}

impl Image {
    /// Signs an image with these parts; each has an offset from the place, and bytes. Fills gaps
    /// with 0xFF.
    ///
    /// # Panics
    /// If there are no parts or more than three, or a part begins before [`BODY_OFFSET`] or before
    /// the end of the previous one.
    #[must_use]
    pub fn sign(
        target: ImageTarget,
        release: ReleaseInfo,
        parts: &[(u32, &[u8])],
        key: &SigningKey,
    ) -> Self {
        assert!((1..=MAX_PARTS).contains(&parts.len()), "one to three parts");
        let mut bytes = vec![0xFF; MANIFEST_BYTES];
        let mut listed = [ImagePart::default(); MAX_PARTS];
        for ((offset, data), part) in parts.iter().zip(&mut listed) {
            assert!(
                *offset as usize >= bytes.len(),
                "parts in order, behind the manifest"
            );
            bytes.resize(*offset as usize, 0xFF);
            bytes.extend(*data);
            *part = ImagePart {
                offset: *offset,
                length: data.len() as u32,
                sha256: Sha256::digest(data).into(),
            };
        }
        let body = &bytes[MANIFEST_BYTES..];
        let manifest = Manifest {
            kind: target.kind(),
            key: key.number,
            lowest_key: release.lowest_key,
            paired: release.paired,
            security_counter: release.security_counter,
            needs_bootloader: release.needs_bootloader,
            needs_configuration: release.needs_configuration,
            hardware: HARDWARE,
            version: release.version,
            length: body.len() as u32,
            crc: crc::Crc::<u32>::new(&crc::CRC_32_ISO_HDLC).checksum(body),
            entries: release.entries,
            parts: listed,
        };
        let signed = manifest.encode();
        let signature = salty::Keypair::from(&key.seed).sign(&signed).to_bytes();
        bytes[..SIGNED_BYTES].copy_from_slice(&signed);
        bytes[SIGNED_BYTES..MANIFEST_BYTES].copy_from_slice(&signature);
        Self {
            target,
            manifest,
            bytes,
        }
    }

    /// Signs the content of a file as one part from the first to the last byte. The entry of the
    /// file, if it has one, becomes that of core 0.
    ///
    /// # Errors
    /// [`PackageError`] if the data do not fit into the place of one image.
    pub fn of(
        content: &Content,
        mut release: ReleaseInfo,
        key: &SigningKey,
    ) -> Result<Self, PackageError> {
        let first = content.runs.first().ok_or(PackageError::Empty)?;
        let first = offset_of(first.0).ok_or(PackageError::Place { offset: first.0 })?;
        let target = ImageTarget::at(first).ok_or(PackageError::Place { offset: first })?;
        let place = FlashRegion::Target(target).range();
        let mut bytes = Vec::new();
        for (address, data) in &content.runs {
            let offset = offset_of(*address).ok_or(PackageError::Place { offset: *address })?;
            if offset < place.start + BODY_OFFSET || offset + data.len() as u32 > place.end {
                return Err(PackageError::Place { offset });
            }
            bytes.resize((offset - first) as usize, 0xFF);
            bytes.extend(data);
        }
        let entry = content.entry.and_then(offset_of);
        if let Some(entry) = entry.filter(|entry| place.contains(entry)) {
            release.entries[0] = entry - place.start;
        }
        Ok(Self::sign(
            target,
            release,
            &[(first - place.start, &bytes)],
            key,
        ))
    }

    /// Like [`Image::of`], with the entry of the file for all cores.
    ///
    /// # Errors
    /// [`PackageError`] if the data do not fit into the place of one image.
    pub fn of_every_core(
        content: &Content,
        release: ReleaseInfo,
        key: &SigningKey,
    ) -> Result<Self, PackageError> {
        let entry = Self::of(content, release, key)?.manifest.entries[0];
        let entries = [entry; 3];
        Self::of(content, ReleaseInfo { entries, ..release }, key)
    }

    /// Returns the image in a signed file.
    ///
    /// # Errors
    /// [`PackageError::Place`] if the file is not one image that begins with its manifest.
    pub fn of_signed(content: &Content) -> Result<Self, PackageError> {
        let (address, first) = content.runs.first().ok_or(PackageError::Empty)?;
        let wrong = PackageError::Place { offset: *address };
        let at = offset_of(*address);
        let target = at.and_then(ImageTarget::at);
        let manifest = first.first_chunk().map(Manifest::decode);
        let (Some(at), Some(target), Some(Ok(manifest))) = (at, target, manifest) else {
            return Err(wrong);
        };
        let mut bytes = Vec::new();
        for (address, data) in &content.runs {
            let offset =
                offset_of(*address).filter(|offset| ImageTarget::at(*offset) == Some(target));
            let offset = offset.ok_or(PackageError::Place { offset: *address })?;
            bytes.resize((offset - at) as usize, 0xFF);
            bytes.extend(data);
        }
        if bytes.len() != MANIFEST_BYTES + manifest.length as usize {
            return Err(wrong);
        }
        Ok(Self {
            target,
            manifest,
            bytes,
        })
    }

    /// Signs the bytes that an ELF file loads into a program flash at address `flash`. All cores
    /// begin at the file's entry.
    ///
    /// # Errors
    /// [`PackageError`] if it is not an ELF file, or its data do not fit into one image.
    pub fn of_elf(
        elf: &[u8],
        flash: u32,
        mut release: ReleaseInfo,
        key: &SigningKey,
    ) -> Result<Self, PackageError> {
        let (entry, runs) = loaded(elf).ok_or(PackageError::Elf)?;
        let mut content = Content::default();
        for (address, data) in runs {
            let offset = address.wrapping_sub(flash);
            if offset < FLASH_BYTES {
                content.runs.push((offset, data.to_vec()));
            }
        }
        content.runs.sort_by_key(|(offset, _)| *offset);
        let entry = entry.wrapping_sub(flash);
        let target = ImageTarget::at(entry).ok_or(PackageError::Place { offset: entry })?;
        release.entries = [entry - FlashRegion::Target(target).range().start; 3];
        Self::of(&content, release, key)
    }

    /// Returns its offset in the flash.
    #[must_use]
    pub fn place(&self) -> u32 {
        FlashRegion::Target(self.target).range().start
    }

    /// Returns the bytes to send: the manifest and the parts, without the gaps between them.
    pub(crate) fn runs(&self) -> impl Iterator<Item = (u32, &[u8])> {
        let manifest = (0, &self.bytes[..MANIFEST_BYTES]);
        let parts = self.manifest.parts().map(|part| {
            let (from, to) = (part.offset as usize, (part.offset + part.length) as usize);
            (part.offset, &self.bytes[from..to])
        });
        std::iter::once(manifest).chain(parts)
    }
}

/// Physical address and bytes of an ELF file's loadable segment.
type Segment<'e> = (u32, &'e [u8]);

/// Returns the entry of an ELF file and its loadable segments (TIS ELF 1.2, figures 1-3 and 2-1).
fn loaded(elf: &[u8]) -> Option<(u32, Vec<Segment<'_>>)> {
    const LOAD: u32 = 1;
    let word = |at: usize| Some(u32::from_le_bytes(*elf.get(at..)?.first_chunk()?));
    let half = |at: usize| Some(u16::from_le_bytes(*elf.get(at..)?.first_chunk()?));
    let is_elf = elf.starts_with(b"\x7fELF\x01\x01");
    let (table, each) = (word(28)? as usize, usize::from(half(42)?));
    let mut runs = Vec::new();
    for at in (0..usize::from(half(44)?)).map(|index| table + index * each) {
        let (kind, begin, address, len) =
            (word(at)?, word(at + 4)?, word(at + 12)?, word(at + 16)?);
        if kind == LOAD && len > 0 {
            let data = elf.get(begin as usize..)?.get(..len as usize)?;
            runs.push((address, data));
        }
    }
    is_elf.then_some((word(24)?, runs))
}

/// Returns the lines of a file with these images: a header, S3 records of [`RECORD_DATA`] bytes, a
/// count, and an entry. Each line ends with CR LF.
#[must_use]
pub fn records(name: &str, images: &[&Image]) -> Vec<String> {
    let mut images: Vec<&&Image> = images.iter().collect();
    images.sort_by_key(|image| image.place());
    let mut lines = vec![line(0, &[0, 0], name.as_bytes())];
    for image in &images {
        for (offset, bytes) in image.runs() {
            for (chunk, at) in bytes.chunks(RECORD_DATA).zip((0..).step_by(RECORD_DATA)) {
                let address = image.place() + offset + at;
                lines.push(line(3, &address.to_be_bytes(), chunk));
            }
        }
    }
    // S6 has three bytes for the count, which is enough: 2 MiB need at most 131,072 records.
    let count = (lines.len() as u32 - 1).to_be_bytes();
    lines.push(line(6, &count[1..], &[]));
    let entry = images.iter().find(|image| image.manifest.entries[0] > 0);
    let entry = entry.map_or(0, |image| image.place() + image.manifest.entries[0]);
    lines.push(line(7, &entry.to_be_bytes(), &[]));
    lines
}

/// Returns one record with its line end.
#[must_use]
pub fn line(digit: u8, address: &[u8], data: &[u8]) -> String {
    let length = (address.len() + data.len() + 1) as u8;
    let bytes = || std::iter::once(&length).chain(address).chain(data);
    let sum = bytes().fold(0u8, |sum, byte| sum.wrapping_add(*byte));
    let mut line = format!("S{digit}");
    for byte in bytes().chain([&!sum]) {
        // Writing to a string does not fail.
        let _ = write!(line, "{byte:02X}");
    }
    line + "\r\n"
}
