//! The rig of the conformance suite. For each case, both systems are switched on again.
//!
//! The carrier's hart is the rig. It prints one line for each case, and one at the end; the status
//! is the number of cases that failed.

use crate::board::{VirtBoard, run};
use crate::interrupts::TICK_NS;
use crate::peripherals::Peripherals;
use crate::{exit, hart, log};
use core::fmt;
use core::sync::atomic::{AtomicU32, Ordering};
use tandem_board::{Board, CoreAddress, SystemId};
use tandem_board_conformance::{Case, CaseOutcome, Rig, Setting, run_all, run_role};
use tandem_peripherals::supply::Change;

/// Length of a turn, 100 us, so that roles that spin do not starve the others.
const SLICE_TICKS: u32 = 1_000;
/// A case that takes longer than this has hung. No role waits as long as this.
const HANGS_AFTER_TICKS: u64 = 60_000_000_000 / TICK_NS;

/// The current case.
static CASE: AtomicU32 = AtomicU32::new(0);
/// The result of the role of each hart.
static RESULTS: [AtomicU32; CoreAddress::COUNT] = [const { AtomicU32::new(0) }; CoreAddress::COUNT];
const RUNS: u32 = 0;
const PASSED: u32 = 1;
const FAILED: u32 = 2;

/// Runs the suite: the main of every hart.
pub fn main(hart: usize) -> ! {
    run(hart, SLICE_TICKS, play_role, play_all)
}

fn result_of(place: CoreAddress) -> &'static AtomicU32 {
    &RESULTS[place.index()]
}

/// Runs on each core, in each of its incarnations.
fn play_role(board: &VirtBoard) {
    let case = CASE.load(Ordering::Relaxed) as usize;
    let place = board.identity().address();
    let parts = tandem_board_conformance::cases::<VirtBoard>()[case].parts;
    let Some(part) = parts.iter().position(|part| part.place == place) else {
        return;
    };
    let result = match run_role(case, part, board) {
        Ok(()) => PASSED,
        Err(failure) => {
            log!("{place}: {failure}");
            FAILED
        }
    };
    // Release pairs with the Acquire in the rig.
    result_of(place).store(result, Ordering::Release);
}

/// Why a case did not pass. The lines before it in the log show the failure of the role.
enum Fault {
    Failed(CoreAddress),
    Hung,
    Reset(SystemId),
}

impl fmt::Display for Fault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Failed(place) => write!(f, "{place} failed"),
            Self::Hung => f.write_str("a role does not end"),
            Self::Reset(system) => write!(f, "system {system} was reset"),
        }
    }
}

struct VirtRig<'c> {
    peripherals: &'c mut Peripherals,
}

impl VirtRig<'_> {
    fn outcome(&mut self, case: &Case<VirtBoard>) -> Result<(), Fault> {
        let until = hart::time() + HANGS_AFTER_TICKS;
        let awaited = |place: CoreAddress| {
            result_of(place).load(Ordering::Acquire) != PASSED
                && !(case.setting == Setting::Suspends && place.system == SystemId::A)
        };
        while case.parts.iter().any(|part| awaited(part.place)) {
            let failed = |place: CoreAddress| result_of(place).load(Ordering::Acquire) == FAILED;
            if let Some(part) = case.parts.iter().find(|part| failed(part.place)) {
                return Err(Fault::Failed(part.place));
            }
            // Polls at least every millisecond.
            match self.peripherals.step(hart::time() + 10_000) {
                Some((system, Change::Reset(_)))
                    if !case.setting.restarts()
                        && case.parts.iter().any(|part| part.place.system == system) =>
                {
                    return Err(Fault::Reset(system));
                }
                _ if hart::time() > until => return Err(Fault::Hung),
                _ => {}
            }
        }
        Ok(())
    }
}

impl Rig for VirtRig<'_> {
    type Board = VirtBoard;
    type Fault = Fault;

    fn takes(&self, _: &Case<VirtBoard>) -> bool {
        true
    }

    fn play(&mut self, index: usize, case: &Case<VirtBoard>) -> Result<(), Fault> {
        CASE.store(index as u32, Ordering::Relaxed);
        for result in &RESULTS {
            result.store(RUNS, Ordering::Relaxed);
        }
        self.peripherals.set_watchdogs(case.setting.watches());
        for system in SystemId::ALL {
            self.peripherals.renew(system);
        }
        self.peripherals.power_on(&SystemId::ALL);
        let outcome = self.outcome(case);
        for system in SystemId::ALL {
            self.peripherals.power_off(system);
        }
        outcome
    }
}

fn play_all(peripherals: &mut Peripherals) -> ! {
    for system in SystemId::ALL {
        peripherals.power_off(system);
    }
    peripherals.connect_stations();
    let summary = run_all(
        &mut VirtRig { peripherals },
        |case, outcome| match outcome {
            CaseOutcome::Passed => log!("ok      {}", case.name),
            CaseOutcome::Skipped => log!("skipped {}", case.name),
            CaseOutcome::Failed(fault) => log!("FAILED  {}: {fault}", case.name),
        },
    );
    log!(
        "{} passed, {} failed, {} skipped",
        summary.passed,
        summary.failed,
        summary.skipped
    );
    exit::exit(summary.failed as u16)
}
