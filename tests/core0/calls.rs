//! Counts core 0's system calls and allocator requests while it stands by, takes over and drives.

use crate::run::{Case, Script, config};
use crate::tracer::ALLOCATOR_REQUESTS;
use crate::{control_core, tracer};
use std::fmt::Write as _;
use std::hint::black_box;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::time::Duration as Span;
use std::{fs, thread};
use tandem_board::{Board, CoreId, Duration, RoleLamp, SystemId, VehiclePort};
use tandem_board_host::realtime::Grant;
use tandem_board_host::{Alarm, CoreArgs, HostBoard};
use tandem_cores::trace::Event;
use tandem_rtos::host;

pub(crate) const CASES: [Case; 3] = [
    Case {
        name: "core_0_makes_the_stated_system_calls_and_allocates_nothing",
        before: start_traced,
        peer: |args, board, grant| run_traced(args, board, grant, None),
        vehicle: |script| take_over(script, None),
    },
    Case {
        name: "a_core_0_that_makes_one_more_system_call_is_found",
        before: start_traced,
        peer: |args, board, grant| run_traced(args, board, grant, Some(call_once)),
        vehicle: |script| take_over(script, Some(libc::SYS_getppid)),
    },
    Case {
        name: "a_core_0_that_allocates_once_is_found",
        before: start_traced,
        peer: |args, board, grant| run_traced(args, board, grant, Some(allocate_once)),
        vehicle: |script| take_over(script, Some(ALLOCATOR_REQUESTS)),
    },
];

/// A permitted system call of core 0: number, name, largest count in the window, and purpose.
struct Stated(i64, &'static str, u32, &'static str);

/// No limit: the number of ticks determines how often a tick and the idle time make this call.
const EACH_TICK: u32 = u32::MAX;
/// Limit: two calls for each interrupt after which core 0 did not sleep, plus ten.
const EACH_PILED: u32 = u32::MAX - 1;

/// Limit for showing the role: one call for each role that the trace contains.
const EACH_ROLE: u32 = u32::MAX - 2;

/// The system call of `libc::pause`.
#[cfg(target_arch = "x86_64")]
const SYS_PAUSE: i64 = libc::SYS_pause;
#[cfg(not(target_arch = "x86_64"))]
const SYS_PAUSE: i64 = libc::SYS_ppoll;

const STATED: [Stated; 7] = [
    Stated(
        SYS_PAUSE,
        "pause",
        EACH_TICK,
        "sleeps while no task is ready",
    ),
    Stated(
        libc::SYS_timerfd_settime,
        "timerfd_settime",
        EACH_TICK,
        "postpones the timer that watches the CPU for stalls",
    ),
    Stated(
        libc::SYS_timer_settime,
        "timer_settime",
        EACH_TICK,
        "moves the next tick to the vehicle's time, if it is more than 1 us off",
    ),
    Stated(
        libc::SYS_rt_sigreturn,
        "rt_sigreturn",
        EACH_TICK,
        "returns from the interrupt of the tick or the doorbell",
    ),
    Stated(
        libc::SYS_rt_sigprocmask,
        "rt_sigprocmask",
        EACH_PILED,
        "returns from an interrupt that came on top of another",
    ),
    Stated(
        libc::SYS_futex,
        "futex",
        20,
        "wakes the thread of the data flash, or a core whose doorbell it rings",
    ),
    Stated(
        libc::SYS_write,
        "write",
        EACH_ROLE,
        "shows the role as the name of the process",
    ),
];

/// Set when the window has begun. The next tick then makes the call that the test must find.
static SPOILS: AtomicBool = AtomicBool::new(false);

fn call_once(_lateness_ns: u64) {
    if SPOILS.swap(false, Relaxed) {
        // SAFETY: the call takes no pointer.
        unsafe { libc::getppid() };
    }
}

fn allocate_once(_lateness_ns: u64) {
    if SPOILS.swap(false, Relaxed) {
        drop(black_box(Box::new(7)));
    }
}

fn start_traced(args: &CoreArgs) {
    tracer::start(&Path::new(&args.common.extra[1]).join("calls"));
}

/// Runs core 0 of B, and marks the window: from one second before the takeover to one after it.
/// `spoil` is called in each tick interrupt.
fn run_traced(_: &CoreArgs, board: HostBoard, grant: Grant, spoil: Option<fn(u64)>) {
    let (backplane, system) = (board.backplane(), board.identity().system);
    let until = move |wanted: RoleLamp| {
        while backplane.role(system) != wanted {
            thread::sleep(Span::from_millis(1));
        }
        thread::sleep(Span::from_secs(1));
    };
    control_core::postpone_at_ticks(Alarm::new().expect("a timer"));
    if spoil.is_some() {
        host::observe_ticks(spoil);
    }
    thread::spawn(move || {
        until(RoleLamp::Standby);
        tracer::mark_begin();
        SPOILS.store(true, Relaxed);
        until(RoleLamp::DegradedMaster);
        tracer::mark_end();
    });
    control_core::go(board, config(), grant).expect("core 0");
}

/// T-CHIP-2: core 0 of A is killed, and B takes over. A negative test adds the call `added`.
fn take_over(script: &mut Script, added: Option<i64>) {
    script.until("A drives and B stands by", |script| {
        script.port().role(SystemId::B) == RoleLamp::Standby && !script.accepted.is_empty()
    });
    script.drive_for(Duration::from_ms(2_000));
    let backplane = script.port().backplane();
    let control = backplane.core_pid(SystemId::A, CoreId::CONTROL);
    // SAFETY: the call takes no pointer, and the process belongs to this run.
    unsafe { libc::kill(control as i32, libc::SIGKILL) };
    let file = script.folder().join("calls");
    script.until("B takes over and is counted", |_| file.exists());
    assert!(script.accepted.iter().any(|(_, by)| *by == SystemId::B));

    let counted = fs::read_to_string(&file).expect("the file of the counts");
    let counted: Vec<(i64, u32)> = counted.lines().map(count).collect();
    let roles = script.traced.iter().filter(|(entry, event)| {
        let by = (entry.system, entry.core);
        by == (SystemId::B, CoreId::CONTROL) && matches!(event, Event::Role { .. })
    });
    let (table, unstated) = judge(&counted, roles.count() as u32);
    eprintln!("{table}");
    match added {
        None => assert_eq!(unstated, []),
        Some(number) => assert!(unstated.contains(&number), "{unstated:?}"),
    }
    // Check that the tracer counts: a core that sleeps and has a tick makes these calls.
    for number in [SYS_PAUSE, libc::SYS_rt_sigreturn] {
        let times = counted.iter().find(|(counted, _)| *counted == number);
        assert!(times.is_some_and(|(_, times)| *times > 0), "{table}");
    }
}

fn count(line: &str) -> (i64, u32) {
    let (number, times) = line.split_once(' ').expect("two numbers");
    let number = number.parse().expect("a number");
    (number, times.parse().expect("a number"))
}

/// Returns a table of the calls, and those not permitted. Core 0 has shown its role `roles` times.
fn judge(counted: &[(i64, u32)], roles: u32) -> (String, Vec<i64>) {
    let (mut table, mut unstated) = (String::new(), vec![]);
    let times = |of| counted.iter().find(|it| it.0 == of).map_or(0, |it| it.1);
    let piled = times(libc::SYS_rt_sigreturn).saturating_sub(times(SYS_PAUSE));
    for (number, times) in counted {
        let stated = STATED.iter().find(|stated| stated.0 == *number);
        let (name, why) = match stated {
            Some(Stated(_, name, _, why)) => ((*name).to_owned(), *why),
            None if *number == ALLOCATOR_REQUESTS => ("allocator".to_owned(), "not stated"),
            None => (format!("system call {number}"), "not stated"),
        };
        let most = |stated: &Stated| match stated.2 {
            EACH_PILED => 2 * piled + 10,
            EACH_ROLE => roles,
            most => most,
        };
        if stated.is_none_or(|stated| *times > most(stated)) {
            unstated.push(*number);
        }
        let _ = writeln!(table, "{times:8} {name:16} {why}");
    }
    (table, unstated)
}
