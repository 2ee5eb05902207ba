//! Power is lost at points of every scenario; the whole sweep is `cargo xtask campaign power-cuts`.
#![allow(clippy::unwrap_used)]

use std::convert::Infallible;
use strum::VariantArray as _;
use tandem_boot_host::FlashTraits;
use tandem_boot_host::cuts::{CutCase, CutScenario, Stage, Swept, TickRange, WiringDefect, sweep};

fn swept(case: CutCase) -> Swept {
    let stage = Stage::new(case);
    let ticks = TickRange {
        from: 0,
        every: 101,
    };
    let live = |flash: &[u8], step| Ok::<_, Infallible>(stage.live(flash, step).unwrap());
    sweep(&stage, ticks, live).unwrap()
}

fn no_bricks(scenario: CutScenario) {
    let swept = swept(CutCase::plain(scenario));
    assert!(swept.points > 10, "{swept:?}");
    assert_eq!(swept.bricks, Vec::<String>::new());
}

fn broken(scenario: CutScenario, defect: WiringDefect) -> CutCase {
    CutCase {
        defect: Some(defect),
        ..CutCase::plain(scenario)
    }
}

/// U-5: also with a flash that erases to 0, and whose torn and erased pages cannot be read.
#[test]
fn no_cut_bricks_a_flash_with_an_ecc() {
    for &scenario in CutScenario::VARIANTS {
        let swept = swept(CutCase {
            traits: FlashTraits::AURIX,
            ..CutCase::plain(scenario)
        });
        assert!(swept.points > 10, "{swept:?}");
        assert_eq!(swept.bricks, Vec::<String>::new(), "{scenario:?}");
    }
}

/// U-5
#[test]
fn no_cut_bricks_an_update_of_the_application() {
    no_bricks(CutScenario::Application);
    no_bricks(CutScenario::Both);
}

/// U-3, U-5
#[test]
fn no_cut_bricks_a_rollback() {
    no_bricks(CutScenario::Rollback);
    no_bricks(CutScenario::RefusedFile);
}

/// U-4, U-5
#[test]
fn no_cut_bricks_an_update_of_the_bootloader() {
    no_bricks(CutScenario::Bootloader);
    no_bricks(CutScenario::CrashingBootloader);
}

/// U-2, U-5
#[test]
fn no_cut_bricks_a_repair() {
    no_bricks(CutScenario::DamagedBootloader);
    no_bricks(CutScenario::LostEnvironment);
}

/// U-5: the sweep finds bricks if there is only one slot or only one bank.
#[test]
fn a_loader_with_one_slot_or_one_bank_bricks() {
    assert!(
        !swept(broken(CutScenario::Application, WiringDefect::OneSlot))
            .bricks
            .is_empty()
    );
    assert!(
        !swept(broken(CutScenario::Bootloader, WiringDefect::OneBank))
            .bricks
            .is_empty()
    );
}
