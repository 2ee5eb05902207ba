//! Runs the conformance suite on this board: see [`conformance`].
#![no_std]
#![no_main]
#![deny(unsafe_code)]

use tandem_board_riscv32_virt::{conformance, entry};

entry!(conformance::main);
