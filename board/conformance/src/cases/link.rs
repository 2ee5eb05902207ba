//! The data link between the systems.

use crate::barrier::{SETTLE, sleep, sleep_until, wait_for_peer};
use crate::case::{CaseFailure, check, equal};
use tandem_board::{Board, CoreAddress, Link};

/// Buffer size for all cases, in words: more than the longest datagram of any board's link.
const WORDS: usize = 256;

/// Returns word `index` of datagram `number` from system `from`.
fn content(from: usize, number: u32, index: usize) -> u32 {
    (number ^ (from as u32) << 31)
        .wrapping_mul(0x9E37_79B1)
        .wrapping_add(index as u32)
}

/// Returns the length of datagram `number`, from one word to the maximum, in mixed order.
fn length<L: Link>(number: u32) -> usize {
    let most = L::MAX_WORDS.min(WORDS);
    1 + (number as usize * 7) % most
}

/// Sends datagram `number`; returns whether there was room.
fn send<B: Board>(board: &B, from: usize, number: u32) -> bool {
    let words: [u32; WORDS] = core::array::from_fn(|index| content(from, number, index));
    board
        .link()
        .try_send(&words[..length::<B::Link>(number)])
        .is_ok()
}

/// Receives datagram `number` if it has arrived; returns whether it had.
#[track_caller]
fn fetch<B: Board>(board: &B, from: usize, number: u32) -> Result<bool, CaseFailure> {
    let mut words = [0; WORDS];
    let Some(len) = board.link().try_receive(&mut words) else {
        return Ok(false);
    };
    equal(
        words[0],
        content(from, number, 0),
        "datagrams come in order, and all of them",
    )?;
    equal(
        len as u64,
        length::<B::Link>(number) as u64,
        "a datagram has the length it was sent with",
    )?;
    for (index, word) in words[..len].iter().enumerate() {
        equal(
            *word,
            content(from, number, index),
            "a datagram comes whole",
        )?;
    }
    Ok(true)
}

/// T-CHIP-5: both systems send and receive at the same time.
pub(super) fn order<B: Board>(board: &B, place: CoreAddress) -> Result<(), CaseFailure> {
    const DATAGRAMS: u32 = 300;
    let own = place.system.index();
    let peer = place.system.peer().index();
    check(
        B::Link::MAX_WORDS >= 8,
        "a datagram can have 8 words at least",
    )?;
    wait_for_peer(board, 1)?;
    let (mut sent, mut fetched) = (0, 0);
    let mut broken = Ok(());
    sleep_until(board, "all datagrams come", || {
        while sent < DATAGRAMS && send(board, own, sent) {
            sent += 1;
        }
        while fetched < DATAGRAMS && broken.is_ok() {
            match fetch(board, peer, fetched) {
                Ok(true) => fetched += 1,
                Ok(false) => break,
                Err(failure) => broken = Err(failure),
            }
        }
        broken.is_err() || (sent == DATAGRAMS && fetched == DATAGRAMS)
    })?;
    broken?;
    wait_for_peer(board, 2)
}

/// Sends until the link is full, while the other system receives nothing.
pub(super) fn filler<B: Board>(board: &B, place: CoreAddress) -> Result<(), CaseFailure> {
    const MANY: u32 = 100_000;
    wait_for_peer(board, 1)?;
    let mut sent = 0;
    while send(board, place.system.index(), sent) {
        sent += 1;
        check(sent < MANY, "a link that is not emptied fills up")?;
    }
    check(sent > 0, "an empty link has room")?;
    wait_for_peer(board, 2)?;
    // The next datagram contains the number of datagrams before it.
    sleep_until(board, "a link that is emptied has room", || {
        board.link().try_send(&[u32::MAX, sent]).is_ok()
    })
}

pub(super) fn drainer<B: Board>(board: &B, place: CoreAddress) -> Result<(), CaseFailure> {
    let peer = place.system.peer().index();
    wait_for_peer(board, 1)?;
    wait_for_peer(board, 2)?;
    let mut words = [0; WORDS];
    let mut fetched = 0_u32;
    let mut said = None;
    let mut in_order = true;
    sleep_until(board, "what was taken comes", || {
        while let Some(len) = board.link().try_receive(&mut words) {
            if len == 2 && words[0] == u32::MAX {
                said = Some(words[1]);
                return true;
            }
            in_order &= words[0] == content(peer, fetched, 0);
            fetched += 1;
        }
        false
    })?;
    equal(
        fetched,
        said.unwrap_or(0),
        "the link takes nothing that it then loses",
    )?;
    check(in_order, "what a full link had taken comes in order")?;
    sleep(board, SETTLE)?;
    check(
        board.link().try_receive(&mut words).is_none(),
        "what a full link refused does not come",
    )
}

pub(super) fn long_sender<B: Board>(board: &B, _: CoreAddress) -> Result<(), CaseFailure> {
    wait_for_peer(board, 1)?;
    for base in [10, 20] {
        let words: [u32; 8] = core::array::from_fn(|index| base + index as u32);
        sleep_until(board, "the link has room", || {
            board.link().try_send(&words).is_ok()
        })?;
    }
    Ok(())
}

/// Receives the first datagram into a buffer that is too short.
pub(super) fn short_receiver<B: Board>(board: &B, _: CoreAddress) -> Result<(), CaseFailure> {
    wait_for_peer(board, 1)?;
    let mut short = [0; 3];
    sleep_until(board, "a datagram comes", || {
        board.link().try_receive(&mut short).is_some()
    })?;
    check(
        short == [10, 11, 12],
        "a short buffer gets the beginning of a datagram",
    )?;
    let mut words = [0; 8];
    sleep_until(board, "the next datagram comes", || {
        board.link().try_receive(&mut words).is_some()
    })?;
    equal(words[0], 20_u32, "what does not fit is cut off")
}
