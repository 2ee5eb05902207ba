//! Two systems in one process and in virtual time. The master loses power, and the other one takes
//! over. `cargo run -p tandem-redundancy --example failover`
#![allow(clippy::print_stdout, reason = "its output is its purpose")]

use tandem_board::{Duration, Edge, Instant, Line, ResetCause, SystemId};
use tandem_redundancy::{
    Action, Config, ControlHeader, Input, LineSnapshot, Loaded, Redundancy, RedundancyEvent, Role,
};

const MS: u64 = 1_000_000;
/// When A loses power, ms.
const CUT_MS: u64 = 1_000;

/// A system, and what the other one's wires have carried to it.
struct System {
    machine: Redundancy,
    edges: Vec<(Line, Edge)>,
    can_frames: u32,
    next_frame: u64,
}

impl System {
    fn new(system: SystemId) -> Self {
        let (config, now) = (Config::rt(), Instant::ORIGIN);
        Self {
            machine: Redundancy::new(config, system, ResetCause::PowerOn, Loaded::Blank, now),
            edges: vec![],
            can_frames: 0,
            next_frame: 0,
        }
    }
}

fn main() {
    let ids = [SystemId::A, SystemId::B];
    let mut systems = ids.map(System::new);
    for ms in 0..2 * CUT_MS {
        let now = Instant::from_ns(ms * MS);
        let powered = [ms < CUT_MS, true];
        if ms == CUT_MS {
            println!("{ms:5} ms  A: power is cut");
        }
        for of in (0..2).filter(|of| powered[*of]) {
            let received = |line, edge| {
                let all = systems[of].edges.iter();
                all.filter(|it| **it == (line, edge)).count() as u32
            };
            let lines = LineSnapshot::new(received, powered[1 - of], systems[of].can_frames);
            let actions = systems[of].machine.on(now, Input::Poll(lines));
            for action in actions.iter() {
                match action {
                    Action::SendEdge(line, edge) => systems[1 - of].edges.push((line, edge)),
                    Action::Transmit | Action::AlignControl => systems[of].next_frame = ms,
                    Action::Record(RedundancyEvent::Phase { from, to, on }) => {
                        println!("{ms:5} ms  {}: {from:?} to {to:?}, on {on:?}", ids[of]);
                    }
                    Action::Record(RedundancyEvent::Takeover(takeover)) => {
                        println!("{ms:5} ms  {}: takes over ({:?})", ids[of], takeover.cause);
                    }
                    // Here is neither flash nor a transmit buffer.
                    Action::Record(_) | Action::Persist(_) | Action::DiscardUnsent => {}
                    Action::Reset(request) => println!("{ms:5} ms  {}: {request:?}", ids[of]),
                }
            }
            // A control frame each 10 ms, if this system may drive: the other one hears it.
            if ms >= systems[of].next_frame && systems[of].machine.may_transmit(now) {
                let term = systems[of].machine.term();
                let (system, role, mode) = (ids[of], Role::Master, systems[of].machine.mode());
                let header = ControlHeader {
                    system,
                    term,
                    role,
                    mode,
                };
                let _ = systems[1 - of].machine.on(now, Input::ControlFrame(header));
                systems[of].next_frame = ms + Duration::from_ms(10).as_ns() / MS;
            }
            // What it tells the other one of itself, each 50 ms.
            if ms % 50 == 0 {
                let report = systems[of].machine.report();
                let _ = systems[1 - of].machine.on(now, Input::StatusFrame(report));
            }
            // The vehicle's frames show that the bus works.
            systems[of].can_frames += 1;
        }
    }
    assert_eq!(systems[1].machine.phase().role(), Role::Master);
}
