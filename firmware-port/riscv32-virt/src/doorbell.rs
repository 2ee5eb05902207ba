//! Sleeping until the doorbell or a deadline: race-free, and without taking the interrupt.

use crate::clint;
use crate::hart::{self, HARTS, MSI, MTI};
use crate::trap::{self, HartState};
use core::sync::atomic::Ordering::Relaxed;

/// Sleeps until this hart's doorbell has rung or `deadline` (in ticks) has passed, and consumes the
/// ring. Returns whether it was the doorbell. Task context, interrupts on.
///
/// Interrupts are switched off before the poll, so an interrupt between the poll and the sleep ends
/// the sleep: `wfi` wakes for every enabled interrupt, even while interrupts are off. A ring that
/// ends the sleep is consumed right here, which is cheaper than to take the interrupt.
#[inline]
pub fn wait(deadline: Option<u64>) -> bool {
    let number = hart::number() % HARTS;
    let state = &trap::STATES[number];
    hart::interrupts_off();
    hart::enable(MSI);
    let rung = loop {
        if hart::pending() & MSI != 0 {
            if clear(number, state) {
                // The reset is taken here, and does not return.
                hart::interrupts_on();
            }
            state.rung.store(false, Relaxed);
            break true;
        }
        if state.rung.load(Relaxed) {
            state.rung.store(false, Relaxed);
            break true;
        }
        match deadline {
            Some(deadline) if hart::time() >= deadline => break false,
            Some(deadline) => {
                clint::set_timer(number, deadline);
                hart::enable(MTI);
            }
            // The slicing timer need not wake a sleeping hart.
            None => hart::disable(MTI),
        }
        hart::sleep();
    };
    rearm(number, state);
    hart::interrupts_on();
    rung
}

/// Consumes a ring, if there was one, without sleeping.
pub fn take() -> bool {
    let number = hart::number() % HARTS;
    let pending = hart::pending() & MSI != 0;
    if pending {
        clear(number, &trap::STATES[number]);
    }
    trap::STATES[number].rung.swap(false, Relaxed) || pending
}

/// Clears the ring, unless it is a reset. The carrier's request is read afterwards: one that
/// arrives in between is either seen, or rings again. Returns whether it is a reset; then the
/// doorbell has been rung again, for the interrupt.
#[inline]
fn clear(number: usize, state: &HartState) -> bool {
    clint::clear(number);
    let reset = state.is_held();
    if reset {
        clint::post(number);
    }
    reset
}

/// Gives the timer back to the slicing, if there is any.
#[inline]
fn rearm(number: usize, state: &HartState) {
    match state.slice.load(Relaxed) {
        0 => hart::disable(MTI),
        ticks => {
            clint::set_timer(number, hart::time() + u64::from(ticks));
            hart::enable(MTI);
        }
    }
}

/// From now on this hart's turn ends after this many ticks, wherever it is; 0: no limit. See
/// [`hart::yield_turn`].
pub fn set_slice(ticks: u32) {
    let number = hart::number() % HARTS;
    let state = &trap::STATES[number];
    hart::without_interrupts(|| {
        state.slice.store(ticks, Relaxed);
        rearm(number, state);
    });
}

/// A hash of the places where the turns of a hart ended since the last call, and starts a new one.
/// The hart must not be slicing.
pub fn take_places(hart: usize) -> u32 {
    trap::STATES[hart % HARTS].places.swap(0, Relaxed)
}
