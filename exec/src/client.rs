//! The deterministic client: what the next activation is for, and when it is (E-1).
//!
//! A client takes a response only once for a cycle, and only if its cycle is later than the last
//! one. A client that was restarted, or was away, follows its own column of the table of
//! [`Activation`] until it has caught up: so it never runs before its `Init`.

use tandem_board::{Duration, Instant};

use crate::message::{Activation, ClientId, SyncRequest, SyncResponse};

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

impl core::fmt::Display for NotTaken {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str(match self {
            Self::Stale => "it is for a cycle that was taken, or for an earlier one",
            Self::WrongTime => "it is at no time for which this client may wait",
        })
    }
}

impl core::error::Error for NotTaken {}

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
    taken: Option<(SyncResponse, Duration)>,
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
    pub const fn request(&self, output: u64) -> SyncRequest {
        SyncRequest {
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
    pub fn on_response(
        &mut self,
        now: Instant,
        response: &SyncResponse,
    ) -> Result<Instant, NotTaken> {
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::message::Clients;
    use proptest::prelude::*;

    const MS: fn(u64) -> Instant = |ms| Instant::ORIGIN + Duration::from_ms(ms);

    fn id(number: usize) -> ClientId {
        ClientId::new(number).unwrap()
    }

    fn response(cycle: u64, code: Activation) -> SyncResponse {
        SyncResponse {
            master: id(0),
            cycle,
            activation: MS(10 * cycle),
            code,
            members: ClientId::first(3).collect(),
            excluded: Clients::NONE,
            is_safe_state: false,
            skipped: 0,
            agreed: 7,
        }
    }

    /// Takes a response in time and is activated at its time.
    fn activate(client: &mut Client, response: &SyncResponse) -> Activated {
        let at = response.activation;
        assert_eq!(client.on_response(MS(0), response), Ok(at));
        client.activate(at).unwrap()
    }

    /// E-1: the whole table. Every code that may follow is taken; every other one is replaced by
    /// the one that the table gives: nothing is left out.
    #[test]
    fn each_activation_follows_the_table() {
        use Activation::{Init, RegisterServices, Run, ServiceDiscovery, Terminate};
        let table = [
            (None, RegisterServices, RegisterServices),
            (Some(RegisterServices), ServiceDiscovery, ServiceDiscovery),
            (Some(ServiceDiscovery), Init, ServiceDiscovery),
            (Some(Init), Run, ServiceDiscovery),
            (Some(Run), Run, ServiceDiscovery),
            (Some(Terminate), Terminate, Terminate),
        ];
        for (last, next, if_lost) in table {
            assert_eq!(Activation::after(last, false), next);
            assert_eq!(Activation::after(last, true), if_lost);
            for code in Activation::ALL {
                let may_follow = [next, if_lost, Terminate].contains(&code);
                assert_eq!(code.may_follow(last), may_follow, "{last:?} {code:?}");
                let mut client = Client::new(id(1), 1);
                client.code = last;
                let taken = activate(&mut client, &response(1, code)).code;
                assert_eq!(
                    taken,
                    if may_follow { code } else { next },
                    "{last:?} {code:?}"
                );
            }
        }
    }

    /// E-1: an overrun is told with its length, and so is a late wake-up.
    #[test]
    fn an_overrun_is_told() {
        let mut client = Client::new(id(1), 1);
        assert!(activate(&mut client, &response(1, Activation::RegisterServices)).is_punctual());
        let next = response(2, Activation::ServiceDiscovery);
        assert_eq!(client.on_response(MS(23), &next), Ok(MS(20)));
        let activated = client.activate(MS(24)).unwrap();
        assert_eq!(activated.overrun, Duration::from_ms(3));
        assert_eq!(activated.late, Duration::from_ms(4));
        assert!(!activated.is_punctual());
        let after = activate(&mut client, &response(5, Activation::Init));
        assert_eq!((after.missed, after.overrun), (2, Duration::ZERO));
        assert!(!after.is_punctual());
        let skipped = SyncResponse {
            skipped: 3,
            ..response(6, Activation::Run)
        };
        assert!(!activate(&mut client, &skipped).is_punctual());
    }

    /// A client is never activated early, twice, for an old cycle, or at a time that cannot be.
    #[test]
    fn what_cannot_be_is_not_taken() {
        let mut client = Client::new(id(1), 1);
        let first = response(1, Activation::RegisterServices);
        assert_eq!(client.on_response(MS(0), &first), Ok(MS(10)));
        assert_eq!(client.activate(MS(9)), None);
        let second = response(2, Activation::ServiceDiscovery);
        assert_eq!(
            client.on_response(MS(9), &second),
            Err(NotTaken::Stale),
            "waits for one"
        );
        assert!(client.activate(MS(10)).is_some());
        assert_eq!(client.activate(MS(10)), None);
        assert_eq!(client.on_response(MS(10), &first), Err(NotTaken::Stale));
        for at in [MS(10), MS(9), MS(10_011), Instant::NEVER] {
            let wrong = SyncResponse {
                activation: at,
                ..second
            };
            assert_eq!(
                client.on_response(MS(10), &wrong),
                Err(NotTaken::WrongTime),
                "{at:?}"
            );
        }
        assert_eq!(client.request(5).cycle, 1);
    }

    /// A client that is no member and has lost a service does not run.
    #[test]
    fn a_joining_client_looks_for_its_services_alone() {
        let mut client = Client::new(id(5), 2);
        client.code = Some(Activation::Run);
        client.set_lost(true);
        let joining = activate(&mut client, &response(1, Activation::Run));
        assert_eq!(
            (joining.code, joining.standing),
            (Activation::ServiceDiscovery, Standing::Joining)
        );
    }

    /// SWS_EM_01326, 01327: equal numbers in all clients, others in each cycle.
    #[test]
    fn random_numbers_are_those_of_the_activation() {
        // The first outputs of `SplittableRandom(1234567)`, as in the published test vectors.
        let mut random = Random::new(1_234_567);
        let first = [random.draw(), random.draw(), random.draw()];
        assert_eq!(
            first,
            [
                6_457_827_717_110_365_317,
                3_203_168_211_198_807_973,
                9_817_491_932_198_370_423
            ]
        );
        let draw = |number: usize, cycle| {
            let mut client = Client::new(id(number), number as u32 + 1);
            activate(&mut client, &response(cycle, Activation::RegisterServices));
            [client.random(), client.random()]
        };
        assert_eq!(draw(0, 4), draw(2, 4));
        assert_ne!(draw(0, 4), draw(0, 5));
    }

    proptest! {
        /// Shared memory is hostile: any words decode without a panic, and what decodes is stored
        /// as the same words.
        #[test]
        fn any_words_are_decoded_or_refused(
            mut words: [u32; 8],
            head in 0_u32..1 << 18,
            kind in 0..3,
        ) {
            if kind > 0 {
                words[0] = (0xD0 + kind as u32) << 24 | head;
            }
            check::<SyncRequest>(words);
            check::<SyncResponse>(words);
        }

        /// A response that was not meant for it never takes a client back in cycle or time.
        #[test]
        fn cycles_and_times_only_increase(
            words in prop::collection::vec((any::<u32>(), 0_u32..6, 0_u32..9), 1..40),
        ) {
            let mut client = Client::new(id(1), 1);
            let mut last = (0, Instant::ORIGIN);
            for (random, cycle, ms) in words {
                let code = Activation::ALL[random as usize % 5];
                let mut response = response(u64::from(cycle) + 1, code);
                response.activation = MS(u64::from(ms));
                if client.on_response(MS(4), &response).is_ok() {
                    client.activate(MS(9)).unwrap();
                    prop_assert!(client.cycle > last.0 && client.activation > last.1);
                    last = (client.cycle, client.activation);
                }
            }
        }
    }

    fn decode<T: tandem_shm::Payload>(words: [u32; 8]) -> Option<T> {
        let mut rest = words.into_iter();
        T::load(&mut || rest.next().unwrap()).ok()
    }

    /// Each word that cannot be is refused.
    #[test]
    fn impossible_words_are_refused() {
        let request: [u32; 8] = [0xD100_0401, 1, 5, 0, 9, 0, 7, 0];
        let response: [u32; 8] = [0xD200_0401, 0x0000_0403, 5, 0, 9, 0, 7, 0];
        assert!(
            decode::<SyncRequest>(request).is_some() && decode::<SyncResponse>(response).is_some()
        );
        let wrong_requests = [
            (0, 0xD200_0401),
            (0, 0xD100_0408),
            (0, 0xD100_0601),
            (0, 0xD100_0001),
        ];
        for (at, word) in wrong_requests
            .into_iter()
            .chain([(0, 0xD104_0401), (1, 0), (2, 0)])
        {
            let mut words = request;
            words[at] = word;
            assert!(decode::<SyncRequest>(words).is_none(), "{at} {word:x}");
        }
        let wrong_responses = [(0, 0xD100_0401), (0, 0xD200_0408), (0, 0xD200_0001)];
        for (at, word) in wrong_responses
            .into_iter()
            .chain([(0, 0xD202_0401), (1, 0x303), (2, 0)])
        {
            let mut words = response;
            words[at] = word;
            assert!(decode::<SyncResponse>(words).is_none(), "{at} {word:x}");
        }
    }

    fn check<T: tandem_shm::Payload>(words: [u32; 8]) {
        if let Some(value) = decode::<T>(words) {
            let mut stored = vec![];
            value.store(&mut |word| stored.push(word));
            assert_eq!(stored, words);
        }
    }
}
