//! Clients and candidates for the sync master over shared memory (E-3).
//!
//! A place is one segment: the decision word, a bell, and a mailbox for each client and each
//! candidate, with one writer each. Processes sleep in the kernel on the decision word and on the
//! bell (futexes). A killed process holds nothing, so its successor just attaches. Two processes
//! with one identity must not run at once: the launcher kills before it restarts.

use core::sync::atomic::{AtomicU32, Ordering};

use rustix::thread::futex;
use tandem_board::{Duration, Instant};
use tandem_board_host::{RunName, Segment, SegmentError, clock};
use tandem_exec::client::{Activated, Client};
use tandem_exec::master::{Config, Event, Lie, MasterCore};
use tandem_exec::message::{Activation, ClientId, MAX_CLIENTS, SyncRequest, SyncResponse};
use tandem_shm::newest::{Reader, Writer};
use tandem_shm::{FitError, Payload as _, Shape, bare, broadcast, newest};

const REQUEST: Shape = Shape::new(4, SyncRequest::WORDS);
/// A proposal that was not decided may follow the decided answer: a reader finds both.
const ANSWER: Shape = Shape::new(4, SyncResponse::WORDS);
const LINE: usize = 16;
const DECISION_AT: usize = 0;
const BELL_AT: usize = LINE;
const STARTS_AT: usize = 2 * LINE;
const REQUESTS_AT: usize = 3 * LINE;
const REQUEST_WORDS: usize = newest::words(REQUEST).next_multiple_of(LINE);
const ANSWERS_AT: usize = REQUESTS_AT + MAX_CLIENTS * REQUEST_WORDS;
const ANSWER_WORDS: usize = broadcast::words(ANSWER).next_multiple_of(LINE);
const WORDS: usize = ANSWERS_AT + MAX_CLIENTS * ANSWER_WORDS;

/// The decision word: the low 29 bits of the cycle, and the master. A candidate that is frozen for
/// exactly 2^29 cycles (6 days at 1 kHz) between its look at it and its exchange misses that.
const MASTER_BITS: u32 = 3;

const fn decision(response: &SyncResponse) -> u32 {
    (response.cycle as u32) << MASTER_BITS | response.master.index() as u32
}

/// No process sleeps longer without a look at the memory, so a lost wake-up costs at most this.
const LOOK: Duration = Duration::from_ms(100);

/// Why a process cannot attach.
#[derive(Debug, thiserror::Error)]
pub enum SyncPlaceError {
    /// The words do not fit the channels: two versions of the program.
    #[error("the shared memory of the sync master has another layout: {0:?}")]
    Layout(FitError),
    /// The numbers of the configuration contradict each other.
    #[error("not a configuration of a sync master: needs 1 ≤ M ≤ N ≤ 8 and lead < period")]
    Config,
}

/// The shared memory of one group of redundant clients. Stays mapped until the process ends.
#[derive(Clone, Copy, Debug)]
pub struct SyncPlace {
    /// All words; public for tests that overwrite them.
    pub words: &'static [AtomicU32],
}

impl SyncPlace {
    /// Creates the memory. It is removed with the run's files.
    ///
    /// # Errors
    /// [`SegmentError`]
    pub fn create(run: &RunName, name: &str) -> Result<Self, SegmentError> {
        Segment::create(run, name).map(Self::keep)
    }

    /// Maps the memory that another process has created.
    ///
    /// # Errors
    /// [`SegmentError`]
    pub fn open(run: &RunName, name: &str) -> Result<Self, SegmentError> {
        Segment::open(run, name).map(Self::keep)
    }

    fn keep(segment: Segment<WORDS>) -> Self {
        let words = Box::leak(Box::new(segment)).words();
        Self { words }
    }

    fn decision(&self) -> &'static AtomicU32 {
        &self.words[DECISION_AT]
    }

    fn bell(&self) -> &'static AtomicU32 {
        &self.words[BELL_AT]
    }

    /// Returns the mailbox of a client, for tests of one that lies.
    #[must_use]
    pub fn request_words(&self, client: ClientId) -> &'static [AtomicU32] {
        &self.words[REQUESTS_AT + client.index() * REQUEST_WORDS..][..REQUEST_WORDS]
    }

    fn answer_words(&self, candidate: ClientId) -> &'static [AtomicU32] {
        &self.words[ANSWERS_AT + candidate.index() * ANSWER_WORDS..][..ANSWER_WORDS]
    }

    /// Returns the answer that the decision word names. `None` if there is none: at the start, or
    /// if the words hold garbage.
    fn decided(&self, word: u32) -> Option<SyncResponse> {
        let master = ClientId::new((word & ((1 << MASTER_BITS) - 1)) as usize)?;
        let answers = bare::broadcast_receiver(self.answer_words(master), ANSWER).ok()?;
        let mut answers = answers.from_oldest();
        let mut found = None;
        // A hostile writer cannot hold the reader: each round takes or skips a value. The newest
        // counts: a candidate may have died after a first proposal for this cycle.
        for _ in 0..2 * ANSWER.slots() {
            match answers.receive() {
                Ok(Some((_, answer))) if decision(&answer) == word => found = Some(answer),
                Ok(None) => break,
                Ok(Some(_)) | Err(_) => {}
            }
        }
        found
    }
}

/// No master answered in the time that the client is prepared to wait.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("no sync master answers: start one, or a further candidate")]
pub struct NoAnswer;

/// One client in this process.
#[derive(Debug)]
pub struct SyncClient {
    client: Client,
    place: SyncPlace,
    requests: Writer<'static, SyncRequest>,
    /// How long before its time it reads the clock in a loop instead of sleeping: needs a CPU of
    /// its own. Zero at first.
    pub spin: Duration,
    /// The decision word that was there before this client asked for the first time.
    passed: u32,
}

impl SyncClient {
    /// Attaches the client. Each attachment is a new generation.
    ///
    /// # Errors
    /// [`SyncPlaceError::Layout`]
    pub fn attach(place: SyncPlace, id: ClientId) -> Result<Self, SyncPlaceError> {
        let starts = &place.words[STARTS_AT + id.index()];
        let before = starts.fetch_add(1, Ordering::Relaxed);
        let words = place.request_words(id);
        Ok(Self {
            client: Client::new(id, before.wrapping_add(1).max(1)),
            place,
            requests: bare::newest_writer(words, REQUEST).map_err(SyncPlaceError::Layout)?,
            spin: Duration::ZERO,
            passed: place.decision().load(Ordering::Relaxed),
        })
    }

    /// Returns the client, for `random`, `activation_time`, `set_lost` and `set_done`.
    pub const fn client(&mut self) -> &mut Client {
        &mut self.client
    }

    /// Ends the current activation with the digest of its outputs, and blocks until the time of
    /// the next one.
    ///
    /// # Errors
    /// [`NoAnswer`] if no master answers for `give_up`. The client may call again.
    pub fn wait_for_activation(
        &mut self,
        output: u64,
        give_up: Duration,
    ) -> Result<Activated, NoAnswer> {
        self.requests.publish(&self.client.request(output));
        // Release pairs with the Acquire in `SyncMaster::step`: who sees the bell sees the request.
        self.place.bell().fetch_add(1, Ordering::Release);
        wake(self.place.bell());
        let until = clock::now() + give_up;
        loop {
            // Acquire pairs with the exchange in `SyncMaster::step`: the answer is there.
            let word = self.place.decision().load(Ordering::Acquire);
            let now = clock::now();
            if word != self.passed
                && let Some(answer) = self.place.decided(word)
                && let Ok(at) = self.client.on_response(now, &answer)
            {
                self.passed = word;
                sleep_until(at, self.spin);
                if let Some(activated) = self.client.activate(clock::now()) {
                    return Ok(activated);
                }
            }
            if now >= until {
                return Err(NoAnswer);
            }
            sleep(self.place.decision(), word, LOOK.min(until.since(now)));
        }
    }
}

/// One candidate for the master in this process.
#[derive(Debug)]
pub struct SyncMaster {
    /// The candidate's logic.
    pub master: MasterCore,
    place: SyncPlace,
    clients: Vec<(ClientId, Reader<'static, SyncRequest, 0>)>,
    answers: broadcast::Writer<'static, SyncResponse>,
    /// The value of the decision word for the last decision that `master` has taken.
    seen: u32,
}

impl SyncMaster {
    /// Attaches the candidate.
    ///
    /// # Errors
    /// [`SyncPlaceError::Config`], [`SyncPlaceError::Layout`]
    pub fn attach(place: SyncPlace, config: Config, id: ClientId) -> Result<Self, SyncPlaceError> {
        let master = MasterCore::new(config, id).ok_or(SyncPlaceError::Config)?;
        let reader = |client| {
            let reader = bare::newest_reader(place.request_words(client), REQUEST);
            reader.map(|reader| (client, reader))
        };
        let clients: Result<_, _> = ClientId::first(config.clients).map(reader).collect();
        let answers = bare::broadcast_writer(place.answer_words(id), ANSWER);
        Ok(Self {
            master,
            place,
            clients: clients.map_err(SyncPlaceError::Layout)?,
            answers: answers.map_err(SyncPlaceError::Layout)?,
            seen: 0,
        })
    }

    /// Reads what is there, and answers if it is this candidate's turn. Returns the time of the
    /// next step. Never blocks.
    pub fn step(&mut self, tell: &mut impl FnMut(Event)) -> Instant {
        let now = clock::now();
        let mut requests = [None; MAX_CLIENTS];
        for (client, reader) in &mut self.clients {
            match reader.fetch() {
                Ok(request) => requests[client.index()] = request,
                Err(_) => tell(Event::Disagrees(*client, Lie::Garbage)),
            }
        }
        let last = self.master.last().map_or(0, |last| last.cycle);
        // The word is read after the requests: a client that has answered a decision saw it. So
        // requests for the cycle before it are taken before it, and those for it afterwards.
        for is_old in [true, false] {
            for (client, request) in ClientId::first(MAX_CLIENTS).zip(requests) {
                if let Some(request) = request.filter(|it| (it.cycle <= last) == is_old) {
                    self.master.on_request(now, client, &request, tell);
                }
            }
            // Acquire pairs with the exchange below.
            let word = self.place.decision().load(Ordering::Acquire);
            if is_old
                && word != self.seen
                && let Some(response) = self.place.decided(word)
            {
                self.seen = word;
                self.master.on_decided(&response, tell);
            }
        }
        let next = self.master.poll(now);
        let Some(proposal) = next.propose else {
            return next.wake;
        };
        self.answers.publish(&proposal);
        // AcqRel pairs with the Acquire loads of this word: who sees it sees the proposal.
        let decided = self.place.decision().compare_exchange(
            self.seen,
            decision(&proposal),
            Ordering::AcqRel,
            Ordering::Relaxed,
        );
        if decided.is_ok() {
            wake(self.place.decision());
            self.seen = decision(&proposal);
            self.master.on_decided(&proposal, tell);
        }
        now
    }

    /// Runs the candidate until `is_over`, or until all clients terminate. Blocks.
    pub fn run(&mut self, mut tell: impl FnMut(Event), mut is_over: impl FnMut() -> bool) {
        while !is_over() {
            // Acquire pairs with the Release in `SyncClient::wait_for_activation`.
            let rung = self.place.bell().load(Ordering::Acquire);
            let next = self.step(&mut tell);
            let code = self.master.last().map(|last| last.code);
            if next == Instant::NEVER && code == Some(Activation::Terminate) {
                return;
            }
            let now = clock::now();
            if now < next {
                sleep(self.place.bell(), rung, LOOK.min(next.since(now)));
            }
        }
    }
}

/// Sleeps until `instant`, and reads the clock in a loop for the last part of `spin`.
fn sleep_until(instant: Instant, spin: Duration) {
    let early = instant.as_ns().saturating_sub(spin.as_ns());
    clock::sleep_until(Instant::from_ns(early));
    while clock::now() < instant {
        core::hint::spin_loop();
    }
}

/// Sleeps until the word is woken, unless it no longer has this value, or until the time is over.
fn sleep(word: &AtomicU32, value: u32, span: Duration) {
    let timeout = clock::timespec(span.as_ns());
    // Every outcome leads to a new look at the memory.
    let _ = futex::wait(word, futex::Flags::empty(), value, Some(&timeout));
}

fn wake(word: &AtomicU32) {
    // Fails only if the word is not mapped.
    let _ = futex::wake(word, futex::Flags::empty(), i32::MAX as u32);
}
