//! The lock: compare-and-swap, owner with generation, bounded waiting, recovery, fair turns.
//!
//! One cache line. Word 0 is the *token* of the last acquisition: which core took the lock, in
//! which of its lives, in which turn (one more with each acquisition), and which cores wait. Words
//! 1 to 12 are one *released* word for each core and life (by its generation mod 4): the owner
//! gives the lock back by storing its token there. So the lock is free if the token's owner has
//! released that very token, and taking it is one compare-and-swap from that token to one's own.
//! Words 13 to 15 say which life of each core attached last. T-LOCK-1, T-LOCK-3
//!
//! - **Release is a plain store, yet a straggler cannot release another's lock**: it stores its old
//!   token into a word of its own life. The next three lives of its core use other words.
//! - **Recovery**: a token that is not released and whose life is not alive is an orphan. Any core
//!   may take over from it by the same compare-and-swap, and is told so by [`Acquired::Recovered`].
//!   The token has 4 bits of the generation; the first attachment of a life marks a token of an
//!   earlier life with equal bits as an orphan.
//! - **Waiting** is test-and-test-and-set with bounded exponential back-off (T. E. Anderson, "The
//!   performance of spin lock alternatives", 1990): waiting cores read, and give up after the given
//!   number of polls.
//! - **Turns**: a waiting core sets its bit in the token. Of the waiting cores the next one after
//!   the last owner, in the cyclic order 0, 1, 2, may take the lock. The token is one word, so the
//!   core that takes the lock has seen the bit, and the cyclic distance from the last owner to a
//!   waiting core shrinks with each turn: **a waiting core is passed at most [`MAX_WAITED_TURNS`] =
//!   2 times**.
//! - A waiting core that does not poll (frozen, pre-empted, dead) would stop the others. After
//!   [`PATIENCE`] polls of a free lock, a waiter takes it out of turn and clears the bit of the
//!   absent one. The bound above holds for cores that poll at least once in that time.
//!
//! Limit: the turn has 23 bits. A core that is stopped between its look at the token and its
//! compare-and-swap, for exactly a multiple of 2^23 turns of which the last is the same owner's,
//! would take a lock that is held. At 100 ns a turn that is 0.8 s; the watchdog resets such a core.

use crate::life::{Attached, CORES, Life, Lives};
use crate::region::{FitError, LINE_WORDS, fit_exactly};
use crate::sync::{AtomicU32, Ordering, fence};

/// Words of a lock.
pub const WORDS: usize = LINE_WORDS;

/// How many turns others take at most while a core waits and looks.
pub const MAX_WAITED_TURNS: u32 = CORES as u32 - 1;

/// Looks at a free lock that is another's turn before a waiting core takes it nevertheless. With
/// the back-off below some 2000 spins, tens of microseconds; longer than any core in step needs.
pub const PATIENCE: u32 = 32;

/// The longest pause between two looks, in spins.
const MAX_PAUSE: u32 = 64;
/// How often an attachment tries to replace a token that its core's earlier life left. Then the
/// token has changed by others so often that it is no longer that one.
const DISOWN_ATTEMPTS: u32 = 16;

const TOKEN_AT: usize = 0;
/// Lives of a core that have released words of their own.
const RELEASED_LIVES: usize = 4;
const ATTACHED_AT: usize = 1 + CORES * RELEASED_LIVES;

// The token, from the lowest bit: core + 1, generation, waiting cores, turn.
const CORE_MASK: u32 = 0x3;
const GENERATION_SHIFT: u32 = 2;
const GENERATION_MASK: u32 = 0xF;
const WAITING_SHIFT: u32 = 6;
const WAITING: u32 = 0b111 << WAITING_SHIFT;
const TURN_SHIFT: u32 = 9;
const ONE_TURN: u32 = 1 << TURN_SHIFT;

/// Core and generation of a token whose owner is gone for good: no core.
const ORPHAN: u32 = GENERATION_MASK << GENERATION_SHIFT;

const _: () = assert!(CORES == 3 && ATTACHED_AT + CORES == WORDS);

/// The core that the token names; [`CORES`] if it names none.
const fn core_of(token: u32) -> usize {
    match token & CORE_MASK {
        0 => CORES,
        n => n as usize - 1,
    }
}

const fn generation_of(token: u32) -> u32 {
    token >> GENERATION_SHIFT & GENERATION_MASK
}

const fn waiting_bit(core: usize) -> u32 {
    1 << (WAITING_SHIFT + core as u32)
}

/// The index of the word in which this life of the core releases.
const fn released_at(core: usize, generation: u32) -> usize {
    1 + core * RELEASED_LIVES + generation as usize % RELEASED_LIVES
}

/// The lock was not to be had within the given number of looks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TimedOut;

/// Why one look did not take the lock.
enum Missed {
    /// Someone else holds it, or was quicker.
    Held,
    /// It is free and in this turn another's.
    Passed { turn: u32 },
}

/// The lock as one life of one core sees it. Several tasks of a core may each attach.
///
/// For tasks; a handler uses [`Lock::try_lock`] only, or it waits for the task that it interrupts.
#[derive(Debug)]
pub struct Lock<'a> {
    words: &'a [AtomicU32; WORDS],
    /// The released word of this life.
    own_released: &'a AtomicU32,
    attached: Attached<'a>,
    core: usize,
    /// Core and generation in their places.
    identity: u32,
    /// The token of the last acquisition through this end, without waiting bits.
    mine: u32,
    #[cfg(loom)]
    patience: u32,
}

impl<'a> Lock<'a> {
    /// Attaches to the lock. `life` must have been [announced](Lives::announce). Never blocks.
    ///
    /// # Errors
    /// [`FitError`] if the words are too few or not at a line boundary.
    pub fn attach(words: &'a [AtomicU32], life: Life, lives: Lives<'a>) -> Result<Self, FitError> {
        let words: &[AtomicU32; WORDS] = fit_exactly(words)?;
        let generations = words.last_chunk().ok_or(FitError::TooSmall)?;
        let generation = life.generation() & GENERATION_MASK;
        let lock = Self {
            words,
            own_released: &words[released_at(life.core(), generation)],
            attached: Attached::new(generations, lives),
            core: life.core(),
            identity: (life.core() as u32 + 1) | generation << GENERATION_SHIFT,
            mine: 0,
            #[cfg(loom)]
            patience: PATIENCE,
        };
        lock.disown_earlier_lives(life);
        Ok(lock)
    }

    /// For models, in which 32 polls are too many.
    #[cfg(loom)]
    pub fn set_patience(&mut self, polls: u32) {
        self.patience = polls;
    }

    #[cfg(loom)]
    const fn patience(&self) -> u32 {
        self.patience
    }

    #[cfg(not(loom))]
    #[allow(clippy::unused_self, reason = "models have one for each end")]
    const fn patience(&self) -> u32 {
        PATIENCE
    }

    /// Undoes what earlier lives of this core left: a waiting bit, and perhaps a token that looks
    /// like one of this life.
    #[cold]
    fn disown_earlier_lives(&self, life: Life) {
        // Each failed attempt is a change by one of two other cores, which takes the orphan or
        // begins or ends waiting, or by an earlier life that attaches late.
        for attempt in 1..=2 * DISOWN_ATTEMPTS {
            // Acquire pairs with the Release in `take`. Read before `earlier`: a token that was
            // there before this life had attached is not its own.
            let token = self.token().load(Ordering::Acquire);
            let Some(earlier) = self.attached.earlier(life) else {
                return;
            };
            let is_alike = token & (CORE_MASK | ORPHAN) == self.identity;
            let new = if is_alike && !self.is_released(token) {
                token & !CORE_MASK | ORPHAN
            } else {
                token
            } & !waiting_bit(self.core);
            let is_disowned = new == token || self.take(token, new) || attempt >= DISOWN_ATTEMPTS;
            if is_disowned && self.attached.insert(life, earlier) {
                return;
            }
        }
    }

    #[inline]
    const fn token(&self) -> &'a AtomicU32 {
        &self.words[TOKEN_AT]
    }

    /// Replaces the token, if it is still the expected one.
    #[inline]
    fn take(&self, expected: u32, new: u32) -> bool {
        // Release pairs with the Acquire in `look`: a core that sees this token sees that its owner
        // was announced and had attached. Not Acquire: what the last owner did was acquired by
        // `is_released`, and since the token is the expected one, no other has had the lock since.
        self.token()
            .compare_exchange(expected, new, Ordering::Release, Ordering::Relaxed)
            .is_ok()
    }

    /// Takes the lock if it is free and no waiting core comes before this one. Never blocks. `None`
    /// if not.
    #[inline]
    #[must_use]
    pub fn try_lock(&mut self) -> Option<Acquired<'_, 'a>> {
        if self.retake() {
            return Some(Acquired::Clean(Guard {
                lock: self,
                waited: 0,
            }));
        }
        self.look(false).ok().map(|orphan| self.acquired(orphan, 0))
    }

    /// Takes the lock, waiting for at most `looks` looks at it. `relax(n)` is called between two
    /// looks to pass the time of n spins (1 ..= 64): [`spin`](crate::sync::spin) on a core of its
    /// own, something that gives the CPU away on a shared one. Task context.
    ///
    /// # Errors
    /// [`TimedOut`] after so many looks.
    #[inline]
    pub fn lock(
        &mut self,
        looks: u32,
        relax: impl FnMut(u32),
    ) -> Result<Acquired<'_, 'a>, TimedOut> {
        if self.retake() {
            return Ok(Acquired::Clean(Guard {
                lock: self,
                waited: 0,
            }));
        }
        let (orphan, waited) = self.wait(looks, relax)?;
        Ok(self.acquired(orphan, waited))
    }

    #[inline]
    fn acquired(&mut self, orphan: bool, waited: u32) -> Acquired<'_, 'a> {
        let guard = Guard { lock: self, waited };
        if orphan {
            Acquired::Recovered(guard)
        } else {
            Acquired::Clean(guard)
        }
    }

    /// The quick way: if the token is still this end's own (or none was ever taken), the lock is
    /// free.
    #[inline]
    fn retake(&mut self) -> bool {
        // Another task of this core may hold the lock by the same token, 2^23 turns later.
        if self.own_released.load(Ordering::Relaxed) != self.mine {
            return false;
        }
        let next = self.token_after(self.mine);
        let taken = self.take(self.mine, next);
        if taken {
            self.mine = next;
        }
        taken
    }

    #[inline]
    const fn token_after(&self, token: u32) -> u32 {
        (token & !(ONE_TURN - 1)).wrapping_add(ONE_TURN) | self.identity
    }

    /// Returns whether it took the lock from an orphan, and the turns of others that it waited.
    #[cold]
    fn wait(&mut self, looks: u32, mut relax: impl FnMut(u32)) -> Result<(bool, u32), TimedOut> {
        let own_bit = waiting_bit(self.core);
        let mut announced = None;
        let mut pause = 1;
        let mut passed = (0, 0);
        for _ in 0..looks {
            match self.look(passed.1 >= self.patience()) {
                Ok(orphan) => {
                    let turns = |first| self.mine.wrapping_sub(first) >> TURN_SHIFT;
                    let waited = announced.map_or(0, |first| turns(first).saturating_sub(1));
                    return Ok((orphan, waited));
                }
                Err(Missed::Held) => passed.1 = 0,
                Err(Missed::Passed { turn }) if turn == passed.0 => passed.1 += 1,
                Err(Missed::Passed { turn }) => passed = (turn, 1),
            }
            if self.token().load(Ordering::Relaxed) & own_bit == 0 {
                // Release pairs with the fence in `waiting_before`: a core that sees the bit sees that
                // this life has attached, so that the bit counts.
                let token = self.token().fetch_or(own_bit, Ordering::Release);
                announced.get_or_insert(token & !(ONE_TURN - 1));
            }
            relax(pause);
            pause = (pause * 2).min(MAX_PAUSE);
        }
        self.token().fetch_and(!own_bit, Ordering::Relaxed);
        Err(TimedOut)
    }

    /// Looks once and takes the lock if that is possible, with `impatient` also out of turn.
    /// Returns whether it was an orphan's.
    fn look(&mut self, impatient: bool) -> Result<bool, Missed> {
        let token = self.token().load(Ordering::Relaxed);
        let mut free = self.is_released(token);
        if !free {
            // Acquire pairs with the Release in `take`: the owner's announcement and attachment are
            // seen with its token.
            fence(Ordering::Acquire);
            let bits = generation_of(token);
            if self
                .attached
                .is_alive(core_of(token), bits, GENERATION_MASK)
            {
                return Err(Missed::Held);
            }
            // The owner may have released and died after the first look at its released word. Its
            // end was acquired, so this look sees that.
            free = self.is_released(token);
        }
        let before = self.waiting_before(token);
        if before != 0 && !impatient {
            return Err(Missed::Passed {
                turn: token >> TURN_SHIFT,
            });
        }
        let mut mine = self.token_after(token);
        // After exactly 2^23 turns the last release would already release the new token.
        if mine == self.own_released.load(Ordering::Relaxed) {
            mine = mine.wrapping_add(ONE_TURN);
        }
        let still_waiting = token & WAITING & !before & !waiting_bit(self.core);
        if !self.take(token, mine | still_waiting) {
            return Err(Missed::Held);
        }
        self.mine = mine;
        Ok(!free)
    }

    fn is_released(&self, token: u32) -> bool {
        let core = core_of(token);
        if core == CORES {
            // Never taken; anything else without a core is scribble, and an orphan.
            return token & !WAITING == 0;
        }
        // Acquire pairs with the Release in `Guard::drop`.
        let released = self.words[released_at(core, generation_of(token))].load(Ordering::Acquire);
        released == token & !WAITING
    }

    /// The waiting bits of living cores whose turn is before this core's. A bit that an earlier life
    /// left does not count before its successor attaches, which clears it.
    fn waiting_before(&self, token: u32) -> u32 {
        if token & WAITING & !waiting_bit(self.core) == 0 {
            return 0;
        }
        // Acquire pairs with the Release of the bit in `lock`.
        fence(Ordering::Acquire);
        let last = core_of(token);
        (last + 1..=last + CORES)
            .map(|core| core % CORES)
            .take_while(|&core| core != self.core)
            .filter(|&core| self.attached.has_living(core))
            .fold(0, |bits, core| bits | token & waiting_bit(core))
    }
}

/// The lock is taken.
#[derive(Debug)]
#[must_use = "dropping it releases the lock"]
pub enum Acquired<'l, 'a> {
    /// From an owner that had released it.
    Clean(Guard<'l, 'a>),
    /// From an owner that died with it: what the lock guards may be half-changed. Repair it; should
    /// this core die too, the next taker is told again.
    Recovered(Guard<'l, 'a>),
}

impl<'l, 'a> Acquired<'l, 'a> {
    /// The guard, for data that no death can leave in a bad state.
    #[inline]
    pub fn into_guard(self) -> Guard<'l, 'a> {
        match self {
            Self::Clean(guard) | Self::Recovered(guard) => guard,
        }
    }

    /// Whether the last owner died with the lock.
    #[must_use]
    pub const fn is_recovered(&self) -> bool {
        matches!(self, Self::Recovered(_))
    }
}

/// Holds the lock; dropping it releases.
#[derive(Debug)]
#[must_use = "dropping it releases the lock"]
pub struct Guard<'l, 'a> {
    lock: &'l mut Lock<'a>,
    /// How many turns others took while this end waited.
    waited: u32,
}

impl<'a> Guard<'_, 'a> {
    /// How many turns others took between this core's announcement that it waits and its own turn.
    #[must_use]
    pub const fn waited_turns(&self) -> u32 {
        self.waited
    }

    /// Keeps the lock beyond the borrow of this end: for a caller that cannot hold a guard, such as
    /// C. Until the result is dropped this end gets the lock no second time.
    #[inline]
    pub fn detach(self) -> Held<'a> {
        let guard = core::mem::ManuallyDrop::new(self);
        Held {
            released: guard.lock.own_released,
            token: guard.lock.mine,
        }
    }
}

/// Holds the lock as a [`Guard`] does, without borrowing the end that took it; dropping it
/// releases.
#[derive(Debug)]
#[must_use = "dropping it releases the lock"]
pub struct Held<'a> {
    released: &'a AtomicU32,
    token: u32,
}

impl Drop for Held<'_> {
    #[inline]
    fn drop(&mut self) {
        // Release pairs with the Acquire in `is_released`.
        self.released.store(self.token, Ordering::Release);
    }
}

impl Drop for Guard<'_, '_> {
    #[inline]
    fn drop(&mut self) {
        // Release pairs with the Acquire in `is_released`.
        self.lock
            .own_released
            .store(self.lock.mine, Ordering::Release);
    }
}

#[cfg(test)]
#[cfg(not(loom))]
mod tests {
    use super::*;
    use crate::step::{freeze_at, kill_at, zeroed};
    use crate::sync::spin;

    #[derive(Clone, Copy)]
    struct Bench {
        words: &'static [AtomicU32],
        lives: Lives<'static>,
    }

    impl Bench {
        fn new() -> Self {
            Self {
                words: zeroed(WORDS),
                lives: Lives::attach(zeroed(Lives::WORDS)).unwrap(),
            }
        }

        /// A new life of a core, at this lock.
        fn start(&self, core: usize, generation: u32) -> Lock<'static> {
            let life = Life::new(core, generation).unwrap();
            self.lives.announce(life).unwrap();
            Lock::attach(self.words, life, self.lives).unwrap()
        }

        fn kill(&self, core: usize, generation: u32) {
            assert!(self.lives.mark_dead(Life::new(core, generation).unwrap()));
        }

        fn token(&self) -> &'static AtomicU32 {
            &self.words[TOKEN_AT]
        }
    }

    /// T-LOCK-1: one owner at a time, of three cores.
    #[test]
    fn the_lock_is_taken_once() {
        let bench = Bench::new();
        let [mut a, mut b, mut c] = [0, 1, 2].map(|core| bench.start(core, 1));
        for _ in 0..3 {
            let guard = a.try_lock().unwrap();
            assert!(!guard.is_recovered());
            assert!(b.try_lock().is_none());
            assert_eq!(c.lock(5, |_| ()).unwrap_err(), TimedOut);
            drop(guard);
            assert!(b.lock(1, |_| ()).is_ok());
            assert!(c.try_lock().is_some());
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
    fn two_ends_of_one_life_exclude_each_other() {
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

    /// T-LOCK-3: a lock whose owner died is recovered by the next taker, who is told so; whoever
    /// takes it from one that died in the middle of the repair is told again.
    #[test]
    fn a_dead_owner_is_replaced_and_the_taker_is_told() {
        let bench = Bench::new();
        let [mut a, mut b, mut c] = [0, 1, 2].map(|core| bench.start(core, 1));
        core::mem::forget(a.try_lock().unwrap());
        assert!(b.try_lock().is_none(), "nobody says that it is dead");
        bench.kill(0, 1);
        let guard = b.try_lock().unwrap();
        assert!(guard.is_recovered());
        core::mem::forget(guard);
        bench.start(1, 2);
        assert!(
            c.try_lock().unwrap().is_recovered(),
            "a new life of the owner's core is enough"
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

    /// A life that attaches after its successor has attached, at once or frozen at any step of it:
    /// the successor keeps the lock that it holds. T-LOCK-3
    #[test]
    fn a_life_that_attaches_late_opens_no_lock() {
        for at in 0.. {
            let bench = Bench::new();
            let late = Life::new(0, 1).unwrap();
            bench.lives.announce(late).unwrap();
            let meanwhile = move || {
                let mut successor = bench.start(0, 2);
                core::mem::forget(successor.try_lock().unwrap());
            };
            let attach = || Lock::attach(bench.words, late, bench.lives);
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

    /// A waiting core that was killed and whose successor has not attached keeps nothing waiting.
    #[test]
    fn the_bit_of_a_dead_waiter_does_not_count_as_its_successors() {
        let bench = Bench::new();
        let (mut one, _two, mut three) = (bench.start(0, 1), bench.start(1, 1), bench.start(2, 1));
        drop(one.try_lock());
        one.token().fetch_or(waiting_bit(1), Ordering::Relaxed);
        assert!(three.try_lock().is_none(), "core 1 waits");
        bench.lives.announce(Life::new(1, 2).unwrap()).unwrap();
        assert!(three.try_lock().is_some(), "its successor does not");
    }

    /// An owner that releases and then dies, while another core is frozen at any step of its own
    /// attempt: the taker is told of no death.
    #[test]
    fn a_release_before_the_death_is_no_recovery_for_a_taker_frozen_at_every_step() {
        for at in 0.. {
            let bench = Bench::new();
            let [mut a, mut b] = [0, 1].map(|core| bench.start(core, 1));
            let held = a.try_lock().unwrap().into_guard().detach();
            let lives = bench.lives;
            let meanwhile = move || {
                drop(held);
                assert!(lives.mark_dead(Life::new(0, 1).unwrap()));
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

    /// T-LOCK-3: generations that are equal in the bits that a token has do not make the dead
    /// alive, whether the lives between them attach to the lock or not.
    #[test]
    fn a_dead_owner_is_replaced_after_any_number_of_lives() {
        for lives in [1, 3, 4, 15, 16, 17, 32, 64] {
            for attach_from in [2, lives, lives + 1, lives + 2] {
                let bench = Bench::new();
                let [mut a, mut b] = [0, 1].map(|core| bench.start(core, 1));
                core::mem::forget(a.try_lock().unwrap());
                for generation in 2..lives + 2 {
                    if generation >= attach_from {
                        bench.start(0, generation);
                    } else {
                        let life = Life::new(0, generation).unwrap();
                        bench.lives.announce(life).unwrap();
                    }
                }
                let recovered = b.try_lock().map(|acquired| acquired.is_recovered());
                assert_eq!(recovered, Some(true), "{lives} lives, {attach_from}");
            }
        }
    }

    /// T-LOCK-3: an owner killed at any step leaves a lock that the next taker gets.
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

    /// A waiting core killed at any step keeps nobody from the lock.
    #[test]
    fn a_waiter_killed_at_every_step_keeps_nobody_out() {
        for at in 0.. {
            let bench = Bench::new();
            let [mut a, mut b, mut c] = [0, 1, 2].map(|core| bench.start(core, 1));
            let guard = a.try_lock().unwrap();
            let done = kill_at(at, || assert_eq!(b.lock(3, |_| ()).unwrap_err(), TimedOut));
            drop(guard);
            // Before anyone knows of the death: patience.
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
            "and a successor waits only when it says so"
        );
    }

    /// A straggler: frozen at any step of its critical section, declared dead, replaced in all its
    /// words by a busy lock, thawed. It releases nothing that another holds.
    #[test]
    fn a_straggler_releases_nobody_elses_lock() {
        for lives in 1..RELEASED_LIVES as u32 {
            for at in 0..4 {
                let bench = Bench::new();
                let mut old = bench.start(0, 1);
                let mut other = bench.start(1, 1);
                let words = bench.words;
                let meanwhile = move || {
                    for generation in 2..=1 + lives {
                        drop(
                            Bench {
                                words,
                                lives: bench.lives,
                            }
                            .start(0, generation)
                            .try_lock(),
                        );
                    }
                    let mut new = Bench {
                        words,
                        lives: bench.lives,
                    }
                    .start(0, 1 + lives);
                    core::mem::forget(new.lock(PATIENCE + 2, |_| ()).unwrap());
                };
                let (_, hit) = freeze_at(at, meanwhile, || drop(old.try_lock()));
                if hit {
                    assert!(
                        other.try_lock().is_none(),
                        "{lives} lives later, frozen at {at}"
                    );
                }
            }
        }
    }

    /// T-LOCK-3: starvation is bounded. The lock goes round; a waiting core is passed twice at
    /// most.
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
        assert!(cores[1].try_lock().is_some(), "nobody waits any more");
    }

    /// T-LOCK-3: waiting is bounded, backs off, and reads.
    #[test]
    fn waiting_backs_off_and_ends() {
        let bench = Bench::new();
        let [mut a, mut b] = [0, 1].map(|core| bench.start(core, 1));
        let guard = a.try_lock().unwrap();
        let mut pauses = std::vec::Vec::new();
        let before = bench.token().load(Ordering::Relaxed);
        assert_eq!(b.lock(9, |pause| pauses.push(pause)).unwrap_err(), TimedOut);
        assert_eq!(pauses, [1, 2, 4, 8, 16, 32, 64, 64, 64]);
        assert_eq!(
            bench.token().load(Ordering::Relaxed),
            before,
            "it waits no more"
        );
        drop(guard);
    }

    /// The number of turns wraps around; a core that comes back exactly then does not hold a lock
    /// that its last release has released already.
    #[test]
    fn turns_wrap_around() {
        let bench = Bench::new();
        let [mut a, mut b] = [0, 1].map(|core| bench.start(core, 1));
        drop(b.try_lock());
        // All turns of a round but one later.
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
}
