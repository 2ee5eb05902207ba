//! What a start takes for a whole image: one for this place and this hardware, within the place.
#![allow(clippy::unwrap_used)]

mod fixture;

use fixture::{application, body, changed, configuration, factory, image, programmed, trial};
use tandem_board::{Instant, ResetCause};
use tandem_boot::{
    Bank, Environment, EnvironmentStore, FlashRegion, ImageTarget, Loader, MANIFEST_BYTES, Next,
    Slot, TrustMode, rom_choice,
};
use tandem_boot_host::life::{End, Life, TEST_KEY, TEST_PUBLIC};
use tandem_boot_host::{Image, ReleaseInfo, SimulatedFlash};

/// Returns a new controller with a configuration, and these bytes in slot A.
fn with_application(bytes: &[u8]) -> SimulatedFlash {
    let mut flash = programmed(&[&configuration(Slot::A, 1)]);
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
    let other_hardware = changed(image(Slot::A, 1, 300), |manifest| manifest.hardware ^= 1);
    let other_crc = changed(image(Slot::A, 1, 300), |manifest| manifest.crc ^= 1);
    for (what, bytes, boots) in [
        ("an application", image(Slot::A, 1, 300).bytes, true),
        ("the longest one", reaching(slot, region, 0).bytes, true),
        (
            "one that is too long",
            reaching(slot, region, 32).bytes,
            false,
        ),
        ("one for other hardware", other_hardware.bytes, false),
        (
            "one with another checksum for the boot ROM",
            other_crc.bytes,
            true,
        ),
        ("a configuration", configuration(Slot::A, 1).bytes, false),
    ] {
        let end = Life::plain().live(&mut with_application(&bytes)).end;
        assert_eq!(matches!(end, End::Running(_)), boots, "{what}: {end:?}");
    }
}

/// U-3, U-5: an image on trial that is damaged, or lacks what it needs, is not started.
#[test]
fn a_trial_is_started_if_it_is_whole_and_has_what_it_needs() {
    let needing = |needs_bootloader| {
        let release = ReleaseInfo {
            version: 2,
            needs_bootloader,
            ..ReleaseInfo::default()
        };
        application(Slot::B, release, &body(2, 300))
    };
    for (needs_bootloader, is_damaged, version) in
        [(1, false, 2), (1, true, 1), (9, false, 1), (9, true, 1)]
    {
        let new = needing(needs_bootloader);
        let mut flash = factory();
        flash.load(new.place(), &new.bytes);
        if is_damaged {
            flash.load(new.place() + 288, &[0; 32]);
        }
        flash.power_on(1, None);
        let mut store = EnvironmentStore::load(&mut flash).unwrap();
        let environment = Environment {
            trial: Some(trial(Slot::B)),
            ..*store.get()
        };
        store.write(&mut flash, environment).unwrap();
        let End::Running(launch) = Life::plain().live(&mut flash).end else {
            panic!("it boots");
        };
        assert_eq!(launch.version, version, "{needs_bootloader} {is_damaged}");
    }
}

/// E-4: in monitor mode a damaged image is started if no other can boot; in strict mode none is.
#[test]
fn monitor_mode_starts_a_damaged_image_as_the_last_resort() {
    for (mode, boots) in [(TrustMode::Strict, false), (TrustMode::Monitor, true)] {
        let mut flash = factory();
        let place = image(Slot::A, 1, 300).place();
        flash.load(place + 288, &[0; 32]);
        flash.power_on(1, None);
        const KEYS: [[u8; 32]; 1] = [TEST_PUBLIC];
        let mut setup = fixture::setup(&KEYS);
        (setup.trust.mode, setup.cause) = (mode, ResetCause::Watchdog);
        let next = Loader::start(flash, setup, Instant::ORIGIN).next(Instant::ORIGIN);
        assert_eq!(matches!(next, Next::Jump(_)), boots, "{mode:?}: {next:?}");
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
