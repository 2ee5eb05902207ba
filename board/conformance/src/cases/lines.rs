//! The lines between the systems.

use super::supply::{is_first_incarnation, software_reset};
use crate::barrier::{
    SETTLE, alternating, sleep, sleep_until, spin_until, wait_for_peer, woken_until,
};
use crate::case::{CaseFailure, check, equal, fail};
use tandem_board::{
    Board, CoreAddress, Duration, Edge, Instant, Line, Lines, Link, SystemId, TimeEdge,
};

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

/// Waits for the stamp of edge `count` on the time line.
#[track_caller]
fn time_edge<B: Board>(board: &B, count: u32) -> Result<TimeEdge, CaseFailure> {
    let mut edge = None;
    sleep_until(board, "an edge on the time line is stamped", || {
        edge = board.lines().time_edge().filter(|edge| edge.count == count);
        edge.is_some()
    })?;
    edge.map_or_else(|| fail("an edge on the time line is stamped"), Ok)
}

const MARKS: u32 = 20;

/// S-3: marks instants, and tells the other system between which readings of the clock each was.
pub(super) fn marker<B: Board>(board: &B, _: CoreAddress) -> Result<(), CaseFailure> {
    for number in 1..=MARKS {
        wait_for_peer(board, number)?;
        let before = board.now().to_words();
        board.lines().send(Line::Time, Edge::Rising);
        let after = board.now().to_words();
        sleep(board, Duration::from_us(u64::from(number) * 200))?;
        board.lines().send(Line::Time, Edge::Falling);
        let words = [before[0], before[1], after[0], after[1]];
        sleep_until(board, "the link has room", || {
            board.link().try_send(&words).is_ok()
        })?;
    }
    wait_for_peer(board, MARKS + 1)
}

/// How much two clocks drift apart in a case, and how exactly a board stamps.
const SLACK_NS: i64 = 50_000;

/// S-3: reads each stamp after a different time. All fit to one offset between the clocks.
pub(super) fn marked<B: Board>(board: &B, _: CoreAddress) -> Result<(), CaseFailure> {
    let none = board.lines().time_edge().is_none();
    check(none, "no edge came since power-on")?;
    // From the sender's clock to this one, with the time on the wire.
    let (mut least, mut most) = (i64::MIN, i64::MAX);
    for number in 1..=MARKS {
        let begin = board.now();
        wait_for_peer(board, number)?;
        let mut words = [0; 4];
        sleep_until(board, "a datagram comes", || {
            board.link().try_receive(&mut words) == Some(4)
        })?;
        let edge = time_edge(board, number)?;
        let count = board.lines().received(Line::Time, Edge::Rising);
        equal(edge.count, count, "a stamp has the number of its edge")?;
        check(edge.at >= begin, "an edge comes after it was sent")?;
        check(edge.at <= board.now(), "an edge comes before it is read")?;
        let since = |low, high| {
            let sent = Instant::from_words([low, high]).as_ns();
            edge.at.as_ns().wrapping_sub(sent).cast_signed()
        };
        let [before, before_high, after, after_high] = words;
        least = least.max(since(after, after_high));
        most = most.min(since(before, before_high));
        let fits = least <= most.saturating_add(SLACK_NS);
        check(
            fits,
            "an edge is stamped when it comes, not when it is read",
        )?;
    }
    wait_for_peer(board, MARKS + 1)
}

/// More edges than a reader can follow.
const HASTE: u32 = 300;

/// Sends edges without a pause, each at a time of its own.
pub(super) fn hasty_marker<B: Board>(board: &B, _: CoreAddress) -> Result<(), CaseFailure> {
    wait_for_peer(board, 1)?;
    for _ in 0..HASTE {
        let last = board.now();
        board.lines().send(Line::Time, Edge::Rising);
        spin_until(board, "the clock runs", || board.now() > last)?;
    }
    wait_for_peer(board, 2)
}

/// S-3: a count and its time belong together, while edges come: one count never has two times.
pub(super) fn hasty_reader<B: Board>(board: &B, _: CoreAddress) -> Result<(), CaseFailure> {
    wait_for_peer(board, 1)?;
    let mut last = TimeEdge {
        count: 0,
        at: Instant::ORIGIN,
    };
    let mut found = Ok(());
    spin_until(board, "the last edge is stamped", || {
        let Some(edge) = board.lines().time_edge() else {
            return false;
        };
        let is_same = edge == last;
        let is_newer = edge.count > last.count && edge.at > last.at;
        let pairs = check(is_same || is_newer, "a count and its time belong together");
        let past = check(edge.at <= board.now(), "an edge comes before it is read");
        found = found.and(pairs).and(past);
        last = edge;
        edge.count == HASTE || found.is_err()
    })?;
    found?;
    wait_for_peer(board, 2)
}

/// Sends an edge, and sees the other system reset.
pub(super) fn marks_once<B: Board>(board: &B, _: CoreAddress) -> Result<(), CaseFailure> {
    if !is_first_incarnation(board) {
        // After this role has ended, no role services this system's watchdog.
        return Ok(());
    }
    board.lines().send(Line::Time, Edge::Rising);
    wait_for_peer(board, 1)
}

/// S-3: a reset of the cores changes neither the count nor the time of the newest edge.
pub(super) fn marked_once<B: Board>(board: &B, place: CoreAddress) -> Result<(), CaseFailure> {
    let begin = board.now();
    if is_first_incarnation(board) {
        wait_for_peer(board, 1)?;
        time_edge(board, 1)?;
    } else {
        let edge = board.lines().time_edge();
        let keeps = edge.is_some_and(|edge| edge.count == 1 && edge.at < begin);
        check(keeps, "the newest edge survives a reset")?;
    }
    software_reset(board, place)
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
