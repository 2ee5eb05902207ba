//! The board as processes on a laptop, over iceoryx2.
//!
//! ```text
//! launcher ── supply A ── core A0 · A1 · A2        each box is a process
//!          ── supply B ── core B0 · B1 · B2
//!          ── vehicle
//! ```
//!
//! A system's LMU is a segment of iceoryx2 storage that its cores map read-write; a doorbell is an
//! iceoryx2 event; the wires between the systems, the bus and the supplies' registers are another
//! segment, the [`Backplane`]. All files are in the run's `/dev/shm` ([`isolation`]), so that none
//! is left behind, whichever process is killed.

// iceoryx2 must be linked with a logger; this one prints nothing.
extern crate iceoryx2_bb_loggers as _;

mod alarm;
mod args;
mod backplane;
mod board;
mod can;
pub mod clock;
pub mod control_group;
pub mod descendants;
pub mod doorbell;
mod flash_file;
pub mod injection;
pub mod isolation;
pub mod jump;
mod launch;
mod lines;
mod memory;
mod name;
mod observe;
mod outside;
pub mod process_list;
pub mod process_report;
pub mod realtime;
mod segment;
pub mod socket;
pub mod spawn;
mod stamped_udp;
pub mod storage;
pub mod supply;
mod supply_client;
mod this_program;
mod trace_ring;
mod udp_port;
mod unsupervised;
mod vehicle_port;

pub use alarm::{Alarm, Expired};
pub use args::{
    Common, CoreArgs, InvalidArgs, Pinning, ProcessArgs, Schedule, SupplyArgs, VehicleArgs,
};
pub use backplane::{Backplane, BackplaneError};
pub use board::{AttachError, HostBoard};
pub use can::HostCan;
pub use doorbell::DoorbellError;
pub use flash_file::{FlashFileError, HostFlash};
pub use isolation::{Isolation, IsolationError};
pub use launch::{Ended, LaunchError, LaunchPlan, Launcher, Leftovers};
pub use lines::{HostLines, HostLink};
pub use memory::{LMU_WORDS, MemoryError};
pub use name::{InvalidRunName, RunName};
pub use observe::BusTap;
pub use segment::{Segment, SegmentError};
pub use stamped_udp::StampedUdp;
pub use supply_client::HostSupply;
pub use tandem_board_udp::UdpPlace;
pub use tandem_peripherals::network::{BusFault, Wire};
pub use this_program::this_program;
pub use udp_port::HostNetwork;
pub use unsupervised::UnsupervisedSystem;
pub use vehicle_port::{HostVehiclePort, VehiclePortError};
