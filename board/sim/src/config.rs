//! The configuration of a simulated run.

use tandem_board::{CanFrame, Duration, HardwareFault};
use tandem_peripherals::network::{LINK_DATAGRAMS, WireTimes};
use tandem_peripherals::supply;
use tandem_peripherals::watchdog::Window;

/// How a system's clock relates to virtual time: `local = offset + time × (1 + drift / 10⁹)`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Clock {
    /// What the clock shows at virtual time zero, in nanoseconds.
    pub offset_ns: u64,
    /// How much faster it runs than virtual time, in parts per billion; a crystal is within ± 100
    /// 000.
    pub drift_ppb: i32,
}

impl Clock {
    const BILLION: i128 = 1_000_000_000;

    fn rate(self) -> i128 {
        Self::BILLION + i128::from(self.drift_ppb)
    }

    /// The local time at virtual time `at_ns`.
    pub(crate) fn local_ns(self, at_ns: u64) -> u64 {
        if self.drift_ppb == 0 {
            return at_ns.saturating_add(self.offset_ns);
        }
        let run = i128::from(at_ns) * self.rate() / Self::BILLION;
        u64::try_from(run)
            .unwrap_or(u64::MAX)
            .saturating_add(self.offset_ns)
    }

    /// The first virtual time at which the clock shows `local_ns` or more, so that no deadline is
    /// early.
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

/// What becomes of a frame.
pub type Tamper = fn(&CanFrame) -> CanFrame;

/// The order of cores that are due at the same instant.
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
    /// The clocks of systems A and B. By default with different origins, as two chips have.
    pub clocks: [Clock; 2],
    /// The order of cores that are due at the same instant.
    pub order: Order,
    /// Whether the supplies reset a system whose watchdog is not serviced.
    pub watchdog: bool,
    /// How long a supply holds its system in reset.
    pub reset_hold: Duration,
    /// Virtual time that a blocking core pays for reading the clock, a line, an empty receiver, or
    /// for a wait that ends at once, so that a polling loop ends. Polled cores pay nothing.
    pub look_at_clock: Duration,
    /// Frames that a core's CAN receive FIFO holds.
    pub can_fifo_frames: usize,
    /// Datagrams that a direction of the link holds.
    pub link_datagrams: usize,
    /// Records that the trace holds.
    pub trace_records: usize,
    /// What the connections take.
    pub wires: WireTimes,
    /// A deliberate fault of the board itself, which the conformance suite must find.
    pub defect: Option<Defect>,
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
            reset_hold: supply::Config::TARGET.hold,
            look_at_clock: Duration::from_us(2),
            can_fifo_frames: 512,
            link_datagrams: LINK_DATAGRAMS,
            trace_records: 1 << 16,
            wires: WireTimes::default(),
            defect: None,
        }
    }
}

impl Config {
    /// The configuration of the supplies, with the defects of the watchdog's window.
    pub(crate) fn supply(&self) -> supply::Config {
        let mut window = Window::TARGET;
        match self.defect {
            Some(Defect::WindowIgnored) => window.opens_us = 0,
            Some(Defect::WindowLate) => window.opens_us += 1_000,
            Some(Defect::WatchdogSleeps) => {
                (window.closes_us, window.first_us) = (u32::MAX, u32::MAX)
            }
            _ => {}
        }
        supply::Config {
            window,
            watches: self.watchdog,
            hold: self.reset_hold,
            longest_hold: self.reset_hold,
            ..supply::Config::TARGET
        }
    }
}

/// A way in which a board can break its contract.
///
/// Exists for one purpose: each defect must make the conformance suite fail.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Defect {
    /// A ring that arrives while the core is awake is lost.
    LostRing,
    /// A ring goes to the next core.
    MisdirectedRing,
    /// `wait` ends before its deadline.
    EarlyDeadline,
    /// `wait` says "deadline" for an interrupt.
    WrongWake,
    /// `wait` says "interrupt" for a deadline.
    SpuriousForEver,
    /// The clock sometimes goes back.
    ClockGoesBack,
    /// The cores of a system have different clocks.
    SkewedCores,
    /// Each core has an LMU of its own.
    PrivateLmu,
    /// The systems share one LMU.
    OneLmu,
    /// The LMU is not zero at power-on.
    DirtyLmu,
    /// The generation does not begin at 1.
    WrongGeneration,
    /// All cores start with core 0.
    NoneHeld,
    /// A release has no effect.
    NeverReleased,
    /// A release releases all cores.
    ReleasesAll,
    /// A core that is released twice starts twice.
    ReleasesAgain,
    /// A core receives the CAN frames that it sends.
    SelfReception,
    /// The other system does not hear this system's CAN frames.
    NoBroadcast,
    /// A discard of the frames that wait also discards the next one.
    DiscardsLaterFrame,
    /// Two CAN frames change places.
    CanReordered,
    /// System B hears its own frames before those of system A.
    CanTwoOrders,
    /// The end of a long CAN FD frame is lost.
    FdTruncated,
    /// Lost CAN frames are not counted.
    OverrunNotCounted,
    /// A received CAN frame does not wake.
    NoWakeOnReceive,
    /// A received CAN frame wakes a core that did not ask for it.
    AlwaysWakeOnReceive,
    /// Falling edges count as rising ones.
    WrongEdge,
    /// Edges come back on the sender's own counters.
    LineLoopback,
    /// An edge on the start line does not interrupt.
    SilentStart,
    /// The level line does not show that the other system is on.
    LevelStuckLow,
    /// The level line does not fall.
    LevelStuckHigh,
    /// A change of the level line does not interrupt.
    SilentLevel,
    /// Words of two datagrams are mixed.
    LinkTorn,
    /// Datagrams overtake each other.
    LinkReordered,
    /// A full link drops datagrams silently.
    LinkDrops,
    /// The rest of a datagram that is too long for a receiver's buffer arrives as the next
    /// datagram.
    LinkSplits,
    /// Erase fills with zeros.
    EraseToZero,
    /// Programming need not be aligned to pages.
    MisalignedProgram,
    /// A new operation replaces the one under way.
    NeverBusy,
    /// Programming sets bits.
    ProgramSets,
    /// An operation that a reset interrupts destroys its whole sector.
    ResetDisturbs,
    /// Programming a page disturbs the page behind it.
    ProgramDisturbs,
    /// A reset erases the flash.
    FlashForgets,
    /// The watchdog resets the system although it was serviced well.
    WatchdogRefuses,
    /// The watchdog always asks the same question.
    SameQuestion,
    /// A wrong answer to the watchdog has no effect.
    AnyAnswer,
    /// An early service is accepted.
    WindowIgnored,
    /// The window of the watchdog opens too late.
    WindowLate,
    /// A missing service has no effect.
    WatchdogSleeps,
    /// The reset cause is always power-on.
    CauseForgotten,
    /// A requested reset does not happen.
    RequestIgnored,
    /// A reset leaves core 2 running.
    PartialReset,
    /// A fault of the hardware has no effect.
    FaultWithoutEffect(HardwareFault),
}

impl Defect {
    /// All defects.
    pub const ALL: [Self; 57] = [
        Self::LostRing,
        Self::MisdirectedRing,
        Self::EarlyDeadline,
        Self::WrongWake,
        Self::SpuriousForEver,
        Self::ClockGoesBack,
        Self::SkewedCores,
        Self::PrivateLmu,
        Self::OneLmu,
        Self::DirtyLmu,
        Self::WrongGeneration,
        Self::NoneHeld,
        Self::NeverReleased,
        Self::ReleasesAll,
        Self::ReleasesAgain,
        Self::SelfReception,
        Self::NoBroadcast,
        Self::DiscardsLaterFrame,
        Self::CanReordered,
        Self::CanTwoOrders,
        Self::FdTruncated,
        Self::OverrunNotCounted,
        Self::NoWakeOnReceive,
        Self::AlwaysWakeOnReceive,
        Self::WrongEdge,
        Self::LineLoopback,
        Self::SilentStart,
        Self::LevelStuckLow,
        Self::LevelStuckHigh,
        Self::SilentLevel,
        Self::LinkTorn,
        Self::LinkReordered,
        Self::LinkDrops,
        Self::LinkSplits,
        Self::EraseToZero,
        Self::MisalignedProgram,
        Self::NeverBusy,
        Self::ProgramSets,
        Self::ResetDisturbs,
        Self::ProgramDisturbs,
        Self::FlashForgets,
        Self::WatchdogRefuses,
        Self::SameQuestion,
        Self::AnyAnswer,
        Self::WindowIgnored,
        Self::WindowLate,
        Self::WatchdogSleeps,
        Self::CauseForgotten,
        Self::RequestIgnored,
        Self::PartialReset,
        Self::FaultWithoutEffect(HardwareFault::OpenLoad),
        Self::FaultWithoutEffect(HardwareFault::ShortCircuit),
        Self::FaultWithoutEffect(HardwareFault::CanTransmit),
        Self::FaultWithoutEffect(HardwareFault::CanReceive),
        Self::FaultWithoutEffect(HardwareFault::ErrorPin),
        Self::FaultWithoutEffect(HardwareFault::Undervoltage),
        Self::FaultWithoutEffect(HardwareFault::Overvoltage),
    ];
}
