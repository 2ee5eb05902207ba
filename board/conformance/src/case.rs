//! A case: roles for some cores, and how a role fails.

use core::fmt;
use core::panic::Location;
use tandem_board::CoreAddress;

/// The function of one core in a case. Its argument is the core that should run it.
pub type CaseRole<B> = fn(&B, CoreAddress) -> Result<(), CaseFailure>;

/// A role and the core that runs it.
#[derive(Clone, Copy, Debug)]
pub struct CasePart<B: 'static> {
    /// The core.
    pub place: CoreAddress,
    /// Its function.
    pub role: CaseRole<B>,
}

/// What a case needs in addition to two systems with power.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Setting {
    /// Nothing more; the watchdogs reset no system.
    Plain,
    /// The watchdogs are active. A reset of a system that has a role is a failure; the state of a
    /// system without a role does not matter.
    Watchdog,
    /// The watchdogs are active, and after a reset the rig runs the roles of that system again, in
    /// the next generation. The case passes when every role has returned `Ok` in some incarnation.
    Restarts,
    /// Like [`Setting::Restarts`], but the role of core 0 releases the other cores. In all other
    /// settings they are released before that role begins.
    Releases,
    /// System A requests to be held in reset: its roles need not end. The roles of system B must
    /// return `Ok`. The watchdogs reset no system.
    Suspends,
}

impl Setting {
    /// Returns whether the watchdogs are active.
    #[must_use]
    pub const fn watches(self) -> bool {
        matches!(self, Self::Watchdog | Self::Restarts | Self::Releases)
    }

    /// Returns whether a system with a role may be reset, after which its roles run again.
    #[must_use]
    pub const fn restarts(self) -> bool {
        matches!(self, Self::Restarts | Self::Releases)
    }
}

/// One case of the suite.
#[derive(Clone, Copy, Debug)]
pub struct Case<B: 'static> {
    /// Unique name of words joined by hyphens; the first word names the part of the board.
    pub name: &'static str,
    /// What the case needs.
    pub setting: Setting,
    /// The cores that take part, with their roles.
    pub parts: &'static [CasePart<B>],
}

/// A broken contract, as one role observed it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct CaseFailure {
    /// The contract.
    pub what: &'static str,
    /// The observed and the expected value, if they are numbers.
    pub numbers: Option<(u64, u64)>,
    /// The check that failed.
    pub at: &'static Location<'static>,
}

impl fmt::Display for CaseFailure {
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

impl core::error::Error for CaseFailure {}

/// Returns a failure with `what`.
#[track_caller]
pub(crate) fn fail<T>(what: &'static str) -> Result<T, CaseFailure> {
    Err(CaseFailure {
        what,
        numbers: None,
        at: Location::caller(),
    })
}

/// Returns a failure with `what` unless `holds` is true.
#[track_caller]
pub(crate) fn check(holds: bool, what: &'static str) -> Result<(), CaseFailure> {
    if holds { Ok(()) } else { fail(what) }
}

/// Returns a failure with `what` unless both numbers are equal.
#[track_caller]
pub(crate) fn equal(
    seen: impl Into<u64>,
    expected: impl Into<u64>,
    what: &'static str,
) -> Result<(), CaseFailure> {
    let (seen, expected) = (seen.into(), expected.into());
    match seen == expected {
        true => Ok(()),
        false => Err(CaseFailure {
            what,
            numbers: Some((seen, expected)),
            at: Location::caller(),
        }),
    }
}
