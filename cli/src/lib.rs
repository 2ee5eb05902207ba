//! The code that `tandem` shares with its separate programs: a run with its processes, its
//! recording and its report.
#![forbid(unsafe_code)]

pub mod args;
pub mod beside;
pub mod board_kind;
pub mod boot;
pub mod boot_demo;
pub mod can_udp;
pub mod clock_view;
pub mod collected;
mod companion;
mod control_core;
mod core_process;
pub mod dflash;
pub mod exec_sign;
