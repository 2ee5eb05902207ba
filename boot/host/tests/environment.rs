//! How the environment uses its sectors, and what a start writes once more.
#![allow(clippy::unwrap_used)]

mod fixture;

use tandem_board::Instant;
use tandem_boot::{
    Environment, EnvironmentStore, FlashRegion, Loader, LoaderUpdate, RECORD_BYTES, Selection, Slot,
};
use tandem_boot_host::life::{End, Life};
use tandem_boot_host::{Failing, FlashOperation, SimulatedFlash, Tear};

const QUIET: Environment = Environment {
    active: Selection {
        application: Some(Slot::A),
        configuration: None,
    },
    trial: None,
    loader: LoaderUpdate::Idle,
    versions: [1, 0, 0],
    lowest_key: 0,
};

/// A flash with this environment in both copies.
fn written(environment: Environment) -> (SimulatedFlash, EnvironmentStore) {
    let mut flash = SimulatedFlash::new();
    flash.power_on(0, None);
    let mut store = EnvironmentStore::new(environment);
    store.settle(&mut flash).unwrap();
    (flash, store)
}

/// The numbers and environments of the records in a copy, in the order of its slots.
fn records(flash: &SimulatedFlash, copy: u8) -> Vec<(u32, Environment)> {
    let range = FlashRegion::Environment(copy).range();
    let slots = range.step_by(RECORD_BYTES + RECORD_BYTES / 2);
    let record = |at| flash.firm(at, RECORD_BYTES as u32);
    let decoded = slots.map_while(|at| Environment::decode(&record(at)?.try_into().unwrap()));
    decoded
        .map(|(environment, number)| (number, environment))
        .collect()
}

const fn changed(version: u32) -> Environment {
    Environment {
        versions: [version, 0, 0],
        ..QUIET
    }
}

/// A flash whose power was lost after `ticks` of the work of a change.
fn cut_at(ticks: u64) -> SimulatedFlash {
    let (mut flash, _) = written(QUIET);
    flash.power_on(1, Some((ticks, Tear::Clean)));
    let mut store = EnvironmentStore::load(&mut flash).unwrap();
    let _cut = store.write(&mut flash, changed(2));
    flash.power_on(2, None);
    flash
}

fn read(flash: &SimulatedFlash) -> Environment {
    *EnvironmentStore::load(&mut flash.clone()).unwrap().get()
}

/// A flash whose power was lost when a change was in the first copy, and not in the second.
fn cut_after_the_first_copy() -> SimulatedFlash {
    let mut cuts = (1..).map(cut_at);
    cuts.find(|flash| read(flash) == changed(2)).unwrap()
}

/// U-2: a record that nothing confirms does not count.
#[test]
fn an_unconfirmed_record_does_not_count() {
    let mut cuts = (1..).map(cut_at);
    let flash = cuts.find(|flash| records(flash, 0).len() == 2).unwrap();
    assert_eq!(read(&flash), QUIET);
}

/// U-2, lifetime: a start that finds everything as it was writes nothing, also nothing to the log.
#[test]
fn a_usual_start_writes_nothing() {
    let mut flash = fixture::factory();
    flash.power_on(1, None);
    let before = flash.work();
    let end = Life::plain().live(&mut flash).end;
    assert!(matches!(end, End::Running(_)), "{end:?}");
    assert_eq!(flash.work(), before);
}

/// U-2, lifetime: a sector takes 170 changes between two erases, as `docs/boot.md` says.
#[test]
fn a_sector_takes_170_changes() {
    let (mut flash, mut store) = written(QUIET);
    let (erased, _) = flash.work();
    for version in 2..=170 {
        store.write(&mut flash, changed(version)).unwrap();
    }
    assert_eq!(flash.work().0, erased);
    assert_eq!(
        *EnvironmentStore::load(&mut flash).unwrap().get(),
        changed(170)
    );
    store.write(&mut flash, changed(171)).unwrap();
    assert!(flash.work().0 > erased);
    assert_eq!(
        *EnvironmentStore::load(&mut flash).unwrap().get(),
        changed(171)
    );
}

/// U-2: what confirms a record names its number and its checksum, so that no erased page and no
/// confirmation of another record does.
#[test]
fn a_confirmation_belongs_to_its_record() {
    let (mut flash, mut store) = written(QUIET);
    store.write(&mut flash, changed(2)).unwrap();
    for (slot, number, environment) in [(0, 1u32, QUIET), (1, 2, changed(2))] {
        let at = FlashRegion::Environment(0).range().start + slot * 96 + RECORD_BYTES as u32;
        let record = environment.encode(number);
        let mut expected = [&b"FIRM"[..], &number.to_le_bytes(), &record[60..]].concat();
        expected.resize(32, 0);
        assert_eq!(flash.firm(at, 32), Some(expected), "{slot}");
    }
}

/// U-2: a start that finds fewer than twelve slots left erases the sectors, so that the application
/// need not. With twelve it does not.
#[test]
fn a_start_leaves_slots_for_the_application() {
    for (changes, erases) in [(10, false), (157, false), (158, true), (169, true)] {
        let (mut flash, mut store) = written(QUIET);
        for version in 0..changes {
            store.write(&mut flash, changed(version)).unwrap();
        }
        flash.power_on(1, None);
        let before = flash.work().0;
        let loader = Loader::start(flash, fixture::setup(&[]), Instant::ORIGIN);
        let mut flash = loader.into_flash();
        assert_eq!(flash.work().0 > before, erases, "{changes}");
        let store = EnvironmentStore::load(&mut flash).unwrap();
        assert_eq!(*store.get(), changed(changes - 1));
    }
}

/// U-5: a start that acts on a trial or on an update of the bootloader first writes that again, so
/// that no torn page can be read as newer later. What only boots is not written.
#[test]
fn what_a_start_acts_on_is_written_again() {
    let on_trial = Environment {
        trial: Some(fixture::trial(Slot::B)),
        ..QUIET
    };
    let updating = |loader| Environment { loader, ..QUIET };
    for (environment, again) in [
        (QUIET, false),
        (updating(LoaderUpdate::BackupOnly), false),
        (updating(LoaderUpdate::Staged), true),
        (updating(LoaderUpdate::Sealing), true),
        (on_trial, true),
    ] {
        let (mut flash, _) = written(environment);
        let before = flash.work();
        let mut store = EnvironmentStore::load(&mut flash).unwrap();
        store.settle(&mut flash).unwrap();
        assert_eq!(flash.work() != before, again, "{environment:?}");
        let read = EnvironmentStore::load(&mut flash).unwrap();
        assert_eq!(*read.get(), environment);
    }
}

/// U-2: a change is written to the first copy, then to the second. A loss of power in between
/// leaves them different; the next start makes them equal, with a higher number.
#[test]
fn a_start_makes_the_copies_equal() {
    let mut flash = cut_after_the_first_copy();
    assert_eq!(records(&flash, 0), [(1, QUIET), (2, changed(2))]);
    assert_eq!(records(&flash, 1), [(1, QUIET)]);
    let mut store = EnvironmentStore::load(&mut flash).unwrap();
    assert_eq!(*store.get(), changed(2));
    store.settle(&mut flash).unwrap();
    assert_eq!(records(&flash, 1), [(1, QUIET), (3, changed(2))]);
    let newest = records(&flash, 0).pop();
    assert_eq!(newest, Some((3, changed(2))));
}

/// U-2: a first copy that cannot be written leaves the second one alone if that is current. If a
/// start acts on it, it is written too.
#[test]
fn a_copy_that_cannot_be_written_is_no_reason_to_touch_the_other() {
    let staged = Environment {
        loader: LoaderUpdate::Staged,
        ..QUIET
    };
    let (settled, _) = written(staged);
    for (mut flash, broken, written) in [(cut_after_the_first_copy(), 1, 0), (settled, 0, 1)] {
        for operation in [FlashOperation::Program, FlashOperation::Erase] {
            flash.fail(Failing {
                range: FlashRegion::Environment(broken).range(),
                operation,
                after: 0,
                times: u32::MAX,
            });
        }
        let before = records(&flash, 1 - broken);
        let mut store = EnvironmentStore::load(&mut flash).unwrap();
        store.settle(&mut flash).unwrap();
        let grown = records(&flash, 1 - broken).len() - before.len();
        assert_eq!(grown, written, "{before:?}");
    }
}
