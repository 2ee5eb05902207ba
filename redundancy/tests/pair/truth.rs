//! Every combination of cut links between two systems in dual operation. T-RED-9

use crate::model::{Pair, us};
use std::fmt::Write;
use tandem_board::SystemId::{self, A, B};
use tandem_redundancy::{Config, Phase};

const SEEDS: std::ops::Range<u64> = 1..6;

/// The connections that are cut: heartbeat line 1, line 2, power level (each in both directions),
/// CAN of A, CAN of B.
type Combination = [bool; 5];

fn combinations() -> impl Iterator<Item = Combination> {
    (0..32u8).map(|bits| [0, 1, 2, 3, 4].map(|i| bits >> i & 1 == 1))
}

fn cut(pair: &mut Pair, [beat_1, beat_2, level, can_a, can_b]: Combination) {
    pair.cuts.beats = [[beat_1; 2], [beat_2; 2]];
    pair.cuts.level = [level; 2];
    pair.cuts.can = [can_a, can_b];
}

fn phase_name(pair: &Pair, id: SystemId) -> &'static str {
    match pair.phase(id) {
        _ if pair.systems[id.index()].held => "suspended",
        Some(Phase::Master) => "master",
        Some(Phase::DegradedMaster) => "degraded master",
        Some(Phase::Standby) => "standby",
        Some(_) => "starting",
        None => "off",
    }
}

/// Returns the system that the vehicle obeyed in the last 20 ms.
fn obeyed(pair: &Pair) -> Option<SystemId> {
    let last = pair.accepted.last()?;
    (pair.now_us - last.at_us <= 20_000).then_some(last.system)
}

/// The result of a run of one combination.
struct Outcome {
    phases: [&'static str; 2],
    obeyed: Option<SystemId>,
    gap_us: u64,
    /// The system that the vehicle obeys, and the gap, if A (or B) loses its supply 100 ms after
    /// the cut, before any system suspends.
    then_off: [(Option<SystemId>, u64); 2],
}

fn run(config: Config, combination: Combination, seed: u64) -> Outcome {
    let mut pair = Pair::dual(config, seed);
    pair.run_ms(seed * 3);
    let from = pair.now_us;
    cut(&mut pair, combination);
    pair.run_ms(2_000);
    check_never_two(&pair, combination);
    let phases = [A, B].map(|id| phase_name(&pair, id));
    let then_off = [A, B].map(|id| {
        let mut pair = Pair::dual(config, seed);
        pair.run_ms(seed * 3);
        cut(&mut pair, combination);
        pair.run_ms(100);
        let from = pair.now_us;
        pair.power_off(id);
        pair.run_ms(500);
        check_never_two(&pair, combination);
        (obeyed(&pair), pair.longest_gap_us(from))
    });
    Outcome {
        phases,
        obeyed: obeyed(&pair),
        gap_us: pair.longest_gap_us(from),
        then_off,
    }
}

fn check_never_two(pair: &Pair, combination: Combination) {
    assert!(pair.changes_of_driver() <= 1, "{combination:?}");
    assert!(pair.fenced.is_empty(), "{combination:?}: {:?}", pair.fenced);
    assert_eq!(pair.both_open_max_us, 0, "{combination:?}");
}

/// T-RED-9: with any links cut, frames of two masters are never on the bus. If a healthy system is
/// connected, the vehicle obeys it within the bound. If the driving system then loses its supply,
/// the other one, if connected, takes over within the bound.
#[test]
fn every_combination_of_cut_links() {
    for config in [Config::rt(), Config::desktop()] {
        let bus = 1_500;
        // The bus delays the echo that reports a mute master, and the new master's first frame.
        let two_frames = 2 * bus;
        for combination in combinations() {
            let [.., can_a, can_b] = combination;
            for seed in SEEDS {
                let outcome = run(config, combination, seed);
                let expected = match (can_a, can_b) {
                    (false, _) => Some(A),
                    (true, false) => Some(B),
                    (true, true) => None,
                };
                assert_eq!(outcome.obeyed, expected, "{combination:?}");
                let bound = if can_a {
                    config.gap_bound_mute()
                } else {
                    config.control_period
                };
                assert!(
                    expected.is_none() || outcome.gap_us <= us(bound) + two_frames,
                    "{combination:?}: {}",
                    outcome.gap_us
                );
                let [after_a, after_b] = outcome.then_off;
                assert_eq!(
                    after_a.0,
                    (!can_b).then_some(B),
                    "{combination:?}, then A off"
                );
                assert_eq!(
                    after_b.0,
                    (!can_a).then_some(A),
                    "{combination:?}, then B off"
                );
                let bound = us(config.gap_bound()) + bus;
                assert!(
                    can_b || after_a.1 <= bound,
                    "{combination:?}: {}",
                    after_a.1
                );
                assert!(
                    can_a || after_b.1 <= bound,
                    "{combination:?}: {}",
                    after_b.1
                );
            }
        }
    }
}

/// T-RED-9: the same with the link between the systems cut too, because no protection against two
/// masters depends on the link.
#[test]
fn every_combination_without_the_link() {
    for combination in combinations() {
        let mut pair = Pair::dual(Config::rt(), 3);
        pair.cuts.link = true;
        cut(&mut pair, combination);
        pair.run_ms(1_000);
        check_never_two(&pair, combination);
        let healed = pair.now_us;
        pair.cuts = Default::default();
        pair.run_ms(500);
        assert!(
            pair.both_open_max_us <= us(pair.config.witness_limit()),
            "{combination:?}"
        );
        assert!(pair.changes_of_driver() <= 2, "{combination:?}");
        assert!(obeyed(&pair).is_some(), "{combination:?}");
        let fenced = pair
            .fenced
            .iter()
            .filter(|seen| seen.at_us > healed)
            .count();
        assert!(fenced <= 2, "{combination:?}: {fenced} frames fenced");
    }
}

/// Returns the table for the docs, profile rt.
pub(crate) fn table() -> String {
    let mut text = String::from(
        "| hb 1 | hb 2 | level | CAN A | CAN B | A after 2 s | B after 2 s | vehicle obeys | gap ms \
         | A loses power: obeys, gap ms | B loses power: obeys, gap ms |\n\
         |---|---|---|---|---|---|---|---|---|---|---|\n",
    );
    let whom = |id: Option<SystemId>| id.map_or("nobody".into(), |id| id.to_string());
    let ms = |us: u64| us.div_ceil(1_000);
    for combination in combinations() {
        let runs: Vec<Outcome> = SEEDS
            .map(|seed| run(Config::rt(), combination, seed))
            .collect();
        let first = &runs[0];
        for run in &runs {
            assert_eq!(
                (run.phases, run.obeyed),
                (first.phases, first.obeyed),
                "{combination:?}"
            );
        }
        for is_cut in combination {
            write!(text, "| {} ", if is_cut { "cut" } else { " · " }).unwrap();
        }
        let gap = |of: fn(&Outcome) -> u64| ms(runs.iter().map(of).max().unwrap_or(0));
        write!(
            text,
            "| {} | {} | {} ",
            first.phases[0],
            first.phases[1],
            whom(first.obeyed)
        )
        .unwrap();
        let cell = |id, gap: u64| match id {
            None => String::from("nobody"),
            some => format!("{}, {gap}", whom(some)),
        };
        let gap_text = if first.obeyed.is_some() {
            gap(|run| run.gap_us).to_string()
        } else {
            "–".into()
        };
        let after_a = cell(first.then_off[0].0, gap(|run| run.then_off[0].1));
        let after_b = cell(first.then_off[1].0, gap(|run| run.then_off[1].1));
        writeln!(text, "| {gap_text} | {after_a} | {after_b} |").unwrap();
    }
    text
}
