//! A log by defmt of what the crates return.
#![no_std]

use tandem_board::FlashError;
use tandem_bus::{FrameReceiver, ReceiveError};
use tandem_redundancy::{Actions, Redundancy};
use tandem_shm::map::MapError;

/// Logs the events of a call, and the state after it.
pub fn log_actions(machine: &Redundancy, actions: &Actions) {
    for event in actions.events() {
        defmt::info!("{}", event);
    }
    defmt::debug!("{} {}", machine.phase(), machine.term());
}

/// Receives a frame, and logs what is wrong with it.
pub fn receive(receiver: &mut FrameReceiver, id: u32, data: &[u8]) -> Result<(), ReceiveError> {
    receiver
        .receive(id, data)
        .map(|_message| ())
        .inspect_err(|why| defmt::warn!("{=u32:x}: {}", id, why))
}

/// Logs why a core cannot start.
pub fn log_start(map: MapError, flash: FlashError) {
    defmt::error!("{} {}", map, flash);
}
