//! A controller from power-on to the next loss of power: boot ROM, bootloader, application.

use crate::{FileSender, SigningKey, SimulatedFlash, ToDo};
use tandem_board::{CanFrame, Instant, ResetCause, SystemId};
use tandem_boot::{
    Bank, Launch, Loader, Next, Refusal, Setup, Slot, Trust, TrustMode, approve, ed25519,
    rom_choice,
};

/// A private key for tests. Its public key is in no product.
pub const TEST_KEY: SigningKey = SigningKey {
    number: 0,
    seed: *b"TEST KEY 0: never in a product!!",
};
/// Its public key as a constant: computing it in each life would take too long. A test checks it.
pub const TEST_PUBLIC: [u8; 32] = [
    0xD1, 0xF9, 0x6F, 0x34, 0x86, 0x2F, 0xAD, 0xD7, 0x02, 0xF5, 0xE2, 0x4C, 0x53, 0x7D, 0xC5, 0x75,
    0x65, 0x94, 0x9D, 0x23, 0x24, 0xA5, 0xA0, 0xAC, 0xA3, 0xD5, 0x5E, 0xAB, 0xB1, 0xD2, 0xC5, 0x2A,
];
/// A second key, for tests of key rotation.
pub const TEST_KEY_1: SigningKey = SigningKey {
    number: 1,
    seed: *b"TEST KEY 1: never in a product!!",
};

/// A controller that resets this many times in one life counts as resetting for ever.
const MAX_RESETS: u8 = 12;

/// How a life ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum End {
    /// Power was lost.
    PowerLost,
    /// The application runs.
    Running(Launch),
    /// Nothing can boot, so the bootloader waits for a download.
    Waiting,
    /// A brick: the boot ROM finds no bootloader, or the bootloader resets for ever.
    Brick,
}

/// The circumstances of a controller in one life.
#[derive(Clone, Debug, Default)]
pub struct Life<'a> {
    /// The file that a host sends, and the host's window.
    pub file: Option<(&'a [String], u8)>,
    /// Whether the application approves itself.
    pub approves: bool,
    /// The slot whose application crashes at its start, although it is whole.
    pub crashing: Option<Slot>,
    /// Whether a new bootloader crashes at its start.
    pub new_loader_crashes: bool,
    /// Whether loaders accept unsigned images.
    pub monitor: bool,
    /// Public keys of the loaders.
    pub keys: Vec<[u8; 32]>,
    /// Public keys of testers; if there are any, the host must prove that it has one of them.
    pub testers: Vec<[u8; 32]>,
    /// The board's monotonic counter.
    pub counter: u32,
    /// The key with which the host proves itself.
    pub tester: Option<SigningKey>,
}

/// The outcome of a life.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LifeOutcome {
    /// How it ended.
    pub end: End,
    /// Why the host's file was refused, if it was.
    pub refused: Option<Refusal>,
    /// Whether the file was accepted.
    pub downloaded: bool,
}

impl<'a> Life<'a> {
    /// Creates a life without a host, in which the application approves itself.
    #[must_use]
    pub fn plain() -> Self {
        Self {
            approves: true,
            keys: vec![TEST_PUBLIC],
            ..Self::default()
        }
    }

    /// Creates a life in which a host sends a file.
    #[must_use]
    pub fn with_file(lines: &'a [String], window: u8) -> Self {
        Self {
            file: Some((lines, window)),
            ..Self::plain()
        }
    }

    /// Runs the life. The flash must be powered on.
    pub fn live(&self, flash: &mut SimulatedFlash) -> LifeOutcome {
        let mut run = Run {
            now: Instant::ORIGIN,
            starts: 0,
            outcome: LifeOutcome {
                end: End::Brick,
                refused: None,
                downloaded: false,
            },
        };
        let mut cause = ResetCause::PowerOn;
        for starts in 1..=MAX_RESETS {
            run.starts = starts;
            let Some(bank) = rom_choice(flash) else { break };
            let mut next = run.loader(self, flash, bank, cause);
            let mut crashes = false;
            while let Next::StartBank(bank) = next
                && flash.is_on()
                && !crashes
            {
                crashes = bank == Bank::Primary && self.new_loader_crashes;
                if !crashes {
                    next = run.loader(self, flash, bank, cause);
                }
            }
            if crashes {
                cause = ResetCause::Watchdog;
                continue;
            }
            match next {
                _ if !flash.is_on() => break,
                Next::Jump(launch) if self.crashing == Some(launch.application) => {
                    cause = ResetCause::Watchdog;
                }
                Next::Jump(launch) => return run.application(self, flash, launch),
                Next::Wait(_) => {
                    run.outcome.end = End::Waiting;
                    break;
                }
                // After an orderly reset, start again.
                _ => cause = ResetCause::Software,
            }
        }
        run.ended(flash)
    }
}

struct Run {
    now: Instant,
    /// Starts in this life.
    starts: u8,
    outcome: LifeOutcome,
}

impl Run {
    fn ended(mut self, flash: &SimulatedFlash) -> LifeOutcome {
        if !flash.is_on() {
            self.outcome.end = End::PowerLost;
        }
        self.outcome
    }

    fn application(
        mut self,
        life: &Life<'_>,
        flash: &mut SimulatedFlash,
        launch: Launch,
    ) -> LifeOutcome {
        self.outcome.end = End::Running(launch);
        if life.approves {
            // An application that cannot approve itself continues; the next start rolls it back.
            let _ = approve(flash);
            let _ = tandem_boot::bootloader_works(flash);
        }
        self.ended(flash)
    }

    /// Runs a bootloader from its start to the board's next action.
    fn loader(
        &mut self,
        life: &Life<'_>,
        flash: &mut SimulatedFlash,
        bank: Bank,
        cause: ResetCause,
    ) -> Next {
        let mode = if life.monitor {
            TrustMode::Monitor
        } else {
            TrustMode::Strict
        };
        let setup = Setup {
            trust: Trust {
                keys: &life.keys,
                testers: &life.testers,
                mode,
                verify: ed25519,
            },
            system: SystemId::A,
            bank,
            cause,
            starts: self.starts,
            counter: life.counter,
            noise: std::array::from_fn(|at| self.starts ^ at as u8),
        };
        let file = life
            .file
            .filter(|_| !self.outcome.downloaded && self.outcome.refused.is_none());
        let mut host = file.map(|(lines, window)| {
            let sender = FileSender::new(lines.to_vec(), None, window);
            match &life.tester {
                Some(key) => sender.proving(SystemId::A, *key),
                None => sender,
            }
        });
        let mut loader = Loader::start(&mut *flash, setup, self.now);
        loop {
            let wait = match loader.next(self.now) {
                Next::Send(frame) => {
                    if let Some(host) = &mut host {
                        host.on_frame(self.now, &frame);
                    }
                    continue;
                }
                Next::Wait(until) => until,
                next => return next,
            };
            match host.as_mut().map(|host| host.next(self.now)) {
                Some(ToDo::Send(frame)) => self.deliver(&mut loader, &frame),
                Some(ToDo::Wait(until)) => self.now = until.min(wait),
                Some(ToDo::Done) => {
                    self.outcome.downloaded = true;
                    host = None;
                }
                Some(ToDo::Refused(refusal)) => {
                    self.outcome.refused = Some(refusal);
                    host = None;
                }
                Some(ToDo::Locked(_)) => {
                    self.outcome.refused = Some(Refusal::Tester);
                    host = None;
                }
                Some(ToDo::Silent) | None if wait == Instant::NEVER => return Next::Wait(wait),
                Some(ToDo::Silent) | None => self.now = wait,
            }
        }
    }

    fn deliver(&mut self, loader: &mut Loader<'_, &mut SimulatedFlash>, frame: &CanFrame) {
        // A frame with 8 bytes has at least 131 bits, which take 262 µs at 500 kbit/s.
        self.now = Instant::from_ns(self.now.as_ns() + 270_000);
        let before = loader.flash().busy();
        loader.on_frame(self.now, frame);
        self.now += loader.flash().busy() - before;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// E-4: the constant is the public key of the private test key.
    #[test]
    fn the_public_test_key_is_that_of_the_private_one() {
        assert_eq!(TEST_KEY.public(), TEST_PUBLIC);
    }
}
