//! The state that the live views show, collected from the messages that a run publishes.

use std::collections::VecDeque;
use std::time::Duration;

use tandem_board::SystemId;
use tandem_bus::{AbilityCode, Message};
use tandem_observers::{Event, Frame, News, Roles, Vehicle};

/// Number of stored events and gaps: as many as the terminal can show.
const EVENTS: usize = 32;
const GAPS: usize = 76;
/// The value of [`tandem_observers::Frame::ruling`] for an accepted control frame.
const ACCEPTED: u8 = 1;
/// A bit of [`Frame::flags`]: the identifier has 29 bits.
const EXTENDED: u8 = 1;
/// The value of [`Roles::state`] of a standby.
const STANDBY: u8 = 2;
/// Most stored times without redundancy.
const ALONE: usize = 64;
/// A shorter time without redundancy is only the change of the roles at a takeover, s.
const ALONE_S: f64 = 0.25;
/// Names of a system's states, in the order of the codes of [`Roles::state`].
const STATES: [&str; 8] = [
    "off",
    "starting",
    "standby",
    "master",
    "degraded master",
    "safe stop",
    "suspended",
    "parking",
];
/// A run that publishes nothing for this long counts as ended.
const SILENT: Duration = Duration::from_secs(2);

/// Returns the name of a system's state by its code in [`Roles::state`].
#[must_use]
pub fn state_name(code: u8) -> &'static str {
    STATES.get(usize::from(code)).copied().unwrap_or("unknown")
}

/// A time without redundancy: no system that could drive stood by.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Alone {
    /// The scenario time at which it began, s.
    pub since_s: f64,
    /// The scenario time at which a system stood by again, s; `None` while none does.
    pub until_s: Option<f64>,
}

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
    /// The times without redundancy, the newest last.
    pub alone: VecDeque<Alone>,
    /// Whether each system has last reported that it could drive.
    able: [bool; 2],
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
            alone: VecDeque::new(),
            able: [true; 2],
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

    /// Returns the scenario time since which no system that could drive stands by, s; `None` if one
    /// does, or if no system has driven yet.
    #[must_use]
    pub fn alone_since_s(&self) -> Option<f64> {
        let last = self.alone.back()?;
        last.until_s.is_none().then_some(last.since_s)
    }

    /// Notes whether a system stands by that could drive.
    fn judge_redundancy(&mut self, now: &Roles) {
        let drives = usize::from(now.obeyed) < SystemId::ALL.len();
        let stands_by = { now.state.iter().zip(self.able) }
            .any(|(state, is_able)| *state == STANDBY && is_able);
        match self.alone.back_mut().filter(|it| it.until_s.is_none()) {
            Some(last) if stands_by => {
                last.until_s = Some(now.time_s);
                if now.time_s - last.since_s < ALONE_S {
                    self.alone.pop_back();
                }
            }
            None if drives && !stands_by => {
                let since = Alone {
                    since_s: now.time_s,
                    until_s: None,
                };
                push(&mut self.alone, since, ALONE);
            }
            _ => {}
        }
    }

    /// Notes whether the sender of a status frame could drive.
    fn hear(&mut self, frame: &Frame) {
        let data = frame.data.get(..frame.length.into()).unwrap_or_default();
        if frame.flags & EXTENDED == 0
            && let Ok(Message::Status { system, status }) = Message::decode(frame.id, data)
            && let Some(able) = self.able.get_mut(usize::from(system))
        {
            *able = !matches!(status.ability, AbilityCode::StopOnly | AbilityCode::None);
        }
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
                self.judge_redundancy(roles);
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
                self.hear(frame);
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

#[cfg(test)]
mod tests {
    use super::*;

    fn roles(tenth: u32, state: [u8; 2], obeyed: u8) -> News {
        News::Roles(Roles {
            at_ns: u64::from(tenth) * 100_000_000,
            time_s: f64::from(tenth) / 10.0,
            state,
            obeyed,
            ..Roles::default()
        })
    }

    /// Redundancy is lost when the standby is gone, and back when a system stands by again. Roles
    /// that change at a takeover are no loss.
    #[test]
    fn one_system_alone_is_noted_with_its_times() {
        let mut picture = Picture::new("tandem-1-a");
        picture.take(&roles(0, [1, 1], u8::MAX));
        assert_eq!(picture.alone_since_s(), None, "no system drives yet");
        picture.take(&roles(1, [3, 2], 0));
        picture.take(&roles(10, [0, 4], 1));
        assert_eq!(picture.alone_since_s(), Some(1.0));
        picture.take(&roles(40, [2, 4], 1));
        assert_eq!(picture.alone_since_s(), None);
        // A planned change of the driver.
        picture.take(&roles(50, [3, 3], 0));
        picture.take(&roles(51, [3, 2], 0));
        let alone = Alone {
            since_s: 1.0,
            until_s: Some(4.0),
        };
        assert_eq!(picture.alone, [alone]);
    }
}
