//! The last minute of a run, for the charts of the page.

use std::collections::VecDeque;
use std::time::Duration;

use tandem_board::Instant;
use tandem_cores::driving::types::{Scene, Trajectory};
use tandem_observers::{Frame, News, Roles};
use tandem_watch::{DrivingView, Picture};

/// The charts cover this time, s.
pub(crate) const SPAN_S: f64 = 60.0;
/// Most stored moments. A run publishes ten in a second.
const MOMENTS: usize = 620;
/// Most stored takeovers, for the marks in the charts.
const TAKEOVERS: usize = 64;

/// The state at one moment of the run.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Moment {
    /// Scenario time, s.
    pub(crate) time_s: f64,
    /// The codes of [`Roles::state`].
    pub(crate) state: [u8; 2],
    /// The longest gap between two accepted control frames since the moment before, ms.
    pub(crate) gap_ms: f64,
    /// Distance from the centre of the lane, positive to the left, m; NaN without a vehicle.
    pub(crate) lateral_m: f64,
}

/// The state of a run, and how it has changed.
pub(crate) struct History {
    /// The newest state.
    pub(crate) picture: Picture,
    /// The last minute, the newest last.
    pub(crate) moments: VecDeque<Moment>,
    /// Scenario times at which the obeyed system changed, s.
    pub(crate) takeovers_s: VecDeque<f64>,
    /// What the sensors show of the road, and the path that follows from it; `None` before the
    /// first round of the sensors.
    pub(crate) seen: Option<(Scene, Trajectory)>,
    driving: DrivingView,
    /// What the last hand did, in words.
    pub(crate) said: String,
}

impl History {
    /// Returns the history of this run before its first message.
    pub(crate) fn new(run: &str) -> Self {
        Self {
            picture: Picture::new(run),
            moments: VecDeque::new(),
            takeovers_s: VecDeque::new(),
            seen: None,
            driving: DrivingView::new(),
            said: String::new(),
        }
    }

    /// Adds `span` to the time without messages.
    pub(crate) fn tick(&mut self, span: Duration) {
        self.picture.tick(span);
    }

    /// Adds a message of the run.
    pub(crate) fn take(&mut self, news: &News) {
        let before = self.picture.roles;
        self.picture.take(news);
        if let News::Frame(frame) = news {
            self.perceive(frame);
        }
        let News::Roles(now) = news else { return };
        if before.is_some_and(|before| before.takeovers < now.takeovers) {
            push(&mut self.takeovers_s, now.time_s, TAKEOVERS);
        }
        self.remember(now);
    }

    fn perceive(&mut self, frame: &Frame) {
        let data = frame.data.get(..frame.length.into());
        // All messages of the vehicle have identifiers of 11 bits.
        if let (Some(data), 0) = (data, frame.flags & 1) {
            let at = Instant::from_ns(frame.at_ns);
            if let Some(seen) = self.driving.take(at, frame.id, data) {
                self.seen = Some(seen);
            }
        }
    }

    fn remember(&mut self, now: &Roles) {
        let moment = Moment {
            time_s: now.time_s,
            state: now.state,
            gap_ms: self.picture.gaps_ms.back().copied().unwrap_or(0.0),
            lateral_m: self.picture.vehicle.map_or(f64::NAN, |it| it.lateral_error),
        };
        push(&mut self.moments, moment, MOMENTS);
        let begin_s = now.time_s - SPAN_S;
        self.moments.retain(|moment| moment.time_s >= begin_s);
        self.takeovers_s.retain(|time_s| *time_s >= begin_s);
    }

    /// Returns the scenario times of the charts' ends, s.
    pub(crate) fn span_s(&self) -> (f64, f64) {
        let end_s = self.picture.roles.map_or(0.0, |roles| roles.time_s);
        let begin_s = (end_s - SPAN_S).max(0.0);
        (begin_s, end_s.max(begin_s + SPAN_S))
    }
}

fn push<T>(into: &mut VecDeque<T>, value: T, most: usize) {
    if into.len() == most {
        into.pop_front();
    }
    into.push_back(value);
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use tandem_observers::{Event, Frame, Vehicle};

    /// Returns a run of 90 s in which B has taken over from A at 80 s.
    pub(crate) fn history() -> History {
        let mut history = History::new("tandem-6796-62fc9754a45");
        for tenth in 0..900_u32 {
            let time_s = f64::from(tenth) / 10.0;
            let at_ns = u64::from(tenth) * 100_000_000 + 1_000_000_000;
            let is_taken = tenth >= 800;
            for step in 0..10 {
                let at_ns = at_ns + step * 10_000_000;
                history.take(&News::Frame(Frame::new(at_ns, 0x100, 2, 1, &[])));
            }
            history.take(&News::Vehicle(Vehicle {
                speed: 30.0,
                lateral_error: 0.2,
                lead_gap: 48.0,
                lane: 1,
                ..Vehicle::default()
            }));
            history.take(&News::Roles(Roles {
                at_ns,
                time_s,
                duration_s: 120.0,
                gap_max_ms: 18.0,
                takeover_gap_ms: 18.0,
                takeovers: u32::from(is_taken),
                term: 12 + u32::from(is_taken),
                obeyed: u8::from(is_taken),
                state: if is_taken { [0, 4] } else { [3, 2] },
                alive: [1; 6],
                beats: [3, 3],
                ..Roles::default()
            }));
        }
        let text = "takes over: <power level> fell";
        history.take(&News::Event(Event::new(81_000_000_000, 1, 0, text)));
        history
    }

    #[test]
    fn the_last_minute_is_kept() {
        let history = history();
        let (begin_s, end_s) = history.span_s();
        assert!((begin_s - 29.9).abs() < 1e-9 && (end_s - 89.9).abs() < 1e-9);
        assert!(history.moments.iter().all(|it| it.time_s >= begin_s));
        assert!((600..=601).contains(&history.moments.len()));
        assert_eq!(history.takeovers_s, [80.0]);
    }
}
