//! How much core 0 reads from sources that another system can flood, and how it reports a flood.
//!
//! The most urgent task reads CAN, the link and the lines. Each limit here bounds the work of one
//! poll. [`DOORBELL_DISTANCE`](crate::doorbell::DOORBELL_DISTANCE) bounds how often an interrupt
//! causes a poll. So the worst case of the task is a sum of constants: see `docs/rtos-tasks.md`.

use crate::trace::{Event, FloodSource};
use strum::VariantArray;
use tandem_board::{Duration, Instant};
use tandem_redundancy::LineSnapshot;

/// Frames that one poll takes from the CAN receiver. A bus of 1 Mbit/s carries at most 20 frames
/// in a millisecond, so one poll also empties what has arrived while the core was held up for 3 ms.
/// Frames beyond the limit wait in the receiver for the next poll.
pub const CAN_FRAMES: u32 = 64;

/// Datagrams that one poll takes from the link: as many as a link holds. The newest valid report
/// counts. In a control cycle the other system sends a report (each millisecond with the profile of
/// a chip), its command, and a request or two chunks while one system joins.
pub const LINK_DATAGRAMS: u32 = 16;

/// Edges in a millisecond beyond which a line is flooded. Edges are counters: a flood costs no time
/// and loses nothing. A heartbeat line has 1 edge in a millisecond.
pub const EDGES_PER_MS: u32 = 4;

/// A flood is reported at most once in this time for each source.
const WINDOW: Duration = Duration::from_ms(100);

/// A source floods if it has exceeded its limit this many times within [`WINDOW`]. One burst after
/// a stall of this core is not a flood. At most 20 doorbells pass in this time; this is half.
const EXCEEDED: u32 = 10;

/// The activity of a source since the last report.
#[derive(Clone, Copy, Debug, Default)]
struct Excess {
    times: u32,
    beyond: u32,
}

/// Counts the events beyond the limits.
#[derive(Debug)]
pub(super) struct Floods {
    since: Instant,
    sources: [Excess; FloodSource::VARIANTS.len()],
    /// Counts of the last poll and when it was.
    lines: Option<(Instant, LineSnapshot)>,
    /// Running counts of the last poll.
    can_overruns: u32,
    doorbells: u32,
}

impl Floods {
    pub(super) fn new(now: Instant) -> Self {
        Self {
            since: now,
            sources: Default::default(),
            lines: None,
            can_overruns: 0,
            doorbells: 0,
        }
    }

    fn exceeded(&mut self, source: FloodSource, beyond: u32) {
        let excess = &mut self.sources[source as usize];
        excess.times = excess.times.saturating_add(1);
        excess.beyond = excess.beyond.saturating_add(beyond);
    }

    /// Called when a poll has taken as many frames as it may. `overruns`: running count of the
    /// frames that the receiver has lost.
    pub(super) fn can(&mut self, overruns: u32) {
        let lost = overruns.wrapping_sub(core::mem::replace(&mut self.can_overruns, overruns));
        self.exceeded(FloodSource::Can, lost);
    }

    /// Called when a poll has taken as many datagrams as it may, and has used one of them.
    pub(super) fn link(&mut self) {
        self.exceeded(FloodSource::Link, LINK_DATAGRAMS - 1);
    }

    /// `held_back`: running count of [`super::Executor::held_back`].
    pub(super) fn doorbells(&mut self, held_back: u32) {
        let new = held_back.wrapping_sub(core::mem::replace(&mut self.doorbells, held_back));
        for _ in 0..new.min(EXCEEDED) {
            self.exceeded(FloodSource::Doorbell, 1);
        }
    }

    /// Compares the counts of the lines with those of the last poll.
    pub(super) fn lines(&mut self, now: Instant, counts: &LineSnapshot) {
        let Some((at, last)) = self.lines.replace((now, *counts)) else {
            return;
        };
        // A poll may fall within a millisecond: count the part at each end as a whole millisecond.
        let ms = u32::try_from(now.since(at).as_us() / 1_000).unwrap_or(u32::MAX);
        let allowed = EDGES_PER_MS.saturating_mul(ms.saturating_add(2));
        let new = |now: u32, last: u32| now.wrapping_sub(last);
        let start =
            new(counts.handshakes, last.handshakes).saturating_add(new(counts.syncs, last.syncs));
        let [beats1, beats2] = [0, 1].map(|line: usize| new(counts.beats[line], last.beats[line]));
        for (source, edges) in [
            (FloodSource::StartLine, start),
            (FloodSource::HeartbeatLines, beats1.max(beats2)),
        ] {
            if edges > allowed {
                self.exceeded(source, edges - allowed);
            }
        }
    }

    /// Returns the floods to report now.
    pub(super) fn events(&mut self, now: Instant) -> impl Iterator<Item = Event> + use<> {
        let over = now.since(self.since) >= WINDOW;
        let sources = if over {
            self.since = now;
            core::mem::take(&mut self.sources)
        } else {
            Default::default()
        };
        let all = FloodSource::VARIANTS.iter().copied().zip(sources);
        all.filter(|(_, excess)| excess.times >= EXCEEDED).map(
            |(source, Excess { times, beyond })| Event::Flood {
                source,
                times,
                beyond,
            },
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at_us(us: u64) -> Instant {
        Instant::from_ns(us * 1_000)
    }

    fn snapshot(edges: u32) -> LineSnapshot {
        LineSnapshot {
            handshakes: 0,
            syncs: 0,
            beats: [edges, edges / 2],
            peer_powered: true,
            can_frames: 0,
        }
    }

    /// One edge a millisecond is not a flood, even if the edges are counted after a stall.
    #[test]
    fn only_a_rate_that_lasts_is_a_flood() {
        for (edges_per_ms, reported) in [(1, 0), (100, 9)] {
            let mut floods = Floods::new(at_us(0));
            let mut events = 0;
            let polls = (0..1_000).filter(|ms| !(300..350).contains(ms));
            for ms in polls {
                // The count wraps around during the test.
                let edges = (ms as u32 * edges_per_ms).wrapping_sub(5_000);
                floods.lines(at_us(ms * 1_000), &snapshot(edges));
                events += floods.events(at_us(ms * 1_000)).count();
            }
            assert_eq!(events, reported, "{edges_per_ms} edges in a millisecond");
        }
    }
}
