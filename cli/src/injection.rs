//! `tandem cut`, `mend`, `power` and `fault`: inject faults into a run while it drives.

use anyhow::{Context as _, anyhow};
use tandem_board::{Edge, HardwareFault, Line, SystemId};
use tandem_board_host::Wire;
use tandem_board_host::injection::Injection;

use crate::args::{FaultArgs, FaultKind, PowerArgs, RunChoice, Switch, WireArgs, WireName};
use crate::failure::Failure;

/// Enters the run. One that does not exist is an error of the command line, as for every command.
fn on(run: &RunChoice) -> Result<Injection, Failure> {
    Injection::on(run.name.as_deref()).map_err(Failure::usage)
}

/// Cuts a wire or restores it.
///
/// # Errors
/// If the run cannot be reached.
pub fn set_cut(args: &WireArgs, is_cut: bool) -> Result<(), Failure> {
    let injection = on(&args.run)?;
    let from = match args.from {
        Some(system) => vec![system],
        None => SystemId::ALL.to_vec(),
    };
    injection.set_cut(args.wire.wire(), &from, is_cut);
    Ok(())
}

/// Switches a system off or on.
///
/// # Errors
/// If the run cannot be reached, or the system is already in that state.
pub fn power(args: &PowerArgs) -> Result<(), Failure> {
    let injection = on(&args.run)?;
    match args.switch {
        Switch::On => injection.power_on(args.system)?,
        Switch::Off => injection.power_off(args.system)?,
    }
    Ok(())
}

/// Injects or ends a hardware fault.
///
/// # Errors
/// If the run cannot be reached, or the fault is momentary and cannot be ended.
pub fn fault(args: &FaultArgs) -> Result<(), Failure> {
    let injection = on(&args.run)?;
    let hardware = match args.fault {
        FaultKind::Lmu | FaultKind::Hang | FaultKind::Handshake | FaultKind::Sync if args.mend => {
            return Err(Failure::Usage(anyhow!(
                "this fault does not last: there is nothing to mend"
            )));
        }
        FaultKind::Lmu => {
            injection.scribble(args.system, args.seed).context("LMU")?;
            return Ok(());
        }
        FaultKind::Hang if injection.hang(args.system) => return Ok(()),
        FaultKind::Hang => {
            let what = anyhow!("system {} has no such core", args.system);
            return Err(Failure::Run(what));
        }
        FaultKind::Handshake => {
            injection.stray_edge(args.system, Line::Start, Edge::Rising);
            return Ok(());
        }
        FaultKind::Sync => {
            injection.stray_edge(args.system, Line::Start, Edge::Falling);
            return Ok(());
        }
        FaultKind::OpenLoad => HardwareFault::OpenLoad,
        FaultKind::ShortCircuit => HardwareFault::ShortCircuit,
        FaultKind::BusOff => HardwareFault::CanTransmit,
        FaultKind::CanReceive => HardwareFault::CanReceive,
        FaultKind::ErrorPin => HardwareFault::ErrorPin,
        FaultKind::Undervoltage => HardwareFault::Undervoltage,
        FaultKind::Overvoltage => HardwareFault::Overvoltage,
        FaultKind::NetworkCut => HardwareFault::Network,
    };
    injection.set_fault(args.system, hardware, !args.mend);
    Ok(())
}

impl WireName {
    const fn wire(self) -> Wire {
        match self {
            Self::Heartbeat1 => Wire::Line(Line::Heartbeat1),
            Self::Heartbeat2 => Wire::Line(Line::Heartbeat2),
            Self::Start => Wire::Line(Line::Start),
            Self::Time => Wire::Line(Line::Time),
            Self::Level => Wire::Level,
            Self::Link => Wire::Link,
            Self::Can => Wire::Can,
        }
    }
}
