//! The lock: compare-and-swap, owner with generation, bounded waiting, recovery, fair turns.
//!
//! The lock is one cache line. Word 0 is the *token* of the last acquisition: the core that took
//! the lock, its incarnation, the turn (incremented by each acquisition), and which cores wait.
//! Words 1 to 12 are one *released* word for each core and incarnation (by its generation mod 4):
//! the owner releases the lock by storing its token there. So the lock is free if the token's owner
//! has released exactly that token, and a core takes it by one compare-and-swap from that token to
//! its own. Words 13 to 15 hold the incarnation of each core that attached last. T-LOCK-1, T-LOCK-3
//!
//! - **Release is a plain store, yet a straggler cannot release another core's lock**: it stores
//!   its old token into a word of its own incarnation. The next three incarnations of its core use
//!   other words.
//! - **Recovery**: a token that is not released and whose incarnation is not alive is an orphan.
//!   Any core may replace it by the same compare-and-swap, and gets [`Acquired::Recovered`]. The
//!   token has 4 bits of the generation; when an incarnation first attaches, it marks a token of an
//!   earlier incarnation with equal bits as an orphan.
//! - **Waiting** is test-and-test-and-set with bounded exponential back-off (T. E. Anderson, "The
//!   performance of spin lock alternatives", 1990): waiting cores read, and give up after the given
//!   number of polls.
//! - **Turns**: a waiting core sets its bit in the token. Only the waiting core that follows the
//!   last owner in the cyclic order 0, 1, 2 may take the lock. The token is one word, so the core
//!   that takes the lock has seen the bit, and the cyclic distance from the last owner to a waiting
//!   core shrinks with each turn: **others take the lock at most [`MAX_WAITED_TURNS`] = 2 times
//!   before a waiting core gets it**.
//! - A waiting core that does not poll (frozen, pre-empted, dead) would block the others. After
//!   [`PATIENCE`] polls of a free lock, a waiter takes it out of turn and clears the bit of the
//!   absent waiter. The bound above holds for cores that poll at least once in that time.
//!
//! Limit: the turn has 23 bits. If a core is stopped between its read of the token and its
//! compare-and-swap for exactly a multiple of 2^23 turns, and the last of them has the same owner,
//! it takes a lock that is held. At 100 ns a turn that is 0.8 s; the watchdog resets such a core.

use crate::incarnation::{Attached, CORES, Incarnation, Incarnations};
use crate::shape::{FitError, LINE_WORDS, fit_exactly};
use crate::sync::{AtomicU32, Ordering, fence};

/// Words of a lock.
pub const WORDS: usize = LINE_WORDS;

/// The largest number of turns that others take while a core waits and polls.
pub const MAX_WAITED_TURNS: u32 = CORES as u32 - 1;

/// After this many polls of a free lock, a waiting core takes it out of turn. With the back-off
/// below that is about 2000 spins (tens of microseconds), longer than any polling core needs.
pub const PATIENCE: u32 = 32;

/// The longest pause between two polls, in spins.
const MAX_PAUSE: u32 = 64;
/// Attempts to replace, when attaching, a token that an earlier incarnation of the core left. If
/// all fail, other cores have changed the token, so it is no longer the old one.
const DISOWN_ATTEMPTS: u32 = 16;

const TOKEN_AT: usize = 0;
/// Number of released words of each core: one for each of this many consecutive incarnations.
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

/// The core and generation bits of a token whose owner is dead: core 0 names no core.
const ORPHAN: u32 = GENERATION_MASK << GENERATION_SHIFT;

const _: () = assert!(CORES == 3 && MAX_WAITED_TURNS == 2 && ATTACHED_AT + CORES == WORDS);

/// Returns the core that the token names, or [`CORES`] if it names none.
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

/// Returns the index of the word in which this incarnation of the core releases.
const fn released_at(core: usize, generation: u32) -> usize {
    1 + core * RELEASED_LIVES + generation as usize % RELEASED_LIVES
}

/// This core could not take the lock within the given number of polls.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct LockTimedOut;

impl core::fmt::Display for LockTimedOut {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str("the lock was not free within the given number of polls")
    }
}

impl core::error::Error for LockTimedOut {}

/// Why one poll did not take the lock.
enum Missed {
    /// Another core holds the lock, or took it first.
    Held,
    /// The lock is free, but it is another core's turn.
    Passed { turn: u32 },
}

/// The lock as one incarnation of one core sees it. Several tasks of a core may each attach.
///
/// An interrupt handler may call only [`Lock::try_lock`]: [`Lock::lock`] could wait for the task
/// that the handler interrupted.
#[derive(Debug)]
pub struct Lock<'a> {
    words: &'a [AtomicU32; WORDS],
    /// The released word of this incarnation.
    own_released: &'a AtomicU32,
    attached: Attached<'a>,
    core: usize,
    /// Core and generation, shifted to their places in a token.
    identity: u32,
    /// The token of the last acquisition through this end, without waiting bits.
    mine: u32,
    #[cfg(loom)]
    patience: u32,
}

impl<'a> Lock<'a> {
    /// Attaches to the lock. `incarnation` must have been [announced](Incarnations::announce).
    /// Never blocks.
    ///
    /// # Errors
    /// [`FitError`] if the words are too few or not at a line boundary.
    pub(crate) fn attach(
        words: &'a [AtomicU32],
        incarnation: Incarnation,
        incarnations: Incarnations<'a>,
    ) -> Result<Self, FitError> {
        let words: &[AtomicU32; WORDS] = fit_exactly(words)?;
        let generations = words.last_chunk().ok_or(FitError::TooSmall)?;
        let generation = incarnation.generation() & GENERATION_MASK;
        let lock = Self {
            words,
            own_released: &words[released_at(incarnation.core(), generation)],
            attached: Attached::new(generations, incarnations),
            core: incarnation.core(),
            identity: (incarnation.core() as u32 + 1) | generation << GENERATION_SHIFT,
            mine: 0,
            #[cfg(loom)]
            patience: PATIENCE,
        };
        lock.disown_earlier_incarnations(incarnation);
        Ok(lock)
    }

    /// Sets the patience for loom models, in which 32 polls take too long.
    #[cfg(loom)]
    pub fn set_patience(&mut self, polls: u32) {
        self.patience = polls;
    }

    #[cfg_attr(not(loom), allow(clippy::unused_self, reason = "models have one each"))]
    const fn patience(&self) -> u32 {
        #[cfg(loom)]
        return self.patience;
        #[cfg(not(loom))]
        PATIENCE
    }

    /// Clears the waiting bit that an earlier incarnation of this core left, and marks a token as
    /// an orphan if its bits equal those of this incarnation.
    #[cold]
    fn disown_earlier_incarnations(&self, incarnation: Incarnation) {
        // An attempt fails only if the token changed: another core took the orphan or started or
        // stopped waiting, or an earlier incarnation attached late.
        for attempt in 1..=2 * DISOWN_ATTEMPTS {
            // Acquire pairs with the Release in `take`. The token is read before `earlier`: a token
            // from before this incarnation attached belongs to an earlier one.
            let token = self.token().load(Ordering::Acquire);
            let Some(earlier) = self.attached.earlier(incarnation) else {
                return;
            };
            let is_alike = token & (CORE_MASK | ORPHAN) == self.identity;
            let new = if is_alike && !self.is_released(token) {
                token & !CORE_MASK | ORPHAN
            } else {
                token
            } & !waiting_bit(self.core);
            let is_disowned = new == token || self.take(token, new) || attempt >= DISOWN_ATTEMPTS;
            if is_disowned && self.attached.insert(incarnation, earlier) {
                return;
            }
        }
    }

    #[inline]
    const fn token(&self) -> &'a AtomicU32 {
        &self.words[TOKEN_AT]
    }

    /// Replaces the token if it is still the expected one. Returns whether it did.
    #[inline]
    fn take(&self, expected: u32, new: u32) -> bool {
        // Release pairs with the Acquire in `look`: a core that sees this token sees that its owner
        // was announced and had attached. Acquire is not needed: `is_released` acquired the last
        // owner's writes, and the expected token shows that no other core took the lock since.
        self.token()
            .compare_exchange(expected, new, Ordering::Release, Ordering::Relaxed)
            .is_ok()
    }

    /// Takes the lock if it is free and no waiting core's turn is before this core's; otherwise
    /// returns `None`. Never blocks.
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

    /// Takes the lock, with at most `polls` polls. Between two polls it calls `relax(n)`, which
    /// should wait for the time of n spins (1 ..= 64): pass [`spin`](crate::sync::spin) on a core
    /// with its own CPU, and a function that yields on a shared CPU. Task context.
    ///
    /// # Errors
    /// [`LockTimedOut`] after `polls` polls.
    #[inline]
    pub fn lock(
        &mut self,
        polls: u32,
        relax: impl FnMut(u32),
    ) -> Result<Acquired<'_, 'a>, LockTimedOut> {
        if self.retake() {
            return Ok(Acquired::Clean(Guard {
                lock: self,
                waited: 0,
            }));
        }
        let (orphan, waited) = self.wait(polls, relax)?;
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

    /// Takes the lock quickly, if the token is still the one that this end released last (or if the
    /// lock was never taken).
    #[inline]
    fn retake(&mut self) -> bool {
        // Check: 2^23 turns later, another task of this core may hold the lock with this token.
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

    /// Waits for the lock and takes it. Returns whether its last owner died while holding it, and
    /// how many turns others took during the wait.
    #[cold]
    fn wait(
        &mut self,
        polls: u32,
        mut relax: impl FnMut(u32),
    ) -> Result<(bool, u32), LockTimedOut> {
        let own_bit = waiting_bit(self.core);
        let mut announced = None;
        let mut pause = 1;
        let mut passed = (0, 0);
        for _ in 0..polls {
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
                // Release pairs with the fence in `waiting_before`: a core that sees the bit sees
                // that this incarnation has attached, so that the bit counts.
                let token = self.token().fetch_or(own_bit, Ordering::Release);
                announced.get_or_insert(token & !(ONE_TURN - 1));
            }
            relax(pause);
            pause = (pause * 2).min(MAX_PAUSE);
        }
        self.token().fetch_and(!own_bit, Ordering::Relaxed);
        Err(LockTimedOut)
    }

    /// Polls once and takes the lock if it is free; `impatient` also takes it out of turn. Returns
    /// whether its last owner died while holding it.
    fn look(&mut self, impatient: bool) -> Result<bool, Missed> {
        let token = self.token().load(Ordering::Relaxed);
        let mut free = self.is_released(token);
        if !free {
            // Acquire pairs with the Release in `take`: a core that sees the token sees its owner's
            // announcement and attachment.
            fence(Ordering::Acquire);
            let bits = generation_of(token);
            if self
                .attached
                .is_alive(core_of(token), bits, GENERATION_MASK)
            {
                return Err(Missed::Held);
            }
            // The owner may have released the lock and died after the first read of its released
            // word. Its death was read with Acquire, so this second read sees the release.
            free = self.is_released(token);
        }
        let before = self.waiting_before(token);
        if before != 0 && !impatient {
            return Err(Missed::Passed {
                turn: token >> TURN_SHIFT,
            });
        }
        let mut mine = self.token_after(token);
        // After exactly 2^23 turns the new token equals the last released one: skip a turn.
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
            // 0: never taken. Any other token without a core is garbage, treated as an orphan.
            return token & !WAITING == 0;
        }
        // Acquire pairs with the Release in `Guard::drop`.
        let released = self.words[released_at(core, generation_of(token))].load(Ordering::Acquire);
        released == token & !WAITING
    }

    /// Returns the waiting bits of living cores whose turn is before this core's. A bit that an
    /// earlier incarnation left is ignored until its successor attaches and clears it.
    fn waiting_before(&self, token: u32) -> u32 {
        if token & WAITING & !waiting_bit(self.core) == 0 {
            return 0;
        }
        // Acquire pairs with the Release of the bit in `wait`.
        fence(Ordering::Acquire);
        let last = core_of(token);
        (last + 1..=last + CORES)
            .map(|core| core % CORES)
            .take_while(|&core| core != self.core)
            .filter(|&core| self.attached.has_living(core))
            .fold(0, |bits, core| bits | token & waiting_bit(core))
    }
}

/// The result of taking the lock.
#[derive(Debug)]
#[must_use = "dropping it releases the lock"]
pub enum Acquired<'l, 'a> {
    /// The last owner had released the lock.
    Clean(Guard<'l, 'a>),
    /// The last owner died while it held the lock: the data under the lock may be half-changed.
    /// Repair it; if this core dies too, the next owner gets `Recovered` again.
    Recovered(Guard<'l, 'a>),
}

impl<'l, 'a> Acquired<'l, 'a> {
    /// Returns the guard, for data that stays consistent even if an owner dies at any point.
    #[inline]
    pub fn into_guard(self) -> Guard<'l, 'a> {
        match self {
            Self::Clean(guard) | Self::Recovered(guard) => guard,
        }
    }

    /// Returns whether the last owner died while it held the lock.
    #[must_use]
    pub const fn is_recovered(&self) -> bool {
        matches!(self, Self::Recovered(_))
    }
}

/// Holds the lock; dropping it releases the lock.
#[derive(Debug)]
#[must_use = "dropping it releases the lock"]
pub struct Guard<'l, 'a> {
    lock: &'l mut Lock<'a>,
    /// How many turns others took while this end waited.
    waited: u32,
}

impl<'a> Guard<'_, 'a> {
    /// Returns how many turns others took after this core set its waiting bit.
    #[must_use]
    pub const fn waited_turns(&self) -> u32 {
        self.waited
    }

    /// Converts the guard to a value that does not borrow this end: for a caller that cannot hold a
    /// guard, such as C. Until that value is dropped, this end cannot take the lock again.
    #[inline]
    pub fn detach(self) -> Held<'a> {
        let guard = core::mem::ManuallyDrop::new(self);
        Held {
            released: guard.lock.own_released,
            token: guard.lock.mine,
        }
    }
}

/// Holds the lock as a [`Guard`] does, without borrowing the end that took it; dropping it releases
/// the lock.
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
mod tests;
