//! Runs one case of the conformance suite at each start of the machine.
//!
//! Strap 0 is the case's number. The status is 0 if it passed, 1 if a role failed, [`SKIPPED`] if
//! this machine cannot run it, [`NO_SUCH_CASE`] if it does not exist. The log gives the reason.
#![no_std]
#![no_main]
#![deny(unsafe_code)]

use core::sync::atomic::{AtomicU32, Ordering};
use tandem_board_conformance::{Case, Setting, cases, run_role};
use tandem_board_mps2_an521::board::{An521Board, Cast};
use tandem_board_mps2_an521::{cpu, entry, exit, log, straps};

entry!(main);

/// The status for a case that this machine cannot run.
const SKIPPED: u8 = 2;
/// The status if there is no case with this number.
const NO_SUCH_CASE: u8 = 3;

/// Number of roles that have passed.
static PASSED: AtomicU32 = AtomicU32::new(0);

/// Returns why this machine cannot run the case; `None` if it can.
fn refusal(case: &Case<An521Board>) -> Option<&'static str> {
    if case.parts.len() > cpu::CPUS {
        return Some("needs more than two cores");
    }
    if case.name.starts_with("flash-") {
        return Some("the machine has no data flash");
    }
    if case.name.starts_with("network-") {
        return Some("the board does not use the machine's Ethernet port");
    }
    if case.name.starts_with("fault-") {
        return Some("the hardware of the machine has no faults");
    }
    match case.setting {
        Setting::Plain => None,
        Setting::Watchdog => Some("the machine has no window watchdog"),
        Setting::Restarts | Setting::Releases => {
            Some("the machine resets only as a whole, and forgets why")
        }
        Setting::Suspends => Some("both systems share the power of the one machine"),
    }
}

fn main(own: usize) -> ! {
    let index = straps::strap(0) as usize;
    let cases = cases::<An521Board>();
    let Some(case) = cases.get(index) else {
        exit::exit(NO_SUCH_CASE)
    };
    if let Some(why) = refusal(case) {
        if own == 0 {
            log!("skipped {}: {why}", case.name);
            exit::exit(SKIPPED);
        }
        rest()
    }
    let cast: Cast = core::array::from_fn(|part| Some(case.parts.get(part)?.place));
    let Some(board) = An521Board::new(cast) else {
        rest()
    };
    if let Err(failure) = run_role(index, own, &board) {
        log!(
            "FAILED  {}: {}: {failure}",
            case.name,
            case.parts[own].place
        );
        exit::exit(1);
    }
    // AcqRel: the last processor to pass sees everything that the other one did.
    let passed = 1 + PASSED.fetch_add(1, Ordering::AcqRel);
    if passed as usize == case.parts.len() {
        log!("passed  {}", case.name);
        exit::exit(0);
    }
    rest()
}

/// Sleeps for the rest of the run: this processor has no more work.
fn rest() -> ! {
    loop {
        cpu::sleep();
    }
}
