//! The driving functions of the three cores: pure computation, told the time. T-CHIP-3

pub mod types;
