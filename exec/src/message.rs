//! What clients and masters say to each other, as words with a checked decode.

use tandem_board::Instant;
use tandem_shm::{Corrupt, Payload};

/// The largest number of redundant clients; also of candidates for the master.
pub const MAX_CLIENTS: usize = 8;

/// A client, or a candidate for the master: 0 ..= 7.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct ClientId(u8);

impl ClientId {
    /// Returns the client with this number, or `None` if it is not below [`MAX_CLIENTS`].
    #[must_use]
    pub const fn new(number: usize) -> Option<Self> {
        if number < MAX_CLIENTS {
            Some(Self(number as u8))
        } else {
            None
        }
    }

    /// Returns the number, below [`MAX_CLIENTS`].
    #[must_use]
    pub const fn index(self) -> usize {
        self.0 as usize
    }

    /// Returns all clients below `count`.
    pub fn first(count: usize) -> impl Iterator<Item = Self> + Clone {
        (0..count.min(MAX_CLIENTS)).map(|number| Self(number as u8))
    }
}

/// A set of clients.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub struct Clients(u8);

impl Clients {
    /// No client.
    pub const NONE: Self = Self(0);

    /// Tests whether the client is in the set.
    #[must_use]
    pub const fn contains(self, client: ClientId) -> bool {
        self.0 & 1 << client.0 != 0
    }

    /// Adds a client.
    pub const fn insert(&mut self, client: ClientId) {
        self.0 |= 1 << client.0;
    }

    /// Removes a client.
    pub const fn remove(&mut self, client: ClientId) {
        self.0 &= !(1 << client.0);
    }

    /// Returns how many clients are in the set.
    #[must_use]
    pub const fn len(self) -> usize {
        self.0.count_ones() as usize
    }

    /// Tests whether the set has no client.
    #[must_use]
    pub const fn is_empty(self) -> bool {
        self.0 == 0
    }

    /// Returns the clients of the set in ascending order.
    pub fn iter(self) -> impl Iterator<Item = ClientId> + Clone {
        ClientId::first(MAX_CLIENTS).filter(move |client| self.contains(*client))
    }
}

impl FromIterator<ClientId> for Clients {
    fn from_iter<I: IntoIterator<Item = ClientId>>(clients: I) -> Self {
        let mut set = Self::NONE;
        clients.into_iter().for_each(|client| set.insert(client));
        set
    }
}

/// What an activation is for: the return value of `wait_for_activation`. SWS_EM_01302
///
/// | last | next, as a rule | if a service is lost | at the end |
/// |---|---|---|---|
/// | none | `RegisterServices` | `RegisterServices` | `Terminate` |
/// | `RegisterServices` | `ServiceDiscovery` | `ServiceDiscovery` | `Terminate` |
/// | `ServiceDiscovery` | `Init` | `ServiceDiscovery` | `Terminate` |
/// | `Init` | `Run` | `ServiceDiscovery` | `Terminate` |
/// | `Run` | `Run` | `ServiceDiscovery` | `Terminate` |
/// | `Terminate` | `Terminate` | `Terminate` | `Terminate` |
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Activation {
    /// Offer own services, and do nothing else.
    RegisterServices = 1,
    /// Find the services that are needed, and do nothing else. SWS_EM_01304
    ServiceDiscovery = 2,
    /// Bring the data into their initial state.
    Init = 3,
    /// Compute one cycle.
    Run = 4,
    /// Clean up and end.
    Terminate = 5,
}

impl Activation {
    /// All activations, in order.
    pub const ALL: [Self; 5] = [
        Self::RegisterServices,
        Self::ServiceDiscovery,
        Self::Init,
        Self::Run,
        Self::Terminate,
    ];

    /// Returns the activation after `last`, by the table above; `is_lost`: a service is lost.
    #[must_use]
    pub const fn after(last: Option<Self>, is_lost: bool) -> Self {
        match (last, is_lost) {
            (None, _) => Self::RegisterServices,
            (Some(Self::RegisterServices), _)
            | (Some(Self::ServiceDiscovery | Self::Init | Self::Run), true) => {
                Self::ServiceDiscovery
            }
            (Some(Self::ServiceDiscovery), false) => Self::Init,
            (Some(Self::Init | Self::Run), false) => Self::Run,
            (Some(Self::Terminate), _) => Self::Terminate,
        }
    }

    /// Tests whether this activation may follow `last`.
    #[must_use]
    pub fn may_follow(self, last: Option<Self>) -> bool {
        let is_next = |is_lost| Self::after(last, is_lost) == self;
        self == Self::Terminate || is_next(false) || is_next(true)
    }

    fn decode(word: u32) -> Option<Self> {
        Self::ALL.get((word as usize).wrapping_sub(1)).copied()
    }
}

/// What a client says when it waits for its next activation. SWS_EM_01325
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct SyncRequest {
    /// Who asks.
    pub client: ClientId,
    /// Which start of this client, from 1. A greater number means that it was restarted.
    pub generation: u32,
    /// Number of the activation that it has executed; 0 before the first.
    pub cycle: u64,
    /// When that activation was.
    pub activation: Instant,
    /// What it was activated for; `None` before the first.
    pub code: Option<Activation>,
    /// A service that it needs is lost.
    pub is_lost: bool,
    /// It has nothing left to do.
    pub is_done: bool,
    /// Digest of the outputs that it computed since that activation.
    pub output: u64,
}

/// What the master answers to all clients. SWS_EM_01326
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct SyncResponse {
    /// The master that answers.
    pub master: ClientId,
    /// Number of the activation, from 1.
    pub cycle: u64,
    /// When it is.
    pub activation: Instant,
    /// What it is for.
    pub code: Activation,
    /// The clients whose outputs count.
    pub members: Clients,
    /// The clients that deviated. Only a restart brings them back.
    pub excluded: Clients,
    /// No majority agreed: the outputs of the previous activation must not act, nor any later one.
    pub is_safe_state: bool,
    /// How many periods were left out before this activation, because the clients or the master
    /// were late; up to 65,535.
    pub skipped: u16,
    /// The digest on which the members agreed for the previous activation.
    pub agreed: u64,
}

/// Marks a word as one of this protocol; also its version.
const REQUEST_MARK: u32 = 0xD1 << 24;
const RESPONSE_MARK: u32 = 0xD2 << 24;
const MARK: u32 = 0xFF << 24;
const LOST: u32 = 1 << 16;
const DONE: u32 = 1 << 17;
const SAFE_STATE: u32 = 1 << 16;

fn put_u64(value: u64, put: &mut impl FnMut(u32)) {
    put(value as u32);
    put((value >> 32) as u32);
}

fn take_u64(take: &mut impl FnMut() -> u32) -> u64 {
    let low = u64::from(take());
    low | u64::from(take()) << 32
}

/// Splits the first word: mark, flags, code, client. Other bits must be zero.
fn head(word: u32, mark: u32, flags: u32) -> Result<(ClientId, u32), Corrupt> {
    if word & MARK != mark || word & !(MARK | flags | 0xFFFF) != 0 {
        return Err(Corrupt);
    }
    let client = ClientId::new((word & 0xFF) as usize).ok_or(Corrupt)?;
    Ok((client, word >> 8 & 0xFF))
}

impl Payload for SyncRequest {
    const WORDS: usize = 8;

    fn store(&self, put: &mut impl FnMut(u32)) {
        let code = self.code.map_or(0, |code| code as u32);
        let [lost, done] = [self.is_lost, self.is_done].map(u32::from);
        let flags = (lost * LOST) | (done * DONE);
        put(REQUEST_MARK | flags | code << 8 | u32::from(self.client.0));
        put(self.generation);
        put_u64(self.cycle, put);
        self.activation.to_words().into_iter().for_each(&mut *put);
        put_u64(self.output, put);
    }

    fn load(take: &mut impl FnMut() -> u32) -> Result<Self, Corrupt> {
        let first = take();
        let (client, code) = head(first, REQUEST_MARK, LOST | DONE)?;
        let request = Self {
            client,
            generation: take(),
            cycle: take_u64(take),
            activation: Instant::from_words([take(), take()]),
            code: Activation::decode(code),
            is_lost: first & LOST != 0,
            is_done: first & DONE != 0,
            output: take_u64(take),
        };
        // Before the first activation there is no code, and after it there is one.
        let is_known = request.code.is_some() || code == 0;
        let is_consistent = request.code.is_none() == (request.cycle == 0);
        let is_valid = is_known && is_consistent && request.generation != 0;
        is_valid.then_some(request).ok_or(Corrupt)
    }
}

impl Payload for SyncResponse {
    const WORDS: usize = 8;

    fn store(&self, put: &mut impl FnMut(u32)) {
        let flags = u32::from(self.is_safe_state) * SAFE_STATE;
        put(RESPONSE_MARK | flags | (self.code as u32) << 8 | u32::from(self.master.0));
        let (members, excluded) = (u32::from(self.members.0), u32::from(self.excluded.0));
        put(u32::from(self.skipped) << 16 | excluded << 8 | members);
        put_u64(self.cycle, put);
        self.activation.to_words().into_iter().for_each(&mut *put);
        put_u64(self.agreed, put);
    }

    fn load(take: &mut impl FnMut() -> u32) -> Result<Self, Corrupt> {
        let (first, second) = (take(), take());
        let (master, code) = head(first, RESPONSE_MARK, SAFE_STATE)?;
        let response = Self {
            master,
            cycle: take_u64(take),
            activation: Instant::from_words([take(), take()]),
            code: Activation::decode(code).ok_or(Corrupt)?,
            members: Clients(second as u8),
            excluded: Clients((second >> 8) as u8),
            is_safe_state: first & SAFE_STATE != 0,
            skipped: (second >> 16) as u16,
            agreed: take_u64(take),
        };
        let is_disjoint = response.members.0 & response.excluded.0 == 0;
        let is_valid = is_disjoint && response.cycle != 0;
        is_valid.then_some(response).ok_or(Corrupt)
    }
}
