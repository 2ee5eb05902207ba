//! The deterministic client: what the next activation is for, and when it is (E-1).
//!
//! A client takes a response only once for a cycle, and only if its cycle is later than the last
//! one. A client that was restarted, or was away, follows its own column of the table of
//! [`Activation`] until it has caught up: so it never runs before its `Init`.

use tandem_board::{Duration, Instant};

use crate::message::{Activation, ClientId, Request, Response};

/// SplitMix64: the generator of G. L. Steele, D. Lea and C. H. Flood, "Fast splittable pseudorandom
/// number generators" (OOPSLA 2014), with the constants of `java.util.SplittableRandom`. It is
/// small and has no bad seeds. It is not for secrets.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Random(u64);

/// The generator's step: 2^64 divided by the golden ratio, made odd.
const GOLDEN: u64 = 0x9E37_79B9_7F4A_7C15;

impl Random {
    /// Starts the sequence of this seed.
    #[must_use]
    pub const fn new(seed: u64) -> Self {
        Self(seed)
    }

    /// Starts the sequence of one element of a run. The seed is drawn at position `index` of the
    /// run's own sequence, so it depends on no other element.
    #[must_use]
    pub const fn of_element(seed: u64, index: u64) -> Self {
        let mut place = Self(seed.wrapping_add(index.wrapping_mul(GOLDEN)));
        Self(place.draw())
    }

    /// Returns the next number.
    pub const fn draw(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(GOLDEN);
        let mut z = self.0;
        z = (z ^ z >> 30).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ z >> 27).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^ z >> 31
    }
}

/// Where a client stands among the redundant clients.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Standing {
    /// Its outputs count.
    Member,
    /// It was restarted or away: its outputs are compared but do not count yet.
    Joining,
    /// Its outputs deviated. It should end and be restarted.
    Excluded,
}

/// An activation: what `wait_for_activation` returns.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Activated {
    /// What it is for.
    pub code: Activation,
    /// Its number, from 1.
    pub cycle: u64,
    /// An overrun, if not zero: how long after its time the client, or the answer, was ready.
    pub overrun: Duration,
    /// How long after its time it is; at least the overrun.
    pub late: Duration,
    /// How many activations this client missed before this one.
    pub missed: u64,
    /// How many periods all clients left out before this one.
    pub skipped: u16,
    /// Whether the outputs of this client count.
    pub standing: Standing,
    /// No majority agreed: the vehicle must go to its safe state. The code is `Terminate`.
    pub is_safe_state: bool,
    /// The digest on which the members agreed for the previous activation. An output acts if and
    /// only if its digest is this one.
    pub agreed: u64,
}

impl Activated {
    /// Tests whether all went as planned: no overrun, nothing missed, nothing left out.
    #[must_use]
    pub fn is_punctual(&self) -> bool {
        self.overrun == Duration::ZERO && self.missed == 0 && self.skipped == 0
    }
}

/// No client waits longer than this for an activation.
pub const HORIZON: Duration = Duration::from_ms(10_000);

/// Why a response was not taken.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum NotTaken {
    /// It is for a cycle that this client has taken, or for an earlier one.
    Stale,
    /// It is at no time for which this client may wait: not after the last activation, or further
    /// ahead than [`HORIZON`]. Its sender lies.
    WrongTime,
}

/// One redundant client.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub struct Client {
    id: ClientId,
    generation: u32,
    cycle: u64,
    activation: Instant,
    code: Option<Activation>,
    is_lost: bool,
    is_done: bool,
    random: Random,
    /// The response for the next activation, and its overrun.
    taken: Option<(Response, Duration)>,
}

impl Client {
    /// A client before its first activation. `generation` grows with each start, from 1.
    #[must_use]
    pub const fn new(id: ClientId, generation: u32) -> Self {
        Self {
            id,
            generation,
            cycle: 0,
            activation: Instant::ORIGIN,
            code: None,
            is_lost: false,
            is_done: false,
            random: Random::new(0),
            taken: None,
        }
    }

    /// Notes that a service that this client needs is lost (`true`) or was found (`false`).
    /// The next activation after a loss is `ServiceDiscovery`.
    pub const fn set_lost(&mut self, is_lost: bool) {
        self.is_lost = is_lost;
    }

    /// Notes that this client has nothing left to do. When enough members say so, all terminate.
    pub const fn set_done(&mut self) {
        self.is_done = true;
    }

    /// Returns the request that ends the current activation. `output`: the digest of its outputs.
    #[must_use]
    pub const fn request(&self, output: u64) -> Request {
        Request {
            client: self.id,
            generation: self.generation,
            cycle: self.cycle,
            activation: self.activation,
            code: self.code,
            is_lost: self.is_lost,
            is_done: self.is_done,
            output,
        }
    }

    /// Takes a response. Returns the time of the activation; call [`Client::activate`] then.
    ///
    /// # Errors
    /// [`NotTaken`]: wait for another response.
    pub fn on_response(&mut self, now: Instant, response: &Response) -> Result<Instant, NotTaken> {
        if self.taken.is_some() || response.cycle <= self.cycle {
            return Err(NotTaken::Stale);
        }
        if response.activation <= self.activation || response.activation > now + HORIZON {
            return Err(NotTaken::WrongTime);
        }
        self.taken = Some((*response, now.since(response.activation)));
        Ok(response.activation)
    }

    /// Activates the client, if it has taken a response and its time has come. SWS_EM_01327
    pub fn activate(&mut self, now: Instant) -> Option<Activated> {
        let (response, overrun) = self.taken.take_if(|(taken, _)| taken.activation <= now)?;
        let standing = match response {
            _ if response.excluded.contains(self.id) => Standing::Excluded,
            _ if response.members.contains(self.id) => Standing::Member,
            _ => Standing::Joining,
        };
        let is_held = self.is_lost && standing != Standing::Member;
        let code = match response.code {
            Activation::Terminate => Activation::Terminate,
            code if code.may_follow(self.code) && !is_held => code,
            _ => Activation::after(self.code, self.is_lost),
        };
        let before = core::mem::replace(&mut self.cycle, response.cycle);
        self.activation = response.activation;
        self.code = Some(code);
        // The cycle too: two runs may have an activation at the same time.
        self.random = Random::of_element(response.activation.as_ns(), response.cycle);
        Some(Activated {
            code,
            cycle: response.cycle,
            overrun,
            late: now.since(response.activation),
            missed: if before == 0 {
                0
            } else {
                response.cycle - before - 1
            },
            skipped: response.skipped,
            standing,
            is_safe_state: response.is_safe_state,
            agreed: response.agreed,
        })
    }

    /// Returns the time of the current activation: the same in all redundant clients.
    #[must_use]
    pub const fn activation_time(&self) -> Instant {
        self.activation
    }

    /// Returns the next random number: the same in all redundant clients that draw equally often
    /// since the activation.
    pub const fn random(&mut self) -> u64 {
        self.random.draw()
    }

    /// Returns who this is.
    #[must_use]
    pub const fn id(&self) -> ClientId {
        self.id
    }
}
