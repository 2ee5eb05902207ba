//! The configuration of a simulated run.

use tandem_board::{CanFrame, Duration, Instant};
use tandem_peripherals::network::{LINK_DATAGRAMS, WireTimes};
use tandem_peripherals::supply;
use tandem_peripherals::watchdog::Window;

/// How a system's clock relates to virtual time: `local = offset + time × (1 + drift / 10⁹)`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Clock {
    /// Reading of the clock at virtual time zero, in nanoseconds.
    pub offset_ns: u64,
    /// How much faster than virtual time the clock runs, in parts per billion. For a crystal at
    /// most ± 100,000.
    pub drift_ppb: i32,
}

impl Clock {
    const BILLION: i128 = 1_000_000_000;

    fn rate(self) -> i128 {
        Self::BILLION + i128::from(self.drift_ppb)
    }

    /// Returns the local time at virtual time `at_ns`.
    pub(crate) fn local_ns(self, at_ns: u64) -> u64 {
        if self.drift_ppb == 0 {
            return at_ns.saturating_add(self.offset_ns);
        }
        let run = i128::from(at_ns) * self.rate() / Self::BILLION;
        u64::try_from(run)
            .unwrap_or(u64::MAX)
            .saturating_add(self.offset_ns)
    }

    /// Returns the first virtual time at which the clock shows `local_ns` or more, so that no
    /// deadline is early.
    pub(crate) fn virtual_ns(self, local_ns: u64) -> u64 {
        if local_ns == u64::MAX {
            return u64::MAX;
        }
        if self.drift_ppb == 0 {
            return local_ns.saturating_sub(self.offset_ns);
        }
        let run = i128::from(local_ns.saturating_sub(self.offset_ns));
        let at = (run * Self::BILLION + self.rate() - 1) / self.rate();
        u64::try_from(at).unwrap_or(u64::MAX)
    }
}

/// Changes a frame that a system sends.
pub type Tamper = fn(&CanFrame) -> CanFrame;
/// Changes a frame between the bus and one core. Gets the time on the system's clock. `None`: the
/// frame is lost.
pub type Filter = Box<dyn FnMut(Instant, CanFrame) -> Option<CanFrame> + Send>;

/// The order in which cores run if they are due at the same instant.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Order {
    /// A0, A1, A2, B0, B1, B2.
    #[default]
    Fixed,
    /// A new order each time, drawn from the seed.
    Shuffled,
}

/// Configuration of a [`SimPair`](crate::SimPair).
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Config {
    /// Seed of all random choices: the order of cores, torn flash bytes.
    pub seed: u64,
    /// The clocks of systems A and B. By default their origins differ, as those of two chips do.
    pub clocks: [Clock; 2],
    /// The order in which cores run if they are due at the same instant.
    pub order: Order,
    /// Whether the supplies reset a system whose watchdog is not serviced.
    pub watchdog: bool,
    /// When a watchdog service is in time.
    pub window: Window,
    /// How long a supply holds its system in reset.
    pub reset_hold: Duration,
    /// Virtual time that a blocking core pays for reading the clock, a line or an empty receiver,
    /// or for a wait that ends at once, so that a polling loop ends. Polled cores pay nothing.
    pub look_at_clock: Duration,
    /// Capacity of a core's CAN receive FIFO, in frames.
    pub can_fifo_frames: usize,
    /// Capacity of each direction of the link, in datagrams.
    pub link_datagrams: usize,
    /// Capacity of the trace, in records.
    pub trace_records: usize,
    /// Transfer times and bit errors of the connections.
    pub wires: WireTimes,
    /// The time of a datagram in the cables and the switch of the Ethernet. `None`: no system is
    /// connected to a network.
    pub network: Option<Duration>,
}

impl Default for Config {
    fn default() -> Self {
        Self {
            seed: 1,
            clocks: [
                Clock {
                    offset_ns: 1_000_000,
                    drift_ppb: 0,
                },
                Clock {
                    offset_ns: 7_000_000_000,
                    drift_ppb: 0,
                },
            ],
            order: Order::Fixed,
            watchdog: true,
            window: Window::TARGET,
            reset_hold: supply::Config::TARGET.hold,
            look_at_clock: Duration::from_us(2),
            can_fifo_frames: 512,
            link_datagrams: LINK_DATAGRAMS,
            trace_records: 1 << 16,
            wires: WireTimes::default(),
            network: None,
        }
    }
}

impl Config {
    /// Returns the configuration of the supplies.
    pub(crate) const fn supply(&self) -> supply::Config {
        supply::Config {
            window: self.window,
            watches: self.watchdog,
            hold: self.reset_hold,
            longest_hold: self.reset_hold,
            ..supply::Config::TARGET
        }
    }
}
