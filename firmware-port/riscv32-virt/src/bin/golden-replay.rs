//! Runs the driving functions over recorded frames: see [`golden_replay`].
#![no_std]
#![no_main]
#![deny(unsafe_code)]

use tandem_board_riscv32_virt::{entry, golden_replay};

entry!(golden_replay::main);
