//! A case: roles for some cores, and how a role fails.

use core::fmt;
use core::panic::Location;
use tandem_board::{Board, CoreId, SystemId};

/// A core of one of the systems.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Place {
    /// The system.
    pub system: SystemId,
    /// The core.
    pub core: CoreId,
}

impl Place {
    pub(crate) const A0: Self = Self {
        system: SystemId::A,
        core: CoreId::CONTROL,
    };
    pub(crate) const A1: Self = Self {
        system: SystemId::A,
        core: CoreId::PERCEPTION,
    };
    pub(crate) const A2: Self = Self {
        system: SystemId::A,
        core: CoreId::PLANNING,
    };
    pub(crate) const B0: Self = Self {
        system: SystemId::B,
        core: CoreId::CONTROL,
    };
    pub(crate) const B1: Self = Self {
        system: SystemId::B,
        core: CoreId::PERCEPTION,
    };
    pub(crate) const B2: Self = Self {
        system: SystemId::B,
        core: CoreId::PLANNING,
    };
}

impl fmt::Display for Place {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}{}", self.system, self.core)
    }
}

/// What one core does in a case. It is told which core it is meant to be.
pub type Role<B> = fn(&B, Place) -> Result<(), Failure>;

/// A role and the core that plays it.
#[derive(Clone, Copy, Debug)]
pub struct Part<B: 'static> {
    /// The core.
    pub place: Place,
    /// What it does.
    pub role: Role<B>,
}

/// What a case needs beside two systems with power.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Setting {
    /// Nothing; the watchdogs do not reset anybody.
    Plain,
    /// The watchdogs watch. A reset of a system that has a role is a failure; what happens to the
    /// other system does not matter.
    Watchdog,
    /// The watchdogs watch, and after a reset the rig runs the roles of that system again, in the
    /// next generation. The case has passed when every role has returned `Ok` in some life.
    Restarts,
    /// System A asks to be held in reset for good: its roles need not end. Those of system B must
    /// return `Ok`. The watchdogs do not reset anybody.
    Suspends,
}

/// One case of the suite.
#[derive(Clone, Copy, Debug)]
pub struct Case<B: 'static> {
    /// Unique, in words joined by hyphens; the first word is the part of the board.
    pub name: &'static str,
    /// What the case needs.
    pub setting: Setting,
    /// Who takes part.
    pub parts: &'static [Part<B>],
}

/// A contract that was broken, as one role saw it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Failure {
    /// The contract.
    pub what: &'static str,
    /// What was seen, and what should have been, if that is a number.
    pub numbers: Option<(u64, u64)>,
    /// The check that failed.
    pub at: &'static Location<'static>,
}

impl fmt::Display for Failure {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.what)?;
        if let Some((seen, expected)) = self.numbers {
            write!(
                f,
                ": saw {seen} ({seen:#x}), expected {expected} ({expected:#x})"
            )?;
        }
        write!(f, " [{}:{}]", self.at.file(), self.at.line())
    }
}

impl core::error::Error for Failure {}

/// Fails with `what`.
#[track_caller]
pub(crate) fn fail<T>(what: &'static str) -> Result<T, Failure> {
    Err(Failure {
        what,
        numbers: None,
        at: Location::caller(),
    })
}

/// Fails with `what` unless `holds`.
#[track_caller]
pub(crate) fn check(holds: bool, what: &'static str) -> Result<(), Failure> {
    if holds { Ok(()) } else { fail(what) }
}

/// Fails with `what` unless both numbers are the same.
#[track_caller]
pub(crate) fn equal(
    seen: impl Into<u64>,
    expected: impl Into<u64>,
    what: &'static str,
) -> Result<(), Failure> {
    let (seen, expected) = (seen.into(), expected.into());
    match seen == expected {
        true => Ok(()),
        false => Err(Failure {
            what,
            numbers: Some((seen, expected)),
            at: Location::caller(),
        }),
    }
}

/// Plays part `part` of case `case` of [`cases`](crate::cases): how a process or a hart that was
/// started for one role finds it.
///
/// # Errors
/// The [`Failure`] that the role saw, also if there is no such case or part.
pub fn run_role<B: Board + 'static>(case: usize, part: usize, board: &B) -> Result<(), Failure> {
    let cases = crate::cases::<B>();
    let found = cases.get(case).and_then(|case| case.parts.get(part));
    let Some(Part { place, role }) = found else {
        return fail("there is a case and a part with these numbers");
    };
    role(board, *place)
}
