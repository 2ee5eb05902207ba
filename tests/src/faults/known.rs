//! What is known to be violated, and why. Each is told in `docs/redundancy.md`.

use super::fault::Kind;
use super::judge::Violation;
use super::plan::Sequence;

impl Sequence {
    /// Why this is known to be violated; `None` if it must not be.
    #[must_use]
    pub fn known(&self, violation: Violation) -> Option<&'static str> {
        let has = |is: fn(Kind) -> bool| self.faults.iter().any(|fault| is(fault.kind));
        match violation {
            Violation::Gap if has(|kind| matches!(kind, Kind::Clock(..-100 | 101..))) => {
                Some("a clock that is far too slow or fast goes unnoticed")
            }
            _ => None,
        }
    }
}
