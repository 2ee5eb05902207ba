//! A core of A stops between any two of its accesses to shared memory. T-RED-9
//!
//! Compiled only with `--cfg stepped`, which `cargo xtask campaign stops` sets: that build counts
//! accesses. Everything that the core has written so far stays, even half of a value.
#![cfg(stepped)]

use std::cell::Cell;
use std::rc::Rc;
use tandem_board::{Board, CoreId, Duration, Instant, ResetCause, RoleLamp, SystemId};
use tandem_board_sim::{Poller, SimBoard, SystemEvent, SystemEventKind};
use tandem_cores::Config;
use tandem_shm::fault::kill_at;
use tandem_sim::drive::{Drive, poller};

/// From this time on the systems drive, and all cores run their cycles.
const DRIVES: Instant = Instant::from_ns(1_500_000_000);
/// Within this time the systems must be master and standby again, and stay so for [`STEADY`].
const HEALS_WITHIN: Duration = Duration::from_ms(12_000);
const STEADY: Duration = Duration::from_ms(300);
const STEP: Duration = Duration::from_ms(20);

/// Number of polls of a core in which it is stopped.
const POLLS: u32 = 40;

/// The situation in which the core stops. Its polls are counted from then on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum When {
    /// A drives, and B stands by.
    Driving,
    /// A was reset, and starts beside B, which drives.
    Restarting,
    /// Both systems are switched on.
    PowerOn,
}

/// Progress of the stop: not yet, stopped, or the poll ended before the access.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Stop {
    Awaited,
    Stopped,
    PollEnded,
}

/// Returns the number of resets of A.
fn resets(drive: &Drive) -> usize {
    let is_reset = |event: &SystemEvent| {
        event.system == SystemId::A && matches!(event.kind, SystemEventKind::Reset(_))
    };
    drive
        .pair
        .events()
        .iter()
        .filter(|event| is_reset(event))
        .count()
}

/// Stops this core of A in the `polls`-th poll, before the `access`-th access. Returns whether it
/// stopped: a poll may make fewer accesses.
///
/// # Panics
/// If control was lost for longer than the bound, A was not reset, or the systems do not heal.
fn stop(core: CoreId, when: When, polls: u32, access: usize) -> bool {
    let state = Rc::new(Cell::new(Stop::Awaited));
    let shared = Rc::clone(&state);
    let config = Config::rt();
    let mut drive = Drive::with("free-lane", 5, move |board: &SimBoard| -> Poller {
        let mut poll = poller(board, config);
        let of = board.identity();
        let generation = if when == When::Restarting { 2 } else { 1 };
        if (of.system, of.core, of.generation.0) != (SystemId::A, core, generation) {
            return poll;
        }
        let (board, state, mut left) = (board.clone(), Rc::clone(&shared), polls);
        Box::new(move |cause| {
            let counts = when != When::Driving || board.now() >= DRIVES;
            match (state.get(), left) {
                (Stop::Stopped, _) => return Instant::NEVER,
                (Stop::Awaited, 0) if counts => {}
                (Stop::Awaited, _) if counts => {
                    left -= 1;
                    return poll(cause);
                }
                _ => return poll(cause),
            }
            let next = kill_at(access, || poll(cause));
            state.set(next.map_or(Stop::Stopped, |_| Stop::PollEnded));
            next.unwrap_or(Instant::NEVER)
        })
    });
    if when == When::Restarting {
        drive.run_for(DRIVES.since(Instant::ORIGIN));
        drive.pair.reset(SystemId::A, ResetCause::Watchdog);
    }
    let before = resets(&drive);
    let what = format!("core {core}, {when:?}, poll {polls}, access {access}");
    let (begin, mut healed) = (drive.pair.now(), Duration::ZERO);
    while state.get() == Stop::Awaited || state.get() == Stop::Stopped && healed < STEADY {
        let lasts = drive.pair.now().since(begin);
        assert!(
            lasts < HEALS_WITHIN,
            "{what}: {:?}, does not heal",
            state.get()
        );
        drive.run_for(STEP);
        let mut lamps = SystemId::ALL.map(|system| drive.pair.lamp(system));
        lamps.sort_by_key(|lamp| *lamp == Some(RoleLamp::Standby));
        let is_healed = matches!(
            lamps,
            [
                Some(RoleLamp::Master | RoleLamp::DegradedMaster),
                Some(RoleLamp::Standby)
            ]
        ) && resets(&drive) > before;
        healed = if is_healed {
            healed + STEP
        } else {
            Duration::ZERO
        };
    }
    let bound = config.redundancy.gap_bound_mute() + Duration::from_ms(1);
    assert!(drive.gap_max() <= bound, "{what}: {:?}", drive.gap_max());
    state.get() == Stop::Stopped
}

#[test]
fn at_each_access() {
    let every = std::env::var("TANDEM_EVERY").ok();
    let every = every.and_then(|every| every.parse().ok()).unwrap_or(97);
    for when in [When::Driving, When::Restarting, When::PowerOn] {
        for core in CoreId::ALL {
            // Select other accesses in each poll.
            let in_poll = |poll: u32| {
                let first = poll as usize * 31 % every;
                let accesses = (first..).step_by(every);
                accesses
                    .take_while(|access| stop(core, when, poll, *access))
                    .count()
            };
            let stops: usize = (0..POLLS).map(in_poll).sum();
            println!("core {core}, {when:?}: stopped {stops} times");
            assert!(stops > 0, "core {core}, {when:?}: no access");
        }
    }
}
