//! What is measured, by name. Each group has a file; the floor comes first in it.

mod chain;
mod lock;
mod noise;
mod one_cpu;
mod pool;
mod rate;
mod rtos;
mod size;
mod sleep;
mod spin;
mod start_up;
mod throughput;

use crate::harness::{Batch, Plan};
use std::io;
use tandem_board_host::UnsupervisedSystem;

/// What is compared with each other.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, clap::ValueEnum)]
pub enum Group {
    /// 4 bytes one way; the receiver looks again and again, on a CPU of its own.
    Spin,
    /// 4 bytes one way; the receiver sleeps in the kernel until it is woken, on a CPU of its own.
    Sleep,
    /// 4 bytes one way; both ends share one CPU.
    OneCpu,
    /// One way by payload, in place: 4 bytes to 16 MiB.
    Size,
    /// Messages in a row, as many as go.
    Throughput,
    /// Taking and giving back the lock: free, contended, and after the death of its owner.
    Lock,
    /// Borrowing and giving back words of the pool.
    Pool,
    /// A wake-up from core 1 over core 2 to core 0.
    Chain,
    /// From power-on until all three cores are in sync.
    StartUp,
    /// One way at a fixed rate, from the intended time of the sending.
    Rate,
    /// FreeRTOS on the host: lateness of the tick, and switches between tasks.
    Rtos,
    /// What the machine does by itself.
    Noise,
}

impl Group {
    /// As it stands in names and on the command line.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Spin => "spin",
            Self::Sleep => "sleep",
            Self::OneCpu => "one-cpu",
            Self::Size => "size",
            Self::Throughput => "throughput",
            Self::Lock => "lock",
            Self::Pool => "pool",
            Self::Chain => "chain",
            Self::StartUp => "start-up",
            Self::Rate => "rate",
            Self::Rtos => "rtos",
            Self::Noise => "noise",
        }
    }
}

/// Runs one batch of a case.
pub type Run = fn(&UnsupervisedSystem, &Plan) -> io::Result<Batch>;

/// One way of doing what its group compares.
#[derive(Clone, Copy)]
pub struct Case {
    /// What it is compared with.
    pub group: Group,
    /// Name within the group; `floor` is what the others are compared with.
    pub name: &'static str,
    /// What it is, for the table.
    pub what: &'static str,
    /// Rounds of one batch: some 10 to 50 ms, so that cases take turns while the machine's mood
    /// lasts.
    pub rounds: usize,
    /// It takes part in every so manieth turn only; 1 but for what needs seconds to begin.
    pub every: usize,
    /// One batch.
    pub run: Run,
}

impl Case {
    /// Group and case, as `spin/tandem`.
    #[must_use]
    pub fn full_name(&self) -> String {
        format!("{}/{}", self.group.name(), self.name)
    }

    /// Whether the others of its group are compared with it.
    #[must_use]
    pub fn is_floor(&self) -> bool {
        self.name == "floor"
    }
}

/// All cases in the order in which they are shown.
pub fn all() -> impl Iterator<Item = &'static Case> {
    let groups = [
        spin::CASES,
        sleep::CASES,
        one_cpu::CASES,
        size::CASES,
        throughput::CASES,
        lock::CASES,
        pool::CASES,
        chain::CASES,
        start_up::CASES,
        rate::CASES,
        rtos::CASES,
        noise::CASES,
    ];
    groups.into_iter().flatten()
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::HashSet;

    #[test]
    fn names_are_unique_and_floors_come_first() {
        let mut names = HashSet::new();
        let mut groups = HashSet::new();
        for case in all() {
            assert!(names.insert(case.full_name()), "{} twice", case.full_name());
            let is_first = groups.insert(case.group);
            assert!(!case.is_floor() || is_first, "{}", case.full_name());
        }
    }
}
