//! The checks at power-on and after a reset, in the order of T-RED-7.

use crate::starting::StartKind;
use crate::{Config, FailureMode, Loaded, SystemState, Term};
use tandem_board::{ResetCause, SystemId};

/// At this count of incarnations that found their command wrong, a further reset does not cure the
/// system. It starts in the safe stop, or suspends if the other system drives.
pub(crate) const WRONG_COMMANDS: u8 = 2;

/// The result of the checks: how to begin the start protocol.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct StartDecision {
    pub(crate) kind: StartKind,
    /// Whether this system claims to lead.
    pub(crate) claims_master: bool,
    /// The fault for which this system suspends if the other system drives. If no system drives, it
    /// starts in the safe stop, because silence does not stop a vehicle.
    pub(crate) fault: Option<FailureMode>,
}

/// Counts the start in the state and decides how to begin. T-RED-5, T-RED-7
pub(crate) fn check(
    config: &Config,
    system: SystemId,
    cause: ResetCause,
    loaded: Loaded,
) -> (SystemState, StartDecision) {
    let mut state = match loaded {
        Loaded::State(state) => state,
        Loaded::Blank | Loaded::Lost => SystemState::factory(system),
    };
    state.total_resets = state.total_resets.saturating_add(1);
    // No term is left above this one: a forged word has reached the record, or all were used. The
    // term is learned anew, and a failure for want of a term ends.
    if state.term.above(1, system).is_none() {
        state.term = Term::NONE;
        if state.failure_mode == FailureMode::TermsExhausted {
            (state.sys_failure, state.failure_mode) = (false, FailureMode::None);
        }
    }

    // A power cycle gives one more attempt: the next abnormal reset or wrong command suspends it
    // again.
    if cause == ResetCause::PowerOn {
        state.wrong_in_a_row = state.wrong_in_a_row.min(WRONG_COMMANDS - 1);
        if state.sys_failure && state.failure_mode.power_cycle_may_cure() {
            state.sys_failure = false;
            state.abn_in_a_row = config.abnormal_limit;
        }
    }
    // 1. Abnormal reset?
    if cause.is_abnormal() {
        state.abn_resets = state.abn_resets.saturating_add(1);
        state.abn_in_a_row = state.abn_in_a_row.saturating_add(1);
        let wrong = state.wrong_in_a_row >= WRONG_COMMANDS;
        if (wrong || state.abn_in_a_row > config.abnormal_limit) && !state.sys_failure {
            state.sys_failure = true;
            state.failure_mode = match state.failure_mode {
                mode @ FailureMode::WrongScene if wrong => mode,
                _ if wrong => FailureMode::WrongCommand,
                // These resets may have been made to cure the connection to the bus.
                mode @ (FailureMode::CanOpenCircuit | FailureMode::CanBusOff) => mode,
                _ => FailureMode::AbnormalResets,
            };
        }
    }
    // 2. Own failure flag?
    let fault = state.sys_failure.then_some(state.failure_mode);
    // 3. The other's failure flag? If it is set, no system will answer. After a reset the other
    //    system has taken over and runs. In both cases listen for a running master first.
    let power_on = cause == ResetCause::PowerOn;
    let kind = if power_on && !state.cpsys_failure {
        StartKind::Handshake
    } else {
        StartKind::Listen
    };
    // 4. Sync. After a reset, begin as the standby of the other system.
    let claims_master = state.is_master && power_on && fault.is_none();
    let boot = StartDecision {
        kind,
        claims_master,
        fault,
    };
    (state, boot)
}

#[cfg(test)]
mod tests {
    use super::*;
    use ResetCause::{PowerOn, Software, Trap, Watchdog};

    const CONFIG: Config = Config::rt();

    fn boot(cause: ResetCause, state: SystemState) -> (SystemState, StartDecision) {
        check(&CONFIG, SystemId::A, cause, Loaded::State(state))
    }

    /// T-RED-7: abnormal reset, own failure flag, other's failure flag, sync: in this order.
    #[test]
    fn order_of_checks() {
        let clean = SystemState::factory(SystemId::A);
        let start = |kind, claims_master| StartDecision {
            kind,
            claims_master,
            fault: None,
        };
        let fails = |kind| StartDecision {
            fault: Some(FailureMode::IoModule),
            ..start(kind, false)
        };
        let peer_failed = SystemState {
            cpsys_failure: true,
            ..clean
        };
        let failed = SystemState {
            sys_failure: true,
            failure_mode: FailureMode::IoModule,
            ..clean
        };
        for (cause, state, expected) in [
            (PowerOn, clean, start(StartKind::Handshake, true)),
            (PowerOn, peer_failed, start(StartKind::Listen, true)),
            (PowerOn, failed, fails(StartKind::Handshake)),
            (Watchdog, clean, start(StartKind::Listen, false)),
            (Trap, peer_failed, start(StartKind::Listen, false)),
            (Software, clean, start(StartKind::Listen, false)),
            (Watchdog, failed, fails(StartKind::Listen)),
        ] {
            assert_eq!(boot(cause, state).1, expected, "{cause:?} {state:?}");
        }
        let slave = SystemState {
            is_master: false,
            ..clean
        };
        assert_eq!(boot(PowerOn, slave).1, start(StartKind::Handshake, false));
    }

    /// T-RED-5: every start and every abnormal reset is counted; too many in a row suspend.
    #[test]
    fn abnormal_resets_are_counted_and_limited() {
        let mut state = SystemState::factory(SystemId::A);
        for n in 1..=u32::from(CONFIG.abnormal_limit) {
            let (after, verdict) = boot(Watchdog, state);
            assert_eq!((after.abn_resets, after.total_resets), (n, n));
            assert_eq!(verdict.fault, None);
            state = after;
        }
        let (after, verdict) = boot(PowerOn, state);
        assert_eq!((after.abn_resets, after.total_resets), (3, 4));
        assert_eq!(
            verdict.fault, None,
            "a power cycle alone neither counts nor clears the row"
        );
        let fails = Some(FailureMode::AbnormalResets);
        let (after, verdict) = boot(Trap, after);
        assert_eq!(verdict.fault, fails);
        assert!(after.sys_failure);
        let (after, verdict) = boot(PowerOn, after);
        assert_eq!(verdict.fault, None, "a power cycle gives one more attempt");
        assert_eq!(boot(PowerOn, after).1.fault, None);
        assert_eq!(boot(Trap, after).1.fault, fails, "and only one");
    }

    /// T-RED-5: a system that left twice because of a wrong command fails at its next abnormal
    /// start. A power cycle gives it one more attempt. One wrong command alone has no effect.
    #[test]
    fn resets_that_do_not_cure_the_command_are_limited() {
        for (cause, wrong_in_a_row, fails) in [
            (Trap, 1, false),
            (Trap, 2, true),
            (Watchdog, 2, true),
            (PowerOn, 2, false),
            (Software, 2, false),
        ] {
            for failure_mode in [FailureMode::WrongCommand, FailureMode::WrongScene] {
                let before = SystemState {
                    failure_mode,
                    wrong_in_a_row,
                    ..SystemState::factory(SystemId::A)
                };
                let (after, verdict) = boot(cause, before);
                let fault = fails.then_some(failure_mode);
                assert_eq!(verdict.fault, fault, "{cause:?} {wrong_in_a_row}");
                let (after, verdict) = boot(PowerOn, after);
                assert_eq!(verdict.fault, None);
                assert_eq!(after.wrong_in_a_row, 1);
                assert_eq!(boot(Trap, after).1.fault.is_some(), fails, "one more reset");
            }
        }
    }

    /// T-RED-9: a record without a higher term begins anew. Only the failure that followed from the
    /// term ends with it.
    #[test]
    fn a_record_without_a_higher_term_is_healed() {
        let kept = SystemState {
            term: Term::from_bits(Term::LAST.bits() - 2),
            ..SystemState::factory(SystemId::A)
        };
        assert_eq!(boot(PowerOn, kept).0.term, kept.term);
        for (failure_mode, fault) in [
            (FailureMode::TermsExhausted, None),
            (FailureMode::IoModule, Some(FailureMode::IoModule)),
        ] {
            for term in [Term::LAST, Term::from_bits(u32::MAX)] {
                let before = SystemState {
                    term,
                    sys_failure: true,
                    cpsys_failure: true,
                    failure_mode,
                    ..kept
                };
                let (after, verdict) = boot(Watchdog, before);
                assert_eq!((after.term, verdict.fault), (Term::NONE, fault));
                assert!(after.cpsys_failure);
            }
        }
    }

    /// T-RED-1: a system whose flash is blank or lost begins with the factory state.
    #[test]
    fn without_a_state_it_begins_with_the_factory_state() {
        for loaded in [Loaded::Blank, Loaded::Lost] {
            let (state, _) = check(&CONFIG, SystemId::B, PowerOn, loaded);
            let factory = SystemState::factory(SystemId::B);
            assert_eq!(
                state,
                SystemState {
                    total_resets: 1,
                    ..factory
                }
            );
        }
    }
}
