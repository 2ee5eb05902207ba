//! A sequence of faults, and the longest gap that it may cause.

use crate::entry::{Fault, Way};
use crate::kind::{Kind, Scope};
use crate::loss::Loss;
use crate::setting::DriveSetting;
use std::fmt;
use tandem_board::{Duration, SystemId};
use tandem_peripherals::network::Wire;
use tandem_record::verdict::Limits;

/// The kind of a sequence.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Group {
    /// One fault at one of [`PHASES`](crate::PHASES) moments of the control cycle.
    Single,
    /// Two faults within one system. One of [`DISTANCES`](crate::DISTANCES) separates them.
    Pair,
    /// Several faults in both systems, drawn with the number as the seed.
    Random,
    /// Like [`Group::Random`], but the number also selects which kinds occur, so that some
    /// sequences have many faults of few kinds.
    Swarm,
    /// One wrong value, deafness or forgery, in one [`DriveSetting`].
    Values,
    /// The faults of a file, or of [`Site::drawn`] or [`Site::cell`].
    File,
}

/// One sequence of faults.
#[derive(Clone, Debug)]
pub struct Sequence {
    /// The group of the sequence.
    pub group: Group,
    /// The number of the sequence in its group.
    pub number: u64,
    /// The faults.
    pub faults: Vec<Fault>,
    /// Whether the faults begin at power-on. Otherwise they begin in dual operation while A drives.
    pub from_power_on: bool,
    /// The time from the start of the faults until everything is restored.
    pub span: Duration,
    /// Where the faults begin; `None`: in the first second, on the road of the campaign.
    pub setting: Option<DriveSetting>,
}

impl Fault {
    /// Returns how this fault makes the vehicle lose its master while A drives and B is standby.
    #[must_use]
    pub fn loss(&self) -> Loss {
        let facts = self.kind.facts();
        match self.kind {
            Kind::Hang(amount) if self.way == Way::Both => Loss::Stall(amount.ms()),
            _ if facts.scope == Scope::Shared || self.way != Way::B => facts.loss,
            _ => Loss::None,
        }
    }

    /// Returns whether the frames of the driving system are unaffected. If so, the system must keep
    /// its role. Returns false for a stalled bus, because it delivers frames too late: the vehicle
    /// refuses them, and their sender may lose its role.
    #[must_use]
    pub fn spares_the_master(&self) -> bool {
        let is_bus = matches!(self.kind, Kind::VehicleHangs(_));
        matches!(self.loss(), Loss::None | Loss::Stall(_)) && !is_bus
    }
}

impl Sequence {
    /// Returns whether [`Fault::spares_the_master`] holds for all faults.
    #[must_use]
    pub fn spares_the_master(&self) -> bool {
        self.faults.iter().all(Fault::spares_the_master)
    }

    /// Returns the longest gap that the faults may cause, and the loss from which this bound
    /// follows. Returns `None` if the sequence has no bound.
    #[must_use]
    pub fn bound(&self, limits: &Limits) -> Option<(Loss, Duration)> {
        let of_one = |fault: &Fault| {
            let loss = fault.loss();
            Some((loss, loss.bound(limits)))
        };
        let is_silent = |fault: &Fault| fault.kind == Kind::VehicleSilent;
        match (self.group, &self.faults[..]) {
            (Group::Random | Group::Swarm | Group::Values, _) => None,
            (Group::Pair, _) => self.bound_within_a_system(limits),
            (Group::File, _) if self.from_power_on => None,
            (_, faults) if faults.iter().any(is_silent) => None,
            (Group::Single, [one]) => of_one(one),
            (Group::File, [one]) if one.has_loss() => of_one(one),
            _ if self.is_within_a_system() => self.bound_within_a_system(limits),
            _ => None,
        }
    }

    /// Returns until when the other system is sound, counted from the start of the faults, and the
    /// longest gap until then: until a fault hits the second system, all are within one. `None` if
    /// no gap is judged.
    #[must_use]
    pub fn bound_while_one_is_sound(&self, limits: &Limits) -> Option<(Duration, Duration)> {
        if self.from_power_on || !matches!(self.group, Group::Random | Group::Swarm) {
            return None;
        }
        let mut faults = self.faults.clone();
        faults.sort_by_key(|fault| fault.at);
        let is_judged = |count: usize| {
            let within = Self {
                faults: faults.iter().take(count).copied().collect(),
                ..self.clone()
            };
            let silent = within
                .faults
                .iter()
                .any(|it| it.kind == Kind::VehicleSilent);
            let bound = within.bound_within_a_system(limits);
            bound.filter(|_| within.is_within_a_system() && !silent)
        };
        let count = (1..=faults.len())
            .rev()
            .find(|count| is_judged(*count).is_some())?;
        let (_, bound) = is_judged(count)?;
        let until = faults.get(count).map_or(self.span, |next| next.at);
        Some((until, bound))
    }

    /// Returns whether all faults are within one system.
    fn is_within_a_system(&self) -> bool {
        let within = |way: Way| {
            self.faults.iter().all(|it| {
                let is_of_wire = it.kind.facts().scope == Scope::Wire;
                it.kind != Kind::Poison && (is_of_wire || it.way == way)
            })
        };
        within(Way::A) || within(Way::B)
    }

    /// Returns the bound of faults that are all within one system.
    fn bound_within_a_system(&self, limits: &Limits) -> Option<(Loss, Duration)> {
        let losses = self.faults.iter().map(|fault| match fault.kind {
            Kind::Clock(amount) if amount.get() < -1 => Loss::of_refused_clock(amount.get()),
            _ => Loss::Mute,
        });
        let bounds = losses.map(|loss| (loss, loss.bound(limits).max(limits.longest())));
        bounds.max_by_key(|(_, bound)| *bound)
    }

    /// Returns the faults in words, without their times.
    #[must_use]
    pub fn kinds(&self) -> String {
        let kind = |fault: &Fault| format!("{:?} {}", fault.way, fault.kind);
        let kinds: Vec<String> = self.faults.iter().map(kind).collect();
        kinds.join(" + ")
    }

    /// Returns whether frames of both systems are lost on CAN, late, or contain a wrong command.
    #[must_use]
    pub fn spoils_frames_of_both(&self) -> bool {
        let spoils = |fault: &Fault| match fault.kind {
            Kind::LosesSent(_) | Kind::Mute | Kind::WrongResults => true,
            // The vehicle refuses frames whose time is wrong.
            Kind::Clock(_) | Kind::ClockJumps(_) => true,
            Kind::Cut { wire } | Kind::Flap { wire, .. } => wire == Wire::Can,
            _ => false,
        };
        let of = |of: SystemId| {
            let mut faults = self.faults.iter();
            faults.any(|fault| spoils(fault) && fault.way == Way::from(of))
        };
        of(SystemId::A) && of(SystemId::B)
    }
}

impl Fault {
    /// Returns whether the kind alone determines the loss. For a fault of both systems this holds
    /// only if the fault affects a wire or a shared part, or stops both systems.
    fn has_loss(&self) -> bool {
        let stands_still = matches!(self.kind, Kind::Hang(_));
        self.way != Way::Both || self.kind.facts().scope != Scope::System || stands_still
    }
}

impl fmt::Display for Sequence {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let faults: Vec<String> = self.faults.iter().map(Fault::to_string).collect();
        let from = if self.from_power_on {
            " from power-on"
        } else {
            ""
        };
        let (group, number, faults) = (self.group, self.number, faults.join("; "));
        let span = self.span.as_ms_f64();
        write!(
            f,
            "{group:?} {number}{from}: {faults}; restored at {span:.1} ms"
        )
    }
}
