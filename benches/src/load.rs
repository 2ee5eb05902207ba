//! A stated background load: processes that spin or stream through memory during the measurement.

use crate::worker::Child;
use std::fmt;
use std::hint::{black_box, spin_loop};
use std::io;
use std::str::FromStr;

/// Words that a streaming process writes in a row: 64 MiB, more than most caches hold.
const STREAMED: usize = 8 << 20;
/// Processes at most.
const MOST: u8 = 64;

/// What the processes of a load do.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Kind {
    /// Nothing but instructions.
    Spin,
    /// Write to memory, line after line.
    Memory,
}

/// Processes that run on the CPUs of both ends, in turn, under SCHED_OTHER.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Load {
    kind: Kind,
    processes: u8,
}

impl Load {
    /// Starts the processes: the first on the near CPU, the second on the far one, and so on. Each
    /// runs until its [`Child`] is dropped.
    ///
    /// # Errors
    /// If a process cannot be had.
    pub fn start(self, cpus: [usize; 2]) -> io::Result<Vec<Child>> {
        let one = |number: u8| {
            Child::start(cpus[usize::from(number) % 2], || match self.kind {
                Kind::Spin => loop {
                    spin_loop();
                },
                Kind::Memory => {
                    let mut words = vec![0u64; STREAMED];
                    for round in 1.. {
                        black_box(&mut words).fill(round);
                    }
                    false
                }
            })
        };
        (0..self.processes).map(one).collect()
    }
}

impl FromStr for Load {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let (kind, processes) = text.split_once(':').unwrap_or((text, "2"));
        let kind = match kind {
            "spin" => Kind::Spin,
            "memory" => Kind::Memory,
            _ => return Err("the kinds are spin and memory".to_owned()),
        };
        match processes.parse() {
            Ok(processes) if (1..=MOST).contains(&processes) => Ok(Self { kind, processes }),
            _ => Err(format!("processes: a number from 1 to {MOST}")),
        }
    }
}

impl fmt::Display for Load {
    fn fmt(&self, to: &mut fmt::Formatter<'_>) -> fmt::Result {
        let kind = match self.kind {
            Kind::Spin => "spin",
            Kind::Memory => "memory",
        };
        write!(to, "{kind}:{}", self.processes)
    }
}
