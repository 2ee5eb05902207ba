//! The other system sends without pause on all connections to core 0.

use crate::run::{Case, Script};
use core::time::Duration as Span;
use std::thread;
use tandem_board::{
    Board, Can, CanFrame, CanId, CoreId, Duration, Edge, Line, Lines, Link, RoleLamp, Supply,
    SystemId, VehiclePort, watchdog_answer,
};
use tandem_board_host::realtime::Grant;
use tandem_board_host::{CoreArgs, HostBoard};
use tandem_cores::doorbell::DOORBELL_DISTANCE;
use tandem_cores::task_table::IrqCode;
use tandem_cores::trace::{Event, FloodSource};

pub(crate) const CASE: Case = Case {
    name: "a_system_that_floods_the_other_does_not_take_it_down",
    before: |_| (),
    peer: babble,
    vehicle: drive_on,
};

/// Duration of the flood.
const FLOOD: Duration = Duration::from_ms(1_000);

/// Services the watchdog, and floods core 0 of A while A drives.
fn babble(_: &CoreArgs, board: HostBoard, _: Grant) {
    let frame = CanFrame::new(CanId::Standard(0x0A0), true, &[0; 16]).expect("a frame");
    let mut served = board.now();
    loop {
        if board.now().since(served) >= Duration::from_ms(8) {
            served = board.now();
            let supply = board.supply();
            supply.service_watchdog(watchdog_answer(supply.watchdog_question()));
        }
        if drives(board.backplane().role(SystemId::A)) {
            for _ in 0..200 {
                let _ = board.link().try_send(&[0xDEAD_BEEF; 4]);
                let _ = board.can().try_send(&frame);
                for line in [Line::Start, Line::Heartbeat1, Line::Heartbeat2] {
                    board.lines().send(line, Edge::Falling);
                }
            }
        }
        // Pause: this process shares a CPU with A, while a real second system has its own.
        thread::sleep(Span::from_micros(200));
    }
}

const fn drives(lamp: RoleLamp) -> bool {
    matches!(lamp, RoleLamp::Master | RoleLamp::DegradedMaster)
}

/// T-CHIP-5, T-SYNC-3: core 0 continues to drive in its first incarnation, takes at most as many
/// interrupts as its limit permits, and reports each source.
fn drive_on(script: &mut Script) {
    let incarnation = |script: &Script| {
        let backplane = script.port().backplane();
        backplane.generation(SystemId::A, CoreId::CONTROL)
    };
    // Repeat after a reset: if the machine takes the CPU from core 0 for too long, its watchdog
    // resets it. simulated::floods checks in virtual time that the flood itself causes no reset.
    let (begin, frames) = loop {
        let frames = script.accepted.len();
        script.until("A drives", |script| {
            drives(script.port().role(SystemId::A)) && script.accepted.len() > frames
        });
        let before = incarnation(script);
        let (begin, frames) = (script.now(), script.accepted.len());
        script.drive_for(FLOOD);
        if incarnation(script) == before && script.accepted.len() > frames {
            break (begin, frames);
        }
    };
    let span = script.now().since(begin);

    let accepted = &script.accepted[frames..];
    assert!(accepted.iter().all(|(_, by)| *by == SystemId::A));

    let events = script.traced.iter().filter(|(entry, _)| {
        (entry.system, entry.core) == (SystemId::A, CoreId::CONTROL) && entry.at >= begin
    });
    let events: Vec<&Event> = events.map(|(_, event)| event).collect();
    let doorbell = Event::IrqIn {
        irq: IrqCode::DOORBELL,
    };
    let interrupts = events.iter().filter(|event| ***event == doorbell).count() as u64;
    let most = span.as_ns() / DOORBELL_DISTANCE.as_ns() + 2;
    assert!(
        interrupts <= most,
        "{interrupts} interrupts, at most {most}"
    );
    for wanted in [
        FloodSource::Link,
        FloodSource::StartLine,
        FloodSource::HeartbeatLines,
        FloodSource::Doorbell,
    ] {
        let reported = events
            .iter()
            .any(|&&event| matches!(event, Event::Flood { source, .. } if source == wanted));
        assert!(reported, "no word of {wanted:?}");
    }
}
