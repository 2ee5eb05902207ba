//! Flash that wears out, refuses operations, or is filled by files that are sent again and again.
#![allow(clippy::unwrap_used)]

mod fixture;

use fixture::{Images, factory, image, lives, loader};
use strum::VariantArray as _;
use tandem_boot::{Bank, EnvironmentStore, FlashRegion, ImageTarget, Slot, approve};
use tandem_boot_host::cuts::{CutCase, CutScenario, LifePlan, Stage};
use tandem_boot_host::life::{End, Life};
use tandem_boot_host::{Failing, FlashOperation, FlashTraits, SimulatedFlash, records};

/// Every region but the slots of the application, of which only one is whole before an update.
const REGIONS: [FlashRegion; 9] = [
    FlashRegion::Bank(Bank::Primary),
    FlashRegion::Bank(Bank::Backup),
    FlashRegion::Environment(0),
    FlashRegion::Environment(1),
    FlashRegion::Target(ImageTarget::Staging),
    FlashRegion::Target(ImageTarget::Application(Slot::B)),
    FlashRegion::Target(ImageTarget::Configuration(Slot::B)),
    FlashRegion::Log(0),
    FlashRegion::Log(1),
];

/// U-5: an operation that fails in one region, after any number of good ones, once or for good,
/// while a file is received or at any later start, leaves a controller that boots a whole image.
#[test]
fn an_operation_that_fails_bricks_nothing() {
    for &scenario in CutScenario::VARIANTS {
        let stage = Stage::new(CutCase::plain(scenario));
        for region in REGIONS {
            for &operation in FlashOperation::VARIANTS {
                // A damaged primary bank leaves only the backup: that one must be readable.
                let damaged = scenario == CutScenario::DamagedBootloader;
                let backup = region == FlashRegion::Bank(Bank::Backup);
                if damaged && backup && operation == FlashOperation::Read {
                    continue;
                }
                for (times, after) in [(1, 0), (1, 1), (1, 3), (u32::MAX, 0), (u32::MAX, 2)] {
                    let mut flash = SimulatedFlash::restore(stage.start()).unwrap();
                    flash.power_on(1, None);
                    flash.fail(Failing {
                        range: region.range(),
                        operation,
                        after,
                        times,
                    });
                    let plan = Life {
                        new_loader_crashes: scenario == CutScenario::CrashingBootloader,
                        ..Life::plain()
                    };
                    let mut first = plan.clone();
                    first.file = (!stage.lines().is_empty()).then_some((stage.lines(), 0));
                    let mut outcome = first.live(&mut flash);
                    let what = format!("{scenario:?} {region:?} {operation:?} {after} {times}");
                    for start in 0..4 {
                        let brick = stage.brick(&outcome, &mut flash);
                        assert_eq!(brick, None, "{what}, start {start}");
                        flash.power_on(2 + start, None);
                        outcome = plan.live(&mut flash);
                    }
                }
            }
        }
    }
}

/// U-5: the slot that boots cannot be read any more: the other one boots.
#[test]
fn an_unreadable_slot_is_replaced_by_the_other_one() {
    let Images { mut flash, .. } = Images::updated();
    for times in [1, u32::MAX] {
        flash.power_on(3, None);
        flash.fail(Failing {
            range: FlashRegion::Target(ImageTarget::Application(Slot::B)).range(),
            operation: FlashOperation::Read,
            after: 9,
            times,
        });
        assert!(matches!(lives(&mut flash, 3), End::Running(_)), "{times}");
    }
}

/// U-5: the active configuration is damaged: the other one is used, and stays.
#[test]
fn a_damaged_configuration_is_replaced_by_the_other_one() {
    let mut flash = factory();
    let lines = records("next", &[&fixture::configuration(Slot::B, 2)]);
    assert!(Life::with_file(&lines, 0).live(&mut flash).downloaded);
    for damaged in [false, true] {
        let place = FlashRegion::Target(ImageTarget::Configuration(Slot::B))
            .range()
            .start;
        if damaged {
            flash.load(place + 256, &[0xA5; 8]);
        }
        for _ in 0..2 {
            let End::Running(launch) = lives(&mut flash, 1) else {
                panic!("{damaged}");
            };
            let used = if damaged { Slot::A } else { Slot::B };
            assert_eq!(launch.configuration, Some(used));
        }
    }
}

/// U-5: the active image is whole, but crashes at each start: after eight starts the other slot
/// boots, and stays until the next power-on. An image on trial that crashes is rolled back at once.
#[test]
fn a_reset_loop_ends_in_the_other_slot() {
    let Images { mut flash, .. } = Images::updated();
    for (crashing, runs) in [(Slot::B, Slot::A), (Slot::A, Slot::B)] {
        for life in 0..3 {
            flash.power_on(life, None);
            let end = Life {
                crashing: Some(crashing),
                ..Life::plain()
            }
            .live(&mut flash)
            .end;
            let End::Running(launch) = end else {
                panic!("{crashing:?} {end:?}");
            };
            assert_eq!(launch.application, runs);
        }
    }
    let mut flash = factory();
    let lines = records("next", &[&image(Slot::B, 2, 40)]);
    let crashes = Life {
        crashing: Some(Slot::B),
        ..Life::with_file(&lines, 0)
    };
    let End::Running(launch) = crashes.live(&mut flash).end else {
        panic!("it boots");
    };
    assert_eq!(launch.application, Slot::A);
}

/// Sends `downloads` releases to a controller whose sectors last for `endurance` erases. Each life
/// must end in an application. Returns how many were accepted.
fn worn_out_by(downloads: u32, endurance: u32) -> u32 {
    let mut flash = factory().with_traits(FlashTraits {
        endurance: Some(endurance),
        ..FlashTraits::default()
    });
    let (mut slot, mut accepted) = (Slot::B, 0);
    for download in 0..downloads {
        let lines = records("next", &[&image(slot, 2 + download, 40)]);
        flash.power_on(u64::from(download), None);
        let outcome = Life::with_file(&lines, 0).live(&mut flash);
        let End::Running(launch) = outcome.end else {
            panic!("{download} {outcome:?}");
        };
        accepted += u32::from(outcome.downloaded);
        slot = launch.application.other();
    }
    accepted
}

/// U-5: downloads until every sector that they use is worn out, and then more: the controller
/// always boots.
#[test]
fn downloads_without_end_brick_nothing() {
    let accepted = worn_out_by(400, 30);
    assert!((60..400).contains(&accepted), "{accepted}");
}

/// U-5: the same with 10^5 downloads and the endurance of AURIX.
#[test]
#[ignore = "takes 20 minutes"]
fn a_hundred_thousand_downloads_brick_nothing() {
    let accepted = worn_out_by(100_000, 1_000);
    println!("{accepted} of 100000 downloads were accepted");
    assert!(accepted >= 2_000, "{accepted}");
}

/// U-5: one valid file that is sent again and again, over one connection or in many, erases nothing
/// after its first time.
#[test]
fn a_replayed_file_wears_nothing_out() {
    let mut flash = factory();
    let lines = records("next", &[&image(Slot::B, 2, 300)]);
    let unapproved = Life {
        approves: false,
        ..Life::with_file(&lines, 0)
    };
    assert!(unapproved.live(&mut flash).downloaded);
    let sector = FlashRegion::Target(ImageTarget::Application(Slot::B))
        .range()
        .start;
    let before = flash.erases()[&sector];
    for replay in 0..50 {
        flash.power_on(replay, None);
        assert!(matches!(unapproved.live(&mut flash).end, End::Running(_)));
    }
    assert_eq!(flash.erases()[&sector], before, "the slot was erased again");
}

/// U-5: a new bootloader for a bank that is worn out: the backup runs, for ever.
#[test]
fn a_worn_bank_leaves_the_backup() {
    for (bank, runs) in [(Bank::Primary, Bank::Backup), (Bank::Backup, Bank::Primary)] {
        let mut flash = factory().with_traits(FlashTraits {
            endurance: Some(1_000),
            ..FlashTraits::default()
        });
        flash.wear(FlashRegion::Bank(bank).range().start, 1_000);
        let lines = records("loader", &[&loader(2)]);
        assert!(Life::with_file(&lines, 0).live(&mut flash).downloaded);
        for start in 0..20 {
            flash.power_on(start, None);
            let end = Life::plain().live(&mut flash).end;
            assert!(matches!(end, End::Running(_)), "{bank:?} {start} {end:?}");
            assert_eq!(tandem_boot::rom_choice(&mut flash), Some(runs));
        }
        let erases = flash.erases()[&FlashRegion::Bank(bank).range().start];
        assert!(erases < 1_010, "erased at each start: {erases}");
    }
}

/// U-5: a life of a flash with an ECC is like one of a flash without.
#[test]
fn a_new_controller_with_an_ecc_boots() {
    let stage = Stage::new(CutCase {
        traits: FlashTraits::AURIX,
        ..CutCase::plain(CutScenario::Both)
    });
    let plan = LifePlan {
        acts: true,
        seed: 1,
        cut: None,
    };
    let (outcome, _, mut flash) = stage.live(stage.start(), plan).unwrap();
    assert!(outcome.downloaded);
    assert_eq!(stage.brick(&outcome, &mut flash), None);
}

/// U-2: the application never meets a full sector of the environment: a start makes room for the
/// records that an approval writes. The erase would hold core 2 up.
#[test]
fn an_approval_needs_no_erase() {
    for shift in 0..6 {
        let mut flash = factory();
        for _ in 0..shift {
            let mut store = EnvironmentStore::load(&mut flash).unwrap();
            let environment = *store.get();
            store.write(&mut flash, environment).unwrap();
        }
        for release in 2..60 {
            let slot = [Slot::B, Slot::A][release as usize % 2];
            let lines = records("new", &[&image(slot, release, 40)]);
            let life = Life {
                approves: false,
                ..Life::with_file(&lines, 8)
            };
            flash.power_on(release.into(), None);
            assert!(life.live(&mut flash).downloaded, "{release}");
            let before = flash.work().0;
            approve(&mut flash).unwrap();
            assert_eq!(flash.work().0, before, "{shift}: release {release} erased");
        }
    }
}
