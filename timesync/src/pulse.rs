//! Time from a pulse with a transfer: an edge on the line `Time`, then a datagram over the link
//! that says which global time it was at that edge. S-3
//!
//! To pair a transfer with the wrong edge makes the time wrong by a period. Five things rule it
//! out:
//!
//! 1. Edges are at least [`MIN_INTERVAL`] apart, and a transfer is paired with the newest edge
//!    only, and only for [`MAX_AGE`] after it, which is less than half of that.
//! 2. From pair to pair the number of the transfer and the receiver's count of edges grow alike.
//! 3. From pair to pair the global time and the local clock grow alike (`continuity.rs`).
//! 4. The first three pairs are of three edges in a row, and only the third is given on.
//! 5. No two of 16 intervals in a row are equal. Where each transfer is late by one to 15 periods,
//!    2 holds but 3 does not.
//!
//! What remains: an edge moved by less than the tolerance of 3 (0.2 ms to 1 ms); and, while the
//! slave learns, three edges in a row moved by the same time, or transfers that are all late by 16
//! intervals (2 s).

use crate::continuity::{Continuity, Verdict};
use crate::{GlobalTime, Sample, Scale};
use tandem_board::{Duration, Instant};

/// Words of a transfer, without those of its protection.
pub const PULSE_WORDS: usize = 6;

/// The shortest interval between two edges. The mean is 125 ms.
const MIN_INTERVAL: Duration = Duration::from_ms(95);
/// By this the next interval is longer, up to the 16th.
const STEP: Duration = Duration::from_ms(4);
const INTERVALS: u32 = 16;
/// A later edge has no transfer: two intervals would differ by less than 1.5 ms, more than the
/// tolerance of 3.
const MAX_LATENESS: Duration = Duration::from_us(2_500);
/// The longest time from `before` to `after` for which an edge has a transfer.
const MAX_UNCERTAINTY: Duration = Duration::from_us(200);
/// An edge waits for its transfer, and a transfer for its edge, up to this time.
const MAX_AGE: Duration = Duration::from_ms(40);
/// An edge is stamped at most this much after it was raised: 10 µs in the isolator and the filter
/// of the input, and the latency of the stamp.
const LATENCY: Duration = Duration::from_us(15);
/// What the stamps of two edges may differ by: latencies of the interrupt.
const STAMP_NOISE: Duration = Duration::from_us(50);

/// What a master says of one edge.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PulseTransfer<S: Scale> {
    /// The number of the edge; wraps around.
    pub number: u32,
    /// Global time just before the edge.
    pub time: GlobalTime<S>,
    /// The edge was at most this much later.
    pub uncertainty: Duration,
    /// The master's estimate of the error of its time, up to 4.2 s.
    pub master_error: Duration,
    /// The master's time is that of a gateway.
    pub is_to_gateway: bool,
}

impl<S: Scale> PulseTransfer<S> {
    /// Returns the words for the link.
    #[must_use]
    pub fn to_words(&self) -> [u32; PULSE_WORDS] {
        let ns = |span: Duration| u32::try_from(span.as_ns()).unwrap_or(u32::MAX);
        let [low, high] = Instant::from_ns(self.time.as_ns()).to_words();
        let (uncertainty, error) = (ns(self.uncertainty), ns(self.master_error));
        let flags = self.is_to_gateway.into();
        [self.number, low, high, uncertainty, error, flags]
    }

    /// The inverse of [`PulseTransfer::to_words`]; `None` if the number of words is another one,
    /// the uncertainty is more than a master states, or a flag is unknown.
    #[must_use]
    pub fn from_words(words: &[u32]) -> Option<Self> {
        let &[number, low, high, uncertainty, error, flags @ 0..=1] = words else {
            return None;
        };
        let uncertainty = Duration::from_ns(uncertainty.into());
        (uncertainty <= MAX_UNCERTAINTY).then_some(Self {
            number,
            time: GlobalTime::from_ns(Instant::from_words([low, high]).as_ns()),
            uncertainty,
            master_error: Duration::from_ns(error.into()),
            is_to_gateway: flags == 1,
        })
    }
}

/// The sender of edges.
#[derive(Clone, Copy, Debug)]
pub struct PulseMaster {
    due: Instant,
    number: u32,
}

impl PulseMaster {
    /// Makes a master whose first edge is due at `now`.
    #[must_use]
    pub const fn new(now: Instant) -> Self {
        Self {
            due: now,
            number: 0,
        }
    }

    /// Returns when to raise the line: `before = now()`, the rising edge, `after = now()`, the
    /// falling edge. Then call [`PulseMaster::raised`].
    #[must_use]
    pub const fn due(&self) -> Instant {
        self.due
    }

    /// Numbers the edge that was sent between these times. Returns the transfer to send at once,
    /// whose `master_error` and `is_to_gateway` the caller fills in. `time`: global time at
    /// `before`. `None` if the edge was late, or it is not known well enough when it was.
    pub fn raised<S: Scale>(
        &mut self,
        before: Instant,
        after: Instant,
        time: GlobalTime<S>,
    ) -> Option<PulseTransfer<S>> {
        let is_late = before.since(self.due) > MAX_LATENESS;
        let number = self.number;
        let uncertainty = after.since(before);
        self.due = before + MIN_INTERVAL + STEP.times(number % INTERVALS);
        self.number = number.wrapping_add(1);
        (!is_late && uncertainty <= MAX_UNCERTAINTY).then_some(PulseTransfer {
            number,
            time,
            uncertainty,
            master_error: Duration::ZERO,
            is_to_gateway: false,
        })
    }
}

/// What a slave learns from one edge.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Pulse<S: Scale> {
    /// The time of the edge on both clocks.
    pub sample: Sample<S>,
    /// What the master said of it.
    pub transfer: PulseTransfer<S>,
}

/// Why a transfer gave no sample.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PulseRefusal {
    /// There was no edge near it.
    NoEdge,
    /// It was received before.
    Repeated,
    /// The first pairs only teach which count of edges is which number.
    Learning,
    /// It does not follow from the pairs before it: its global time is this much later, ns. Zero if
    /// only its number is wrong.
    OutOfLine(i64),
}

impl core::fmt::Display for PulseRefusal {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        let text = match self {
            Self::NoEdge => "no edge is near it",
            Self::Repeated => "it was received before",
            Self::Learning => "the first pairs only teach the number of edges",
            Self::OutOfLine(ns) => return write!(f, "its time is {ns} ns later than expected"),
        };
        f.write_str(text)
    }
}

impl core::error::Error for PulseRefusal {}

/// The receiver of edges and transfers. A system that has a new master makes a new one.
#[derive(Clone, Copy, Debug)]
pub struct PulseSlave<S: Scale> {
    /// The newest transfer, until its edge is seen, and when it was received.
    heard: Option<(Instant, PulseTransfer<S>)>,
    /// Pairs, each with the number of its transfer and the count of its edge.
    line: Continuity<S, (u32, u32)>,
}

impl<S: Scale> Default for PulseSlave<S> {
    /// Makes a slave that knows nothing.
    fn default() -> Self {
        Self {
            heard: None,
            line: Continuity::NEW,
        }
    }
}

impl<S: Scale> PulseSlave<S> {
    /// Takes a transfer. Call [`PulseSlave::poll`] after all transfers that have arrived.
    pub const fn on_transfer(&mut self, now: Instant, transfer: PulseTransfer<S>) {
        self.heard = Some((now, transfer));
    }

    /// Pairs the newest transfer with the newest edge. `edge`: how many rising edges this system
    /// has received since its power-on, modulo 2³², and when it received the newest one; read after
    /// the transfers. Returns `None` if there is nothing new.
    ///
    /// # Errors
    /// [`PulseRefusal`]: the transfer is not used.
    pub fn poll(
        &mut self,
        now: Instant,
        edge: Option<(u32, Instant)>,
    ) -> Result<Option<Pulse<S>>, PulseRefusal> {
        let Some((heard, transfer)) = self.heard else {
            return Ok(None);
        };
        let Some((count, at)) = edge.filter(|&(_, at)| now.since(at) <= MAX_AGE) else {
            if now.since(heard) <= MAX_AGE {
                return Ok(None);
            }
            self.heard = None;
            return Err(PulseRefusal::NoEdge);
        };
        self.heard = None;
        let key = (transfer.number, count);
        let follows = self.line.newest().is_none_or(|(number, last)| {
            let edges = count.wrapping_sub(last);
            transfer.number.wrapping_sub(number) == edges && (edges == 1 || self.line.is_learned())
        });
        if self.line.newest() == Some(key) {
            return Err(PulseRefusal::Repeated);
        }
        let half = transfer.uncertainty.as_ns().div_ceil(2);
        let sample = Sample {
            local: at,
            global: transfer.time.moved(half as i64),
            error: LATENCY + Duration::from_ns(half),
        };
        match self.line.judge(sample, key, STAMP_NOISE, follows) {
            Verdict::InLine => Ok(Some(Pulse { sample, transfer })),
            Verdict::Learning => Err(PulseRefusal::Learning),
            Verdict::Out(by) => Err(PulseRefusal::OutOfLine(by)),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Arbitrary;
    use proptest::prelude::*;

    fn at(us: u64) -> Instant {
        Instant::from_ns(1_000 * us)
    }

    fn raise(
        master: &mut PulseMaster,
        late_us: u64,
        lasts_us: u64,
    ) -> Option<PulseTransfer<Arbitrary>> {
        let before = master.due() + Duration::from_us(late_us);
        let time = GlobalTime::from_ns(before.as_ns() + 5);
        master.raised(before, before + Duration::from_us(lasts_us), time)
    }

    /// S-3: an edge that is late, or whose time is not known well, is numbered and has no transfer.
    #[test]
    fn a_master_tells_of_edges_whose_time_it_knows() {
        let mut master = PulseMaster::new(at(9));
        let first = raise(&mut master, 2_500, 200).unwrap();
        assert_eq!((first.number, first.time.as_ns()), (0, 2_509_005));
        assert_eq!(first.uncertainty, Duration::from_us(200));
        assert_eq!(master.due(), at(9 + 2_500 + 95_000));
        assert_eq!(raise(&mut master, 2_501, 0), None);
        assert_eq!(raise(&mut master, 0, 201), None);
        assert_eq!(raise(&mut master, 0, 0).unwrap().number, 3);
        let intervals = [0; 16].map(|_| {
            let before = master.due();
            let _ = raise(&mut master, 0, 0);
            master.due().since(before).as_ns() / 1_000_000
        });
        let expected = [4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 0, 1, 2, 3];
        assert_eq!(intervals, expected.map(|n| 95 + 4 * n));
    }

    /// S-3: what a slave says of each transfer; a stamp counts up to 40 ms, and no longer.
    #[test]
    fn a_slave_tells_why_it_gives_no_sample() {
        const LONGEST: Duration = Duration::from_ms(40);
        let (mut master, mut slave) = (PulseMaster::new(at(0)), PulseSlave::default());
        for count in 7..10 {
            let (edge, now) = (Some((count, master.due())), master.due() + LONGEST);
            let transfer = raise(&mut master, 0, 1).unwrap();
            slave.on_transfer(now, transfer);
            let heard = slave.poll(now, edge);
            assert_eq!(heard.is_err(), count < 9);
            if let Ok(pulse) = heard {
                let sample = pulse.unwrap().sample;
                assert_eq!(sample.local, edge.unwrap().1);
                assert_eq!(sample.global, transfer.time.moved(500));
                assert_eq!(sample.error, LATENCY + Duration::from_ns(500));
            }
            assert_eq!(slave.poll(now, edge), Ok(None));
            slave.on_transfer(now, transfer);
            assert_eq!(slave.poll(now, edge), Err(PulseRefusal::Repeated));
        }
        let (now, transfer) = (master.due(), raise(&mut master, 0, 1).unwrap());
        slave.on_transfer(now, transfer);
        let out = Err(PulseRefusal::OutOfLine(0));
        assert_eq!(slave.poll(now, Some((11, now))), out);
        slave.on_transfer(now, transfer);
        assert_eq!(slave.poll(now + LONGEST, None), Ok(None));
        let later = now + LONGEST + Duration::from_ns(1);
        assert_eq!(
            slave.poll(later, Some((11, now))),
            Err(PulseRefusal::NoEdge)
        );
        assert_eq!(slave.poll(later, None), Ok(None));
    }

    proptest! {
        /// S-3: words from the link are decoded or refused, and never cause a panic.
        #[test]
        fn any_words_are_allowed(
            words in prop::collection::vec(prop_oneof![any::<u32>(), 0..200_002u32, 0..3u32], 5..8),
            edges in prop::collection::vec(any::<(u64, u32, u64)>(), 9),
        ) {
            let transfer = PulseTransfer::<Arbitrary>::from_words(&words);
            let is_valid = words.len() == PULSE_WORDS && words[3] <= 200_000 && words[5] <= 1;
            prop_assert_eq!(transfer.map(|it| it.to_words().to_vec()), is_valid.then_some(words));
            let mut slave = PulseSlave::default();
            for (now, count, at) in edges {
                if let Some(transfer) = transfer {
                    slave.on_transfer(Instant::from_ns(now), transfer);
                }
                let _ = slave.poll(Instant::from_ns(now), Some((count, Instant::from_ns(at))));
            }
        }
    }
}
