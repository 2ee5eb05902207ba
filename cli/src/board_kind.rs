//! The command-line argument that selects the controller's board.

use clap::ValueEnum;

/// Values of `--board`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum BoardKind {
    /// Processes of this machine, in real time
    Host,
    /// Firmware in two emulated RISC-V machines, one for each system, in the emulator's time; core
    /// 0 runs under FreeRTOS
    Qemu,
    /// Firmware in one emulated machine that holds both systems, in the emulator's time; no core
    /// runs a kernel
    QemuOne,
}

/// Values of `--board` of the demonstrations.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum DemoBoard {
    /// This process, in real time
    Host,
    /// Firmware in an emulated RISC-V machine, in the emulator's time
    Qemu,
}
