//! Heartbeats on two redundant lines: one sender, one receiver for both lines. T-RED-3

use tandem_board::{Duration, Edge, Instant};

/// Sends a heartbeat every period: an edge on each line, rising and falling in turn.
#[derive(Clone, Debug)]
pub struct BeatSender {
    period: Duration,
    next: Option<Instant>,
    edge: Edge,
    sent: u32,
    last: Instant,
}

/// One heartbeat to be sent now, on both lines.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Beat {
    /// The type of the edge.
    pub edge: Edge,
}

impl BeatSender {
    /// A sender that is off.
    #[must_use]
    pub const fn new(period: Duration) -> Self {
        Self {
            period,
            next: None,
            edge: Edge::Rising,
            sent: 0,
            last: Instant::ORIGIN,
        }
    }

    /// Starts sending, the first heartbeat at once; no effect if it sends already.
    pub fn start(&mut self, now: Instant) {
        self.next = self.next.or(Some(now));
    }

    /// Stops sending.
    pub fn stop(&mut self) {
        self.next = None;
    }

    /// The heartbeat that is due, if one is. The schedule does not drift; after a stall it goes on
    /// from `now`, without a burst of what was missed.
    #[must_use]
    pub fn poll(&mut self, now: Instant) -> Option<Beat> {
        let due = self.next.filter(|&due| due <= now)?;
        let following = due + self.period;
        self.next = Some(if following > now {
            following
        } else {
            now + self.period
        });
        self.sent = self.sent.wrapping_add(1);
        self.last = now;
        let edge = self.edge;
        self.edge = match edge {
            Edge::Rising => Edge::Falling,
            Edge::Falling => Edge::Rising,
        };
        Some(Beat { edge })
    }

    /// When the next heartbeat is due; [`Instant::NEVER`] while off.
    #[must_use]
    pub fn due(&self) -> Instant {
        self.next.unwrap_or(Instant::NEVER)
    }

    /// How many heartbeats were sent; wraps around.
    #[must_use]
    pub const fn sent(&self) -> u32 {
        self.sent
    }
}

/// What changed on a line at an update.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LineChange {
    /// The line went silent.
    Silent,
    /// Edges come again.
    Back,
}

#[derive(Clone, Copy, Debug)]
struct LineState {
    counted: u32,
    last_edge: Instant,
    silent: bool,
    received: u32,
}

/// Watches the heartbeats of the other system on both lines.
///
/// It works on the running counts of edges, which wrap around and which a reset of the core does
/// not clear, so only differences matter; and on time limits, so that a drift between the two
/// systems' periods is no false alarm, as it is when a count of sent heartbeats is compared.
#[derive(Clone, Debug)]
pub struct BeatReceiver {
    limit: Duration,
    lines: [LineState; 2],
    alive_since: Option<Instant>,
}

impl BeatReceiver {
    /// A receiver for lines that go silent after `limit` without an edge. `counts` are the counts
    /// at the moment; both lines begin silent.
    #[must_use]
    pub fn new(limit: Duration, counts: [u32; 2], now: Instant) -> Self {
        let line = |counted| LineState {
            counted,
            last_edge: now,
            silent: true,
            received: 0,
        };
        Self {
            limit,
            lines: counts.map(line),
            alive_since: None,
        }
    }

    /// Takes the current counts; returns what changed on line 1 and 2.
    pub fn update(&mut self, now: Instant, counts: [u32; 2]) -> [Option<LineChange>; 2] {
        let limit = self.limit;
        let mut changes = [None; 2];
        for ((line, counted), change) in self.lines.iter_mut().zip(counts).zip(&mut changes) {
            let new = counted.wrapping_sub(line.counted);
            line.counted = counted;
            line.received = line.received.wrapping_add(new);
            if new > 0 {
                line.last_edge = now;
                *change = line.silent.then_some(LineChange::Back);
                line.silent = false;
            } else if !line.silent && now.since(line.last_edge) > limit {
                line.silent = true;
                *change = Some(LineChange::Silent);
            }
        }
        if self.both_silent() {
            self.alive_since = None;
        } else if self.alive_since.is_none() {
            self.alive_since = Some(now);
        }
        changes
    }

    /// Takes both lines for alive with an edge at `from`, which may lie in the future: the other
    /// system is known to begin now, and gets that long for its first heartbeat.
    pub fn expect(&mut self, from: Instant) {
        for line in &mut self.lines {
            line.silent = false;
            line.last_edge = from;
        }
        self.alive_since = Some(from);
    }

    /// Restarts the time limits of the lines that are not silent: after a stall of the receiver
    /// itself, whose absence is no evidence against the sender.
    pub fn forgive(&mut self, now: Instant) {
        for line in self.lines.iter_mut().filter(|line| !line.silent) {
            line.last_edge = line.last_edge.max(now);
        }
    }

    /// Whether line 1 and line 2 are silent.
    #[must_use]
    pub fn silent(&self) -> [bool; 2] {
        self.lines.map(|line| line.silent)
    }

    /// Looks at line 1, and only if that is silent at line 2: both silent means that the other
    /// failed.
    #[must_use]
    pub fn both_silent(&self) -> bool {
        self.lines[0].silent && self.lines[1].silent
    }

    /// Time since the last edge on either line.
    #[must_use]
    pub fn silent_for(&self, now: Instant) -> Duration {
        now.since(self.lines[0].last_edge.max(self.lines[1].last_edge))
    }

    /// For how long heartbeats have come without both lines being silent; zero while they are.
    #[must_use]
    pub fn alive_for(&self, now: Instant) -> Duration {
        self.alive_since
            .map_or(Duration::ZERO, |since| now.since(since))
    }

    /// How many heartbeats came on each line since [`BeatReceiver::new`]; wraps around.
    #[must_use]
    pub fn received(&self) -> [u32; 2] {
        self.lines.map(|line| line.received)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::vec::Vec;

    const LIMIT: Duration = Duration::from_ms(4);

    fn at_us(us: u64) -> Instant {
        Instant::from_ns(us * 1_000)
    }

    #[test]
    fn sends_every_period_without_drift_and_without_bursts() {
        let mut sender = BeatSender::new(Duration::from_ms(1));
        assert_eq!(sender.poll(at_us(0)), None);
        assert_eq!(sender.due(), Instant::NEVER);
        sender.start(at_us(100));
        let mut sent = Vec::new();
        // Polled late by up to 0.4 ms, then held up from 6.3 to 20.5 ms.
        for us in [
            100, 1_400, 2_100, 3_300, 4_100, 5_500, 6_300, 20_500, 20_600, 21_500, 22_500,
        ] {
            if let Some(beat) = sender.poll(at_us(us)) {
                sent.push((us, beat.edge));
            }
        }
        let times: Vec<u64> = sent.iter().map(|&(us, _)| us).collect();
        let expected = [
            100, 1_400, 2_100, 3_300, 4_100, 5_500, 6_300, 20_500, 21_500, 22_500,
        ];
        assert_eq!(times, expected);
        assert!(
            sent.windows(2).all(|pair| pair[0].1 != pair[1].1),
            "the edges alternate"
        );
        assert_eq!(sender.sent(), 10);
        sender.stop();
        assert_eq!(sender.poll(at_us(30_000)), None);
    }

    /// Feeds one edge per millisecond on the lines that are whole, from counts just below
    /// wrap-around, and returns the receiver after `ms` milliseconds.
    fn fed(whole: [bool; 2], ms: u64) -> BeatReceiver {
        let mut counts = [u32::MAX - 5, u32::MAX];
        let mut receiver = BeatReceiver::new(LIMIT, counts, at_us(0));
        receiver.expect(at_us(0));
        for tick in 1..=ms {
            for line in 0..2 {
                counts[line] = counts[line].wrapping_add(u32::from(whole[line]));
            }
            let _ = receiver.update(at_us(tick * 1_000), counts);
        }
        receiver
    }

    /// T-RED-3: line 1, and only if it fails line 2; one broken line is no failure but is reported;
    /// counts wrap around unnoticed.
    #[test]
    fn one_silent_line_is_no_failure() {
        for (whole, silent, failed) in [
            ([true, true], [false, false], false),
            ([false, true], [true, false], false),
            ([true, false], [false, true], false),
            ([false, false], [true, true], true),
        ] {
            let receiver = fed(whole, 20);
            assert_eq!(receiver.silent(), silent);
            assert_eq!(receiver.both_silent(), failed);
            let expected = whole.map(|whole| if whole { 20 } else { 0 });
            assert_eq!(receiver.received(), expected);
        }
    }

    /// T-RED-3: silence is what lasts longer than the limit, told once; so is the return.
    #[test]
    fn silence_begins_after_the_limit_and_ends_with_an_edge() {
        let mut receiver = fed([true, true], 10);
        let counts = [u32::MAX.wrapping_add(5), u32::MAX.wrapping_add(10)];
        let last = at_us(10_000);
        assert_eq!(receiver.update(last + LIMIT, counts), [None, None]);
        let late = last + LIMIT + Duration::from_ns(1);
        assert_eq!(receiver.update(late, counts), [Some(LineChange::Silent); 2]);
        assert_eq!(receiver.update(late, counts), [None, None]);
        assert!(receiver.both_silent());
        assert_eq!(receiver.alive_for(late), Duration::ZERO);
        let back = late + Duration::from_ms(50);
        let changes = receiver.update(back, [counts[0], counts[1] + 1]);
        assert_eq!(changes, [None, Some(LineChange::Back)]);
        let later = back + Duration::from_ms(3);
        assert_eq!(receiver.alive_for(later), Duration::from_ms(3));
    }

    /// T-RED-3: two clocks that drift apart by 1 % never raise a false alarm, though the counts of
    /// sent and received heartbeats differ soon.
    #[test]
    fn a_drift_of_phase_is_no_false_alarm() {
        let mut receiver = BeatReceiver::new(LIMIT, [0, 0], at_us(0));
        receiver.expect(at_us(0));
        for own in 1..20_000u64 {
            // The sender's period is 1.01 ms; the receiver looks every millisecond.
            let count = (own * 1_000 / 1_010) as u32;
            assert_eq!(
                receiver.update(at_us(own * 1_000), [count, count]),
                [None, None]
            );
        }
        assert_eq!(receiver.received(), [19_800, 19_800]);
    }

    #[test]
    fn own_absence_is_forgiven_only_for_lines_that_were_alive() {
        let mut receiver = fed([false, true], 10);
        let counts = [u32::MAX - 5, u32::MAX.wrapping_add(10)];
        receiver.forgive(at_us(500_000));
        assert_eq!(receiver.update(at_us(503_000), counts), [None, None]);
        assert_eq!(receiver.silent(), [true, false]);
    }
}
