//! The faults that a campaign injects. Each sequence has a number. The same number always gives the
//! same faults.

use crate::amount::just;
use crate::entry::{Fault, Way};
use crate::kind::{Kind, Scope};
use crate::sequence::{Group, Sequence};
use crate::site::Site;
use crate::values;
use tandem_board::{Duration, SystemId};

/// The number of moments of the control cycle at which a single fault can begin.
pub const PHASES: u64 = 20;
/// Time between two of these moments, µs. They divide a cycle of 10 ms into equal parts.
const PHASE_US: u64 = 10_000 / PHASES;
/// Possible times between the two faults of a pair, µs.
pub const DISTANCES: [u64; 6] = [0, 1_700, 7_300, 13_100, 41_900, 260_300];
/// For processes and emulated machines: how long a sequence continues after its longest possible
/// fault has ended, ms.
const AFTERWARDS_MS: u64 = 300;

/// Returns all faults of the numbered sequences, each with its direction: first those from which
/// random sequences are drawn, then [`Kind::FURTHER`].
fn all_faults() -> Vec<(Kind, Way)> {
    let mut faults = single_faults();
    for kind in Kind::FURTHER {
        faults.extend([(kind, Way::A), (kind, Way::B)]);
    }
    faults
}

/// Returns the faults from which random sequences and pairs are drawn.
fn single_faults() -> Vec<(Kind, Way)> {
    let mut faults = Vec::new();
    for kind in Kind::OF_ONE_SYSTEM {
        faults.extend([(kind, Way::A), (kind, Way::B)]);
        if kind.facts().scope == Scope::Wire {
            faults.push((kind, Way::Both));
        }
    }
    faults.extend(Kind::OF_BOTH.map(|kind| (kind, Way::A)));
    faults.push((Kind::Hang(just(9)), Way::Both));
    faults
}

/// Returns the faults of this system's own parts, and of its wires in both directions.
fn faults_within(system: SystemId) -> Vec<(Kind, Way)> {
    let within = |(kind, way): &(Kind, Way)| match kind.facts().scope {
        Scope::Shared => false,
        Scope::Wire => true,
        Scope::System => *way == Way::from(system),
    };
    single_faults().into_iter().filter(within).collect()
}

impl Group {
    /// All groups whose sequences have numbers.
    pub const ALL: [Self; 5] = [
        Self::Single,
        Self::Pair,
        Self::Random,
        Self::Swarm,
        Self::Values,
    ];

    /// Returns the name of the group on a command line.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Single => "single",
            Self::Pair => "pair",
            Self::Random => "random",
            Self::Swarm => "swarm",
            Self::Values => "values",
            Self::File => "file",
        }
    }

    /// Returns the group with this name, if its sequences have numbers.
    #[must_use]
    pub fn of_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|group| group.name() == name)
    }

    /// Returns the number of sequences; `None` for a file, or if every number gives a sequence.
    #[must_use]
    pub fn count(self) -> Option<u64> {
        match self {
            Self::Single => Some(all_faults().len() as u64 * PHASES),
            Self::Pair => {
                let within = SystemId::ALL.map(|system| faults_within(system).len() as u64);
                let pairs = within.map(|count| count * count).iter().sum::<u64>();
                Some(pairs * DISTANCES.len() as u64)
            }
            Self::Values => Some(values::count()),
            Self::Random | Self::Swarm | Self::File => None,
        }
    }

    /// Returns a sequence by its number.
    ///
    /// # Panics
    /// If no sequence has this number. The sequences of a file have no numbers.
    #[must_use]
    pub fn sequence(self, number: u64) -> Sequence {
        match self {
            Self::Single => single(number),
            Self::Pair => pair(number),
            Self::Random => random(number),
            Self::Swarm => swarm(number),
            Self::Values => values::sequence(number),
            Self::File => panic!("the faults of a file have no number"),
        }
    }
}

/// Returns a fault that lasts until everything is restored.
const fn lasting((kind, way): (Kind, Way), at_us: u64) -> Fault {
    Fault {
        kind,
        way,
        at: Duration::from_us(at_us),
        lasts: None,
    }
}

fn single(number: u64) -> Sequence {
    let fault = all_faults()[(number / PHASES) as usize];
    // The fault does not begin exactly at a poll, because the time between polls matters too.
    let at_us = number % PHASES * PHASE_US + 137;
    Sequence {
        group: Group::Single,
        number,
        faults: vec![lasting(fault, at_us)],
        from_power_on: false,
        span: Duration::from_ms(1_500),
        setting: None,
    }
}

fn pair(number: u64) -> Sequence {
    let distances = DISTANCES.len() as u64;
    let distance = DISTANCES[(number % distances) as usize];
    let mut index = number / distances;
    let mut of = SystemId::A;
    let of_a = (faults_within(of).len() as u64).pow(2);
    if index >= of_a {
        (of, index) = (SystemId::B, index - of_a);
    }
    let within = faults_within(of);
    let count = within.len() as u64;
    // Different pairs begin at different moments of the control cycle.
    let at_us = (number * 7_919) % 10_000;
    let first = lasting(within[(index / count) as usize], at_us);
    let second = lasting(within[(index % count) as usize], at_us + distance);
    Sequence {
        group: Group::Pair,
        number,
        faults: vec![first, second],
        from_power_on: false,
        span: Duration::from_ms(1_000),
        setting: None,
    }
}

/// The random number generator SplitMix64 (Steele, Lea, Flood: Fast Splittable Pseudorandom Number
/// Generators, 2014).
#[derive(Clone, Debug)]
pub struct Draw(u64);

impl Draw {
    /// The generator of this seed.
    #[must_use]
    pub const fn new(seed: u64) -> Self {
        Self(seed)
    }

    /// Returns a number below the limit.
    ///
    /// # Panics
    /// If the limit is 0.
    pub const fn below(&mut self, limit: u64) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut mixed = self.0;
        mixed = (mixed ^ (mixed >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        mixed = (mixed ^ (mixed >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        (mixed ^ (mixed >> 31)) % limit
    }
}

fn random(number: u64) -> Sequence {
    several(Group::Random, number, Draw(number), &single_faults())
}

/// Swarm testing (Groce, Zhang, Eide, Chen, Regehr: Swarm Testing, 2012): sequences without some
/// kinds show the faults that those kinds would mask.
fn swarm(number: u64) -> Sequence {
    let mut draw = Draw(!number);
    // On average one kind in 2, 4, 8 or 16 is used.
    let one_of = 2 << draw.below(4);
    let mut kinds = all_faults();
    let last = kinds[draw.below(kinds.len() as u64) as usize];
    kinds.retain(|kind| *kind == last || draw.below(one_of) == 0);
    several(Group::Swarm, number, draw, &kinds)
}

fn several(group: Group, number: u64, mut draw: Draw, kinds: &[(Kind, Way)]) -> Sequence {
    // Dense: many faults at the same time. Sparse: every time limit can elapse between two faults.
    let distance_us = [15_000, 60_000, 400_000][draw.below(3) as usize];
    let (mut at_us, count) = (0, 1 + draw.below(8));
    let mut faults = Vec::new();
    for _ in 0..count {
        at_us += draw.below(distance_us);
        let fault = kinds[draw.below(kinds.len() as u64) as usize];
        let lasts = match draw.below(3) {
            0 => None,
            1 => Some(Duration::from_us(200 + draw.below(30_000))),
            _ => Some(Duration::from_us(200 + draw.below(600_000))),
        };
        faults.push(Fault {
            lasts,
            ..lasting(fault, at_us)
        });
    }
    Sequence {
        group,
        number,
        faults,
        from_power_on: draw.below(5) == 0,
        span: Duration::from_us(at_us + 50_000 + draw.below(500_000)),
        setting: None,
    }
}

/// Sequences of one fault for real processes and emulated machines: drawn from a seed, or each
/// fault at each phase of the control cycle.
impl Site {
    fn kinds(self) -> Vec<Kind> {
        let mut kinds = Kind::OF_PROCESSES.to_vec();
        kinds.extend(values::of_processes());
        kinds.retain(|kind| kind.is_for(self));
        kinds
    }

    /// Returns the number of sequences in the matrix: each fault, in the master and in the
    /// standby, at each phase.
    #[must_use]
    pub fn cells(self) -> u64 {
        self.kinds().len() as u64 * 2 * PHASES
    }

    /// Returns the `number`-th sequence of this seed: one fault at time 0, in the master (here A)
    /// or in the standby.
    #[must_use]
    pub fn drawn(self, seed: u64, number: u64) -> Sequence {
        let mut draw = Draw(seed ^ number.wrapping_mul(0xD1B5_4A32_D192_ED03));
        let kinds = self.kinds();
        let kind = kinds[draw.below(kinds.len() as u64) as usize];
        // On average two of three faults hit the master, because it can fail in more ways.
        let way = if draw.below(3) < 2 { Way::A } else { Way::B };
        at_the_beginning(number, kind, way, &mut draw)
    }

    /// Returns a cell of the matrix, and the time in the control cycle at which its fault begins.
    /// Returns `None` if `number` is not below [`Site::cells`].
    #[must_use]
    pub fn cell(self, number: u64) -> Option<(Sequence, Duration)> {
        let (fault, phase) = (number / PHASES, number % PHASES);
        let kind = *self.kinds().get((fault / 2) as usize)?;
        let way = [Way::A, Way::B][(fault % 2) as usize];
        let phase = Duration::from_us(phase * PHASE_US);
        let sequence = at_the_beginning(number, kind, way, &mut Draw(number));
        Some((sequence, phase))
    }
}

fn at_the_beginning(number: u64, kind: Kind, way: Way, draw: &mut Draw) -> Sequence {
    let short_ms = 5 + draw.below(195);
    let short = Duration::from_ms(short_ms);
    let lasts = match kind {
        // The core either stays stopped until the watchdog resets it, or continues after `short`.
        Kind::CoreHangs(_) if draw.below(2) == 0 => None,
        Kind::CoreHangs(_) => Some(short),
        _ => Some(Duration::from_ms(20 + draw.below(600))),
    };
    let longest = lasts.map_or(Duration::from_ms(500), |lasts| lasts.max(short));
    Sequence {
        group: Group::File,
        number,
        faults: vec![Fault {
            lasts,
            ..lasting((kind.with_time(short_ms as i32), way), 0)
        }],
        from_power_on: false,
        span: longest + Duration::from_ms(AFTERWARDS_MS),
        setting: None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Every fault of the matrix is drawn for both systems. The same seed always gives the same
    /// faults. Each drawn fault is one that the site can suffer and a file can contain.
    #[test]
    fn drawn_sequences_repeat_and_cover_the_matrix() {
        for site in [Site::Processes, Site::Machines] {
            let mut missing: Vec<(String, Way)> = (0..site.cells())
                .step_by(PHASES as usize)
                .filter_map(|number| site.cell(number))
                .map(|(cell, _)| (cell.faults[0].kind.label(), cell.faults[0].way))
                .collect();
            for number in 0..2_000 {
                let sequence = site.drawn(977, number);
                let fault = sequence.faults[0];
                assert!(fault.kind.is_for(site), "{fault}");
                assert_eq!(site.drawn(977, number).faults, sequence.faults);
                let text = sequence.to_toml().expect("TOML");
                let read = Sequence::from_toml(&text, 0).expect("what was written can be read");
                assert_eq!(read.faults, sequence.faults, "{text}");
                missing.retain(|(label, way)| (label, way) != (&fault.kind.label(), &fault.way));
            }
            assert!(missing.is_empty(), "never drawn: {missing:?}");
            assert!(site.cell(site.cells()).is_none());
            assert_ne!(site.drawn(1, 0).faults, site.drawn(2, 0).faults);
        }
    }
}
