//! `tandem cut`, `mend`, `power` and `fault`: hands on a run while it drives.

use anyhow::Context as _;
use tandem_board::{Edge, Line, SystemId};
use tandem_board_host::Wire;
use tandem_board_host::hands::Hands;

use crate::args::{FaultArgs, FaultKind, PowerArgs, Switch, WireArgs, WireName};

/// Cuts a wire, or mends it.
///
/// # Errors
/// If the run cannot be reached.
pub(crate) fn set_cut(args: &WireArgs, is_cut: bool) -> anyhow::Result<()> {
    let hands = Hands::on(args.run.as_deref())?;
    let from = match args.from {
        Some(system) => vec![system],
        None => SystemId::ALL.to_vec(),
    };
    hands.set_cut(args.wire.wire(), &from, is_cut);
    Ok(())
}

/// Switches a system off or on.
///
/// # Errors
/// If the run cannot be reached, or the system is so already.
pub(crate) fn power(args: &PowerArgs) -> anyhow::Result<()> {
    let hands = Hands::on(args.run.as_deref())?;
    match args.switch {
        Switch::On => hands.power_on(args.system)?,
        Switch::Off => hands.power_off(args.system)?,
    }
    Ok(())
}

/// Does what no signal to a process can do.
///
/// # Errors
/// If the run cannot be reached.
pub(crate) fn fault(args: &FaultArgs) -> anyhow::Result<()> {
    let hands = Hands::on(args.run.as_deref())?;
    match args.fault {
        FaultKind::Lmu => hands.scribble(args.system, args.seed).context("LMU"),
        FaultKind::Handshake => {
            hands.stray_edge(args.system, Line::Start, Edge::Rising);
            Ok(())
        }
        FaultKind::Sync => {
            hands.stray_edge(args.system, Line::Start, Edge::Falling);
            Ok(())
        }
    }
}

impl WireName {
    const fn wire(self) -> Wire {
        match self {
            Self::Heartbeat1 => Wire::Line(Line::Heartbeat1),
            Self::Heartbeat2 => Wire::Line(Line::Heartbeat2),
            Self::Start => Wire::Line(Line::Start),
            Self::Level => Wire::Level,
            Self::Link => Wire::Link,
            Self::Can => Wire::Can,
        }
    }
}
