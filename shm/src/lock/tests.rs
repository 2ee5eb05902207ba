//! Tests the lock with deaths and freezes at every access, with stragglers, and with garbage.

use super::*;
use crate::fault::{freeze_at, kill_at, zeroed};
use crate::sync::spin;
use proptest::prelude::*;
use proptest_state_machine::{ReferenceStateMachine, StateMachineTest, prop_state_machine};
use std::vec::Vec;

#[derive(Clone, Copy)]
struct Bench {
    words: &'static [AtomicU32],
    incarnations: Incarnations<'static>,
}

impl Bench {
    fn new() -> Self {
        Self {
            words: zeroed(WORDS),
            incarnations: Incarnations::attach(zeroed(Incarnations::WORDS)).unwrap(),
        }
    }

    /// Announces a new incarnation of a core and attaches it to the lock.
    fn start(&self, core: usize, generation: u32) -> Lock<'static> {
        let incarnation = Incarnation::new(core, generation).unwrap();
        self.incarnations.announce(incarnation).unwrap();
        Lock::attach(self.words, incarnation, self.incarnations).unwrap()
    }

    fn kill(&self, core: usize, generation: u32) {
        assert!(
            self.incarnations
                .mark_dead(Incarnation::new(core, generation).unwrap())
        );
    }

    fn token(&self) -> &'static AtomicU32 {
        &self.words[TOKEN_AT]
    }
}

/// T-LOCK-1: of three cores, one at a time owns the lock.
#[test]
fn the_lock_is_taken_once() {
    let bench = Bench::new();
    let [mut a, mut b, mut c] = [0, 1, 2].map(|core| bench.start(core, 1));
    for _ in 0..3 {
        let guard = a.try_lock().unwrap();
        assert!(!guard.is_recovered());
        assert!(b.try_lock().is_none());
        assert_eq!(c.lock(5, |_| ()).unwrap_err(), LockTimedOut);
        drop(guard);
        assert!(b.lock(1, |_| ()).is_ok());
        assert!(c.try_lock().is_some());
    }
}

/// After a release the next waiting core has its turn. A living core that does not wait has no
/// turn.
#[test]
fn a_core_that_does_not_wait_has_no_turn() {
    for (waiting, takes) in [([0, 0], true), ([0, 1], false)] {
        let bench = Bench::new();
        let [mut a, _b, mut c] = [0, 1, 2].map(|core| bench.start(core, 1));
        drop(a.try_lock());
        for core in waiting {
            bench.token().fetch_or(waiting_bit(core), Ordering::Relaxed);
        }
        assert_eq!(c.try_lock().is_some(), takes, "{waiting:?} wait");
    }
}

#[test]
fn a_detached_guard_holds_the_lock_until_it_is_dropped() {
    let bench = Bench::new();
    let [mut a, mut b] = [0, 1].map(|core| bench.start(core, 1));
    for _ in 0..3 {
        let held = a.try_lock().unwrap().into_guard().detach();
        assert!(b.try_lock().is_none());
        assert!(a.try_lock().is_none(), "not a second time by the same end");
        drop(held);
        assert!(b.try_lock().is_some());
    }
    let _lost = a.try_lock().unwrap().into_guard().detach();
    bench.kill(0, 1);
    assert!(b.try_lock().unwrap().is_recovered());
}

/// Two tasks of one core exclude each other as two cores do.
#[test]
fn two_ends_of_one_incarnation_exclude_each_other() {
    let bench = Bench::new();
    let [mut one, mut two] = [bench.start(0, 1), bench.start(0, 1)];
    let guard = one.try_lock().unwrap();
    assert!(two.try_lock().is_none());
    drop(guard);
    let guard = two.try_lock().unwrap();
    assert!(one.try_lock().is_none());
    drop(guard);
    assert!(one.try_lock().is_some());
}

/// T-LOCK-3: if the owner dies, the next owner gets `Recovered`. If that owner also dies before it
/// has repaired the data, its successor gets `Recovered` too.
#[test]
fn a_dead_owner_is_replaced_and_the_next_owner_learns_of_it() {
    let bench = Bench::new();
    let [mut a, mut b, mut c] = [0, 1, 2].map(|core| bench.start(core, 1));
    core::mem::forget(a.try_lock().unwrap());
    assert!(b.try_lock().is_none(), "no core has marked it dead");
    bench.kill(0, 1);
    let guard = b.try_lock().unwrap();
    assert!(guard.is_recovered());
    core::mem::forget(guard);
    bench.start(1, 2);
    assert!(
        c.try_lock().unwrap().is_recovered(),
        "a new incarnation of the owner's core is enough"
    );
    assert!(!c.try_lock().unwrap().is_recovered());
    assert!(!bench.start(0, 2).try_lock().unwrap().is_recovered());
}

#[test]
fn a_death_after_the_release_is_no_recovery() {
    let bench = Bench::new();
    drop(bench.start(0, 1).try_lock());
    bench.kill(0, 1);
    assert!(!bench.start(1, 1).try_lock().unwrap().is_recovered());
}

/// If an incarnation attaches after its successor, or is frozen at any step of its attachment while
/// the successor attaches, the successor keeps the lock that it holds. T-LOCK-3
#[test]
fn a_incarnation_that_attaches_late_opens_no_lock() {
    for at in 0.. {
        let bench = Bench::new();
        let late = Incarnation::new(0, 1).unwrap();
        bench.incarnations.announce(late).unwrap();
        let meanwhile = move || {
            let mut successor = bench.start(0, 2);
            core::mem::forget(successor.try_lock().unwrap());
        };
        let attach = || Lock::attach(bench.words, late, bench.incarnations);
        let (_, hit) = freeze_at(at, meanwhile, attach);
        if !hit {
            meanwhile();
            let _ = attach();
        }
        assert!(bench.start(1, 1).try_lock().is_none(), "frozen at {at}");
        if !hit {
            break;
        }
    }
}

/// The waiting bit of a killed core delays no other core, even before its successor attaches.
#[test]
fn the_bit_of_a_dead_waiter_does_not_count_as_its_successors() {
    let bench = Bench::new();
    let (mut one, _two, mut three) = (bench.start(0, 1), bench.start(1, 1), bench.start(2, 1));
    drop(one.try_lock());
    one.token().fetch_or(waiting_bit(1), Ordering::Relaxed);
    assert!(three.try_lock().is_none(), "core 1 waits");
    bench
        .incarnations
        .announce(Incarnation::new(1, 2).unwrap())
        .unwrap();
    assert!(three.try_lock().is_some(), "its successor does not");
}

/// If an owner releases the lock and then dies, while another core is frozen at any step of its
/// attempt, the lock is not reported as recovered.
#[test]
fn a_release_before_the_death_is_no_recovery_for_a_waiter_frozen_at_every_step() {
    for at in 0.. {
        let bench = Bench::new();
        let [mut a, mut b] = [0, 1].map(|core| bench.start(core, 1));
        let held = a.try_lock().unwrap().into_guard().detach();
        let incarnations = bench.incarnations;
        let meanwhile = move || {
            drop(held);
            assert!(incarnations.mark_dead(Incarnation::new(0, 1).unwrap()));
        };
        let (recovered, hit) = freeze_at(at, meanwhile, || {
            b.lock(2, |_| ())
                .ok()
                .map(|acquired| acquired.is_recovered())
        });
        if !hit {
            break;
        }
        assert_ne!(recovered, Some(true), "frozen at {at}");
    }
}

/// T-LOCK-3: a dead owner counts as dead even if a later generation has the same bits in the token,
/// whether or not the incarnations between them attach to the lock.
#[test]
fn a_dead_owner_is_replaced_after_any_number_of_incarnations() {
    let all = [16, 1, 3, 4, 15, 17, 32, 64];
    for &incarnations in &all[..if cfg!(miri) { 2 } else { all.len() }] {
        for attach_from in [2, incarnations, incarnations + 1, incarnations + 2] {
            let bench = Bench::new();
            let [mut a, mut b] = [0, 1].map(|core| bench.start(core, 1));
            core::mem::forget(a.try_lock().unwrap());
            for generation in 2..incarnations + 2 {
                if generation >= attach_from {
                    bench.start(0, generation);
                } else {
                    let incarnation = Incarnation::new(0, generation).unwrap();
                    bench.incarnations.announce(incarnation).unwrap();
                }
            }
            let recovered = b.try_lock().map(|acquired| acquired.is_recovered());
            assert_eq!(
                recovered,
                Some(true),
                "{incarnations} incarnations, {attach_from}"
            );
        }
    }
}

/// An incarnation that attaches clears its predecessors' waiting bit, and marks a token with its
/// own bits as an orphan if it is not released. The turn and the other bits do not change.
#[test]
fn an_incarnation_disowns_what_its_predecessors_left_and_no_more() {
    for first in 1..=16 {
        for (later, is_released) in [(1, false), (16, false), (16, true), (32, false)] {
            let bench = Bench::new();
            let [_, _, mut a] = [1, 2, 0].map(|core| bench.start(core, first));
            drop(a.try_lock());
            let held = a.try_lock().unwrap().into_guard().detach();
            match is_released {
                true => drop(held),
                false => core::mem::forget(held),
            }
            let others = waiting_bit(1) | waiting_bit(2);
            let token = bench.token().load(Ordering::Relaxed) | others;
            bench
                .token()
                .store(token | waiting_bit(0), Ordering::Relaxed);
            bench.start(0, first + later);
            let expected = match (later, is_released) {
                (1, _) | (_, true) => token,
                _ => token & !CORE_MASK | ORPHAN,
            };
            let left = bench.token().load(Ordering::Relaxed);
            assert_eq!(left, expected, "{first} and {later} later, {is_released}");
        }
    }
}

/// T-LOCK-3: if the owner is killed at any step, the next core gets the lock.
#[test]
fn an_owner_killed_at_every_step_leaves_a_lock_to_be_had() {
    for at in 0.. {
        let bench = Bench::new();
        let [mut a, mut b] = [0, 1].map(|core| bench.start(core, 1));
        drop(b.try_lock());
        let held = core::cell::Cell::new(false);
        let done = kill_at(at, || {
            let guard = a.lock(3, |_| ()).unwrap();
            held.set(true);
            drop(guard);
        });
        bench.kill(0, 1);
        let acquired = b.lock(1, |_| ()).unwrap();
        if held.get() {
            assert_eq!(acquired.is_recovered(), done.is_none(), "killed at {at}");
        }
        drop(acquired);
        assert!(!bench.start(0, 2).lock(1, |_| ()).unwrap().is_recovered());
        if done.is_some() {
            break;
        }
    }
}

/// If a waiting core is killed at any step, other cores still get the lock.
#[test]
fn a_waiter_killed_at_every_step_keeps_no_other_out() {
    for at in 0.. {
        let bench = Bench::new();
        let [mut a, mut b, mut c] = [0, 1, 2].map(|core| bench.start(core, 1));
        let guard = a.try_lock().unwrap();
        let done = kill_at(at, || {
            assert_eq!(b.lock(3, |_| ()).unwrap_err(), LockTimedOut)
        });
        drop(guard);
        // Before the death is marked, C waits until its patience ends.
        assert!(c.lock(PATIENCE + 1, |_| ()).is_ok(), "killed at {at}");
        assert!(a.try_lock().is_some());
        assert!(c.try_lock().is_some(), "its bit is struck");
        if done.is_some() {
            break;
        }
    }
    let bench = Bench::new();
    let [mut a, _b, mut c] = [0, 1, 2].map(|core| bench.start(core, 1));
    drop(a.try_lock());
    bench.token().fetch_or(waiting_bit(1), Ordering::Relaxed);
    assert!(c.try_lock().is_none(), "it is its turn");
    bench.kill(1, 1);
    assert!(c.try_lock().is_some(), "the dead have no turn");
    bench.token().fetch_or(waiting_bit(1), Ordering::Relaxed);
    bench.start(1, 2);
    assert!(
        c.try_lock().is_some(),
        "and a successor waits only after it sets its bit"
    );
}

/// A straggler is frozen at any step of its critical section, declared dead, and thawed after
/// successors have used the lock. It cannot release the lock of another core.
#[test]
fn a_straggler_releases_no_other_cores_lock() {
    for incarnations in 1..RELEASED_LIVES as u32 {
        for at in 0..4 {
            let bench = Bench::new();
            let mut old = bench.start(0, 1);
            let mut other = bench.start(1, 1);
            let words = bench.words;
            let meanwhile = move || {
                for generation in 2..=1 + incarnations {
                    drop(
                        Bench {
                            words,
                            incarnations: bench.incarnations,
                        }
                        .start(0, generation)
                        .try_lock(),
                    );
                }
                let mut new = Bench {
                    words,
                    incarnations: bench.incarnations,
                }
                .start(0, 1 + incarnations);
                core::mem::forget(new.lock(PATIENCE + 2, |_| ()).unwrap());
            };
            let (_, hit) = freeze_at(at, meanwhile, || drop(old.try_lock()));
            if hit {
                assert!(
                    other.try_lock().is_none(),
                    "{incarnations} incarnations later, frozen at {at}"
                );
            }
        }
    }
}

/// T-LOCK-3: starvation is bounded. Turns rotate; others go before a waiting core at most twice.
#[test]
fn the_lock_goes_round_among_waiting_cores() {
    let bench = Bench::new();
    let mut cores = [0, 1, 2].map(|core| bench.start(core, 1));
    drop(cores[1].try_lock());
    for core in [0, 1, 2] {
        bench.token().fetch_or(waiting_bit(core), Ordering::Relaxed);
    }
    for next in [2, 0, 1] {
        for core in [0, 1, 2] {
            if core != next {
                assert!(cores[core].try_lock().is_none(), "{core} before {next}");
            }
        }
        assert!(cores[next].try_lock().is_some());
    }
    assert!(cores[1].try_lock().is_some(), "no core waits any more");
}

/// T-LOCK-3: waiting is bounded, backs off, and leaves the token unchanged.
#[test]
fn waiting_backs_off_and_ends() {
    let bench = Bench::new();
    let [mut a, mut b] = [0, 1].map(|core| bench.start(core, 1));
    let guard = a.try_lock().unwrap();
    let mut pauses = std::vec::Vec::new();
    let before = bench.token().load(Ordering::Relaxed);
    assert_eq!(
        b.lock(9, |pause| pauses.push(pause)).unwrap_err(),
        LockTimedOut
    );
    assert_eq!(pauses, [1, 2, 4, 8, 16, 32, 64, 64, 64]);
    assert_eq!(
        bench.token().load(Ordering::Relaxed),
        before,
        "it no longer waits"
    );
    drop(guard);
}

/// T-LOCK-3: a core takes a free lock out of turn after `PATIENCE` polls, not before. A new turn or
/// a new owner restarts the count.
#[test]
fn a_waiting_core_is_patient_in_each_turn() {
    const AT: u32 = 10;
    for (new_turn, owner, expected) in [
        (false, false, PATIENCE),
        (true, false, AT + PATIENCE),
        (false, true, AT + 1 + PATIENCE),
    ] {
        let bench = Bench::new();
        let [mut a, _b, mut c] = [0, 1, 2].map(|core| bench.start(core, 1));
        drop(a.try_lock());
        bench.token().fetch_or(waiting_bit(1), Ordering::Relaxed);
        assert_eq!(c.lock(PATIENCE, |_| ()).unwrap_err(), LockTimedOut);
        let released = &bench.words[released_at(0, 1)];
        let mut polls = 0;
        let taken = c.lock(2 * PATIENCE, |_| {
            polls += 1;
            if new_turn && polls == AT {
                bench.token().fetch_add(ONE_TURN, Ordering::Relaxed);
                released.fetch_add(ONE_TURN, Ordering::Relaxed);
            }
            if owner && (AT..=AT + 1).contains(&polls) {
                let turn = if polls == AT { ONE_TURN } else { !ONE_TURN + 1 };
                released.fetch_add(turn, Ordering::Relaxed);
            }
        });
        assert!(!taken.unwrap().is_recovered());
        assert_eq!(polls, expected, "{new_turn} {owner}");
    }
}

/// A guard counts the turns that others took while its core waited.
#[test]
fn a_guard_counts_the_turns_that_it_waited() {
    for turns in [0, 1] {
        let bench = Bench::new();
        let [mut a, mut b, mut c] = [0, 1, 2].map(|core| bench.start(core, 1));
        let mut held = [a.try_lock().map(|it| it.into_guard().detach()), None];
        let mut polls = 0;
        let guard = c.lock(5, |_| {
            polls += 1;
            held[0] = None;
            // After A, B's turn is before C's.
            let taken = (polls == 1 && turns == 1).then(|| b.try_lock().unwrap());
            held[1] = taken.map(|it| it.into_guard().detach());
        });
        assert_eq!(guard.unwrap().into_guard().waited_turns(), turns);
        assert_eq!(polls, 1 + turns);
    }
}

/// If the number of turns wraps around to that of a core's last release, that core's next
/// acquisition does not count as released.
#[test]
fn turns_wrap_around() {
    let bench = Bench::new();
    let [mut a, mut b] = [0, 1].map(|core| bench.start(core, 1));
    drop(b.try_lock());
    // Skip to one turn before the number of B's turn occurs again; A has released that turn.
    let before = (b.mine & !(ONE_TURN - 1)).wrapping_sub(ONE_TURN) | a.identity;
    bench.token().store(before, Ordering::Relaxed);
    a.own_released.store(before, Ordering::Relaxed);
    let guard = b.try_lock().unwrap();
    assert!(a.try_lock().is_none());
    drop(guard);
    assert!(a.try_lock().is_some());
}

#[test]
fn scribbled_words_cost_time_and_no_more() {
    for scribble in [
        1,
        4,
        WAITING,
        ONE_TURN,
        0x1234_5678,
        u32::MAX,
        u32::MAX << 2,
    ] {
        let bench = Bench::new();
        let [mut a, mut b] = [0, 1].map(|core| bench.start(core, 1));
        drop(a.try_lock());
        bench
            .words
            .iter()
            .for_each(|word| word.store(scribble, Ordering::Relaxed));
        let _ = b.lock(PATIENCE + 3, spin);
        let _ = a.lock(PATIENCE + 3, spin);
    }
}

/// One step of the random test.
#[derive(Clone, Copy, Debug)]
enum Event {
    Take(usize),
    Leave(usize),
    /// The core dies, whether it holds the lock or not, and starts again.
    Die(usize),
    /// Dead owners release the lock late, as a core that was frozen may do.
    LeaveLate,
}

/// The model: the lock as one value.
#[derive(Clone, Copy, Debug)]
struct Owner {
    core: Option<usize>,
    /// Whether the last owner died while it held the lock.
    orphaned: bool,
}

impl ReferenceStateMachine for Owner {
    type State = Self;
    type Transition = Event;

    fn init_state() -> BoxedStrategy<Self> {
        let free = Self {
            core: None,
            orphaned: false,
        };
        Just(free).boxed()
    }

    fn transitions(_: &Self) -> BoxedStrategy<Event> {
        prop_oneof![
            4 => (0..3_usize).prop_map(Event::Take),
            3 => (0..3_usize).prop_map(Event::Leave),
            2 => (0..3_usize).prop_map(Event::Die),
            1 => Just(Event::LeaveLate),
        ]
        .boxed()
    }

    fn preconditions(owner: &Self, event: &Event) -> bool {
        match event {
            Event::Take(_) | Event::Die(_) => true,
            Event::Leave(core) => owner.core == Some(*core),
            // Excluded: a late release of an orphaned lock, because no core would then recover it.
            Event::LeaveLate => !owner.orphaned,
        }
    }

    fn apply(mut owner: Self, event: &Event) -> Self {
        match event {
            Event::Take(core) if owner.core.is_none() => {
                owner.core = Some(*core);
                owner.orphaned = false;
            }
            Event::Leave(_) => owner.core = None,
            Event::Die(core) if owner.core == Some(*core) => {
                owner.core = None;
                owner.orphaned = true;
            }
            Event::Take(_) | Event::Die(_) | Event::LeaveLate => {}
        }
        owner
    }
}

struct Cores {
    bench: Bench,
    locks: [Lock<'static>; 3],
    generations: [u32; 3],
    held: [Option<Held<'static>>; 3],
    /// The guards that dead incarnations held, each with its core and generation.
    late: Vec<(usize, u32, Held<'static>)>,
    /// The state of the model before the event.
    before: Owner,
}

impl StateMachineTest for Cores {
    type SystemUnderTest = Self;
    type Reference = Owner;

    fn init_test(owner: &Owner) -> Self {
        let bench = Bench::new();
        Self {
            bench,
            locks: [0, 1, 2].map(|core| bench.start(core, 1)),
            generations: [1; 3],
            held: [None, None, None],
            late: Vec::new(),
            before: *owner,
        }
    }

    fn apply(mut cores: Self, owner: &Owner, event: Event) -> Self {
        match event {
            Event::Take(core) => {
                let taken = cores.locks[core].try_lock();
                assert_eq!(
                    taken.is_some(),
                    cores.before.core.is_none(),
                    "one is inside"
                );
                if let Some(taken) = taken {
                    assert_eq!(taken.is_recovered(), cores.before.orphaned);
                    cores.held[core] = Some(taken.into_guard().detach());
                }
            }
            Event::Leave(core) => drop(cores.held[core].take()),
            Event::Die(core) => {
                let generation = cores.generations[core];
                cores.bench.kill(core, generation);
                let held = cores.held[core].take();
                cores.late.extend(held.map(|held| (core, generation, held)));
                cores.generations[core] += 1;
                // Forget releases that are too late: a core has only four released words.
                let too_late = |(of, generation, _): &mut (usize, u32, _)| {
                    *of == core && *generation + 3 < cores.generations[core]
                };
                cores
                    .late
                    .extract_if(.., too_late)
                    .for_each(core::mem::forget);
                cores.locks[core] = cores.bench.start(core, cores.generations[core]);
            }
            Event::LeaveLate => cores.late.clear(),
        }
        cores.before = *owner;
        cores
    }
}

prop_state_machine! {
    #![proptest_config(ProptestConfig {
        cases: if cfg!(miri) { 1 } else { 512 },
        failure_persistence: None,
        ..ProptestConfig::default()
    })]

    /// T-LOCK-1, T-LOCK-3: in any order of acquisitions, releases, deaths and late releases, at
    /// most one core is inside. Exactly the next owner after a death inside gets `Recovered`.
    #[test]
    fn the_lock_does_what_its_model_does(sequential 1..60 => Cores);
}
