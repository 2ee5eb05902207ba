//! The times of a simulated run, with the source of each figure.

use tandem_board::{Duration, SystemId};
use tandem_board_sim::{BitRates, Bits, WireTimes};
use tandem_cores::task_table::TaskCode;

/// How long jobs, wires and frames take.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Time {
    /// All execution and transmission times are zero.
    #[default]
    Ideal,
    /// Jobs take between a quarter and the whole of the measured 99th percentile, most often 5/8 of
    /// it. Connections have the times of a vehicle without faults.
    Typical,
    /// Each job takes the longest measured time; connections are at their limits.
    Worst,
}

/// A pair of figures, typical and worst. For a task or handler: measured p99 and maximum, ns.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Measured(u64, u64);

/// Execution times on the host: columns "p99" and "max" of the table of response times in
/// `docs/rtos-tasks.md`. The maxima are 2 to 20 times the percentiles, so they also cover a
/// processor that is slower than the host by that factor.
const CORE_0: [(TaskCode, Measured); 6] = [
    (TaskCode::ROLES, Measured(9_000, 169_700)),
    (TaskCode::MONITORING, Measured(2_700, 63_300)),
    (TaskCode::CONTROL, Measured(15_700, 79_000)),
    (TaskCode::DEGRADED, Measured(32_300, 87_400)),
    (TaskCode::TRAJECTORY_INPUT, Measured(30_700, 38_500)),
    (TaskCode::STATUS, Measured(4_400, 11_300)),
];
/// Execution times on cores 1 and 2. Percentiles: on the host, release build, by `tandem run`
/// of `cut-in` and `stop-and-go`, 30 s each, SCHED_FIFO, cores pinned to two CPUs; worst of both
/// systems and runs. Medians were 21 to 32 µs and 90 to 112 µs, maxima 222 and 387 µs. The maxima
/// here are of the firmware: `tandem run --board qemu`, same scenarios, 20 s each. An instruction
/// takes 1 ns there, and riscv32imac computes floating point in software; medians were 1.6 to 1.8
/// and 9.0 to 11.2 ms, p99 2.2 and 13.8 ms. Both programs were made faster later: the firmware's
/// medians are now 1.2 to 1.4 ms and 3.9 to 4.4 ms, its maxima 1.8 and 9.9 ms.
const CORES_1_AND_2: [(TaskCode, Measured); 2] = [
    (TaskCode::PERCEPTION, Measured(117_200, 2_322_900)),
    (TaskCode::PLANNING, Measured(202_000, 14_645_200)),
];
/// Execution times of handlers, same table, with 0.6 µs each for interrupt entry and a switch.
pub(crate) const TICK: Measured = Measured(2_700, 32_400);
pub(crate) const DOORBELL: Measured = Measured(9_600, 30_100);
/// Response times of the tasks for roles and for control, from the same table.
const RESPONSE_OF_ROLES: Measured = Measured(55_000, 313_000);
const RESPONSE_OF_CONTROL: Measured = Measured(119_000, 709_000);

/// A line between the systems, with an isolator and the edge filter of the input; assumed.
const LINE: Measured = Measured(1_000, 10_000);
/// 16 words on a link, at 10 Mbit/s and at 3 Mbit/s; assumed.
const LINK: Measured = Measured(51_200, 170_700);
/// Wrong bits per 10^9: 3.1e-9 per bit in a factory, 2.6e-7 two metres from a welder (Ferreira,
/// Oliveira, Fonseca, Fonseca: An experiment to assess bit error rate in CAN, 2004).
const WRONG_BITS: Measured = Measured(3, 260);
/// The largest error of a crystal, parts per billion: at 25 °C, and from -40 to 125 °C.
const DRIFT: Measured = Measured(20_000, 100_000);
/// The longest frame of the bus: 64 bytes, with a stuff bit after every four bits.
const LONGEST_FRAME: Bits = Bits {
    nominal: 30,
    data: 679,
};
/// The longest of these two: an echo of the gate, a control frame. Both have at most 16 bytes.
const SHORT_FRAME: Bits = Bits {
    nominal: 30,
    data: 189,
};

impl Time {
    /// All settings.
    pub const ALL: [Self; 3] = [Self::Ideal, Self::Typical, Self::Worst];

    /// Returns the setting's name on a command line.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Ideal => "ideal",
            Self::Typical => "typical",
            Self::Worst => "worst",
        }
    }

    /// Returns the time of one job. `draw` returns a random number below its argument.
    pub(crate) fn of(self, Measured(p99, max): Measured, mut draw: impl FnMut(u64) -> u64) -> u64 {
        match self {
            Self::Ideal => 0,
            // The sum of two uniform random numbers has its mode in the middle.
            Self::Typical => p99 / 4 + draw(p99 * 3 / 8 + 1) + draw(p99 * 3 / 8 + 1),
            Self::Worst => max,
        }
    }

    /// Returns the execution time of a job of this task, ns.
    pub(crate) fn execution(self, task: TaskCode, draw: impl FnMut(u64) -> u64) -> u64 {
        let mut measured = CORE_0.iter().chain(&CORES_1_AND_2);
        let measured = measured.find(|(code, _)| *code == task);
        measured.map_or(0, |(_, measured)| self.of(*measured, draw))
    }

    const fn pick(self, Measured(typical, worst): Measured) -> u64 {
        match self {
            Self::Ideal => 0,
            Self::Typical => typical,
            Self::Worst => worst,
        }
    }

    /// Returns the times of the connections.
    #[must_use]
    pub fn wires(self) -> WireTimes {
        WireTimes {
            line: Duration::from_ns(self.pick(LINE)),
            link: Duration::from_ns(self.pick(LINK)),
            bus: (self != Self::Ideal).then_some(BitRates::TANDEM),
            wrong_bits: self.pick(WRONG_BITS) as u32,
        }
    }

    /// Returns how much faster the clock of a system runs than virtual time, parts per billion. B's
    /// drift is the negative of A's.
    #[must_use]
    pub const fn drift_ppb(self, of: SystemId) -> i32 {
        let drift = self.pick(DRIFT) as i32;
        match of {
            SystemId::A => drift,
            SystemId::B => -drift,
        }
    }

    /// Returns the time to add to the bounds of `docs/redundancy.md`, which assume that polls and
    /// frames take no time. It covers the first frame of the successor after a fault: the response
    /// times of the roles and of control, an edge on a line, and two frames, the echo and the
    /// control frame. Each may wait for the longest frame, and be destroyed once.
    #[must_use]
    pub fn allowance(self) -> Duration {
        if self == Self::Ideal {
            return Duration::ZERO;
        }
        let rates = BitRates::TANDEM;
        let frame = rates.time(LONGEST_FRAME)
            + rates.time(SHORT_FRAME)
            + rates.time(Bits::INTERMISSION).times(2);
        let destroyed = rates.time(SHORT_FRAME) + rates.time(Bits::ERROR);
        let on_bus = (frame + destroyed).times(2);
        let cores = self.pick(RESPONSE_OF_ROLES) + self.pick(RESPONSE_OF_CONTROL);
        Duration::from_ns(cores + self.pick(LINE)) + on_bus
    }
}
