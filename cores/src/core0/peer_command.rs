//! The command that the other system would give, and its scene, in the form that crosses the link.
//! T-CHIP-5

use super::agreement::Stage;
use super::datagram::{PEER_COMMAND, is_sealed, seal};
use super::scene_check::PeerScene;
use crate::driving::types::{Command, Ego};
use tandem_board::{Duration, Instant};
use tandem_bus::ModeCode;
use tandem_bus::e2e::Checker;

/// The command that a system would give, and whether it agrees with the other system.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct PeerCommand {
    /// The function that computed it; none while the command must not be compared yet.
    pub(super) mode: ModeCode,
    pub(super) stage: Stage,
    pub(super) command: Command,
    /// The SoC that it follows, see [`soc_code`](super::topics::soc_code); 0 if none.
    pub(super) soc: u16,
    /// When it begins its next control cycle: the low word of the vehicle's time, ns; 0 if it has
    /// no time.
    pub(super) next_cycle: u32,
    /// Its newest scene with a lane, if that is at most [`OLDEST`] old.
    pub(super) scene: Option<PeerScene>,
}

const VERSION: u8 = 1;
/// An older scene is not sent.
const OLDEST: Duration = Duration::from_ms(150);
/// In place of a scene's age.
const NO_SCENE: u32 = u32::MAX;
/// Largest steering angle, rad, and acceleration, m/s², of an opinion: what a vehicle can follow.
/// An opinion is compared and never steers.
const STEERING_MAX: f32 = 0.61;
const ACCELERATION_MAX: f32 = 10.0;

impl PeerCommand {
    /// The command, the age of the scene, its line, its motion, and the next control cycle.
    const WORDS: usize = 4 + 1 + 4 + 4 + 1;

    fn from_words(now: Instant, words: &[u32; Self::WORDS]) -> Option<Self> {
        let code = |code: u32| u8::try_from(code).ok();
        let number =
            |bits, limit| Some(f32::from_bits(bits)).filter(|value: &f32| value.abs() <= limit);
        let mode = code(words[1] & 0xFF)?;
        let stage = code(words[1] >> 8 & 0xFF)?;
        Some(Self {
            mode: ModeCode::ALL.into_iter().find(|one| *one as u8 == mode)?,
            stage: Stage::ALL.into_iter().find(|one| *one as u8 == stage)?,
            command: Command {
                steering_angle: number(words[2], STEERING_MAX)?,
                acceleration: number(words[3], ACCELERATION_MAX)?,
            },
            soc: (words[1] >> 16) as u16,
            next_cycle: words[13],
            scene: scene(now, words),
        })
    }
}

/// Returns the scene in a datagram that arrived now.
fn scene(now: Instant, words: &[u32; PeerCommand::WORDS]) -> Option<PeerScene> {
    let age = Duration::from_us(words[4].into());
    let number = |place: usize| f32::from_bits(words[place]);
    (age <= OLDEST && now.since(Instant::ORIGIN) >= age).then(|| PeerScene {
        at: Instant::from_ns(now.as_ns() - age.as_ns()),
        c: core::array::from_fn(|place| number(5 + place)),
        ego: Ego {
            speed: number(9),
            yaw_rate: number(10),
            steering_angle: number(11),
            slip_angle: number(12),
            ..Ego::default()
        },
    })
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

    /// Returns the datagram that is sent now.
    pub(super) fn datagram(&mut self, now: Instant, own: PeerCommand) -> [u32; PeerCommand::WORDS] {
        let mut words = [0; PeerCommand::WORDS];
        words[1] = own.mode as u32 | (own.stage as u32) << 8 | u32::from(own.soc) << 16;
        words[2] = own.command.steering_angle.to_bits();
        words[3] = own.command.acceleration.to_bits();
        words[4] = NO_SCENE;
        words[13] = own.next_cycle;
        if let Some(PeerScene { at, c, ego }) = own.scene {
            words[4] = u32::try_from(now.since(at).as_ns() / 1_000).unwrap_or(NO_SCENE);
            let motion = [ego.speed, ego.yaw_rate, ego.steering_angle, ego.slip_angle];
            for (word, number) in words[5..13].iter_mut().zip(c.into_iter().chain(motion)) {
                *word = number.to_bits();
            }
        }
        seal(PEER_COMMAND, VERSION, &mut self.counter, &mut words);
        words
    }

    /// Returns the command in a datagram that has arrived now; `None` if it holds another kind, or
    /// is not new.
    pub(super) fn on_datagram(&mut self, now: Instant, words: &[u32]) -> Option<PeerCommand> {
        let words: &[u32; PeerCommand::WORDS] = words.try_into().ok()?;
        let is_sealed = is_sealed(&mut self.checker, VERSION, words);
        PeerCommand::from_words(now, words).filter(|_| is_sealed)
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
            soc: 0xABCD,
            next_cycle: 0x1234_5678,
            scene: Some(PeerScene {
                at: NOW,
                c: [0.1, 0.2, 0.3, 0.4],
                ego: Ego {
                    speed: 30.0,
                    slip_angle: 0.01,
                    ..Ego::default()
                },
            }),
        }
    }

    const NOW: Instant = Instant::from_ns(7_000_000_000);

    /// T-RED-9: a scene arrives with its age, and an old one does not.
    #[test]
    fn a_scene_arrives_with_its_age() {
        let (mut from, mut to) = (PeerCommandLink::new(), PeerCommandLink::new());
        for (age_ms, arrives) in [
            (0, true),
            (150, true),
            (151, false),
            (u64::MAX >> 30, false),
        ] {
            let age = Duration::from_ms(age_ms);
            let words = from.datagram(NOW + age, peer_command());
            // The other system's clock shows another time.
            let theirs = Instant::from_ns(1_000_000_000);
            let scene = to.on_datagram(theirs, &words).unwrap().scene;
            let expected = peer_command()
                .scene
                .filter(|_| arrives)
                .map(|it| PeerScene {
                    at: Instant::from_ns(theirs.as_ns() - age.as_ns()),
                    ..it
                });
            assert_eq!(scene, expected, "{age_ms} ms");
        }
        let words = from.datagram(NOW, peer_command());
        assert!(to.on_datagram(Instant::ORIGIN, &words).is_some());
    }

    /// T-CHIP-5: a command arrives once. A repeated or damaged one is refused, and so is one with
    /// values that no system sends.
    #[test]
    fn only_a_new_and_whole_command_is_accepted() {
        let (mut from, mut to) = (PeerCommandLink::new(), PeerCommandLink::new());
        let words = from.datagram(NOW, peer_command());
        assert_eq!(to.on_datagram(NOW, &words), Some(peer_command()));
        assert_eq!(to.on_datagram(NOW, &words), None, "repeated");
        let words = from.datagram(NOW, peer_command());
        assert_eq!(to.on_datagram(NOW, &words[..3]), None);
        for bit in 0..32 * PeerCommand::WORDS {
            let mut wrong = words;
            wrong[bit / 32] ^= 1 << (bit % 32);
            assert_eq!(to.clone().on_datagram(NOW, &wrong), None, "bit {bit}");
        }
        for strange in [f32::NAN, f32::INFINITY, 1e9, 900.0, 0.62, -10.1] {
            let mut strange_one = peer_command();
            match strange == 0.62 {
                true => strange_one.command.steering_angle = strange,
                false => strange_one.command.acceleration = strange,
            }
            let words = from.datagram(NOW, strange_one);
            assert_eq!(to.on_datagram(NOW, &words), None, "{strange}");
        }
    }
}
