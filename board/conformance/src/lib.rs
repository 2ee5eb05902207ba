//! One suite that every board must pass: tests of the contracts of `tandem-board`.
//!
//! A [`Case`] has one role for each core that takes part, and a role is a plain function over a
//! [`Board`](tandem_board::Board): a rig can run it on a thread, in a process started for it, or on
//! a hart. The roles of a case wait for each other through LMU words and lines, with time limits on
//! the board's clock.
//!
//! A rig gives each case: both systems freshly powered on (LMU zero, no edges counted, generation
//! 1, no fault), all boards of the case made before or while its roles start, no other node on the
//! bus, and no watchdog unless [`Case::setting`] says so. Cores without a role in the case are
//! absent.
//!
//! Calls from handlers are tested outside the cases, because a portable role cannot be interrupted
//! on purpose: a rig whose board has handlers runs [`in_task`] in a loop, and [`Handler::run`] from
//! an interrupt.
//!
//! ```text
//! for each case in cases::<B>():        run_all(&mut rig, report)
//!     rig: power on; for each of case.parts: run_role(case, part, &board) → Result<(), Failure>
//! ```
#![no_std]
#![forbid(unsafe_code)]

mod barrier;
mod case;
mod cases;
mod context;
mod rig;

pub use case::{Case, CaseFailure, CasePart, CaseRole, Setting};
pub use cases::{case_of, cases};
pub use context::{Handler, in_task};
pub use rig::{CaseOutcome, Rig, Summary, run_all, run_role};
