//! Frames that core 0 sends and receives: conversions between the types of the bus and those of the
//! redundancy.

use super::driving::Output;
use crate::driving::function::{Driver, FunctionState};
use crate::driving::parking::{BodyRequest, BodyState};
use crate::driving::types::Command;
use tandem_board::{Board, Can, CanFrame, CanId, Duration, SystemId};
use tandem_bus::{
    BodyControl, Control, DriverRequest, EgoMotion, Encoded, GateEcho, ModeCode, Status,
};
use tandem_redundancy::{
    Ability, ControlHeader, Mode, ObeyedTerm, PeerReport, Redundancy, Role, Term,
};

const fn bus_role(role: Role) -> tandem_bus::RoleCode {
    match role {
        Role::Starting => tandem_bus::RoleCode::Starting,
        Role::Master => tandem_bus::RoleCode::Master,
        Role::Standby => tandem_bus::RoleCode::Standby,
        Role::Suspended => tandem_bus::RoleCode::Suspended,
    }
}

const fn bus_ability(ability: Ability) -> tandem_bus::AbilityCode {
    match ability {
        Ability::All => tandem_bus::AbilityCode::All,
        Ability::Lacks => tandem_bus::AbilityCode::Lacks,
        Ability::StopOnly => tandem_bus::AbilityCode::StopOnly,
        Ability::None => tandem_bus::AbilityCode::None,
    }
}

/// Returns the mode of a control frame, and of the comparison with the other system. A system that
/// parks follows the SoC, so its command is compared only with that of another one that parks.
pub(super) const fn function(mode: Mode, state: FunctionState) -> ModeCode {
    match (mode, state) {
        (Mode::L3 | Mode::DegradedL2, FunctionState::Parking) => ModeCode::Parking,
        _ => bus_mode(mode),
    }
}

const fn bus_mode(mode: Mode) -> ModeCode {
    match mode {
        Mode::None => ModeCode::None,
        Mode::L3 => ModeCode::L3,
        Mode::DegradedL2 => ModeCode::DegradedL2,
        Mode::SafeStop => ModeCode::SafeStop,
    }
}

/// Returns the control frame for this output. `sent_at`: when it is made, on the vehicle's clock.
pub(super) fn control(redundancy: &Redundancy, output: &Output, sent_at: Option<u16>) -> Control {
    Control {
        role: bus_role(redundancy.role()),
        mode: function(output.mode, output.state),
        takeover_request: output.state == FunctionState::TakeoverRequest,
        term: redundancy.term().bits(),
        steering_angle: output.command.steering_angle,
        acceleration: output.command.acceleration,
        // The largest number that the signal can carry stands for "rests on no sensor data".
        command_age: output.age.map_or(f32::MAX, |age| age.as_ms_f64() as f32),
        // 0 means "not known".
        sent_at: sent_at.map_or(0, |sent_at| sent_at.max(1)),
    }
}

/// Returns the status frame.
pub(super) fn status(redundancy: &Redundancy, tracks: u8, deadline_misses: u32) -> Status {
    let state = redundancy.state();
    let [line1_silent, line2_silent] = redundancy.lines_silent();
    Status {
        role: bus_role(redundancy.role()),
        mode: bus_mode(redundancy.mode()),
        sys_failure: state.sys_failure,
        cpsys_failure: state.cpsys_failure,
        line1_silent,
        line2_silent,
        agreement: tandem_bus::AgreementCode::Agreed,
        ability: bus_ability(redundancy.ability()),
        failure_mode: state.failure_mode as u8,
        term: redundancy.highest_term().bits(),
        abn_resets: u16::try_from(state.abn_resets).unwrap_or(u16::MAX),
        total_resets: u16::try_from(state.total_resets).unwrap_or(u16::MAX),
        tracks,
        deadline_misses: u8::try_from(deadline_misses).unwrap_or(u8::MAX),
    }
}

/// Sends a frame; returns whether the controller took it.
pub(super) fn send_encoded<B: Board>(board: &B, encoded: &Encoded) -> bool {
    let frame = CanFrame::new(CanId::Standard(encoded.id), true, encoded.data());
    frame.is_ok_and(|frame| board.can().try_send(&frame).is_ok())
}

/// Converts a control frame of the other system to the form that the redundancy takes.
pub(super) fn received_control(from: u8, control: &Control) -> Option<ControlHeader> {
    Some(ControlHeader {
        system: SystemId::from_index(usize::from(from))?,
        term: Term::from_bits(control.term),
        role: Role::from_repr(control.role as u8)?,
        mode: match control.mode {
            // It needs no more than one system; a standby is ready for L3.
            ModeCode::Parking => Mode::L3,
            mode => Mode::from_repr(mode as u8)?,
        },
    })
}

/// Returns the command in a control frame.
pub(super) const fn command(control: &Control) -> Command {
    Command {
        steering_angle: control.steering_angle,
        acceleration: control.acceleration,
    }
}

/// Returns the command that the vehicle obeys.
pub(super) const fn obeyed(echo: &GateEcho) -> Command {
    Command {
        steering_angle: echo.steering_angle,
        acceleration: echo.acceleration,
    }
}

/// Returns the request of the driver.
pub(super) const fn driver(request: &DriverRequest) -> Driver {
    match (request.engage, request.overrides) {
        (true, false) if request.park => Driver::Parks,
        (true, false) => Driver::Engages,
        _ => Driver::Drives,
    }
}

/// Returns gear and parking brake of the vehicle.
pub(super) const fn body_state(motion: &EgoMotion) -> BodyState {
    BodyState {
        gear: motion.gear,
        brake: motion.parking_brake,
    }
}

/// Returns the frame for gear and parking brake.
pub(super) fn body_control(redundancy: &Redundancy, request: BodyRequest) -> BodyControl {
    BodyControl {
        gear: request.gear,
        brake_request: request.brake,
        term: redundancy.term().bits(),
    }
}

/// Returns the term that the vehicle obeyed when it sent this echo, `on_the_way` ago.
pub(super) fn received_echo(echo: &GateEcho, on_the_way: Duration) -> ObeyedTerm {
    ObeyedTerm {
        term: Term::from_bits(echo.term),
        age: Duration::from_us((echo.term_age * 1e3) as u64) + on_the_way,
        sent: Some((echo.sent_at as u8, on_the_way)),
    }
}

/// Converts a status frame of the other system. Its arrival shows that the sender's CAN is alive.
pub(super) fn received_status(status: &Status) -> Option<PeerReport> {
    Some(PeerReport {
        role: Role::from_repr(status.role as u8)?,
        mode: Mode::from_repr(status.mode as u8)?,
        term: Term::from_bits(status.term),
        can_alive: true,
        ability: Ability::from_bits(status.ability as u8),
    })
}
