//! Each event survives its record.

use super::*;

#[test]
fn every_event_survives_the_trace() {
    let phase = |from, to| Event::Phase {
        from,
        to,
        on: Evidence::PeerOff,
    };
    let leaves = |leaves| Event::TaskOut {
        task: TaskCode::MONITORING,
        leaves,
    };
    let flood = |source| Event::Flood {
        source,
        times: 12,
        beyond: 3,
    };
    let events = [
        Event::Started {
            generation: 3,
            cause: 2,
        },
        Event::Role {
            role: 1,
            mode: 2,
            term: 9,
        },
        phase(Phase::Standby, Phase::DegradedMaster),
        Event::TookOver {
            cause: Evidence::PeerSilent,
            since_heartbeat_us: 4000,
            since_control_us: 12_000,
            term: 4,
        },
        Event::PeerFailed(true),
        Event::Line {
            line: 2,
            silent: true,
        },
        Event::LinesSplit,
        Event::CanSilent(false),
        Event::Ignored { term: 6 },
        Event::TermRaised { term: 7 },
        Event::StateLost,
        Event::ControlCycle {
            lateness_ns: 1,
            execution_ns: 2,
            transmitted: true,
        },
        Event::Chain {
            latency_ns: 7,
            cycle: 8,
        },
        Event::CoreSilent { core: 2 },
        Event::DeadlineMiss {
            task: TaskCode::CONTROL,
            missed: 5,
        },
        Event::FramesLost { count: 77 },
        Event::Sensors { missing: 33 },
        Event::CanErrors {
            errors: CanErrors {
                transmit: 256,
                receive: 3,
                bus_offs: 1,
            },
        },
        Event::Refused { id: 0x110 },
        Event::TaskIn {
            task: TaskCode::CONTROL,
            begin: Begin::Goes,
        },
        Event::TaskIn {
            task: TaskCode(200),
            begin: Begin::Released {
                late_ns: 12,
                missed: 3,
            },
        },
        leaves(Leaves::Done),
        leaves(Leaves::Blocked),
        leaves(Leaves::Preempted),
        leaves(Leaves::Gives),
        Event::Ready {
            task: TaskCode::STATUS,
        },
        Event::IrqIn { irq: IrqCode::TICK },
        Event::IrqOut {
            irq: IrqCode::DOORBELL,
        },
        Event::Interrupted {
            irq: IrqCode::DOORBELL,
        },
        Event::Wake {
            core: CoreId::PLANNING,
            task: TaskCode::PLANNING,
            flow: 77,
        },
        Event::Woken {
            core: CoreId::PERCEPTION,
            flow: 77,
        },
        Event::Stack {
            task: TaskCode::CONTROL,
            free_bytes: 900,
        },
        Event::Ring {
            core: CoreId::CONTROL,
        },
        Event::Held {
            task: TaskCode::STATUS,
            longest_ns: 1200,
        },
        flood(FloodSource::Can),
        flood(FloodSource::Doorbell),
        Event::Agreement {
            stage: 2,
            percent: 99,
        },
        Event::WrongCommand { witness: 1 },
        Event::ClockWrong { of: 2 },
        Event::SocSilent { topic: 3 },
        Event::OutputFault { found: 2 },
        Event::WrongScene {
            what: 4,
            hearing: true,
            thousandths: 50,
        },
        Event::SceneCheck { percent: 40 },
        Event::WrongEcho,
        Event::PeerScene {
            what: 1,
            own: false,
            thousandths: 7,
        },
        Event::Ability {
            bits: 2,
            missing: 0x40,
        },
        Event::SensorContradicted { sensor: 5 },
        Event::StampRefused {
            source: 6,
            later: true,
            off_us: 50_000,
        },
        Event::WrongTrajectory {
            what: 4,
            percent: 300,
        },
        Event::TrajectoryCheck {
            what: 0,
            percent: 40,
        },
    ];
    for event in events {
        assert_eq!(Event::decode(event.encode()), Some(event));
    }
    assert_eq!(Event::decode([0; 4]), None);
    assert_eq!(Event::decode([0xFF03, 0, 0, 0]), None);
    for strange in [
        0x0002_0011,
        0x0004_0012,
        0x0000_0317,
        0x0000_0318,
        0x051C,
        0x031D,
        0x021E,
        0x031F,
        0x0320,
        0x0928,
        0x0430,
        0x0434,
        36,
    ] {
        assert_eq!(Event::decode([strange, 0, 0, 0]), None, "{strange:X}");
    }
}
