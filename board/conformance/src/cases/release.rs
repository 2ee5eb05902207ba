//! Core 0 starts alone and releases the other cores. T-BOOT-2

use crate::barrier::{PATIENCE, SETTLE, word};
use crate::case::{CaseFailure, check, equal};
use crate::cases::supply::{expect_reset, is_first_incarnation, middle, serve};
use core::sync::atomic::{AtomicU32, Ordering};
use tandem_board::{Board, CoreAddress, CoreId, Duration, Instant, ResetRequest, Supply};

/// Counter that a released core increments while it runs.
fn steps<B: Board>(board: &B, core: CoreId) -> &AtomicU32 {
    word(board, core.index())
}

/// Counts the starts of a core.
fn begins<B: Board>(board: &B, core: CoreId) -> &AtomicU32 {
    word(board, CoreId::COUNT + core.index())
}

/// Core 0, which services the watchdog while it waits.
struct Servant<'b, B> {
    board: &'b B,
    next_service: Instant,
}

impl<B: Board> Servant<'_, B> {
    /// Waits for `holds` for at most `span`, and returns whether it became true.
    fn until(&mut self, span: Duration, mut holds: impl FnMut() -> bool) -> bool {
        let limit = self.board.now() + span;
        while !holds() {
            let now = self.board.now();
            if now >= limit {
                return false;
            }
            if now >= self.next_service {
                serve(self.board);
                self.next_service = self.board.now() + middle::<B::Supply>();
            }
            let look = now + Duration::from_ms(1);
            self.board.wait(limit.min(self.next_service).min(look));
        }
        true
    }
}

/// Role of core 0 in a case about another core: that core is already released.
pub(super) fn nothing_more<B: Board>(_: &B, _: CoreAddress) -> Result<(), CaseFailure> {
    Ok(())
}

/// T-CHIP-2: in each of two incarnations, core 0 runs alone, then with core 2, then with all.
pub(super) fn releases<B: Board>(board: &B, _: CoreAddress) -> Result<(), CaseFailure> {
    const OTHERS: [CoreId; 2] = [CoreId::PLANNING, CoreId::PERCEPTION];
    let ran = |core: CoreId| steps(board, core).load(Ordering::Acquire) != 0;
    let next_service = board.now();
    let mut servant = Servant {
        board,
        next_service,
    };
    for core in OTHERS {
        steps(board, core).store(0, Ordering::Relaxed);
        begins(board, core).store(0, Ordering::Relaxed);
    }
    let generation = board.identity().generation.0;
    steps(board, CoreId::CONTROL).store(generation, Ordering::Relaxed);
    let early = servant.until(SETTLE, || OTHERS.into_iter().any(ran));
    check(!early, "a core stands still until core 0 releases it")?;
    for (index, core) in OTHERS.into_iter().enumerate() {
        board.release_core(core);
        let runs = servant.until(PATIENCE, || ran(core));
        check(runs, "a core that core 0 releases runs")?;
        let others = &OTHERS[index + 1..];
        check(
            !others.iter().any(|other| ran(*other)),
            "a release is of one core",
        )?;
    }
    board.release_core(CoreId::PLANNING);
    servant.until(SETTLE, || false);
    for core in OTHERS {
        let begun = begins(board, core).load(Ordering::Acquire);
        equal(
            begun,
            1_u32,
            "a core begins once in each incarnation of its system",
        )?;
    }
    if is_first_incarnation(board) {
        board.supply().request_reset(ResetRequest::Software);
        return expect_reset(board, "a reset that was asked for comes");
    }
    Ok(())
}

/// Counts its start, then counts steps until a reset; in the second incarnation only a few steps.
pub(super) fn released<B: Board>(board: &B, place: CoreAddress) -> Result<(), CaseFailure> {
    equal(
        board.identity().generation.0,
        steps(board, CoreId::CONTROL).load(Ordering::Relaxed),
        "a released core begins the incarnation of its system",
    )?;
    begins(board, place.core).fetch_add(1, Ordering::Relaxed);
    let limit = board.now() + PATIENCE;
    while board.now() < limit {
        // Release pairs with Acquire on core 0: with the first step, core 0 also sees the start.
        let count = steps(board, place.core).fetch_add(1, Ordering::Release);
        if count > 20 && !is_first_incarnation(board) {
            break;
        }
        board.wait(board.now() + Duration::from_ms(1));
    }
    Ok(())
}
