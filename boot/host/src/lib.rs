//! The host's side of a download, and a program flash that loses power.
//!
//! [`Image::sign`] and [`records`] make a signed file, and [`Sender`] sends it. For tests and
//! simulations, [`ProgramFlash`] is the flash, [`life`](mod@life) a controller between two losses
//! of power, and [`cuts`] the sweep of all points at which power can be lost.
#![forbid(unsafe_code)]

mod bus_time;
pub mod cuts;
mod flash;
mod flash_file;
pub mod life;
mod package;
mod sender;
mod transfer;
pub mod wire;

pub use bus_time::bits;
pub use flash::{ERASE_TICKS, ModelError, PROGRAM_TICKS, ProgramFlash, Tear};
pub use flash_file::{FlashFile, FlashFileFault};
pub use package::{Content, Image, PackageError, RECORD_DATA, Release, SigningKey, line, records};
pub use sender::{ANSWER_WITHIN, CONNECT_EVERY, Sender, ToDo};
pub use transfer::{TransferError, send_file, serve};
pub use wire::Wire;
