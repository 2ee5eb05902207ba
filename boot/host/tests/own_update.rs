//! The steps of an update of the bootloader itself, each from a flash that is made for it.
#![allow(clippy::unwrap_used)]

mod fixture;

use fixture::{body, factory};
use tandem_board::{Instant, ResetCause};
use tandem_boot::{
    Bank, Environment, EnvironmentStore, FlashRegion, ImageTarget, Loader, LoaderUpdate, Next,
};
use tandem_boot_host::life::{TEST_KEY, TEST_PUBLIC};
use tandem_boot_host::{Failing, FlashOperation, Image, ReleaseInfo, SimulatedFlash};

/// A bootloader whose length is no multiple of a page.
fn loader(version: u32) -> Image {
    let release = ReleaseInfo {
        version,
        entries: [256; 3],
        ..ReleaseInfo::default()
    };
    Image::sign(
        ImageTarget::Staging,
        release,
        &[(256, &body(version, 333))],
        &TEST_KEY,
    )
}

/// Returns a controller with bootloader 1 in the primary bank, 0 in the backup bank, and this one
/// in staging. `lowest`: the lowest version that is not refused.
fn controller(staged: &Image, state: LoaderUpdate, lowest: u32) -> SimulatedFlash {
    let mut flash = factory();
    flash.load(staged.place(), &staged.bytes);
    for (bank, version) in [(Bank::Primary, 1), (Bank::Backup, 0)] {
        let start = FlashRegion::Bank(bank).range().start;
        flash.load(start, &loader(version).bytes);
    }
    flash.power_on(1, None);
    let mut store = EnvironmentStore::load(&mut flash).unwrap();
    let [application, configuration, _] = store.get().versions;
    let environment = Environment {
        loader: state,
        versions: [application, configuration, lowest],
        ..*store.get()
    };
    store.write(&mut flash, environment).unwrap();
    flash
}

/// Starts the bootloader in a bank. Returns what it wants next, the state of the update, and the
/// version in each bank, if that is whole.
fn start(flash: SimulatedFlash, bank: Bank) -> (Next, LoaderUpdate, [Option<u32>; 2]) {
    const KEYS: [[u8; 32]; 1] = [TEST_PUBLIC];
    let mut setup = fixture::setup(&KEYS);
    (setup.bank, setup.cause) = (bank, ResetCause::Watchdog);
    let mut loader = Loader::start(flash, setup, Instant::ORIGIN);
    let next = loader.next(Instant::ORIGIN);
    let mut flash = loader.into_flash();
    let state = EnvironmentStore::load(&mut flash).unwrap().get().loader;
    let versions = [Bank::Primary, Bank::Backup].map(|bank| version_in(&flash, bank));
    (next, state, versions)
}

fn version_in(flash: &SimulatedFlash, bank: Bank) -> Option<u32> {
    let start = FlashRegion::Bank(bank).range().start;
    (0..10).find(|version| {
        let image = self::loader(*version);
        flash.firm(start, image.bytes.len() as u32) == Some(image.bytes)
    })
}

fn damaged(mut image: Image) -> Image {
    image.bytes[300] ^= 1;
    image
}

/// U-4, U-5: what is staged is installed if it is whole and not older than what was approved. First
/// the running bootloader is copied to the backup bank.
#[test]
fn a_staged_bootloader_is_installed_if_it_is_whole_and_not_old() {
    for (staged, lowest, installs) in [
        (loader(2), 1, true),
        (loader(2), 2, true),
        (loader(2), 3, false),
        (damaged(loader(2)), 1, false),
        (damaged(loader(2)), 3, false),
    ] {
        let version = staged.manifest.version;
        let flash = controller(&staged, LoaderUpdate::Staged, lowest);
        let (next, state, versions) = start(flash, Bank::Primary);
        let what = format!("{version} of {lowest}: {next:?}");
        if installs {
            assert_eq!(next, Next::StartBank(Bank::Backup), "{what}");
            assert_eq!((state, versions), (LoaderUpdate::Installing, [Some(1); 2]));
        } else {
            assert!(matches!(next, Next::Jump(_)), "{what}");
            assert_eq!((state, versions), (LoaderUpdate::Idle, [Some(1), Some(0)]));
        }
    }
    // The backup that runs is the one that stays.
    let flash = controller(&loader(2), LoaderUpdate::Staged, 1);
    let (next, state, [_, backup]) = start(flash, Bank::Backup);
    assert_eq!(
        (next, state, backup),
        (Next::Reset, LoaderUpdate::Trial, Some(0))
    );
}

/// U-4: if the backup bank cannot be written, nothing is installed, and the bootloader that runs
/// stays what it is.
#[test]
fn without_a_backup_nothing_is_installed() {
    let mut flash = controller(&loader(2), LoaderUpdate::Staged, 1);
    flash.fail(Failing {
        range: FlashRegion::Bank(Bank::Backup).range(),
        operation: FlashOperation::Program,
        after: 0,
        times: u32::MAX,
    });
    let (next, state, [primary, _]) = start(flash, Bank::Primary);
    assert!(matches!(next, Next::Jump(_)), "{next:?}");
    assert_eq!((state, primary), (LoaderUpdate::Idle, Some(1)));
}

/// U-4: a damaged primary bank gets the staged bootloader if that is the approved one, else the
/// backup.
#[test]
fn a_damaged_bank_gets_the_approved_bootloader() {
    for (staged, lowest, expected) in [
        (loader(2), 2, 2),
        (loader(3), 2, 0),
        (damaged(loader(2)), 2, 0),
        (damaged(loader(3)), 2, 0),
    ] {
        let mut flash = controller(&staged, LoaderUpdate::Idle, lowest);
        let primary = FlashRegion::Bank(Bank::Primary).range().start;
        flash.load(primary + 288, &[0; 32]);
        let (next, state, versions) = start(flash, Bank::Backup);
        assert_eq!((next, state), (Next::Reset, LoaderUpdate::Idle));
        assert_eq!(versions, [Some(expected), Some(0)], "{lowest}");
    }
}
