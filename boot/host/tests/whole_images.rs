//! What a start takes for a whole image: one for this place and this hardware, within the place.
#![allow(clippy::unwrap_used)]

mod fixture;

use fixture::{body, configuration, image, loader};
use tandem_boot::{
    Bank, FlashRegion, ImageTarget, MANIFEST_BYTES, Manifest, SIGNED_BYTES, Slot, rom_choice,
};
use tandem_boot_host::life::{End, Life, TEST_KEY};
use tandem_boot_host::{Image, ReleaseInfo, SimulatedFlash};

/// Returns a new controller with bootloader and configuration, and these bytes in slot A.
fn with_application(bytes: &[u8]) -> SimulatedFlash {
    let mut flash = SimulatedFlash::new();
    for bank in [Bank::Primary, Bank::Backup] {
        flash.load(FlashRegion::Bank(bank).range().start, &loader(1).bytes);
    }
    let configuration = configuration(Slot::A, 1);
    flash.load(configuration.place(), &configuration.bytes);
    let place = FlashRegion::Target(ImageTarget::Application(Slot::A));
    flash.load(place.range().start, bytes);
    flash.power_on(0, None);
    flash
}

/// Returns an image whose body reaches from its place to `beyond` bytes behind its end.
fn reaching(target: ImageTarget, place: FlashRegion, beyond: usize) -> Image {
    let room = place.range().len() - MANIFEST_BYTES;
    let release = ReleaseInfo {
        version: 1,
        entries: [256; 3],
        ..ReleaseInfo::default()
    };
    Image::sign(
        target,
        release,
        &[(256, &body(1, room + beyond))],
        &TEST_KEY,
    )
}

/// U-5: an image that is signed and has the right digests boots only from the place that it is for,
/// on the hardware that it is for, and if it ends within its place.
#[test]
fn an_image_boots_only_where_it_belongs() {
    let slot = ImageTarget::Application(Slot::A);
    let region = FlashRegion::Target(slot);
    let mut foreign = image(Slot::A, 1, 300);
    foreign.manifest.hardware ^= 1;
    let signed: [u8; SIGNED_BYTES] = Manifest::encode(&foreign.manifest);
    foreign.bytes[..SIGNED_BYTES].copy_from_slice(&signed);
    foreign.bytes[SIGNED_BYTES..MANIFEST_BYTES].copy_from_slice(&TEST_KEY.sign(&signed));
    for (what, bytes, boots) in [
        ("an application", image(Slot::A, 1, 300).bytes, true),
        (
            "the longest one",
            reaching(slot, region.clone(), 0).bytes,
            true,
        ),
        (
            "one that is too long",
            reaching(slot, region, 32).bytes,
            false,
        ),
        ("one for other hardware", foreign.bytes, false),
        ("a configuration", configuration(Slot::A, 1).bytes, false),
    ] {
        let end = Life::plain().live(&mut with_application(&bytes)).end;
        assert_eq!(matches!(end, End::Running(_)), boots, "{what}: {end:?}");
    }
}

/// U-4: the boot ROM starts a bank whose checksum is right, if its body ends within the bank.
#[test]
fn the_rom_starts_a_bank_that_is_whole() {
    let region = FlashRegion::Bank(Bank::Primary);
    let loader = |len| {
        let release = ReleaseInfo::default();
        Image::sign(
            ImageTarget::Staging,
            release,
            &[(256, &body(1, len))],
            &TEST_KEY,
        )
    };
    let room = region.range().len() - MANIFEST_BYTES;
    for (len, starts) in [(90, true), (300, true), (room, true), (room + 32, false)] {
        let mut flash = SimulatedFlash::new();
        flash.load(region.range().start, &loader(len).bytes);
        flash.power_on(0, None);
        let expected = starts.then_some(Bank::Primary);
        assert_eq!(rom_choice(&mut flash), expected, "{len}");
    }
}
