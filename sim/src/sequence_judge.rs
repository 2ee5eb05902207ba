//! The judge of a simulated sequence: the rules of every campaign, and rules for which only the
//! simulator has evidence.

use crate::bench::{Bench, SequenceState};
use crate::drive::{FLASH_SECTOR_BYTES, newest_record};
use std::fmt;
use tandem_board::{Duration, Instant, RoleLamp, SystemId};
use tandem_cores::trace::Event;
use tandem_faults::{Fault, Kind, Loss, Observed};
use tandem_record::verdict::required_limits::CONTROL_PERIOD;
use tandem_record::verdict::{HEADWAY_MIN_S, LATERAL_ERROR_MAX_M, Rule};
use tandem_redundancy::{Loaded, SystemState};
use tandem_vehicle::World;
use tandem_vehicle::gate::Acceptance;

/// The first finding after the fault.
#[derive(Clone, Copy, Debug)]
pub struct Found {
    /// The system that tells it.
    pub by: SystemId,
    /// Time since the fault.
    pub after: Duration,
    /// The event.
    pub event: Event,
}

/// The outcome of one sequence.
#[derive(Clone, Debug, Default)]
pub struct Tried {
    /// The longest gap from the first fault until everything was restored.
    pub gap: Duration,
    /// How many times the driving system changed.
    pub changes: usize,
    /// Number of systems that suspended themselves.
    pub suspended: usize,
    /// Virtual time of the whole run, including the start and the time to settle.
    pub simulated: Duration,
    /// A digest of every frame on the bus and every event of a system.
    pub digest: u64,
    /// Each kind of fault that was applied, with the state of the system that it hit.
    pub covered: Vec<(Kind, SequenceState)>,
    /// The rules that were broken.
    pub violations: Vec<Rule>,
    /// Of wrong values: the first finding.
    pub found: Option<Found>,
    /// With a vehicle: the largest offset from the lane outside lane changes, m.
    pub aside_m: Option<f64>,
}

impl fmt::Display for Tried {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (gap, changes, suspended) = (self.gap.as_ms_f64(), self.changes, self.suspended);
        let violations = &self.violations;
        write!(
            f,
            "gap {gap:.1} ms, {changes} changes of driver, {suspended} suspended, {violations:?}"
        )?;
        if let Some(found) = self.found {
            let (after, by) = (found.after.as_ms_f64(), found.by);
            write!(f, ", found by {by} after {after:.0} ms: {:?}", found.event)?;
        }
        self.aside_m
            .map_or(Ok(()), |m| write!(f, ", {m:.2} m aside"))
    }
}

/// The largest plausible number of writes to the flash of one system for one fault.
const PROGRAMS_OF_A_FAULT: usize = 12;

impl Bench {
    /// Judges a run whose faults began at `begin`. Everything was restored at `restored`. `bound`:
    /// the longest permitted gap between these times.
    #[must_use]
    pub fn judge(
        &self,
        faults: &[Fault],
        [begin, restored]: [Instant; 2],
        bound: Option<Duration>,
    ) -> Tried {
        let vehicle = self.vehicle.borrow();
        let gap = longest_gap(&vehicle.accepted, begin, restored);
        let changed = |pair: &&[Acceptance]| pair[0].system != pair[1].system;
        let changes = vehicle.accepted.windows(2).filter(changed).count();
        let drive = vehicle.world().map(World::metrics);
        let observed = Observed {
            faults,
            acted: &vehicle.accepted,
            changes,
            collisions: drive
                .as_ref()
                .map_or(0, |drive| drive.collisions_by_ego as usize),
        };
        let is_too_long = bound.is_some_and(|bound| gap > bound);
        let mut violations: Vec<Rule> = is_too_long.then_some(Rule::Gap).into_iter().collect();
        violations.extend(observed.findings().into_iter().map(|finding| finding.rule));
        let mut check = |broken: bool, rule| violations.extend(broken.then_some(rule));
        check(vehicle.chatters, Rule::Chatters);
        for system in SystemId::ALL {
            let destroyed = faults.iter().any(|fault| {
                fault.kind == Kind::FlashLost && fault.way.systems().any(|of| of == system)
            });
            let (loaded, programs) = self.record_of(system);
            let lost = !matches!(loaded, Loaded::State(_));
            let worn = programs > PROGRAMS_OF_A_FAULT * (faults.len() + 1);
            check(!destroyed && lost, Rule::StateLost);
            check(!destroyed && worn, Rule::FlashWorn);
        }
        let aside_m = drive.as_ref().map(|drive| drive.lateral_error_max_m);
        if let Some(drive) = drive {
            check(drive.excursion_max_m > 0.0, Rule::LeftLane);
            let beside_m = drive.lateral_error_max_m;
            check(beside_m > LATERAL_ERROR_MAX_M, Rule::LateralError);
            check(vehicle.headway_s < HEADWAY_MIN_S, Rule::TooClose);
        }
        drop(vehicle);
        violations.extend(self.judge_end());
        Tried {
            gap,
            changes,
            suspended: self.suspended(),
            simulated: self.pair.now().since(self.born),
            digest: self.pair.digest(),
            covered: self.covered.clone(),
            violations,
            found: None,
            aside_m,
        }
    }

    /// Returns the rule that is violated at the end of the run, long after everything was restored.
    fn judge_end(&self) -> Option<Rule> {
        let now = self.pair.now();
        let from = Instant::from_ns(now.as_ns().saturating_sub(STEADY.as_ns()));
        let believes = SystemId::ALL.map(|system| {
            let lamp = self.pair.lamp(system);
            matches!(lamp, Some(RoleLamp::Master | RoleLamp::DegradedMaster))
        });
        let vehicle = self.vehicle.borrow();
        let last = vehicle.accepted.last();
        let obeyed = last.filter(|last| {
            now.as_ns().saturating_sub(last.at_ns) <= CONTROL_PERIOD.times(2).as_ns()
        });
        let Some(obeyed) = obeyed else {
            return Some(match self.suspended() {
                2 => Rule::BothSuspended,
                _ => Rule::NoneObeyed,
            });
        };
        let longest = Loss::None.bound(&self.profile.bounds()) + self.profile.time.allowance();
        let late = longest_gap(&vehicle.accepted, from, now) > longest;
        let since = vehicle
            .accepted
            .iter()
            .rev()
            .take_while(|frame| frame.at_ns >= from.as_ns());
        // One handover is permitted: a system with a fault hands over when the hold-down has ended.
        let frames: Vec<&Acceptance> = since.collect();
        let changed = frames.chunk_by(|a, b| a.system == b.system).count() > 2;
        let fenced = vehicle
            .fenced
            .last()
            .is_some_and(|frame| frame.at_ns >= from.as_ns());
        match believes {
            _ if !believes[usize::from(obeyed.system)] => Some(Rule::ObeysNoMaster),
            [true, true] => Some(Rule::TwoMasters),
            _ if late || changed || fenced => Some(Rule::Unsteady),
            _ => None,
        }
    }

    /// Returns the rules that the roles violate after the end: no system is standby and none is
    /// suspended, or the vehicle stops although a system can still drive (`may_drive`).
    pub(crate) fn judge_roles(&mut self, may_drive: bool) -> Vec<Rule> {
        let is_alone = |bench: &Self| {
            let stands_by = |system: &SystemId| bench.pair.lamp(*system) == Some(RoleLamp::Standby);
            bench.suspended() == 0 && !SystemId::ALL.iter().any(stands_by)
        };
        let mut broken = vec![];
        if is_alone(self) {
            // After a long hold-down the other system may have started only now. It may still
            // become standby or suspend itself.
            self.pair.run_for(self.settles_within());
            broken.extend(is_alone(self).then_some(Rule::NoStandby));
        }
        let is_stopped = may_drive && self.vehicle.borrow().is_stopped();
        broken.extend(is_stopped.then_some(Rule::Stopped));
        broken
    }

    /// Returns the newest record in the flash of a system, and the number of used slots.
    fn record_of(&self, system: SystemId) -> (Loaded, usize) {
        let bytes = self.pair.flash(system);
        let loaded = newest_record(&bytes);
        let slots = bytes[..2 * FLASH_SECTOR_BYTES as usize].chunks(SystemState::BYTES);
        let used = slots.filter(|slot| slot.iter().any(|byte| *byte != 0xFF));
        (loaded, used.count())
    }
}

/// One system must have driven for this long at the end, without a pause.
const STEADY: Duration = Duration::from_ms(200);

/// Returns the longest time without an accepted control frame between these times.
pub(crate) fn longest_gap(accepted: &[Acceptance], from: Instant, until: Instant) -> Duration {
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

#[cfg(test)]
mod tests;
