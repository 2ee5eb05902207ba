//! The manifest: encoding, layout, and an example for other tests.

use super::*;
use proptest::prelude::*;

/// A manifest of one part.
pub(crate) fn example() -> Manifest {
    let mut parts = [ImagePart::default(); MAX_PARTS];
    parts[0] = ImagePart {
        offset: BODY_OFFSET,
        length: 100,
        sha256: [7; 32],
    };
    Manifest {
        kind: ImageKind::Application,
        key: 0,
        lowest_key: 0,
        paired: true,
        security_counter: 2,
        needs_bootloader: 4,
        needs_configuration: 5,
        hardware: HARDWARE,
        version: 3,
        length: 100,
        crc: 0x1234_5678,
        entries: [BODY_OFFSET, 0, BODY_OFFSET + 99],
        parts,
    }
}

/// U-5: each kind decodes to what was encoded, and its first page seals it for the ROM.
#[test]
fn what_is_encoded_is_decoded() {
    for kind in (0..).map_while(ImageKind::from_repr) {
        let manifest = Manifest { kind, ..example() };
        let bytes = manifest.encode();
        assert_eq!(Manifest::decode(&bytes), Ok(manifest));
        let page = bytes.first_chunk().unwrap();
        assert_eq!(Manifest::seal(page), Some((100, 0x1234_5678)));
    }
}

#[test]
fn a_layout_that_cannot_be_is_refused() {
    let wrong = |change: fn(&mut Manifest)| {
        let mut manifest = example();
        change(&mut manifest);
        Manifest::decode(&manifest.encode())
    };
    let layout = Err(ManifestError::Layout);
    assert_eq!(wrong(|manifest| manifest.parts[0].offset = 0), layout);
    assert_eq!(
        wrong(|manifest| manifest.parts[0].length = u32::MAX),
        layout
    );
    assert_eq!(wrong(|manifest| manifest.length = u32::MAX), layout);
    assert_eq!(wrong(|manifest| manifest.length = 101), layout);
    assert_eq!(wrong(|manifest| manifest.entries[1] = 1), layout);
    assert_eq!(
        wrong(|manifest| manifest.parts[1] = manifest.parts[0]),
        layout
    );
    assert_eq!(wrong(|manifest| manifest.parts[0].length = 0), layout);
}

proptest! {
    /// A manifest has one encoding: a changed byte is refused or encodes another manifest.
    #[test]
    fn no_two_byte_strings_mean_the_same(place in 0..SIGNED_BYTES, value: u8) {
        let mut bytes = example().encode();
        bytes[place] = value;
        if let Ok(manifest) = Manifest::decode(&bytes) {
            prop_assert_eq!(manifest.encode(), bytes);
        }
    }
}
