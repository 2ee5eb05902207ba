//! The host's end of a download, sans-IO: it connects, sends and repeats. T-BOOT-3

use crate::SigningKey;
use tandem_board::{CanFrame, Duration, Instant, SystemId};
use tandem_boot::{Answer, CHALLENGE_BYTES, HostRequest, Refusal, tester_message};

/// Time between two connect requests.
pub const CONNECT_EVERY: Duration = Duration::from_ms(5);
/// Time between two requests to give up a release: a system needs longer to go back.
const ROLL_BACK_EVERY: Duration = Duration::from_ms(100);
/// Silence after which a record is repeated: longer than the erase of the largest sector.
pub const ANSWER_WITHIN: Duration = Duration::from_ms(3_000);
/// The host gives up after this many attempts in a row. The loader gives up earlier and sends the
/// reason.
const MAX_ATTEMPTS: u32 = 16;

/// The next action of the caller.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[must_use]
pub enum ToDo {
    /// Send this frame, then call again.
    Send(CanFrame),
    /// Wait for an answer until this time.
    Wait(Instant),
    /// The loader has accepted the file and puts it on trial.
    Done,
    /// The loader refuses the file.
    Refused(Refusal),
    /// The loader takes no signature for this time, s.
    Locked(u16),
    /// The loader does not answer.
    Silent,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum State {
    Connecting,
    /// The sender asks for this part of a challenge.
    Asking(u8),
    /// It sends this part of the signature.
    Proving(u8),
    /// The sender offers its window.
    Offering,
    Sending,
    Ended(ToDo),
}

/// Sends one file.
#[derive(Clone, Debug)]
pub struct FileSender {
    lines: Vec<String>,
    system: Option<SystemId>,
    /// Whether to continue an interrupted transfer.
    resume: bool,
    /// The requested window; 0 for the protocol of the thesis.
    wanted: u8,
    /// The granted window; 1 record without the extension.
    window: u32,
    state: State,
    /// Number of records accepted by the loader.
    accepted: u32,
    /// The record being sent, and how many of its bytes are already sent.
    record: u32,
    sent: usize,
    /// The highest number of completely sent records.
    farthest: u32,
    /// Whether to send a go-back frame next.
    go_back: bool,
    due: Instant,
    attempts: u32,
    /// The attempt in which the window was offered.
    offered: u32,
    resends: u64,
    /// The key of the tester, and the system that it signs for.
    tester: Option<(SystemId, SigningKey)>,
    /// A running application asked for the proof, not a bootloader.
    is_at_application: bool,
    /// Asks a running application to give up the release on trial, and sends no file.
    rolls_back: bool,
    /// Whether to ask for a part of the challenge next.
    asks: bool,
    challenge: [u8; CHALLENGE_BYTES],
    signature: [u8; 65],
}

impl FileSender {
    /// Creates a sender of these records. `window` is the number of records to send ahead; 0 means
    /// the protocol of the thesis.
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
            tester: None,
            is_at_application: false,
            rolls_back: false,
            asks: false,
            challenge: [0; CHALLENGE_BYTES],
            signature: [0; 65],
        }
    }

    /// Makes the sender prove to this system's loader that it has a tester's key.
    #[must_use]
    pub fn proving(mut self, system: SystemId, key: SigningKey) -> Self {
        self.tester = Some((system, key));
        self
    }

    /// Creates a sender that asks a running application to give up its release on trial. It asks
    /// until the caller has seen that the release is gone.
    #[must_use]
    pub fn rolling_back(system: SystemId) -> Self {
        Self {
            rolls_back: true,
            ..Self::new(Vec::new(), Some(system), 0)
        }
    }

    /// Makes the sender continue an interrupted transfer, if the loader still has the records of
    /// that transfer. Needs a window.
    #[must_use]
    pub fn resuming(mut self) -> Self {
        self.resume = self.wanted > 0;
        self
    }

    /// Returns whether the sender is connected. With a window, it reconnects to a silent loader and
    /// continues after the records that the loader has; after a loss of power the loader has none.
    #[must_use]
    pub fn is_connected(&self) -> bool {
        self.state != State::Connecting
    }

    /// Returns the number of accepted records, and of all records.
    #[must_use]
    pub fn progress(&self) -> (u32, u32) {
        (self.accepted, self.lines.len() as u32)
    }

    /// Returns how many times the loader requested a resend.
    #[must_use]
    pub const fn resends(&self) -> u64 {
        self.resends
    }

    /// Returns the next action.
    pub fn next(&mut self, now: Instant) -> ToDo {
        if self.state == State::Sending && self.wanted > 0 && now >= self.due {
            self.connect_again(now);
        }
        let waits = !matches!(self.state, State::Connecting | State::Ended(_));
        let is_due = waits && now >= self.due;
        if is_due && !self.repeat(now) {
            return ToDo::Silent;
        }
        match self.state {
            State::Ended(end) => end,
            State::Connecting if now >= self.due => {
                let (system, resume) = (self.system, self.resume);
                let (request, every) = match self.rolls_back {
                    true => (HostRequest::RollBack { system }, ROLL_BACK_EVERY),
                    false => (HostRequest::Connect { system, resume }, CONNECT_EVERY),
                };
                self.due = now + every;
                self.send(request)
            }
            State::Connecting => ToDo::Wait(self.due),
            State::Asking(part) if self.asks => {
                self.asks = false;
                let key = self.tester.as_ref().map_or(0, |(_, key)| key.number);
                let system = self.system;
                self.send(HostRequest::Challenge { system, key, part })
            }
            State::Asking(_) => ToDo::Wait(self.due),
            State::Proving(part) if part < 13 => {
                self.state = State::Proving(part + 1);
                let (pieces, _) = self.signature.as_chunks::<5>();
                let bytes = pieces[usize::from(part)];
                let system = self.system;
                self.send(HostRequest::Proof {
                    system,
                    part,
                    bytes,
                })
            }
            State::Proving(_) => ToDo::Wait(self.due),
            State::Offering if self.offered < self.attempts => {
                self.offered = self.attempts;
                let records = self.wanted;
                self.send(HostRequest::Offer { records })
            }
            State::Offering => ToDo::Wait(self.due),
            State::Sending => self.next_piece(),
        }
    }

    /// Asks for a part of a challenge.
    fn ask(&mut self, now: Instant, part: u8) {
        (self.state, self.asks, self.due) = (State::Asking(part), true, now + ANSWER_WITHIN);
    }

    /// Begins to send, or with a window to offer it.
    fn begin(&mut self, now: Instant) {
        if self.wanted > 0 {
            self.state = State::Offering;
            (self.due, self.offered) = (now, self.attempts);
        } else {
            self.state = State::Sending;
        }
    }

    /// Reconnects to a silent loader: frames were lost, or the loader lost power. The loader's
    /// answer reports how many records it has.
    fn connect_again(&mut self, now: Instant) {
        (self.state, self.resume, self.due) = (State::Connecting, true, now);
    }

    /// Starts another attempt. Returns `false` if none is left.
    fn repeat(&mut self, now: Instant) -> bool {
        self.due = now + ANSWER_WITHIN;
        self.attempts += 1;
        if self.attempts > MAX_ATTEMPTS {
            self.state = State::Ended(ToDo::Silent);
            return false;
        }
        match self.state {
            State::Sending => self.back_to(self.accepted),
            // A frame was lost: ask again from the first part.
            State::Asking(_) | State::Proving(_) => self.ask(now, 0),
            _ => {}
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

    /// Processes a frame of the loader.
    pub fn on_frame(&mut self, now: Instant, frame: &CanFrame) {
        if frame.id() != tandem_boot::TO_HOST {
            return;
        }
        let Some(answer) = Answer::decode(frame.data()) else {
            return;
        };
        // Ignore a count beyond the sent records: the loader cannot have sent such a count.
        if let Answer::Accepted { records: count } | Answer::Resend { record: count } = answer
            && count > self.farthest
        {
            return;
        }
        self.due = now + ANSWER_WITHIN;
        match (self.state, answer) {
            (State::Connecting, Answer::Connected) => match self.tester {
                Some(_) => self.ask(now, 0),
                None => self.begin(now),
            },
            (State::Asking(asked), Answer::Challenge { part, bytes }) if part == asked => {
                let (parts, _) = self.challenge.as_chunks_mut::<5>();
                parts[usize::from(part)] = bytes;
                if usize::from(part) + 1 < parts.len() {
                    self.ask(now, part + 1);
                } else if let Some((system, key)) = &self.tester {
                    let message = tester_message(*system, key.number, &self.challenge);
                    self.signature[..64].copy_from_slice(&key.sign(&message));
                    self.state = State::Proving(0);
                }
            }
            (State::Proving(_), Answer::Proved) => {
                self.attempts = 0;
                match core::mem::take(&mut self.is_at_application) {
                    true => (self.state, self.due) = (State::Connecting, now),
                    false => self.begin(now),
                }
            }
            // A running application wants a proof before it makes room for its bootloader.
            (State::Connecting, Answer::Refused(Refusal::Tester)) if self.tester.is_some() => {
                self.is_at_application = true;
                self.ask(now, 0);
            }
            (State::Proving(_), Answer::Unproved) => {
                self.state = State::Ended(ToDo::Refused(Refusal::Tester));
            }
            (State::Asking(_), Answer::Locked { seconds }) => {
                self.state = State::Ended(ToDo::Locked(seconds));
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
                // Without a window the count is 0: the answer is for the last sent record.
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
            (State::Connecting | State::Sending | State::Offering, Answer::Refused(refusal)) => {
                self.state = State::Ended(ToDo::Refused(refusal));
            }
            _ => {}
        }
    }
}
