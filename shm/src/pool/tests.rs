//! Tests of the pool against a model, with deaths and freezes at every access, and with garbage.

use super::*;
use crate::fault::{freeze_at, kill_at, zeroed};
use proptest::prelude::*;
use std::vec::Vec;

const BLOCKS: usize = 8;

/// Returns the accesses at which to kill or freeze. Miri takes long for each, so it gets only some
/// of them.
fn steps() -> impl Iterator<Item = usize> {
    (0..).step_by(if cfg!(miri) { 7 } else { 1 })
}

#[derive(Clone, Copy)]
struct Bench {
    words: &'static [AtomicU32],
    incarnations: Incarnations<'static>,
}

impl Bench {
    fn new() -> Self {
        let incarnations = Incarnations::attach(zeroed(Incarnations::WORDS)).unwrap();
        Self {
            words: zeroed(words(BLOCKS)),
            incarnations,
        }
    }

    fn start(&self, core: usize, generation: u32) -> Pool<'static> {
        let incarnation = Incarnation::new(core, generation).unwrap();
        self.incarnations.announce(incarnation).unwrap();
        Pool::attach(self.words, BLOCKS, incarnation, self.incarnations).unwrap()
    }
}

/// T-SHM-1: the pool refuses a request that does not fit, and lends at least the requested length.
#[test]
fn words_are_given_until_they_are_gone() {
    let pool = Bench::new().start(0, 1);
    assert_eq!(pool.get(0), Err(GetError::Full));
    assert_eq!(pool.get(BLOCKS * BLOCK_WORDS + 1), Err(GetError::Full));
    let one = pool.get(17).unwrap();
    assert_eq!(pool.open(one).unwrap().len(), 17);
    assert_eq!(pool.free_words(), 6 * BLOCK_WORDS);
    let rest = pool.get(6 * BLOCK_WORDS).unwrap();
    assert_eq!(pool.get(1), Err(GetError::Full));
    let (one, rest) = (pool.open(one).unwrap(), pool.open(rest).unwrap());
    assert!(one.as_ptr_range().end <= rest.as_ptr_range().start);
}

/// A run ends within the pool, even if its length was overwritten.
#[test]
fn a_run_of_the_dead_ends_within_the_pool() {
    for (length, blocks) in [(0, 1), (1, 1), (2, 2), (3, 2), (300, 2)] {
        let pool = Bench::new().start(1, 1);
        let head = owned(Incarnation::new(0, 1).unwrap(), length, 1);
        pool.states[BLOCKS - 2].store(head, Ordering::Relaxed);
        assert_eq!(pool.reclaim_dead(), blocks * BLOCK_WORDS, "length {length}");
        assert_eq!(pool.free_words(), BLOCKS * BLOCK_WORDS);
    }
}

/// T-SHM-2, T-SHM-4: an owner gives memory back; the pool refuses a stale or forged handle.
#[test]
fn stale_and_forged_handles_are_errors() {
    let bench = Bench::new();
    let (pool, other) = (bench.start(0, 1), bench.start(1, 1));
    let handle = pool.get(20).unwrap();
    assert_eq!(Handle::from_words(handle.to_words()), handle);
    assert_eq!(other.open(handle).unwrap_err(), HandleError::NotOwner);
    assert_eq!(other.give_back(handle), Err(HandleError::NotOwner));
    let block = |block| Handle { block, ..handle };
    let words = |words| Handle { words, ..handle };
    let stamp = |stamp| Handle { stamp, ..handle };
    for (forged, error) in [
        (block(7), HandleError::Invalid),
        (block(u16::MAX), HandleError::Invalid),
        (block(3), HandleError::Stale),
        (block(1), HandleError::Stale),
        (words(0), HandleError::Invalid),
        (words(16), HandleError::Invalid),
        (words(33), HandleError::Invalid),
        (words(u16::MAX), HandleError::Invalid),
        (stamp(handle.stamp + 1), HandleError::Stale),
        (stamp(0), HandleError::Stale),
        (Handle::from_words([0, 0]), HandleError::Invalid),
    ] {
        assert_eq!(pool.open(forged).unwrap_err(), error, "{forged:?}");
        assert_eq!(pool.give_back(forged), Err(error), "{forged:?}");
        assert_eq!(pool.hand_over(forged, 1), Err(HandOverError::Handle(error)));
    }
    pool.give_back(handle).unwrap();
    assert_eq!(pool.give_back(handle), Err(HandleError::Stale));
    let again = pool.get(20).unwrap();
    assert_eq!(again.block, handle.block);
    assert_eq!(pool.open(handle).unwrap_err(), HandleError::Stale);
    assert!(pool.open(again).is_ok());
}

/// T-SHM-3: the receiver opens the handed-over words with the same handle.
#[test]
fn ownership_is_handed_over() {
    let bench = Bench::new();
    let (pool, other) = (bench.start(0, 1), bench.start(1, 4));
    let handle = pool.get(2).unwrap();
    pool.open(handle).unwrap()[1].store(42, Ordering::Relaxed);
    assert_eq!(pool.hand_over(handle, 2), Err(HandOverError::ReceiverDead));
    pool.hand_over(handle, 1).unwrap();
    assert_eq!(pool.open(handle).unwrap_err(), HandleError::NotOwner);
    assert_eq!(other.open(handle).unwrap()[1].load(Ordering::Relaxed), 42);
    other.give_back(handle).unwrap();
    assert_eq!(pool.free_words(), BLOCKS * BLOCK_WORDS);
}

/// T-SHM-2: only the words of a dead core are freed.
#[test]
fn the_words_of_the_dead_are_reclaimed() {
    let bench = Bench::new();
    let (dying, other) = (bench.start(0, 1), bench.start(1, 1));
    let _ = dying.get(40).unwrap();
    let kept = other.get(16).unwrap();
    let old = dying.get(16).unwrap();
    let handed = dying.get(16).unwrap();
    dying.hand_over(handed, 1).unwrap();
    assert_eq!(other.reclaim_dead(), 0);
    bench
        .incarnations
        .announce(Incarnation::new(0, 2).unwrap())
        .unwrap();
    assert_eq!(other.reclaim_dead(), 4 * BLOCK_WORDS);
    let successor = bench.start(0, 2);
    assert_eq!(successor.open(old).unwrap_err(), HandleError::Stale);
    assert!(other.open(kept).is_ok() && other.open(handed).is_ok());
    // `get` also frees them without a call of `reclaim_dead`.
    let lent = bench.start(2, 1).get(48).unwrap();
    assert!(
        bench
            .incarnations
            .mark_dead(Incarnation::new(2, 1).unwrap())
    );
    let taken = other.get(48).unwrap();
    assert_eq!(taken.stamp, lent.stamp + 1, "at the first attempt");
}

/// A core is killed at any step of get, hand over and give back: no word is lost or lent twice.
#[test]
fn killed_at_every_step_everything_comes_back() {
    for at in steps() {
        let bench = Bench::new();
        let (dying, other) = (bench.start(0, 1), bench.start(1, 1));
        let kept = other.get(16).unwrap();
        let done = kill_at(at, || {
            let one = dying.get(40).unwrap();
            let two = dying.get(16).unwrap();
            dying.hand_over(one, 1).unwrap();
            dying.give_back(two).unwrap();
        });
        assert!(
            bench
                .incarnations
                .mark_dead(Incarnation::new(0, 1).unwrap())
        );
        other.reclaim_dead();
        // Words that are not free were handed over to the living core.
        let lost = (BLOCKS - 1) * BLOCK_WORDS - other.free_words();
        assert!(
            lost == 0 || lost == 3 * BLOCK_WORDS,
            "killed at {at}: {lost}"
        );
        let all = other.get(other.free_words()).unwrap();
        assert!(other.open(all).is_ok() && other.open(kept).is_ok());
        if done.is_some() {
            break;
        }
    }
}

/// A straggler that is thawed in the middle of a call takes no words of a living core.
#[test]
fn a_straggler_takes_nothing_from_the_living() {
    for at in steps() {
        let bench = Bench::new();
        let straggler = bench.start(0, 1);
        let own = straggler.get(16).unwrap();
        let meanwhile = move || {
            assert!(
                bench
                    .incarnations
                    .mark_dead(Incarnation::new(0, 1).unwrap())
            );
            let living = bench.start(1, 1);
            for words in [16, 48, 64] {
                living.get(words).unwrap();
            }
        };
        let (_, hit) = freeze_at(at, meanwhile, || {
            let _ = straggler.get(32);
            let _ = straggler.hand_over(own, 1);
            let _ = straggler.give_back(own);
        });
        if !hit {
            break;
        }
        let living = bench.start(1, 1);
        living.reclaim_dead();
        assert_eq!(living.free_words(), 0, "frozen at {at}");
    }
}

/// As above, with runs of several blocks, between blocks that living cores borrow.
#[test]
fn a_straggler_gets_no_run_in_the_middle_of_another() {
    for (kept, living) in [(1, 4), (1, 7), (2, 3), (2, 6), (0, 8), (4, 1), (1, 1)] {
        for at in steps() {
            let bench = Bench::new();
            let straggler = bench.start(0, 1);
            let keeper = bench.start(2, 1);
            for _ in 0..kept {
                let handle = straggler.get(1).unwrap();
                straggler.hand_over(handle, 2).unwrap();
            }
            let given: std::rc::Rc<core::cell::Cell<Option<Handle>>> = std::rc::Rc::default();
            let meanwhile = {
                let given = given.clone();
                move || {
                    assert!(
                        bench
                            .incarnations
                            .mark_dead(Incarnation::new(0, 1).unwrap())
                    );
                    // Free the blocks before the straggler's, so that the run begins there.
                    let head =
                        |block: usize| bench.words[STATES_AT + block].load(Ordering::Relaxed);
                    for block in 0..kept {
                        let handle = Handle {
                            block: block as u16,
                            words: 1,
                            stamp: stamp_of(head(block)),
                        };
                        let _ = keeper.give_back(handle);
                    }
                    given.set(Some(bench.start(1, 1).get(living * BLOCK_WORDS).unwrap()));
                }
            };
            let (got, hit) = freeze_at(at, meanwhile, || straggler.get(3 * BLOCK_WORDS));
            if !hit {
                break;
            }
            let other = bench.start(1, 1);
            let theirs = other.open(given.get().unwrap()).unwrap().as_ptr_range();
            if let Ok(own) = got
                .map_err(|_| ())
                .and_then(|got| straggler.open(got).map_err(|_| ()))
            {
                let own = own.as_ptr_range();
                let apart = own.end <= theirs.start || theirs.end <= own.start;
                assert!(apart, "{kept}, {living}, frozen at {at}: lent twice");
            }
        }
    }
}

/// A core that is frozen at any step of a call delays no other core. T-SHM-1
#[test]
fn a_frozen_core_delays_no_other() {
    for blocks in [1, 3] {
        for at in steps() {
            let bench = Bench::new();
            let frozen = bench.start(0, 1);
            bench.start(1, 1);
            let meanwhile = move || {
                let other = bench.start(1, 1);
                let got = [2, 1, 2].map(|blocks| other.get(blocks * BLOCK_WORDS).unwrap());
                for handle in got {
                    other.give_back(handle).unwrap();
                }
            };
            let (_, hit) = freeze_at(at, meanwhile, || {
                let handle = frozen.get(blocks * BLOCK_WORDS).unwrap();
                frozen.give_back(handle).unwrap();
            });
            if !hit {
                break;
            }
        }
    }
}

/// A dead owner counts as dead even if a later generation has the same bits in the head.
#[test]
fn the_words_of_the_dead_come_back_after_any_number_of_incarnations() {
    let all = [16, 1, 15, 31, 32, 64];
    for &incarnations in &all[..if cfg!(miri) { 2 } else { all.len() }] {
        for attach_from in [2, incarnations, incarnations + 1, incarnations + 2] {
            let bench = Bench::new();
            let dying = bench.start(0, 1);
            let other = bench.start(1, 1);
            let old = dying.get(40).unwrap();
            for generation in 2..incarnations + 2 {
                if generation >= attach_from {
                    assert!(bench.start(0, generation).open(old).is_err());
                } else {
                    let incarnation = Incarnation::new(0, generation).unwrap();
                    bench.incarnations.announce(incarnation).unwrap();
                }
            }
            other.reclaim_dead();
            assert_eq!(
                other.free_words(),
                BLOCKS * BLOCK_WORDS,
                "{incarnations}, {attach_from}"
            );
        }
    }
}

#[test]
fn scribbled_words_are_no_panic() {
    for scribble in [1, 2, 3, 0xFFF, 0x1234_5678, u32::MAX] {
        let bench = Bench::new();
        let pool = bench.start(0, 1);
        let handle = pool.get(20).unwrap();
        for word in bench.words {
            word.store(scribble, Ordering::Relaxed);
        }
        let _ = pool.open(handle);
        let _ = pool.give_back(handle);
        pool.reclaim_dead();
        let _ = pool.free_words();
        let _ = (pool.get(1), pool.get(40));
    }
}

/// An operation of a core on the pool.
#[derive(Clone, Debug)]
enum Op {
    Get { core: usize, words: usize },
    GiveBack { core: usize, pick: usize },
    HandOver { core: usize, pick: usize, to: usize },
    Respawn { core: usize },
    Reclaim { core: usize },
}

fn op() -> impl Strategy<Value = Op> {
    let core = 0..3usize;
    prop_oneof![
        4 => (core.clone(), 0..70usize).prop_map(|(core, words)| Op::Get { core, words }),
        3 => (core.clone(), any::<usize>())
            .prop_map(|(core, pick)| Op::GiveBack { core, pick }),
        2 => (core.clone(), any::<usize>(), core.clone())
            .prop_map(|(core, pick, to)| Op::HandOver { core, pick, to }),
        1 => core.clone().prop_map(|core| Op::Respawn { core }),
        1 => core.prop_map(|core| Op::Reclaim { core }),
    ]
}

/// One allocation that was made during the test.
#[derive(Clone, Copy)]
struct Known {
    handle: Handle,
    /// Core and generation; `None` after it was given back or reclaimed.
    owner: Option<(usize, u32)>,
}

/// The model: a list of all allocations, first fit.
struct Model {
    generations: [u32; 3],
    known: Vec<Known>,
}

impl Model {
    fn bury(&mut self) {
        for known in &mut self.known {
            known.owner = known.owner.filter(|&(core, g)| self.generations[core] == g);
        }
    }

    fn first_fit(&self, blocks: usize) -> Option<usize> {
        let mut used = [false; BLOCKS];
        for Known { handle, .. } in self.known.iter().filter(|known| known.owner.is_some()) {
            let first = handle.block as usize;
            used[first..first + handle.len().div_ceil(BLOCK_WORDS)].fill(true);
        }
        (0..=BLOCKS - blocks).find(|&at| !used[at..at + blocks].contains(&true))
    }
}

fn check(ops: &[Op]) {
    let bench = Bench::new();
    let mut pools: Vec<_> = (0..3).map(|core| bench.start(core, 1)).collect();
    let mut model = Model {
        generations: [1; 3],
        known: Vec::new(),
    };
    for op in ops {
        match *op {
            Op::Get { core, words } => {
                let blocks = words.div_ceil(BLOCK_WORDS);
                model.bury();
                let expected = model.first_fit(blocks).filter(|_| words != 0);
                let got = pools[core].get(words);
                assert_eq!(got.map(|handle| handle.block as usize).ok(), expected);
                if let Ok(handle) = got {
                    let owner = Some((core, model.generations[core]));
                    model.known.push(Known { handle, owner });
                }
            }
            Op::GiveBack { core, pick } if !model.known.is_empty() => {
                let pick = pick % model.known.len();
                let known = &mut model.known[pick];
                let mine = known.owner == Some((core, model.generations[core]));
                assert_eq!(pools[core].give_back(known.handle).is_ok(), mine);
                known.owner = known.owner.filter(|_| !mine);
            }
            Op::HandOver { core, pick, to } if !model.known.is_empty() => {
                let pick = pick % model.known.len();
                let known = &mut model.known[pick];
                let mine = known.owner == Some((core, model.generations[core]));
                assert_eq!(pools[core].hand_over(known.handle, to).is_ok(), mine);
                if mine {
                    known.owner = Some((to, model.generations[to]));
                }
            }
            Op::Respawn { core } => {
                model.generations[core] += 1;
                pools[core] = bench.start(core, model.generations[core]);
            }
            Op::Reclaim { core } => {
                pools[core].reclaim_dead();
                model.bury();
            }
            Op::GiveBack { .. } | Op::HandOver { .. } => {}
        }
        for known in &model.known {
            for (core, pool) in pools.iter().enumerate() {
                let mine = known.owner == Some((core, model.generations[core]));
                assert_eq!(pool.open(known.handle).is_ok(), mine);
            }
        }
    }
}

const MAX_OPS: usize = if cfg!(miri) { 20 } else { 60 };

proptest! {
    #![proptest_config(ProptestConfig {
        cases: if cfg!(miri) { 2 } else { 512 },
        failure_persistence: None,
        ..ProptestConfig::default()
    })]

    /// T-SHM-1, T-SHM-2, T-SHM-4: the pool behaves like a plain list of allocations.
    #[test]
    fn the_pool_does_what_its_model_does(ops in prop::collection::vec(op(), 1..MAX_OPS)) {
        check(&ops);
    }
}

/// An incarnation that attaches after its successor takes none of the successor's words.
#[test]
fn a_straggler_that_attaches_late_takes_nothing_from_the_living() {
    let bench = Bench::new();
    let late = Incarnation::new(0, 1).unwrap();
    bench.incarnations.announce(late).unwrap();
    let (living, other) = (bench.start(0, 2), bench.start(1, 1));
    let kept = living.get(16).unwrap();
    let _late = Pool::attach(bench.words, BLOCKS, late, bench.incarnations).unwrap();
    assert_eq!(other.reclaim_dead(), 0);
    assert!(living.open(kept).is_ok());
    let next = living.get(16).unwrap();
    assert!(other.get((BLOCKS - 1) * BLOCK_WORDS).is_err());
    assert!(living.open(next).is_ok());
}

/// The same if the late incarnation is frozen at any step of its attachment, or if another core is
/// frozen at any step of handing words over to it.
#[test]
fn an_attachment_frozen_at_any_step_takes_nothing_from_the_next_incarnation() {
    for by_hand_over in [false, true] {
        for at in steps() {
            let bench = Bench::new();
            let (late, next) = (
                Incarnation::new(1, 1).unwrap(),
                Incarnation::new(1, 2).unwrap(),
            );
            bench.incarnations.announce(late).unwrap();
            let lender = bench.start(0, 1);
            let given = lender.get(16).unwrap();
            let kept = std::rc::Rc::new(core::cell::Cell::new(None));
            let meanwhile = {
                let kept = kept.clone();
                move || {
                    let living = bench.start(1, 2);
                    kept.set(Some((living, living.get(16).unwrap())));
                }
            };
            let (_, hit) = freeze_at(at, meanwhile, || {
                if by_hand_over {
                    let _ = lender.hand_over(given, 1);
                } else {
                    let _ = Pool::attach(bench.words, BLOCKS, late, bench.incarnations);
                }
            });
            if !hit {
                assert!(at > BLOCKS);
                break;
            }
            let (living, first) = kept.take().unwrap();
            assert!(bench.incarnations.is_alive(next));
            assert!(living.open(first).is_ok(), "frozen at {at}");
            let second = living.get(16).unwrap();
            assert_eq!(lender.reclaim_dead(), 0, "frozen at {at}");
            assert!(
                living.open(first).is_ok() && living.open(second).is_ok(),
                "frozen at {at}"
            );
        }
    }
}

/// `free_words` returns even while a run is being gathered, or after its owner was killed.
#[test]
fn free_words_end_wherever_a_core_is_killed() {
    for at in steps() {
        let bench = Bench::new();
        let (dying, other) = (bench.start(0, 1), bench.start(1, 1));
        let done = kill_at(at, || dying.get(3 * BLOCK_WORDS).unwrap()).is_some();
        assert!(other.free_words() <= BLOCKS * BLOCK_WORDS);
        if done {
            break;
        }
    }
}
