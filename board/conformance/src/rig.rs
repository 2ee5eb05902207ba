//! Runs the suite on a board.

use crate::case::{Case, CaseFailure, CasePart, Setting, fail};
use crate::cases::cases;
use core::fmt::Display;
use tandem_board::{CoreId, FaultSource};

/// Runs cases on one kind of board.
pub trait Rig {
    /// The board.
    type Board: FaultSource + 'static;
    /// Why a case failed: the role that failed, hung or died.
    type Fault: Display;

    /// Returns whether this rig supports the case's setting.
    fn takes(&self, case: &Case<Self::Board>) -> bool;

    /// Powers on both systems, runs all parts of the case at the same time, and switches off.
    /// `index` is the case's index in [`cases`], for [`run_role`].
    ///
    /// # Errors
    /// The first fault, if a role fails or does not end.
    fn play(&mut self, index: usize, case: &Case<Self::Board>) -> Result<(), Self::Fault>;
}

/// How a case ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CaseOutcome<F> {
    /// Every role returned `Ok`.
    Passed,
    /// The rig does not support the case's setting.
    Skipped,
    /// A role failed, hung or died.
    Failed(F),
}

/// How many cases passed, were skipped, or failed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Summary {
    /// Passed.
    pub passed: u32,
    /// Skipped.
    pub skipped: u32,
    /// Failed.
    pub failed: u32,
}

/// Runs all cases in order and calls `report` for each.
pub fn run_all<R: Rig>(
    rig: &mut R,
    mut report: impl FnMut(&Case<R::Board>, &CaseOutcome<R::Fault>),
) -> Summary {
    let mut summary = Summary::default();
    for (index, case) in cases::<R::Board>().iter().enumerate() {
        let outcome = match rig.takes(case) {
            false => CaseOutcome::Skipped,
            true => match rig.play(index, case) {
                Ok(()) => CaseOutcome::Passed,
                Err(fault) => CaseOutcome::Failed(fault),
            },
        };
        match outcome {
            CaseOutcome::Passed => summary.passed += 1,
            CaseOutcome::Skipped => summary.skipped += 1,
            CaseOutcome::Failed(_) => summary.failed += 1,
        }
        report(case, &outcome);
    }
    summary
}

/// Runs part `part` of case `case` of [`cases`], for a process or a hart that runs a single role.
/// On core 0 it releases the other cores first, unless the case tests the release.
///
/// # Errors
/// The [`CaseFailure`] that the role returned, or one for a case or part that does not exist.
pub fn run_role<B: FaultSource + 'static>(
    case: usize,
    part: usize,
    board: &B,
) -> Result<(), CaseFailure> {
    let cases = cases::<B>();
    let case = cases.get(case);
    let found = case.and_then(|case| Some((case.setting, case.parts.get(part)?)));
    let Some((setting, CasePart { place, role })) = found else {
        return fail("there is a case and a part with these numbers");
    };
    if place.core == CoreId::CONTROL && setting != Setting::Releases {
        board.release_core(CoreId::PERCEPTION);
        board.release_core(CoreId::PLANNING);
    }
    role(board, *place)
}
