//! The programs of the cores of one system: the driving functions and their wiring over one board.
//!
//! [`driving`] is pure computation: sensor frames and the time in; scene, trajectory and command
//! out. [`core0`], [`core1`] and [`core2`] wire it to a board. A board's main loop is the same for
//! all:
//!
//! ```text
//! loop { let deadline = core.poll(); board.wait(deadline); }
//! ```
#![no_std]
#![forbid(unsafe_code)]

#[cfg(test)]
extern crate std;

pub mod core0;
pub mod core1;
pub mod core2;
pub mod doorbell;
pub mod driving;
pub mod layout;
pub mod release;
pub mod task_table;
mod tester_desk;
pub mod trace;
pub mod words;

use tandem_board::{Board, Can, CanFrame, CanId, Duration, Instant, Received};
use tandem_bus::e2e::Check;
use tandem_bus::{Message, ReceiveError};
pub use tester_desk::Unguarded;

/// The work of one core, in steps that terminate.
pub trait Core {
    /// Does all due work and returns the latest time of the next call. Also called after an
    /// interrupt. Task context; never blocks, never allocates.
    fn poll(&mut self) -> Instant;
}

/// Period of polls of a core that waits for the LMU to be formatted.
const RETRY: Duration = Duration::from_ms(1);

/// Limits that depend on how punctual the machine's timers are.
#[derive(Clone, Copy, Debug)]
pub struct Config {
    /// Limits of heartbeats, start protocol and takeover.
    pub redundancy: tandem_redundancy::Config,
    /// Core 1 or 2 is silent if it has not completed a cycle for longer than this.
    pub alive_limit: Duration,
    /// How long cores 1 and 2 may take from the start to their first cycle, and the sensors to
    /// show a lane.
    pub boot_limit: Duration,
}

impl Config {
    /// Returns the limits for chips, which do not stall.
    #[must_use]
    pub const fn chip() -> Self {
        Self {
            redundancy: tandem_redundancy::Config::chip(),
            ..Self::rt()
        }
    }

    /// Returns the limits for machines whose timers are late by far less than a millisecond.
    #[must_use]
    pub const fn rt() -> Self {
        Self {
            redundancy: tandem_redundancy::Config::rt(),
            // A cycle that is missed is noticed within the period that follows it.
            alive_limit: Duration::from_ms(75),
            boot_limit: Duration::from_ms(2000),
        }
    }

    /// Returns the limits for ordinary processes on a desktop.
    #[must_use]
    pub const fn desktop() -> Self {
        Self {
            redundancy: tandem_redundancy::Config::desktop(),
            alive_limit: Duration::from_ms(100),
            boot_limit: Duration::from_ms(4000),
        }
    }
}

/// A received frame of the DBC.
enum ReceivedFrame {
    /// It passed its end-to-end check.
    Valid(Message),
    /// Its CRC is right, but its counter is wrong: repeated, or out of sequence.
    WrongCounter(Message),
    /// It is for the desk on core 2.
    ForDesk(CanFrame),
}

/// Returns the next received frame of the DBC whose CRC is right, or the next frame for
/// the desk, with the time at which it was on the bus. Skips other frames.
///
/// Takes at most `left` frames of any kind from the receiver, and counts `left` down; 0 means that
/// more may wait. `hears` is called with each of them.
fn read_can<B: Board>(
    board: &B,
    receiver: &mut tandem_bus::FrameReceiver,
    left: &mut u32,
    mut hears: impl FnMut(&Received),
) -> Option<(Instant, ReceivedFrame)> {
    while *left > 0 {
        let received = board.can().try_receive()?;
        *left -= 1;
        hears(&received);
        let CanId::Standard(id) = received.frame.id() else {
            if tester_desk::concerns(&received.frame) {
                return Some((received.at, ReceivedFrame::ForDesk(received.frame)));
            }
            continue;
        };
        let data = received.frame.data();
        match receiver.receive(id.into(), data) {
            Ok(message) => return Some((received.at, ReceivedFrame::Valid(message))),
            Err(ReceiveError::Protection(check)) => {
                board.trace(trace::Event::Refused { id: id.into() }.encode());
                if check != Check::CrcError
                    && let Ok(message) = Message::decode(id.into(), data)
                {
                    return Some((received.at, ReceivedFrame::WrongCounter(message)));
                }
            }
            Err(ReceiveError::Decode(_)) => {}
        }
    }
    None
}
