//! The state that the live views show, collected from the messages that a run publishes.

use std::collections::VecDeque;
use std::time::Duration;

use tandem_board::SystemId;
use tandem_observers::{Event, News, Roles, Vehicle};

/// Number of stored events and gaps: as many as the terminal can show.
const EVENTS: usize = 32;
const GAPS: usize = 76;
/// The value of [`tandem_observers::Frame::ruling`] for an accepted control frame.
const ACCEPTED: u8 = 1;
/// A run that publishes nothing for this long counts as ended.
const SILENT: Duration = Duration::from_secs(2);

/// What a view shows of a run.
#[derive(Debug)]
pub struct Picture {
    /// The name of the run.
    pub run: String,
    /// The newest state of both systems; `None` before the first.
    pub roles: Option<Roles>,
    /// The newest state of the vehicle; `None` before the first.
    pub vehicle: Option<Vehicle>,
    /// Events, the newest last.
    pub events: VecDeque<Event>,
    /// The longest gap in each tenth of a second, ms; the newest last.
    pub gaps_ms: VecDeque<f64>,
    /// Number of frames on the bus in the last `span_ns`.
    frames: u32,
    span_ns: u64,
    /// Time of the last accepted frame, ns.
    accepted_ns: Option<u64>,
    counted: u32,
    longest_ms: f64,
    silent: Duration,
}

impl Picture {
    /// Returns the picture of this run before its first message.
    #[must_use]
    pub fn new(run: &str) -> Self {
        Self {
            run: run.to_owned(),
            roles: None,
            vehicle: None,
            events: VecDeque::new(),
            gaps_ms: VecDeque::new(),
            frames: 0,
            span_ns: 0,
            accepted_ns: None,
            counted: 0,
            longest_ms: 0.0,
            silent: Duration::ZERO,
        }
    }

    /// Returns true if the run has stopped publishing.
    #[must_use]
    pub fn has_ended(&self) -> bool {
        self.silent >= SILENT
    }

    /// Returns the number of frames on the bus per second.
    #[must_use]
    pub fn frames_per_s(&self) -> u64 {
        u64::from(self.frames) * 1_000_000_000 / self.span_ns.max(1)
    }

    /// Returns the system that the vehicle obeys; `None` before the first control frame.
    #[must_use]
    pub fn obeyed(&self) -> Option<SystemId> {
        let index = usize::from(self.roles?.obeyed);
        SystemId::ALL.get(index).copied()
    }

    /// Returns the run's clock at scenario time 0, ns.
    #[must_use]
    pub fn begin_ns(&self) -> u64 {
        self.roles.map_or(0, |roles| {
            roles.at_ns.saturating_sub((roles.time_s * 1e9) as u64)
        })
    }

    /// Adds `span` to the time without messages.
    pub fn tick(&mut self, span: Duration) {
        self.silent += span;
    }

    /// Says that the run has ended.
    pub fn end(&mut self) {
        self.silent = SILENT;
    }

    /// Adds a message of the run.
    pub fn take(&mut self, news: &News) {
        self.silent = Duration::ZERO;
        match news {
            News::Roles(roles) => {
                let before_ns = self.roles.replace(*roles).map_or(0, |before| before.at_ns);
                // If several of these messages arrive together, only the first follows any frames.
                if self.counted == 0 {
                    return;
                }
                self.span_ns = roles.at_ns.saturating_sub(before_ns);
                self.frames = std::mem::take(&mut self.counted);
                push(
                    &mut self.gaps_ms,
                    std::mem::take(&mut self.longest_ms),
                    GAPS,
                );
            }
            News::Vehicle(vehicle) => self.vehicle = Some(*vehicle),
            News::Frame(frame) => {
                self.counted += 1;
                if frame.ruling == ACCEPTED
                    && let Some(last_ns) = self.accepted_ns.replace(frame.at_ns)
                {
                    let gap_ms = frame.at_ns.saturating_sub(last_ns) as f64 * 1e-6;
                    self.longest_ms = self.longest_ms.max(gap_ms);
                }
            }
            News::Event(event) => push(&mut self.events, *event, EVENTS),
            News::Time(_) => {}
        }
    }
}

fn push<T>(into: &mut VecDeque<T>, value: T, most: usize) {
    if into.len() == most {
        into.pop_front();
    }
    into.push_back(value);
}
