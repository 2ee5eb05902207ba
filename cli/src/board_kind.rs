//! Which board the controller runs on, as an argument.

use clap::ValueEnum;

/// Values of `--board`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum BoardKind {
    /// Processes of this machine, in real time
    Host,
    /// Firmware in two emulated RISC-V machines, one for each system, in the emulator's time; core
    /// 0 under FreeRTOS
    Qemu,
    /// Firmware in one emulated machine with both systems in it, in the emulator's time; all cores
    /// bare
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
