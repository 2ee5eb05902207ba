//! Each fault that a system can detect in itself can be caused, and has the stated effect.

use tandem_board::{
    Board, Can, CanFrame, CanId, CoreId, Duration, HardwareFault, ResetCause, RoleLamp, SystemId,
};
use tandem_board_sim::Wire;
use tandem_cores::task_table::TaskCode;
use tandem_cores::trace::Event;
use tandem_peripherals::memory::scribble;
use tandem_redundancy::{Evidence, FailureMode, SystemState, Term};
use tandem_sim::drive::Drive;

use SystemId::{A, B};

const MS: fn(u64) -> Duration = Duration::from_ms;

fn started() -> Drive {
    let mut drive = Drive::new("free-lane", 8);
    drive.run_for(MS(5_000));
    assert_eq!(drive.masters(), [A]);
    drive
}

fn with_fault(fault: HardwareFault) -> Drive {
    let mut drive = started();
    drive.pair.set_fault(A, fault, true);
    drive
}

/// Starts a drive in which B drives in the last term, and then loses its power.
fn no_term_left() -> Drive {
    let mut drive = Drive::new("free-lane", 8);
    for system in SystemId::ALL {
        drive.pair.power_off(system);
        let state = SystemState {
            is_master: system == B,
            term: Term::from_bits(Term::LAST.bits() - 2),
            ..SystemState::factory(system)
        };
        drive.pair.edit_flash(system, |bytes| {
            bytes.fill(0xFF);
            bytes[..SystemState::BYTES].copy_from_slice(&state.encode(1));
        });
    }
    for system in SystemId::ALL {
        drive.pair.power_on(system);
    }
    drive.run_for(MS(5_000));
    assert_eq!(drive.masters(), [B]);
    drive.pair.power_off(B);
    drive
}

/// Returns the events of a system's cores that the drive has recorded.
fn events(drive: &Drive, of: SystemId) -> impl Iterator<Item = (CoreId, Event)> {
    let reported = drive
        .events
        .iter()
        .filter(move |(_, system, ..)| *system == of);
    reported.map(|(_, _, core, event)| (*core, *event))
}

/// T-RED-5, T-RED-6: each failure mode can be caused, and the affected system writes it to its
/// flash. The test does not compile if a mode has no source.
#[test]
fn each_failure_mode_has_a_source() {
    for &mode in FailureMode::ALL {
        let source: fn() -> Drive = match mode {
            // These are not faults. `Unknown` represents a mode of a later version.
            FailureMode::None | FailureMode::Unknown => continue,
            FailureMode::AbnormalResets => || {
                let mut drive = started();
                for _ in 0..6 {
                    drive.pair.reset(A, ResetCause::Watchdog);
                    drive.run_for(MS(1_500));
                }
                drive
            },
            FailureMode::CanOpenCircuit => || {
                let mut drive = started();
                drive.pair.cut(Wire::Can, A);
                drive
            },
            FailureMode::IoModule => || with_fault(HardwareFault::OpenLoad),
            FailureMode::PerceptionCore => || {
                let mut drive = started();
                drive.pair.kill_core(A, CoreId::PERCEPTION);
                drive
            },
            FailureMode::PlanningCore => || {
                let mut drive = started();
                drive.pair.kill_core(A, CoreId::PLANNING);
                drive
            },
            FailureMode::Deadline => || crate::hung::drive(A),
            FailureMode::TermsExhausted => no_term_left,
            FailureMode::WrongCommand => crate::wrong::stuck,
            FailureMode::Clock => || {
                let mut drive = started();
                drive.pair.set_clock_rate(A, 50_000_000);
                drive
            },
            FailureMode::CanBusOff => || with_fault(HardwareFault::CanTransmit),
            FailureMode::WrongScene => crate::values::wrong_scene,
        };
        let mut drive = source();
        // Repeated resets that do not cure the fault finally become a failure mode.
        let found = (0..60).any(|_| {
            drive.run_for(MS(50));
            drive.state_in_flash(A).failure_mode == mode
        });
        assert!(found, "{mode:?}: {:?}", drive.state_in_flash(A));
        assert_eq!(drive.two_masters_ns(), 0, "{mode:?}");
    }
}

const fn is_bus_off(event: &Event) -> bool {
    matches!(event, Event::CanErrors { errors } if errors.bus_offs > 0)
}

/// T-RED-6: if the bus destroys a master's frames, the master is bus-off within milliseconds. It
/// resigns over the link, and the standby drives. After its last retry the master is suspended.
#[test]
fn a_master_that_is_bus_off_resigns() {
    let mut drive = with_fault(HardwareFault::CanTransmit);
    drive.run_for(MS(6_000));
    crate::print_story(&drive);
    assert_eq!(drive.masters(), [A, B]);
    let causes: Vec<_> = drive.takeovers().iter().map(|of| of.cause).collect();
    assert_eq!(causes, [Some(Evidence::MasterResigns)]);
    assert_eq!(drive.gaps_beyond(), []);
    assert!(drive.gap_max() <= MS(16), "{:?}", drive.gap_max());
    assert_eq!(
        (drive.two_masters_ns(), drive.both_transmitted_ms()),
        (0, 0.0)
    );
    assert!(events(&drive, A).any(|(_, event)| is_bus_off(&event)));
    let state = drive.state_in_flash(A);
    assert!(state.sys_failure);
    assert_eq!(state.failure_mode, FailureMode::CanBusOff);
    assert_eq!(drive.pair.lamp(A), None, "held in reset");
}

/// T-RED-6: a standby that is bus-off leaves, and the master drives on. A disturbance of 3 ms is
/// not a fault of either system.
#[test]
fn a_standby_that_is_bus_off_costs_no_frame() {
    let mut drive = started();
    for of in SystemId::ALL {
        // Wait until more than one frame has been destroyed.
        drive.pair.set_fault(of, HardwareFault::CanTransmit, true);
        while drive
            .pair
            .board(of, CoreId::CONTROL)
            .can()
            .errors()
            .transmit
            < 16
        {
            drive.run_for(MS(1));
        }
        drive.pair.set_fault(of, HardwareFault::CanTransmit, false);
        drive.run_for(MS(500));
    }
    assert_eq!(drive.masters(), [A]);
    assert!(!drive.state_in_flash(A).failure_mode.reset_may_cure());
    drive.pair.set_fault(B, HardwareFault::CanTransmit, true);
    drive.run_for(MS(10_000));
    crate::print_story(&drive);
    assert_eq!(drive.masters(), [A]);
    assert_eq!(drive.gaps_beyond(), []);
    assert_eq!(drive.state_in_flash(B).failure_mode, FailureMode::CanBusOff);
    let of_a = events(&drive, A).find(|(_, event)| is_bus_off(event));
    assert_eq!(of_a, None);
}

/// T-CHIP-6: faults of the rails and of the error pin of the master's supply. The standby takes
/// over when the level line falls. The master returns as standby; an overvoltage keeps it off.
#[test]
fn a_fault_of_the_supply_is_a_reset() {
    for (fault, cause) in [
        (HardwareFault::ErrorPin, Some(ResetCause::ErrorPin)),
        (HardwareFault::Undervoltage, Some(ResetCause::Undervoltage)),
        (HardwareFault::Overvoltage, None),
    ] {
        let mut drive = with_fault(fault);
        drive.run_for(MS(200));
        drive.pair.set_fault(A, fault, false);
        drive.run_for(MS(3_000));
        assert_eq!(drive.masters(), [A, B], "{fault:?}");
        let causes: Vec<_> = drive.takeovers().iter().map(|of| of.cause).collect();
        assert_eq!(causes, [Some(Evidence::PeerOff)], "{fault:?}");
        assert_eq!(drive.gaps_beyond(), [], "{fault:?}");
        let again = events(&drive, A).find_map(|(core, event)| match event {
            Event::Started {
                generation: 2,
                cause,
            } if core == CoreId::CONTROL => Some(cause),
            _ => None,
        });
        assert_eq!(again, cause.map(|cause| cause.code() as u8), "{fault:?}");
        let abnormal = u32::from(cause.is_some());
        assert_eq!(drive.state_in_flash(A).abn_resets, abnormal, "{fault:?}");
        let lamp = cause.map(|_| RoleLamp::Standby);
        assert_eq!(drive.pair.lamp(A), lamp, "{fault:?}");
    }
}

/// T-CHIP-3: each core reports the number of jobs that it omitted, by task.
#[test]
fn jobs_that_did_not_run_are_counted() {
    for (core, frozen_ms, tasks) in [
        (
            CoreId::CONTROL,
            // Shorter than the watchdog's window.
            12,
            &[
                (TaskCode::ROLES, 10..=12),
                (TaskCode::MONITORING, 1..=2),
                (TaskCode::DEGRADED, 1..=1),
            ][..],
        ),
        (CoreId::PERCEPTION, 220, &[(TaskCode::PERCEPTION, 3..=4)]),
        (CoreId::PLANNING, 220, &[(TaskCode::PLANNING, 3..=4)]),
    ] {
        let mut drive = started();
        // Remove the peer, which would take over from a system without one of its cores.
        drive.pair.power_off(B);
        drive.run_for(MS(1_000));
        drive.events.clear();
        drive.pair.freeze_core(A, core, MS(frozen_ms));
        drive.run_for(MS(400));
        for (task, expected) in tasks {
            let missed: u32 = events(&drive, A)
                .filter_map(|(of, event)| match event {
                    Event::DeadlineMiss {
                        task: which,
                        missed,
                    } if which == *task => {
                        assert_eq!(of, core);
                        Some(missed)
                    }
                    _ => None,
                })
                .sum();
            assert!(expected.contains(&missed), "{task:?}: {missed}");
        }
    }
}

/// T-CHIP-7: each receiving core reports the number of frames that its full receiver lost.
#[test]
fn received_frames_that_were_lost_are_counted() {
    const FLOOD: u32 = 800;
    let mut drive = started();
    drive.events.clear();
    let frame = CanFrame::new(CanId::Standard(0x7F0), true, &[0; 8]).expect("a frame");
    let forged = vec![frame; FLOOD as usize];
    drive.seen.borrow_mut().forged = forged;
    drive.run_for(MS(200));
    for system in SystemId::ALL {
        for core in [CoreId::CONTROL, CoreId::PERCEPTION] {
            let lost = events(&drive, system).find_map(|(of, event)| match event {
                Event::FramesLost { count } if of == core => Some(count),
                _ => None,
            });
            let kept = tandem_board_sim::Config::default().can_fifo_frames as u32;
            let expected = FLOOD - kept..FLOOD;
            assert!(
                lost.is_some_and(|lost| expected.contains(&lost)),
                "{system}{core}: {lost:?}"
            );
        }
    }
    assert_eq!(drive.masters(), [A]);
}

/// T-SHM-4: a core overwrites the whole LMU of its system. The readers reject the data, or the
/// alive supervision detects a missing core. The system repairs its LMU or leaves, and one system
/// drives.
#[test]
fn a_scribbled_lmu_is_found_and_costs_no_frame() {
    for of in SystemId::ALL {
        for seed in 1..=6_u32 {
            let mut drive = started();
            drive.events.clear();
            scribble(drive.pair.lmu(of), seed.wrapping_mul(0x9E37_79B9));
            drive.run_for(MS(5_000));
            let found = events(&drive, of).find(|(_, event)| {
                matches!(
                    event,
                    Event::Refused { .. } | Event::CoreSilent { .. } | Event::WrongCommand { .. }
                )
            });
            println!("{of} {seed}: {found:?}, {:?}", drive.masters());
            assert!(found.is_some(), "{of} {seed}");
            assert_eq!(drive.gaps_beyond(), [], "{of} {seed}");
            assert_eq!(drive.two_masters_ns(), 0);
            assert_eq!(drive.collisions(), 0);
            let lamps = [A, B].map(|system| drive.pair.lamp(system));
            let driving = [RoleLamp::Master, RoleLamp::DegradedMaster].map(Some);
            let masters = lamps.iter().filter(|lamp| driving.contains(lamp));
            assert_eq!(masters.count(), 1, "{of} {seed}: {lamps:?}");
            assert!(drive.pair.lamp(of).is_some(), "it comes back");
        }
    }
}
