//! Which sequences of faults a campaign tries: each has a number.

use super::bench::{Around, Bench};
use super::fault::{Fault, Kind, Way};
use super::judge::{Row, Verdict, Violation, containment_bound, row};
use crate::timing::Time;
use std::fmt;
use std::panic::{AssertUnwindSafe, catch_unwind};
use tandem_board::{Duration, RoleLamp, SystemId};
use tandem_redundancy::Config;

/// Each sequence whose number this divides is watched for the whole time within which a system must
/// drive, even if master and standby are there earlier.
const HEALS_WHOLLY: u64 = 16;

/// The simulated machine of a sequence.
#[derive(Clone, Copy, Debug)]
pub struct Profile {
    /// Limits of the redundancy.
    pub limits: Config,
    /// How long things take.
    pub time: Time,
    /// What is around core 0.
    pub around: Around,
}

impl From<Config> for Profile {
    fn from(limits: Config) -> Self {
        Self {
            limits,
            time: Time::Ideal,
            around: Around::Core0,
        }
    }
}

impl Profile {
    /// Both systems have just been switched on.
    #[must_use]
    pub fn at_power_on(self, told: bool) -> Bench {
        let mut bench = Bench::of(self, told);
        SystemId::ALL
            .into_iter()
            .for_each(|system| bench.pair.power_on(system));
        bench
    }

    /// In dual operation, A driving.
    ///
    /// # Panics
    /// If they do not begin.
    #[must_use]
    pub fn in_dual_operation(self, told: bool) -> Bench {
        let mut bench = Bench::of(self, told);
        bench.begin();
        bench
    }
}

/// The kind of sequences.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Group {
    /// One fault at one of [`PHASES`] moments of the control cycle.
    Single,
    /// Two faults within one system, at one of [`DISTANCES`].
    Pair,
    /// Several faults in both systems, drawn from the number.
    Random,
    /// The same, but the number also draws which kinds there are at all: some sequences have many
    /// faults of few kinds.
    Swarm,
    /// The faults of a file; the number is the seed of what the machine draws.
    File,
}

/// Moments of the control cycle at which a single fault begins.
pub const PHASES: u64 = 20;
/// Time between two faults, µs.
pub const DISTANCES: [u64; 6] = [0, 1_700, 7_300, 13_100, 41_900, 260_300];

/// One sequence of faults.
#[derive(Clone, Debug)]
pub struct Sequence {
    /// Of which kind.
    pub group: Group,
    /// Which one.
    pub number: u64,
    /// The faults.
    pub faults: Vec<Fault>,
    /// Whether they begin at power-on; else in dual operation, A driving.
    pub from_power_on: bool,
    /// How long after their begin all is mended.
    pub span: Duration,
}

/// What fails in a system or on a wire, and which way: all that the group of random sequences draws
/// from, and then the further ones.
fn all_faults() -> Vec<(Kind, Way)> {
    let mut faults = single_faults();
    for kind in Kind::FURTHER {
        faults.extend(SystemId::ALL.map(|system| (kind, Way::From(system))));
    }
    faults
}

/// What random sequences and pairs draw from. Their numbers mean the same faults for ever.
fn single_faults() -> Vec<(Kind, Way)> {
    let mut faults = Vec::new();
    for kind in Kind::OF_ONE_SYSTEM {
        faults.extend(SystemId::ALL.map(|system| (kind, Way::From(system))));
        if kind.is_of_wire() {
            faults.push((kind, Way::Both));
        }
    }
    faults.extend(Kind::OF_BOTH.map(|kind| (kind, Way::From(SystemId::A))));
    faults.push((Kind::Hang(9), Way::Both));
    faults
}

/// What can fail within this system: its own parts, and both ends of what joins it to the other.
fn faults_within(system: SystemId) -> Vec<(Kind, Way)> {
    let within = |(kind, way): &(Kind, Way)| match kind {
        Kind::Poison | Kind::VehicleSilent => false,
        _ if !kind.is_of_wire() && *way == Way::Both => false,
        _ => kind.is_of_wire() || *way == Way::From(system),
    };
    single_faults().into_iter().filter(within).collect()
}

impl Group {
    /// All.
    pub const ALL: [Self; 4] = [Self::Single, Self::Pair, Self::Random, Self::Swarm];

    /// How many sequences there are; as many as one likes of the random ones.
    #[must_use]
    pub fn count(self) -> Option<u64> {
        match self {
            Self::Single => Some(all_faults().len() as u64 * PHASES),
            Self::Pair => {
                let within = SystemId::ALL.map(|system| faults_within(system).len() as u64);
                let pairs = within.map(|count| count * count).iter().sum::<u64>();
                Some(pairs * DISTANCES.len() as u64)
            }
            Self::Random | Self::Swarm | Self::File => None,
        }
    }

    /// A sequence by its number.
    ///
    /// # Panics
    /// If there is none of this number, as of all that stand in a file.
    #[must_use]
    pub fn sequence(self, number: u64) -> Sequence {
        match self {
            Self::Single => single(number),
            Self::Pair => pair(number),
            Self::Random => random(number),
            Self::Swarm => swarm(number),
            Self::File => panic!("the faults of a file have no number"),
        }
    }
}

fn single(number: u64) -> Sequence {
    let faults = all_faults();
    let (kind, way) = faults[(number / PHASES) as usize];
    // Not at a whole poll: where it lies between two polls counts too.
    let at = Duration::from_us(number % PHASES * (10_000 / PHASES) + 137);
    let fault = Fault {
        kind,
        way,
        at,
        lasts: None,
    };
    Sequence {
        group: Group::Single,
        number,
        faults: vec![fault],
        from_power_on: false,
        span: Duration::from_ms(1_500),
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
    let fault = |index: u64, at_us| {
        let (kind, way) = within[index as usize];
        Fault {
            kind,
            way,
            at: Duration::from_us(at_us),
            lasts: None,
        }
    };
    // Every pair at another moment of the control cycle.
    let at_us = (number * 7_919) % 10_000;
    Sequence {
        group: Group::Pair,
        number,
        faults: vec![
            fault(index / count, at_us),
            fault(index % count, at_us + distance),
        ],
        from_power_on: false,
        span: Duration::from_ms(1_000),
    }
}

/// Draws numbers: SplitMix64 (Steele, Lea, Flood: Fast Splittable Pseudorandom Number Generators,
/// 2014).
pub(super) struct Draw(u64);

impl Draw {
    pub(super) const fn new(seed: u64) -> Self {
        Self(seed)
    }

    pub(super) fn below(&mut self, limit: u64) -> u64 {
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

/// Swarm testing (Groce, Zhang, Eide, Chen, Regehr: Swarm Testing, 2012): a fault that others mask
/// shows where these are left out.
fn swarm(number: u64) -> Sequence {
    let mut draw = Draw(!number);
    // One of 2, 4, 8 or 16 kinds is on.
    let one_of = 2 << draw.below(4);
    let mut kinds = all_faults();
    let last = kinds[draw.below(kinds.len() as u64) as usize];
    kinds.retain(|kind| *kind == last || draw.below(one_of) == 0);
    several(Group::Swarm, number, draw, &kinds)
}

fn several(group: Group, number: u64, mut draw: Draw, kinds: &[(Kind, Way)]) -> Sequence {
    // Dense: many at a time. Sparse: every limit passes between two.
    let distance_us = [15_000, 60_000, 400_000][draw.below(3) as usize];
    let (mut at_us, count) = (0, 1 + draw.below(8));
    let mut faults = Vec::new();
    for _ in 0..count {
        at_us += draw.below(distance_us);
        let (kind, way) = kinds[draw.below(kinds.len() as u64) as usize];
        let lasts = match draw.below(3) {
            0 => None,
            1 => Some(Duration::from_us(200 + draw.below(30_000))),
            _ => Some(Duration::from_us(200 + draw.below(600_000))),
        };
        faults.push(Fault {
            kind,
            way,
            at: Duration::from_us(at_us),
            lasts,
        });
    }
    Sequence {
        group,
        number,
        faults,
        from_power_on: draw.below(5) == 0,
        span: Duration::from_us(at_us + 50_000 + draw.below(500_000)),
    }
}

impl Sequence {
    /// The longest gap that its faults may cost, and the row that says so; `None` if they are not
    /// within one system.
    #[must_use]
    pub fn bound(&self, config: &Config) -> Option<(Row, Duration)> {
        match self.group {
            Group::Single if self.faults[0].kind == Kind::VehicleSilent => None,
            Group::Single => {
                let row = row(&self.faults[0]);
                Some((row, row.bound(config)))
            }
            Group::Pair => self.bound_within_a_system(config),
            Group::Random | Group::Swarm => None,
            Group::File => self.bound_of_a_file(config),
        }
    }

    /// Of faults that are all within one system.
    fn bound_within_a_system(&self, config: &Config) -> Option<(Row, Duration)> {
        let rows = self.faults.iter().map(|fault| match fault.kind {
            Kind::Clock(permille @ ..=-2) => Row::of_refused_clock(permille),
            _ => Row::Mute,
        });
        let bounds = rows.map(|row| (row, row.bound(config).max(containment_bound(config))));
        bounds.max_by_key(|(_, bound)| *bound)
    }

    /// As of the other groups, if what they presume is so: in dual operation A drives.
    fn bound_of_a_file(&self, config: &Config) -> Option<(Row, Duration)> {
        if self.from_power_on || self.faults.iter().any(|it| it.kind == Kind::VehicleSilent) {
            return None;
        }
        // A fault that hits both systems has a bound only where a row says so.
        let has_row = |it: &Fault| {
            it.way != Way::Both
                || it.kind.is_of_wire()
                || it.kind.is_of_both()
                || matches!(it.kind, Kind::Hang(_))
        };
        if let [one] = &self.faults[..]
            && has_row(one)
        {
            let row = row(one);
            return Some((row, row.bound(config)));
        }
        let within = |system| {
            let mut faults = self.faults.iter();
            faults.all(|it| {
                it.kind != Kind::Poison && (it.kind.is_of_wire() || it.way == Way::From(system))
            })
        };
        let contained = SystemId::ALL.into_iter().any(within);
        contained.then(|| self.bound_within_a_system(config))?
    }

    /// Runs it. `told`: whether the cores' events are kept.
    #[must_use]
    pub fn run(&self, profile: impl Into<Profile>, told: bool) -> (Verdict, Bench) {
        let profile = profile.into();
        let bench = if self.from_power_on {
            profile.at_power_on(told)
        } else {
            profile.in_dual_operation(told)
        };
        self.run_from(bench)
    }

    /// Runs it on a bench that nothing has happened to since its [`Profile`] made it.
    #[must_use]
    pub fn run_from(&self, mut bench: Bench) -> (Verdict, Bench) {
        bench.pair.reseed(self.number);
        let begin = bench.pair.now();
        bench.suffer(&self.faults, self.span);
        let mended = bench.pair.now();
        bench.heal(self.number.is_multiple_of(HEALS_WHOLLY));
        let bound = self.bound(&bench.config.redundancy);
        let bound = bound.map(|(_, bound)| bound + bench.time.allowance());
        let mut verdict = bench.judge(&self.faults, [begin, mended], bound);
        let is_alone = |bench: &Bench| {
            let stands_by = |system: &SystemId| bench.pair.lamp(*system) == Some(RoleLamp::Standby);
            !SystemId::ALL.iter().any(stands_by)
        };
        if verdict.suspended == 0 && is_alone(&bench) {
            // A long hold-down may have let the other start only now, to stand by or to suspend
            // itself.
            bench.pair.run_for(bench.settles_within());
            if bench.suspended() == 0 && is_alone(&bench) {
                verdict.violations.push(Violation::NoStandby);
            }
        }
        if bound.is_some() && bench.vehicle.borrow().is_stopped() {
            verdict.violations.push(Violation::Stopped);
        }
        (verdict, bench)
    }

    /// The same with as few faults as still lead to this violation.
    #[must_use]
    pub fn shrunk(&self, profile: impl Into<Profile>, violation: Violation) -> Self {
        let profile = profile.into();
        let mut least = self.clone();
        while let Some(shorter) = (0..least.faults.len()).find_map(|index| {
            let mut shorter = least.clone();
            shorter.faults.remove(index);
            let violates = shorter.try_run(profile).violations.contains(&violation);
            (violates && !shorter.faults.is_empty()).then_some(shorter)
        }) {
            least = shorter;
        }
        least
    }

    /// The fault, without its time.
    #[must_use]
    pub fn kinds(&self) -> String {
        let kind = |fault: &Fault| format!("{:?} {:?}", fault.way, fault.kind);
        let kinds: Vec<String> = self.faults.iter().map(kind).collect();
        kinds.join(" + ")
    }

    /// Runs it; a panic is a violation.
    #[must_use]
    pub fn try_run(&self, profile: impl Into<Profile>) -> Verdict {
        let profile = profile.into();
        let run = AssertUnwindSafe(|| self.run(profile, false).0);
        catch_unwind(run).unwrap_or_else(|_| Verdict {
            violations: vec![Violation::Panic],
            ..Verdict::default()
        })
    }
}

impl fmt::Display for Sequence {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let faults: Vec<String> = self.faults.iter().map(Fault::to_string).collect();
        let from = if self.from_power_on {
            " from power-on"
        } else {
            ""
        };
        let (group, number) = (self.group, self.number);
        let span = self.span.as_ms_f64();
        let faults = faults.join("; ");
        write!(
            f,
            "{group:?} {number}{from}: {faults}; mended at {span:.1} ms"
        )
    }
}
