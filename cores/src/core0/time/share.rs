//! What the tasks of core 0 share of the time: the newest conversion, and the newest transfer.

use super::super::datagram::{PULSE, is_sealed, seal};
use tandem_board::Instant;
use tandem_bus::e2e::Checker;
use tandem_timesync::{Arbitrary, Conversion, PULSE_WORDS, PulseTransfer};

const VERSION: u8 = 1;
/// Words of a transfer with those of its protection.
const WORDS: usize = 1 + PULSE_WORDS;

/// The time as the other tasks see it, and both ends of the transfers over the link.
pub(in super::super) struct TimeShare {
    /// How local time becomes the vehicle's time; `None` while there is none.
    pub(in super::super) conversion: Option<Conversion<Arbitrary>>,
    /// The newest transfer of the other system, and when it was read.
    pub(super) transfer: Option<(Instant, PulseTransfer<Arbitrary>)>,
    /// When the other system begins its next control cycle: the low word of its time, ns.
    peer_cycle: Option<u32>,
    counter: u8,
    checker: Checker,
}

impl TimeShare {
    pub(in super::super) const fn new() -> Self {
        Self {
            conversion: None,
            transfer: None,
            peer_cycle: None,
            counter: 0,
            checker: Checker::new(PULSE),
        }
    }

    /// Takes a datagram of the link. Returns whether it is a transfer.
    pub(in super::super) fn on_datagram(&mut self, now: Instant, words: &[u32]) -> bool {
        let Ok(words) = <&[u32; WORDS]>::try_from(words) else {
            return false;
        };
        if !is_sealed(&mut self.checker, VERSION, words) {
            return false;
        }
        let [_, content @ ..] = words;
        self.transfer = PulseTransfer::from_words(content).map(|it| (now, it));
        self.transfer.is_some()
    }

    /// Returns whether a transfer waits for the task of time.
    pub(in super::super) const fn has_transfer(&self) -> bool {
        self.transfer.is_some()
    }

    /// Returns the word that tells the other system when this one begins its next control cycle:
    /// the low word of the time, ns. 0 while there is no time.
    pub(in super::super) fn cycle_word(&self, next: Instant) -> u32 {
        let word = |it: &Conversion<Arbitrary>| (it.at(next).as_ns() as u32).max(1);
        self.conversion.as_ref().map_or(0, word)
    }

    /// Takes the word of the other system.
    pub(in super::super) fn on_peer_cycle(&mut self, word: u32) {
        self.peer_cycle = Some(word).filter(|word| *word != 0);
    }

    /// Returns the word once.
    pub(in super::super) const fn take_peer_cycle(&mut self) -> Option<u32> {
        self.peer_cycle.take()
    }

    /// Returns the datagram for a transfer.
    pub(super) fn datagram(&mut self, transfer: &PulseTransfer<Arbitrary>) -> [u32; WORDS] {
        let mut words = [0; WORDS];
        let [_, content @ ..] = &mut words;
        *content = transfer.to_words();
        seal(PULSE, VERSION, &mut self.counter, &mut words);
        words
    }
}
