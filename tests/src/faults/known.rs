//! What is known to be violated, and why. Each is told in `docs/redundancy.md`.

use super::fault::Kind;
use super::judge::Violation;
use super::plan::{Group, Sequence};

impl Sequence {
    /// Why this is known to be violated; `None` if it must not be.
    #[must_use]
    pub fn known(&self, violation: Violation) -> Option<&'static str> {
        use Violation as V;
        let has = |is: fn(Kind) -> bool| self.faults.iter().any(|fault| is(fault.kind));
        let flaps = has(|kind| matches!(kind, Kind::Flap(..)));
        let misses = has(|kind| matches!(kind, Kind::LosesHeard(_)));
        let level = has(|kind| matches!(kind, Kind::LevelLow | Kind::LevelGlitch(_)));
        match violation {
            V::Gap | V::BothSuspended if has(|kind| kind == Kind::Poison) => {
                Some("both systems run the same software")
            }
            V::Changes | V::FlashWorn | V::Needless if flaps => {
                Some("a line that flaps is believed each time")
            }
            V::Needless if misses => Some("a standby that misses frames takes over"),
            V::Needless if level => Some("a level line is believed against two other witnesses"),
            V::Gap if has(|kind| matches!(kind, Kind::Clock(..-100 | 101..))) => {
                Some("a clock that is far too slow or fast goes unnoticed")
            }
            V::Gap if self.group == Group::Pair => {
                Some("the worse system may win, for as long as it takes to depose it")
            }
            _ => None,
        }
    }
}
