//! Time synchronisation on the host: gPTP over Ethernet or UDP, with the kernel's stamps in
//! software. S-2
//!
//! Local time is the machine's clock CLOCK_REALTIME, in which the kernel stamps. Nothing here sets
//! it.
#![forbid(unsafe_code)]

mod port;
mod roles;

pub use port::{PtpArrival, TimePort, Transport, now};
pub use roles::{follow, lead};
