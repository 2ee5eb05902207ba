//! Waits for the doorbell or a deadline, without a race and without taking the interrupt.

use crate::hart::{self, DOORBELL, HARTS, TIMER};
use crate::interrupts;
use crate::trap::{self, HartState};
use core::sync::atomic::Ordering::Relaxed;

/// Sleeps until this hart's doorbell has rung or `deadline` (in ticks) has passed, and consumes the
/// ring. Returns whether the doorbell rang. Task context, interrupts on.
///
/// Interrupts are switched off before the poll, so an interrupt between the poll and the sleep ends
/// the sleep: `wfi` wakes for every enabled interrupt, even while interrupts are off. A ring that
/// ends the sleep is consumed here, which is cheaper than taking the interrupt.
#[inline]
pub fn wait(deadline: Option<u64>) -> bool {
    let number = hart::number() % HARTS;
    let state = &trap::STATES[number];
    hart::interrupts_off();
    // With interrupts off no handler records a ring, so the loop below need not look for one.
    let rung = if state.rung.load(Relaxed) {
        state.rung.store(false, Relaxed);
        clear(number, state);
        true
    } else {
        sleep(number, state, deadline)
    };
    rearm(number, state);
    hart::interrupts_on();
    rung
}

/// Sleeps until this hart's doorbell has rung, and consumes the ring, or until `deadline` has
/// passed. Returns whether the doorbell rang. Interrupts are off.
#[inline]
fn sleep(number: usize, state: &HartState, deadline: Option<u64>) -> bool {
    hart::enable(DOORBELL);
    while hart::pending() & DOORBELL == 0 {
        match deadline {
            Some(deadline) if hart::time() >= deadline => return false,
            Some(deadline) => {
                interrupts::set_timer(number, deadline);
                hart::enable(TIMER);
            }
            // The timer that ends turns need not wake a sleeping hart.
            None => hart::disable(TIMER),
        }
        hart::sleep();
    }
    clear(number, state);
    true
}

/// Consumes a ring without sleeping. Returns whether there was one.
pub fn take() -> bool {
    let number = hart::number() % HARTS;
    let pending = hart::pending() & DOORBELL != 0;
    if pending {
        clear(number, &trap::STATES[number]);
    }
    trap::STATES[number].rung.swap(false, Relaxed) || pending
}

/// Clears the ring, then reads whether the carrier requests a reset. A request that arrives after
/// the clear is read here, or rings the doorbell again. If there is a request, rings the doorbell
/// again, so that the interrupt handler runs as soon as interrupts are on: it resets the hart and
/// does not return.
#[inline]
fn clear(number: usize, state: &HartState) {
    interrupts::clear(number);
    if state.is_held() {
        interrupts::post(number);
    }
}

/// Sets the timer to the end of this hart's turn, or disables it if turns have no limit.
#[inline]
fn rearm(number: usize, state: &HartState) {
    match state.slice.load(Relaxed) {
        0 => hart::disable(TIMER),
        ticks => {
            interrupts::set_timer(number, hart::time() + u64::from(ticks));
            hart::enable(TIMER);
        }
    }
}

/// Limits the turns of this hart to this many ticks from now on; 0 means no limit. See
/// [`hart::yield_turn`].
pub fn set_slice(ticks: u32) {
    let number = hart::number() % HARTS;
    let state = &trap::STATES[number];
    hart::without_interrupts(|| {
        state.slice.store(ticks, Relaxed);
        rearm(number, state);
    });
}

/// Returns a hash of the code addresses at which the turns of a hart have ended since the last
/// call, and starts a new hash. The turns of the hart must have no limit during the call.
pub fn take_places(hart: usize) -> u32 {
    trap::STATES[hart % HARTS].places.swap(0, Relaxed)
}
