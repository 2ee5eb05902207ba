//! Tests that no core allocates in any poll after its start, in either role, nor a worker pool in
//! a run.

mod allocator;
mod board;
mod pool;

use allocator::counted;
use board::Counted;
use std::cell::RefCell;
use std::hint::black_box;
use std::rc::Rc;
use tandem_board::{Board, CoreId, Duration, Instant, SystemId};
use tandem_board_sim::{Poller, SimBoard};
use tandem_bus::ModeCode;
use tandem_cores::core0::Core0;
use tandem_cores::core1::Core1;
use tandem_cores::core2::Core2;
use tandem_cores::trace::Event;
use tandem_cores::{Config, Core};
use tandem_record::run_log::ControlFrame;
use tandem_redundancy::Phase;
use tandem_sim::drive::Drive;

const S: fn(u64) -> Duration = |seconds| Duration::from_ms(seconds * 1000);

/// A poll in which a core called the allocator.
#[derive(Debug)]
#[allow(dead_code, reason = "read in the message of a failed assertion")]
struct Offence {
    at: Instant,
    system: SystemId,
    core: CoreId,
    requests: u64,
}

/// The counts of the polls in a drive.
#[derive(Default)]
struct Tally {
    /// Number of polls, by system and core.
    polls: [[u64; CoreId::COUNT]; 2],
    offences: Vec<Offence>,
}

type Log = Rc<RefCell<Tally>>;

/// Wraps a core, and counts its polls and their requests.
fn watched(board: &'static Counted<'static>, mut core: impl Core + 'static, tally: &Log) -> Poller {
    let identity = board.identity();
    let (system, of) = (identity.system, identity.core);
    let tally = Rc::clone(tally);
    Box::new(move |_| {
        let at = board.now();
        let (requests, deadline) = counted(|| core.poll());
        let mut tally = tally.borrow_mut();
        tally.polls[system.index()][of.index()] += 1;
        if requests > 0 {
            tally.offences.push(Offence {
                at,
                system,
                core: of,
                requests,
            });
        }
        deadline
    })
}

/// Creates the core for this board, and counts its requests.
fn core(board: &SimBoard, tally: &Log) -> Poller {
    // A reset ends the core but not this process, so each reset leaks a board.
    let board: &'static SimBoard = Box::leak(Box::new(board.clone()));
    let board: &'static Counted<'static> = Box::leak(Box::new(Counted::new(board)));
    match board.identity().core {
        CoreId::CONTROL => watched(board, Core0::new(board, Config::rt()), tally),
        CoreId::PERCEPTION => watched(board, Core1::new(board), tally),
        _ => watched(board, Core2::new(board), tally),
    }
}

/// Returns the phases that a system entered, in order.
fn phases(drive: &Drive, of: SystemId) -> Vec<Phase> {
    let events = drive.events.iter();
    events
        .filter_map(|(_, system, _, event)| match event {
            Event::Phase { to, .. } if *system == of => Some(*to),
            _ => None,
        })
        .collect()
}

/// T-CHIP-2: no core allocates, reallocates or frees memory in a poll: at the start, while it
/// drives or stands by in dense traffic, in a takeover, when the lost system returns, and in
/// degraded mode.
#[test]
fn no_poll_of_any_core_allocates() {
    let tally = Log::default();
    let log = Rc::clone(&tally);
    let mut drive = Drive::with("cut-in", 1, move |board| core(board, &log));
    drive.run_for(S(10));
    drive.pair.power_off(SystemId::A);
    drive.run_for(S(4));
    drive.pair.power_on(SystemId::A);
    drive.run_for(S(6));
    assert_eq!(phases(&drive, SystemId::A), [Phase::Master, Phase::Standby]);
    // Without a peer and without planning, B drives with the L2 functions.
    drive.pair.power_off(SystemId::A);
    drive.run_for(S(1));
    drive.pair.kill_core(SystemId::B, CoreId::PLANNING);
    drive.run_for(S(3));

    let l2 = |frame: &&ControlFrame| frame.mode == ModeCode::DegradedL2;
    let frames = drive.seen.borrow().log.accepted().filter(l2).count();
    assert!(frames > 100, "{frames} frames of the L2 functions");
    assert_eq!(drive.masters(), [SystemId::A, SystemId::B]);
    let of_b = [Phase::Standby, Phase::DegradedMaster];
    assert_eq!(phases(&drive, SystemId::B), of_b);
    let tally = tally.borrow();
    // Every core runs for at least 16 s; the slowest has a period of 50 ms.
    for polls in tally.polls.as_flattened() {
        assert!(*polls >= 16 * 20, "{:?}", tally.polls);
    }
    assert!(tally.offences.is_empty(), "{:#?}", tally.offences);
}

/// A core that allocates in every poll.
struct Wasteful<C>(C);

impl<C: Core> Core for Wasteful<C> {
    fn poll(&mut self) -> Instant {
        drop(black_box(Box::new(0)));
        self.0.poll()
    }
}

/// Negative test for the test above: it finds the one of six cores that allocates.
#[test]
fn a_core_that_allocates_is_found() {
    let tally = Log::default();
    let log = Rc::clone(&tally);
    let mut drive = Drive::with("cut-in", 1, move |board| {
        let of = board.identity();
        if (of.system, of.core) != (SystemId::B, CoreId::PLANNING) {
            return core(board, &log);
        }
        let board: &'static SimBoard = Box::leak(Box::new(board.clone()));
        let board: &'static Counted<'static> = Box::leak(Box::new(Counted::new(board)));
        watched(board, Wasteful(Core2::new(board)), &log)
    });
    drive.run_for(S(1));

    let tally = tally.borrow();
    let polls = tally.polls[SystemId::B.index()][CoreId::PLANNING.index()];
    assert!(polls > 0);
    assert_eq!(tally.offences.len() as u64, polls);
    for offence in &tally.offences {
        let of = (offence.system, offence.core, offence.requests);
        assert_eq!(of, (SystemId::B, CoreId::PLANNING, 2), "{offence:?}");
    }
}
