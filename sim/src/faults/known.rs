//! What is known to be violated, and why. Each is told in `docs/redundancy.md`.

use super::fault::{Kind, Way};
use super::judge::Violation;
use super::plan::Sequence;
use tandem_board::SystemId;
use tandem_board_sim::Wire;

impl Sequence {
    /// Why this is known to be violated; `None` if it must not be.
    #[must_use]
    pub fn known(&self, violation: Violation) -> Option<&'static str> {
        match violation {
            Violation::Changes if SystemId::ALL.iter().all(|of| self.loses_frames(*of)) => {
                Some("frames of both systems are lost or wrong, so each relieves the other rightly")
            }
            _ => None,
        }
    }

    /// Whether frames of this system are lost on CAN, or carry a wrong command.
    fn loses_frames(&self, of: SystemId) -> bool {
        self.faults.iter().any(|fault| {
            let loses = matches!(
                fault.kind,
                Kind::LosesSent(_)
                    | Kind::Mute
                    | Kind::WrongResults
                    | Kind::Cut(Wire::Can)
                    | Kind::Flap(Wire::Can, _)
            );
            loses && fault.way == Way::From(of)
        })
    }
}
