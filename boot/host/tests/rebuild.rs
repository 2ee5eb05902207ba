//! What a loader makes of a flash without an environment: a new controller, or one that has lost
//! both copies.
#![allow(clippy::unwrap_used)]

mod fixture;

use fixture::{application, body, factory, programmed};
use tandem_board::Instant;
use tandem_boot::{Environment, EnvironmentStore, FlashRegion, Loader, Slot, TrustMode};
use tandem_boot_host::life::{TEST_KEY, TEST_KEY_1};
use tandem_boot_host::{Image, ReleaseInfo, SimulatedFlash};

/// Returns an application; `is_signed`: by an accepted key.
fn image(slot: Slot, version: u32, is_signed: bool) -> Image {
    let release = ReleaseInfo {
        version,
        ..ReleaseInfo::default()
    };
    let mut image = application(slot, release, &body(version, 90));
    image.bytes[200] ^= u8::from(!is_signed);
    image
}

/// Starts a loader with two keys. Returns the environment that it has written.
fn starts(mut flash: SimulatedFlash, mode: TrustMode) -> Environment {
    flash.power_on(1, None);
    let keys = [TEST_KEY.public(), TEST_KEY_1.public()];
    let mut setup = fixture::setup(&keys);
    setup.trust.mode = mode;
    let mut flash = Loader::start(flash, setup, Instant::ORIGIN).into_flash();
    *EnvironmentStore::load(&mut flash).unwrap().get()
}

/// E-4: a new controller accepts all keys of its bootloader; one that has lost its environment
/// accepts the newest one only.
#[test]
fn only_a_new_controller_accepts_old_keys() {
    let new = programmed(&[&image(Slot::A, 1, true)]);
    assert_eq!(starts(new, TrustMode::Strict).lowest_key, 0);
    let mut lost = factory();
    for copy in [0, 1] {
        lost.load(FlashRegion::Environment(copy).range().start, &[0; 0x4000]);
    }
    assert_eq!(starts(lost, TrustMode::Strict).lowest_key, 1);
}

/// U-2, U-5: of two whole images the older one is active and the newer one on trial. One without a
/// signature is taken in monitor mode only, and raises nothing.
#[test]
fn the_older_of_two_images_is_active() {
    use TrustMode::{Monitor, Strict};
    const A: Option<Slot> = Some(Slot::A);
    const B: Option<Slot> = Some(Slot::B);
    // Versions and signatures in slots A and B, mode; active, on trial, authentic, lowest version.
    for (a, b, mode, expected) in [
        ((1, true), (2, true), Strict, (A, B, true, 2)),
        ((2, true), (1, true), Strict, (B, A, true, 2)),
        ((2, true), (2, true), Strict, (A, B, true, 2)),
        ((1, true), (2, false), Strict, (A, None, false, 1)),
        ((1, false), (2, true), Strict, (B, None, false, 2)),
        ((1, false), (2, false), Strict, (None, None, false, 0)),
        ((1, true), (2, false), Monitor, (A, B, false, 1)),
        ((1, false), (2, true), Monitor, (A, B, false, 2)),
        ((1, true), (2, true), Monitor, (A, B, true, 2)),
    ] {
        let [a_image, b_image] = [(Slot::A, a), (Slot::B, b)]
            .map(|(slot, (version, signed))| image(slot, version, signed));
        let environment = starts(programmed(&[&a_image, &b_image]), mode);
        let trial = environment.trial;
        let seen = (
            environment.active.application,
            trial.and_then(|trial| trial.selection.application),
            trial.is_some_and(|trial| trial.authentic),
            environment.versions[0],
        );
        assert_eq!(seen, expected, "{a:?} {b:?} {mode:?}");
    }
}
