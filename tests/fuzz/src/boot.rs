//! Fuzz targets for the inputs of the bootloader. T-BOOT-3, T-BOOT-4

use embedded_storage::nor_flash::{
    ErrorType, NorFlash, NorFlashErrorKind, ReadNorFlash, check_erase, check_read, check_write,
};
use tandem_boot::{
    Assembler, BODY_OFFSET, EnvironmentStore, FlashRegion, MANIFEST_BYTES, Manifest, PAGE_BYTES,
    SIGNED_BYTES, SMALLEST_SECTOR, SRecord,
};

/// A valid record.
const GOOD: &[u8] = b"S107004000DEADBE6F\r\n";

/// Checks that a line is accepted as a record only if its digits are a valid one.
///
/// # Panics
/// If a wrong length or checksum is accepted, or the line in upper case is read differently.
pub(crate) fn record(line: &[u8]) -> bool {
    let Ok(record) = SRecord::parse(line) else {
        return false;
    };
    let digits = |byte: &u8| char::from(*byte).to_digit(16).expect("hexadecimal digits");
    let (pairs, odd) = line[2..].as_chunks::<2>();
    let bytes: Vec<u32> = pairs
        .iter()
        .map(|[a, b]| digits(a) << 4 | digits(b))
        .collect();
    assert!(odd.is_empty(), "half a byte");
    assert_eq!(bytes[0] as usize, bytes.len() - 1, "length");
    assert_eq!(bytes.iter().sum::<u32>() & 0xFF, 0xFF, "checksum");
    let tail = &bytes[bytes.len() - 1 - record.data().len()..bytes.len() - 1];
    assert!(
        tail.iter()
            .copied()
            .eq(record.data().iter().copied().map(u32::from))
    );
    let mut upper = line.to_ascii_uppercase();
    upper[0] = b'S';
    assert_eq!(SRecord::parse(&upper), Ok(record));
    true
}

/// Takes frames, each a length (modulo 9) and its data. After any frames, the assembler must read
/// the next whole record.
///
/// # Panics
/// If the record is not read, or the assembler panics.
pub(crate) fn frames(mut bytes: &[u8]) -> bool {
    let mut assembler = Assembler::default();
    let mut accepted = false;
    while let [length, rest @ ..] = bytes {
        let (frame, rest) = rest.split_at(usize::from(length % 9).min(rest.len()));
        accepted |= matches!(assembler.push(frame), Some(Ok(_)));
        bytes = rest;
    }
    let results: Vec<_> = GOOD
        .chunks(8)
        .filter_map(|frame| assembler.push(frame))
        .collect();
    let [Ok(record)] = results[..] else {
        panic!("{results:?}");
    };
    assert_eq!(
        (record.address, record.data()),
        (0x40, &[0x00, 0xDE, 0xAD, 0xBE][..])
    );
    assert!(!assembler.is_inside());
    accepted
}

/// Checks that bytes are accepted as a manifest only if encoding it returns the same bytes, and all
/// its parts lie within its body.
///
/// # Panics
/// If other bytes are accepted.
pub(crate) fn manifest(bytes: &[u8]) -> bool {
    let Some(bytes) = bytes.first_chunk::<SIGNED_BYTES>() else {
        return false;
    };
    let Ok(manifest) = Manifest::decode(bytes) else {
        return false;
    };
    assert_eq!(manifest.encode(), *bytes);
    let end = u64::from(BODY_OFFSET) + u64::from(manifest.length);
    let mut free = MANIFEST_BYTES as u64;
    for part in manifest.parts() {
        assert!(u64::from(part.offset) >= free, "parts overlap");
        free = u64::from(part.offset) + u64::from(part.length);
    }
    assert_eq!(free, end, "the body ends with its last part");
    let seal = bytes.first_chunk::<PAGE_BYTES>().and_then(Manifest::seal);
    assert_eq!(seal, Some((manifest.length, manifest.crc)));
    true
}

/// Takes two copies of a boot environment, each with its confirmation. After a repair, the same
/// environment must be read again.
///
/// # Panics
/// If another environment is read.
pub(crate) fn environment(bytes: &[u8]) -> bool {
    let mut flash = Sectors::new();
    for (copy, bytes) in (0..2).zip(bytes.chunks(3 * PAGE_BYTES)) {
        let at = FlashRegion::Environment(copy).range().start as usize;
        flash.0[at..][..bytes.len()].copy_from_slice(bytes);
    }
    let load = |flash: &mut Sectors| EnvironmentStore::load(flash);
    let Some(mut store) = load(&mut flash) else {
        return false;
    };
    store.settle(&mut flash).expect("this flash can be written");
    let again = load(&mut flash).expect("what was repaired is there");
    assert_eq!(again.get(), store.get());
    true
}

/// The flash sectors up to the end of the boot environment.
struct Sectors(Vec<u8>);

impl Sectors {
    fn new() -> Self {
        Self(vec![0xFF; FlashRegion::Environment(1).range().end as usize])
    }
}

impl ErrorType for Sectors {
    type Error = NorFlashErrorKind;
}

impl ReadNorFlash for Sectors {
    const READ_SIZE: usize = 1;

    fn read(&mut self, offset: u32, bytes: &mut [u8]) -> Result<(), NorFlashErrorKind> {
        check_read(self, offset, bytes.len())?;
        bytes.copy_from_slice(&self.0[offset as usize..][..bytes.len()]);
        Ok(())
    }

    fn capacity(&self) -> usize {
        self.0.len()
    }
}

impl NorFlash for Sectors {
    const WRITE_SIZE: usize = PAGE_BYTES;
    const ERASE_SIZE: usize = SMALLEST_SECTOR as usize;

    fn erase(&mut self, from: u32, to: u32) -> Result<(), NorFlashErrorKind> {
        check_erase(self, from, to)?;
        self.0[from as usize..to as usize].fill(0xFF);
        Ok(())
    }

    fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), NorFlashErrorKind> {
        check_write(self, offset, bytes.len())?;
        let cells = self.0[offset as usize..].iter_mut();
        cells.zip(bytes).for_each(|(cell, byte)| *cell &= byte);
        Ok(())
    }
}
