//! The locked sections of a control cycle: how many it takes, and what may run between them.

use crate::one_flow;
use std::cell::RefCell;
use std::rc::Rc;
use tandem_board::{Board, CoreId, Duration, SystemId};
use tandem_cores::Config;
use tandem_cores::core0::Core0Task;
use tandem_cores::trace::Event;
use tandem_sim::drive::{Drive, poller};

const MS: fn(u64) -> Duration = Duration::from_ms;
/// Both systems drive and stand by after this time.
const START: Duration = Duration::from_ms(6_000);

/// T-CHIP-6: a control cycle locks three times: to take its inputs, to compute and to send. In
/// degraded mode the control task locks once more, to pass the cycle on.
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

/// T-RED-9: the roles run between two sections of a control cycle, and this system becomes master
/// or stops being it. It sends a control frame only if it is master at that time, and never in an
/// earlier term.
#[test]
fn a_role_that_changes_within_a_control_cycle_counts_at_once() {
    let mut changes_within_a_cycle = 0;
    for (section, shift) in [2, 3]
        .into_iter()
        .flat_map(|it| (0..10).map(move |ms| (it, ms)))
    {
        let mut drive = Drive::with("free-lane", 4, move |board| {
            if board.identity().core == CoreId::CONTROL {
                one_flow::core_0(board, || true, Some(section), |_, _| ())
            } else {
                poller(board, Config::rt())
            }
        });
        drive.run_for(START + MS(shift));
        drive.pair.power_off(SystemId::A);
        drive.run_for(MS(200));
        drive.pair.power_on(SystemId::A);
        drive.run_for(START);
        drive.pair.kill_core(SystemId::B, CoreId::PERCEPTION);
        drive.run_for(MS(500));
        assert_eq!(drive.masters(), [SystemId::A, SystemId::B, SystemId::A]);
        assert_eq!(drive.seen.borrow().world.gate().counts().fenced, 0);
        for of in SystemId::ALL {
            let (mut role, mut last_term, mut in_cycle) = (0, 0, false);
            let of_core_0 =
                |it: &&(_, SystemId, CoreId, Event)| (it.1, it.2) == (of, CoreId::CONTROL);
            for (at, _, _, event) in drive.events.iter().filter(of_core_0) {
                match *event {
                    Event::TaskIn { task, .. } if task.is_control() => in_cycle = true,
                    Event::TaskOut { task, .. } if task.is_control() => in_cycle = false,
                    Event::Role {
                        role: new, term, ..
                    } => {
                        assert!(term >= last_term, "{at:?}");
                        changes_within_a_cycle += u32::from(in_cycle && role != new);
                        (role, last_term) = (new, term);
                    }
                    Event::ControlCycle {
                        transmitted: true, ..
                    } => {
                        assert_eq!(role, 1, "{of} sends at {at:?}");
                    }
                    _ => {}
                }
            }
        }
    }
    println!("{changes_within_a_cycle} changes of the role within a control cycle");
    assert!(changes_within_a_cycle > 0);
}
