//! Explores all states that two systems reach with lossy wires and a bounded number of faults:
//! breadth first, by Stateright, in steps of one millisecond of virtual time. The systems run the
//! product's code. T-RED-9

use crate::forged::{Word, forge};
use crate::model::{Pair, Seen};
use stateright::{Checker as _, HasDiscoveries, Model, Property};
use std::fmt::{self, Write as _};
use std::hash::{DefaultHasher, Hash, Hasher};
use tandem_board::ResetCause;
use tandem_board::SystemId::{self, A, B};
use tandem_redundancy::{Config, Phase, Role};

/// A fault that can happen in any millisecond. The first five kinds last for that millisecond:
/// everything that is sent in this time is lost.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Fault {
    Beats(SystemId),
    Link,
    CanSend(SystemId),
    CanHear(SystemId),
    LevelLow(SystemId),
    PowerOff(SystemId),
    Reset(SystemId),
    /// Longer than the lease, shorter than the watchdog's window.
    Freeze(SystemId),
    /// This system hears one word with a right protection and a wrong term.
    Forged(SystemId, Word, Wrong),
}

/// How a forged term is wrong.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Wrong {
    /// One mastership above the one that the vehicle obeys.
    Near,
    Far,
    /// No term at all.
    Ones,
}

const FREEZE_MS: u64 = 12;

fn faults() -> impl Iterator<Item = Fault> {
    let of_each = [
        Fault::Beats,
        Fault::CanSend,
        Fault::CanHear,
        Fault::LevelLow,
        Fault::PowerOff,
        Fault::Reset,
        Fault::Freeze,
    ];
    let of = move |id: SystemId| of_each.into_iter().map(move |fault| fault(id));
    of(A).chain(of(B)).chain([Fault::Link])
}

/// One forged word in each form, heard by either system.
fn forged() -> impl Iterator<Item = Fault> {
    let words = [
        Word::Control,
        Word::Stale,
        Word::Status(Role::Master),
        Word::Status(Role::Standby),
        Word::Link(Role::Master),
        Word::Echo(0),
        Word::Echo(900),
    ];
    let terms = [Wrong::Near, Wrong::Far, Wrong::Ones];
    let of = move |id: SystemId| {
        let pairs = words
            .into_iter()
            .flat_map(move |word| terms.map(|term| (word, term)));
        pairs.map(move |(word, term)| Fault::Forged(id, word, term))
    };
    of(A).chain(of(B))
}

impl Fault {
    fn begin(self, pair: &mut Pair) {
        match self {
            Self::Beats(from) => {
                (
                    pair.cuts.beats[0][from.index()],
                    pair.cuts.beats[1][from.index()],
                ) = (true, true);
            }
            Self::Link => pair.cuts.link = true,
            Self::CanSend(of) => pair.cuts.can_send[of.index()] = true,
            Self::CanHear(of) => pair.cuts.can_hear[of.index()] = true,
            Self::LevelLow(of) => pair.level_stuck_low[of.index()] = true,
            Self::PowerOff(id) => pair.power_off(id),
            Self::Reset(id) => pair.reset(id, ResetCause::Watchdog),
            Self::Freeze(id) => pair.freeze_ms(id, FREEZE_MS),
            Self::Forged(to, word, wrong) => {
                let obeyed = pair.accepted.last().unwrap().term.bits();
                let bits = match wrong {
                    Wrong::Near => obeyed + 2,
                    Wrong::Far => 1_000_000,
                    Wrong::Ones => u32::MAX,
                };
                forge(pair, to, word, bits);
            }
        }
    }

    fn end(pair: &mut Pair) {
        pair.cuts = Default::default();
        pair.level_stuck_low = [false; 2];
    }
}

/// Two systems at the end of a millisecond.
#[derive(Clone)]
struct Reached {
    pair: Pair,
    ms: u64,
    /// The number of faults so far. It is part of the state, because it limits the faults that may
    /// follow.
    faults: usize,
    shown: Shown,
    /// A digest of all fields above: two states with the same digest count as one.
    digest: u64,
}

/// The properties observed in the last millisecond, or at the end of the healing.
#[derive(Clone, Copy, Debug, Default)]
struct Shown {
    two_terms_act: bool,
    /// Both outputs were open for longer than the bound.
    two_outputs_stay_open: bool,
    both_suspended: bool,
    healed: bool,
}

impl Reached {
    fn new(mut pair: Pair, ms: u64, faults: usize, healed: bool) -> Self {
        let follows = |two: &[Seen]| {
            let rises = two[0].term < two[1].term;
            let stays = two[0].term == two[1].term && two[0].system == two[1].system;
            rises || stays
        };
        // Each further fault can hide one more frame of the new master from the old one.
        let config = &pair.config;
        let further = faults.saturating_sub(1) as u32;
        let bound = config.witness_limit() + config.control_period.times(further);
        let shown = Shown {
            two_terms_act: !pair.accepted.windows(2).all(follows),
            two_outputs_stay_open: pair.both_open_max_us > bound.as_us(),
            both_suspended: pair.systems.iter().all(|system| system.held),
            healed,
        };
        pair.forget();
        let mut digest = Digest(DefaultHasher::new());
        write!(digest, "{ms} {faults} {shown:?} {pair:?}").unwrap();
        Self {
            pair,
            ms,
            faults,
            shown,
            digest: digest.0.finish(),
        }
    }
}

/// Prints the end of a counterexample; its faults are printed before it.
impl fmt::Debug for Reached {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:?}, {:?}", self.pair.phases(), self.shown)
    }
}

impl PartialEq for Reached {
    fn eq(&self, other: &Self) -> bool {
        self.digest == other.digest
    }
}

impl Hash for Reached {
    fn hash<H: Hasher>(&self, state: &mut H) {
        state.write_u64(self.digest);
    }
}

/// Hashes what is written to it.
struct Digest(DefaultHasher);

impl fmt::Write for Digest {
    fn write_str(&mut self, text: &str) -> fmt::Result {
        self.0.write(text.as_bytes());
        Ok(())
    }
}

/// Dual operation with at most `most` faults in the first `window_ms`, then `after_ms` without
/// faults, then healing.
struct Faults {
    config: Config,
    kinds: Vec<Fault>,
    window_ms: u64,
    most: usize,
    after_ms: u64,
}

/// Restores power. Returns whether the vehicle obeys one system, and the other is its standby.
fn heal(pair: &mut Pair) -> bool {
    for id in [A, B] {
        pair.power_on(id);
    }
    pair.run_ms(pair.config.start_limit.as_us() / 1_000 + 500);
    let from = pair.now_us;
    pair.run_ms(100);
    let phases = pair.phases();
    let driving = phases.into_iter().flatten().filter(|it| it.is_driving());
    pair.longest_gap_us(from) <= 12_000
        && driving.count() == 1
        && phases.contains(&Some(Phase::Standby))
}

impl Model for Faults {
    type State = Reached;
    /// The millisecond, and the fault in it, if any.
    type Action = (u64, Option<Fault>);

    fn init_states(&self) -> Vec<Reached> {
        let mut pair = Pair::dual(self.config, 5);
        pair.forget();
        vec![Reached::new(pair, 0, 0, false)]
    }

    fn actions(&self, state: &Reached, actions: &mut Vec<Self::Action>) {
        if state.ms < self.window_ms && state.faults < self.most {
            actions.extend(self.kinds.iter().map(|fault| (state.ms, Some(*fault))));
        }
        if state.ms <= self.window_ms + self.after_ms {
            actions.push((state.ms, None));
        }
    }

    fn next_state(&self, state: &Reached, (ms, fault): Self::Action) -> Option<Reached> {
        let mut pair = state.pair.clone();
        if let Some(fault) = fault {
            fault.begin(&mut pair);
        }
        let mut healed = false;
        if ms < self.window_ms + self.after_ms {
            pair.run_ms(1);
        } else {
            healed = heal(&mut pair);
        }
        Fault::end(&mut pair);
        let faults = state.faults + usize::from(fault.is_some());
        Some(Reached::new(pair, ms + 1, faults, healed))
    }

    fn properties(&self) -> Vec<Property<Self>> {
        vec![
            Property::<Self>::always("one accepted term acts", |_, it| !it.shown.two_terms_act),
            Property::<Self>::always("both outputs are open no longer than the bound", |_, it| {
                !it.shown.two_outputs_stay_open
            }),
            Property::<Self>::always("not both are suspended", |_, it| !it.shown.both_suspended),
            Property::<Self>::eventually("healed: one drives, one stands by", |_, it| {
                it.shown.healed
            }),
            // Without a takeover the exploration would test nothing. A forged word causes it, too.
            Property::<Self>::sometimes("B takes over", |_, it| {
                it.pair.phase(B).is_some_and(Phase::is_driving)
            }),
        ]
    }
}

/// T-RED-9: every state that one fault at any time in two control periods reaches is safe.
/// `TANDEM_EXPLORE=2` explores two faults within one control period, which takes half a minute.
#[test]
fn every_state_of_bounded_faults_is_safe_and_leads_to_a_driver() {
    let wanted = std::env::var("TANDEM_EXPLORE").ok();
    let most = wanted.map_or(1, |count| count.parse().unwrap());
    explore(&faults().collect::<Vec<_>>(), most);
}

/// T-RED-9: every state that one forged word at any time in two control periods reaches is safe.
/// `TANDEM_EXPLORE=2` adds another fault.
#[test]
fn every_state_of_a_forged_word_is_safe_and_leads_to_a_driver() {
    if std::env::var("TANDEM_EXPLORE").is_ok() {
        explore(&forged().chain(faults()).collect::<Vec<_>>(), 2);
    } else {
        explore(&forged().collect::<Vec<_>>(), 1);
    }
}

#[expect(clippy::print_stdout, reason = "shows what was explored")]
fn explore(kinds: &[Fault], most: usize) {
    let (window_ms, after_ms) = (20 / most as u64, 30);
    for (name, config) in [("chip", Config::chip()), ("rt", Config::rt())] {
        let short = Config {
            start_limit: tandem_board::Duration::from_ms(300),
            ..config
        };
        let model = Faults {
            config: short,
            kinds: kinds.to_vec(),
            window_ms,
            most,
            after_ms,
        };
        let threads = std::thread::available_parallelism().unwrap();
        let checker = model.checker().threads(threads.get());
        let checker = checker.finish_when(HasDiscoveries::AnyFailures);
        let checker = checker.spawn_bfs().join();
        println!(
            "{name}, {most} of {} faults in {window_ms} ms: {} states, reached on {} ways, depth {} ms \
             and the time of healing",
            kinds.len(),
            checker.unique_state_count(),
            checker.state_count(),
            checker.max_depth() - 2,
        );
        for property in checker.model().properties() {
            println!("    {:?}: {}", property.expectation, property.name);
        }
        checker.assert_properties();
    }
}
