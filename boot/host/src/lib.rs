//! The host's side of a download, and a program flash that loses power.
//!
//! [`Image::sign`] and [`records`] create a signed file, and [`FileSender`] sends it. For tests and
//! simulations there are [`SimulatedFlash`], the controller between two losses of power
//! ([`life`](mod@life)), and the sweep of all points at which power can be lost ([`cuts`]).
#![forbid(unsafe_code)]

mod bus_pipe;
mod bus_time;
pub mod cuts;
mod delta;
mod file_sender;
mod flash_file;
mod info;
pub mod life;
mod package;
mod simulated_flash;
mod transfer;
pub mod udp_bus;

pub use bus_pipe::{BusPipe, BusPipeListener};
pub use bus_time::bits;
pub use delta::delta;
pub use file_sender::{ANSWER_WITHIN, CONNECT_EVERY, FileSender, ToDo};
pub use flash_file::{FlashFile, FlashFileFault};
pub use info::{Inquiry, SystemInfo, ask};
pub use package::{
    Content, Image, PackageError, RECORD_DATA, ReleaseInfo, SigningKey, line, records,
};
pub use simulated_flash::{
    ERASE_TICKS, Failing, FlashOperation, FlashTimes, FlashTraits, ModelError, PROGRAM_TICKS,
    SimulatedFlash, Tear,
};
pub use transfer::{TransferError, send_file, serve};
pub use udp_bus::UdpBus;
