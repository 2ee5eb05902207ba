//! One suite of tests that every board must pass: they test the contracts of `tandem-board`.
//!
//! A [`Case`] has one role for each core that takes part. A role is a plain function of a
//! [`Board`](tandem_board::Board): a rig can run it on a thread, in a separate process, or on a
//! hart. The roles of a case wait for each other through LMU words and lines, with time limits on
//! the board's clock.
//!
//! A rig prepares each case: both systems are freshly powered on (LMU zero, no edges counted,
//! generation 1, no fault), all boards of the case exist before its roles start or are made while
//! they start, the bus has no other node, and no watchdog is active unless [`Case::setting`] says
//! so. Cores without a role in the case do not run.
//!
//! Calls from handlers are tested outside the cases, because a portable role cannot be interrupted
//! at will: a rig whose board has handlers runs [`in_task`] in a loop, and [`Handler::run`] from an
//! interrupt.
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
