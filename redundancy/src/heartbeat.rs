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

    /// The heartbeat that is due, if one is. The schedule does not drift; after a stall it goes on from
    /// `now`, without a burst of what was missed.
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
/// It works on the running counts of edges, which wrap around and which a reset of the core does not
/// clear, so only differences matter; and on time limits, so that a drift between the two systems'
/// periods is no false alarm, as it is when a count of sent heartbeats is compared.
#[derive(Clone, Debug)]
pub struct BeatReceiver {
    limit: Duration,
    lines: [LineState; 2],
    alive_since: Option<Instant>,
}

impl BeatReceiver {
    /// A receiver for lines that go silent after `limit` without an edge. `counts` are the counts at the
    /// moment; both lines begin silent.
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

    /// Takes both lines for alive with an edge at `from`, which may lie in the future: the other system
    /// is known to begin now, and gets that long for its first heartbeat.
    pub fn expect(&mut self, from: Instant) {
        for line in &mut self.lines {
            line.silent = false;
            line.last_edge = from;
        }
        self.alive_since = Some(from);
    }

    /// Restarts the time limits of the lines that are not silent: after a stall of the receiver itself,
    /// whose absence is no evidence against the sender.
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

    /// Looks at line 1, and only if that is silent at line 2: both silent means that the other failed.
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
