//! Tests of the locked sections of a control cycle: their number, and preemption between them.

use crate::one_flow;
use std::cell::RefCell;
use std::collections::HashMap;
use std::rc::Rc;
use tandem_board::{Board, CanFrame, CanId, CoreId, Duration, SystemId};
use tandem_bus::{Control, FrameTransmitter, Message, RoleCode};
use tandem_cores::Config;
use tandem_cores::core0::Core0Task;
use tandem_cores::trace::Event;
use tandem_redundancy::Role;
use tandem_sim::drive::{Drive, poller};

const MS: fn(u64) -> Duration = Duration::from_ms;
/// Both systems are in dual operation after this time.
const START: Duration = Duration::from_ms(6_000);

/// T-CHIP-6: a control cycle locks three times: to take its inputs, to compute and to send. In
/// degraded mode the degraded task does so; the control task locks once, to release that task.
#[test]
fn a_control_cycle_takes_three_locked_sections() {
    let counted = Rc::new(RefCell::new(Vec::new()));
    let counts = Rc::clone(&counted);
    let mut drive = Drive::with("free-lane", 4, move |board| {
        if board.identity().core != CoreId::CONTROL {
            return poller(board, Config::rt());
        }
        let counts = Rc::clone(&counts);
        let after = move |task, flow: &one_flow::OneFlow| {
            let row = (task, flow.has_begun.get(), flow.sections.get());
            counts.borrow_mut().push(row);
        };
        one_flow::core_0(board, || true, None, after)
    });
    drive.run_for(START);
    drive.pair.power_off(SystemId::A);
    drive.run_for(MS(2_000));
    for (task, has_begun, sections) in counted.borrow().iter() {
        let expected = if *has_begun { 3 } else { 1 };
        assert_eq!(*sections, expected, "{task:?}");
    }
    for task in [Core0Task::Control, Core0Task::Degraded] {
        let cycles = counted
            .borrow()
            .iter()
            .filter(|it| it.0 == task && it.1)
            .count();
        assert!(cycles > 100, "{cycles} cycles of {task:?}");
    }
}

/// Changes of role between the first and the last section of a control cycle.
#[derive(Debug, Default)]
struct Changes {
    /// The system became master.
    gained: u32,
    /// The system was master and lost the role.
    lost: u32,
}

/// Starts a drive in which the urgent tasks run before this section of each control job.
fn preempted(section: u32) -> Drive {
    Drive::with("free-lane", 4, move |board| {
        if board.identity().core == CoreId::CONTROL {
            one_flow::core_0(board, || true, Some(section), |_, _| ())
        } else {
            poller(board, Config::rt())
        }
    })
}

/// Counts the changes within a cycle. Checks that each control frame carries the term that its
/// sender has as master at the time of sending.
fn changes_within_a_cycle(drive: &Drive) -> Changes {
    let master = Role::Master as u8;
    let log = &drive.seen.borrow().log;
    let (mut changes, mut frames) = (Changes::default(), 0);
    for of in SystemId::ALL {
        let (mut role, mut term, mut in_cycle) = (Role::Starting as u8, 0, false);
        let sent = log.control.iter().filter(|it| it.system == of);
        let sent_terms: HashMap<_, _> = sent.map(|it| (it.sent_ns, it.term)).collect();
        let of_core_0 = |it: &&(_, SystemId, CoreId, Event)| (it.1, it.2) == (of, CoreId::CONTROL);
        for (at, _, _, event) in drive.events.iter().filter(of_core_0) {
            match *event {
                Event::TaskIn { task, .. } if task.is_control() => in_cycle = true,
                Event::TaskOut { task, .. } if task.is_control() => in_cycle = false,
                Event::Role {
                    role: new_role,
                    term: new_term,
                    ..
                } => {
                    assert!(new_term >= term, "{at:?}");
                    changes.gained += u32::from(in_cycle && role != master && new_role == master);
                    changes.lost += u32::from(in_cycle && role == master && new_role != master);
                    (role, term) = (new_role, new_term);
                }
                Event::ControlCycle {
                    transmitted: true, ..
                } => {
                    assert_eq!(role, master, "{of} sends at {at:?}");
                    if let Some(sent) = sent_terms.get(&at.as_ns()) {
                        assert_eq!(*sent, term, "{of} sends at {at:?}");
                        frames += 1;
                    }
                }
                _ => {}
            }
        }
    }
    assert!(frames > 100, "{frames} frames");
    changes
}

/// T-RED-9: a standby takes over between two sections of a control cycle. It sends as master in
/// its new term at once.
#[test]
fn a_system_that_becomes_master_within_a_control_cycle_sends_in_its_new_term() {
    for section in [2, 3] {
        let mut gained = 0;
        for shift in 0..10 {
            let mut drive = preempted(section);
            drive.run_for(START + MS(shift));
            drive.pair.power_off(SystemId::A);
            drive.run_for(MS(200));
            drive.pair.power_on(SystemId::A);
            drive.run_for(START);
            drive.pair.kill_core(SystemId::B, CoreId::PERCEPTION);
            drive.run_for(MS(500));
            assert_eq!(drive.masters(), [SystemId::A, SystemId::B, SystemId::A]);
            assert_eq!(drive.seen.borrow().world.gate().counts().fenced, 0);
            gained += changes_within_a_cycle(&drive).gained;
        }
        assert!(gained > 0, "no takeover before section {section}");
    }
}

/// T-RED-9: a master receives a higher term between two sections of a control cycle, and loses its
/// role. It sends no control frame in that cycle, with or without a standby.
#[test]
fn a_master_that_loses_its_role_within_a_control_cycle_sends_no_frame() {
    for (section, is_alone) in [(2, false), (3, false), (2, true), (3, true)] {
        let mut lost = 0;
        // At least one of these times is in the pause before a control job.
        for shift in [0, 3, 6, 9] {
            let mut drive = preempted(section);
            drive.run_for(START);
            if is_alone {
                drive.pair.power_off(SystemId::B);
                drive.run_for(MS(500));
            }
            drive.run_for(MS(shift));
            let obeyed = drive.seen.borrow().world.gate().accepted();
            let obeyed = obeyed.expect("A drives");
            assert_eq!(usize::from(obeyed.system), SystemId::A.index());
            let control = Control {
                role: RoleCode::Master,
                // The terms of A and B alternate, so an odd step gives a term of B.
                term: obeyed.term + 41,
                ..Control::default()
            };
            let system = SystemId::B.index() as u8;
            let frame = FrameTransmitter::new().encode(&Message::Control { system, control });
            let frame = CanFrame::new(CanId::Standard(frame.id), true, frame.data());
            let frame = frame.expect("of the DBC");
            drive.seen.borrow_mut().forged.push(frame);
            drive.run_for(MS(200));
            lost += changes_within_a_cycle(&drive).lost;
        }
        assert!(
            lost > 0,
            "A keeps its role before section {section}, alone: {is_alone}"
        );
    }
}
