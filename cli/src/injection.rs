//! `tandem cut`, `mend`, `power` and `fault`: inject faults into a run while it drives.

use anyhow::{Context as _, bail};
use tandem_board::{Edge, HardwareFault, Line, SystemId};
use tandem_board_host::Wire;
use tandem_board_host::injection::Injection;

use crate::args::{FaultArgs, FaultKind, PowerArgs, Switch, WireArgs, WireName};

/// Cuts a wire or restores it.
///
/// # Errors
/// If the run cannot be reached.
pub fn set_cut(args: &WireArgs, is_cut: bool) -> anyhow::Result<()> {
    let injection = Injection::on(args.run.name.as_deref())?;
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
pub fn power(args: &PowerArgs) -> anyhow::Result<()> {
    let injection = Injection::on(args.run.name.as_deref())?;
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
pub fn fault(args: &FaultArgs) -> anyhow::Result<()> {
    let injection = Injection::on(args.run.name.as_deref())?;
    let hardware = match args.fault {
        FaultKind::Lmu | FaultKind::Handshake | FaultKind::Sync if args.mend => {
            bail!("this fault does not last: there is nothing to mend")
        }
        FaultKind::Lmu => return injection.scribble(args.system, args.seed).context("LMU"),
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
