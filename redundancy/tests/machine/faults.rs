//! Faults that a system finds in itself, and its own stalls.

use super::{Bench, CONFIG, sound};
use tandem_board::{Duration, Instant, ResetCause, ResetRequest, SystemId};
use tandem_redundancy::{
    Action, Actions, FailureMode, Input, Loaded, Phase, Redundancy, Role, SystemState, Term,
};

/// T-RED-5: the first fault counts; the first one that no reset cures replaces it.
#[test]
fn the_first_fault_counts_and_a_permanent_one_after_it() {
    use FailureMode::{AbnormalResets, IoModule, None, PerceptionCore, PlanningCore};
    for (faults, counts, stays) in [
        ([None, None], None, false),
        ([None, PlanningCore], PlanningCore, false),
        ([PlanningCore, PerceptionCore], PlanningCore, false),
        ([PlanningCore, IoModule], IoModule, true),
        ([IoModule, PlanningCore], IoModule, true),
        ([IoModule, AbnormalResets], IoModule, true),
        ([AbnormalResets, IoModule], AbnormalResets, true),
    ] {
        let mut bench = Bench::master();
        for fault in faults {
            let _ = bench.on(Input::OwnFault(fault));
        }
        let state = bench.machine.state();
        let found = (state.failure_mode, state.sys_failure);
        assert_eq!(found, (counts, stays), "{faults:?}");
        let drives_on = bench.machine.phase() == Phase::Master;
        assert_eq!(drives_on, counts == None, "{faults:?}");
    }
}

/// T-RED-5: a system that waits for its reset suspends for a fault that no reset cures. A suspended
/// system counts no further fault.
#[test]
fn a_system_that_waits_for_its_reset_suspends_for_a_permanent_fault() {
    for (fault, phase, request) in [
        (
            FailureMode::WrongCommand,
            Phase::Resetting,
            ResetRequest::CoreDead,
        ),
        (
            FailureMode::IoModule,
            Phase::Suspended,
            ResetRequest::Suspend,
        ),
    ] {
        let mut bench = Bench::standby();
        let _ = bench.control(16);
        let _ = bench.on(Input::OwnFault(FailureMode::PlanningCore));
        assert_eq!(bench.machine.phase(), Phase::Resetting);
        let actions = bench.on(Input::OwnFault(fault));
        assert_eq!(bench.machine.phase(), phase);
        assert!(actions.contains(Action::Reset(request)), "{actions:?}");
        let _ = bench.on(Input::OwnFault(FailureMode::WrongCommand));
        let counted = u8::from(phase == Phase::Resetting);
        assert_eq!(bench.machine.state().wrong_in_a_row, counted);
    }
}

/// T-RED-5: a system sends a command known to be wrong only if resets have not cured it.
#[test]
fn only_a_command_that_no_reset_cured_is_sent_though_it_is_wrong() {
    for (cause, wrong_in_a_row, fault, expected) in [
        (ResetCause::Watchdog, 2, FailureMode::None, true),
        (ResetCause::Watchdog, 1, FailureMode::None, false),
        (ResetCause::Watchdog, 1, FailureMode::IoModule, false),
        (ResetCause::PowerOn, 1, FailureMode::WrongCommand, false),
    ] {
        let state = SystemState {
            wrong_in_a_row,
            ..SystemState::factory(SystemId::A)
        };
        let now = Instant::from_ns(5_000_000_000);
        let loaded = Loaded::State(state);
        let mut machine = Redundancy::new(CONFIG, SystemId::A, cause, loaded, now);
        let _ = machine.on(now, Input::OwnFault(fault));
        let stops = machine.stops_for_its_command();
        assert_eq!(stops, expected, "{cause:?} {wrong_in_a_row} {fault:?}");
    }
}

/// T-RED-9: a master whose frame was refused does not report that it drives, until it has polled.
#[test]
fn a_master_whose_frame_was_refused_does_not_report_that_it_drives() {
    let mut bench = Bench::master();
    assert!(bench.machine.may_transmit(bench.now));
    assert_eq!(bench.machine.report().role, Role::Master);
    bench.now += CONFIG.lease();
    assert!(bench.machine.may_transmit(bench.now));
    bench.now += Duration::from_ns(1);
    assert!(!bench.machine.may_transmit(bench.now));
    assert_eq!(bench.machine.report().role, Role::Starting);
    let actions = bench.on(Input::Poll(bench.snapshot));
    assert!(actions.contains(Action::Transmit), "the frame is sent now");
    assert_eq!(bench.machine.report().role, Role::Master);
}

/// T-RED-9: a master that was held up beyond its lease listens first if the other system may have
/// taken over: the other system's heartbeats arrive, or it was heard as standby.
#[test]
fn a_master_held_up_drives_on_only_if_no_system_can_have_taken_over() {
    let (lease, ns) = (CONFIG.lease(), Duration::from_ns(1));
    for (beats, was_standby, span, listens) in [
        (true, false, lease, false),
        (true, false, lease + ns, true),
        (false, true, lease, false),
        (false, true, lease + ns, true),
        (false, false, lease + ns, false),
    ] {
        let mut bench = Bench::master();
        if was_standby {
            let _ = bench.on(Input::StatusFrame(sound(Role::Standby, Term::NONE)));
        }
        for _ in 0..20 {
            bench.snapshot.beats[0] += u32::from(beats);
            let _ = bench.poll();
        }
        assert!(bench.machine.phase().is_driving());
        bench.now += span;
        let _ = bench.on(Input::Poll(bench.snapshot));
        let thawed = bench.machine.phase() == Phase::Thawed;
        assert_eq!(thawed, listens, "{beats} {was_standby} {span:?}");
    }
}

/// T-RED-9: a poll that is late by no more than its jitter is not a stall: the limits of the
/// witnesses are not restarted.
#[test]
fn a_poll_within_its_jitter_is_no_stall() {
    for (late, forgiven) in [
        (CONFIG.stall_limit(), false),
        (CONFIG.stall_limit() + Duration::from_ns(1), true),
    ] {
        let mut bench = Bench::standby();
        let _ = bench.control(16);
        let last = bench.now;
        for _ in 0..10 {
            let _ = bench.poll();
        }
        bench.now += late;
        let resumed = bench.now;
        let _ = bench.on(Input::Poll(bench.snapshot));
        while bench.machine.phase() == Phase::Standby {
            let _ = bench.poll();
        }
        let since = if forgiven { resumed } else { last };
        let took = bench.now.since(since);
        let limit = CONFIG.witness_limit();
        assert!(
            took > limit && took <= limit + CONFIG.poll_interval,
            "{took:?}"
        );
    }
}

/// T-RED-2: a system that did not poll while it started has not waited for the other one: a stall,
/// or a clock that jumps, does not end the start.
#[test]
fn a_stall_does_not_end_the_wait_for_the_other_system() {
    let polls_after = |stall_ms: u64| {
        let mut bench = Bench::new(SystemId::A, SystemState::factory(SystemId::A));
        let _ = bench.poll();
        bench.now += Duration::from_ms(stall_ms);
        let mut polls = 1;
        while bench.machine.phase() == Phase::Starting {
            let _ = bench.poll();
            polls += 1;
        }
        assert_eq!(bench.machine.phase(), Phase::DegradedMaster);
        polls
    };
    let undisturbed = polls_after(0);
    for stall_ms in [500, 5_000] {
        let fewer = undisturbed - polls_after(stall_ms);
        assert!(fewer <= 2, "{fewer} after a stall of {stall_ms} ms");
    }
}

/// T-RED-5: a standby resets itself for a fault only while it hears its master drive, because
/// otherwise it may be the only system left.
#[test]
fn a_standby_resets_itself_only_beside_a_master_that_drives() {
    let mut bench = Bench::standby();
    // Heartbeats continue, but no control frame arrives; the vehicle does not report it missing.
    bench.run_with_beats(10);
    let fault = Input::OwnFault(FailureMode::PlanningCore);
    let asks = |actions: Actions| actions.contains(Action::Reset(ResetRequest::CoreDead));
    assert!(!asks(bench.on(fault)) && !asks(bench.poll()));
    assert_eq!(bench.machine.phase(), Phase::Standby);
    let _ = bench.control(16);
    assert!(asks(bench.poll()), "the fault need not be reported again");
}
