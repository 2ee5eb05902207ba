//! Each check of a manifest and of what follows it, with a file that breaks it alone.
#![allow(clippy::unwrap_used)]

mod fixture;

use fixture::{changed, factory, image, loader};
use tandem_boot::{FlashRegion, ImageKind, ImageTarget, MANIFEST_BYTES, Manifest, Refusal, Slot};
use tandem_boot_host::life::{End, Life, LifeOutcome, TEST_KEY};
use tandem_boot_host::{Image, ReleaseInfo, SimulatedFlash, line, records};

fn sends(flash: &mut SimulatedFlash, lines: &[String]) -> LifeOutcome {
    flash.power_on(3, None);
    Life::with_file(lines, 0).live(flash)
}

/// Returns the bytes of an image in records of this length.
fn all_bytes(image: &Image, length: usize) -> Vec<String> {
    let mut lines = vec![line(0, &[0, 0], b"new")];
    for (bytes, at) in image.bytes.chunks(length).zip((0..).step_by(length)) {
        lines.push(line(3, &(image.place() + at).to_be_bytes(), bytes));
    }
    lines.push(line(7, &[0; 4], &[]));
    lines
}

/// An application in two parts, one behind the other.
fn two_parts() -> Image {
    let release = ReleaseInfo {
        version: 2,
        entries: [256; 3],
        ..ReleaseInfo::default()
    };
    let target = ImageTarget::Application(Slot::B);
    let parts: [(u32, &[u8]); 2] = [(256, &[1; 70]), (326, &[2; 90])];
    Image::sign(target, release, &parts, &TEST_KEY)
}

/// T-BOOT-4: records of any length give the same image, also if they cross the end of the manifest,
/// of a part or of a page.
#[test]
fn records_of_any_length_give_the_same_image() {
    let images = [image(Slot::B, 2, 300), two_parts()];
    for (new, length) in images
        .iter()
        .flat_map(|it| [1, 7, 33, 100, 250].map(|len| (it, len)))
    {
        let mut flash = factory();
        let outcome = sends(&mut flash, &all_bytes(new, length));
        assert!(outcome.downloaded, "{length}: {outcome:?}");
        let written = flash.firm(new.place(), new.bytes.len() as u32);
        assert_eq!(written.as_ref(), Some(&new.bytes), "{length}");
    }
}

/// U-5: only a bootloader needs the checksum of the boot ROM, and it needs the right one.
#[test]
fn a_bootloader_has_the_checksum_of_the_rom() {
    let wrong = |manifest: &mut Manifest| manifest.crc ^= 1;
    for (file, refused) in [
        (changed(loader(2), wrong), Some(Refusal::Digest)),
        (changed(image(Slot::B, 2, 300), wrong), None),
    ] {
        let outcome = sends(&mut factory(), &records("new", &[&file]));
        assert_eq!(outcome.refused, refused, "{:?}", file.target);
    }
}

/// U-3: an image that is there, but damaged, is written again.
#[test]
fn a_damaged_image_is_written_again() {
    let new = image(Slot::B, 2, 300);
    let mut flash = factory();
    flash.load(new.place(), &new.bytes);
    flash.load(new.place() + 300, &[0; 32]);
    let outcome = sends(&mut flash, &records("new", &[&new]));
    assert!(matches!(outcome.end, End::Running(launch) if launch.version == 2));
    let written = flash.firm(new.place(), new.bytes.len() as u32);
    assert_eq!(written, Some(new.bytes));
}

/// E-4, U-5: a manifest for another place or other hardware, too long, or one that retires its own
/// key is refused, and nothing was erased for it. The longest one is not.
#[test]
fn a_manifest_that_does_not_fit_is_refused() {
    let range = FlashRegion::Target(ImageTarget::Application(Slot::B)).range();
    let room = range.len() as u32 - MANIFEST_BYTES as u32;
    let long = |length: u32| {
        changed(image(Slot::B, 2, 300), move |manifest| {
            (manifest.length, manifest.parts[0].length) = (length, length);
        })
    };
    let plain = || image(Slot::B, 2, 300);
    let bad = Some(Refusal::BadManifest);
    for (what, file, refused) in [
        ("hardware", changed(plain(), |it| it.hardware ^= 1), bad),
        (
            "kind",
            changed(plain(), |it| it.kind = ImageKind::Configuration),
            bad,
        ),
        ("key", changed(plain(), |it| it.lowest_key = 1), bad),
        ("too long", long(room + 1), bad),
        ("twice too long", long(2 * room), bad),
        ("longest", long(room), Some(Refusal::Incomplete)),
    ] {
        let mut flash = factory();
        let before = flash.work().0;
        let outcome = sends(&mut flash, &all_bytes(&file, 16));
        let refusal = outcome.refused;
        // The data of the longest one end early.
        assert_eq!(refusal, refused, "{what}");
        let erases = flash.work().0 > before;
        assert_eq!(erases, refused != bad, "{what}");
    }
}
