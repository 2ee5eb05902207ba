//! Power is lost at points of every scenario; the whole sweep is `cargo xtask campaign power-cuts`.
#![allow(clippy::unwrap_used)]

use std::convert::Infallible;
use tandem_boot_host::cuts::{Defect, Scenario, Stage, Swept, Ticks, sweep};

fn swept(scenario: Scenario, defect: Option<Defect>) -> Swept {
    let stage = Stage::new(scenario, defect);
    let ticks = Ticks { from: 0, every: 29 };
    let live = |flash: &[u8], step| Ok::<_, Infallible>(stage.live(flash, step).unwrap());
    sweep(&stage, ticks, live).unwrap()
}

fn no_bricks(scenario: Scenario) {
    let swept = swept(scenario, None);
    assert!(swept.points > 10, "{swept:?}");
    assert_eq!(swept.bricks, Vec::<String>::new());
}

/// U-5
#[test]
fn no_cut_bricks_an_update_of_the_application() {
    no_bricks(Scenario::Application);
    no_bricks(Scenario::Both);
}

/// U-3, U-5
#[test]
fn no_cut_bricks_a_rollback() {
    no_bricks(Scenario::Rollback);
    no_bricks(Scenario::RefusedFile);
}

/// U-4, U-5
#[test]
fn no_cut_bricks_an_update_of_the_bootloader() {
    no_bricks(Scenario::Bootloader);
    no_bricks(Scenario::CrashingBootloader);
}

/// U-2, U-5
#[test]
fn no_cut_bricks_a_repair() {
    no_bricks(Scenario::DamagedBootloader);
    no_bricks(Scenario::LostEnvironment);
}

/// U-5: the sweep finds what it looks for. With one slot, or one bank, there are bricks.
#[test]
fn a_loader_with_one_slot_or_one_bank_bricks() {
    assert!(
        !swept(Scenario::Application, Some(Defect::OneSlot))
            .bricks
            .is_empty()
    );
    assert!(
        !swept(Scenario::Bootloader, Some(Defect::OneBank))
            .bricks
            .is_empty()
    );
}
