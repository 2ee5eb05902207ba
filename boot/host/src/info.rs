//! Asks a bootloader or a running application what it holds: versions, slots, log. U-2

use crate::{ToDo, TransferError, UdpBus};
use std::time::Instant as Clock;
use tandem_board::{CanFrame, Duration, Instant, SystemId};
use tandem_boot::{
    Answer, Environment, FlashRegion, HostRequest, LOG_ANSWERS, LogEvent, PLACES, Question,
    RECORD_BYTES, RELEASES, ReleaseStage, TO_HOST,
};

/// A question is repeated after this time without an answer.
const ANSWER_WITHIN: Duration = Duration::from_ms(30);
/// An application tells its release five times a second.
const TELLS_WITHIN: Duration = Duration::from_ms(450);

/// What a system holds.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SystemInfo {
    /// The release that a running application tells; `None` from a bootloader.
    pub running: Option<(ReleaseStage, u32)>,
    /// Its boot environment.
    pub environment: Environment,
    /// Starts of which none worked.
    pub starts: u8,
    /// The version of what each place holds; `None` if that does not begin with a manifest.
    pub places: Vec<(FlashRegion, Option<u32>)>,
    /// The newest entries of the log, the newest first.
    pub log: Vec<(LogEvent, u32)>,
}

/// Asks all questions, one after the other.
#[derive(Clone, Debug)]
pub struct Inquiry {
    system: SystemId,
    questions: Vec<u8>,
    /// The answers so far: detail and value.
    answers: Vec<(u8, u32)>,
    due: Instant,
    running: Option<(ReleaseStage, u32)>,
    /// When the first answer arrived.
    answered: Option<Instant>,
}

impl Inquiry {
    /// Creates an inquiry to one system.
    #[must_use]
    pub fn new(system: SystemId) -> Self {
        let words = (0..(RECORD_BYTES / 4) as u8).map(Question::Environment);
        let places = PLACES.into_iter().map(Question::Place);
        let log = (0..LOG_ANSWERS).map(Question::Log);
        let questions = words.chain(places).chain(log);
        Self {
            system,
            questions: questions.filter_map(Question::code).collect(),
            answers: Vec::new(),
            due: Instant::ORIGIN,
            running: None,
            answered: None,
        }
    }

    /// Returns whether the system has answered at all.
    #[must_use]
    pub const fn is_answered(&self) -> bool {
        self.answered.is_some()
    }

    /// Returns the next action; [`ToDo::Done`] when all answers are there.
    pub fn next(&mut self, now: Instant) -> ToDo {
        let Some(question) = self.questions.get(self.answers.len()) else {
            let tells_until = self.answered.map_or(now, |at| at + TELLS_WITHIN);
            return match self.running {
                None if now < tells_until => ToDo::Wait(tells_until),
                _ => ToDo::Done,
            };
        };
        if now < self.due {
            return ToDo::Wait(self.due);
        }
        self.due = now + ANSWER_WITHIN;
        let request = HostRequest::Info {
            system: Some(self.system),
            question: *question,
        };
        request.frame().map_or(ToDo::Silent, ToDo::Send)
    }

    /// Processes a frame from the bus.
    pub fn on_frame(&mut self, now: Instant, frame: &CanFrame) {
        match (frame.id(), Answer::decode(frame.data())) {
            (
                TO_HOST,
                Some(Answer::Info {
                    question,
                    detail,
                    value,
                }),
            ) if self.questions.get(self.answers.len()) == Some(&question) => {
                self.answers.push((detail, value));
                self.answered.get_or_insert(now);
                self.due = now;
            }
            (
                RELEASES,
                Some(Answer::Release {
                    system,
                    stage,
                    version,
                }),
            ) if system == self.system => self.running = Some((stage, version)),
            _ => {}
        }
    }

    /// Returns what the system holds; `None` before all answers are there, or if they are no
    /// environment because it changed between two answers.
    #[must_use]
    pub fn info(&self) -> Option<SystemInfo> {
        let (words, rest) = self.answers.split_at_checked(RECORD_BYTES / 4)?;
        let (places, log) = rest.split_at_checked(PLACES.len())?;
        let mut record = [0; RECORD_BYTES];
        for (bytes, (_, word)) in record.as_chunks_mut::<4>().0.iter_mut().zip(words) {
            *bytes = word.to_le_bytes();
        }
        let (environment, _) = Environment::decode(&record)?;
        let version = |(detail, version): &(u8, u32)| (*detail == 1).then_some(*version);
        let entry = |(event, value): &(u8, u32)| Some((LogEvent::from_repr(*event)?, *value));
        (log.len() == usize::from(LOG_ANSWERS)).then(|| SystemInfo {
            running: self.running,
            environment,
            starts: words[0].0,
            places: PLACES.into_iter().zip(places.iter().map(version)).collect(),
            log: log.iter().map_while(entry).collect(),
        })
    }
}

/// Asks one system over a bus, in real time. `within`: the time until its first answer, and for all
/// further ones.
///
/// # Errors
/// [`TransferError`] if the bus fails, or not all answers arrive.
pub fn ask(wire: &UdpBus, system: SystemId, within: Duration) -> Result<SystemInfo, TransferError> {
    let start = Clock::now();
    let since = || Instant::from_ns(start.elapsed().as_nanos() as u64);
    let no_answer = TransferError::NoAnswer(within.as_ns() / 1_000_000_000);
    let mut limit = Instant::ORIGIN + within;
    let mut inquiry = Inquiry::new(system);
    loop {
        let now = since();
        if now >= limit {
            return Err(no_answer);
        }
        let was_answered = inquiry.is_answered();
        match inquiry.next(now) {
            ToDo::Send(frame) => wire.send(&frame)?,
            ToDo::Wait(until) => {
                let left = until.since(now).as_ns().clamp(1_000, 100_000_000);
                if let Some(frame) = wire.receive(std::time::Duration::from_nanos(left))? {
                    inquiry.on_frame(since(), &frame);
                }
            }
            _ => match inquiry.info() {
                Some(info) => return Ok(info),
                None => inquiry = Inquiry::new(system),
            },
        }
        if inquiry.is_answered() && !was_answered {
            limit = since() + within;
        }
    }
}
