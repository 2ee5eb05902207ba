//! Runs and judges a sequence of wrong values: a sound system drives, and what was found is told.

use crate::bench::{Around, Bench, Profile};
use crate::sequence_judge::{Found, Tried, longest_gap};
use tandem_board::{Duration, Instant, ResetCause, SystemId};
use tandem_board_sim::Power;
use tandem_bus::ModeCode;
use tandem_cores::trace::Event;
use tandem_faults::{DriveRoad, DriveSetting, Effect, Loss, Sequence, Suffer as _};
use tandem_record::verdict::{HEADWAY_MIN_S, Rule};
use tandem_redundancy::Evidence;

/// The sound system drives at most this long after the finding.
const SOUND_DRIVES: Duration = Duration::from_ms(20);
/// The same if the finding is that a sensor is lost: the systems compare their abilities only when
/// a difference has lasted for 100 ms.
const ABILITY_LASTS: Duration = Duration::from_ms(100);
/// A side of the vehicle is 0.1 m off its lane at this offset, m: the lane is 3.5 m and the vehicle
/// 1.8 m wide.
const OFF_LANE_M: f64 = 0.95;
/// A vehicle that is farther aside has been steered by the fault, m.
const STEERED_M: f64 = 0.5;
/// Both systems have started after this time.
const STARTED: Duration = Duration::from_ms(300);
/// The other system loses its power this long before the fault.
const ALONE: Duration = Duration::from_ms(2_000);

/// Returns whether this event says that a value or a system is wrong.
#[must_use]
pub const fn is_finding(event: &Event) -> bool {
    match event {
        Event::WrongScene { .. }
        | Event::PeerScene { .. }
        | Event::WrongTrajectory { .. }
        | Event::WrongCommand { .. }
        | Event::WrongEcho
        | Event::ClockWrong { .. }
        | Event::SensorLies { .. }
        | Event::SensorContradicted { .. } => true,
        Event::Agreement { stage, .. } => *stage > 0,
        _ => false,
    }
}

/// Returns whether this event tells of a wrong value, or of one that is missing.
const fn tells(event: &Event) -> bool {
    match event {
        Event::Ignored { .. } => true,
        // The other system is not there, or not able.
        Event::Phase { on, .. } => matches!(
            on,
            Evidence::PeerOff
                | Evidence::BeatsSilent
                | Evidence::StandbyMute
                | Evidence::StandbyUnable
        ),
        Event::Ability { bits, .. } => *bits != 0,
        Event::Sensors { missing } => *missing != 0,
        _ => is_finding(event),
    }
}

/// Returns whether this event says that its own system is the wrong one, or the less able.
const fn locates(event: &Event) -> bool {
    match event {
        Event::WrongScene { .. }
        | Event::WrongTrajectory { .. }
        | Event::WrongCommand { .. }
        | Event::SensorLies { .. }
        | Event::Ability { .. }
        | Event::Sensors { .. } => true,
        Event::PeerScene { own, .. } => *own,
        Event::ClockWrong { of } => *of == 0,
        _ => false,
    }
}

impl Profile {
    /// Runs a sequence in its setting.
    pub(crate) fn run_values(
        self,
        sequence: &Sequence,
        setting: DriveSetting,
        keeps: bool,
    ) -> (Tried, Bench) {
        let profile = Self {
            around: Around::ClosedLoop(setting.road),
            ..self
        };
        let mut bench = Bench::tracing(profile, 0, keeps);
        bench.drive_into(setting);
        bench.pair.reseed(sequence.number);
        let begin = bench.pair.now();
        let mode = bench.vehicle.borrow().mode();
        bench.forget_trace();
        for fault in &sequence.faults {
            for of in fault.way.systems() {
                let begins = bench.apply(Effect::Fault(fault.kind, of, true));
                begins.expect("a fault that the simulator can suffer");
            }
        }
        bench.pair.run_for(sequence.span);
        let faulty = match sequence.faults.first().map(|fault| fault.way.systems()) {
            Some(mut systems) => match (systems.next(), systems.next()) {
                (Some(one), None) => Some(one),
                _ => None,
            },
            None => None,
        };
        let tried = bench.judge_values(setting, faulty, (begin, mode));
        (tried, bench)
    }
}

impl Bench {
    /// Drives until the faults begin.
    ///
    /// # Panics
    /// If another system drives than the setting says.
    fn drive_into(&mut self, setting: DriveSetting) {
        let born = self.pair.now();
        self.power_on();
        if setting.driver == SystemId::B {
            // After a takeover, B leads the next start of both.
            self.pair.run_until(born + STARTED);
            self.pair.reset(SystemId::A, ResetCause::Software);
            self.pair.run_until(born + STARTED.times(2));
            for system in SystemId::ALL {
                self.pair.power_off(system);
            }
            self.power_on();
        }
        if setting.is_alone {
            self.pair.run_until(born + (setting.driven - ALONE));
            self.pair.power_off(setting.driver.peer());
        }
        self.pair.run_until(born + setting.driven);
        let drives = self.vehicle.borrow().accepted.last().map(|it| it.system);
        let expected = Some(setting.driver.index() as u8);
        assert_eq!(drives, expected, "{setting:?}");
    }

    fn judge_values(
        &mut self,
        setting: DriveSetting,
        faulty: Option<SystemId>,
        (begin, mode): (Instant, Option<ModeCode>),
    ) -> Tried {
        let now = self.pair.now();
        let found: Vec<Found> = self.findings(begin);
        let own = |of: SystemId| found.iter().find(|it| it.by == of && locates(&it.event));
        let vehicle = self.vehicle.borrow();
        let since = |at: Instant| {
            let from = vehicle.accepted.partition_point(|it| it.at_ns < at.as_ns());
            &vehicle.accepted[from..]
        };
        let index = |of: SystemId| of.index() as u8;
        let drive = vehicle
            .world()
            .map(tandem_vehicle::World::metrics)
            .unwrap_or_default();
        let changes = since(begin)
            .windows(2)
            .filter(|it| it[0].system != it[1].system)
            .count();
        let mut violations = vec![];
        let mut check = |broken: bool, rule| violations.extend(broken.then_some(rule));
        let sound = faulty.filter(|_| !setting.is_alone).map(SystemId::peer);
        if let (Some(faulty), Some(sound)) = (faulty, sound) {
            let frames = since(begin);
            let taken = frames.iter().position(|it| it.system == index(sound));
            let taken_at = taken.map(|first| Instant::from_ns(frames[first].at_ns));
            let late = own(faulty)
                .filter(|_| faulty == setting.driver)
                .is_some_and(|found| {
                    let limit = match found.event {
                        Event::Ability { .. }
                        | Event::Sensors { .. }
                        | Event::SensorLies { .. } => SOUND_DRIVES + ABILITY_LASTS,
                        _ => SOUND_DRIVES,
                    };
                    taken_at.is_none_or(|at| at > begin + found.after + limit)
                });
            // Once the sound system drives, it drives on.
            let after = taken.map_or(&[][..], |first| &frames[first..]);
            let again = after.iter().any(|it| it.system == index(faulty));
            check(late || again, Rule::SoundDrives);
        }
        let suspended = |of: SystemId| self.pair.power(of) == Power::Suspended;
        let driver = sound.unwrap_or(setting.driver);
        check(suspended(driver), Rule::DriverSuspended);
        check(drive.lateral_error_max_m > OFF_LANE_M, Rule::OffLane);
        check(drive.collisions_by_ego > 0, Rule::Collision);
        let too_close = setting.road == DriveRoad::StopAndGo && vehicle.headway_s < HEADWAY_MIN_S;
        check(too_close, Rule::TooClose);
        let gap = longest_gap(&vehicle.accepted, begin, now);
        let bound = Loss::Refused(Duration::from_ms(10)).bound(&self.profile.bounds());
        check(!setting.is_alone && gap > bound, Rule::Gap);
        let differs = vehicle.mode() != mode;
        let acted = changes > 0 || differs || drive.lateral_error_max_m > STEERED_M;
        check(acted && found.is_empty(), Rule::Untold);
        drop(vehicle);
        Tried {
            gap,
            changes,
            suspended: self.suspended(),
            simulated: now.since(self.born),
            digest: self.pair.digest(),
            covered: vec![],
            violations,
            found: found.first().copied(),
            aside_m: Some(drive.lateral_error_max_m),
        }
    }

    fn findings(&mut self, begin: Instant) -> Vec<Found> {
        let traced = self.trace().iter().filter(|it| it.at >= begin);
        traced
            .filter_map(|it| {
                let event = Event::decode(it.record).filter(tells)?;
                Some(Found {
                    by: it.system,
                    after: it.at.since(begin),
                    event,
                })
            })
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tandem_redundancy::Config;

    /// Returns the rules that are broken in a second in which A drives with a fault that has no
    /// effect, after this change of what the judge sees.
    fn judged(change: impl FnOnce(&mut Bench)) -> Vec<Rule> {
        let (_, road, driven) = DriveSetting::PLACES[0];
        let setting = DriveSetting {
            road,
            driver: SystemId::A,
            is_alone: false,
            driven,
        };
        let profile = Profile {
            around: Around::ClosedLoop(road),
            ..Profile::from(Config::rt())
        };
        let mut bench = Bench::tracing(profile, 0, false);
        bench.drive_into(setting);
        let begin = (bench.pair.now(), bench.vehicle.borrow().mode());
        bench.forget_trace();
        bench.pair.run_for(Duration::from_ms(1_000));
        change(&mut bench);
        let tried = bench.judge_values(setting, Some(SystemId::A), begin);
        tried.violations
    }

    /// Makes the accepted frames of the last `ago_ms` those of this system.
    fn drives(bench: &Bench, ago_ms: u64, system: SystemId) {
        let since_ns = bench.pair.now().as_ns() - ago_ms * 1_000_000;
        for frame in &mut bench.vehicle.borrow_mut().accepted {
            if frame.at_ns >= since_ns {
                frame.system = system.index() as u8;
            }
        }
    }

    /// Each rule is broken by what it forbids, and by nothing else.
    #[test]
    fn each_rule_of_wrong_values_can_be_broken() {
        assert_eq!(judged(|_| ()), []);
        let untold = judged(|bench| drives(bench, 500, SystemId::B));
        assert_eq!(untold, [Rule::Untold]);
        let returned = judged(|bench| {
            drives(bench, 500, SystemId::B);
            drives(bench, 100, SystemId::A);
        });
        assert_eq!(returned, [Rule::SoundDrives, Rule::Untold]);
        let paused = judged(|bench| {
            let now_ns = bench.pair.now().as_ns();
            let pause = now_ns - 300_000_000..now_ns - 200_000_000;
            let mut vehicle = bench.vehicle.borrow_mut();
            vehicle.accepted.retain(|it| !pause.contains(&it.at_ns));
        });
        assert_eq!(paused, [Rule::Gap]);
        let close = judged(|bench| bench.vehicle.borrow_mut().headway_s = 0.1);
        assert_eq!(close, [], "only the jam has a distance");
    }
}
