//! The sync master: one answer to the requests of all redundant clients (E-3).
//!
//! There are several *candidates*; each hears all requests and sees all decisions. One proposes:
//! that of the last decision. If it is dead, the next id follows (the k-th next waits k times
//! [`Config::takeover`]). A frozen master may wake at any instant and propose too late. So a
//! proposal is no answer. The rule:
//!
//! > One word holds the last decided cycle and its master. A candidate first writes its proposal
//! > for cycle n + 1 to its own slot, and then moves the word from the value of cycle n, which it
//! > has seen, by one compare-exchange. A client takes from a slot only the cycle that the word
//! > names, from the master that the word names.
//!
//! Of all candidates only one can move the word away from cycle n, and that one does not write its
//! slot again before it has seen its own decision. So no two clients take different answers for
//! one cycle. `tests/succession.rs` tries all interleavings. (One compare-exchange decides between
//! any number of processes: M. Herlihy, "Wait-free synchronization", 1991.)
//!
//! | a client that | is |
//! |---|---|
//! | was not heard in time | told as [`Event::Silent`]; after 3 in a row no member |
//! | sends for an earlier cycle | told as [`Event::Late`]; not counted |
//! | contradicts a decision or itself ([`Lie`]) | told as [`Event::Disagrees`]; not counted |
//! | computed something else | excluded until it is restarted |
//! | was restarted, or was no member | a member after 8 activations with equal outputs |

use tandem_board::{Duration, Instant};

use crate::lockstep::{Agreement, compare};
use crate::message::{Activation, ClientId, Clients, MAX_CLIENTS, SyncRequest, SyncResponse};

/// A member that is not heard in so many activations in a row is no member.
const SILENT_LIMIT: u32 = 3;
/// A client that is no member becomes one after so many activations in a row with equal outputs.
const PROBATION: u32 = 8;
/// If one member alone reports that a service is lost, it holds the others for so many activations.
const LOST_ALONE_LIMIT: u32 = 8;

/// What the candidates agree on.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Config {
    /// N: the number of clients, 1 ..= [`MAX_CLIENTS`].
    pub clients: usize,
    /// M: how many clients an activation needs, 1 ..= N.
    pub quorum: usize,
    /// The number of candidates, 1 ..= [`MAX_CLIENTS`].
    pub candidates: usize,
    /// Time from one activation to the next.
    pub period: Duration,
    /// Time that an answer needs to reach all clients.
    pub lead: Duration,
    /// How long after an activation the master waits for all clients, if it has M; as a rule less
    /// than the period without two leads. Longer: a late client delays the others.
    pub wait: Duration,
    /// After this time without M requests the answer is the safe state. At the start: how long the
    /// master waits for all clients if it has M.
    pub patience: Duration,
    /// How long the next candidate waits for the master's decision.
    pub takeover: Duration,
}

impl Config {
    fn is_valid(&self) -> bool {
        (1..=MAX_CLIENTS).contains(&self.clients)
            && (1..=self.clients).contains(&self.quorum)
            && (1..=MAX_CLIENTS).contains(&self.candidates)
            && self.lead < self.period
    }
}

/// How a request contradicts what was decided.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Lie {
    /// Its words are not a request.
    Garbage,
    /// It names another client than the one whose mailbox it was in.
    Identity,
    /// It is from an earlier start than the last request.
    Generation,
    /// It is for a cycle that was not decided.
    Cycle,
    /// It names another time of the activation.
    Time,
    /// A member names another code.
    Code,
    /// It is a second, different request for one cycle.
    Twice,
}

/// What a candidate has seen.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Event {
    /// The client was started again.
    Restarted(ClientId),
    /// The client's request is so many cycles late.
    Late(ClientId, u64),
    /// The client says what cannot be.
    Disagrees(ClientId, Lie),
    /// The client did not answer in time.
    Silent(ClientId),
    /// The client computed something else in this cycle; it is excluded.
    Deviates(ClientId, u64),
    /// The client's outputs count from now on.
    Joined(ClientId),
    /// The client's outputs do not count any more.
    Left(ClientId),
    /// Only this client says that a service is lost; it is not believed any more.
    LostAlone(ClientId),
    /// So many periods were left out.
    Overrun(u16),
    /// This candidate decides from now on.
    Master(ClientId),
    /// No majority, or too few clients.
    SafeState,
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
struct Seen {
    request: Option<SyncRequest>,
    /// Activations in a row without a request in time.
    silent: u32,
    /// Activations in a row with equal outputs while it was no member.
    equal: u32,
}

/// One candidate.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub struct MasterCore {
    config: Config,
    id: ClientId,
    last: Option<SyncResponse>,
    seen: [Seen; MAX_CLIENTS],
    /// Clients that were started again since a decision last counted them.
    restarted: Clients,
    /// Activations in a row in which one member alone had lost a service.
    lost_alone: u32,
    /// Since when an answer is possible.
    ready_at: Option<Instant>,
    first_request_at: Option<Instant>,
    is_stopping: bool,
}

/// What a candidate does next.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[must_use]
pub struct NextPoll {
    /// Propose this answer now.
    pub propose: Option<SyncResponse>,
    /// Poll again at this time, or after a request or a decision.
    pub wake: Instant,
}

impl MasterCore {
    /// A candidate that has seen nothing; `None` if the numbers do not fit.
    #[must_use]
    pub fn new(config: Config, id: ClientId) -> Option<Self> {
        (config.is_valid() && id.index() < config.candidates).then_some(Self {
            config,
            id,
            last: None,
            seen: [Seen::default(); MAX_CLIENTS],
            restarted: Clients::NONE,
            lost_alone: 0,
            ready_at: None,
            first_request_at: None,
            is_stopping: false,
        })
    }

    /// Returns the last decision that this candidate has seen.
    #[must_use]
    pub const fn last(&self) -> Option<&SyncResponse> {
        self.last.as_ref()
    }

    /// Ends all clients at the next activation, if this candidate decides it.
    pub const fn stop(&mut self) {
        self.is_stopping = true;
    }

    /// Takes a request from the mailbox of `from`. One that was taken before changes nothing.
    /// First call [`MasterCore::on_decided`] with a decision that was read before the request.
    pub fn on_request(
        &mut self,
        now: Instant,
        from: ClientId,
        request: &SyncRequest,
        tell: &mut impl FnMut(Event),
    ) {
        if request.client != from || from.index() >= self.config.clients {
            return tell(Event::Disagrees(from, Lie::Identity));
        }
        let before = self.seen[from.index()].request;
        if before == Some(*request) {
            return;
        }
        if let Some(before) = before {
            if request.generation < before.generation {
                return tell(Event::Disagrees(from, Lie::Generation));
            }
            if request.generation > before.generation {
                self.restarted.insert(from);
                tell(Event::Restarted(from));
            } else if request.cycle == before.cycle {
                return tell(Event::Disagrees(from, Lie::Twice));
            } else if request.cycle < before.cycle {
                return tell(Event::Disagrees(from, Lie::Cycle));
            }
        }
        // A lie is not kept: it delays no other client, and the truth may still follow.
        if let Some(lie) = self.lie(request) {
            return tell(Event::Disagrees(from, lie));
        }
        self.first_request_at.get_or_insert(now);
        let is_member = self.members().contains(from);
        let seen = &mut self.seen[from.index()];
        seen.request = Some(*request);
        if !is_member {
            // It runs again: the others wait for it until the deadline, so that it can join.
            seen.silent = 0;
        }
        if request.cycle > 0 && request.cycle < self.cycle() {
            tell(Event::Late(from, self.cycle() - request.cycle));
        }
    }

    /// Takes a decision: its own, or that of another candidate. An earlier one changes nothing.
    pub fn on_decided(&mut self, response: &SyncResponse, tell: &mut impl FnMut(Event)) {
        if response.cycle <= self.cycle() {
            return;
        }
        for client in ClientId::first(self.config.clients) {
            self.note(client, response, tell);
        }
        if self.last.is_some_and(|last| last.master != response.master) {
            tell(Event::Master(response.master));
        }
        if response.skipped > 0 {
            tell(Event::Overrun(response.skipped));
        }
        if response.is_safe_state {
            tell(Event::SafeState);
        }
        self.lost_alone = match self.lost().len() {
            1 if self.members().len() > 1 => self.lost_alone.saturating_add(1),
            _ => 0,
        };
        if self.lost_alone == LOST_ALONE_LIMIT {
            self.lost()
                .iter()
                .for_each(|client| tell(Event::LostAlone(client)));
        }
        self.last = Some(*response);
        self.ready_at = None;
    }

    /// Counts what one client did in the cycle that this decision ends.
    fn note(&mut self, client: ClientId, response: &SyncResponse, tell: &mut impl FnMut(Event)) {
        let (was, is) = (
            self.members().contains(client),
            response.members.contains(client),
        );
        let request = self.in_time(client);
        let is_heard = if was {
            request.is_some()
        } else {
            self.is_heard(client)
        };
        let is_equal = request.is_some_and(|request| request.output == response.agreed);
        let is_excluded = response.excluded.contains(client);
        if is_excluded && !self.excluded().contains(client) {
            tell(Event::Deviates(client, response.cycle - 1));
        } else if was && !is {
            tell(Event::Left(client));
        } else if is && !was {
            tell(Event::Joined(client));
        }
        if !is_heard && self.is_awaited(client) {
            tell(Event::Silent(client));
        }
        if !is && !is_excluded {
            self.restarted.remove(client);
        }
        let seen = &mut self.seen[client.index()];
        seen.silent = if is_heard {
            0
        } else {
            seen.silent.saturating_add(1)
        };
        seen.equal = if is_equal && !is {
            seen.equal.saturating_add(1)
        } else {
            0
        };
    }

    /// Returns what to do at this time.
    pub fn poll(&mut self, now: Instant) -> NextPoll {
        let idle = |wake| NextPoll {
            propose: None,
            wake,
        };
        if self
            .last
            .is_some_and(|last| last.code == Activation::Terminate)
        {
            return idle(Instant::NEVER);
        }
        let mut clients = ClientId::first(self.config.clients);
        let is_missing = |client| self.is_awaited(client) && !self.is_heard(client);
        let is_enough = self.requests().count() >= self.config.quorum;
        let wait_until = match (is_enough, self.last, self.first_request_at) {
            (true, ..) if !clients.any(is_missing) => Instant::ORIGIN,
            (true, Some(last), _) => last.activation + self.config.wait,
            (true, None, Some(first)) => first + self.config.patience,
            (false, Some(last), _) => last.activation + self.config.patience,
            (_, None, _) => Instant::NEVER,
        };
        if now < wait_until {
            return idle(wait_until);
        }
        let turn = self.turn();
        let at = *self.ready_at.get_or_insert(now) + self.config.takeover.times(turn);
        if now < at {
            return idle(at);
        }
        NextPoll {
            propose: Some(self.answer(now)),
            wake: Instant::NEVER,
        }
    }

    /// Returns after how many others it is this candidate's turn.
    fn turn(&self) -> u32 {
        let count = self.config.candidates;
        let current = self.last.map_or(0, |last| last.master.index() % count);
        ((self.id.index() + count - current) % count) as u32
    }

    fn answer(&self, now: Instant) -> SyncResponse {
        let outputs = self
            .requests()
            .map(|(client, request)| (client, request.output));
        let (mut members, mut excluded) = (self.members(), self.excluded());
        let mut agreed = 0;
        match compare(outputs, self.config.quorum) {
            // Before the first activation there are no outputs.
            _ if self.last.is_none() => {
                members = self.requests().map(|(client, _)| client).collect()
            }
            Agreement::Agreed {
                output, deviating, ..
            } => {
                agreed = output;
                for client in deviating.iter() {
                    members.remove(client);
                    excluded.insert(client);
                }
            }
            Agreement::NoMajority => return self.safe_state(now),
        }
        for client in ClientId::first(self.config.clients) {
            let seen = &self.seen[client.index()];
            let request = self.in_time(client);
            let is_equal = request.is_some_and(|request| request.output == agreed);
            if self.restarted.contains(client) {
                members.remove(client);
                excluded.remove(client);
            } else if members.contains(client) {
                if request.is_none() && seen.silent + 1 >= SILENT_LIMIT {
                    members.remove(client);
                }
            } else if is_equal && seen.equal + 1 >= PROBATION && !excluded.contains(client) {
                members.insert(client);
            }
        }
        let (activation, skipped) = self.next_time(now);
        SyncResponse {
            code: self.next_code(),
            is_safe_state: false,
            members,
            excluded,
            agreed,
            activation,
            skipped,
            ..self.safe_state(now)
        }
    }

    fn safe_state(&self, now: Instant) -> SyncResponse {
        SyncResponse {
            master: self.id,
            cycle: self.cycle().saturating_add(1),
            activation: now + self.config.lead,
            code: Activation::Terminate,
            members: self.members(),
            excluded: self.excluded(),
            is_safe_state: true,
            skipped: 0,
            agreed: 0,
        }
    }

    /// Returns the next point of the grid of activations that an answer reaches in time, and how
    /// many points it leaves out.
    fn next_time(&self, now: Instant) -> (Instant, u16) {
        let earliest = now + self.config.lead;
        let Some(last) = self.last else {
            return (earliest, 0);
        };
        let next = last.activation + self.config.period;
        let behind = earliest
            .since(next)
            .as_ns()
            .div_ceil(self.config.period.as_ns().max(1));
        let span = Duration::from_ns(self.config.period.as_ns().saturating_mul(behind));
        (next + span, u16::try_from(behind).unwrap_or(u16::MAX))
    }

    fn next_code(&self) -> Activation {
        let done = self.requests().filter(|(_, request)| request.is_done);
        if self.is_stopping || self.last.is_some() && done.count() >= self.config.quorum {
            return Activation::Terminate;
        }
        let is_alone = self.lost_alone >= LOST_ALONE_LIMIT;
        let is_lost = self.lost().len() > usize::from(is_alone);
        Activation::after(self.last.map(|last| last.code), is_lost)
    }

    fn lost(&self) -> Clients {
        let lost = self.requests().filter(|(_, request)| request.is_lost);
        lost.map(|(client, _)| client).collect()
    }

    fn cycle(&self) -> u64 {
        self.last.map_or(0, |last| last.cycle)
    }

    /// Returns the clients whose outputs count: before the first activation, all.
    fn members(&self) -> Clients {
        let all = || ClientId::first(self.config.clients).collect();
        self.last.map_or_else(all, |last| last.members)
    }

    fn excluded(&self) -> Clients {
        self.last.map_or(Clients::NONE, |last| last.excluded)
    }

    /// Returns how this request contradicts the last decision. One for an earlier cycle does not.
    fn lie(&self, request: &SyncRequest) -> Option<Lie> {
        let is_member = self.members().contains(request.client);
        match self.last {
            _ if request.cycle > self.cycle() => Some(Lie::Cycle),
            Some(last) if request.cycle == last.cycle => {
                if request.activation != last.activation {
                    Some(Lie::Time)
                } else {
                    let is_same = request.code == Some(last.code) || !is_member;
                    (!is_same && !self.restarted.contains(request.client)).then_some(Lie::Code)
                }
            }
            _ => None,
        }
    }

    /// Returns the client's request if it ends the last activation.
    fn in_time(&self, client: ClientId) -> Option<&SyncRequest> {
        let request = self.seen[client.index()].request.as_ref()?;
        let is_same = request.code == self.last.map(|last| last.code);
        (is_same && self.is_heard(client)).then_some(request)
    }

    /// Returns the requests that count.
    fn requests(&self) -> impl Iterator<Item = (ClientId, &SyncRequest)> + Clone {
        let members = self
            .members()
            .iter()
            .filter(|client| !self.restarted.contains(*client));
        members.filter_map(|client| Some((client, self.in_time(client)?)))
    }

    /// Returns whether the client has ended the last activation, whatever that was for it.
    fn is_heard(&self, client: ClientId) -> bool {
        self.seen[client.index()].request.is_some_and(|request| {
            let last = self.last.map_or(Instant::ORIGIN, |last| last.activation);
            request.cycle == self.cycle() && request.activation == last
        })
    }

    /// Returns whether it is worth to wait for the client: it was heard the last time.
    fn is_awaited(&self, client: ClientId) -> bool {
        self.seen[client.index()].silent == 0 && !self.excluded().contains(client)
    }
}
