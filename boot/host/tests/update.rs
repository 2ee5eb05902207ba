//! Updates from end to end: download, trial, approval, rollback, downgrade, and the loader itself.
#![allow(clippy::unwrap_used)]

mod fixture;

use fixture::{Images, configuration, factory, image, lives, loader, signed};
use tandem_board::Instant;
use tandem_boot::{
    Answer, Bank, EnvironmentStore, FlashRegion, HostRequest, ImageTarget, Loader, Next, Refusal,
    Slot, rom_choice,
};
use tandem_boot_host::life::{End, Life, TEST_KEY, TEST_KEY_1, TEST_PUBLIC};
use tandem_boot_host::{Content, Image, ReleaseInfo, SimulatedFlash, records};

fn running(end: End) -> (Slot, u32) {
    match end {
        End::Running(launch) => (launch.application, launch.version),
        other => panic!("not running: {other:?}"),
    }
}

/// T-BOOT-1, T-BOOT-3, U-3: with each window, a download is on trial, approves itself and stays.
#[test]
fn a_download_boots_and_stays() {
    for window in [0, 1, 16] {
        let mut flash = factory();
        let new = image(Slot::B, 2, 1000);
        let lines = records("new", &[&new]);
        let outcome = Life::with_file(&lines, window).live(&mut flash);
        assert!(outcome.downloaded);
        assert_eq!(running(outcome.end), (Slot::B, 2));
        assert_eq!(
            flash.firm(new.place(), new.bytes.len() as u32),
            Some(new.bytes)
        );
        assert_eq!(running(lives(&mut flash, 1)), (Slot::B, 2));
        assert_eq!(flash.overwrites(), []);
    }
}

/// U-3: an image that was started and did not approve itself is rolled back.
#[test]
fn an_image_that_does_not_approve_itself_is_rolled_back() {
    let mut flash = factory();
    let lines = records("new", &[&image(Slot::B, 2, 100)]);
    let mut life = Life::with_file(&lines, 0);
    life.approves = false;
    assert_eq!(running(life.live(&mut flash).end), (Slot::B, 2));
    assert_eq!(running(lives(&mut flash, 1)), (Slot::A, 1));
    assert_eq!(running(lives(&mut flash, 2)), (Slot::A, 1));
}

/// U-3, U-5: application and configuration of one file are on trial together, and roll back
/// together.
#[test]
fn what_comes_together_goes_together() {
    for approves in [true, false] {
        let mut flash = factory();
        let (new, settings) = (image(Slot::B, 2, 100), configuration(Slot::B, 5));
        let lines = records("both", &[&new, &settings]);
        let mut life = Life::with_file(&lines, 8);
        life.approves = approves;
        let End::Running(launch) = life.live(&mut flash).end else {
            panic!("not running")
        };
        assert_eq!(launch.configuration, Some(Slot::B));
        let End::Running(launch) = lives(&mut flash, 1) else {
            panic!("not running")
        };
        let expected = if approves {
            (Slot::B, Some(Slot::B))
        } else {
            (Slot::A, Some(Slot::A))
        };
        assert_eq!((launch.application, launch.configuration), expected);
    }
}

/// U-3: a version older than an approved image is refused; the same version is accepted again.
#[test]
fn a_downgrade_is_refused() {
    let mut flash = factory();
    for (slot, version, refused) in [
        (Slot::B, 3, None),
        (Slot::A, 2, Some(Refusal::Downgrade)),
        (Slot::A, 3, None),
    ] {
        let lines = records("next", &[&image(slot, version, 64)]);
        let outcome = Life::with_file(&lines, 4).live(&mut flash);
        assert_eq!(outcome.refused, refused);
        assert_eq!(running(outcome.end).1, 3);
    }
}

/// E-4: key rotation. The new key retires the old one only after its image has approved itself.
#[test]
fn a_retired_key_signs_nothing_any_more() {
    let mut flash = factory();
    let mut step = |image: &Image, approves| {
        let lines = records("next", &[image]);
        let mut life = Life::with_file(&lines, 0);
        life.keys = vec![TEST_KEY.public(), TEST_KEY_1.public()];
        life.approves = approves;
        life.live(&mut flash).refused
    };
    let retiring = |slot, version| {
        let release = ReleaseInfo {
            version,
            entries: [256, 0, 0],
            lowest_key: 1,
            ..ReleaseInfo::default()
        };
        Image::sign(
            ImageTarget::Application(slot),
            release,
            &[(256, &[7; 50])],
            &TEST_KEY_1,
        )
    };
    assert_eq!(step(&retiring(Slot::B, 2), false), None);
    assert_eq!(
        step(&image(Slot::B, 2, 50), false),
        None,
        "the old key, after a rollback"
    );
    assert_eq!(step(&retiring(Slot::B, 3), true), None);
    assert_eq!(step(&image(Slot::A, 4, 50), true), Some(Refusal::Untrusted));
    let foreign = Image::sign(
        ImageTarget::Application(Slot::A),
        ReleaseInfo {
            version: 9,
            entries: [0; 3],
            lowest_key: 1,
            ..ReleaseInfo::default()
        },
        &[(256, &[7; 50])],
        &TEST_KEY,
    );
    assert_eq!(
        step(&foreign, true),
        Some(Refusal::BadManifest),
        "a key that retires itself"
    );
}

/// E-4: strict mode refuses an image that is not authentic; monitor mode accepts and logs it.
#[test]
fn strict_refuses_and_monitor_notes() {
    for monitor in [false, true] {
        let mut flash = factory();
        let mut new = image(Slot::B, 2, 100);
        new.bytes[255] ^= 1;
        let lines = records("new", &[&new]);
        let mut life = Life::with_file(&lines, 0);
        life.monitor = monitor;
        let outcome = life.live(&mut flash);
        assert_eq!(outcome.refused, (!monitor).then_some(Refusal::Untrusted));
        assert_eq!(running(outcome.end).1, if monitor { 2 } else { 1 });
        let mut events = Vec::new();
        tandem_boot::read_log(&mut flash, &mut |entry| events.push(entry.event));
        let noted = events.contains(&tandem_boot::LogEvent::StartedUntrusted);
        assert_eq!(noted, monitor, "{events:?}");
    }
}

/// T-BOOT-6: no address outside the free slots is written, and the refusal names the reason.
#[test]
fn addresses_that_are_not_free_are_refused() {
    let at = |address: u32| vec![tandem_boot_host::line(3, &address.to_be_bytes(), &[1; 16])];
    for (lines, refusal) in [
        (at(0x00_0000), Refusal::Protected),
        (at(0x00_7FF0), Refusal::Protected),
        (at(0x00_8000), Refusal::Protected),
        (at(0x01_0000), Refusal::Protected),
        (at(0x03_0000), Refusal::Protected),
        (at(0x02_8000), Refusal::Address),
        (at(0x1C_0000), Refusal::Address),
        (at(0x20_0000), Refusal::Address),
        (at(0x7000_0000), Refusal::Address),
        (at(0x04_0000), Refusal::SlotInUse),
        (at(0x01_8000), Refusal::SlotInUse),
        (at(0x10_0000), Refusal::NoManifest),
        (at(0xA010_0100), Refusal::NoManifest),
    ] {
        let mut flash = factory();
        let before = flash.save();
        let lines = [lines, records("", &[&image(Slot::B, 2, 1)])].concat();
        let outcome = Life::with_file(&lines, 0).live(&mut flash);
        assert_eq!(outcome.refused, Some(refusal), "{}", lines[0]);
        assert_eq!(running(outcome.end), (Slot::A, 1));
        unchanged_but_for_the_log(&before, &flash.save());
    }
}

/// Asserts that nothing outside the log has changed.
fn unchanged_but_for_the_log(before: &[u8], after: &[u8]) {
    const CELL: usize = 69;
    let outside = |bytes: &[u8]| -> Vec<Vec<u8>> {
        let log = FlashRegion::Log(0).range().start..FlashRegion::Log(1).range().end;
        let cells = bytes.chunks(CELL);
        let page = |cell: &&[u8]| u32::from_le_bytes(*cell.first_chunk().unwrap()) * 32;
        let cells = cells.filter(|cell| !log.contains(&page(cell)));
        cells.map(<[u8]>::to_vec).collect()
    };
    assert_eq!(outside(before), outside(after));
}

/// T-BOOT-4, U-5: each file has one defect and is refused for that reason, and the old image
/// boots.
#[test]
fn wrong_files_are_refused_with_the_reason() {
    let new = image(Slot::B, 2, 200);
    let good = records("new", &[&new]);
    let edit = |change: &dyn Fn(&mut Vec<String>)| {
        let mut lines = good.clone();
        change(&mut lines);
        lines
    };
    let count = good.len() - 2;
    let body = 1 + 256 / 16;
    let overlapping = {
        let address = (new.place() + 256 + 8).to_be_bytes();
        tandem_boot_host::line(3, &address, &[0; 16])
    };
    for (name, lines, refusal) in [
        (
            "a missing record",
            edit(&|lines| drop(lines.remove(body + 1))),
            Refusal::Gap,
        ),
        (
            "a missing last record",
            edit(&|lines| drop(lines.remove(count - 1))),
            Refusal::Count,
        ),
        (
            "swapped records",
            edit(&|lines| lines.swap(body, body + 1)),
            Refusal::Gap,
        ),
        (
            "an old record",
            edit(&|lines| lines.insert(body + 2, lines[3].clone())),
            Refusal::Order,
        ),
        (
            "the record before",
            edit(&|lines| lines.insert(body + 2, lines[body].clone())),
            Refusal::Order,
        ),
        (
            "an overlap",
            edit(&|lines| lines.insert(body + 1, overlapping.clone())),
            Refusal::Overlap,
        ),
        (
            "a changed byte",
            edit(&|lines| {
                let address = (new.place() + 256).to_be_bytes();
                lines[body] = tandem_boot_host::line(3, &address, &[0xA5; 16]);
            }),
            Refusal::Digest,
        ),
        (
            "no manifest",
            edit(&|lines| drop(lines.drain(1..body))),
            Refusal::NoManifest,
        ),
        (
            "a wrong count",
            edit(&|lines| lines[count] = tandem_boot_host::line(5, &[0, 9], &[])),
            Refusal::Count,
        ),
        (
            "another entry",
            edit(&|lines| lines[count + 1] = tandem_boot_host::line(7, &[0, 0x10, 9, 9], &[])),
            Refusal::Entry,
        ),
        (
            "no end of data",
            edit(&|lines| drop(lines.drain(body + 2..=count))),
            Refusal::Incomplete,
        ),
        (
            "no data",
            edit(&|lines| drop(lines.drain(1..=count))),
            Refusal::Incomplete,
        ),
        (
            "more than the manifest names",
            edit(&|lines| {
                let address = (new.place() + 0x8000).to_be_bytes();
                lines.insert(count, tandem_boot_host::line(3, &address, &[1; 16]));
            }),
            Refusal::Unannounced,
        ),
        (
            "no S-records",
            vec!["S1 is a nice motorway\r\n".into(); 99],
            Refusal::Record,
        ),
        (
            "Intel hex",
            vec![":0300300002337A1E\r\n".into(); 99],
            Refusal::Record,
        ),
    ] {
        for window in [0, 4] {
            let mut flash = factory();
            let outcome = Life::with_file(&lines, window).live(&mut flash);
            assert_eq!(outcome.refused, Some(refusal), "{name}, window {window}");
            assert!(!outcome.downloaded);
            assert_eq!(running(outcome.end), (Slot::A, 1), "{name}");
            assert_eq!(running(lives(&mut flash, 1)), (Slot::A, 1), "{name}");
        }
    }
}

/// U-4: a new bootloader that no host has heard, and under which no application has worked, is not
/// approved: the next start restores the old one. One that a host has heard is.
#[test]
fn a_new_bootloader_must_have_worked() {
    for heard in [false, true] {
        let mut flash = factory();
        let new = loader(2);
        let lines = records("loader", &[&new]);
        let life = Life {
            approves: false,
            ..Life::with_file(&lines, 0)
        };
        assert!(life.live(&mut flash).downloaded);
        if heard {
            // The new bootloader, in the life in which the backup has started it.
            flash.power_on(1, None);
            let keys = [TEST_PUBLIC];
            let setup = fixture::setup(&keys);
            let mut loader = Loader::start(&mut flash, setup, Instant::ORIGIN);
            let connect = HostRequest::Connect {
                system: None,
                resume: false,
            };
            // A connection whose answer is not read, and then a record that the loader accepts.
            let accepted = records("new", &[&image(Slot::B, 2, 40)]).swap_remove(1);
            let pieces = accepted.as_bytes().chunks(8).map(HostRequest::Data);
            for request in std::iter::once(connect).chain(pieces) {
                loader.on_frame(Instant::ORIGIN, &request.frame().unwrap());
                let _ = loader.next(Instant::ORIGIN);
            }
        }
        let life = Life {
            approves: false,
            ..Life::plain()
        };
        for seed in 5..7 {
            flash.power_on(seed, None);
            assert_eq!(running(life.live(&mut flash).end), (Slot::A, 1));
        }
        let expected = if heard { new } else { loader(1) }.bytes;
        assert_eq!(
            flash.firm(0, expected.len() as u32),
            Some(expected),
            "{heard}"
        );
        assert_eq!(rom_choice(&mut flash), Some(Bank::Primary));
    }
}

/// U-4: a new bootloader is installed, tried, approves itself and is sealed; the application is
/// unchanged.
#[test]
fn a_new_bootloader_is_installed() {
    let mut flash = factory();
    let new = loader(2);
    let lines = records("loader", &[&new]);
    let outcome = Life::with_file(&lines, 0).live(&mut flash);
    assert!(outcome.downloaded);
    assert_eq!(running(outcome.end), (Slot::A, 1));
    assert_eq!(rom_choice(&mut flash), Some(Bank::Backup), "not sealed yet");
    assert_eq!(running(lives(&mut flash, 1)), (Slot::A, 1));
    assert_eq!(flash.firm(0, new.bytes.len() as u32), Some(new.bytes));
    let backup = FlashRegion::Bank(Bank::Backup).range().start;
    let old = loader(1).bytes;
    assert_eq!(flash.firm(backup, old.len() as u32), Some(old));
    assert_eq!(rom_choice(&mut flash), Some(Bank::Primary));
    let lines = records("loader", &[&loader(1)]);
    let outcome = Life::with_file(&lines, 0).live(&mut flash);
    assert_eq!(outcome.refused, Some(Refusal::Downgrade));
    assert_eq!(flash.overwrites(), []);
}

/// U-4: a new bootloader that crashes is replaced by its backup.
#[test]
fn a_bootloader_that_crashes_is_restored() {
    let mut flash = factory();
    let lines = records("loader", &[&loader(2)]);
    let mut life = Life::with_file(&lines, 0);
    life.new_loader_crashes = true;
    let outcome = life.live(&mut flash);
    assert!(outcome.downloaded);
    assert_eq!(running(outcome.end), (Slot::A, 1));
    let old = loader(1).bytes;
    assert_eq!(flash.firm(0, old.len() as u32), Some(old));
}

/// U-2, U-4: a damaged primary bootloader is restored from the backup.
#[test]
fn a_damaged_bootloader_is_restored() {
    let mut flash = factory();
    flash.load(0x40, &[0x5A; 8]);
    flash.load(0x120, &[0x5A; 8]);
    assert_eq!(rom_choice(&mut flash), Some(Bank::Backup));
    assert_eq!(running(lives(&mut flash, 1)), (Slot::A, 1));
    assert_eq!(rom_choice(&mut flash), Some(Bank::Primary));
}

/// U-2: a controller that lost both copies of its environment boots, and the older of two images
/// remains the fallback of the newer.
#[test]
fn a_lost_environment_is_rebuilt() {
    let Images { mut flash, .. } = Images::updated();
    for (older, newer) in [((Slot::A, 1), (Slot::B, 2)), ((Slot::B, 2), (Slot::A, 3))] {
        if newer.1 == 3 {
            let lines = records("new", &[&image(Slot::A, 3, 50)]);
            // Release 1 was forgotten as a trial, and release 2 is on trial again.
            assert_eq!(running(lives(&mut flash, 1)), (Slot::A, 1));
            let second = records("new", &[&image(Slot::B, 2, 300)]);
            assert!(Life::with_file(&second, 0).live(&mut flash).downloaded);
            flash.power_on(5, None);
            assert!(Life::with_file(&lines, 0).live(&mut flash).downloaded);
        }
        for copy in [0, 1] {
            flash.load(FlashRegion::Environment(copy).range().start, &[0; 0x4000]);
        }
        flash.power_on(6, None);
        let mut life = Life::plain();
        life.approves = false;
        assert_eq!(running(life.live(&mut flash).end), newer);
        assert_eq!(running(lives(&mut flash, 1)), older);
    }
}

/// U-3: a damaged active image is replaced by the other one.
#[test]
fn a_damaged_image_falls_back() {
    let Images { mut flash, new, .. } = Images::updated();
    flash.load(new.place() + 300, &[0; 4]);
    assert_eq!(running(lives(&mut flash, 1)), (Slot::A, 1));
    assert_eq!(running(lives(&mut flash, 1)), (Slot::A, 1));
    // The damaged slot is now free.
    let lines = records("again", &[&image(Slot::B, 2, 77)]);
    let outcome = Life::with_file(&lines, 0).live(&mut flash);
    assert_eq!(running(outcome.end), (Slot::B, 2));
}

/// T-BOOT-1: a controller without an image waits for a download and accepts it.
#[test]
fn an_empty_controller_waits() {
    let mut flash = tandem_boot_host::SimulatedFlash::new();
    let first = loader(1);
    flash.load(0, &first.bytes);
    flash.power_on(0, None);
    assert_eq!(Life::plain().live(&mut flash).end, End::Waiting);
    let lines = records("first", &[&image(Slot::A, 1, 40)]);
    let outcome = Life::with_file(&lines, 0).live(&mut flash);
    assert_eq!(running(outcome.end), (Slot::A, 1));
}

/// T-BOOT-4: an unsigned file is converted to a signed one, with its entry.
#[test]
fn a_plain_file_is_signed() {
    let lines = [
        tandem_boot_host::line(0, &[0, 0], b"app"),
        tandem_boot_host::line(3, &0xA010_0140u32.to_be_bytes(), &[2; 8]),
        tandem_boot_host::line(3, &0xA010_0100u32.to_be_bytes(), &[1; 16]),
        tandem_boot_host::line(5, &[0, 2], &[]),
        tandem_boot_host::line(7, &0xA010_0142u32.to_be_bytes(), &[]),
    ];
    let content = Content::parse(&lines.concat()).unwrap();
    let image = signed(&content, 2);
    assert_eq!(image.manifest.entries, [0x142, 0, 0]);
    let mut flash = factory();
    let lines = records("app", &[&image]);
    let End::Running(launch) = Life::with_file(&lines, 0).live(&mut flash).end else {
        panic!("not running")
    };
    assert_eq!(launch.entries, [Some(0x10_0142), None, None]);
}

/// Sends lines to a bootloader at power-on, without a window, and takes the flash away from it
/// before it resets. Returns the last answer.
fn sends_at_power_on(flash: &mut SimulatedFlash, lines: &[String]) -> Option<Answer> {
    let keys = [TEST_PUBLIC];
    flash.power_on(9, None);
    let mut loader = Loader::start(&mut *flash, fixture::setup(&keys), Instant::ORIGIN);
    let connect = HostRequest::Connect {
        system: None,
        resume: false,
    };
    let pieces = lines.iter().flat_map(|line| line.as_bytes().chunks(8));
    let mut last = None;
    for request in std::iter::once(connect).chain(pieces.map(HostRequest::Data)) {
        loader.on_frame(Instant::ORIGIN, &request.frame().unwrap());
        while let Next::Send(frame) = loader.next(Instant::ORIGIN) {
            last = Answer::decode(frame.data());
        }
    }
    last
}

/// U-4, T-BOOT-1: a record after the end of a file is refused, and takes nothing back.
#[test]
fn a_record_after_the_end_takes_nothing_back() {
    let mut flash = factory();
    let mut lines = records("loader", &[&loader(2)]);
    lines.push(tandem_boot_host::line(3, &[0, 4, 1, 0], &[7; 16]));
    let last = sends_at_power_on(&mut flash, &lines);
    assert_eq!(last, Some(Answer::Refused(Refusal::AfterEnd)));
    lives(&mut flash, 3);
    let new = loader(2).bytes;
    assert_eq!(flash.firm(0, new.len() as u32), Some(new));
}

/// U-3: an image on trial that was not started yet is forgotten before its place is erased, of each
/// kind; one in another place stays on trial.
#[test]
fn a_trial_is_forgotten_before_its_place_is_erased() {
    let application = |version| image(Slot::B, version, 300);
    let pairs = [
        (application(2), application(3), false),
        (configuration(Slot::B, 2), configuration(Slot::B, 3), false),
        (configuration(Slot::B, 2), application(3), true),
        (application(2), configuration(Slot::B, 3), true),
        (application(2), loader(3), true),
    ];
    for (first, second, stays) in pairs {
        let mut flash = factory();
        let lines = records("first", &[&first]);
        let last = sends_at_power_on(&mut flash, &lines);
        assert_eq!(last, Some(Answer::Accepted { records: 0 }));
        // The second file breaks off behind its manifest.
        let lines = records("second", &[&second]);
        sends_at_power_on(&mut flash, &lines[..18]);
        let store = EnvironmentStore::load(&mut flash).unwrap();
        assert_eq!(store.get().trial.is_some(), stays, "{:?}", second.target);
    }
}

/// U-3: a download in a reset loop goes to the slot that does not run, although that was the active
/// one. What runs is active from then on, so a start without approval boots it.
#[test]
fn a_download_in_a_reset_loop_does_not_become_active() {
    let Images { mut flash, .. } = Images::updated();
    let lines = records("new", &[&image(Slot::B, 3, 300)]);
    let keys = [TEST_PUBLIC];
    let start = |flash: &mut SimulatedFlash, starts, lines: &[String]| {
        let mut setup = fixture::setup(&keys);
        setup.starts = starts;
        setup.cause = match lines {
            [] => tandem_board::ResetCause::Watchdog,
            _ => tandem_board::ResetCause::Download,
        };
        let mut loader = Loader::start(&mut *flash, setup, Instant::ORIGIN);
        let connect = HostRequest::Connect {
            system: None,
            resume: false,
        };
        let pieces = lines.iter().flat_map(|line| line.as_bytes().chunks(8));
        let pieces = pieces.map(HostRequest::Data);
        let connects = (!lines.is_empty()).then_some(connect);
        for request in connects.into_iter().chain(pieces) {
            loader.on_frame(Instant::ORIGIN, &request.frame().unwrap());
            while let Next::Send(_) = loader.next(Instant::ORIGIN) {}
        }
        loader.next(Instant::from_ns(20_000_000_000))
    };
    // Slot B with release 2 is active, and after eight failed starts slot A runs.
    assert_eq!(start(&mut flash, 10, &lines), Next::Reset);
    let environment = *EnvironmentStore::load(&mut flash).unwrap().get();
    assert_eq!(environment.active.application, Some(Slot::A));
    assert!(environment.trial.is_some());
    let Next::Jump(launch) = start(&mut flash, 11, &[]) else {
        panic!("it boots");
    };
    assert_eq!(
        (launch.application, launch.version),
        (Slot::B, 3),
        "on trial"
    );
    // The next power-on ends the loop.
    let Next::Jump(launch) = start(&mut flash, 1, &[]) else {
        panic!("it boots");
    };
    assert_eq!(
        (launch.application, launch.version),
        (Slot::A, 1),
        "rolled back"
    );
}
