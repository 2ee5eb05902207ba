//! Tests failures of cores, supplies and watchdogs: level lines, resets and their causes.

use core::sync::atomic::Ordering::SeqCst;
use std::time::{Duration as Span, Instant as Clock};

use rustix::process::Signal;
use tandem_board::{
    Board, Can, CanFrame, CanId, CoreId, Lines, ResetCause, ResetRequest, RoleLamp, Supply,
    SystemId, VehicleBus, VehiclePort, watchdog_answer,
};
use tandem_board_host::{HostBoard, clock, process_list};

use crate::fixture::{Case, GRANTED, Script, await_interrupt, idle, live, serve, service, signal};

use SystemId::{A, B};

const CONTROL: CoreId = CoreId::CONTROL;
const PERCEPTION: CoreId = CoreId::PERCEPTION;

/// The case whose processes claim real time.
pub(crate) const REALTIME: &str = "with_real_time_if_permitted";

pub(crate) const CASES: &[Case] = &[
    Case {
        name: "death_of_a_supply_is_a_power_loss",
        core: report_power,
        vehicle: kill_supply,
    },
    Case {
        name: "death_of_core_0_resets_the_system",
        core: report_start,
        vehicle: kill_core_0,
    },
    Case {
        name: "death_of_core_1_is_for_core_0_to_notice",
        core: supervise,
        vehicle: kill_core_1,
    },
    Case {
        name: "a_frozen_core_0_is_reset_by_the_watchdog",
        core: report_start,
        vehicle: freeze,
    },
    Case {
        name: "a_frozen_supply_blames_nobody_when_it_thaws",
        core: live,
        vehicle: freeze_supply,
    },
    Case {
        name: "a_core_that_never_serves_is_reset",
        core: never_serve,
        vehicle: reset_by_dog,
    },
    Case {
        name: "a_wrong_answer_is_a_fault",
        core: answer_wrong,
        vehicle: reset_by_dog,
    },
    Case {
        name: "an_early_service_is_a_fault",
        core: serve_early,
        vehicle: reset_by_dog,
    },
    Case {
        name: "a_requested_reset_is_orderly",
        core: ask_for_reset,
        vehicle: reset_by_software,
    },
    Case {
        name: "a_suspended_system_stays_down",
        core: suspend,
        vehicle: stays_down,
    },
    Case {
        name: "resets_in_a_row_are_paced",
        core: die,
        vehicle: paced,
    },
    Case {
        name: "doorbells_ring_the_incarnation_that_is",
        core: answer_rings,
        vehicle: reset_and_ring,
    },
    Case {
        name: "a_system_without_power_sends_nothing",
        core: send_always,
        vehicle: silence,
    },
    Case {
        name: "an_early_death_is_survived",
        core: live,
        vehicle: kill_at_the_start,
    },
    Case {
        name: REALTIME,
        core: live,
        vehicle: check_policy,
    },
    Case {
        name: "the_processes_can_be_listed",
        core: show_role,
        vehicle: list,
    },
];

const STARTED: u32 = 1;
const POWER: u32 = 2;
const CODE_OF: [ResetCause; 4] = [
    ResetCause::PowerOn,
    ResetCause::Software,
    ResetCause::Watchdog,
    ResetCause::Trap,
];

/// Core 0 reports its incarnation, its reset cause, and the value of an LMU word, which it then
/// overwrites.
fn report(board: &HostBoard) {
    if board.identity().core == CONTROL {
        let cause = board.supply().reset_cause();
        let code = CODE_OF
            .iter()
            .position(|known| *known == cause)
            .expect("listed") as u32;
        let found = board.lmu()[100].swap(0xBAD, SeqCst);
        board.trace([STARTED, board.identity().generation.0, code, found]);
    }
}

fn report_start(board: &HostBoard) {
    report(board);
    live(board);
}

/// Waits for the report of this incarnation; returns its reset cause and the LMU word's value.
fn await_start(script: &mut Script, system: SystemId, incarnation: u32) -> (ResetCause, u32) {
    loop {
        let [_, generation, cause, found] = script.await_trace(system, CONTROL, STARTED);
        if generation == incarnation {
            return (CODE_OF[cause as usize], found);
        }
    }
}

fn report_power(board: &HostBoard) {
    if board.identity().core != CONTROL {
        return idle(board);
    }
    // The first wait always returns at once. Do it here, so that the wait below returns only
    // after a ring.
    board.wait(board.now());
    board.trace([STARTED, board.identity().generation.0, 0, 0]);
    while board.lines().peer_powered() {
        service(board);
        std::thread::sleep(Span::from_millis(6));
    }
    // The fall of the level line must also have rung the doorbell.
    await_interrupt(board);
    board.trace([POWER, 0, 0, 0]);
    serve(board);
}

/// T-CHIP-5, T-CHIP-6: a system that loses its supply loses all cores, and the other system is
/// notified.
fn kill_supply(script: &mut Script) {
    await_start(script, A, 1);
    await_start(script, B, 1);
    script.await_incarnation(A, 1);
    let cores = CoreId::ALL.map(|core| script.pid(A, core));
    signal(script.port.backplane().supply_pid(A), Signal::KILL);
    script.until("level falls", |script| !script.port.is_powered(A));
    script.await_trace(B, CONTROL, POWER);
    let run = script.run.clone();
    script.until("the cores are dead", |_| {
        process_list::of_run(&run)
            .iter()
            .all(|process| !cores.contains(&process.pid))
    });
    assert!(script.port.is_powered(B));
    script.rest(100);
    assert!(script.was_never_blamed(B), "B drives on");
}

/// T-CHIP-6: the death of core 0 counts as a trap; the system restarts with memory as at power-on.
fn kill_core_0(script: &mut Script) {
    assert_eq!(await_start(script, A, 1), (ResetCause::PowerOn, 0));
    await_start(script, B, 1);
    script.await_incarnation(A, 1);
    let first = CoreId::ALL.map(|core| script.pid(A, core));
    for incarnation in 2..4 {
        script.signal(A, CONTROL, Signal::KILL);
        script.await_incarnation(A, incarnation);
        assert!(script.port.is_powered(A));
        assert_eq!(await_start(script, A, incarnation), (ResetCause::Trap, 0));
    }
    assert!(
        CoreId::ALL
            .iter()
            .all(|core| !first.contains(&script.pid(A, *core))),
        "all are new"
    );
    assert!(script.was_never_blamed(B));
}

fn supervise(board: &HostBoard) {
    report(board);
    match board.identity().core {
        CONTROL => loop {
            service(board);
            // A frame from the vehicle means that the vehicle has killed core 1.
            if board.can().try_receive().is_some() {
                board.supply().request_reset(ResetRequest::CoreDead);
            }
            std::thread::sleep(Span::from_millis(5));
        },
        _ => idle(board),
    }
}

fn kill_core_1(script: &mut Script) {
    await_start(script, A, 1);
    script.await_incarnation(A, 1);
    script.signal(A, PERCEPTION, Signal::KILL);
    script.until("it is gone", |script| script.pid(A, PERCEPTION) == 0);
    script.rest(60);
    if script.was_never_blamed(A) && script.generation(A, CONTROL).0 > 1 {
        // Core 0 was delayed: the watchdog reset the system before core 0 requested the reset.
        return;
    }
    assert_eq!(script.generation(A, CONTROL).0, 1, "no other part resets");
    assert!(script.port.is_powered(A));
    script
        .port
        .broadcast(&CanFrame::new(CanId::Standard(1), false, &[]).expect("valid"));
    assert_eq!(await_start(script, A, 2).0, ResetCause::Trap);
    script.await_incarnation(A, 2);
}

/// T-CHIP-6: if core 0 hangs, only the missing service of the watchdog shows it.
fn freeze(script: &mut Script) {
    await_start(script, B, 1);
    script.signal(B, CONTROL, Signal::STOP);
    assert_eq!(await_start(script, B, 2).0, ResetCause::Watchdog);
}

/// T-CHIP-6: while the supply is stopped, it watches no core. Afterwards it judges the services
/// that the ring kept; lost services do not count against the core.
fn freeze_supply(script: &mut Script) {
    script.await_incarnation(A, 1);
    script.rest(50);
    let supply = script.port.backplane().supply_pid(A);
    signal(supply, Signal::STOP);
    script.rest(1_000);
    signal(supply, Signal::CONT);
    script.rest(300);
    assert!(script.was_never_blamed(A), "it was always served");
    let incarnation = script.generation(A, CONTROL).0;
    script.signal(A, CONTROL, Signal::STOP);
    script.until("watched again", |script| {
        script.generation(A, CONTROL).0 > incarnation
    });
}

fn report_once(board: &HostBoard) {
    report(board);
    if board.identity().generation.0 > 1 {
        live(board);
    }
}

fn never_serve(board: &HostBoard) {
    report_once(board);
    idle(board);
}

fn answer_wrong(board: &HostBoard) {
    report_once(board);
    if board.identity().core == CONTROL {
        for n in 0_u8.. {
            let answer = watchdog_answer(board.supply().watchdog_question());
            board.supply().service_watchdog(answer ^ u8::from(n == 5));
            std::thread::sleep(Span::from_millis(5));
        }
    }
    idle(board);
}

fn serve_early(board: &HostBoard) {
    report_once(board);
    if board.identity().core == CONTROL {
        loop {
            let answer = watchdog_answer(board.supply().watchdog_question());
            board.supply().service_watchdog(answer);
        }
    }
    idle(board);
}

fn reset_by_dog(script: &mut Script) {
    assert_eq!(await_start(script, A, 1).0, ResetCause::PowerOn);
    assert_eq!(await_start(script, A, 2).0, ResetCause::Watchdog);
}

fn ask_for_reset(board: &HostBoard) {
    report_once(board);
    if board.identity().core == CONTROL {
        board.supply().request_reset(ResetRequest::Software);
    }
    live(board);
}

fn reset_by_software(script: &mut Script) {
    assert_eq!(await_start(script, A, 2).0, ResetCause::Software);
}

fn suspend(board: &HostBoard) {
    if board.identity().core == CONTROL && board.identity().system == A {
        board.supply().request_reset(ResetRequest::Suspend);
    }
    live(board);
}

/// T-RED-5: a system that has failed is held in reset until the next power-on.
fn stays_down(script: &mut Script) {
    script.until("it is down", |script| {
        !script.port.is_powered(A) && CoreId::ALL.iter().all(|core| script.pid(A, *core) == 0)
    });
    script.rest(200);
    assert_eq!(script.generation(A, CONTROL).0, 1);
    assert!(!script.port.is_powered(A));
    assert_eq!(script.port.role(A), RoleLamp::Suspended);
    assert!(script.port.is_powered(B));
}

fn die(board: &HostBoard) {
    if board.identity().core != CONTROL {
        idle(board);
    }
}

fn paced(script: &mut Script) {
    script.until("it starts", |script| script.generation(A, CONTROL).0 == 1);
    let start = Clock::now();
    script.rest(1_500);
    let incarnations = script.generation(A, CONTROL).0;
    // Pauses of 20 + 40 + 80 + 160 + 320 + 640 ms allow seven starts in 1.26 s. On a slow machine
    // more time may have passed, so compute the allowed number from the time that has passed.
    let (mut allowed, mut pause, mut time) = (1, 20, 0);
    while time < start.elapsed().as_millis() + 100 {
        time += pause;
        pause = 1_000.min(pause * 2);
        allowed += 1;
    }
    assert!(
        incarnations >= 2 && incarnations <= allowed,
        "{incarnations} incarnations, {allowed} allowed"
    );
}

const ANSWER: u32 = 7;

/// Core 1 answers rings with a count in the LMU; core 0 rings and services the watchdog.
fn answer_rings(board: &HostBoard) {
    let (asked, answered) = (&board.lmu()[0], &board.lmu()[16]);
    match board.identity().core {
        CONTROL => {
            for n in 1..=50 {
                asked.store(n, SeqCst);
                board.ring(PERCEPTION);
                let patience = Clock::now() + Span::from_secs(15);
                while answered.load(SeqCst) != n {
                    assert!(Clock::now() < patience, "ring {n} was lost");
                    std::thread::yield_now();
                }
            }
            board.trace([ANSWER, board.identity().generation.0, 0, 0]);
            // Rings to a dead core must have no effect.
            for _ in 0..10_000 {
                board.ring(CoreId::PLANNING);
            }
            serve(board);
        }
        PERCEPTION => loop {
            board.wait(clock::now() + tandem_board::Duration::from_ms(10_000));
            answered.store(asked.load(SeqCst), SeqCst);
        },
        // Core 2 has no role here: it ends at once, but its doorbell still exists.
        _ => {}
    }
}

fn reset_and_ring(script: &mut Script) {
    for incarnation in 1..5 {
        while script.await_trace(A, CONTROL, ANSWER)[1] != incarnation {}
        script.signal(A, CONTROL, Signal::KILL);
    }
}

fn send_always(board: &HostBoard) {
    if board.identity().core != CONTROL {
        return idle(board);
    }
    let id = 0x10 + board.identity().system.index() as u16;
    let frame = CanFrame::new(CanId::Standard(id), false, &[1]).expect("valid");
    for n in 0_u32.. {
        // Fails if the buffer is full, because the bus is stopped.
        let _ = board.can().try_send(&frame);
        if n.is_multiple_of(10) {
            let question = board.supply().watchdog_question();
            board.supply().service_watchdog(watchdog_answer(question));
        }
        std::thread::sleep(Span::from_millis(1));
    }
}

/// T-RED-9: frames in the buffers of a dead system do not reach the bus.
fn silence(script: &mut Script) {
    let mut sent = [0; 2];
    script.until("both send", |script| {
        script
            .port
            .transmitted(&mut |system, _, _| sent[system.index()] += 1);
        sent.iter().all(|count| *count > 20)
    });
    // This script does not run the bus here, so frames collect in the buffers.
    std::thread::sleep(Span::from_millis(20));
    signal(script.port.backplane().supply_pid(A), Signal::KILL);
    let patience = Clock::now() + Span::from_secs(10);
    while script.port.is_powered(A) {
        assert!(Clock::now() < patience, "level never falls");
    }
    script
        .port
        .transmitted(&mut |system, _, _| assert_eq!(system, B));
}

fn kill_at_the_start(script: &mut Script) {
    for incarnation in 1..12_u32 {
        script.until("core 0 starts", |script| {
            script.pid(A, CONTROL) != 0 && script.generation(A, CONTROL).0 == incarnation
        });
        std::thread::sleep(Span::from_micros(u64::from(incarnation) * 170));
        let pid = script.pid(A, CONTROL);
        if pid != 0 {
            signal(pid, Signal::KILL);
        }
        script.until("it is gone", |script| {
            script.generation(A, CONTROL).0 > incarnation
        });
    }
    script.rest(300);
}

fn show_role(board: &HostBoard) {
    if board.identity().core == CONTROL {
        board.supply().show_role(match board.identity().system {
            A => RoleLamp::Master,
            B => RoleLamp::Standby,
        });
    }
    live(board);
}

fn list(script: &mut Script) {
    script.await_incarnation(A, 1);
    script.await_incarnation(B, 1);
    script.until("both show roles", |script| {
        script.port.role(A) == RoleLamp::Master && script.port.role(B) == RoleLamp::Standby
    });
    let run = script.run.clone();
    let listed = |processes: Vec<process_list::Process>| -> Vec<String> {
        let line = |p: &process_list::Process| {
            let system = p.system.map_or("-".to_owned(), |system| system.to_string());
            format!("{} {system} {}", p.kind, p.role.as_deref().unwrap_or("-"))
        };
        processes.iter().map(line).collect()
    };
    let expected = [
        "supply A master",
        "core A master",
        "core A master",
        "core A master",
        "supply B standby",
        "core B standby",
        "core B standby",
        "core B standby",
        "vehicle - -",
    ];
    script.until("the names are set", |_| {
        listed(process_list::of_run(&run)) == expected
    });
    let all = process_list::of_run(&run);
    assert!(all.iter().all(|process| process.cpu.is_some()));
    assert!(all.iter().any(|process| process.pid == std::process::id()));
}

/// Checks that all processes except the launcher have the granted policy and keep it.
fn check_policy(script: &mut Script) {
    const FIFO: &str = "1";
    for system in SystemId::ALL {
        for core in CoreId::ALL {
            let granted = script.await_trace(system, core, GRANTED)[1] == 1;
            script.until("the core is entered", |script| {
                script.pid(system, core) != 0
            });
            let pid = script.pid(system, core);
            let stat = std::fs::read_to_string(format!("/proc/{pid}/stat")).expect("its state");
            // Field 41 of proc(5) is the policy. 40 fields precede it; the first 2 of them end at
            // the bracket.
            let fields = stat.rsplit_once(')').expect("a name").1;
            let policy = fields.split_whitespace().nth(38).expect("a policy");
            assert_eq!(policy == FIFO, granted, "{system}{core}");
        }
    }
    script.rest(300);
    for system in SystemId::ALL {
        assert!(script.was_never_blamed(system), "{system}");
    }
}
