//! The interrupt handlers: the doorbell sets a flag and calls the program's handler; the timer ends
//! the hart's turn.

use crate::hart::{DOORBELL, HARTS, TIMER};
use crate::{hart, interrupts};
use core::sync::atomic::{AtomicBool, AtomicPtr, AtomicU32, Ordering};

/// A handler, which runs in interrupt context and must never block.
pub type InterruptHandler = fn();

/// The state of one hart's handlers, on its own cache line.
#[repr(C, align(64))]
pub(crate) struct HartState {
    /// Whether the doorbell rang while this hart was awake.
    pub(crate) rung: AtomicBool,
    /// Length of a turn in ticks; 0 means no limit.
    pub(crate) slice: AtomicU32,
    /// A hash of the code addresses at which this hart's turns ended.
    pub(crate) places: AtomicU32,
    /// The code address where the last turn ended, and its repetitions in a row (at most 6).
    ended_at: AtomicU32,
    repeats: AtomicU32,
    /// Whether the carrier requests that this hart stop.
    pub(crate) held: AtomicBool,
    /// The state of the hart's incarnation: 0, [`STANDS`], [`GOES`] or [`RUNS`].
    incarnation: AtomicU32,
    on_doorbell: AtomicPtr<()>,
    on_turn: AtomicPtr<()>,
}

// 0: the machine has started, and the hart has not yet stopped for the first time.
/// The hart is stopped: its last incarnation is over, and none of its code runs.
const STANDS: u32 = 1;
/// The carrier has released the hart, which has not started yet. The carrier may still revoke the
/// release: the first to change the word succeeds.
const GOES: u32 = 2;
/// The hart runs.
const RUNS: u32 = 3;

impl HartState {
    #[inline]
    pub(crate) fn is_held(&self) -> bool {
        // Acquire pairs with the Release of the carrier.
        self.held.load(Ordering::Acquire)
    }
}

/// The state of each hart, in the carrier's memory, because it outlives the image of a hart.
// SAFETY: the fields are atomics, for which zero is valid: a null pointer means no handler.
#[unsafe(link_section = ".bss.carrier.harts")]
pub(crate) static STATES: [HartState; HARTS] = unsafe { core::mem::zeroed() };

unsafe extern "C" {
    fn tandem_restart_hart(hart: usize) -> !;
}

/// Sets the function that runs at this hart's doorbell, after the ring is recorded.
pub fn on_doorbell(handler: InterruptHandler) {
    STATES[hart::number() % HARTS]
        .on_doorbell
        .store(handler as *mut (), Ordering::Relaxed);
    hart::enable(DOORBELL);
}

/// Sets the function that runs at the end of each turn of a hart; `None` for no function.
pub fn on_turn(hart: usize, handler: Option<InterruptHandler>) {
    let handler = handler.map_or(core::ptr::null_mut(), |handler| handler as *mut ());
    STATES[hart % HARTS]
        .on_turn
        .store(handler, Ordering::Relaxed);
}

/// Stops another hart: rings its doorbell, and the handler there ends its incarnation. Then wait
/// until the hart [`stands`].
pub(crate) fn hold(hart: usize) {
    let state = &STATES[hart % HARTS];
    // Release pairs with the Acquire in `is_held`.
    state.held.store(true, Ordering::Release);
    // A hart that was released and has not started yet stays stopped.
    let taken_back =
        state
            .incarnation
            .compare_exchange(GOES, STANDS, Ordering::Relaxed, Ordering::Relaxed);
    if taken_back.is_err() {
        interrupts::post(hart);
    }
}

/// Returns whether a hart that is held has stopped.
pub(crate) fn stands(hart: usize) -> bool {
    // Acquire pairs with the Release in `begin_held`.
    STATES[hart % HARTS].incarnation.load(Ordering::Acquire) == STANDS
}

/// Releases a hart that has stopped.
pub(crate) fn release(hart: usize) {
    let state = &STATES[hart % HARTS];
    state.held.store(false, Ordering::Relaxed);
    // Release pairs with the Acquire in `sleep_while_held`: the hart sees all preparations.
    state.incarnation.store(GOES, Ordering::Release);
    interrupts::post(hart);
}

/// Marks this hart as stopped, and clears the state of its last incarnation. Interrupts are off.
pub(crate) fn begin_held(hart: usize) {
    let state = &STATES[hart % HARTS];
    state.rung.store(false, Ordering::Relaxed);
    forget_handler(hart);
    hart::disable(TIMER);
    hart::enable(DOORBELL);
    // Release pairs with the Acquire in `stands`: the carrier sees the end of the incarnation.
    state.incarnation.store(STANDS, Ordering::Release);
}

/// Sleeps until this hart is released. Interrupts are off.
pub(crate) fn sleep_while_held(hart: usize) {
    loop {
        interrupts::clear(hart);
        let incarnation = &STATES[hart % HARTS].incarnation;
        // Acquire pairs with the Release in `release`.
        let goes = incarnation.compare_exchange(GOES, RUNS, Ordering::Acquire, Ordering::Relaxed);
        if goes.is_ok() {
            return;
        }
        hart::sleep();
    }
}

/// Removes this hart's handlers, before the hart leaves its image. Interrupts are off.
pub(crate) fn forget_handler(hart: usize) {
    let state = &STATES[hart % HARTS];
    state.slice.store(0, Ordering::Relaxed);
    for handler in [&state.on_doorbell, &state.on_turn] {
        handler.store(core::ptr::null_mut(), Ordering::Relaxed);
    }
}

/// Ends this incarnation if the carrier has requested it. For the doorbell handler of an operating
/// system with its own trap vector.
pub fn end_if_held() {
    let number = hart::number() % HARTS;
    end_if(number, &STATES[number]);
}

#[inline]
fn end_if(number: usize, state: &HartState) {
    if state.is_held() {
        // SAFETY: the interrupted incarnation is over: no code uses its stack again, and it shares
        // only atomics with other harts.
        unsafe { tandem_restart_hart(number) };
    }
}

#[unsafe(no_mangle)]
extern "C" fn tandem_on_doorbell() {
    let number = hart::number() % HARTS;
    let state = &STATES[number];
    interrupts::clear(number);
    end_if(number, state);
    state.rung.store(true, Ordering::Relaxed);
    call(&state.on_doorbell);
}

#[inline]
fn call(handler: &AtomicPtr<()>) {
    let handler = handler.load(Ordering::Relaxed);
    if !handler.is_null() {
        // SAFETY: only `on_doorbell` and `on_turn` store here; both store an `InterruptHandler`.
        let handler: InterruptHandler = unsafe { core::mem::transmute(handler) };
        handler();
    }
}

#[unsafe(no_mangle)]
extern "C" fn tandem_on_timer() {
    let number = hart::number() % HARTS;
    match STATES[number].slice.load(Ordering::Relaxed) {
        // The interrupt only ended a sleep.
        0 => hart::disable(TIMER),
        ticks => {
            let HartState {
                places,
                ended_at,
                repeats,
                ..
            } = &STATES[number];
            let place = hart::interrupted_at() as u32;
            let hash = places.load(Ordering::Relaxed) ^ place;
            // FNV-1a, word by word.
            places.store(hash.wrapping_mul(0x0100_0193), Ordering::Relaxed);
            hart::yield_turn();
            call(&STATES[number].on_turn);
            // The timer of another hart may end this turn, and this hart's timer then expires while
            // the others run: short turns in step with each other make no progress. So if a hart's
            // turns repeatedly end at one address, the turns become longer.
            let stays = ended_at.load(Ordering::Relaxed) == place;
            let times = match stays {
                true => (repeats.load(Ordering::Relaxed) + 1).min(6),
                false => 0,
            };
            ended_at.store(place, Ordering::Relaxed);
            repeats.store(times, Ordering::Relaxed);
            interrupts::set_timer(number, hart::time() + (u64::from(ticks) << times));
        }
    }
}
