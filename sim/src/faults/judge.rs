//! The limits under each fault, and the state that must hold in the end.

use super::bench::{Bench, State};
use super::fault::{Fault, Kind, Way};
use crate::drive::{FLASH_SECTOR_BYTES, newest_record};
use std::fmt;
use tandem_board::{CoreId, Duration, Instant, RoleLamp, SystemId};
use tandem_board_sim::{Power, Wire};
use tandem_redundancy::{Config, Loaded, SystemState};
use tandem_vehicle::gate::Acceptance;

/// A row of the table of bounds: how the vehicle loses its master.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Row {
    /// It does not: the fault leaves the master's frames as they are.
    None,
    /// Both systems stand still for this time.
    Stall(Duration),
    /// The power level falls.
    Power,
    /// The master falls silent, and its level line stays high.
    Silence,
    /// The master lives, and its frames do not arrive.
    Mute,
    /// Its clock is wrong: the longest control period of a system by its own clock.
    Clock(Duration),
    /// The same, and without the link it cannot find out itself. The gate refuses its frames as
    /// late; after two of them it falls silent, and then it is as good as mute.
    Refused(Duration),
}

impl Row {
    /// The longest time between two control frames that act.
    #[must_use]
    pub fn bound(self, config: &Config) -> Duration {
        match self {
            // A cycle begins at a poll.
            Self::None => config.control_period + config.poll_interval,
            // It hears the echo, polls, and sends.
            Self::Stall(span) => config.control_period + span + config.poll_interval.times(3),
            Self::Power => config.gap_bound_power(),
            Self::Silence => config.gap_bound(),
            Self::Mute => config.gap_bound_mute(),
            Self::Refused(period) => period.times(2) + config.gap_bound_mute(),
            Self::Clock(period) => (period + config.poll_interval).max(config.gap_bound()),
        }
    }

    /// The row of a clock that is wrong by this many parts in a thousand: until that is found, its
    /// system's control period is as wrong.
    #[must_use]
    pub fn of_clock(permille: i16) -> Self {
        Self::Clock(Self::period_of(permille))
    }

    pub(super) fn of_refused_clock(permille: i16) -> Self {
        Self::Refused(Self::period_of(permille))
    }

    fn period_of(permille: i16) -> Duration {
        let period_us = 10_000_000 / (1_000 + i64::from(permille.min(0)));
        Duration::from_us(period_us as u64)
    }
}

/// The row of a fault while A drives and B stands by.
#[must_use]
pub fn row(fault: &Fault) -> Row {
    if let (Kind::Hang(ms), Way::Both) = (fault.kind, fault.way) {
        return Row::Stall(Duration::from_ms(ms.into()));
    }
    let of_master = fault.way.systems().any(|system| system == SystemId::A);
    match fault.kind {
        // Nothing of them reaches the bus, whichever system drives.
        Kind::VehicleHangs(ms) => Row::Stall(Duration::from_ms(ms.into())),
        _ if !of_master && !matches!(fault.kind, Kind::Poison) => Row::None,
        Kind::PowerLoss
        | Kind::BrownOut(_)
        | Kind::Reset(_)
        | Kind::FlashLost
        | Kind::Poison
        // Core 0 notices, and resets its system.
        | Kind::CoreDies(CoreId::PERCEPTION | CoreId::PLANNING)
        | Kind::CoreHangs(CoreId::PERCEPTION | CoreId::PLANNING) => Row::Power,
        // Until the watchdog resets it, the level is high.
        Kind::CoreDies(_)
        | Kind::CoreHangs(_)
        | Kind::Hang(_)
        | Kind::Slow(_)
        // Its timers stand still, or it was held up by its own clock.
        | Kind::ClockJumps(_)
        | Kind::Scribble => Row::Silence,
        Kind::Clock(permille) => Row::of_clock(permille),
        // It reads back what the vehicle obeys, and sends nothing any more.
        Kind::WrongResults
        | Kind::Mute
        | Kind::LosesSent(_)
        | Kind::Late(_)
        | Kind::Cut(Wire::Can)
        | Kind::Flap(Wire::Can, _) => Row::Mute,
        // Its frames continue; if it is suspended, its level falls.
        Kind::Deaf | Kind::LosesHeard(_) => Row::Power,
        _ => Row::None,
    }
}

/// A violation.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Violation {
    /// The vehicle was without control for longer than the bound.
    Gap,
    /// In the end the vehicle obeys no system, though one could drive.
    NoneObeyed,
    /// The same, and both systems have suspended themselves.
    BothSuspended,
    /// In the end the vehicle obeys a system that does not believe to be master.
    ObeysNoMaster,
    /// In the end both believe to be master.
    TwoMasters,
    /// In the end control frames come too late, or the driver changes, or a system drives into the
    /// fence.
    Unsteady,
    /// A control frame of an old term acted, or one term belongs to both.
    OldTerm,
    /// The driver changed more often than the faults explain.
    Changes,
    /// The driver changed, though one fault alone left the master sound.
    Needless,
    /// A record that no fault destroyed is gone.
    StateLost,
    /// The flash was programmed more often than the faults explain.
    FlashWorn,
    /// A core panicked, or the cores wake each other for ever.
    Panic,
    /// The vehicle caused a collision.
    Collision,
    /// A side of the vehicle crossed the line of its lane.
    LeftLane,
    /// The vehicle came too close to the one in front.
    TooClose,
    /// In the end no system stands by, though none has suspended itself.
    NoStandby,
    /// In the end the vehicle is stopped by a system with a fault, though the other one had none.
    Stopped,
    /// A system that is no master has sent a control frame.
    Chatters,
}

/// The outcome of one sequence.
#[derive(Clone, Debug, Default)]
pub struct Verdict {
    /// The longest time without control, from the first fault until all is mended.
    pub gap: Duration,
    /// How often the driver changed.
    pub changes: usize,
    /// Systems that suspended themselves.
    pub suspended: usize,
    /// Virtual time of the whole run, with its start and the time to settle.
    pub simulated: Duration,
    /// Every frame on the bus and every event of a system, as one number.
    pub digest: u64,
    /// The states that the faults hit.
    pub covered: Vec<(Kind, State)>,
    /// The violations.
    pub violations: Vec<Violation>,
}

impl Violation {
    /// All.
    pub const ALL: [Self; 18] = [
        Self::Gap,
        Self::NoneObeyed,
        Self::BothSuspended,
        Self::ObeysNoMaster,
        Self::TwoMasters,
        Self::Unsteady,
        Self::OldTerm,
        Self::Changes,
        Self::Needless,
        Self::StateLost,
        Self::FlashWorn,
        Self::Panic,
        Self::Collision,
        Self::LeftLane,
        Self::TooClose,
        Self::NoStandby,
        Self::Stopped,
        Self::Chatters,
    ];
}

impl fmt::Display for Verdict {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self {
            gap,
            changes,
            suspended,
            violations,
            ..
        } = self;
        let gap = gap.as_ms_f64();
        write!(
            f,
            "gap {gap:.1} ms, {changes} changes of driver, {suspended} suspended, {violations:?}"
        )
    }
}

/// Changes of the driver that one fault explains: away, and back when its consequence shows.
const CHANGES_OF_A_FAULT: usize = 2;
/// Programs of the flash that one fault explains, in each system.
const PROGRAMS_OF_A_FAULT: usize = 12;

/// The vehicle must be at least this long behind the place of the one in front, s: the time gap
/// that planning asks for at more than 60 km/h.
const LEAST_HEADWAY_S: f64 = 1.6;
/// At this distance from the centre of its lane a side of the vehicle reaches the line, m.
const AT_THE_LINE_M: f64 = 0.85;

impl Bench {
    /// How long after everything was mended a system must drive: longer than a start of both.
    #[must_use]
    pub fn settles_within(&self) -> Duration {
        let limits = &self.config.redundancy;
        self.config.boot_limit
            + limits.start_limit
            + limits.stagger.times(4)
            + limits.no_master_limit(SystemId::B)
            + Duration::from_ms(300)
    }

    /// Judges a run whose faults began at `begin` and were mended at `mended`. `bound`: the longest
    /// permitted gap in between.
    #[must_use]
    pub fn judge(
        &self,
        faults: &[Fault],
        [begin, mended]: [Instant; 2],
        bound: Option<Duration>,
    ) -> Verdict {
        let mut violations = Vec::new();
        let vehicle = self.vehicle.borrow();
        let gap = longest_gap(&vehicle.accepted, begin, mended);
        let mut check = |broken: bool, violation| {
            if broken {
                violations.push(violation);
            }
        };
        check(bound.is_some_and(|bound| gap > bound), Violation::Gap);
        let old_term = |pair: &[Acceptance]| {
            let same = pair[0].term == pair[1].term;
            pair[1].term < pair[0].term || (same && pair[0].system != pair[1].system)
        };
        check(
            vehicle.accepted.windows(2).any(old_term),
            Violation::OldTerm,
        );
        check(vehicle.chatters, Violation::Chatters);
        let changed = |pair: &&[Acceptance]| pair[0].system != pair[1].system;
        let changes = vehicle.accepted.windows(2).filter(changed).count();
        check(
            changes > CHANGES_OF_A_FAULT * faults.len() + 1,
            Violation::Changes,
        );
        let needless =
            matches!(faults, [one] if matches!(row(one), Row::None | Row::Stall(_))) && changes > 0;
        check(needless, Violation::Needless);
        for system in SystemId::ALL {
            let destroyed = faults.iter().any(|fault| {
                fault.kind == Kind::FlashLost && fault.way.systems().any(|of| of == system)
            });
            let (loaded, programs) = self.record_of(system);
            let lost = !matches!(loaded, Loaded::State(_));
            let worn = programs > PROGRAMS_OF_A_FAULT * (faults.len() + 1);
            check(!destroyed && lost, Violation::StateLost);
            check(!destroyed && worn, Violation::FlashWorn);
        }
        if let Some(world) = vehicle.world() {
            let drive = world.metrics();
            check(drive.collisions_by_ego > 0, Violation::Collision);
            let left = drive.excursion_max_m > 0.0 || drive.lateral_error_max_m > AT_THE_LINE_M;
            check(left, Violation::LeftLane);
            check(vehicle.headway_s < LEAST_HEADWAY_S, Violation::TooClose);
        }
        drop(vehicle);
        violations.extend(self.judge_end());
        Verdict {
            gap,
            changes,
            suspended: self.suspended(),
            simulated: self.pair.now().since(self.born),
            digest: self.pair.digest(),
            covered: self.covered.clone(),
            violations,
        }
    }

    pub(super) fn suspended(&self) -> usize {
        let suspended = |system: &SystemId| self.pair.power(*system) == Power::Suspended;
        SystemId::ALL.into_iter().filter(suspended).count()
    }

    /// Whether a system drives now that all is mended, and has for the last time.
    fn judge_end(&self) -> Option<Violation> {
        let limits = &self.config.redundancy;
        let now = self.pair.now();
        let from = Instant::from_ns(now.as_ns().saturating_sub(STEADY.as_ns()));
        let believes = SystemId::ALL.map(|system| {
            let lamp = self.pair.lamp(system);
            matches!(lamp, Some(RoleLamp::Master | RoleLamp::DegradedMaster))
        });
        let vehicle = self.vehicle.borrow();
        let last = vehicle.accepted.last();
        let obeyed = last.filter(|last| {
            now.as_ns().saturating_sub(last.at_ns) <= limits.control_period.times(2).as_ns()
        });
        let Some(obeyed) = obeyed else {
            return Some(match self.suspended() {
                2 => Violation::BothSuspended,
                _ => Violation::NoneObeyed,
            });
        };
        let longest = Row::None.bound(limits) + self.time.allowance();
        let late = longest_gap(&vehicle.accepted, from, now) > longest;
        let since = vehicle
            .accepted
            .iter()
            .rev()
            .take_while(|frame| frame.at_ns >= from.as_ns());
        // One handover is no violation: a system with a fault gives way when the hold-down is over.
        let frames: Vec<&Acceptance> = since.collect();
        let changed = frames.chunk_by(|a, b| a.system == b.system).count() > 2;
        let fenced = vehicle
            .fenced
            .last()
            .is_some_and(|frame| frame.at_ns >= from.as_ns());
        match believes {
            _ if !believes[usize::from(obeyed.system)] => Some(Violation::ObeysNoMaster),
            [true, true] => Some(Violation::TwoMasters),
            _ if late || changed || fenced => Some(Violation::Unsteady),
            _ => None,
        }
    }

    /// The newest record in the flash of a system, and how many it has space used by.
    fn record_of(&self, system: SystemId) -> (Loaded, usize) {
        let bytes = self.pair.flash(system);
        let loaded = newest_record(&bytes);
        let slots = bytes[..2 * FLASH_SECTOR_BYTES as usize].chunks(SystemState::BYTES);
        let used = slots.filter(|slot| slot.iter().any(|byte| *byte != 0xFF));
        (loaded, used.count())
    }
}

/// For this long at the end a system must have driven without a pause.
const STEADY: Duration = Duration::from_ms(200);

/// The longest time without a control frame that acted, within these times.
fn longest_gap(accepted: &[Acceptance], from: Instant, until: Instant) -> Duration {
    let (from_ns, until_ns) = (from.as_ns(), until.as_ns());
    let before = accepted.iter().rev().find(|frame| frame.at_ns <= from_ns);
    let mut last = before.map_or(from_ns, |frame| frame.at_ns);
    let mut longest = 0;
    for frame in accepted {
        if frame.at_ns > from_ns && frame.at_ns <= until_ns {
            longest = longest.max(frame.at_ns - last);
            last = frame.at_ns;
        }
    }
    Duration::from_ns(longest.max(until_ns.saturating_sub(last)))
}

/// The longest gap of faults within one system, whatever they are.
#[must_use]
pub fn containment_bound(config: &Config) -> Duration {
    Row::Mute.bound(config).max(Row::Silence.bound(config))
}
