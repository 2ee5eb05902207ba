//! The data flash.

use crate::barrier::{PATIENCE, sleep, sleep_until};
use crate::case::{CaseFailure, check, equal, fail};
use tandem_board::{Board, CoreAddress, DataFlash, FlashError, FlashStatus, ResetRequest, Supply};

/// The largest page, in bytes, that the suite can program.
const PAGE: usize = 64;

fn page<F: DataFlash>() -> usize {
    (F::PAGE_BYTES as usize).min(PAGE)
}

#[track_caller]
fn idle<B: Board>(board: &B) -> Result<(), CaseFailure> {
    let mut failed = false;
    sleep_until(board, "a flash operation ends", || {
        failed = board.flash().status() == FlashStatus::Failed;
        failed || board.flash().status() == FlashStatus::Idle
    })?;
    check(!failed, "a flash operation succeeds")
}

#[track_caller]
fn erase<B: Board>(board: &B, sector: u32) -> Result<(), CaseFailure> {
    check(
        board.flash().start_erase(sector).is_ok(),
        "an idle flash takes an erase",
    )?;
    idle(board)
}

/// Checks that every byte of `sector` outside `pages` is 0xFF.
#[track_caller]
fn erased_but<B: Board>(board: &B, sector: u32, pages: &[u32]) -> Result<(), CaseFailure> {
    let page_bytes = B::Flash::PAGE_BYTES;
    for number in (0..B::Flash::SECTOR_BYTES / page_bytes).filter(|n| !pages.contains(n)) {
        let mut bytes = [0; PAGE];
        let bytes = &mut bytes[..page::<B::Flash>()];
        let offset = sector * B::Flash::SECTOR_BYTES + number * page_bytes;
        check(
            board.flash().read(offset, bytes).is_ok(),
            "an idle flash can be read",
        )?;
        for byte in bytes {
            equal(
                *byte,
                0xFF_u8,
                "a byte that was erased and not programmed is 0xFF",
            )?;
        }
    }
    Ok(())
}

fn data(number: u32) -> [u8; PAGE] {
    let first = number as u8;
    core::array::from_fn(|index| {
        first
            .wrapping_mul(31)
            .wrapping_add((index as u8).wrapping_mul(5))
    })
}

#[track_caller]
fn holds<B: Board>(board: &B, offset: u32, expected: &[u8]) -> Result<(), CaseFailure> {
    let mut bytes = [0; PAGE];
    let bytes = &mut bytes[..expected.len()];
    check(
        board.flash().read(offset, bytes).is_ok(),
        "an idle flash can be read",
    )?;
    for (seen, expected) in bytes.iter().zip(expected) {
        equal(*seen, *expected, "what was programmed is read")?;
    }
    Ok(())
}

pub(super) fn erase_program<B: Board>(board: &B, _: CoreAddress) -> Result<(), CaseFailure> {
    let (page_bytes, sector_bytes) = (B::Flash::PAGE_BYTES, B::Flash::SECTOR_BYTES);
    let last = sector_bytes / page_bytes - 1;
    check(B::Flash::SECTORS >= 2, "the flash has two sectors at least")?;
    check(page_bytes as usize <= PAGE, "the suite can program a page")?;
    for sector in 0..B::Flash::SECTORS {
        erase(board, sector)?;
        erased_but(board, sector, &[])?;
    }
    let pages = [0, 5, last];
    for number in pages {
        let offset = sector_bytes + number * page_bytes;
        let started = board
            .flash()
            .start_program(offset, &data(number)[..page_bytes as usize]);
        check(started.is_ok(), "an idle flash takes a page")?;
        idle(board)?;
    }
    for number in pages {
        let expected = &data(number)[..page_bytes as usize];
        holds(board, sector_bytes + number * page_bytes, expected)?;
    }
    erased_but(board, 1, &pages)?;
    erased_but(board, 0, &[])?;
    erase(board, 1)?;
    erased_but(board, 1, &[])
}

/// An operation that does not cover whole pages inside the flash is refused, and changes nothing.
pub(super) fn ranges<B: Board>(board: &B, _: CoreAddress) -> Result<(), CaseFailure> {
    let (page_bytes, sector_bytes) = (B::Flash::PAGE_BYTES, B::Flash::SECTOR_BYTES);
    let size = sector_bytes * B::Flash::SECTORS;
    erase(board, 0)?;
    let zeros = [0; 2 * PAGE];
    let whole = page::<B::Flash>();
    let refused = Err(FlashError::OutOfRange);
    let flash = board.flash();
    let page = &zeros[..whole];
    let last = u32::MAX - (page_bytes - 1);
    for (answer, what) in [
        (
            flash.start_program(page_bytes / 2, page),
            "an offset that is not aligned is refused",
        ),
        (
            flash.start_program(0, &zeros[..whole / 2]),
            "a part of a page is refused",
        ),
        (
            flash.start_program(sector_bytes - page_bytes, &zeros[..2 * whole]),
            "programming across a sector's end is refused",
        ),
        (
            flash.start_program(size, page),
            "programming outside the flash is refused",
        ),
        (
            flash.start_program(last, page),
            "an offset whose end wraps around is refused",
        ),
        (
            flash.start_erase(B::Flash::SECTORS),
            "an erase outside is refused",
        ),
        (flash.read(size, &mut [0]), "a read outside is refused"),
        (
            flash.read(size - 1, &mut [0; 2]),
            "a read past the end is refused",
        ),
    ] {
        check(answer == refused, what)?;
    }
    idle(board)?;
    erased_but(board, 0, &[])
}

/// Starts a page while the previous one may still be in progress: both must end up programmed.
pub(super) fn one_at_a_time<B: Board>(board: &B, _: CoreAddress) -> Result<(), CaseFailure> {
    let page_bytes = B::Flash::PAGE_BYTES;
    erase(board, 0)?;
    for number in 0..16 {
        let bytes = data(number);
        let bytes = &bytes[..page_bytes as usize];
        let mut started = Err(FlashError::Busy);
        sleep_until(board, "the flash becomes ready", || {
            started = board.flash().start_program(number * page_bytes, bytes);
            started != Err(FlashError::Busy)
        })?;
        check(
            started.is_ok(),
            "a flash that cannot start now says that it is busy",
        )?;
    }
    idle(board)?;
    for number in 0..16 {
        holds(
            board,
            number * page_bytes,
            &data(number)[..page_bytes as usize],
        )?;
    }
    Ok(())
}

/// A page programmed twice without an erase holds the bits that were set both times.
pub(super) fn no_erase<B: Board>(board: &B, _: CoreAddress) -> Result<(), CaseFailure> {
    let page_bytes = B::Flash::PAGE_BYTES as usize;
    erase(board, 0)?;
    for number in [3, 4] {
        let started = board.flash().start_program(0, &data(number)[..page_bytes]);
        check(started.is_ok(), "a page can be programmed again")?;
        idle(board)?;
    }
    let mut both = data(3);
    for (byte, second) in both.iter_mut().zip(data(4)) {
        *byte &= second;
    }
    holds(board, 0, &both[..page_bytes])?;
    erased_but(board, 0, &[0])
}

/// First incarnation: is reset while a page is programmed. Second incarnation: the adjacent pages
/// are intact, and the sector can be used again.
pub(super) fn interrupted<B: Board>(board: &B, _: CoreAddress) -> Result<(), CaseFailure> {
    let page_bytes = B::Flash::PAGE_BYTES;
    let page = |number| (number * page_bytes, data(number));
    let start = |number| {
        let (offset, bytes) = page(number);
        let started = board
            .flash()
            .start_program(offset, &bytes[..page_bytes as usize]);
        check(started.is_ok(), "an idle flash takes a page")
    };
    if board.identity().generation.0 == 1 {
        erase(board, 0)?;
        for number in [1, 3] {
            start(number)?;
            idle(board)?;
        }
        start(2)?;
        board.supply().request_reset(ResetRequest::Software);
        sleep(board, PATIENCE)?;
        return fail("a reset that was asked for comes");
    }
    idle(board)?;
    for number in [1, 3] {
        let (offset, bytes) = page(number);
        holds(board, offset, &bytes[..page_bytes as usize])?;
    }
    erased_but(board, 0, &[1, 2, 3])?;
    erase(board, 0)?;
    erased_but(board, 0, &[])
}

/// First incarnation: programs a page and requests a reset. Second incarnation: reads the page.
pub(super) fn durable<B: Board>(board: &B, _: CoreAddress) -> Result<(), CaseFailure> {
    let page = &data(7)[..B::Flash::PAGE_BYTES as usize];
    let offset = B::Flash::SECTOR_BYTES;
    if board.identity().generation.0 == 1 {
        erase(board, 1)?;
        check(
            board.flash().start_program(offset, page).is_ok(),
            "an idle flash takes a page",
        )?;
        idle(board)?;
        board.supply().request_reset(ResetRequest::Software);
        sleep(board, PATIENCE)?;
        return fail("a reset that was asked for comes");
    }
    holds(board, offset, page)
}
