//! The kinds of cells: what each demands of two peers.

use crate::cell::{Pair, figure};
use crate::peer::{Reader, Vendor, Writer};
use crate::relay::{Relay, Relayed};
use std::ops::RangeInclusive;
use std::time::{Duration, Instant};
use tandem_topics::{Durability, Qos, READERS, Reliability};

/// The period of the frames.
const PERIOD: Duration = Duration::from_millis(10);
/// Readers are asked this often what has arrived.
const POLLS_EVERY: Duration = Duration::from_millis(2);
/// A frame that must not arrive would arrive within this time.
const SETTLES: Duration = Duration::from_millis(300);
/// A cell that waits longer fails, and says for what. The watchdog, which cannot say it, is later.
const PATIENCE: Duration = Duration::from_secs(100);
/// Where nothing is lost, the writer is at most this many frames ahead of its readers. So a reader
/// that the machine has stalled has room for them all.
const AHEAD: u32 = 16;
/// The number of all frames that only show that the peers have found each other.
const GREETING: u32 = 0;
/// Frames in a plain cell.
const PLAIN: u32 = 200;
/// Frames in a round of a cell with loss.
const LOSSY: u32 = 300;
const LOSS_PERCENT: u64 = 20;
/// A machine that stalls for three periods loses frames too, so the best round counts.
const ROUNDS: u32 = 3;

/// What a writer of the MCU offers. D-4
const OFFERED: Qos = Qos {
    reliability: Reliability::Reliable,
    durability: Durability::TransientLocal,
    depth: 3,
};
/// What a reader asks for that wants all.
const ASKED: Qos = Qos {
    depth: 32,
    ..OFFERED
};

/// A reader, and what it has heard.
struct Listener {
    reader: Box<dyn Reader>,
    /// It has heard a greeting.
    is_greeted: bool,
    /// The numbers of all other frames, as they arrived.
    taken: Vec<u32>,
}

/// A writer and its readers.
struct Link {
    writer: Box<dyn Writer>,
    listeners: Vec<Listener>,
}

impl Link {
    fn open(Pair(writer, reader): Pair, offered: Qos, asked: Qos) -> Self {
        let mut link = Self::of(writer.writer(0, offered));
        link.join(reader.reader(0, asked));
        link
    }

    fn of(writer: Box<dyn Writer>) -> Self {
        Self {
            writer,
            listeners: Vec::new(),
        }
    }

    fn join(&mut self, reader: Box<dyn Reader>) {
        self.listeners.push(Listener {
            reader,
            is_greeted: false,
            taken: Vec::new(),
        });
    }

    /// Takes what has arrived.
    fn poll(&mut self) {
        for listener in &mut self.listeners {
            for number in listener.reader.take() {
                if number == GREETING {
                    listener.is_greeted = true;
                } else {
                    listener.taken.push(number);
                }
            }
        }
    }

    /// Returns what each reader has taken.
    fn taken(&self) -> Vec<&[u32]> {
        let listeners = self.listeners.iter();
        listeners.map(|listener| &listener.taken[..]).collect()
    }

    /// Waits until a condition holds.
    fn wait(&mut self, what: &str, mut holds: impl FnMut(&mut Self) -> bool) {
        let begin = Instant::now();
        loop {
            self.poll();
            if holds(self) {
                return;
            }
            assert!(begin.elapsed() < PATIENCE, "no {what}: {:?}", self.taken());
            std::thread::sleep(POLLS_EVERY);
        }
    }

    fn listen(&mut self, time: Duration) {
        let begin = Instant::now();
        self.wait("end of time", |_| begin.elapsed() >= time);
    }

    /// Writes a frame, and waits for the end of its period. Returns whether it was published.
    fn write(&mut self, number: u32) -> bool {
        let is_published = self.writer.write(number);
        self.listen(PERIOD);
        is_published
    }

    /// Writes frames of which each arrives.
    fn publish(&mut self, numbers: RangeInclusive<u32>) {
        for number in numbers {
            assert!(self.write(number), "the writer has blocked");
            self.wait("progress", |link| {
                let taken = link.taken();
                let mut newest = taken.iter().filter_map(|taken| taken.last());
                newest.all(|newest| newest + AHEAD >= number)
            });
        }
    }

    /// Writes greetings until this many readers have heard one.
    fn greet(&mut self, readers: usize) {
        let begin = Instant::now();
        while self.greeted() < readers {
            assert!(begin.elapsed() < PATIENCE, "{} readers", self.greeted());
            self.write(GREETING);
        }
    }

    fn greeted(&self) -> usize {
        let listeners = self.listeners.iter();
        listeners.filter(|listener| listener.is_greeted).count()
    }
}

/// Returns the number of the sequence of losses: the one in `TANDEM_MATRIX_SEED`, or 1.
fn seed() -> u64 {
    let given = std::env::var("TANDEM_MATRIX_SEED");
    given.map_or(1, |seed| seed.parse().unwrap())
}

fn numbers(range: RangeInclusive<u32>) -> Vec<u32> {
    range.collect()
}

/// All frames arrive once and in their order.
pub(crate) fn plain(pair: Pair) {
    let mut link = Link::open(pair, OFFERED, ASKED);
    link.greet(1);
    link.publish(1..=PLAIN);
    link.wait("last frame", |link| link.taken()[0].len() >= PLAIN as usize);
    link.listen(SETTLES);
    assert_eq!(link.taken(), [numbers(1..=PLAIN)]);
}

/// A reader that starts after ten frames gets the last three, and all new ones.
pub(crate) fn late_joiner(pair: Pair) {
    let mut link = Link::of(pair.0.writer(0, OFFERED));
    link.publish(1..=10);
    link.join(pair.1.reader(0, ASKED));
    link.wait("history", |link| link.taken()[0].len() >= 3);
    link.publish(11..=30);
    link.wait("last frame", |link| link.taken()[0].last() == Some(&30));
    link.listen(SETTLES);
    assert_eq!(link.taken(), [numbers(8..=30)]);
}

/// A reader that starts after ten frames, and does not ask for them, gets the new ones alone.
pub(crate) fn late_volatile(pair: Pair) {
    let mut link = Link::of(pair.0.writer(0, OFFERED));
    link.publish(1..=10);
    let now = Qos {
        durability: Durability::Volatile,
        ..ASKED
    };
    link.join(pair.1.reader(0, now));
    link.greet(1);
    link.publish(11..=30);
    link.wait("last frame", |link| link.taken()[0].last() == Some(&30));
    link.listen(SETTLES);
    assert_eq!(link.taken(), [numbers(11..=30)]);
}

/// A writer that sends nothing again, and a reader that wants all.
pub(crate) fn wrong_reliability(pair: Pair) {
    let best_effort = Qos {
        reliability: Reliability::BestEffort,
        ..OFFERED
    };
    refuses(pair, best_effort);
}

/// A writer without history, and a reader that wants it.
pub(crate) fn wrong_durability(pair: Pair) {
    let volatile = Qos {
        durability: Durability::Volatile,
        ..OFFERED
    };
    refuses(pair, volatile);
}

/// Each side says once that the other one does not fit, and no frame arrives.
fn refuses(pair: Pair, offered: Qos) {
    let mut link = Link::open(pair, offered, ASKED);
    link.wait("refusal by the writer", |link| {
        link.writer.incompatible() > 0
    });
    link.wait("refusal by the reader", |link| {
        link.listeners[0].reader.incompatible() > 0
    });
    link.publish(1..=20);
    link.listen(SETTLES);
    assert_eq!(link.taken(), [&[][..]]);
    let reader = link.listeners[0].reader.incompatible();
    assert_eq!((link.writer.incompatible(), reader), (1, 1));
}

/// A writer of Tandem serves two readers. The third one is refused and counted.
pub(crate) fn third_reader(pair: Pair) {
    let mut link = Link::open(pair, OFFERED, ASKED);
    link.join(pair.1.reader(0, ASKED));
    link.join(pair.1.reader(0, ASKED));
    link.wait("refusal", |link| link.writer.refused() > 0);
    link.greet(READERS);
    link.publish(1..=50);
    link.wait("last frame", |link| {
        let mut taken = link.taken();
        taken.retain(|taken| taken.len() >= 50);
        taken.len() >= READERS
    });
    link.listen(SETTLES);
    let mut taken = link.taken();
    taken.sort_by_key(|taken| taken.len());
    assert_eq!(taken, [vec![], numbers(1..=50), numbers(1..=50)]);
    assert!(link.writer.refused() > 0);
}

/// Of the datagrams in each direction, 20 % are lost by chance: frames, heartbeats, requests, and
/// what discovery repeats. Nothing is lost before the peers have found each other.
///
/// Most frames arrive, once and in their order. A reader of Tandem counts the others.
pub(crate) fn loss(pair: Pair) {
    let relay = Relay::between([0, 1], seed());
    let mut link = Link::of(pair.0.writer(0, OFFERED));
    link.join(pair.1.reader(1, ASKED));
    link.greet(1);
    link.listen(SETTLES);
    let bar = arrives_percent(pair.1);
    let shares = (0..ROUNDS).map(|round| lossy_round(&mut link, &relay, round * LOSSY));
    assert!(
        shares.into_iter().any(|share| share >= bar),
        "less than {bar} %"
    );
}

/// Publishes frames while datagrams are lost, and judges what arrives. Returns its share, %.
///
/// A writer of dust_dds waits until its oldest frame is acknowledged. So it is slower than its
/// period, and loses nothing.
fn lossy_round(link: &mut Link, relay: &Relay, before: u32) -> f64 {
    link.listeners[0].taken.clear();
    let counted_before = link.listeners[0].reader.lost();
    relay.lose(LOSS_PERCENT);
    let numbers = before + 1..=before + LOSSY;
    let published: Vec<u32> = numbers.filter(|number| link.write(*number)).collect();
    // Nothing replaces the last frame, so it arrives in the end, and all others before it.
    link.wait("last frame", |link| {
        link.taken()[0].last() == published.last()
    });
    relay.lose(0);
    let published = published.len();
    let counted_after = link.listeners[0].reader.lost();
    let taken = link.taken()[0];
    let share = taken.len() as f64 * 100.0 / published as f64;
    let Relayed { all, lost } = relay.relayed();
    figure(&format!(
        "{share:.1} % ({} of {published} frames arrived, {lost} of {all} datagrams were lost)",
        taken.len()
    ));
    assert!(taken.is_sorted_by(|a, b| a < b), "{taken:?}");
    assert!(lost * 100 > all * 15 && all > LOSSY, "{lost} of {all}");
    if let Some((after, before)) = counted_after.zip(counted_before) {
        let missing = published - taken.len();
        assert_eq!((after - before) as usize, missing, "{taken:?}");
    }
    share
}

/// Returns the share of frames that a reader of this vendor gets at least, %. A writer keeps each
/// frame for three periods, so the share depends on how often the reader asks.
const fn arrives_percent(reader: Vendor) -> f64 {
    match reader {
        // Each 5 ms. That of Cyclone is configured to: else it asks once, and gets 93 %.
        Vendor::Tandem | Vendor::Cyclone => 95.0,
        // It asks only when a heartbeat arrives, and drops each frame behind a missing one. It gets
        // 90 to 97 %.
        Vendor::Dust => 85.0,
    }
}
