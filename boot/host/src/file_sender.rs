//! The host's end of a download: connects, sends, repeats. Sans-IO. T-BOOT-3

use tandem_board::{CanFrame, Duration, Instant, SystemId};
use tandem_boot::{Answer, HostRequest, Refusal};

/// Time between two connect requests.
pub const CONNECT_EVERY: Duration = Duration::from_ms(5);
/// Silence after which a record is sent again: longer than the loader erases the largest sector.
pub const ANSWER_WITHIN: Duration = Duration::from_ms(3_000);
/// How often in a row the same thing is sent before the host gives up. The loader gives up before
/// and says why.
const MAX_ATTEMPTS: u32 = 16;

/// What the caller does next.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[must_use]
pub enum ToDo {
    /// Send this frame, then ask again.
    Send(CanFrame),
    /// Wait for an answer until this moment.
    Wait(Instant),
    /// The loader has the file and puts it on trial.
    Done,
    /// The loader refuses the file.
    Refused(Refusal),
    /// The loader does not answer.
    Silent,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum State {
    Connecting,
    /// The window was offered.
    Offering,
    Sending,
    Ended(ToDo),
}

/// Sends one file.
#[derive(Clone, Debug)]
pub struct FileSender {
    lines: Vec<String>,
    system: Option<SystemId>,
    /// Continue what another sender began.
    resume: bool,
    /// Wanted window; 0 for the protocol of the thesis.
    wanted: u8,
    /// Granted window; 1 record without the extension.
    window: u32,
    state: State,
    /// Records that the loader has.
    accepted: u32,
    /// The record that is being sent, and how much of it has gone.
    record: u32,
    sent: usize,
    /// Records that were ever sent whole.
    farthest: u32,
    /// The frame that says where the records go on.
    go_back: bool,
    due: Instant,
    attempts: u32,
    /// The attempt for which the window was offered.
    offered: u32,
    resends: u64,
}

impl FileSender {
    /// A sender of these records. `window` is the number of records that it would send ahead; 0
    /// speaks the protocol of the thesis.
    #[must_use]
    pub fn new(lines: Vec<String>, system: Option<SystemId>, window: u8) -> Self {
        Self {
            lines,
            system,
            resume: false,
            wanted: window,
            window: 1,
            state: State::Connecting,
            accepted: 0,
            record: 0,
            sent: 0,
            farthest: 0,
            go_back: false,
            due: Instant::ORIGIN,
            attempts: 0,
            offered: 0,
            resends: 0,
        }
    }

    /// The same, but continues where a connection broke, if the loader still has its part.
    /// Needs a window.
    #[must_use]
    pub fn resuming(mut self) -> Self {
        self.resume = self.wanted > 0;
        self
    }

    /// Whether a loader answers. With a window, a sender whose loader falls silent connects again,
    /// and continues where that stands: at the begin if it has lost power.
    #[must_use]
    pub fn is_connected(&self) -> bool {
        self.state != State::Connecting
    }

    /// Records that the loader has, and of how many.
    #[must_use]
    pub fn progress(&self) -> (u32, u32) {
        (self.accepted, self.lines.len() as u32)
    }

    /// Records that were asked for again.
    #[must_use]
    pub const fn resends(&self) -> u64 {
        self.resends
    }

    /// What to do now.
    pub fn next(&mut self, now: Instant) -> ToDo {
        if self.state == State::Sending && self.wanted > 0 && now >= self.due {
            self.connect_again(now);
        }
        let is_due = matches!(self.state, State::Offering | State::Sending) && now >= self.due;
        if is_due && !self.repeat(now) {
            return ToDo::Silent;
        }
        match self.state {
            State::Ended(end) => end,
            State::Connecting if now >= self.due => {
                self.due = now + CONNECT_EVERY;
                self.send(HostRequest::Connect {
                    system: self.system,
                    resume: self.resume,
                })
            }
            State::Connecting => ToDo::Wait(self.due),
            State::Offering if self.offered < self.attempts => {
                self.offered = self.attempts;
                let records = self.wanted;
                self.send(HostRequest::Offer { records })
            }
            State::Offering => ToDo::Wait(self.due),
            State::Sending => self.next_piece(),
        }
    }

    /// The loader is silent: frames were lost, or it has lost power. It says what it still has.
    fn connect_again(&mut self, now: Instant) {
        (self.state, self.resume, self.due) = (State::Connecting, true, now);
    }

    /// Whether something may be sent once more.
    fn repeat(&mut self, now: Instant) -> bool {
        self.due = now + ANSWER_WITHIN;
        self.attempts += 1;
        if self.attempts > MAX_ATTEMPTS {
            self.state = State::Ended(ToDo::Silent);
            return false;
        }
        if self.state == State::Sending {
            self.back_to(self.accepted);
        }
        true
    }

    fn back_to(&mut self, record: u32) {
        (self.record, self.sent) = (record, 0);
        self.go_back = self.wanted > 0;
    }

    fn next_piece(&mut self) -> ToDo {
        if self.go_back {
            self.go_back = false;
            let record = self.record;
            return self.send(HostRequest::GoBack { record });
        }
        let may_send = self.record < self.accepted + self.window;
        let line = self.lines.get(self.record as usize).filter(|_| may_send);
        let Some(line) = line else {
            return ToDo::Wait(self.due);
        };
        let piece = &line.as_bytes()[self.sent..];
        let piece = &piece[..piece.len().min(8)];
        let frame = HostRequest::Data(piece).frame();
        self.sent += piece.len();
        if self.sent == line.len() {
            (self.record, self.sent) = (self.record + 1, 0);
            self.farthest = self.record.max(self.farthest);
        }
        frame.map_or(ToDo::Silent, ToDo::Send)
    }

    fn send(&self, request: HostRequest<'_>) -> ToDo {
        request.frame().map_or(ToDo::Silent, ToDo::Send)
    }

    /// Takes a frame of the loader.
    pub fn on_frame(&mut self, now: Instant, frame: &CanFrame) {
        if frame.id() != tandem_boot::TO_HOST {
            return;
        }
        let Some(answer) = Answer::decode(frame.data()) else {
            return;
        };
        // A count beyond what was sent is not the loader's.
        if let Answer::Accepted { records: count } | Answer::Resend { record: count } = answer
            && count > self.farthest
        {
            return;
        }
        self.due = now + ANSWER_WITHIN;
        match (self.state, answer) {
            (State::Connecting, Answer::Connected) => {
                self.state = if self.wanted > 0 {
                    State::Offering
                } else {
                    State::Sending
                };
                if self.wanted > 0 {
                    (self.due, self.offered) = (now, self.attempts);
                }
            }
            (
                State::Offering,
                Answer::Window {
                    records, accepted, ..
                },
            ) => {
                (self.window, self.accepted) = (u32::from(records).max(1), accepted);
                self.farthest = accepted;
                (self.state, self.attempts) = (State::Sending, 0);
                self.back_to(accepted);
            }
            (State::Sending, Answer::Accepted { records }) => {
                // Without a window the count is 0: it is the record that was sent last.
                let accepted = if self.wanted > 0 {
                    records
                } else {
                    self.record
                };
                if accepted > self.accepted {
                    self.attempts = 0;
                }
                self.accepted = accepted.max(self.accepted);
                if self.accepted as usize >= self.lines.len() {
                    self.state = State::Ended(ToDo::Done);
                }
            }
            (State::Sending, Answer::Resend { record }) => {
                self.resends += 1;
                let record = if self.wanted > 0 {
                    record
                } else {
                    self.accepted
                };
                self.accepted = record.max(self.accepted);
                self.repeat(now);
            }
            (State::Sending | State::Offering, Answer::Refused(refusal)) => {
                self.state = State::Ended(ToDo::Refused(refusal));
            }
            _ => {}
        }
    }
}
