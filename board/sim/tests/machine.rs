//! The functions of the simulated pair for tests: time, faults, power, the world.
#![allow(clippy::unwrap_used, reason = "all of it is a test")]

use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::{Arc, Mutex};
use tandem_board::{
    Board, Can, CanFrame, CanId, CoreAddress, CoreId, DataFlash, Duration, Edge, Generation,
    Instant, Line, Lines, Link, ResetCause, ResetRequest, RoleLamp, Supply, SystemId, VehicleBus,
    watchdog_answer,
};
use tandem_board_sim::{
    Clock, Config, Order, Poller, Power, Sender, SimBoard, SimPair, SystemEventKind, Wire, blocking,
};

const A: SystemId = SystemId::A;
const B: SystemId = SystemId::B;
const CONTROL: CoreId = CoreId::CONTROL;

fn ms(span: u64) -> Duration {
    Duration::from_ms(span)
}

fn relaxed() -> Config {
    Config {
        watchdog: false,
        ..Config::default()
    }
}

fn frame(value: u8) -> CanFrame {
    CanFrame::new(CanId::Standard(0x123), false, &[value]).unwrap()
}

/// Makes core 0 release the other cores.
fn release_others(board: &SimBoard) {
    if board.identity().core == CoreId::CONTROL {
        board.release_core(CoreId::PERCEPTION);
        board.release_core(CoreId::PLANNING);
    }
}

/// Makes a powered pair in which `make` provides the code of core `core` of system A.
fn pair_with(
    config: Config,
    core: CoreId,
    mut make: impl FnMut(&SimBoard) -> Poller + 'static,
) -> SimPair {
    let mut pair = SimPair::new(config, move |board| {
        release_others(board);
        let identity = board.identity();
        match (identity.system, identity.core == core) {
            (A, true) => make(board),
            _ => Box::new(|_| Instant::NEVER),
        }
    });
    pair.power_on(A);
    pair.power_on(B);
    pair
}

/// Services the watchdog every 10 ms and shows the role of master.
fn servant(_: &SimBoard) -> Poller {
    let mut next = Instant::ORIGIN;
    Box::new(move |board| {
        let supply = board.supply();
        supply.show_role(RoleLamp::Master);
        if board.now() >= next {
            supply.service_watchdog(watchdog_answer(supply.watchdog_question()));
            next = board.now() + ms(10);
        }
        next
    })
}

fn kinds(pair: &SimPair, system: SystemId) -> Vec<SystemEventKind> {
    let of_system = pair
        .events()
        .into_iter()
        .filter(|event| event.system == system);
    of_system.map(|event| event.kind).collect()
}

/// Makes six cores that send, ring and answer each other.
fn chatter(config: Config) -> SimPair {
    let mut pair = SimPair::new(config, |board| {
        release_others(board);
        let mut count = 0_u8;
        let mut next = Instant::ORIGIN;
        Box::new(move |board| {
            board.can().wake_on_receive(count.is_multiple_of(3));
            while let Some(received) = board.can().try_receive() {
                board.trace([u32::from(received.frame.data()[0]), 0, 0, 0]);
            }
            if board.now() < next {
                return next;
            }
            count = count.wrapping_add(1);
            if count % 4 == 1 {
                board.can().try_send(&frame(count)).unwrap();
            }
            board.ring(CoreId::ALL[usize::from(count) % 3]);
            next = board.now() + Duration::from_us(100 + 7 * u64::from(count));
            next
        })
    });
    pair.power_on(A);
    pair.power_on(B);
    pair.run_for(ms(20));
    pair
}

#[test]
fn the_same_seed_gives_the_same_run_and_another_seed_another() {
    let run = |seed| {
        let mut pair = chatter(Config {
            seed,
            order: Order::Shuffled,
            ..relaxed()
        });
        (pair.take_bus_log(), pair.take_trace())
    };
    assert!(!run(1).0.is_empty());
    assert_eq!(run(1), run(1));
    assert_ne!(run(1), run(2));
}

/// T-CHIP-5: a core that sends without a pause puts 8 frames on the bus per millisecond; the other
/// cores can still send theirs.
#[test]
fn a_core_has_its_share_of_the_bus() {
    let mut pair = SimPair::idle(relaxed());
    let (babbler, other) = (
        pair.board(B, CoreId::PLANNING),
        pair.board(A, CoreId::CONTROL),
    );
    for _ in 0..10 {
        let sent = (0..100).filter(|n| babbler.can().try_send(&frame(*n)).is_ok());
        assert_eq!(sent.count(), 8);
        other.can().try_send(&frame(0)).unwrap();
        pair.run_for(ms(1));
    }
    assert_eq!(pair.take_bus_log().len(), 90);
}

#[test]
fn blocking_cores_are_deterministic_too() {
    let run = || {
        let mut pair = SimPair::new(relaxed(), |board| {
            release_others(board);
            blocking(board, |board| {
                for count in 0..50 {
                    // Other cores' rings wake this core more often than the bus accepts frames.
                    while board.can().try_send(&frame(count)).is_err() {
                        board.wait(board.now() + Duration::from_us(300));
                    }
                    board.ring(CoreId::ALL[usize::from(count) % 3]);
                    while board.can().try_receive().is_some() {}
                    board.wait(board.now() + Duration::from_us(300));
                }
            })
        });
        pair.power_on(A);
        pair.power_on(B);
        pair.run_for(ms(50));
        pair.take_bus_log()
    };
    assert_eq!(run().len(), 300);
    assert_eq!(run(), run());
}

#[test]
fn a_poller_runs_at_its_deadlines_on_its_own_clock() {
    let clock = Clock {
        offset_ns: 500,
        drift_ppb: 50_000,
    };
    let seen = Arc::new(Mutex::new(Vec::new()));
    let reported = Arc::clone(&seen);
    let config = Config {
        clocks: [clock, Clock::default()],
        ..relaxed()
    };
    let mut pair = pair_with(config, CONTROL, move |board| {
        let mut next = board.now();
        let reported = Arc::clone(&reported);
        Box::new(move |board| {
            assert!(board.now() >= next, "not early");
            reported.lock().unwrap().push(board.now());
            next += ms(10);
            next
        })
    });
    // The clock of A gains 50 µs per second.
    pair.run_until(Instant::from_ns(10_000_000_000));
    let seen = seen.lock().unwrap();
    assert_eq!(seen.len(), 1001);
    assert!(
        seen.windows(2)
            .all(|two| two[1].since(two[0]).as_ns().abs_diff(10_000_000) <= 1)
    );
    assert_eq!(pair.board(A, CONTROL).now().as_ns(), 10_000_500_500);
}

#[test]
fn a_core_that_dies_is_found_by_the_watchdog() {
    let mut pair = pair_with(Config::default(), CONTROL, servant);
    pair.run_for(ms(95));
    assert_eq!(pair.lamp(A), Some(RoleLamp::Master));
    pair.lmu(A)[5].store(42, Ordering::Relaxed);
    pair.kill_core(A, CONTROL);
    let died = pair.now();
    // B does not service its watchdog; its resets do not matter here.
    let is_on = pair.run_while(died + ms(20), |pair| pair.power(A) == Power::On);
    assert!(!is_on, "reset within the window");
    assert!(!pair.board(B, CONTROL).lines().peer_powered());
    pair.run_for(ms(3));
    assert_eq!(
        kinds(&pair, A),
        [
            SystemEventKind::Started(ResetCause::PowerOn),
            SystemEventKind::Lamp(RoleLamp::Master),
            SystemEventKind::CoreDied(CONTROL),
            SystemEventKind::Reset(ResetCause::Watchdog),
            SystemEventKind::Started(ResetCause::Watchdog),
            SystemEventKind::Lamp(RoleLamp::Master),
        ]
    );
    assert_eq!(pair.board(A, CONTROL).identity().generation, Generation(2));
    assert_eq!(
        pair.board(A, CONTROL).supply().reset_cause(),
        ResetCause::Watchdog
    );
    assert_eq!(
        pair.lmu(A)[5].load(Ordering::Relaxed),
        42,
        "the LMU keeps its content"
    );
}

#[test]
fn a_freeze_is_found_by_the_watchdog_and_a_short_one_is_not() {
    for (span, resets) in [(5, 0), (200, 1)] {
        let mut pair = pair_with(Config::default(), CONTROL, servant);
        pair.run_for(ms(51));
        pair.freeze(A, ms(span));
        pair.run_for(ms(60));
        let reset = |kind: &SystemEventKind| *kind == SystemEventKind::Reset(ResetCause::Watchdog);
        assert_eq!(
            kinds(&pair, A).iter().filter(|kind| reset(kind)).count(),
            resets,
            "{span} ms"
        );
    }
}

#[test]
fn power_loss_clears_the_memory_and_interrupts_the_other_system() {
    let wakes = Arc::new(AtomicU32::new(0));
    let counted = Arc::clone(&wakes);
    let mut pair = pair_with(relaxed(), CONTROL, move |_| {
        let counted = Arc::clone(&counted);
        Box::new(move |board| {
            counted.fetch_add(1, Ordering::Relaxed);
            board.trace([u32::from(board.lines().peer_powered()), 0, 0, 0]);
            Instant::NEVER
        })
    });
    pair.run_for(ms(1));
    let quiet = wakes.load(Ordering::Relaxed);
    pair.lmu(B)[9].store(1, Ordering::Relaxed);
    pair.restart_core(B, CONTROL);
    pair.power_off(B);
    assert_eq!((pair.power(B), pair.lamp(B)), (Power::Off, None));
    pair.run_for(ms(1));
    pair.power_on(B);
    pair.run_for(ms(1));
    assert_eq!(wakes.load(Ordering::Relaxed), quiet + 2);
    let (trace, lost) = pair.take_trace();
    let levels: Vec<_> = trace.iter().map(|entry| entry.record[0]).collect();
    assert_eq!((&levels[levels.len() - 2..], lost), (&[0, 1][..], 0));
    assert_eq!(pair.lmu(B)[9].load(Ordering::Relaxed), 0);
    assert_eq!(pair.board(B, CONTROL).identity().generation, Generation(1));
}

#[test]
fn a_suspended_system_stays_silent_until_power_comes_anew() {
    let mut pair = SimPair::idle(relaxed());
    pair.board(A, CONTROL)
        .supply()
        .request_reset(ResetRequest::Suspend);
    pair.run_for(ms(1000));
    assert_eq!(pair.power(A), Power::Suspended);
    pair.power_on(A);
    pair.reset(A, ResetCause::Software);
    assert_eq!(pair.power(A), Power::Suspended);
    pair.power_off(A);
    pair.power_on(A);
    assert_eq!(pair.power(A), Power::On);
}

#[test]
fn the_dead_do_not_act() {
    let mut pair = SimPair::idle(relaxed());
    let ghost = pair.board(A, CONTROL);
    pair.restart_core(A, CONTROL);
    ghost.can().try_send(&frame(1)).unwrap();
    ghost.lines().send(Line::Start, Edge::Rising);
    ghost.link().try_send(&[1]).unwrap();
    ghost.supply().request_reset(ResetRequest::Suspend);
    ghost.trace([0; 4]);
    assert!(ghost.flash().start_erase(0).is_err());
    pair.run_for(ms(10));
    let other = pair.board(B, CONTROL);
    assert!(pair.take_bus_log().is_empty() && pair.take_trace().0.is_empty());
    assert_eq!(other.lines().received(Line::Start, Edge::Rising), 0);
    assert_eq!(other.link().try_receive(&mut [0]), None);
    assert_eq!(pair.power(A), Power::On);
    assert_eq!(pair.board(A, CONTROL).identity().generation, Generation(2));
}

#[test]
fn a_cut_wire_carries_nothing_until_it_is_restored() {
    let mut pair = SimPair::idle(relaxed());
    let (near, far) = (pair.board(A, CONTROL), pair.board(B, CONTROL));
    let send = |value| {
        Line::ALL
            .into_iter()
            .for_each(|line| near.lines().send(line, Edge::Rising));
        near.link().try_send(&[value]).unwrap();
        near.can().try_send(&frame(value as u8)).unwrap();
        far.can().try_send(&frame(value as u8)).unwrap();
    };
    let edges = || Line::ALL.map(|line| far.lines().received(line, Edge::Rising));
    for line in Line::ALL {
        pair.cut(Wire::Line(line), A);
        send(1);
        pair.restore(Wire::Line(line), A);
    }
    assert_eq!(edges(), [3; 4], "each line was cut once");
    assert_eq!(far.lines().time_edge().map(|edge| edge.count), Some(3));
    while far.link().try_receive(&mut [0]).is_some() {}
    while near.can().try_receive().is_some() || far.can().try_receive().is_some() {}

    pair.cut(Wire::Link, A);
    pair.cut(Wire::Can, A);
    send(2);
    assert_eq!(far.link().try_receive(&mut [0]), None);
    assert!(near.can().try_receive().is_none() && far.can().try_receive().is_none());
    pair.restore(Wire::Link, A);
    pair.restore(Wire::Can, A);
    send(3);
    let mut word = [0];
    assert_eq!((far.link().try_receive(&mut word), word), (Some(1), [3]));
    assert_eq!(far.can().try_receive().unwrap().frame, frame(3));
    assert_eq!(near.can().try_receive().unwrap().frame, frame(3));

    pair.cut(Wire::Level, A);
    pair.power_off(A);
    assert!(far.lines().peer_powered(), "a cut level line reads as high");
    pair.restore(Wire::Level, A);
    assert!(!far.lines().peer_powered());
}

/// Power fails after every 97th byte of an erase and every byte of a program; the flash keeps the
/// bytes that were already processed.
#[test]
fn power_can_fail_at_every_byte_of_the_flash() {
    let erase = u64::from(<SimBoard as Board>::Flash::SECTOR_BYTES);
    for cut in (0..=erase).step_by(97).chain(erase..=erase + 8) {
        let mut pair = pair_with(relaxed(), CONTROL, |_| {
            let mut step = 0;
            Box::new(move |board| {
                let started = match step {
                    0 => board.flash().start_erase(0),
                    1 => board.flash().start_program(0, &[0x11; 8]),
                    _ => return Instant::NEVER,
                };
                step += u32::from(started.is_ok());
                board.now() + Duration::from_us(500)
            })
        });
        pair.edit_flash(A, |bytes| bytes.fill(0));
        pair.power_off_after_flash_bytes(A, cut);
        let on = pair.run_while(Instant::ORIGIN + ms(100), |pair| pair.power(A) == Power::On);
        assert!(!on, "power fails after {cut} bytes");
        let flash = pair.flash(A);
        let (erased, programmed) = (cut.min(erase) as usize, (cut.max(erase) - erase) as usize);
        assert!(flash[..programmed].iter().all(|byte| *byte == 0x11));
        // The byte at the cut is random.
        let first_erased = if cut >= erase { programmed + 1 } else { 0 };
        assert!(
            flash[first_erased.min(erased)..erased]
                .iter()
                .all(|byte| *byte == 0xFF)
        );
        assert!(flash[(erased + 1)..].iter().all(|byte| *byte == 0));
        pair.power_on(A);
        assert_eq!(pair.power(A), Power::On, "once");
    }
}

#[test]
fn the_world_hears_sees_and_sends_every_millisecond() {
    let mut pair = pair_with(relaxed(), CONTROL, |_| {
        Box::new(|board| {
            board.supply().show_role(RoleLamp::Standby);
            while let Some(received) = board.can().try_receive() {
                let value = received.frame.data()[0];
                board.can().try_send(&frame(value + 100)).unwrap();
            }
            board.can().wake_on_receive(true);
            Instant::NEVER
        })
    });
    pair.power_off(B);
    let ticks = Arc::new(Mutex::new(Vec::new()));
    let reported = Arc::clone(&ticks);
    let mut count = 0;
    pair.set_world(move |tick| {
        count += 1;
        tick.broadcast(&frame(count));
        reported
            .lock()
            .unwrap()
            .push((tick.at, tick.heard.clone(), tick.lamps));
    });
    pair.run_until(Instant::from_ns(3_000_000));
    let ticks = ticks.lock().unwrap();
    assert_eq!(ticks.len(), 4, "at 0, 1, 2 and 3 ms");
    let (at, heard, lamps) = &ticks[2];
    assert_eq!(at.as_ns(), 2_000_000);
    assert_eq!(*lamps, [Some(RoleLamp::Standby), None]);
    let heard: Vec<_> = heard
        .iter()
        .map(|seen| (seen.sender, seen.frame.data()[0]))
        .collect();
    assert_eq!(
        heard,
        [(Sender::Vehicle, 2), (Sender::Core(CoreAddress::A0), 102)]
    );
    assert_eq!(pair.take_bus_log().len(), 8);
}

#[test]
fn a_killed_blocking_core_unwinds_out_of_its_wait() {
    struct Told(Arc<AtomicU32>);
    impl Drop for Told {
        fn drop(&mut self) {
            self.0.fetch_add(1, Ordering::Relaxed);
        }
    }
    let unwound = Arc::new(AtomicU32::new(0));
    let reported = Arc::clone(&unwound);
    let mut pair = pair_with(relaxed(), CoreId::PLANNING, move |board| {
        let reported = Told(Arc::clone(&reported));
        blocking(board, move |board| {
            let _told = reported;
            loop {
                board.wait(board.now() + ms(1));
            }
        })
    });
    pair.run_for(ms(5));
    assert_eq!(unwound.load(Ordering::Relaxed), 0);
    pair.kill_core(A, CoreId::PLANNING);
    assert_eq!(unwound.load(Ordering::Relaxed), 1);
    pair.restart_core(A, CoreId::PLANNING);
    drop(pair);
    assert_eq!(unwound.load(Ordering::Relaxed), 2);
}

#[test]
#[should_panic(expected = "out of a core")]
fn a_panic_in_a_blocking_core_comes_out() {
    let mut pair = pair_with(relaxed(), CONTROL, |board| {
        blocking(board, |board| {
            board.wait(board.now() + ms(1));
            panic!("out of a core");
        })
    });
    pair.run_for(ms(5));
}

#[test]
#[should_panic(expected = "wake each other for ever")]
fn a_livelock_panics() {
    let mut pair = pair_with(relaxed(), CONTROL, |_| Box::new(|board| board.now()));
    pair.run_for(ms(5));
}

#[test]
#[should_panic(expected = "a polled core cannot wait")]
fn a_polled_core_cannot_wait() {
    let pair = SimPair::idle(relaxed());
    pair.board(A, CONTROL).wait(Instant::NEVER);
}

#[test]
fn a_full_trace_counts_what_it_loses() {
    let mut pair = SimPair::idle(Config {
        trace_records: 3,
        ..relaxed()
    });
    for number in 0..5 {
        pair.board(B, CoreId::PLANNING).trace([number; 4]);
    }
    let (trace, lost) = pair.take_trace();
    assert_eq!((trace.len(), lost), (3, 2));
    assert_eq!(
        (trace[2].system, trace[2].core, trace[2].record),
        (B, CoreId::PLANNING, [2; 4])
    );
}
