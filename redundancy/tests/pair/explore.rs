//! Explores all states that two systems reach with lossy wires and a bounded number of faults:
//! breadth first, a layer each millisecond of virtual time. The systems are the real code.
//! T-RED-9

use crate::model::Pair;
use std::collections::HashMap;
use std::fmt::{self, Write as _};
use std::hash::{DefaultHasher, Hasher as _};
use tandem_board::ResetCause;
use tandem_board::SystemId::{self, A, B};
use tandem_redundancy::{Config, Phase};

/// A fault that can happen in any millisecond. The first five last for that millisecond: what is
/// sent in it is lost.
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
        }
    }

    fn end(pair: &mut Pair) {
        pair.cuts = Default::default();
        pair.level_stuck_low = [false; 2];
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

/// What was explored.
#[derive(Debug, Default)]
struct Explored {
    states: usize,
    /// How often a state was reached on one more way.
    merged: usize,
    leaves: usize,
}

/// A state with the faults that led to it, for the story of a violation.
struct Reached {
    pair: Pair,
    faults: Vec<(u64, Fault)>,
}

/// In each millisecond of this state: at most one term acts, and not both outputs stay open.
fn check_safety(pair: &Pair, story: &[(u64, Fault)]) {
    for two in pair.accepted.windows(2) {
        let rises = two[0].term < two[1].term;
        let stays = two[0].term == two[1].term && two[0].system == two[1].system;
        assert!(rises || stays, "{two:?}: {story:?}");
    }
    // Each further fault can hide one more frame of the new master from the old one.
    let config = &pair.config;
    let further = story.len().saturating_sub(1) as u32;
    let bound = config.witness_limit() + config.control_period.times(further);
    let open_us = pair.both_open_max_us;
    assert!(open_us <= bound.as_us(), "{open_us} us: {story:?}");
    let held = [A, B].map(|id| pair.systems[id.index()].held);
    assert!(held != [true; 2], "both suspended: {story:?}");
}

/// With power again, the vehicle obeys one system, and the other is its standby.
fn check_liveness(mut pair: Pair, story: &[(u64, Fault)]) {
    for id in [A, B] {
        pair.power_on(id);
    }
    pair.run_ms(pair.config.start_limit.as_us() / 1_000 + 500);
    check_safety(&pair, story);
    pair.forget();
    let from = pair.now_us;
    pair.run_ms(100);
    let gap = pair.longest_gap_us(from);
    assert!(gap <= 12_000, "gap {gap} us: {story:?}");
    let phases = pair.phases();
    let driving = |phase: &&Option<Phase>| phase.is_some_and(Phase::is_driving);
    assert_eq!(
        phases.iter().filter(driving).count(),
        1,
        "{phases:?}: {story:?}"
    );
    assert!(
        phases.contains(&Some(Phase::Standby)),
        "{phases:?}: {story:?}"
    );
}

/// Explores dual operation: faults in the first `window_ms`, at most `most` of them, and then
/// `after_ms` without.
fn explore(config: Config, window_ms: u64, most: usize, after_ms: u64) -> Explored {
    let mut start = Pair::dual(config, 5);
    start.forget();
    let mut explored = Explored::default();
    let faults_left = |reached: &Reached| most - reached.faults.len();
    let mut layer = vec![Reached {
        pair: start,
        faults: vec![],
    }];
    for ms in 0..window_ms + after_ms {
        // The more faults are left, the more may follow: two states are one only with as many.
        let mut next: HashMap<(u64, usize), Reached> = HashMap::new();
        for reached in layer {
            let choices = faults().filter(|_| ms < window_ms && faults_left(&reached) > 0);
            for choice in choices.map(Some).chain([None]) {
                let mut pair = reached.pair.clone();
                let mut story = reached.faults.clone();
                if let Some(fault) = choice {
                    story.push((ms, fault));
                    fault.begin(&mut pair);
                }
                pair.run_ms(1);
                check_safety(&pair, &story);
                Fault::end(&mut pair);
                pair.forget();
                let mut digest = Digest(DefaultHasher::new());
                write!(digest, "{pair:?}").unwrap();
                let reached = Reached {
                    pair,
                    faults: story,
                };
                let key = (digest.0.finish(), faults_left(&reached));
                explored.merged += usize::from(next.insert(key, reached).is_some());
            }
        }
        explored.states += next.len();
        layer = next.into_values().collect();
    }
    explored.leaves = layer.len();
    for Reached { pair, faults } in layer {
        check_liveness(pair, &faults);
    }
    explored
}

/// T-RED-9: every state that one fault reaches, whenever in two control periods it happens.
/// `TANDEM_EXPLORE=2` explores two faults within one control period, which takes minutes.
#[test]
fn every_state_of_bounded_faults_is_safe_and_leads_to_a_driver() {
    let wanted = std::env::var("TANDEM_EXPLORE").ok();
    let most = wanted.map_or(1, |count| count.parse().unwrap());
    let (window_ms, after_ms) = (20 / most as u64, 30);
    for (name, config) in [("chip", Config::chip()), ("rt", Config::rt())] {
        let short = Config {
            start_limit: tandem_board::Duration::from_ms(300),
            ..config
        };
        let explored = explore(short, window_ms, most, after_ms);
        println!(
            "{name}, {most} of {} faults in {window_ms} ms: {explored:?}, depth {} ms; at most one \
             accepted term acts, never both suspended; at the end one drives and one stands by",
            faults().count(),
            window_ms + after_ms,
        );
    }
}
