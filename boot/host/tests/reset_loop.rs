//! A reset loop: starts that do not work are counted, and end in the other slot.
#![allow(clippy::unwrap_used)]

mod fixture;

use fixture::Images;
use tandem_board::{Instant, ResetCause};
use tandem_boot::{EnvironmentStore, Loader, LogEvent, Next, Slot, read_log};
use tandem_boot_host::life::TEST_PUBLIC;

/// U-2: after eight starts that did not work the loader boots the other slot for eight starts, and
/// so on. It logs that once for each change, and the approved slot stays the approved one.
#[test]
fn each_eight_starts_the_other_slot_is_tried() {
    const KEYS: [[u8; 32]; 1] = [TEST_PUBLIC];
    let mut flash = Images::updated().flash;
    let mut expected_log = Vec::new();
    for starts in 1..=70u8 {
        let mut setup = fixture::setup(&KEYS);
        (setup.starts, setup.cause) = (starts, ResetCause::Watchdog);
        flash.power_on(starts.into(), None);
        let mut loader = Loader::start(flash, setup, Instant::ORIGIN);
        let Next::Jump(launch) = loader.next(Instant::ORIGIN) else {
            panic!("{starts}: it boots at once");
        };
        flash = loader.into_flash();
        let (expected, begins) = match (starts - 1) / 8 {
            0 | 2 | 4 | 6 | 8 => (Slot::B, false),
            _ => (Slot::A, (starts - 1) % 8 == 0),
        };
        assert_eq!(launch.application, expected, "{starts}");
        if begins {
            expected_log.push(u32::from(starts));
        }
    }
    let environment = *EnvironmentStore::load(&mut flash).unwrap().get();
    assert_eq!(environment.active.application, Some(Slot::B));
    let mut log = Vec::new();
    read_log(&mut flash, &mut |entry| {
        if entry.event == LogEvent::ResetLoop {
            log.push(entry.value);
        }
    });
    assert_eq!(log, expected_log);
    assert_eq!(log, [9, 25, 41, 57]);
}
