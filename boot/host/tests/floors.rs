//! What was refused once stays refused: old versions, retired keys, what follows the end of a file.
#![allow(clippy::unwrap_used)]

mod fixture;

use fixture::{factory, image, lives, loader};
use tandem_board::Instant;
use tandem_boot::{Bank, EnvironmentStore, FlashRegion, ImageTarget, Loader, Next, Refusal, Slot};
use tandem_boot_host::cuts::floors;
use tandem_boot_host::life::{End, Life, LifeOutcome, TEST_KEY, TEST_KEY_1, TEST_PUBLIC};
use tandem_boot_host::{FileSender, Image, ReleaseInfo, SigningKey, SimulatedFlash, ToDo, records};

const SECOND: [SigningKey; 2] = [TEST_KEY, TEST_KEY_1];

/// Runs a life in which a host sends these images, and the loader knows both keys.
fn sends(flash: &mut SimulatedFlash, images: &[&Image], monitor: bool) -> LifeOutcome {
    let lines = records("new", images);
    flash.power_on(1, None);
    let life = Life {
        keys: SECOND.iter().map(SigningKey::public).collect(),
        monitor,
        ..Life::with_file(&lines, 0)
    };
    life.live(flash)
}

fn application(slot: Slot, version: u32, lowest_key: u8, key: &SigningKey) -> Image {
    let release = ReleaseInfo {
        version,
        entries: [256; 3],
        lowest_key,
        ..ReleaseInfo::default()
    };
    Image::sign(
        ImageTarget::Application(slot),
        release,
        &[(256, &[7; 50])],
        key,
    )
}

/// U-5: the running bootloader counts as approved, also that of the factory.
#[test]
fn a_bootloader_older_than_the_running_one_is_refused() {
    let mut flash = factory();
    for bank in [Bank::Primary, Bank::Backup] {
        let place = FlashRegion::Bank(bank).range().start;
        flash.load(place, &loader(5).bytes);
    }
    let refused = sends(&mut flash, &[&loader(4)], false).refused;
    assert_eq!(refused, Some(Refusal::Downgrade));
    assert!(
        sends(&mut flash, &[&loader(5)], false).downloaded,
        "the same"
    );
    assert!(sends(&mut flash, &[&loader(6)], false).downloaded);
    // It has worked in that life; the next start seals it.
    lives(&mut flash, 1);
    assert_eq!(floors(&mut flash).unwrap()[2], 6);
}

/// U-5, E-4: a controller that has lost both copies of its environment takes only what is signed by
/// the newest key, and is not older than its images.
#[test]
fn the_loss_of_both_copies_lowers_nothing() {
    let mut flash = factory();
    assert!(
        sends(
            &mut flash,
            &[&application(Slot::B, 3, 1, &TEST_KEY_1)],
            false
        )
        .downloaded
    );
    for copy in [0, 1] {
        flash.load(FlashRegion::Environment(copy).range().start, &[0; 0x4000]);
    }
    for (new, refused) in [
        (
            application(Slot::A, 4, 0, &TEST_KEY),
            Some(Refusal::Untrusted),
        ),
        (
            application(Slot::A, 2, 0, &TEST_KEY_1),
            Some(Refusal::Downgrade),
        ),
        (application(Slot::B, 4, 0, &TEST_KEY_1), None),
    ] {
        let outcome = sends(&mut flash, &[&new], false);
        assert!(matches!(outcome.end, End::Running(_)), "{outcome:?}");
        let in_use = outcome.refused == Some(Refusal::SlotInUse);
        assert!(outcome.refused == refused || in_use, "{outcome:?}");
    }
}

/// U-2: the loss of one copy of the environment, at any time, changes nothing.
#[test]
fn the_loss_of_one_copy_changes_nothing() {
    for copy in [0, 1] {
        let mut flash = factory();
        assert!(sends(&mut flash, &[&image(Slot::B, 3, 50)], false).downloaded);
        let environment =
            |flash: &mut SimulatedFlash| *EnvironmentStore::load(flash).unwrap().get();
        let before = environment(&mut flash);
        flash.load(FlashRegion::Environment(copy).range().start, &[0; 0x4000]);
        for start in 0..2 {
            assert_eq!(environment(&mut flash), before, "{copy} {start}");
            flash.power_on(start, None);
            assert!(matches!(
                Life::plain().live(&mut flash).end,
                End::Running(_)
            ));
        }
    }
}

/// E-4: in monitor mode an image that is not authentic runs, and raises nothing for ever.
#[test]
fn an_unsigned_image_raises_nothing() {
    let mut flash = factory();
    let before = floors(&mut flash);
    let mut unsigned = application(Slot::B, 9, 0, &TEST_KEY);
    unsigned.bytes[200] ^= 1;
    assert!(sends(&mut flash, &[&unsigned], true).downloaded);
    assert_eq!(floors(&mut flash), before);
    assert!(sends(&mut flash, &[&image(Slot::A, 3, 50)], true).downloaded);
}

/// T-BOOT-1, T-BOOT-5: what follows the end of a file is refused. The file itself stays on trial: a
/// host without a key cannot take it back.
#[test]
fn records_after_the_end_are_refused() {
    let mut flash = factory();
    let lines = [
        records("a", &[&image(Slot::B, 2, 50)]),
        records("b", &[&fixture::configuration(Slot::B, 2)]),
    ];
    let outcome = Life::with_file(&lines.concat(), 0).live(&mut flash);
    assert_eq!(outcome.refused, Some(Refusal::AfterEnd));
    let End::Running(launch) = outcome.end else {
        panic!("{outcome:?}");
    };
    assert_eq!((launch.application, launch.version), (Slot::B, 2));
    assert_eq!(launch.configuration, Some(Slot::A));
}

/// T-BOOT-3: a connection takes one file; the next one comes after a start.
#[test]
fn a_connection_takes_one_file() {
    let keys = [TEST_PUBLIC];
    let setup = fixture::setup(&keys);
    let mut now = Instant::ORIGIN;
    let mut controller = Loader::start(factory(), setup, now);
    let lines = records("new", &[&image(Slot::B, 2, 50)]);
    let mut files = 0;
    let mut host = FileSender::new(lines.clone(), None, 0);
    loop {
        let wait = match controller.next(now) {
            Next::Send(frame) => {
                host.on_frame(now, &frame);
                continue;
            }
            Next::Wait(until) => until,
            next => {
                assert_eq!(next, Next::Reset);
                break;
            }
        };
        match host.next(now) {
            ToDo::Send(frame) => controller.on_frame(now, &frame),
            ToDo::Wait(until) => now = until.min(wait),
            ToDo::Done => {
                files += 1;
                host = FileSender::new(lines.clone(), None, 0);
            }
            other => panic!("{other:?}"),
        }
    }
    assert_eq!(files, 1);
}
