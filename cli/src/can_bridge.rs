//! `tandem run --can INTERFACE`: the program that connects the bus of the run with a SocketCAN
//! interface.

use std::time::Duration;

use tandem_board_host::RunName;
use tandem_processes::open_bus::OpenBusPlace;

use crate::args::{CanBus, RunArgs};
use crate::beside::{Attendant, Program};
use crate::failure::Failure;

/// The program ends within this time after the run.
const ENDS_WITHIN: Duration = Duration::from_secs(1);

/// The program between a run and an interface. Dropping it ends the program.
pub(crate) struct CanBridge {
    _program: Attendant,
    name: String,
}

impl CanBridge {
    /// Starts the program; `None` if the arguments name no interface.
    ///
    /// # Errors
    /// See [`Attendant::start`].
    pub(crate) fn start(args: &RunArgs) -> Result<Option<Self>, Failure> {
        let Some(CanBus::Interface(interface)) = &args.can else {
            return Ok(None);
        };
        let name = format!("{}-can", RunName::unique());
        let words = vec![interface.into(), name.clone().into()];
        let program = Attendant::start(Program::Can, "program for SocketCAN", words, ENDS_WITHIN)?;
        Ok(Some(Self {
            _program: program,
            name,
        }))
    }

    /// Returns where the vehicle finds it.
    pub(crate) fn place(&self) -> OpenBusPlace {
        OpenBusPlace::Bridge(self.name.clone())
    }
}
