//! Who may program: a tester proves that it has a key before anything is erased. T-BOOT-1, E-4
//!
//! The loader sends a challenge that no other challenge equals, and the tester answers with an
//! Ed25519 signature of it. After a wrong signature it must wait, twice as long each time; the log
//! keeps the number of wrong ones over a reset. A running application asks for the same proof.

use crate::flash_access::sha256;
use crate::log::LogEvent;
use crate::protocol::{Answer, CHALLENGE_BYTES, PROOF_BYTES, PROOF_PARTS, PROOF_PIECE};
use crate::trust::Trust;
use tandem_board::{Duration, Instant, SystemId};

/// What a tester signs begins with this.
const TESTER_DOMAIN: &[u8; 13] = b"tandem tester";
/// Bytes that a tester signs: the domain, the system (0 A, 1 B), the number of the key, and the
/// challenge.
pub const TESTER_MESSAGE_BYTES: usize = TESTER_DOMAIN.len() + 2 + CHALLENGE_BYTES;
/// The wait after a wrong signature is at most 2^12 s, 68 minutes.
const LONGEST_WAIT: u8 = 12;

/// Returns the bytes that a tester signs.
#[must_use]
pub fn tester_message(
    system: SystemId,
    key: u8,
    challenge: &[u8; CHALLENGE_BYTES],
) -> [u8; TESTER_MESSAGE_BYTES] {
    let mut message = [0; TESTER_MESSAGE_BYTES];
    let (domain, rest) = message.split_at_mut(TESTER_DOMAIN.len());
    domain.copy_from_slice(TESTER_DOMAIN);
    rest[..2].copy_from_slice(&[system.index() as u8, key]);
    rest[2..].copy_from_slice(challenge);
    message
}

/// How a signature was judged.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Judged {
    Right,
    Wrong,
}

impl Judged {
    /// Returns what is logged, and what the tester hears.
    pub(crate) const fn outcome(self) -> (LogEvent, Answer) {
        match self {
            Self::Right => (LogEvent::TesterProved, Answer::Proved),
            Self::Wrong => (LogEvent::TesterRefused, Answer::Unproved),
        }
    }
}

/// The tester at the other end.
#[derive(Clone, Debug)]
pub(crate) struct Tester {
    /// It begins with the present challenge, and the next one follows from all of it: on a board
    /// with random numbers none can be foreseen.
    noise: [u8; 32],
    /// The key for which the present challenge was given.
    key: Option<u8>,
    proof: [u8; PROOF_PARTS * PROOF_PIECE],
    /// The parts of the signature that have arrived, one bit each.
    arrived: u16,
    is_proved: bool,
    /// Wrong signatures in a row.
    wrong: u8,
    locked_until: Instant,
}

impl Tester {
    /// `wrong`: the wrong signatures in a row before this start.
    pub(crate) fn new(noise: [u8; 32], wrong: u8, now: Instant) -> Self {
        let mut tester = Self {
            noise,
            key: None,
            proof: [0; PROOF_PARTS * PROOF_PIECE],
            arrived: 0,
            is_proved: false,
            wrong,
            locked_until: now,
        };
        tester.lock(now);
        tester
    }

    /// Returns whether this tester may program. A bootloader without keys of testers serves all.
    pub(crate) const fn may_program(&self, trust: &Trust<'_>) -> bool {
        self.is_proved || trust.testers.is_empty()
    }

    /// Forgets the tester: a new connection begins.
    pub(crate) const fn leave(&mut self) {
        (self.is_proved, self.key, self.arrived) = (false, None, 0);
    }

    fn lock(&mut self, now: Instant) {
        let seconds = match self.wrong.min(LONGEST_WAIT) {
            0 => 0,
            wrong => 1 << wrong,
        };
        self.locked_until = now + Duration::from_ms(1_000).times(seconds);
    }

    /// Returns a part of the challenge, to be signed with a key.
    pub(crate) fn on_challenge(&mut self, now: Instant, key: u8, part: u8) -> Option<Answer> {
        if now < self.locked_until {
            // In units of 1024 ns the longest wait has 32 bits: a 64-bit division takes 1 KiB.
            let left = (self.locked_until.since(now).as_ns() >> 10) as u32;
            let seconds = (left / 976_562 + 1) as u16;
            return Some(Answer::Locked { seconds });
        }
        let (parts, _) = self.noise[..CHALLENGE_BYTES].as_chunks::<PROOF_PIECE>();
        let bytes = *parts.get(usize::from(part))?;
        (self.key, self.arrived) = (Some(key), 0);
        Some(Answer::Challenge { part, bytes })
    }

    /// Takes a part of the signature. Returns the judgement when all have arrived; the challenge is
    /// then used up.
    pub(crate) fn on_proof(
        &mut self,
        (now, system): (Instant, SystemId),
        part: u8,
        bytes: [u8; PROOF_PIECE],
        trust: &Trust<'_>,
    ) -> Option<Judged> {
        let (places, _) = self.proof.as_chunks_mut::<PROOF_PIECE>();
        *places.get_mut(usize::from(part))? = bytes;
        self.arrived |= 1 << part;
        if self.arrived != (1 << PROOF_PARTS) - 1 {
            return None;
        }
        let key = self.key.take()?;
        let message = tester_message(system, key, self.noise.first_chunk()?);
        self.noise = sha256(&self.noise);
        self.arrived = 0;
        let public = trust.testers.get(usize::from(key));
        let signature = self.proof.first_chunk::<PROOF_BYTES>()?;
        self.is_proved = public.is_some_and(|key| (trust.verify)(key, &message, signature));
        if self.is_proved {
            self.wrong = 0;
            return Some(Judged::Right);
        }
        self.wrong = self.wrong.saturating_add(1);
        self.lock(now);
        Some(Judged::Wrong)
    }

    /// Returns the wrong signatures in a row.
    pub(crate) const fn wrong(&self) -> u8 {
        self.wrong
    }
}
