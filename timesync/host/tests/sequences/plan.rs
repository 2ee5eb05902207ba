//! What happens in one sequence, drawn from its number.

use chacha20::ChaCha8Rng;
use rand::{Rng, RngExt, SeedableRng};

pub(crate) const US: u64 = 1_000;
pub(crate) const MS: u64 = 1_000_000;

/// Who or what is wrong in a sequence besides its messages.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Liar {
    /// Nothing: each stated error must hold.
    None,
    /// Clocks of systems and sensors jump.
    Jumps,
    /// The grandmaster's time is set, by a little or a lot.
    Steps,
    /// The grandmaster's clock or a local clock runs beyond the limit of crystals.
    Rate,
    /// Another station sends in the grandmaster's name; transfers and frames are forged.
    Forger,
    /// A second grandmaster has another time; at last the first dies.
    SecondMaster,
    /// Messages take longer in one direction.
    Asymmetry,
}

impl Liar {
    const ALL: [Self; 7] = [
        Self::None,
        Self::Jumps,
        Self::Steps,
        Self::Rate,
        Self::Forger,
        Self::SecondMaster,
        Self::Asymmetry,
    ];
}

/// A clock of the chain.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Place {
    Grandmaster,
    System(usize),
    Sensor,
}

/// What happens to all messages of a kind for a while.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Spell {
    /// Transfers of the pulse are late by this time, ns.
    TransfersLate(u64),
    /// Edges are lost, or move by a random time of up to this, ns.
    EdgesMove(u64),
    /// Follow-ups on CAN are late.
    CanFollowUpsLate(u64),
    /// Follow-ups of the grandmaster are late.
    FollowUpsLate(u64),
}

/// What happens once, at a time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Incident {
    /// A clock is set by this much, ns.
    Jump(Place, i64),
    /// A clock has this rate from now on, ppb.
    Rate(Place, i64),
    /// The other system drives from now on. The old one still runs, or restarts after this time,
    /// ms.
    Takeover(Option<u64>),
    /// A sensor restarts.
    SensorRestarts,
    /// The grandmaster is silent from now on.
    GrandmasterDies,
    /// A message of a forger, with this deviation from the right time, ns.
    Forgery(i64),
}

/// One sequence.
#[derive(Debug)]
pub(crate) struct Plan {
    pub(crate) liar: Liar,
    /// Messages that suffer a fault.
    pub(crate) faulty_permille: u32,
    /// How long there are faults; afterwards none for [`QUIET_NS`].
    pub(crate) ends: u64,
    pub(crate) has_grandmaster: bool,
    /// Grandmaster, second grandmaster, A, B, sensor.
    pub(crate) rates_ppb: [i64; 5],
    /// Tasks and frames that nothing disturbs are late by up to this, ns.
    pub(crate) lateness: u64,
    /// The Ethernet: shortest time of a message, and what may be added to it.
    pub(crate) wire: (u64, u64),
    /// The second direction is slower by this.
    pub(crate) slower_back: u64,
    /// The line Time, and the largest latency of its stamp.
    pub(crate) line: (u64, u64),
    pub(crate) incidents: Vec<(u64, Incident)>,
    /// Each with its begin and its end.
    pub(crate) spells: Vec<(u64, u64, Spell)>,
}

/// Without faults all recover in this time: a grandmaster counts as silent after 3 s, its delay
/// needs a second, and a correction of 1 ms two.
pub(crate) const RECOVERS_NS: u64 = 8_000 * MS;
/// A sequence ends with this time without faults.
pub(crate) const QUIET_NS: u64 = RECOVERS_NS + 2_000 * MS;

pub(crate) fn rng(number: u64, stream: u64) -> ChaCha8Rng {
    ChaCha8Rng::seed_from_u64(number << 8 | stream)
}

/// Returns a span with a uniform magnitude: as often 1 to 10 µs as 0.1 to 1 s.
pub(crate) fn magnitude(rng: &mut impl Rng, from: u64, to: u64) -> u64 {
    let (low, high) = (from.max(1).ilog2(), to.ilog2());
    let exponent = rng.random_range(low..=high);
    (1 << exponent | rng.random_range(0..1u64 << exponent)).clamp(from, to)
}

fn signed(rng: &mut impl Rng, from: u64, to: u64) -> i64 {
    let size = magnitude(rng, from, to) as i64;
    if rng.random() { size } else { -size }
}

impl Plan {
    pub(crate) fn draw(number: u64) -> Self {
        let mut rng = rng(number, 1);
        let rng = &mut rng;
        // Half of all sequences have no liar.
        let liar = match rng.random_range(0..2) {
            0 => Liar::None,
            _ => Liar::ALL[rng.random_range(1..Liar::ALL.len())],
        };
        let mut plan = Self {
            liar,
            faulty_permille: [0, 20, 100, 300, 600][rng.random_range(0..5)],
            ends: rng.random_range(4_000..14_000) * MS,
            has_grandmaster: liar >= Liar::Steps || rng.random_range(0..4) > 0,
            rates_ppb: core::array::from_fn(|_| rng.random_range(-99_000..=99_000)),
            lateness: [US, 300 * US, 2_000 * US][rng.random_range(0..3)],
            wire: (magnitude(rng, US, 50 * US), rng.random_range(0..=8 * US)),
            slower_back: 0,
            line: (rng.random_range(0..=10 * US), rng.random_range(0..=5 * US)),
            incidents: vec![],
            spells: vec![],
        };
        for _ in 0..rng.random_range(0..3) {
            let dies = rng.random_range(0..2) == 0;
            let back_ms = dies.then(|| rng.random_range(20..6_000));
            plan.add(rng, 0, Incident::Takeover(back_ms));
        }
        if rng.random_range(0..4) == 0 {
            plan.add(rng, 0, Incident::SensorRestarts);
        }
        if plan.faulty_permille > 0 {
            plan.draw_spells(rng);
        }
        plan.draw_wander(rng);
        plan.draw_lies(rng);
        plan
    }

    /// At a time after `from`, within the time of faults.
    fn add(&mut self, rng: &mut impl Rng, from: u64, incident: Incident) {
        let at = rng.random_range(from..self.ends);
        self.incidents.push((at, incident));
    }

    fn draw_spells(&mut self, rng: &mut impl Rng) {
        for _ in 0..rng.random_range(0..4) {
            let span = rng.random_range(MS..300 * MS);
            let spell = [
                Spell::TransfersLate(span),
                Spell::EdgesMove(span),
                Spell::CanFollowUpsLate(span),
                Spell::FollowUpsLate(span),
            ];
            let from = rng.random_range(0..self.ends);
            let to = self.ends.min(from + rng.random_range(0..4_000 * MS));
            self.spells.push((from, to, spell[rng.random_range(0..4)]));
        }
    }

    /// Returns by how much messages of a kind are late at `now`, ns. `of`: the span if it is of
    /// this kind.
    pub(crate) fn late(&self, now: u64, of: impl Fn(Spell) -> Option<u64>) -> u64 {
        let now = self
            .spells
            .iter()
            .filter(|(from, to, _)| (*from..*to).contains(&now));
        now.filter_map(|(.., spell)| of(*spell)).sum()
    }

    /// The temperature of each crystal changes: two of them differ by 200 ppb more at most.
    fn draw_wander(&mut self, rng: &mut impl Rng) {
        let places = [
            Place::Grandmaster,
            Place::System(0),
            Place::System(1),
            Place::Sensor,
        ];
        for _ in 0..rng.random_range(0..8) {
            let place = places[rng.random_range(0..places.len())];
            let rate = self.rates_ppb[place.number()] + rng.random_range(-50..=50);
            self.add(rng, 0, Incident::Rate(place, rate));
        }
    }

    fn draw_lies(&mut self, rng: &mut impl Rng) {
        let local = [Place::System(0), Place::System(1), Place::Sensor];
        let count = rng.random_range(1..6);
        match self.liar {
            Liar::None => {}
            Liar::Jumps => {
                for _ in 0..count {
                    let by = signed(rng, US, 10_000 * MS);
                    let place = local[rng.random_range(0..3)];
                    self.add(rng, 0, Incident::Jump(place, by));
                }
            }
            Liar::Steps => {
                for _ in 0..count {
                    let by = signed(rng, US, 100_000 * MS);
                    self.add(rng, 0, Incident::Jump(Place::Grandmaster, by));
                }
            }
            Liar::Rate => {
                let place = [Place::Grandmaster, local[0], local[1], local[2]];
                let place = place[rng.random_range(0..4)];
                let wrong = signed(rng, 100_000, 50_000_000);
                self.add(rng, 0, Incident::Rate(place, wrong));
                let right = self.rates_ppb[place.number()];
                self.incidents
                    .push((self.ends - 1, Incident::Rate(place, right)));
            }
            Liar::Forger => {
                let by = signed(rng, US, 10_000 * MS);
                for _ in 0..count * 20 {
                    let by = match rng.random_range(0..2) {
                        0 => by,
                        _ => signed(rng, US, 10_000 * MS),
                    };
                    self.add(rng, 0, Incident::Forgery(by));
                }
            }
            Liar::SecondMaster => {
                if rng.random() {
                    self.add(rng, 2_000 * MS, Incident::GrandmasterDies);
                }
            }
            Liar::Asymmetry => self.slower_back = magnitude(rng, 10 * US, 500 * US),
        }
    }
}

impl Place {
    /// Returns its place in [`Plan::rates_ppb`].
    pub(crate) const fn number(self) -> usize {
        match self {
            Self::Grandmaster => 0,
            Self::System(system) => 2 + system,
            Self::Sensor => 4,
        }
    }
}
