//! The command that the other system would give, in the form that crosses the link. T-CHIP-5

use super::agreement::Stage;
use super::datagram::{PEER_COMMAND, is_sealed, seal};
use crate::driving::types::Command;
use tandem_bus::ModeCode;
use tandem_bus::e2e::Checker;

/// The command that a system would give, and whether it agrees with the other system.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct PeerCommand {
    /// The function that computed it; none while the command must not be compared yet.
    pub(super) mode: ModeCode,
    pub(super) stage: Stage,
    pub(super) command: Command,
}

const VERSION: u8 = 0;
/// Largest steering angle, rad, and acceleration, m/s², of an opinion: what a vehicle can follow.
/// An opinion is compared and never steers.
const STEERING_MAX: f32 = 0.61;
const ACCELERATION_MAX: f32 = 10.0;

impl PeerCommand {
    const WORDS: usize = 4;

    fn from_words(words: &[u32; Self::WORDS]) -> Option<Self> {
        let code = |code: u32| u8::try_from(code).ok();
        let number =
            |bits, limit| Some(f32::from_bits(bits)).filter(|value: &f32| value.abs() <= limit);
        let mode = code(words[1] & 0xFF)?;
        let stage = code(words[1] >> 8)?;
        Some(Self {
            mode: ModeCode::ALL.into_iter().find(|one| *one as u8 == mode)?,
            stage: Stage::ALL.into_iter().find(|one| *one as u8 == stage)?,
            command: Command {
                steering_angle: number(words[2], STEERING_MAX)?,
                acceleration: number(words[3], ACCELERATION_MAX)?,
            },
        })
    }
}

/// Both ends of these datagrams.
#[derive(Clone, Debug)]
pub(super) struct PeerCommandLink {
    counter: u8,
    checker: Checker,
}

impl PeerCommandLink {
    pub(super) const fn new() -> Self {
        Self {
            counter: 0,
            checker: Checker::new(PEER_COMMAND),
        }
    }

    /// Returns the datagram for a command that is sent now.
    pub(super) fn datagram(&mut self, own: PeerCommand) -> [u32; PeerCommand::WORDS] {
        let mut words = [
            0,
            own.mode as u32 | (own.stage as u32) << 8,
            own.command.steering_angle.to_bits(),
            own.command.acceleration.to_bits(),
        ];
        seal(PEER_COMMAND, VERSION, &mut self.counter, &mut words);
        words
    }

    /// Returns the command in a datagram; `None` if it holds another kind, or is not new.
    pub(super) fn on_datagram(&mut self, words: &[u32]) -> Option<PeerCommand> {
        let words: &[u32; PeerCommand::WORDS] = words.try_into().ok()?;
        let is_sealed = is_sealed(&mut self.checker, VERSION, words);
        PeerCommand::from_words(words).filter(|_| is_sealed)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn peer_command() -> PeerCommand {
        PeerCommand {
            mode: ModeCode::L3,
            stage: Stage::Disagreed,
            command: Command {
                steering_angle: -0.02,
                acceleration: 1.5,
            },
        }
    }

    /// T-CHIP-5: a command arrives once. A repeated or damaged one is refused, and so is one with
    /// values that no system sends.
    #[test]
    fn only_a_new_and_whole_command_is_accepted() {
        let (mut from, mut to) = (PeerCommandLink::new(), PeerCommandLink::new());
        let words = from.datagram(peer_command());
        assert_eq!(to.on_datagram(&words), Some(peer_command()));
        assert_eq!(to.on_datagram(&words), None, "repeated");
        let words = from.datagram(peer_command());
        assert_eq!(to.on_datagram(&words[..3]), None);
        for bit in 0..128 {
            let mut wrong = words;
            wrong[bit / 32] ^= 1 << (bit % 32);
            assert_eq!(to.clone().on_datagram(&wrong), None, "bit {bit}");
        }
        for strange in [f32::NAN, f32::INFINITY, 1e9, 900.0, 0.62, -10.1] {
            let mut strange_one = peer_command();
            match strange == 0.62 {
                true => strange_one.command.steering_angle = strange,
                false => strange_one.command.acceleration = strange,
            }
            let words = from.datagram(strange_one);
            assert_eq!(to.on_datagram(&words), None, "{strange}");
        }
    }
}
