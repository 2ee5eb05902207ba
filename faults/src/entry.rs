//! One fault, the changes of a board that it causes, and the boards that can suffer it.

use crate::kind::{Ends, Kind, Scope};
use crate::site::Site;
use crate::words::{ms, ms_or_none};
use serde::{Deserialize, Serialize};
use std::fmt;
use tandem_board::{Duration, Edge, Line, SystemId};
use tandem_peripherals::network::{BusFault, Wire};

/// The direction in which a wire fails, or the system in which a fault occurs.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Way {
    /// The direction from A, or A itself.
    A,
    /// The direction from B, or B itself.
    B,
    /// Both directions, or both systems.
    Both,
}

impl From<SystemId> for Way {
    fn from(system: SystemId) -> Self {
        match system {
            SystemId::A => Self::A,
            SystemId::B => Self::B,
        }
    }
}

impl Way {
    /// Returns this one system, or both systems.
    pub fn systems(self) -> impl Iterator<Item = SystemId> {
        let of = move |system: &SystemId| self == Self::Both || self == Self::from(*system);
        SystemId::ALL.into_iter().filter(of)
    }
}

/// One fault: what fails, when it fails, and for how long. It is one entry of a fault file.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub struct Fault {
    /// What fails.
    #[serde(flatten)]
    pub kind: Kind,
    /// The system or the direction that fails.
    #[serde(rename = "of")]
    pub way: Way,
    /// When it begins, counted from the start of the faults.
    #[serde(rename = "at-ms", with = "ms")]
    pub at: Duration,
    /// How long it lasts, unless the kind determines this. `None`: until everything is restored.
    #[serde(rename = "lasts-ms", with = "ms_or_none")]
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub lasts: Option<Duration>,
}

impl fmt::Display for Fault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (at, way, kind) = (self.at.as_ms_f64(), self.way, self.kind);
        write!(f, "{at:.1} ms {way:?} {kind}")?;
        self.lasts.map_or(Ok(()), |lasts| {
            write!(f, " for {:.1} ms", lasts.as_ms_f64())
        })
    }
}

/// One change of a board.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Effect {
    /// A fault of this system begins (`true`) or ends. Composite kinds such as `Flap` do not occur.
    Fault(Kind, SystemId, bool),
    /// An edge of this system's line arrives at its peer. The system has not sent it.
    Edge(SystemId, Line, Edge),
}

/// The error of a board that cannot suffer a fault.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct CannotSuffer {
    /// The kind of fault.
    pub kind: Kind,
    /// The board.
    pub site: Site,
}

impl fmt::Display for CannotSuffer {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (what, site) = (self.kind.label(), self.site);
        write!(
            f,
            "{what}: {site} cannot suffer it; docs/faults.md says what can"
        )
    }
}

impl std::error::Error for CannotSuffer {}

/// A board on which faults can be injected.
pub trait Suffer {
    /// The reason why a change was not made: [`CannotSuffer`], or an error of the board.
    type Error: From<CannotSuffer>;

    /// Makes this change now.
    ///
    /// # Errors
    /// [`CannotSuffer`] if [`Kind::is_for`] is false for this board; or the board's error.
    fn apply(&mut self, change: Effect) -> Result<(), Self::Error>;

    /// Ends every fault, and switches on each system that has no power.
    fn restore(&mut self);
}

/// The current faults of the CAN connections of A and B.
#[derive(Clone, Copy, Debug, Default)]
pub struct BusFaults([BusFault; 2]);

impl BusFaults {
    /// Applies a change. Returns the new faults of this system's connection; `None` if the kind
    /// is not a fault of a CAN connection.
    pub fn follow(&mut self, kind: Kind, of: SystemId, on: bool) -> Option<BusFault> {
        let fault = &mut self.0[of.index()];
        let permille = |percent: i32| if on { percent as u16 * 10 } else { 0 };
        match kind {
            Kind::Mute => fault.lost_out = permille(100),
            Kind::Deaf => fault.lost_in = permille(100),
            Kind::LosesSent(amount) => fault.lost_out = permille(amount.get()),
            Kind::LosesHeard(amount) => fault.lost_in = permille(amount.get()),
            Kind::Late(amount) => {
                fault.late = if on { amount.ms() } else { Duration::ZERO };
            }
            Kind::DeafTo(to) => {
                let id = on.then_some(to.frame.info().id);
                fault.deaf_to[usize::from(to.core)] = id;
            }
            _ => return None,
        }
        Some(*fault)
    }
}

/// Returns the changes that these faults cause, in order, each with its time since the faults
/// began. At `end` everything is restored. `driver` is the system that the faults call A.
#[must_use]
pub fn effects(faults: &[Fault], end: Duration, driver: SystemId) -> Vec<(Duration, Effect)> {
    let mut changes = Vec::new();
    for fault in faults {
        // A fault of a shared part is applied only once.
        let times = if fault.kind.facts().scope == Scope::Shared {
            1
        } else {
            2
        };
        for system in fault.way.systems().take(times) {
            let real = match driver {
                SystemId::A => system,
                SystemId::B => system.peer(),
            };
            fault.changes_of(real, end, &mut changes);
        }
    }
    changes.sort_by_key(|(at, _)| *at);
    changes
}

impl Fault {
    fn changes_of(&self, of: SystemId, end: Duration, changes: &mut Vec<(Duration, Effect)>) {
        let from = self.at;
        let until = match self.kind.facts().ends {
            Ends::AsGiven => Some(self.lasts.map_or(end, |lasts| (from + lasts).min(end))),
            Ends::After(span) => Some(from + span),
            Ends::AtOnce => None,
        };
        let mut span = |kind| {
            changes.push((from, Effect::Fault(kind, of, true)));
            changes.extend(until.map(|until| (until, Effect::Fault(kind, of, false))));
        };
        match self.kind {
            Kind::LevelGlitch(_) => span(Kind::LevelLow),
            Kind::BrownOut(_) => span(Kind::PowerLoss),
            Kind::FlashLost => {
                span(Kind::PowerLoss);
                let lost = from + Duration::from_ms(1);
                changes.push((lost, Effect::Fault(Kind::FlashLost, of, true)));
            }
            Kind::StrayBeats(amount) => {
                for _ in 0..amount.get() {
                    let edge = |line| (from, Effect::Edge(of, line, Edge::Rising));
                    changes.extend([Line::Heartbeat1, Line::Heartbeat2].map(edge));
                }
            }
            Kind::StraySync => changes.push((from, Effect::Edge(of, Line::Start, Edge::Falling))),
            Kind::Flap { wire, amount } => {
                let until = until.unwrap_or(end);
                flap(wire, of, [from, until, amount.ms()], changes);
            }
            kind => span(kind),
        }
    }
}

/// Adds the changes of a loose contact. While it is open, the level line is low and any other wire
/// is cut. An edge line also has an edge each time the contact opens or closes.
fn flap(
    wire: Wire,
    of: SystemId,
    [begin, until, half]: [Duration; 3],
    changes: &mut Vec<(Duration, Effect)>,
) {
    let kind = match wire {
        Wire::Level => Kind::LevelLow,
        _ => Kind::Cut { wire },
    };
    let mut at = begin;
    while at < until {
        let back = (at + half).min(until);
        for (at, on, edge) in [(at, true, Edge::Falling), (back, false, Edge::Rising)] {
            changes.push((at, Effect::Fault(kind, of, on)));
            if let Wire::Line(line) = wire {
                changes.push((at, Effect::Edge(of, line, edge)));
            }
        }
        at = back + half;
    }
}
