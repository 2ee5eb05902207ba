//! The lines between the systems.

use crate::barrier::{SETTLE, alternating, sleep, sleep_until, wait_for_peer, woken_until};
use crate::case::{CaseFailure, equal};
use tandem_board::{Board, CoreAddress, Duration, Edge, Line, Lines, SystemId};

/// Returns how many rising edges a system sends on a line.
fn rising(system: SystemId, line: Line) -> u32 {
    3 + 2 * line.index() as u32 + 7 * system.index() as u32
}

/// Returns how many falling edges a system sends on a line. If there is one falling edge fewer than
/// rising edges, the line ends high, otherwise low.
fn falling(system: SystemId, line: Line) -> u32 {
    rising(system, line) - u32::from(line != Line::Heartbeat1)
}

/// Both systems send different numbers of edges on each line; each counts all edges of the other.
pub(super) fn counter<B: Board>(board: &B, place: CoreAddress) -> Result<(), CaseFailure> {
    let lines = board.lines();
    for line in Line::ALL {
        for edge in 0..rising(place.system, line) + falling(place.system, line) {
            lines.send(line, alternating(edge));
        }
    }
    let peer = place.system.peer();
    sleep_until(board, "every edge on every line is counted", || {
        Line::ALL.iter().all(|line| {
            let seen = lines.received(*line, Edge::Rising) + lines.received(*line, Edge::Falling);
            seen >= rising(peer, *line) + falling(peer, *line)
        })
    })?;
    sleep(board, SETTLE)?;
    for line in Line::ALL {
        let [up, down] = [Edge::Rising, Edge::Falling].map(|edge| lines.received(line, edge));
        equal(
            up,
            rising(peer, line),
            "rising edges are counted, by line and direction",
        )?;
        equal(
            down,
            falling(peer, line),
            "falling edges are counted, by line and direction",
        )?;
    }
    Ok(())
}

const STARTS: u32 = 6;

/// Sends an edge on the start line each time the other system reports that it will sleep.
pub(super) fn starter<B: Board>(board: &B, _: CoreAddress) -> Result<(), CaseFailure> {
    for round in 0..STARTS {
        wait_for_peer(board, round + 1)?;
        sleep(board, Duration::from_ms(5))?;
        board.lines().send(Line::Start, alternating(round));
    }
    Ok(())
}

pub(super) fn started<B: Board>(board: &B, _: CoreAddress) -> Result<(), CaseFailure> {
    let lines = board.lines();
    for round in 0..STARTS {
        wait_for_peer(board, round + 1)?;
        woken_until(board, "an edge on the start line interrupts core 0", || {
            let rising = lines.received(Line::Start, Edge::Rising);
            rising + lines.received(Line::Start, Edge::Falling) > round
        })?;
    }
    equal(
        lines.received(Line::Start, Edge::Rising),
        STARTS / 2,
        "rising edges are counted",
    )?;
    equal(
        lines.received(Line::Start, Edge::Falling),
        STARTS / 2,
        "falling edges are counted",
    )
}

pub(super) fn level<B: Board>(board: &B, _: CoreAddress) -> Result<(), CaseFailure> {
    wait_for_peer(board, 1)?;
    for _ in 0..10 {
        let high = board.lines().peer_powered();
        equal(
            u32::from(high),
            1_u32,
            "the level line of a system that runs is high",
        )?;
    }
    wait_for_peer(board, 2)
}
