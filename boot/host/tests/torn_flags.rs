//! A torn write destroys the rollback of a loader that decides by flags; a sweep that cuts power
//! only between operations does not find this defect. Tandem's loader survives the same cuts.
//!
//! The loader here is a small model of a swap by flags. Each slot has a trailer with a magic number
//! and two flags, and a table maps combinations to actions. A combination that the table does not
//! list changes nothing. mcu-tools/mcuboot, issue 1966, describes this.
#![allow(clippy::unwrap_used)]

use embedded_storage::nor_flash::{NorFlash as _, ReadNorFlash as _};
use std::convert::Infallible;
use tandem_boot::PAGE_BYTES;
use tandem_boot_host::cuts::{CutCase, CutScenario, Stage, TickRange, sweep};
use tandem_boot_host::{ModelError, PROGRAM_TICKS, SimulatedFlash, Tear};

type Page = [u8; PAGE_BYTES];
const MAGIC: Page = [0x5A; PAGE_BYTES];
const SET: Page = [0x01; PAGE_BYTES];
const UNSET: Page = [0xFF; PAGE_BYTES];

/// The trailers of both slots, each a sector with magic number, "copied" and "approved"; and the
/// sector where the swap records that the old image is back in the first slot.
const FIRST: u32 = 0x04_0000;
const SECOND: u32 = 0x04_8000;
const RESTORED: u32 = 0x05_0000;

/// Returns the flash after an update whose image crashes: the first slot holds it, not approved.
fn crashed_update() -> SimulatedFlash {
    let mut flash = SimulatedFlash::new();
    flash.load(FIRST, &MAGIC);
    flash.load(FIRST + 32, &SET);
    flash
}

fn page(flash: &mut SimulatedFlash, at: u32) -> Result<Page, ModelError> {
    let mut page = UNSET;
    flash.read(at, &mut page)?;
    Ok(page)
}

/// Runs one start of the loader. Returns whether the old image runs.
fn start(flash: &mut SimulatedFlash) -> Result<bool, ModelError> {
    let trailer = |flash: &mut SimulatedFlash, at| -> Result<[Page; 3], ModelError> {
        Ok([
            page(flash, at)?,
            page(flash, at + 32)?,
            page(flash, at + 64)?,
        ])
    };
    let (first, second) = (trailer(flash, FIRST)?, trailer(flash, SECOND)?);
    if first == [MAGIC, SET, UNSET] && second[0] == UNSET {
        // Revert: set the trailer as for an update to the old image.
        flash.erase(SECOND, SECOND + 0x8000)?;
        flash.write(SECOND + 64, &SET)?;
        flash.write(SECOND, &MAGIC)?;
        return start(flash);
    }
    if second[0] == MAGIC && second[2] == SET {
        flash.erase(RESTORED, RESTORED + 0x8000)?;
        flash.write(RESTORED, &SET)?;
        flash.erase(SECOND, SECOND + 0x8000)?;
        flash.erase(FIRST, FIRST + 0x8000)?;
    }
    Ok(page(flash, RESTORED)? == SET)
}

/// Returns whether a controller that lost power at this tick never runs its old image again.
fn bricks(tick: u64, tear: Tear) -> bool {
    let mut flash = crashed_update();
    flash.power_on(tick, Some((tick, tear)));
    let _ = start(&mut flash);
    !(0..8).any(|life| {
        flash.power_on(life, None);
        start(&mut flash).unwrap()
    })
}

/// U-5
#[test]
fn torn_flags_brick_a_loader_that_believes_them_and_not_this_one() {
    let mut flash = crashed_update();
    flash.power_on(0, None);
    assert!(start(&mut flash).unwrap());
    let ticks = flash.ticks();
    // All operations have equally many moments; the first of each is between operations.
    let between = (0..ticks).step_by(PROGRAM_TICKS as usize);
    assert!(between.clone().count() > 4);
    assert!(
        between.into_iter().all(|tick| !bricks(tick, Tear::Clean)),
        "between operations"
    );
    assert!((0..ticks).any(|tick| bricks(tick, Tear::Clean)), "torn");

    let stage = Stage::new(CutCase::plain(CutScenario::Rollback));
    let live = |flash: &[u8], step| Ok::<_, Infallible>(stage.live(flash, step).unwrap());
    let swept = sweep(&stage, TickRange { from: 0, every: 7 }, live).unwrap();
    assert!(swept.points > 50);
    assert_eq!(swept.bricks, Vec::<String>::new());
}
