//! A connection with a host: acknowledgements, requests to resend, and the window. T-BOOT-3
//!
//! Without a window the host waits for the answer to each record, as in the thesis. With a window
//! of n the host sends up to n records ahead, and one answer covers n records. After an error the
//! host goes back to the record that the loader names.

use crate::download::{Download, Ground, free_slot};
use crate::protocol::{Answer, HostRequest, Refusal};
use crate::srec::{Assembler, SRecord, SRecordType};
use embedded_storage::nor_flash::NorFlash;
use tandem_board::{Duration, Instant};

/// The loader requests a resend after this time without a frame within a record or a window.
pub const RESEND_AFTER: Duration = Duration::from_ms(100);
/// The largest window. A CAN controller's receive buffer must hold this many records during an
/// erase: our host's records have 6 frames each (16 data bytes), the longest permitted one has 65.
pub const MAX_WINDOW: u8 = 16;
/// After this many wrong records in a row the file is refused.
const MAX_ATTEMPTS: u8 = 8;

/// The state of a connection.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
enum State {
    /// No host is connected.
    #[default]
    Closed,
    Open,
    /// The file has ended and is on trial.
    Finished,
    Refused(Refusal),
}

/// The connection and the records received over it.
#[derive(Clone, Debug, Default)]
pub(crate) struct Session {
    state: State,
    assembler: Assembler,
    download: Download,
    /// Number of records that the host may send ahead; 0 without the extension.
    window: u8,
    /// Records accepted since the connection.
    accepted: u32,
    /// Records accepted since the last answer.
    unanswered: u8,
    /// Whether to ignore data until the host goes back; set after an error within a window.
    waits_for_go_back: bool,
    attempts: u8,
    /// Address of the record that would have been refused, and was requested again.
    doubted: Option<u32>,
    /// [`SRecord::print`] of the last accepted record. If its acknowledgement is lost, the host
    /// repeats it.
    last: Option<u32>,
    heard: Instant,
    /// When the host last brought something: a connection, a proof, bytes of an image, the end.
    progressed: Instant,
    /// It has brought something since [`Session::take_progress`].
    brought: bool,
}

impl Session {
    pub(crate) const fn is_finished(&self) -> bool {
        matches!(self.state, State::Finished)
    }

    /// Returns whether the file was accepted or refused.
    pub(crate) const fn has_ended(&self) -> bool {
        matches!(self.state, State::Finished | State::Refused(_))
    }

    pub(crate) const fn is_open(&self) -> bool {
        matches!(self.state, State::Open)
    }

    /// Returns when the host last brought something. Frames that bring nothing, of whichever node,
    /// do not keep the loader waiting.
    pub(crate) const fn progressed(&self) -> Instant {
        self.progressed
    }

    /// Does not count the time until now as silence: the flash was busy.
    pub(crate) const fn excuse(&mut self, now: Instant) {
        (self.heard, self.progressed) = (now, now);
    }

    /// Notes that the host has brought something.
    pub(crate) const fn progress(&mut self, now: Instant) {
        self.excuse(now);
        self.brought = true;
    }

    /// Returns whether the host has brought something since the last call.
    pub(crate) const fn take_progress(&mut self) -> bool {
        core::mem::replace(&mut self.brought, false)
    }

    /// Connects a host; `None` after a file was accepted: a connection takes one file.
    pub(crate) fn connect(&mut self, now: Instant, resume: bool) -> Option<Answer> {
        if self.is_finished() {
            return None;
        }
        if !(resume && self.is_open()) {
            *self = Self::default();
            self.progressed = now;
        }
        (self.state, self.heard) = (State::Open, now);
        // The host repeats the record that it was sending when the connection broke.
        self.assembler = Assembler::default();
        (self.window, self.unanswered, self.waits_for_go_back) = (0, 0, false);
        Some(Answer::Connected)
    }

    /// Processes a frame other than a connect request.
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
        // After the end of a file no frame makes the loader wait longer.
        if self.is_open() {
            self.heard = now;
        }
        match request {
            // The loader handles these.
            HostRequest::Connect { .. }
            | HostRequest::Challenge { .. }
            | HostRequest::Proof { .. }
            | HostRequest::Info { .. }
            | HostRequest::RollBack { .. } => None,
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
            // The end of the previous record was lost. Without a window this record may repeat it.
            HostRequest::Data([b'S', ..]) if self.window > 0 && self.assembler.is_inside() => {
                self.assembler = Assembler::default();
                Some(self.ask_again())
            }
            HostRequest::Data(data) => {
                let record = self.assembler.push(data)?;
                let was_open = self.is_open();
                let answer = self.on_record(now, record.ok(), flash, ground);
                if was_open && self.has_ended() {
                    // From now on the host may ask for this answer again.
                    self.excuse(now);
                }
                answer
            }
        }
    }

    fn on_record(
        &mut self,
        now: Instant,
        record: Option<SRecord>,
        flash: &mut impl NorFlash,
        ground: &mut Ground<'_>,
    ) -> Option<Answer> {
        if let State::Refused(refusal) = self.state {
            return Some(Answer::Refused(refusal));
        }
        if !ground.tester.may_program(&ground.trust) {
            return Some(self.refuse(Refusal::Tester));
        }
        // No file has data records without data: the checksum does not cover the type.
        let is_empty = |it: &SRecord| it.record_type == SRecordType::Data && it.data().is_empty();
        let Some(record) = record.filter(|it| !is_empty(it)) else {
            self.attempts += 1;
            if self.attempts >= MAX_ATTEMPTS {
                return Some(self.refuse(Refusal::Record));
            }
            return Some(self.ask_again());
        };
        // Without a window the host repeats a record whose acknowledgement was lost.
        let is_last = self.last == Some(record.print);
        let repeated = self.window == 0 && is_last;
        if self.state == State::Finished && !is_last {
            // Any host could have sent it: what the file brought stays on trial.
            return Some(Answer::Refused(Refusal::AfterEnd));
        }
        if !repeated && self.state == State::Open {
            let received = self.download.received();
            match self.download.take(&record, flash, ground) {
                Ok(ended) => {
                    (self.attempts, self.doubted) = (0, None);
                    if ended || self.download.received() != received {
                        self.progress(now);
                    }
                    self.accepted += 1;
                    self.unanswered += 1;
                    if ended {
                        self.state = State::Finished;
                    }
                }
                // With a window, a whole record or the go-back frame may have been lost.
                Err(Refusal::Gap | Refusal::Overlap | Refusal::Order)
                    if self.window > 0 && self.attempts < MAX_ATTEMPTS =>
                {
                    self.attempts += 1;
                    return Some(self.ask_again());
                }
                // With another type it has another address: refuse only what is sent again.
                Err(Refusal::Address | Refusal::Order)
                    if self.doubted.replace(record.address) != Some(record.address) =>
                {
                    return Some(self.ask_again());
                }
                Err(refusal) => return Some(self.refuse(refusal)),
            }
            self.last = Some(record.print);
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

    #[inline(never)]
    fn refuse(&mut self, refusal: Refusal) -> Answer {
        self.state = State::Refused(refusal);
        self.download = Download::default();
        Answer::Refused(refusal)
    }

    #[inline(never)]
    fn ask_again(&mut self) -> Answer {
        self.waits_for_go_back = self.window > 0;
        Answer::Resend {
            record: if self.window == 0 { 0 } else { self.accepted },
        }
    }

    /// Returns the time at which [`Session::on_silence`] is due; `None` if no record is incomplete
    /// or unanswered.
    pub(crate) fn deadline(&self) -> Option<Instant> {
        let under_way = self.assembler.is_inside() || self.unanswered > 0;
        (self.is_open() && under_way).then(|| self.heard + RESEND_AFTER)
    }

    /// Requests a resend: nothing arrived for [`RESEND_AFTER`] although a record was incomplete or
    /// unanswered, so frames were lost.
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
