//! The interrupt handlers: a doorbell sets a flag, or calls the program's handler; a timer ends the
//! hart's turn.

use crate::hart::{HARTS, MSI, MTI};
use crate::{clint, hart};
use core::sync::atomic::{AtomicBool, AtomicPtr, AtomicU32, Ordering};

/// A handler: runs in interrupt context and never blocks.
pub type InterruptHandler = fn();

/// The state of one hart's handlers. On its own cache line.
#[repr(C, align(64))]
pub(crate) struct HartState {
    /// A doorbell arrived while this hart was awake.
    pub(crate) rung: AtomicBool,
    /// Length of a turn in ticks; 0: no limit.
    pub(crate) slice: AtomicU32,
    /// A hash of the places where this hart's turns ended.
    pub(crate) places: AtomicU32,
    /// Where the last turn ended, and how many turns in a row have ended there.
    ended_at: AtomicU32,
    repeats: AtomicU32,
    /// The carrier requests that this hart stand still.
    pub(crate) held: AtomicBool,
    /// Between two incarnations: one of the four below.
    incarnation: AtomicU32,
    on_doorbell: AtomicPtr<()>,
    on_turn: AtomicPtr<()>,
}

// Its first incarnation has not yet begun to stand still: 0.
/// Its last incarnation is over, and nothing of it runs.
const STANDS: u32 = 1;
/// The carrier releases it. The carrier may revoke that; the first to change the word succeeds.
const GOES: u32 = 2;
/// It runs.
const RUNS: u32 = 3;

impl HartState {
    #[inline]
    pub(crate) fn is_held(&self) -> bool {
        // Acquire pairs with the Release of the carrier.
        self.held.load(Ordering::Acquire)
    }
}

/// For each hart. It belongs to the carrier, because it outlives the image that a hart runs.
// SAFETY: the fields are atomics, of which zero is a value: a null pointer is no handler.
#[unsafe(link_section = ".bss.carrier.harts")]
pub(crate) static STATES: [HartState; HARTS] = unsafe { core::mem::zeroed() };

unsafe extern "C" {
    fn tandem_restart_hart(hart: usize) -> !;
}

/// This hart's function at its doorbell, in addition to recording the ring.
pub fn on_doorbell(handler: InterruptHandler) {
    STATES[hart::number() % HARTS]
        .on_doorbell
        .store(handler as *mut (), Ordering::Relaxed);
    hart::enable(MSI);
}

/// A hart's function at the end of each of its turns.
pub(crate) fn on_turn(hart: usize, handler: Option<InterruptHandler>) {
    let handler = handler.map_or(core::ptr::null_mut(), |handler| handler as *mut ());
    STATES[hart % HARTS]
        .on_turn
        .store(handler, Ordering::Relaxed);
}

/// Ends the incarnation of another hart at its next doorbell, which is rung here. Wait until it
/// [`stands`].
pub(crate) fn hold(hart: usize) {
    let state = &STATES[hart % HARTS];
    // Release pairs with the Acquire in `is_held`.
    state.held.store(true, Ordering::Release);
    // A hart that was released and has not started yet stays where it is.
    let taken_back =
        state
            .incarnation
            .compare_exchange(GOES, STANDS, Ordering::Relaxed, Ordering::Relaxed);
    if taken_back.is_err() {
        clint::post(hart);
    }
}

/// Whether a hart that is held stands still.
pub(crate) fn stands(hart: usize) -> bool {
    // Acquire pairs with the Release in `begin_held`.
    STATES[hart % HARTS].incarnation.load(Ordering::Acquire) == STANDS
}

/// Releases a hart that stands still.
pub(crate) fn release(hart: usize) {
    let state = &STATES[hart % HARTS];
    state.held.store(false, Ordering::Relaxed);
    // Release pairs with the Acquire in `sleep_while_held`: it sees all preparations.
    state.incarnation.store(GOES, Ordering::Release);
    clint::post(hart);
}

/// This hart stands from now on, with nothing of its last incarnation. Interrupts are off.
pub(crate) fn begin_held(hart: usize) {
    let state = &STATES[hart % HARTS];
    state.rung.store(false, Ordering::Relaxed);
    forget_handler(hart);
    hart::disable(MTI);
    hart::enable(MSI);
    // Release pairs with the Acquire in `stands`: the carrier never touches a running hart.
    state.incarnation.store(STANDS, Ordering::Release);
}

/// Sleeps until this hart is released. Interrupts are off.
pub(crate) fn sleep_while_held(hart: usize) {
    loop {
        clint::clear(hart);
        let incarnation = &STATES[hart % HARTS].incarnation;
        // Acquire pairs with the Release in `release`.
        let goes = incarnation.compare_exchange(GOES, RUNS, Ordering::Acquire, Ordering::Relaxed);
        if goes.is_ok() {
            return;
        }
        hart::sleep();
    }
}

/// This hart leaves its image: its handlers no longer run. Interrupts are off.
pub(crate) fn forget_handler(hart: usize) {
    let state = &STATES[hart % HARTS];
    state.slice.store(0, Ordering::Relaxed);
    for handler in [&state.on_doorbell, &state.on_turn] {
        handler.store(core::ptr::null_mut(), Ordering::Relaxed);
    }
}

/// Ends this incarnation if the carrier has requested that. For a doorbell's handler under an
/// operating system that has its own trap vector.
pub fn end_if_held() {
    let number = hart::number() % HARTS;
    end_if(number, &STATES[number]);
}

#[inline]
fn end_if(number: usize, state: &HartState) {
    if state.is_held() {
        // SAFETY: the incarnation that was interrupted is over: nothing of its stack is used again,
        // and what it shares with other harts are atomics.
        unsafe { tandem_restart_hart(number) };
    }
}

#[unsafe(no_mangle)]
extern "C" fn tandem_on_doorbell() {
    let number = hart::number() % HARTS;
    let state = &STATES[number];
    clint::clear(number);
    end_if(number, state);
    state.rung.store(true, Ordering::Relaxed);
    call(&state.on_doorbell);
}

#[inline]
fn call(handler: &AtomicPtr<()>) {
    let handler = handler.load(Ordering::Relaxed);
    if !handler.is_null() {
        // SAFETY: only `on_doorbell` and `on_turn` store here, and they store a `InterruptHandler`.
        let handler: InterruptHandler = unsafe { core::mem::transmute(handler) };
        handler();
    }
}

#[unsafe(no_mangle)]
extern "C" fn tandem_on_timer() {
    let number = hart::number() % HARTS;
    match STATES[number].slice.load(Ordering::Relaxed) {
        // The interrupt only had to end a sleep.
        0 => hart::disable(MTI),
        ticks => {
            let HartState {
                places,
                ended_at,
                repeats,
                ..
            } = &STATES[number];
            let place = hart::interrupted_at() as u32;
            let hash = places.load(Ordering::Relaxed) ^ place;
            // FNV-1a, by words.
            places.store(hash.wrapping_mul(0x0100_0193), Ordering::Relaxed);
            hart::yield_turn();
            call(&STATES[number].on_turn);
            // The timer of another hart may end this turn, and this hart's timer then expires while
            // the others run: short turns that keep step with each other make no progress. So a
            // hart that stays where it is gets longer turns.
            let stays = ended_at.load(Ordering::Relaxed) == place;
            let times = match stays {
                true => (repeats.load(Ordering::Relaxed) + 1).min(6),
                false => 0,
            };
            ended_at.store(place, Ordering::Relaxed);
            repeats.store(times, Ordering::Relaxed);
            clint::set_timer(number, hart::time() + (u64::from(ticks) << times));
        }
    }
}
