//! Services the watchdog while a bootloader computes, because a signature check takes longer than
//! the window. Runs in the interrupt of the timer that ends the turns of the hart.

use crate::board::{VirtBoard, VirtSupply};
use crate::peripherals::now;
use crate::{hart, trap};
use core::sync::atomic::{AtomicU32, Ordering::Relaxed};
use tandem_board::{Board, CoreAddress, Duration, Instant, Supply, watchdog_answer};
use tandem_boot::{Keeper, first_service, next_service};

/// Time at which the bootloader must service the watchdog next, in microseconds (low word).
static DUE_US: AtomicU32 = AtomicU32::new(0);
/// Number of services in this incarnation.
static SERVED: AtomicU32 = AtomicU32::new(0);

fn now_us() -> u32 {
    (now().as_ns() / 1_000) as u32
}

/// Services the watchdog from an interrupt. Turns must be limited: see [`run`](crate::board::run).
#[derive(Debug)]
pub struct ByTimer(());

impl ByTimer {
    /// Starts the services. Core 0 calls this immediately after its start.
    #[must_use]
    pub fn new(board: &VirtBoard) -> Self {
        let first = first_service::<<VirtBoard as Board>::Supply>();
        DUE_US.store(
            now_us().wrapping_add((first.as_ns() / 1_000) as u32),
            Relaxed,
        );
        SERVED.store(0, Relaxed);
        trap::on_turn(board.identity().address().index(), Some(serve));
        Self(())
    }
}

/// Services the watchdog if it is due. Runs in the interrupt of core 0, or with interrupts off.
fn serve() {
    if now_us().wrapping_sub(DUE_US.load(Relaxed)).cast_signed() < 0 {
        return;
    }
    let Some(place) = CoreAddress::from_index(hart::number()) else {
        return;
    };
    let supply = VirtSupply(place);
    supply.service_watchdog(watchdog_answer(supply.watchdog_question()));
    SERVED.fetch_add(1, Relaxed);
    let next = next_service::<VirtSupply>();
    DUE_US.store(
        now_us().wrapping_add((next.as_ns() / 1_000) as u32),
        Relaxed,
    );
}

impl Keeper for ByTimer {
    /// Services the watchdog before the hart sleeps, because a sleeping hart has no turns.
    fn keep(&self) -> Instant {
        hart::without_interrupts(serve);
        let left = DUE_US.load(Relaxed).wrapping_sub(now_us());
        now() + Duration::from_us(left.into())
    }

    /// Waits until the window is open, because the application services the watchdog at its start.
    fn hand_over(&self) -> bool {
        hart::without_interrupts(|| trap::on_turn(hart::number(), None));
        let served = SERVED.load(Relaxed) > 0;
        let next = next_service::<VirtSupply>().as_ns() / 1_000;
        let last = DUE_US.load(Relaxed).wrapping_sub(next as u32);
        // 1 ms more, because the supply's clock may be slower.
        while served && now_us().wrapping_sub(last) < VirtSupply::WINDOW_OPENS_US + 1_000 {
            hart::yield_turn();
        }
        true
    }
}
