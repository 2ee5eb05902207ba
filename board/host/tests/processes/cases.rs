//! Tests of the board's connections: LMU, doorbells, lines, link, CAN, flash, trace.

use core::ptr::{from_ref, null_mut};
use core::sync::atomic::AtomicPtr;
use core::sync::atomic::Ordering::{Acquire, Relaxed, Release, SeqCst};
use std::time::{Duration as Span, Instant as Clock};

use tandem_board::{
    Board, Can, CanFrame, CanId, CoreId, DataFlash, Edge, FlashStatus, Instant, Line, Lines, Link,
    RoleLamp, Supply, SystemId, VehicleBus, VehiclePort, Wake, watchdog_answer,
};
use tandem_board_conformance::{self as suite, Handler};
use tandem_board_host::{HostBoard, Wire};

use crate::fixture::{Case, Script, await_interrupt, idle, live};

use SystemId::{A, B};

const PERCEPTION: CoreId = CoreId::PERCEPTION;
const PLANNING: CoreId = CoreId::PLANNING;
const CONTROL: CoreId = CoreId::CONTROL;

pub(crate) const CASES: &[Case] = &[
    Case {
        name: "lmu_is_shared_by_three_processes",
        core: increment,
        vehicle: incremented,
    },
    Case {
        name: "a_handler_may_call_what_the_contract_says",
        core: interrupted,
        vehicle: undisturbed,
    },
    Case {
        name: "no_doorbell_is_lost",
        core: ping_pong,
        vehicle: both_done,
    },
    Case {
        name: "a_doorbell_rung_by_two_loses_no_ring",
        core: rung_by_two,
        vehicle: both_done,
    },
    Case {
        name: "wait_ends_at_its_deadline",
        core: deadlines,
        vehicle: both_done,
    },
    Case {
        name: "edges_and_datagrams_cross_over",
        core: wires,
        vehicle: crossed,
    },
    Case {
        name: "can_frames_reach_all_but_the_sender",
        core: listen,
        vehicle: hear,
    },
    Case {
        name: "flash_keeps_its_content_over_a_reset",
        core: program,
        vehicle: programmed,
    },
    Case {
        name: "a_full_trace_counts_what_it_loses",
        core: chatter,
        vehicle: overheard,
    },
];

const DONE: u32 = 100;

fn done(board: &HostBoard, detail: u32) {
    board.trace([DONE, detail, 0, 0]);
    live(board);
}

fn both_done(script: &mut Script) {
    for system in SystemId::ALL {
        script.await_trace(system, CONTROL, DONE);
    }
}

const ROUNDS: u32 = 200_000;

/// T-CHIP-1: the three cores of a system share one LMU; the other system has a separate one.
fn increment(board: &HostBoard) {
    let lmu = board.lmu();
    assert_eq!(lmu.len(), 8192);
    for _ in 0..ROUNDS {
        lmu[17].fetch_add(1, Relaxed);
    }
    lmu[8191].fetch_add(1, SeqCst);
    if board.identity().core == CONTROL {
        while lmu[8191].load(SeqCst) < 3 {
            std::thread::yield_now();
        }
        done(board, lmu[17].load(SeqCst));
    }
    idle(board);
}

fn incremented(script: &mut Script) {
    for system in SystemId::ALL {
        assert_eq!(script.await_trace(system, CONTROL, DONE)[1], 3 * ROUNDS);
    }
}

/// The board for the signal handler, which takes the place of a chip's interrupt.
static INTERRUPTED: AtomicPtr<HostBoard> = AtomicPtr::new(null_mut());
static HANDLER: Handler = Handler::new();

extern "C" fn on_signal(_: libc::c_int) {
    // Acquire pairs with the Release in `interrupted`.
    let board = INTERRUPTED.load(Acquire);
    // SAFETY: the board is never dropped: its core sleeps until it is killed.
    HANDLER.run(unsafe { &*board });
}

/// Interrupts only this thread, with this period in ns; 0 stops the interrupts.
fn interrupt_every(period_ns: libc::c_long) {
    static TIMER: AtomicPtr<libc::c_void> = AtomicPtr::new(null_mut());
    let handler: extern "C" fn(libc::c_int) = on_signal;
    let period = libc::timespec {
        tv_sec: 0,
        tv_nsec: period_ns,
    };
    let times = libc::itimerspec {
        it_interval: period,
        it_value: period,
    };
    // SAFETY: the structures are valid during each call. The handler only makes calls that are
    // permitted in any context, and accesses atomics.
    unsafe {
        if period_ns != 0 {
            libc::signal(libc::SIGALRM, handler as libc::sighandler_t);
            let mut event: libc::sigevent = core::mem::zeroed();
            event.sigev_notify = libc::SIGEV_THREAD_ID;
            event.sigev_signo = libc::SIGALRM;
            event.sigev_notify_thread_id = libc::gettid();
            let mut timer = null_mut();
            let made = libc::timer_create(libc::CLOCK_MONOTONIC, &raw mut event, &raw mut timer);
            assert_eq!(made, 0, "a timer");
            TIMER.store(timer, Relaxed);
        }
        libc::timer_settime(TIMER.load(Relaxed), 0, &raw const times, null_mut());
    }
}

/// T-SYNC-3: a handler that interrupts this core at any point, even inside a call, makes all calls
/// that the contract permits in any context.
fn interrupted(board: &HostBoard) {
    const RUNS: u32 = 5_000;
    if board.identity().core != PERCEPTION {
        return live(board);
    }
    INTERRUPTED.store(from_ref(board).cast_mut(), Release);
    interrupt_every(100_000);
    let mut round = 0;
    while HANDLER.runs() < RUNS {
        suite::in_task(board, round).expect("a call of the task");
        round += 1;
    }
    interrupt_every(0);
    loop {
        // Repeat the record, because a full trace loses it.
        board.trace([DONE, HANDLER.runs(), round, 0]);
        board.wait(board.now() + tandem_board::Duration::from_ms(10));
    }
}

/// Each record of the task and of its handler must be in the trace, complete and in order, or be
/// counted as lost.
fn undisturbed(script: &mut Script) {
    for system in SystemId::ALL {
        let [_, runs, rounds, _] = script.await_trace(system, PERCEPTION, DONE);
        assert!(script.was_never_blamed(system), "{system}");
        let incarnations = script.generation(system, PERCEPTION).0 as usize;
        for (code, expected) in [
            (Handler::TRACE_CODE, runs),
            (Handler::TASK_TRACE_CODE, rounds),
        ] {
            let of_code = script.take_traced(system, PERCEPTION, code);
            let numbers: Vec<u32> = of_code.iter().map(|record| record[1]).collect();
            // Each incarnation counts from 0 again.
            let in_order = numbers.chunk_by(|a, b| a < b).count();
            assert!(in_order <= incarnations, "{system} {code:#x}: {numbers:?}");
            let lost = script.lost as usize;
            assert!(
                numbers.len() + lost >= expected as usize,
                "{system} {code:#x}: {} read and {lost} lost of {expected}, first {:?}",
                numbers.len(),
                numbers.first()
            );
        }
    }
}

/// T-SYNC-3: two cores ring each other thousands of times; each sleeps until it is rung.
fn ping_pong(board: &HostBoard) {
    const TURNS: u32 = 3_000;
    let (ball, me) = (&board.lmu()[0], board.identity().core);
    let (parity, other) = match me {
        CONTROL => (0, PERCEPTION),
        PERCEPTION => (1, CONTROL),
        _ => return idle(board),
    };
    for turn in (parity..TURNS).step_by(2) {
        while ball.load(SeqCst) != turn {
            await_interrupt(board);
        }
        ball.store(turn + 1, SeqCst);
        board.ring(other);
    }
    if me == CONTROL {
        while ball.load(SeqCst) != TURNS {
            await_interrupt(board);
        }
        done(board, 0);
    }
    idle(board);
}

/// T-SYNC-3: two cores ring a third at any time; the third sees what each wrote before its ring.
fn rung_by_two(board: &HostBoard) {
    const TURNS: u32 = 3_000;
    let lmu = board.lmu();
    let (asked, answered) = match board.identity().core {
        CONTROL => (&lmu[0], &lmu[64]),
        PERCEPTION => (&lmu[16], &lmu[80]),
        _ => loop {
            await_interrupt(board);
            for n in [0, 16] {
                lmu[64 + n].store(lmu[n].load(SeqCst), SeqCst);
            }
            if lmu[0].load(SeqCst) == TURNS && lmu[16].load(SeqCst) == TURNS {
                return idle(board);
            }
        },
    };
    for turn in 1..=TURNS {
        asked.store(turn, SeqCst);
        board.ring(PLANNING);
        let patience = Clock::now() + Span::from_secs(15);
        while answered.load(SeqCst) != turn {
            assert!(Clock::now() < patience, "ring {turn} was lost");
            std::thread::yield_now();
        }
    }
    if board.identity().core == CONTROL {
        done(board, 0);
    }
    idle(board);
}

fn deadlines(board: &HostBoard) {
    // The first wait returns at once.
    board.wait(board.now());
    for us in [0, 1, 50, 300, 1_000, 20_000] {
        let deadline = board.now() + tandem_board::Duration::from_us(us);
        while board.wait(deadline) == Wake::Interrupt {}
        assert!(board.now() >= deadline, "woke early");
    }
    // A past deadline does not hide a pending interrupt, and a core can ring itself.
    board.ring(board.identity().core);
    assert_eq!(board.wait(Instant::ORIGIN), Wake::Interrupt);
    assert_eq!(board.wait(Instant::ORIGIN), Wake::Deadline);
    done(board, 0);
}

fn wires(board: &HostBoard) {
    if board.identity().core != CONTROL {
        return idle(board);
    }
    let lines = board.lines();
    assert!(lines.peer_powered());
    for _ in 0..5 {
        lines.send(Line::Heartbeat1, Edge::Rising);
        lines.send(Line::Heartbeat2, Edge::Falling);
    }
    // An edge on the start line must interrupt core 0 of the other system.
    lines.send(Line::Start, Edge::Rising);
    while lines.received(Line::Start, Edge::Rising) == 0 {
        await_interrupt(board);
    }
    assert_eq!(lines.received(Line::Heartbeat1, Edge::Rising), 5);
    assert_eq!(lines.received(Line::Heartbeat1, Edge::Falling), 0);
    assert_eq!(lines.received(Line::Heartbeat2, Edge::Falling), 5);

    let longest: Vec<u32> = (0..64).collect();
    board.link().try_send(&longest).expect("room");
    board.link().try_send(&[]).expect("room");
    let mut words = [0; 64];
    let first = loop {
        if let Some(length) = board.link().try_receive(&mut words) {
            break length;
        }
        std::thread::yield_now();
    };
    assert_eq!((first, &words[..]), (64, &longest[..]));
    while board.link().try_receive(&mut words) != Some(0) {
        std::thread::yield_now();
    }
    // A cut line must transmit no edge.
    board.trace([1, 0, 0, 0]);
    let before = lines.received(Line::Heartbeat1, Edge::Rising);
    while board.can().try_receive().is_none() {
        std::thread::yield_now();
    }
    if board.identity().system == A {
        lines.send(Line::Heartbeat1, Edge::Rising);
        board
            .link()
            .try_send(&[1])
            .expect("a cut link takes and loses");
        lines.send(Line::Heartbeat2, Edge::Rising);
    } else {
        while lines.received(Line::Heartbeat2, Edge::Rising) == 0 {
            std::thread::yield_now();
        }
        assert_eq!(lines.received(Line::Heartbeat1, Edge::Rising), before);
        assert_eq!(board.link().try_receive(&mut words), None);
    }
    done(board, 0);
}

fn crossed(script: &mut Script) {
    for system in SystemId::ALL {
        script.await_trace(system, CONTROL, 1);
    }
    script.port.set_cut(Wire::Line(Line::Heartbeat1), A, true);
    script.port.set_cut(Wire::Link, A, true);
    script.port.broadcast(&frame(0x700));
    both_done(script);
}

fn frame(id: u16) -> CanFrame {
    CanFrame::new(CanId::Standard(id), true, &[id as u8; 48]).expect("a valid frame")
}

/// Sends frames from all cores, and records the frames that each core receives.
fn listen(board: &HostBoard) {
    let me = board.identity();
    let number = (me.system.index() * 3 + me.core.index()) as u16;
    board.can().wake_on_receive(true);
    board.trace([1, 0, 0, 0]);
    // The vehicle's frame 0x700 signals that all cores are ready.
    await_frame(board, 0x700);
    for n in 0..10 {
        board
            .can()
            .try_send(&frame(number * 0x10 + n))
            .expect("room");
    }
    let mut heard: Vec<u32> = vec![];
    while heard.len() < 50 {
        match board.can().try_receive() {
            Some(received) => {
                let CanId::Standard(id) = received.frame.id() else {
                    panic!("extended")
                };
                assert_ne!(id / 0x10, number, "own frame");
                assert_eq!(received.frame.data(), [id as u8; 48]);
                assert!(received.at <= board.now());
                heard.push(id.into());
            }
            None => await_interrupt(board),
        }
    }
    assert_eq!(board.can().overruns(), 0);
    // The bus has one order: all cores receive the same frames, except those that they sent.
    for id in &heard {
        board.trace([2, *id, 0, 0]);
    }
    done(board, 0);
}

fn await_frame(board: &HostBoard, id: u16) {
    loop {
        match board.can().try_receive() {
            Some(received) if received.frame.id() == CanId::Standard(id) => return,
            Some(_) => {}
            None => await_interrupt(board),
        }
    }
}

fn hear(script: &mut Script) {
    let mut ready = 0;
    script.until("all are there", |script| {
        script
            .port
            .drain_trace(&mut |traced| ready += u32::from(traced.record[0] == 1));
        ready == 6
    });
    script.port.broadcast(&frame(0x700));
    let (mut bus, mut heard, mut finished) = (vec![], vec![vec![]; 6], 0);
    let patience = Clock::now() + Span::from_secs(15);
    while finished < 6 {
        assert!(Clock::now() < patience, "{finished} of 6 heard all");
        script.port.transmitted(&mut |system, core, received| {
            let CanId::Standard(id) = received.frame.id() else {
                panic!("extended")
            };
            assert_eq!(usize::from(id / 0x10), system.index() * 3 + core.index());
            bus.push(u32::from(id));
        });
        script.port.drain_trace(&mut |traced| {
            let core = traced.system.index() * 3 + traced.core.index();
            match traced.record {
                [2, id, ..] => heard[core].push(id),
                [DONE, ..] => finished += 1,
                _ => {}
            }
        });
        std::thread::sleep(Span::from_millis(1));
    }
    for (core, heard) in heard.iter().enumerate() {
        let foreign: Vec<u32> = bus
            .iter()
            .copied()
            .filter(|id| id / 0x10 != core as u32)
            .collect();
        assert_eq!(*heard, foreign, "core {core}");
    }
    unplugged(script);
}

/// Checks that a system that is cut off from the bus neither sends nor receives.
fn unplugged(script: &mut Script) {
    script.port.set_cut(Wire::Can, B, true);
    script.port.broadcast(&frame(0x701));
    script.port.set_cut(Wire::Can, B, false);
    script.rest(5);
}

fn wait_for_flash(board: &HostBoard) {
    while board.flash().status() == FlashStatus::Busy {
        std::thread::yield_now();
    }
    assert_eq!(board.flash().status(), FlashStatus::Idle);
}

fn program(board: &HostBoard) {
    if board.identity().core != CONTROL {
        return idle(board);
    }
    let mut bytes = [0; 8];
    board.flash().read(4096, &mut bytes).expect("read");
    if bytes == [0xFF; 8] {
        board.flash().start_erase(1).expect("erase");
        wait_for_flash(board);
        board.flash().start_program(4096, &[7; 8]).expect("program");
        wait_for_flash(board);
        std::process::exit(1);
    }
    done(board, bytes[0].into());
}

fn programmed(script: &mut Script) {
    for system in SystemId::ALL {
        assert_eq!(script.await_trace(system, CONTROL, DONE)[1], 7);
        assert!(script.generation(system, CONTROL).0 >= 2);
    }
}

const CHATTER: u32 = 10_000;

fn chatter(board: &HostBoard) {
    if board.identity().core == CONTROL {
        for n in 0..CHATTER {
            board.trace([1, n, 0, 0]);
        }
        board.supply().show_role(RoleLamp::Standby);
        loop {
            let question = board.supply().watchdog_question();
            board.supply().service_watchdog(watchdog_answer(question));
            std::thread::sleep(Span::from_millis(10));
        }
    }
    idle(board);
}

fn overheard(script: &mut Script) {
    // Do not read the trace while the cores write to it.
    script.until("they have talked", |script| {
        SystemId::ALL
            .iter()
            .all(|system| script.port.role(*system) == RoleLamp::Standby)
    });
    let (mut next, mut count) = ([0; 2], 0);
    let lost = script.port.drain_trace(&mut |traced| {
        let expected = &mut next[traced.system.index()];
        assert_eq!(
            traced.record,
            [1, *expected, 0, 0],
            "in order, none missing in between"
        );
        *expected += 1;
        count += 1;
    });
    assert!(lost > 0);
    assert_eq!(count + lost, 2 * CHATTER);
}
