//! How the environment uses its sectors, and what a start writes once more.
#![allow(clippy::unwrap_used)]

use tandem_boot::{Environment, EnvironmentStore, LoaderUpdate, Selection, Slot, Trial};
use tandem_boot_host::SimulatedFlash;

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

/// U-2, lifetime: a sector takes 170 changes between two erases, as `docs/boot.md` says.
#[test]
fn a_sector_takes_170_changes() {
    let (mut flash, mut store) = written(QUIET);
    let change = |version| Environment {
        versions: [version, 0, 0],
        ..QUIET
    };
    let (erased, _) = flash.work();
    for version in 2..=170 {
        store.write(&mut flash, change(version)).unwrap();
    }
    assert_eq!(flash.work().0, erased);
    assert_eq!(
        *EnvironmentStore::load(&mut flash).unwrap().get(),
        change(170)
    );
    store.write(&mut flash, change(171)).unwrap();
    assert!(flash.work().0 > erased);
    assert_eq!(
        *EnvironmentStore::load(&mut flash).unwrap().get(),
        change(171)
    );
}

/// U-5: a start that acts on a trial or on an update of the bootloader first writes that again, so
/// that no torn page can be read as newer later. What only boots is not written.
#[test]
fn what_a_start_acts_on_is_written_again() {
    let trial = Trial {
        selection: Selection {
            application: Some(Slot::B),
            configuration: None,
        },
        executed: false,
        ready: false,
        authentic: true,
    };
    let on_trial = Environment {
        trial: Some(trial),
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
