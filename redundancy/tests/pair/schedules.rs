//! Random schedules of faults: what must never happen during them, and must happen after. T-RED-9

use crate::model::{Pair, us};
use proptest::prelude::*;
use proptest::test_runner::RngSeed;
use tandem_board::ResetCause;
use tandem_board::SystemId::{self, A, B};
use tandem_redundancy::{Config, Phase};

#[derive(Clone, Copy, Debug)]
enum Fault {
    Beat(usize, SystemId, bool),
    Start(SystemId, bool),
    Level(SystemId, bool),
    Can(SystemId, bool),
    Link(bool),
    Reset(SystemId, ResetCause),
    PowerOff(SystemId),
    PowerOn(SystemId),
    Freeze(SystemId, u64),
}

fn any_fault() -> impl Strategy<Value = Fault> {
    let id = prop_oneof![Just(A), Just(B)];
    let cause = prop_oneof![Just(ResetCause::Watchdog), Just(ResetCause::Software)];
    prop_oneof![
        3 => (0usize..2, id.clone(), any::<bool>()).prop_map(|(l, s, c)| Fault::Beat(l, s, c)),
        1 => (id.clone(), any::<bool>()).prop_map(|(s, c)| Fault::Start(s, c)),
        2 => (id.clone(), any::<bool>()).prop_map(|(s, c)| Fault::Level(s, c)),
        3 => (id.clone(), any::<bool>()).prop_map(|(s, c)| Fault::Can(s, c)),
        1 => any::<bool>().prop_map(Fault::Link),
        2 => (id.clone(), cause).prop_map(|(s, c)| Fault::Reset(s, c)),
        1 => id.clone().prop_map(Fault::PowerOff),
        2 => id.clone().prop_map(Fault::PowerOn),
        2 => (id, 1u64..80).prop_map(|(s, ms)| Fault::Freeze(s, ms)),
    ]
}

fn inject(pair: &mut Pair, fault: Fault) {
    match fault {
        Fault::Beat(line, from, cut) => pair.cuts.beats[line][from.index()] = cut,
        Fault::Start(from, cut) => pair.cuts.start[from.index()] = cut,
        Fault::Level(from, cut) => pair.cuts.level[from.index()] = cut,
        Fault::Can(of, cut) => pair.cuts.can[of.index()] = cut,
        Fault::Link(cut) => pair.cuts.link = cut,
        Fault::Reset(id, cause) => pair.reset(id, cause),
        Fault::PowerOff(id) => pair.power_off(id),
        Fault::PowerOn(id) => pair.power_on(id),
        Fault::Freeze(id, ms) => pair.freeze_ms(id, ms),
    }
}

/// Checks that under any faults the driver does not change without a cause, a deposed master stops
/// sending, and two outputs on one bus do not stay open.
fn check_safety(pair: &Pair, faults: usize) {
    // A fault may change the driver twice: to the other system, and later back.
    assert!(
        pair.changes_of_driver() <= 2 * faults + 1,
        "{} changes",
        pair.changes_of_driver()
    );
    let bound = us(pair.config.witness_limit());
    assert!(
        pair.both_open_max_us <= bound,
        "both open for {} us",
        pair.both_open_max_us
    );
    for pair_of in pair.accepted.windows(2) {
        assert!(pair_of[0].term <= pair_of[1].term);
        assert!(pair_of[0].system == pair_of[1].system || pair_of[0].term < pair_of[1].term);
    }
    for seen in &pair.fenced {
        assert_eq!(seen.term.system(), seen.system);
    }
}

/// Removes all faults and restores power. Then only one system drives, and the vehicle obeys it
/// without gaps. The other is its standby, unless its supply holds it in reset.
fn heal_and_check(pair: &mut Pair) {
    pair.cuts = Default::default();
    pair.power_on(A);
    pair.power_on(B);
    pair.run_ms(us(pair.config.start_limit) / 1_000 + 500);
    let held = [A, B].map(|id| pair.systems[id.index()].held);
    assert_ne!(held, [true; 2], "both suspended");
    let (from, fenced) = (pair.now_us, pair.fenced.len());
    pair.run_ms(500);
    let driving = |id: &SystemId| pair.phase(*id).is_some_and(Phase::is_driving);
    let drivers: Vec<SystemId> = [A, B].into_iter().filter(driving).collect();
    assert_eq!(drivers.len(), 1, "{:?}", pair.phases());
    assert!(
        pair.longest_gap_us(from) <= 12_000,
        "gap {}",
        pair.longest_gap_us(from)
    );
    assert_eq!(pair.fenced.len(), fenced, "nobody sends into the fence");
    let other = drivers[0].peer();
    if !held[other.index()] {
        assert_eq!(pair.phase(other), Some(Phase::Standby));
    }
}

fn run(config: Config, seed: u64, faults: &[(u64, Fault)]) {
    let mut pair = Pair::dual(config, seed);
    for &(after_ms, fault) in faults {
        inject(&mut pair, fault);
        pair.run_ms(after_ms);
        check_safety(&pair, faults.len());
    }
    heal_and_check(&mut pair);
    check_safety(&pair, faults.len());
}

fn cases(cases: u32) -> ProptestConfig {
    let rng_seed = RngSeed::Fixed(0x7A4D);
    ProptestConfig {
        cases,
        rng_seed,
        failure_persistence: None,
        ..ProptestConfig::default()
    }
}

proptest! {
    #![proptest_config(cases(400))]

    /// T-RED-9: dense faults, many at the same time or shortly after each other.
    #[test]
    fn dense_faults(
        seed in 1u64..1_000, faults in prop::collection::vec((0u64..40, any_fault()), 1..30),
    ) {
        run(Config::rt(), seed, &faults);
    }

    /// T-RED-9: faults with enough time between them for every limit to pass.
    #[test]
    fn sparse_faults(
        seed in 1u64..1_000, faults in prop::collection::vec((0u64..400, any_fault()), 1..12),
    ) {
        run(Config::desktop(), seed, &faults);
    }
}
