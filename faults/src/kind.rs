//! The kinds of faults, and their properties.
//!
//! Each variant of [`Kind`] is a kind of fault in a fault file. Its name is the value of `what`,
//! and its fields are further keys.

use crate::amount::{Amount, Given, just};
use crate::loss::Loss;
use crate::site::Site;
use crate::value::{DeafTo, Forged, FrameName, How, Real, Signal, WrongValue};
use crate::words::wire;
use serde::{Deserialize, Serialize};
use std::fmt;
use tandem_board::{Duration, Line};
use tandem_peripherals::network::Wire;

/// The kind of fault.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(tag = "what", rename_all = "kebab-case")]
pub enum Kind {
    /// A wire carries nothing. A level line that is cut reads as high.
    Cut {
        /// The wire.
        #[serde(with = "wire")]
        wire: Wire,
    },
    /// A wire repeatedly loses contact and makes it again.
    Flap {
        /// The wire.
        #[serde(with = "wire")]
        wire: Wire,
        /// Time with contact, and time without it, ms.
        #[serde(flatten)]
        amount: Amount<1, 1_000>,
    },
    /// The level line reads as low.
    LevelLow,
    /// The level line reads as low for a moment.
    LevelGlitch(Amount<1, 65_535>),
    /// Edges on both heartbeat lines that no system has sent.
    StrayBeats(Amount<1, 255>),
    /// One sync edge that no system has sent.
    StraySync,
    /// The CAN transmitter is dead.
    Mute,
    /// The CAN receiver is dead.
    Deaf,
    /// Frames that the system sends are lost.
    LosesSent(Amount<1, 100>),
    /// Frames on the bus do not reach the system.
    LosesHeard(Amount<1, 100>),
    /// Frames that the system sends reach the bus late.
    Late(Amount<1, 1_000>),
    /// The supply loses power. `chaos` kills its process.
    PowerLoss,
    /// The supply loses power for a time.
    BrownOut(Amount<1, 60_000>),
    /// The watchdog resets the system. `chaos` stops core 0 to cause this.
    ResetByWatchdog,
    /// Core 0 requests a reset.
    ResetBySoftware,
    /// A trap resets the system. `chaos` kills core 0 to imitate this.
    ResetByTrap,
    /// All cores of the system freeze. `chaos` sends SIGSTOP and SIGCONT.
    Hang(Amount<1, 60_000>),
    /// A core dies. `chaos` sends SIGKILL.
    CoreDies(Amount<0, 2>),
    /// A core freezes. `chaos` sends SIGSTOP; an emulated core 0 hangs until its watchdog
    /// resets it.
    CoreHangs(Amount<0, 2>),
    /// The process of the supply freezes.
    SupplyHangs(Amount<1, 60_000>),
    /// The process of the vehicle, which is the bus, freezes.
    VehicleHangs(Amount<1, 60_000>),
    /// The process of `tandem run` freezes.
    LauncherHangs(Amount<1, 60_000>),
    /// A core out of control overwrites the whole LMU.
    Scribble,
    /// After each step, core 0 does not run for this time.
    Slow(Amount<1, 255>),
    /// The clock has a wrong rate.
    Clock(Amount<-900, 5_000>),
    /// The clock and the timers jump.
    ClockJumps(Amount<-10_000, 10_000>),
    /// Control frames contain a command that was not computed, with correct protection.
    WrongResults,
    /// Operations of the data flash never end.
    FlashHangs,
    /// Power is lost for 20 ms, and the content of the data flash is lost.
    FlashLost,
    /// A frame that crashes core 1 of each receiving system is sent every 100 ms.
    Poison,
    /// The vehicle sends nothing.
    VehicleSilent,
    /// One signal of one core is wrong, with correct protection.
    WrongValue(WrongValue),
    /// One core does not hear a frame.
    DeafTo(DeafTo),
    /// Another node sends a forged frame each 10 ms.
    Forged(Forged),
    /// The cable of the system's Ethernet port is cut.
    NetworkCut,
}

/// The end of a fault.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Ends {
    /// At the time that the entry gives, or when everything is restored.
    AsGiven,
    /// After this time.
    After(Duration),
    /// At once: the fault is one event.
    AtOnce,
}

/// The part in which a fault occurs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Scope {
    /// One system.
    System,
    /// A wire between the systems, which has a direction.
    Wire,
    /// A part that both systems share.
    Shared,
}

/// The properties of a kind.
#[derive(Clone, Copy, Debug)]
pub struct Facts {
    /// The boards on which the fault can be injected.
    pub sites: &'static [Site],
    /// The part in which the fault occurs.
    pub scope: Scope,
    /// When the fault ends.
    pub ends: Ends,
    /// How the vehicle loses its master if the fault hits the master.
    pub loss: Loss,
}

const fn row(sites: &'static [Site], scope: Scope, ends: Ends, loss: Loss) -> Facts {
    Facts {
        sites,
        scope,
        ends,
        loss,
    }
}

const EVERY: &[Site] = &[Site::Simulator, Site::Processes, Site::Machines];
/// The simulator and processes.
const SIM_RUN: &[Site] = &[Site::Simulator, Site::Processes];
/// Processes.
const RUN: &[Site] = &[Site::Processes];
/// The simulator.
const SIM: &[Site] = &[Site::Simulator];

impl Kind {
    /// Returns the properties of this kind.
    #[must_use]
    pub const fn facts(self) -> Facts {
        use Ends::{After, AsGiven, AtOnce};
        use Loss::{Mute, Power, Silence, Stall};
        use Scope::{Shared, System};
        match self {
            Self::Cut { wire } | Self::Flap { wire, .. } => match wire {
                Wire::Can => row(EVERY, System, AsGiven, Mute),
                _ => row(EVERY, Scope::Wire, AsGiven, Loss::None),
            },
            Self::LevelLow => row(EVERY, Scope::Wire, AsGiven, Loss::None),
            Self::LevelGlitch(amount) => row(SIM_RUN, Scope::Wire, After(amount.us()), Loss::None),
            Self::StrayBeats(_) => row(EVERY, Scope::Wire, AtOnce, Loss::None),
            Self::StraySync => row(EVERY, Scope::Wire, AtOnce, Loss::None),
            // The vehicle's echo shows the master that it is not obeyed. The master stops sending.
            Self::Mute => row(EVERY, System, AsGiven, Mute),
            Self::LosesSent(_) => row(EVERY, System, AsGiven, Mute),
            Self::Late(_) => row(EVERY, System, AsGiven, Mute),
            // A deaf master continues to send. If it is suspended, its power level falls.
            Self::Deaf => row(EVERY, System, AsGiven, Power),
            Self::LosesHeard(_) => row(EVERY, System, AsGiven, Power),
            Self::PowerLoss => row(EVERY, System, AsGiven, Power),
            Self::BrownOut(amount) => row(EVERY, System, After(amount.ms()), Power),
            Self::ResetByWatchdog => row(EVERY, System, AtOnce, Power),
            Self::ResetBySoftware => row(SIM_RUN, System, AtOnce, Power),
            Self::ResetByTrap => row(EVERY, System, AtOnce, Power),
            // The level is high until the watchdog resets the system.
            Self::Hang(amount) => row(SIM_RUN, System, After(amount.ms()), Silence),
            // An emulated machine can stop core 0, but no other core.
            Self::CoreDies(CORE_0) => row(EVERY, System, AtOnce, Silence),
            Self::CoreHangs(CORE_0) => row(EVERY, System, AsGiven, Silence),
            // Core 0 detects that core 1 or 2 has stopped, and resets its system.
            Self::CoreDies(_) => row(SIM_RUN, System, AtOnce, Power),
            Self::CoreHangs(_) => row(SIM_RUN, System, AsGiven, Power),
            Self::SupplyHangs(amount) => row(RUN, System, After(amount.ms()), Loss::None),
            // No frame reaches the bus, whichever system drives.
            Self::VehicleHangs(amount) => row(RUN, Shared, After(amount.ms()), Stall(amount.ms())),
            Self::LauncherHangs(_) => row(RUN, Shared, AtOnce, Loss::None),
            Self::Scribble => row(EVERY, System, AtOnce, Silence),
            Self::Slow(_) => row(SIM, System, AsGiven, Silence),
            Self::Clock(amount) => row(SIM, System, AsGiven, Loss::of_clock(amount.get())),
            // The timers of the system stop, or its own clock shows a stall.
            Self::ClockJumps(_) => row(SIM, System, AtOnce, Silence),
            Self::WrongResults => row(SIM, System, AsGiven, Mute),
            Self::FlashHangs => row(SIM, System, AsGiven, Loss::None),
            Self::FlashLost => row(SIM_RUN, System, After(Duration::from_ms(20)), Power),
            Self::Poison => row(SIM, Shared, AsGiven, Power),
            Self::VehicleSilent => row(SIM, Shared, AsGiven, Loss::None),
            Self::WrongValue(_) => row(SIM, System, AsGiven, Mute),
            Self::DeafTo(_) => row(SIM_RUN, System, AsGiven, Mute),
            Self::Forged(_) => row(SIM_RUN, Shared, AsGiven, Mute),
            Self::NetworkCut => row(EVERY, System, AsGiven, Loss::None),
        }
    }

    /// Returns the value of the key `amount`, with its range and unit; `None` without this key.
    #[must_use]
    pub const fn amount(self) -> Option<Given> {
        Some(match self {
            Self::Flap { amount, .. } => amount.given("ms"),
            Self::LevelGlitch(amount) => amount.given("µs"),
            Self::StrayBeats(amount) => amount.given("edges"),
            Self::LosesSent(amount) | Self::LosesHeard(amount) => amount.given("percent"),
            Self::Late(amount) => amount.given("ms"),
            Self::BrownOut(amount)
            | Self::Hang(amount)
            | Self::SupplyHangs(amount)
            | Self::VehicleHangs(amount)
            | Self::LauncherHangs(amount) => amount.given("ms"),
            Self::CoreDies(amount) | Self::CoreHangs(amount) => amount.given(CORE),
            Self::Slow(amount) => amount.given("ms"),
            Self::Clock(amount) => amount.given("parts in a thousand"),
            Self::ClockJumps(amount) => amount.given("ms"),
            _ => return None,
        })
    }

    /// Returns whether a foreign node sends control frames: those on the bus then do not tell which
    /// system transmits.
    #[must_use]
    pub fn forges_control(self) -> bool {
        matches!(self, Self::Forged(forged) if forged.frame.info().name.starts_with("Control"))
    }

    /// Returns whether this kind of fault can be injected on this board.
    #[must_use]
    pub fn is_for(self, site: Site) -> bool {
        self.facts().sites.contains(&site)
    }

    /// Returns the value of `what` in a file.
    #[must_use]
    pub fn word(self) -> String {
        let table = toml::Table::try_from(self).unwrap_or_default();
        let word = table.get("what").and_then(toml::Value::as_str);
        word.unwrap_or_default().to_owned()
    }

    /// Returns the value of `what` with the wire or the core, such as `core-dies 0` or `cut can`.
    #[must_use]
    pub fn label(self) -> String {
        match (self, self.amount()) {
            (Self::Cut { wire } | Self::Flap { wire, .. }, _) => {
                format!("{} {}", self.word(), wire.name())
            }
            (Self::WrongValue(wrong), _) => format!("{} {}", self.word(), wrong.signal.name()),
            (Self::DeafTo(to), _) => format!("{} {}", self.word(), to.frame.info().name),
            (Self::Forged(forged), _) => {
                format!("{} {}", self.word(), forged.frame.info().name)
            }
            (
                _,
                Some(Given {
                    number, unit: CORE, ..
                }),
            ) => format!("{} {number}", self.word()),
            _ => self.word(),
        }
    }

    /// Returns the labels of everything that the simulator can inject, each once.
    #[must_use]
    pub fn labels() -> Vec<String> {
        let all = Self::OF_ONE_SYSTEM.iter().chain(&Self::FURTHER);
        let all = all.chain(&Self::OF_BOTH).map(|kind| kind.label());
        let mut labels: Vec<String> = all.collect();
        labels.sort_unstable();
        labels.dedup();
        labels
    }

    /// Returns the further keys of wrong values, deafness and forgeries in words; `None` for other
    /// kinds.
    #[must_use]
    pub fn own_keys(self) -> Option<String> {
        Some(match self {
            Self::WrongValue(_) => {
                let signals: Vec<&str> = Signal::ALL.iter().map(|it| it.name()).collect();
                let hows: Vec<&str> = How::ALL.iter().map(|it| it.name()).collect();
                let (signals, hows) = (signals.join(", "), hows.join(", "));
                format!("`signal`: {signals}; `core`; `how`: {hows}; `amount`, a number")
            }
            Self::DeafTo(_) => "`frame`, of the DBC; `core`: 0 or 1".to_owned(),
            Self::Forged(_) => "`frame` and `field`, of the DBC; `value`, a number".to_owned(),
            _ => return None,
        })
    }

    /// Returns one wrong value, one deafness and one forged frame.
    fn of_values() -> Vec<Self> {
        let wrong = WrongValue {
            signal: Signal::LaneHeading,
            core: 1,
            how: How::Offset,
            amount: Real::thousandths(50),
        };
        let deaf =
            FrameName::of("CameraLanes").map(|frame| Self::DeafTo(DeafTo { frame, core: 1 }));
        let forged = FrameName::of("GateEcho").and_then(|frame| {
            let last_term = Real::thousandths(0xFFFF_FFFE_i64 * 1_000);
            Forged::of(frame, "Term", last_term).map(Self::Forged)
        });
        let all = [Some(Self::WrongValue(wrong)), deaf, forged];
        all.into_iter().flatten().collect()
    }

    /// Returns at least one of each kind, in the order of the documentation.
    pub fn samples() -> impl Iterator<Item = Self> {
        let lists = [&Self::OF_ONE_SYSTEM[..], &Self::OF_PROCESSES];
        let lists = lists
            .into_iter()
            .chain([&Self::FURTHER[..], &Self::OF_BOTH]);
        let further = Self::of_values().into_iter();
        let further = further.chain([Self::NetworkCut, Self::ResetByTrap]);
        lists.flatten().copied().chain(further)
    }
}

impl fmt::Display for Kind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::WrongValue(wrong) => return write!(f, "{} {wrong}", self.word()),
            Self::DeafTo(to) => return write!(f, "{} {to}", self.word()),
            Self::Forged(forged) => return write!(f, "{} {forged}", self.word()),
            _ => {}
        }
        f.write_str(&self.label())?;
        match self.amount().filter(|amount| amount.unit != CORE) {
            Some(Given { number, unit, .. }) => write!(f, " {number} {unit}"),
            None => Ok(()),
        }
    }
}

/// The unit of an amount that is the number of a core.
const CORE: &str = "the core";
const CORE_0: Amount<0, 2> = just(0);
const BEAT_1: Wire = Wire::Line(Line::Heartbeat1);
const BEAT_2: Wire = Wire::Line(Line::Heartbeat2);
const START: Wire = Wire::Line(Line::Start);

/// The lists from which campaigns draw. A sequence number must always give the same faults, so no
/// list may change. The exception is [`Kind::FURTHER`], to which kinds may be appended: this
/// changes only the sequences of the group swarm.
impl Kind {
    /// All faults of one system or of a wire, with the parameters that the simulator uses.
    pub const OF_ONE_SYSTEM: [Self; 50] = {
        use Kind as K;
        [
            K::Cut { wire: START },
            K::Cut { wire: BEAT_1 },
            K::Cut { wire: BEAT_2 },
            K::Cut { wire: Wire::Level },
            K::Cut { wire: Wire::Link },
            K::Cut { wire: Wire::Can },
            flap(START, 5),
            flap(BEAT_1, 5),
            flap(BEAT_2, 20),
            flap(Wire::Level, 5),
            flap(Wire::Level, 40),
            flap(Wire::Link, 30),
            flap(Wire::Can, 7),
            flap(Wire::Can, 60),
            K::LevelLow,
            K::LevelGlitch(just(300)),
            K::StrayBeats(just(3)),
            K::StraySync,
            K::Mute,
            K::Deaf,
            K::LosesSent(just(2)),
            K::LosesSent(just(10)),
            K::LosesSent(just(50)),
            K::LosesHeard(just(2)),
            K::LosesHeard(just(10)),
            K::LosesHeard(just(50)),
            K::Late(just(3)),
            K::Late(just(30)),
            K::PowerLoss,
            K::BrownOut(just(1)),
            K::BrownOut(just(15)),
            K::BrownOut(just(200)),
            K::ResetByWatchdog,
            K::ResetBySoftware,
            K::Hang(just(4)),
            K::Hang(just(12)),
            K::Hang(just(19)),
            K::Hang(just(400)),
            core_dies(0),
            core_dies(1),
            core_dies(2),
            K::Slow(just(2)),
            K::Slow(just(4)),
            K::Clock(just(1)),
            K::Clock(just(-50)),
            K::Clock(just(50)),
            K::Clock(just(-500)),
            K::Clock(just(1000)),
            K::FlashHangs,
            K::FlashLost,
        ]
    };
    /// Additional faults for single sequences and for the swarm.
    pub const FURTHER: [Self; 6] = [
        Self::ClockJumps(just(-500)),
        Self::ClockJumps(just(-7)),
        Self::ClockJumps(just(7)),
        Self::ClockJumps(just(500)),
        Self::WrongResults,
        Self::Scribble,
    ];
    /// Faults of both systems at once.
    pub const OF_BOTH: [Self; 2] = [Self::Poison, Self::VehicleSilent];
    /// Faults of processes and emulated machines. A time of 1 ms is a placeholder for a random one.
    pub const OF_PROCESSES: [Self; 34] = {
        use Kind as K;
        [
            K::PowerLoss,
            K::BrownOut(just(1)),
            K::ResetBySoftware,
            core_dies(0),
            core_dies(1),
            core_dies(2),
            core_hangs(0),
            core_hangs(1),
            core_hangs(2),
            K::Hang(just(1)),
            K::SupplyHangs(just(1)),
            K::Scribble,
            K::FlashLost,
            K::Cut { wire: BEAT_1 },
            K::Cut { wire: BEAT_2 },
            K::Cut { wire: START },
            K::Cut { wire: Wire::Level },
            K::Cut { wire: Wire::Link },
            K::Cut { wire: Wire::Can },
            flap(BEAT_1, 5),
            flap(Wire::Level, 5),
            flap(Wire::Link, 30),
            flap(Wire::Can, 60),
            K::LevelLow,
            K::LevelGlitch(just(300)),
            K::StrayBeats(just(3)),
            K::StraySync,
            K::Mute,
            K::Deaf,
            K::LosesSent(just(10)),
            K::LosesHeard(just(10)),
            K::Late(just(3)),
            K::VehicleHangs(just(1)),
            K::LauncherHangs(just(1)),
        ]
    };

    /// Returns the kind with its placeholder replaced by this time, if the kind has a time.
    #[must_use]
    pub(crate) const fn with_time(self, ms: i32) -> Self {
        let amount = just(ms);
        match self {
            Self::BrownOut(_) => Self::BrownOut(amount),
            Self::Hang(_) => Self::Hang(amount),
            Self::SupplyHangs(_) => Self::SupplyHangs(amount),
            Self::VehicleHangs(_) => Self::VehicleHangs(amount),
            Self::LauncherHangs(_) => Self::LauncherHangs(amount),
            other => other,
        }
    }
}

const fn flap(wire: Wire, ms: i32) -> Kind {
    Kind::Flap {
        wire,
        amount: just(ms),
    }
}

const fn core_dies(core: i32) -> Kind {
    Kind::CoreDies(just(core))
}

const fn core_hangs(core: i32) -> Kind {
    Kind::CoreHangs(just(core))
}
