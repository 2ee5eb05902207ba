//! One fault, and the acts on the simulated machine that it consists of.

use std::fmt;
use tandem_board::{CoreId, Duration, Edge, Line, ResetCause, SystemId};
use tandem_board_sim::{BusFault, Wire};

/// The kind of fault.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// A wire carries nothing. A level line that is cut reads as high.
    Cut(Wire),
    /// A wire makes contact and loses it, each for this many milliseconds.
    Flap(Wire, u16),
    /// The level line reads as low.
    LevelLow,
    /// The level line reads as low for this many microseconds.
    LevelGlitch(u16),
    /// Edges that no system has sent: this many on both heartbeat lines.
    StrayBeats(u8),
    /// One sync edge that no system has sent.
    StraySync,
    /// The CAN transmitter is dead.
    Mute,
    /// The CAN receiver is dead.
    Deaf,
    /// Of a hundred frames that it sends, this many are lost.
    LosesSent(u8),
    /// Of a hundred frames on the bus, this many do not reach it.
    LosesHeard(u8),
    /// What it sends reaches the bus this many milliseconds later.
    Late(u16),
    /// Its supply loses power.
    PowerLoss,
    /// Its supply loses power for this many milliseconds.
    BrownOut(u16),
    /// It is reset.
    Reset(ResetCause),
    /// All its cores stand still for this many milliseconds.
    Hang(u16),
    /// A core dies.
    CoreDies(CoreId),
    /// A core stands still.
    CoreHangs(CoreId),
    /// The process of its supply stands still for this many milliseconds. A chip's cannot.
    SupplyHangs(u16),
    /// The vehicle's process, which is the bus, stands still for this many milliseconds.
    VehicleHangs(u16),
    /// The process that started the run stands still for this many milliseconds.
    LauncherHangs(u16),
    /// A core out of control overwrites the whole LMU.
    Scribble,
    /// Core 0 is called in each period of this many milliseconds at most.
    Slow(u8),
    /// Its clock is wrong by this many parts in a thousand.
    Clock(i16),
    /// Its clock jumps by this many milliseconds.
    ClockJumps(i16),
    /// It computes wrong commands, and protects them well.
    WrongResults,
    /// Operations of the data flash do not end.
    FlashHangs,
    /// The data flash loses its content, and so does what was known of it: power is lost for 20 ms.
    FlashLost,
    /// A frame that ends core 1 of each system that hears it, repeated every 100 ms.
    Poison,
    /// The vehicle sends nothing.
    VehicleSilent,
}

impl Kind {
    /// All that can fail in one system or on a wire, with the parameters that the campaign tries.
    pub const OF_ONE_SYSTEM: [Self; 50] = {
        use CoreId as C;
        use Kind as K;
        const START: Wire = Wire::Line(Line::Start);
        const BEAT_1: Wire = Wire::Line(Line::Heartbeat1);
        const BEAT_2: Wire = Wire::Line(Line::Heartbeat2);
        [
            K::Cut(START),
            K::Cut(BEAT_1),
            K::Cut(BEAT_2),
            K::Cut(Wire::Level),
            K::Cut(Wire::Link),
            K::Cut(Wire::Can),
            K::Flap(START, 5),
            K::Flap(BEAT_1, 5),
            K::Flap(BEAT_2, 20),
            K::Flap(Wire::Level, 5),
            K::Flap(Wire::Level, 40),
            K::Flap(Wire::Link, 30),
            K::Flap(Wire::Can, 7),
            K::Flap(Wire::Can, 60),
            K::LevelLow,
            K::LevelGlitch(300),
            K::StrayBeats(3),
            K::StraySync,
            K::Mute,
            K::Deaf,
            K::LosesSent(2),
            K::LosesSent(10),
            K::LosesSent(50),
            K::LosesHeard(2),
            K::LosesHeard(10),
            K::LosesHeard(50),
            K::Late(3),
            K::Late(30),
            K::PowerLoss,
            K::BrownOut(1),
            K::BrownOut(15),
            K::BrownOut(200),
            K::Reset(ResetCause::Watchdog),
            K::Reset(ResetCause::Software),
            K::Hang(4),
            K::Hang(12),
            K::Hang(19),
            K::Hang(400),
            K::CoreDies(C::CONTROL),
            K::CoreDies(C::PERCEPTION),
            K::CoreDies(C::PLANNING),
            K::Slow(2),
            K::Slow(4),
            K::Clock(1),
            K::Clock(-50),
            K::Clock(50),
            K::Clock(-500),
            K::Clock(1000),
            K::FlashHangs,
            K::FlashLost,
        ]
    };
    /// What the single faults and the swarm try in addition.
    pub const FURTHER: [Self; 6] = [
        Self::ClockJumps(-500),
        Self::ClockJumps(-7),
        Self::ClockJumps(7),
        Self::ClockJumps(500),
        Self::WrongResults,
        Self::Scribble,
    ];
    /// Faults of both systems at once.
    pub const OF_BOTH: [Self; 2] = [Self::Poison, Self::VehicleSilent];

    /// Whether the simulator can do it.
    #[must_use]
    pub const fn is_for_simulator(self) -> bool {
        !matches!(
            self,
            Self::SupplyHangs(_) | Self::VehicleHangs(_) | Self::LauncherHangs(_)
        )
    }

    /// Whether real processes can suffer it.
    #[must_use]
    pub const fn is_for_processes(self) -> bool {
        !matches!(
            self,
            Self::Slow(_)
                | Self::Clock(_)
                | Self::ClockJumps(_)
                | Self::WrongResults
                | Self::FlashHangs
                | Self::Poison
                | Self::VehicleSilent
        )
    }

    /// Whether emulated machines can suffer it. Core 0 that stands still does so until its watchdog
    /// resets it.
    #[must_use]
    pub const fn is_for_machines(self) -> bool {
        match self {
            Self::CoreDies(core) | Self::CoreHangs(core) => core.index() == CoreId::CONTROL.index(),
            Self::Reset(cause) => matches!(cause, ResetCause::Watchdog | ResetCause::Trap),
            Self::Cut(_)
            | Self::Flap(..)
            | Self::LevelLow
            | Self::StrayBeats(_)
            | Self::StraySync
            | Self::Mute
            | Self::Deaf
            | Self::LosesSent(_)
            | Self::LosesHeard(_)
            | Self::Late(_)
            | Self::PowerLoss
            | Self::BrownOut(_)
            | Self::Scribble => true,
            _ => false,
        }
    }

    /// Whether it is a fault of what both systems share.
    #[must_use]
    pub const fn is_of_both(self) -> bool {
        matches!(
            self,
            Self::Poison | Self::VehicleSilent | Self::VehicleHangs(_) | Self::LauncherHangs(_)
        )
    }

    /// Whether it is a fault of a wire between the systems, which has a direction.
    #[must_use]
    pub const fn is_of_wire(self) -> bool {
        match self {
            Self::Cut(wire) | Self::Flap(wire, _) => !matches!(wire, Wire::Can),
            Self::LevelLow | Self::LevelGlitch(_) | Self::StrayBeats(_) | Self::StraySync => true,
            _ => false,
        }
    }
}

/// Which way a wire fails; faults of a system are all [`Way::From`] it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Way {
    /// What this system sends, or the system itself.
    From(SystemId),
    /// Both directions.
    Both,
}

impl Way {
    /// One system or both.
    pub fn systems(self) -> impl Iterator<Item = SystemId> {
        SystemId::ALL
            .into_iter()
            .filter(move |system| self == Self::Both || self == Self::From(*system))
    }
}

/// Something that fails at a time, and for how long.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Fault {
    /// What.
    pub kind: Kind,
    /// Of which system, or which way.
    pub way: Way,
    /// When, after the faults begin.
    pub at: Duration,
    /// For how long, where the kind does not say; until everything is mended if `None`.
    pub lasts: Option<Duration>,
}

impl fmt::Display for Fault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self {
            kind,
            way,
            at,
            lasts,
        } = self;
        write!(f, "{:.1} ms {way:?} {kind:?}", at.as_ms_f64())?;
        lasts.map_or(Ok(()), |lasts| {
            write!(f, " for {:.1} ms", lasts.as_ms_f64())
        })
    }
}

/// One change of the machine; `true` begins what `false` ends.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Act {
    /// What this system sends on the wire does not arrive.
    Cut(Wire, SystemId, bool),
    /// The level line of this system reads as low.
    LevelLow(SystemId, bool),
    /// An edge that no system has sent. The system that hears it.
    Edge(SystemId, Line, Edge),
    /// Of a thousand frames that it sends, this many are lost from now on.
    LostOut(SystemId, u16),
    /// Of a thousand frames on the bus, this many do not reach it from now on.
    LostIn(SystemId, u16),
    /// What it sends is late by this many milliseconds from now on.
    Late(SystemId, u16),
    /// Its supply has power or not.
    Power(SystemId, bool),
    /// It is reset.
    Reset(SystemId, ResetCause),
    /// All its cores stand still for this many milliseconds.
    Freeze(SystemId, u16),
    /// One core stands still.
    FreezeCore(SystemId, CoreId, bool),
    /// A core dies.
    Kill(SystemId, CoreId),
    /// Core 0 is not called for this many milliseconds after each poll.
    Rest(SystemId, u8),
    /// Its clock is wrong by this many parts in a thousand from now on.
    Clock(SystemId, i16),
    /// Its clock jumps by this many milliseconds.
    ClockJumps(SystemId, i16),
    /// Its control frames carry another command than it has computed.
    WrongResults(SystemId, bool),
    /// Operations of its data flash do not end.
    FlashHangs(SystemId, bool),
    /// Its data flash loses its content.
    FlashLost(SystemId),
    /// Its LMU is overwritten.
    Scribble(SystemId),
    /// The process of its supply stands still.
    FreezeSupply(SystemId, bool),
    /// The process of the vehicle stands still.
    FreezeVehicle(bool),
    /// The process that started the run stands still for this many milliseconds.
    FreezeLauncher(u16),
    /// The frame that ends core 1 is sent.
    Poison(bool),
    /// The vehicle sends nothing.
    VehicleSilent(bool),
}

/// The faults of the connections to the CAN bus of A and B, as acts change them in turn.
#[derive(Clone, Copy, Debug, Default)]
pub struct BusFaults([BusFault; 2]);

impl BusFaults {
    /// Follows an act: the system whose connection it changes, and the faults that this has now.
    pub fn follow(&mut self, act: Act) -> Option<(SystemId, BusFault)> {
        let of = match act {
            Act::LostOut(of, permille) => {
                self.0[of.index()].lost_out = permille;
                of
            }
            Act::LostIn(of, permille) => {
                self.0[of.index()].lost_in = permille;
                of
            }
            Act::Late(of, ms) => {
                self.0[of.index()].late = Duration::from_ms(ms.into());
                of
            }
            _ => return None,
        };
        Some((of, self.0[of.index()]))
    }
}

impl Fault {
    /// Its acts with their times after the faults begin, up to `end`, when all is mended anyway.
    #[must_use]
    pub fn acts(&self, end: Duration) -> Vec<(Duration, Act)> {
        let mut acts = Vec::new();
        // What both systems share fails once.
        let times = if self.kind.is_of_both() { 1 } else { 2 };
        for system in self.way.systems().take(times) {
            self.acts_of(system, end, &mut acts);
        }
        acts
    }

    fn acts_of(&self, s: SystemId, end: Duration, acts: &mut Vec<(Duration, Act)>) {
        let from = self.at;
        let until = self.lasts.map_or(end, |lasts| (from + lasts).min(end));
        let ms = |ms: u16| Duration::from_ms(ms.into());
        let mut span = |from, until, on, off| {
            acts.push((from, on));
            acts.push((until, off));
        };
        match self.kind {
            Kind::Cut(wire) => span(
                from,
                until,
                Act::Cut(wire, s, true),
                Act::Cut(wire, s, false),
            ),
            Kind::Flap(wire, period) => flap(wire, s, [from, until, ms(period)], acts),
            Kind::LevelLow => span(from, until, Act::LevelLow(s, true), Act::LevelLow(s, false)),
            Kind::LevelGlitch(us) => {
                let until = from + Duration::from_us(us.into());
                span(from, until, Act::LevelLow(s, true), Act::LevelLow(s, false));
            }
            Kind::StrayBeats(edges) => {
                for _ in 0..edges {
                    let edge = |line| (from, Act::Edge(s.peer(), line, Edge::Rising));
                    acts.extend([Line::Heartbeat1, Line::Heartbeat2].map(edge));
                }
            }
            Kind::StraySync => acts.push((from, Act::Edge(s.peer(), Line::Start, Edge::Falling))),
            Kind::Mute => span(from, until, Act::LostOut(s, 1000), Act::LostOut(s, 0)),
            Kind::Deaf => span(from, until, Act::LostIn(s, 1000), Act::LostIn(s, 0)),
            Kind::LosesSent(percent) => {
                let on = Act::LostOut(s, u16::from(percent) * 10);
                span(from, until, on, Act::LostOut(s, 0));
            }
            Kind::LosesHeard(percent) => {
                let on = Act::LostIn(s, u16::from(percent) * 10);
                span(from, until, on, Act::LostIn(s, 0));
            }
            Kind::Late(late) => span(from, until, Act::Late(s, late), Act::Late(s, 0)),
            Kind::PowerLoss => span(from, until, Act::Power(s, false), Act::Power(s, true)),
            Kind::BrownOut(off) => {
                span(
                    from,
                    from + ms(off),
                    Act::Power(s, false),
                    Act::Power(s, true),
                );
            }
            Kind::Reset(cause) => acts.push((from, Act::Reset(s, cause))),
            Kind::Hang(span) => acts.push((from, Act::Freeze(s, span))),
            Kind::CoreDies(core) => acts.push((from, Act::Kill(s, core))),
            Kind::CoreHangs(core) => span(
                from,
                until,
                Act::FreezeCore(s, core, true),
                Act::FreezeCore(s, core, false),
            ),
            Kind::SupplyHangs(span_ms) => {
                let until = from + ms(span_ms);
                span(
                    from,
                    until,
                    Act::FreezeSupply(s, true),
                    Act::FreezeSupply(s, false),
                );
            }
            Kind::VehicleHangs(span_ms) => {
                let until = from + ms(span_ms);
                span(
                    from,
                    until,
                    Act::FreezeVehicle(true),
                    Act::FreezeVehicle(false),
                );
            }
            Kind::LauncherHangs(span) => acts.push((from, Act::FreezeLauncher(span))),
            Kind::Scribble => acts.push((from, Act::Scribble(s))),
            Kind::Slow(gap) => span(from, until, Act::Rest(s, gap), Act::Rest(s, 0)),
            Kind::Clock(rate) => span(from, until, Act::Clock(s, rate), Act::Clock(s, 0)),
            Kind::ClockJumps(by) => acts.push((from, Act::ClockJumps(s, by))),
            Kind::WrongResults => {
                span(
                    from,
                    until,
                    Act::WrongResults(s, true),
                    Act::WrongResults(s, false),
                );
            }
            Kind::FlashHangs => {
                span(
                    from,
                    until,
                    Act::FlashHangs(s, true),
                    Act::FlashHangs(s, false),
                );
            }
            Kind::FlashLost => {
                span(
                    from,
                    from + ms(20),
                    Act::Power(s, false),
                    Act::Power(s, true),
                );
                acts.push((from + ms(1), Act::FlashLost(s)));
            }
            Kind::Poison => span(from, until, Act::Poison(true), Act::Poison(false)),
            Kind::VehicleSilent => {
                span(
                    from,
                    until,
                    Act::VehicleSilent(true),
                    Act::VehicleSilent(false),
                );
            }
        }
    }
}

/// A loose contact: an edge line sees an edge each time that contact is made or lost, a level line
/// falls, anything else is cut in between.
fn flap(
    wire: Wire,
    from: SystemId,
    [begin, until, half]: [Duration; 3],
    acts: &mut Vec<(Duration, Act)>,
) {
    let mut at = begin;
    while at < until {
        let back = (at + half).min(until);
        match wire {
            Wire::Level => {
                acts.push((at, Act::LevelLow(from, true)));
                acts.push((back, Act::LevelLow(from, false)));
            }
            Wire::Line(line) => {
                acts.push((at, Act::Cut(wire, from, true)));
                acts.push((at, Act::Edge(from.peer(), line, Edge::Falling)));
                acts.push((back, Act::Cut(wire, from, false)));
                acts.push((back, Act::Edge(from.peer(), line, Edge::Rising)));
            }
            Wire::Link | Wire::Can => {
                acts.push((at, Act::Cut(wire, from, true)));
                acts.push((back, Act::Cut(wire, from, false)));
            }
        }
        at = back + half;
    }
}
