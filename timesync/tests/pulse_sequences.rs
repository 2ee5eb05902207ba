//! Every sequence of five faults on the line and the link between two systems, and random ones: no
//! sample has a wrong time. S-3

mod exhaustive;

use exhaustive::no_sequence_gives_a_wrong_sample;
use proptest::prelude::*;
use tandem_board::{Duration, Instant};
use tandem_timesync::{Arbitrary, GlobalTime, Pulse, PulseMaster, PulseSlave, PulseTransfer};

const MS: u64 = 1_000_000;
const US: u64 = 1_000;

/// What happens to one edge and its transfer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Fate {
    Good,
    EdgeLost,
    /// Noise before the transfer, and after it.
    NoiseFirst,
    NoiseLater,
    /// The edge is lost, and noise arrives instead: each time at another distance.
    EdgeMoved,
    TransferLost,
    TransferTwice,
    /// The transfer arrives again after the next one's edge.
    TransferAgain,
    /// Late by this time, ms: in the same period, in the next one, or in a later one.
    TransferLate(u64),
    /// The transfer arrives before the edge is seen.
    EdgeSeenLate,
    MasterRestarts,
    SlaveRestarts,
    /// Its count of edges restarts too.
    SlaveLosesPower,
}

const FATES: [Fate; 15] = [
    Fate::Good,
    Fate::EdgeLost,
    Fate::NoiseFirst,
    Fate::NoiseLater,
    Fate::EdgeMoved,
    Fate::TransferLost,
    Fate::TransferTwice,
    Fate::TransferAgain,
    Fate::TransferLate(60),
    Fate::TransferLate(130),
    Fate::TransferLate(270),
    Fate::EdgeSeenLate,
    Fate::MasterRestarts,
    Fate::SlaveRestarts,
    Fate::SlaveLosesPower,
];

#[derive(Clone, Copy)]
enum Arrival {
    /// An edge with its stamp.
    Edge(u64),
    Transfer(PulseTransfer<Arbitrary>),
    Restart {
        with_count: bool,
    },
}

/// The clocks of a run: how the slave's clock and the global time follow from true time.
#[derive(Clone, Copy, Debug)]
struct Clocks {
    slave_ns: u64,
    slave_ppm: i64,
    global_ns: u64,
}

impl Clocks {
    fn local(&self, at: u64) -> u64 {
        let drift = at as i64 / 1_000 * self.slave_ppm / 1_000;
        (self.slave_ns + at).wrapping_add_signed(drift)
    }
}

/// Runs the sequence. Returns of each sample when it was given, and its error in ns: the oracle
/// knows at which true time the slave's clock showed the sample's local time.
fn run(fates: &[Fate], clocks: Clocks) -> Vec<(usize, i64)> {
    let mut arrivals: Vec<(u64, usize, Arrival)> = Vec::new();
    let mut master = PulseMaster::new(Instant::from_ns(50 * MS));
    let edge = |at: u64| Arrival::Edge(clocks.local(at));
    for (n, &fate) in fates.iter().enumerate() {
        if fate == Fate::MasterRestarts {
            master = PulseMaster::new(master.due() + Duration::from_ms(77));
        }
        let at = master.due().as_ns();
        let (before, after) = (Instant::from_ns(at), Instant::from_ns(at + 2 * US));
        let time = GlobalTime::from_ns(clocks.global_ns + at);
        let transfer = master.raised(before, after, time).map(Arrival::Transfer);
        let mut add = |at: u64, what| arrivals.push((at, n, what));
        let moved = at + (3 + 2 * n as u64) * MS;
        match fate {
            Fate::EdgeLost => {}
            Fate::EdgeMoved => add(moved, edge(moved)),
            Fate::EdgeSeenLate => add(at + 3 * MS, edge(at + US)),
            _ => add(at + US, edge(at + US)),
        }
        let sent = at
            + match fate {
                Fate::TransferLate(ms) => ms * MS,
                Fate::EdgeMoved => 40 * MS,
                _ => 2 * MS,
            };
        match fate {
            Fate::NoiseFirst => add(at + MS, edge(at + MS)),
            Fate::NoiseLater => add(at + 50 * MS, edge(at + 50 * MS)),
            Fate::TransferTwice => transfer.into_iter().for_each(|it| add(sent + MS, it)),
            Fate::TransferAgain => transfer.into_iter().for_each(|it| add(sent + 160 * MS, it)),
            Fate::SlaveRestarts => add(at + 70 * MS, Arrival::Restart { with_count: false }),
            Fate::SlaveLosesPower => add(at + 70 * MS, Arrival::Restart { with_count: true }),
            _ => {}
        }
        if fate != Fate::TransferLost {
            transfer.into_iter().for_each(|it| add(sent, it));
        }
    }
    arrivals.sort_by_key(|&(at, ..)| at);
    receive(&arrivals, clocks)
}

/// The slave polls at each arrival.
fn receive(arrivals: &[(u64, usize, Arrival)], clocks: Clocks) -> Vec<(usize, i64)> {
    let (mut slave, mut count, mut newest) = (PulseSlave::default(), u32::MAX - 3, None);
    let mut samples = Vec::new();
    for &(at, n, what) in arrivals {
        let now = Instant::from_ns(clocks.local(at));
        match what {
            Arrival::Edge(stamp) => {
                count = count.wrapping_add(1);
                newest = Some((count, Instant::from_ns(stamp)));
            }
            Arrival::Transfer(transfer) => slave.on_transfer(now, transfer),
            Arrival::Restart { with_count } => {
                slave = PulseSlave::default();
                if with_count {
                    (count, newest) = (0, None);
                }
            }
        }
        if let Ok(Some(Pulse { sample, .. })) = slave.poll(now, newest) {
            let global = sample.global.as_ns() - clocks.global_ns;
            let error = clocks.local(global) as i64 - sample.local.as_ns() as i64;
            samples.push((n, error));
        }
    }
    samples
}

const CLOCKS: Clocks = Clocks {
    slave_ns: 7_000_000 * MS,
    slave_ppm: 0,
    global_ns: 3_000_000 * MS,
};

/// S-3: the sample is the middle of the time in which the edge was raised, here 1 us after
/// `before`.
#[test]
fn five_periods_of_all_faults_give_no_wrong_sample() {
    let given =
        no_sequence_gives_a_wrong_sample(&FATES, (Fate::Good, 5, 8), |fates| run(fates, CLOCKS));
    assert!(given > 8_000_000, "{given}");
}

/// S-3: where every transfer is late by the same time, nothing but the intervals can tell; 16 of
/// them take 2 s.
#[test]
fn a_link_that_is_always_late_gives_no_sample() {
    for late in 45..1_850 {
        let samples = run(&[Fate::TransferLate(late); 40], CLOCKS);
        assert!(
            samples.iter().all(|&(_, error)| error == 0),
            "{late} ms: {samples:?}"
        );
    }
    assert_eq!(run(&[Fate::TransferLate(30); 40], CLOCKS).len(), 38);
}

/// S-3: a slave learns from edges in a row: longer spans differ by less than the lateness of edges.
#[test]
fn pairs_with_gaps_teach_nothing() {
    let gaps = [Fate::TransferLost, Fate::Good].repeat(10);
    assert!(run(&gaps, CLOCKS).is_empty());
    let fates = [&[Fate::Good; 3], &gaps[..]].concat();
    assert_eq!(run(&fates, CLOCKS).len(), 11);
}

proptest! {
    /// S-3: with any clock that drifts as clocks do, a sample errs by what the clock drifts between
    /// the edge and its stamp, which is nothing here.
    #[test]
    fn random_sequences_with_random_clocks_give_no_wrong_sample(
        fates in prop::collection::vec(prop::sample::select(&FATES[..]), 1..60),
        slave_ns in 0..1u64 << 60,
        slave_ppm in -500..500i64,
        global_ns in 0..1u64 << 60,
    ) {
        let clocks = Clocks { slave_ns, slave_ppm, global_ns };
        for (n, error) in run(&fates, clocks) {
            prop_assert!(error.abs() <= 2, "{n}: {error}");
        }
    }
}
