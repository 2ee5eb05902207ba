//! Topics on the host: UDP, profiles in XML, the SoC's process.
#![forbid(unsafe_code)]

pub mod approach;
pub mod gateway;
pub mod listing;
pub mod node;
pub mod signals;
pub mod soc;
pub mod typed;
pub mod udp;
