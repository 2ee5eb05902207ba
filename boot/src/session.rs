//! One connection with a host: acknowledges, asks again, keeps a window. T-BOOT-3
//!
//! Without a window every record has an answer before the next one comes, as in the thesis. With a
//! window of n the host sends up to n records ahead, one answer covers n of them, and after an
//! error the host goes back to the record that the loader names.

use crate::download::{Download, Ground, free_slot};
use crate::protocol::{Answer, HostRequest, Refusal};
use crate::srec::{Assembler, SRecord, SRecordType};
use embedded_storage::nor_flash::NorFlash;
use tandem_board::{Duration, Instant};

/// Silence inside a record, or inside a window, after which the loader asks again.
pub const RESEND_AFTER: Duration = Duration::from_ms(100);
/// The largest window. The receive buffer of a CAN controller must hold what the host may send
/// while the flash erases: 16 records of 14 frames.
pub const MAX_WINDOW: u8 = 16;
/// How often in a row a record may be wrong before the file is taken for something else.
const MAX_ATTEMPTS: u8 = 8;

/// The state of a connection.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum State {
    /// No host yet, or the host was refused.
    Closed,
    Open,
    /// The file has ended and is on trial.
    Finished,
    Refused(Refusal),
}

/// The connection and the records received over it.
#[derive(Clone, Debug)]
pub(crate) struct Session {
    state: State,
    assembler: Assembler,
    download: Download,
    /// Records under way at most; 0 without the extension.
    window: u8,
    /// Records accepted since the connection.
    accepted: u32,
    /// Records since the last answer.
    unanswered: u8,
    /// With a window, after an error: nothing counts until the host goes back.
    waits_for_go_back: bool,
    attempts: u8,
    /// The last accepted record: if its acknowledgement was lost, the host sends it again.
    last: Option<SRecord>,
    heard: Instant,
}

impl Session {
    pub(crate) fn new() -> Self {
        Self {
            state: State::Closed,
            assembler: Assembler::default(),
            download: Download::default(),
            window: 0,
            accepted: 0,
            unanswered: 0,
            waits_for_go_back: false,
            attempts: 0,
            last: None,
            heard: Instant::ORIGIN,
        }
    }

    pub(crate) const fn is_finished(&self) -> bool {
        matches!(self.state, State::Finished)
    }

    /// The file was taken, or refused.
    pub(crate) const fn has_ended(&self) -> bool {
        matches!(self.state, State::Finished | State::Refused(_))
    }

    pub(crate) const fn is_open(&self) -> bool {
        matches!(self.state, State::Open)
    }

    /// When the host was last heard.
    pub(crate) const fn heard(&self) -> Instant {
        self.heard
    }

    /// The host counts as heard up to this moment.
    pub(crate) const fn hear(&mut self, now: Instant) {
        self.heard = now;
    }

    pub(crate) fn connect(&mut self, now: Instant, resume: bool) -> Answer {
        if !(resume && self.is_open()) {
            *self = Self::new();
        }
        (self.state, self.heard) = (State::Open, now);
        // The host sends again what was under way when the connection broke.
        self.assembler = Assembler::default();
        (self.window, self.unanswered, self.waits_for_go_back) = (0, 0, false);
        Answer::Connected
    }

    /// Takes a frame that is no connect request.
    pub(crate) fn on_request(
        &mut self,
        now: Instant,
        request: HostRequest<'_>,
        flash: &mut impl NorFlash,
        ground: &mut Ground<'_>,
    ) -> Option<Answer> {
        if self.state == State::Closed {
            return None;
        }
        self.heard = now;
        match request {
            HostRequest::Connect { .. } => None,
            HostRequest::Offer { records } => {
                self.window = records.min(MAX_WINDOW);
                Some(Answer::Window {
                    records: self.window,
                    application: free_slot(ground.keep.application),
                    configuration: free_slot(ground.keep.configuration),
                    accepted: self.accepted,
                })
            }
            HostRequest::GoBack { record } if record == self.accepted => {
                self.assembler = Assembler::default();
                (self.waits_for_go_back, self.unanswered) = (false, 0);
                None
            }
            HostRequest::GoBack { .. } => Some(self.ask_again()),
            HostRequest::Data(_) if self.waits_for_go_back => None,
            // The end of the record before was lost. Without a window the host repeats a record so.
            HostRequest::Data([b'S', ..]) if self.window > 0 && self.assembler.is_inside() => {
                self.assembler = Assembler::default();
                Some(self.ask_again())
            }
            HostRequest::Data(data) => {
                let record = self.assembler.push(data)?;
                Some(self.on_record(record.ok(), flash, ground)).flatten()
            }
        }
    }

    fn on_record(
        &mut self,
        record: Option<SRecord>,
        flash: &mut impl NorFlash,
        ground: &mut Ground<'_>,
    ) -> Option<Answer> {
        if let State::Refused(refusal) = self.state {
            return Some(Answer::Refused(refusal));
        }
        let Some(record) = record else {
            self.attempts += 1;
            if self.attempts >= MAX_ATTEMPTS {
                return Some(self.refuse(Refusal::Record));
            }
            return Some(self.ask_again());
        };
        // Without a window the host repeats a record whose acknowledgement it did not get.
        let repeated = self.window == 0 && self.last.as_ref() == Some(&record);
        if !repeated && self.state == State::Open {
            match self.download.take(&record, flash, ground) {
                Ok(ended) => {
                    self.attempts = 0;
                    self.accepted += 1;
                    self.unanswered += 1;
                    if ended {
                        self.state = State::Finished;
                    }
                }
                // With a window: a whole record, or the frame that goes back, may have been lost.
                Err(Refusal::Gap | Refusal::Overlap | Refusal::Order)
                    if self.window > 0 && self.attempts < MAX_ATTEMPTS =>
                {
                    self.attempts += 1;
                    return Some(self.ask_again());
                }
                Err(refusal) => return Some(self.refuse(refusal)),
            }
            self.last = Some(record);
        }
        let ends = record.record_type == SRecordType::Entry;
        if self.unanswered < self.window && !ends {
            return None;
        }
        self.unanswered = 0;
        Some(Answer::Accepted {
            records: if self.window == 0 { 0 } else { self.accepted },
        })
    }

    fn refuse(&mut self, refusal: Refusal) -> Answer {
        self.state = State::Refused(refusal);
        self.download = Download::default();
        Answer::Refused(refusal)
    }

    fn ask_again(&mut self) -> Answer {
        self.waits_for_go_back = self.window > 0;
        Answer::Resend {
            record: if self.window == 0 { 0 } else { self.accepted },
        }
    }

    /// When [`Session::on_silence`] is due; `None` if nothing is under way.
    pub(crate) fn deadline(&self) -> Option<Instant> {
        let under_way = self.assembler.is_inside() || self.unanswered > 0;
        (self.is_open() && under_way).then(|| self.heard + RESEND_AFTER)
    }

    /// Nothing came for [`RESEND_AFTER`] although something was under way: frames were lost.
    pub(crate) fn on_silence(&mut self, now: Instant) -> Answer {
        self.heard = now;
        self.assembler = Assembler::default();
        self.unanswered = 0;
        self.ask_again()
    }

    pub(crate) const fn refusal(&self) -> Option<Refusal> {
        match self.state {
            State::Refused(refusal) => Some(refusal),
            _ => None,
        }
    }
}
