//! The state that `tandem top` shows, collected from the messages that a run publishes.

use std::collections::VecDeque;
use std::time::Duration;

use tandem_board::SystemId;
use tandem_board_host::services::{Event, News, Roles, Vehicle};

/// Number of stored events and gaps: as many as the screen can show.
const EVENTS: usize = 32;
const GAPS: usize = 76;
/// The value of [`tandem_board_host::services::Frame::verdict`] for an accepted control frame.
const ACCEPTED: u8 = 1;
/// A run that publishes nothing for this long counts as ended.
const SILENT: Duration = Duration::from_secs(2);

/// The state on the screen.
pub(super) struct Picture {
    pub(super) run: String,
    pub(super) roles: Option<Roles>,
    pub(super) vehicle: Option<Vehicle>,
    /// Events, the newest last.
    pub(super) events: VecDeque<Event>,
    /// The longest gap in each tenth of a second, ms; the newest last.
    pub(super) gaps_ms: VecDeque<f64>,
    /// Number of frames on the bus in the last `span_ns`.
    frames: u32,
    span_ns: u64,
    /// The system that keys act on.
    pub(super) selected: SystemId,
    /// A description of the last action.
    pub(super) said: String,
    /// Time of the last accepted frame, ns.
    accepted_ns: Option<u64>,
    counted: u32,
    longest_ms: f64,
    silent: Duration,
}

impl Picture {
    pub(super) fn new(run: &str) -> Self {
        Self {
            run: run.to_owned(),
            roles: None,
            vehicle: None,
            events: VecDeque::new(),
            gaps_ms: VecDeque::new(),
            frames: 0,
            span_ns: 0,
            selected: SystemId::A,
            said: String::new(),
            accepted_ns: None,
            counted: 0,
            longest_ms: 0.0,
            silent: Duration::ZERO,
        }
    }

    /// Returns true if the run has stopped publishing.
    pub(super) fn has_ended(&self) -> bool {
        self.silent >= SILENT
    }

    /// Returns the number of frames on the bus per second.
    pub(super) fn frames_per_s(&self) -> u64 {
        u64::from(self.frames) * 1_000_000_000 / self.span_ns.max(1)
    }

    /// Adds `span`, which passed without a key press, to the time without messages.
    pub(super) fn tick(&mut self, span: Duration) {
        self.silent += span;
    }

    pub(super) fn take(&mut self, news: &News) {
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
