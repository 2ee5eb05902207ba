//! A background load: processes that spin or stream through memory during the measurement.

use crate::worker::Child;
use std::fmt;
use std::hint::{black_box, spin_loop};
use std::io;
use std::str::FromStr;

/// Words that a streaming process writes in a row: 64 MiB, more than most caches hold.
const STREAMED: usize = 8 << 20;
/// Largest number of processes.
const MOST: u8 = 64;

type Kind = (&'static str, fn() -> bool);
/// The activity of a load's processes, by name.
const KINDS: [Kind; 2] = [("spin", spin), ("memory", memory)];

/// Runs instructions without memory accesses.
fn spin() -> bool {
    loop {
        spin_loop();
    }
}

/// Writes to memory, line after line.
fn memory() -> bool {
    let mut words = vec![0u64; STREAMED];
    loop {
        black_box(&mut words).fill(1);
    }
}

/// Processes that run on the CPUs of both ends, in turn, under SCHED_OTHER.
#[derive(Clone, Copy, Debug)]
pub struct Load {
    kind: Kind,
    processes: u8,
}

impl Load {
    /// Starts the processes: the first on the near CPU, the second on the far one, and so on. Each
    /// runs until its [`Child`] is dropped.
    pub(crate) fn start(self, cpus: [usize; 2]) -> io::Result<Vec<Child>> {
        let cpu = |number| cpus[usize::from(number) % 2];
        let one = |number: u8| Child::start(cpu(number), self.kind.1);
        (0..self.processes).map(one).collect()
    }
}

impl FromStr for Load {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let (name, processes) = text.split_once(':').unwrap_or((text, "2"));
        let kind = KINDS.into_iter().find(|(kind, _)| *kind == name);
        let kind = kind.ok_or("the kinds are spin and memory")?;
        match processes.parse() {
            Ok(processes) if (1..=MOST).contains(&processes) => Ok(Self { kind, processes }),
            _ => Err(format!("processes: a number from 1 to {MOST}")),
        }
    }
}

impl fmt::Display for Load {
    fn fmt(&self, to: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(to, "{}:{}", self.kind.0, self.processes)
    }
}
