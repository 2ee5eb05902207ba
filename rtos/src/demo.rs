//! Two tests of a kernel's scheduling, visible at digital outputs: the work of the tasks, and the
//! log lines in which an image reports when its outputs changed. T-RTOS-3, T-RTOS-4
//!
//! ```text
//! edge T-RTOS-3 0 60000300        test, number of the output, ns since the test began
//! ```

use crate::context::TaskContext;
use crate::time::Ticks;
use core::fmt;
use core::time::Duration;

/// How long each test runs, ms: a multiple of every output's period.
pub const SPAN_MS: u32 = 360;
/// An image prints this after its last edge.
pub const COMPLETE: &str = "outputs complete";

/// How a task changes its output.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Output {
    /// Name of the task and its curve; at most 15 bytes.
    pub name: &'static str,
    /// Priority of the task; a higher number is more urgent.
    pub priority: u8,
    /// Period of the task, ms.
    pub period_ms: u32,
    /// Work in each period, with the output high, ms. If `None`, the output toggles once a period.
    pub burn_ms: Option<u32>,
}

impl Output {
    /// Returns how often the task runs during a test.
    #[must_use]
    pub const fn rounds(&self) -> u32 {
        SPAN_MS / self.period_ms
    }
}

/// Runs a test's task from the tick `wake` to the test's end. Calls `change` when its output
/// changes.
pub fn toggle(ctx: &TaskContext, output: &Output, mut wake: Ticks, change: impl Fn()) {
    for _ in 0..output.rounds() {
        change();
        if let Some(burn_ms) = output.burn_ms {
            ctx.burn(Duration::from_millis(burn_ms.into()));
            change();
        }
        ctx.delay_until(&mut wake, Ticks(output.period_ms));
    }
}

/// A test: its tasks begin at the same tick, with their outputs low.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Test {
    /// The id of the requirement.
    pub id: &'static str,
    /// The expected behaviour.
    pub title: &'static str,
    /// The tasks.
    pub outputs: [Output; 3],
}

const fn toggles(name: &'static str, priority: u8, period_ms: u32) -> Output {
    Output {
        name,
        priority,
        period_ms,
        burn_ms: None,
    }
}

/// The tests.
pub const TESTS: [Test; 2] = [
    Test {
        id: "T-RTOS-3",
        title: "each task toggles its output once in its period",
        outputs: [
            toggles("60 ms", 1, 60),
            toggles("40 ms", 2, 40),
            toggles("20 ms", 3, 20),
        ],
    },
    Test {
        id: "T-RTOS-4",
        title: "the most urgent task works for 20 ms in each 30 ms",
        outputs: [
            Output {
                name: "priority 3",
                priority: 3,
                period_ms: 30,
                burn_ms: Some(20),
            },
            toggles("priority 2", 2, 20),
            toggles("priority 1", 1, 10),
        ],
    },
];

/// A change of an output.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct OutputEdge {
    /// Index in [`TESTS`].
    pub test: usize,
    /// Index in the test's outputs.
    pub output: usize,
    /// Time since the test began, ns.
    pub at_ns: u64,
}

impl fmt::Display for OutputEdge {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        let id = TESTS.get(self.test).map_or("?", |test| test.id);
        write!(out, "edge {id} {} {}", self.output, self.at_ns)
    }
}

impl OutputEdge {
    /// Reads the edge from a line of a log; `None` if the line has none.
    #[must_use]
    pub fn parse(line: &str) -> Option<Self> {
        let mut words = line.trim_end().strip_prefix("edge ")?.split(' ');
        let id = words.next()?;
        let test = TESTS.iter().position(|test| test.id == id)?;
        let output = words.next()?.parse().ok()?;
        let at_ns = words.next()?.parse().ok()?;
        let edge = Self {
            test,
            output,
            at_ns,
        };
        (output < TESTS[test].outputs.len() && words.next().is_none()).then_some(edge)
    }
}

#[cfg(test)]
mod tests {
    extern crate std;
    use super::*;
    use std::string::ToString as _;

    #[test]
    fn an_edge_is_read_as_it_was_written() {
        let edge = OutputEdge {
            test: 1,
            output: 2,
            at_ns: 5_000_000_100,
        };
        assert_eq!(edge.to_string(), "edge T-RTOS-4 2 5000000100");
        assert_eq!(OutputEdge::parse(&edge.to_string()), Some(edge));
        for line in [
            "edge T-RTOS-4 3 1",
            "edge T-RTOS-5 0 1",
            "edge T-RTOS-4 0",
            "edge T-RTOS-4 0 1 2",
            "bench a 1 2",
        ] {
            assert_eq!(OutputEdge::parse(line), None, "{line}");
        }
    }
}
