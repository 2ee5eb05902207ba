//! Heartbeats on two redundant lines: one sender, one receiver for both lines. T-RED-3

use tandem_board::{Duration, Edge, Instant};

/// Sends a heartbeat every period: an edge on each line, rising and falling in turn.
#[derive(Clone, Debug)]
pub(crate) struct BeatSender {
    period: Duration,
    next: Option<Instant>,
    edge: Edge,
    sent: u32,
}

impl BeatSender {
    /// Creates a sender that is off.
    pub(crate) const fn new(period: Duration) -> Self {
        Self {
            period,
            next: None,
            edge: Edge::Rising,
            sent: 0,
        }
    }

    /// Starts sending, the first heartbeat at once; no effect if it sends already.
    pub(crate) fn start(&mut self, now: Instant) {
        self.next = self.next.or(Some(now));
    }

    /// Stops sending.
    pub(crate) fn stop(&mut self) {
        self.next = None;
    }

    /// Returns the edge to send now on both lines, if a heartbeat is due. The schedule does not
    /// drift. After a stall it continues from `now`, without a burst of the missed heartbeats.
    pub(crate) fn poll(&mut self, now: Instant) -> Option<Edge> {
        let due = self.next.filter(|&due| due <= now)?;
        let following = due + self.period;
        self.next = Some(if following > now {
            following
        } else {
            now + self.period
        });
        self.sent = self.sent.wrapping_add(1);
        let edge = self.edge;
        self.edge = match edge {
            Edge::Rising => Edge::Falling,
            Edge::Falling => Edge::Rising,
        };
        Some(edge)
    }

    /// Returns the time at which the next heartbeat is due; [`Instant::NEVER`] while off.
    pub(crate) fn due(&self) -> Instant {
        self.next.unwrap_or(Instant::NEVER)
    }

    /// Returns the number of heartbeats sent; wraps around.
    pub(crate) const fn sent(&self) -> u32 {
        self.sent
    }
}

/// A change on a line at an update.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum LineChange {
    /// The line went silent.
    Silent,
    /// The line carries edges again.
    Back,
}

#[derive(Clone, Copy, Debug)]
struct LineState {
    last_edge: Instant,
    silent: bool,
    received: u32,
}

/// The witness of the two heartbeat lines.
///
/// It counts differences, because a reset of the core does not clear the counts of the lines. It
/// compares times, not counts of sent and received heartbeats: two periods that drift apart must
/// not raise a false alarm.
#[derive(Clone, Debug)]
pub(crate) struct BeatReceiver {
    limit: Duration,
    lines: [LineState; 2],
    alive_since: Option<Instant>,
}

impl BeatReceiver {
    /// Creates a receiver whose lines are silent after `limit` without an edge. Both begin silent.
    pub(crate) const fn new(limit: Duration, now: Instant) -> Self {
        let line = LineState {
            last_edge: now,
            silent: true,
            received: 0,
        };
        Self {
            limit,
            lines: [line; 2],
            alive_since: None,
        }
    }

    /// Takes the numbers of new edges; returns the changes on line 1 and 2.
    pub(crate) fn update(&mut self, now: Instant, new: [u32; 2]) -> [Option<LineChange>; 2] {
        let limit = self.limit;
        let mut changes = [None; 2];
        for ((line, new), change) in self.lines.iter_mut().zip(new).zip(&mut changes) {
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

    /// Assumes an edge on both lines at `from`, which may be in the future: the other system begins
    /// now, and its silence counts only from then on.
    pub(crate) fn expect(&mut self, from: Instant) {
        for line in &mut self.lines {
            line.silent = false;
            line.last_edge = from;
        }
        self.alive_since = Some(from);
    }

    /// Restarts the time limits of the lines that are not silent. Called after a stall of this
    /// system, which is not evidence against the other system.
    pub(crate) fn forgive(&mut self, now: Instant) {
        for line in self.lines.iter_mut().filter(|line| !line.silent) {
            line.last_edge = line.last_edge.max(now);
        }
    }

    /// Returns whether each of the two lines is silent.
    pub(crate) fn silent(&self) -> [bool; 2] {
        self.lines.map(|line| line.silent)
    }

    /// Returns whether both lines are silent. If only one is, the line is broken, not the system.
    pub(crate) fn both_silent(&self) -> bool {
        self.lines[0].silent && self.lines[1].silent
    }

    /// Returns the time of the last edge on either line.
    pub(crate) fn last_edge(&self) -> Instant {
        self.lines[0].last_edge.max(self.lines[1].last_edge)
    }

    /// Returns the time since the last edge on either line.
    pub(crate) fn silent_for(&self, now: Instant) -> Duration {
        now.since(self.last_edge())
    }

    /// Returns the time since the lines were last both silent; zero while they are.
    pub(crate) fn alive_for(&self, now: Instant) -> Duration {
        self.alive_since
            .map_or(Duration::ZERO, |since| now.since(since))
    }

    /// Returns the number of heartbeats received on each line so far; wraps around.
    pub(crate) fn received(&self) -> [u32; 2] {
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
        // The polls are up to 0.4 ms late, stop from 6.3 to 20.5 ms, then omit just one period.
        for us in [
            100, 1_400, 2_100, 3_300, 4_100, 5_500, 6_300, 20_500, 20_600, 21_500, 22_500, 24_500,
            24_600, 25_500,
        ] {
            if let Some(edge) = sender.poll(at_us(us)) {
                sent.push((us, edge));
            }
        }
        let times: Vec<u64> = sent.iter().map(|&(us, _)| us).collect();
        let expected = [
            100, 1_400, 2_100, 3_300, 4_100, 5_500, 6_300, 20_500, 21_500, 22_500, 24_500, 25_500,
        ];
        assert_eq!(times, expected);
        assert!(
            sent.windows(2).all(|pair| pair[0].1 != pair[1].1),
            "the edges alternate"
        );
        assert_eq!(sender.sent(), 12);
        sender.stop();
        assert_eq!(sender.poll(at_us(30_000)), None);
    }

    /// Sends one edge per millisecond to the receiver on the intact lines; returns the receiver
    /// after `ms` milliseconds.
    fn fed(whole: [bool; 2], ms: u64) -> BeatReceiver {
        let mut receiver = BeatReceiver::new(LIMIT, at_us(0));
        receiver.expect(at_us(0));
        for tick in 1..=ms {
            let _ = receiver.update(at_us(tick * 1_000), whole.map(u32::from));
        }
        receiver
    }

    /// T-RED-3: line 2 counts if line 1 fails; one broken line is not a failure but is reported.
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

    /// T-RED-3: a line is silent after more than the limit; silence and return are each reported
    /// once.
    #[test]
    fn silence_begins_after_the_limit_and_ends_with_an_edge() {
        let mut receiver = fed([true, true], 10);
        let last = at_us(10_000);
        assert_eq!(receiver.update(last + LIMIT, [0, 0]), [None, None]);
        let late = last + LIMIT + Duration::from_ns(1);
        assert_eq!(receiver.update(late, [0, 0]), [Some(LineChange::Silent); 2]);
        assert_eq!(receiver.update(late, [0, 0]), [None, None]);
        assert!(receiver.both_silent());
        assert_eq!(receiver.alive_for(late), Duration::ZERO);
        let back = late + Duration::from_ms(50);
        let changes = receiver.update(back, [0, 1]);
        assert_eq!(changes, [None, Some(LineChange::Back)]);
        let later = back + Duration::from_ms(3);
        assert_eq!(receiver.alive_for(later), Duration::from_ms(3));
    }

    /// T-RED-3: two clocks that drift apart by 1 % never raise a false alarm, although the sent and
    /// received counts of heartbeats soon differ.
    #[test]
    fn a_drift_of_phase_is_no_false_alarm() {
        let mut receiver = BeatReceiver::new(LIMIT, at_us(0));
        receiver.expect(at_us(0));
        let mut sent = 0;
        for own in 1..20_000u64 {
            // The sender's period is 1.01 ms; the receiver polls every millisecond.
            let new = (own * 1_000 / 1_010) as u32 - sent;
            sent += new;
            assert_eq!(
                receiver.update(at_us(own * 1_000), [new, new]),
                [None, None]
            );
        }
        assert_eq!(receiver.received(), [19_800, 19_800]);
    }

    #[test]
    fn own_absence_is_forgiven_only_for_lines_that_were_alive() {
        let mut receiver = fed([false, true], 10);
        receiver.forgive(at_us(500_000));
        assert_eq!(receiver.update(at_us(503_000), [0, 0]), [None, None]);
        assert_eq!(receiver.silent(), [true, false]);
    }
}
