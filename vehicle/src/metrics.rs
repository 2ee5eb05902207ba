//! Figures of a run, kept up to date in each tick.

use std::sync::Arc;

use crate::commonroad::{Goal, Nearest};
use crate::emergency::EMERGENCY_BRAKING;
use crate::geometry::{Pose, Vec2};
use crate::road::LaneId;
use crate::traffic::{Participant, RoadUser};

/// A collision with the same vehicle counts again if the two were apart for this time, s.
const COLLISION_APART_S: f64 = 1.0;
/// Within this distance of a lane's centre the ego counts as being in place, m.
const IN_PLACE: f64 = 0.3;
/// An offset from the lane's centre that lasts longer than this is not a lane change, s.
const LANE_CHANGE_S: f64 = 10.0;
/// A lane change never leads farther than this beyond the border of a lane, m.
const BESIDE_ROAD: f64 = 0.5;
/// A gap of up to this width between lanes of different widths counts as road, m.
pub(crate) const LANE_GAP: f64 = 0.3;
/// A corner this little over the line is not an excursion, m: the precision of maps.
const ON_THE_LINE: f64 = 0.1;
/// A slower ego counts as standing, m/s.
const STANDING: f64 = 0.1;
/// Lateral motion faster than this is intentional, m/s.
const SWERVING: f64 = 0.3;
/// Stronger braking is reported with its reason, m/s².
pub(crate) const HARD_BRAKING: f64 = 4.0;
/// Braking harder than this is checked against the need of the situation, m/s².
pub(crate) const NOTED_BRAKING: f64 = 0.5;
/// An emergency ends this long after its situation, s: by then the vehicle has released its brake,
/// or stands.
const EMERGENCY_ENDS_S: f64 = 1.0;
/// A stop counts after this time, s, unless something within this distance ahead, m, explains it.
const STANDING_S: f64 = 3.0;
const STANDING_REASON_M: f64 = 30.0;
/// Milliseconds between two checks of the distance to a goal.
const NEAREST_STEPS: usize = 20;
/// Width and number of the jerk histogram's bins, m/s³; larger values count in the last bin.
const JERK_BIN: f64 = 0.02;
const JERK_BINS: usize = 5_000;
/// Time over which the jerk is computed, in milliseconds.
const JERK_SPAN_MS: usize = 20;
/// Window of the largest jerk, in milliseconds: passengers do not feel a shorter one.
const JERK_MAX_SPAN_MS: usize = 100;

/// Figures of a run so far. Time counts only while the world runs.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct WorldMetrics {
    /// Number of collisions: the ego's rectangle overlapped another vehicle's.
    pub collisions: u32,
    /// Collisions that the ego caused. Not counted: it was hit while it stood, from behind, or from
    /// the side while it kept its lane.
    pub collisions_by_ego: u32,
    /// Collisions while the ego stood.
    pub hit_while_standing: u32,
    /// How far the farthest corner of the ego was outside of all lanes of its direction, m, and
    /// when, s; 0 if never by more than 0.1 m. What is outside at the start counts when it grows.
    pub excursion_max_m: f64,
    /// The time of `excursion_max_m`.
    pub excursion_at_s: f64,
    /// How many others had to brake with more than 1.5 m/s² for the ego, and the hardest of that
    /// braking, m/s², positive.
    pub forced_brakes: u32,
    /// The hardest braking of `forced_brakes`.
    pub forced_brake_max: f64,
    /// Time with the centre outside of all lanes of its direction, s.
    pub off_lane_s: f64,
    /// The part of that time on a lane of the other direction, s.
    pub wrong_way_s: f64,
    /// Time for which the ego stood, after the first seconds of each stop, although nothing was
    /// near ahead and the driver did not want it parked, s.
    pub standing_s: f64,
    /// When the first of the scenario's goals was reached, s; `None` if none was.
    pub goal_reached_s: Option<f64>,
    /// The nearest approach to the place of a goal within the goal's time; `None` before that time,
    /// or if no goal has a place.
    pub goal_nearest: Option<Nearest>,
    /// Time for which the ego drove beyond the end of the operational design domain, s.
    pub outside_domain_s: f64,
    /// When the function first asked the driver to take over, s.
    pub takeover_asked_s: Option<f64>,
    /// When the function first began its minimal-risk stop, s.
    pub safe_stop_s: Option<f64>,
    /// Largest distance to the centre of the ego's lane, m, while no lane change was under way.
    ///
    /// A lane change is an excursion of more than 0.3 m from the centre of the nearest lane that
    /// ends in the middle of another lane. An excursion that leads back counts in full, as does one
    /// that lasts longer than 10 s, one that is still open in another lane, and one that leaves the
    /// road. The path from the start to the centre of the first lane does not count while it is on
    /// the road.
    pub lateral_error_max_m: f64,
    /// The same during lane changes, to the nearest lane's centre, m: about half a lane's width.
    pub lane_change_offset_max_m: f64,
    /// How often the ego went to another lane.
    pub lane_changes: u32,
    /// Smallest bumper distance to the leader in the ego's lane, m; infinite if there was none.
    pub gap_min_m: f64,
    /// Smallest time to collision with the leader, s; infinite if the ego never closed in.
    pub ttc_min_s: f64,
    /// Largest longitudinal acceleration, m/s².
    pub acceleration_max: f64,
    /// Largest deceleration, m/s², positive.
    pub deceleration_max: f64,
    /// Largest lateral acceleration to either side, m/s².
    pub lateral_acceleration_max: f64,
    /// 99th percentile of the longitudinal jerk's magnitude over 20 ms, m/s³.
    pub jerk_p99: f64,
    /// Largest longitudinal jerk over 100 ms, m/s³, and when, s.
    pub jerk_max: (f64, f64),
    /// Largest deceleration, m/s², positive, and largest longitudinal jerk over 100 ms, m/s³,
    /// outside emergencies.
    ///
    /// An emergency is a situation in which the ego needs a constant deceleration above 3 m/s²: to
    /// stay 1 m behind an object that is in its path or enters it within 2 s and keeps its
    /// deceleration, or to stop 1 m before the end of the lane or of the domain. It ends 1 s
    /// after the situation does.
    pub calm_deceleration_max: f64,
    /// The jerk of `calm_deceleration_max`.
    pub calm_jerk_max: f64,
    /// The hardest braking above 4 m/s²: when it first exceeded that, and its reason.
    pub hard_braking: Option<HardBraking>,
    /// Distance driven, m.
    pub distance_m: f64,
}

impl Default for WorldMetrics {
    /// The figures of a drive that has not begun.
    fn default() -> Self {
        Self {
            collisions: 0,
            collisions_by_ego: 0,
            hit_while_standing: 0,
            excursion_max_m: 0.0,
            excursion_at_s: 0.0,
            forced_brakes: 0,
            forced_brake_max: 0.0,
            off_lane_s: 0.0,
            wrong_way_s: 0.0,
            standing_s: 0.0,
            goal_reached_s: None,
            goal_nearest: None,
            outside_domain_s: 0.0,
            takeover_asked_s: None,
            safe_stop_s: None,
            lateral_error_max_m: 0.0,
            lane_change_offset_max_m: 0.0,
            lane_changes: 0,
            gap_min_m: f64::INFINITY,
            ttc_min_s: f64::INFINITY,
            acceleration_max: 0.0,
            deceleration_max: 0.0,
            lateral_acceleration_max: 0.0,
            jerk_p99: 0.0,
            jerk_max: (0.0, 0.0),
            calm_deceleration_max: 0.0,
            calm_jerk_max: 0.0,
            hard_braking: None,
            distance_m: 0.0,
        }
    }
}

/// Braking that is not comfortable.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct HardBraking {
    /// s
    pub at_s: f64,
    /// Time to collision with the leader at that time, s; infinite if the ego was not closing in.
    pub ttc_s: f64,
    /// Distance to the leader at that time, m; infinite without one.
    pub gap_m: f64,
    /// Distance to the end of the lane or domain at that time, m; infinite without one.
    pub end_m: f64,
    /// Distance to the nearest other road user in front, in any lane, m; infinite without one.
    pub beside_m: f64,
    /// Constant deceleration that the situation needed at that time or up to a second before, m/s².
    pub needed: f64,
}

impl HardBraking {
    /// Returns the reason in words.
    #[must_use]
    pub fn reason(&self) -> String {
        format!("{}; {:.1} m/s² needed", self.what(), self.needed)
    }

    fn what(&self) -> String {
        match self {
            Self { ttc_s, gap_m, .. } if *ttc_s < 6.0 => {
                format!("vehicle {gap_m:.0} m ahead, {ttc_s:.1} s to a collision")
            }
            Self { end_m, .. } if *end_m < 50.0 => format!("the lane ends in {end_m:.0} m"),
            Self { gap_m, .. } if *gap_m < 50.0 => format!("vehicle {gap_m:.0} m ahead"),
            Self { beside_m, .. } if *beside_m < 50.0 => {
                format!("road user {beside_m:.0} m away, not in the lane yet")
            }
            _ => "nothing seen ahead".to_owned(),
        }
    }
}

/// The ego's state for [`Meter::step`].
#[derive(Clone, Copy, Debug)]
pub(crate) struct Sample {
    pub(crate) time_s: f64,
    /// The driver wants the vehicle parked.
    pub(crate) parks: bool,
    pub(crate) speed: f64,
    pub(crate) long_acceleration: f64,
    pub(crate) lat_acceleration: f64,
    pub(crate) lane: LaneId,
    pub(crate) offset: f64,
    /// Width of the lane at the ego, m; 0 where it does not exist or runs the other way.
    pub(crate) width: f64,
    /// Whether the ego is on a lane of the other direction and not on one of its direction.
    pub(crate) wrong_way: bool,
    /// How far its farthest corner is outside of all lanes of its direction, m.
    pub(crate) outside: f64,
    pub(crate) pose: Pose,
    pub(crate) gap: f64,
    pub(crate) ttc: f64,
    /// Distance to the nearest other road user in front, in any lane, m, while the ego brakes hard.
    pub(crate) beside: f64,
    /// Distance to the end of the lane, m.
    pub(crate) end: f64,
    /// Distance to the end of the operational design domain, m.
    pub(crate) domain_end: f64,
}

/// Collects the figures.
#[derive(Debug)]
pub(crate) struct Meter {
    metrics: WorldMetrics,
    /// When the ego last overlapped each vehicle.
    last_overlap: Vec<Option<f64>>,
    goals: Arc<[Goal]>,
    excursion: Excursion,
    /// How far a corner was outside ever since the start, m.
    outside_since_start: f64,
    lane: Option<LaneId>,
    stopped_since: Option<f64>,
    /// Time of the last emergency, s.
    emergency_s: Option<f64>,
    /// The last deceleration that was needed, m/s², and its time, s.
    needed: (f64, f64),
    accelerations: [f64; JERK_SPAN_MS],
    /// Accelerations of the last 100 ms, for the largest jerk.
    smooth: [f64; JERK_MAX_SPAN_MS],
    steps: usize,
    jerks: Vec<u32>,
}

/// The ego's path since it left the centre of a lane.
#[derive(Clone, Copy, Debug)]
struct Excursion {
    since: f64,
    largest: f64,
    /// The excursion is not an error: the ego changes lanes, or has not yet reached its first lane.
    excused: bool,
}

impl Meter {
    pub(crate) fn new(vehicles: usize, goals: Arc<[Goal]>) -> Self {
        Self {
            metrics: WorldMetrics::default(),
            last_overlap: vec![None; vehicles],
            excursion: Excursion {
                since: 0.0,
                largest: 0.0,
                excused: true,
            },
            goals,
            outside_since_start: f64::INFINITY,
            lane: None,
            stopped_since: None,
            emergency_s: None,
            needed: (0.0, 0.0),
            smooth: [0.0; JERK_MAX_SPAN_MS],
            accelerations: [0.0; JERK_SPAN_MS],
            steps: 0,
            jerks: vec![0; JERK_BINS],
        }
    }

    /// Adds one millisecond of the running world.
    pub(crate) fn step(&mut self, sample: &Sample) {
        self.lateral(sample);
        self.largest_jerk(sample);
        self.jerk(sample.long_acceleration);
        self.standing(sample);
        let m = &mut self.metrics;
        if sample.long_acceleration < -HARD_BRAKING
            && -sample.long_acceleration > m.deceleration_max
            && m.hard_braking.is_none_or(|h| sample.time_s - h.at_s > 2.0)
        {
            m.hard_braking = Some(HardBraking {
                at_s: sample.time_s,
                ttc_s: sample.ttc,
                gap_m: sample.gap,
                end_m: sample.end.min(sample.domain_end),
                beside_m: sample.beside,
                needed: self.needed.0,
            });
        }
        let Sample { pose, speed, .. } = *sample;
        let reached = |goal: &Goal| goal.is_reached(sample.time_s, pose.position, pose.yaw, speed);
        if m.goal_reached_s.is_none() && self.goals.iter().any(reached) {
            m.goal_reached_s = Some(sample.time_s);
        }
        if m.goal_reached_s.is_none() && self.steps.is_multiple_of(NEAREST_STEPS) {
            m.goal_nearest = self.goals.iter().fold(m.goal_nearest, |nearest, goal| {
                goal.nearer(nearest, sample.time_s, pose.position, speed)
            });
        }
        if sample.domain_end <= 0.0 && speed >= STANDING {
            m.outside_domain_s += 1e-3;
        }
        m.gap_min_m = m.gap_min_m.min(sample.gap);
        m.ttc_min_s = m.ttc_min_s.min(sample.ttc);
        m.acceleration_max = m.acceleration_max.max(sample.long_acceleration);
        m.deceleration_max = m.deceleration_max.max(-sample.long_acceleration);
        m.lateral_acceleration_max = m
            .lateral_acceleration_max
            .max(sample.lat_acceleration.abs());
        m.distance_m += sample.speed * 1e-3;
    }

    /// Called when the ego brakes and needs this deceleration, m/s².
    pub(crate) fn needs(&mut self, time_s: f64, deceleration: f64) {
        let (largest, at_s) = self.needed;
        if deceleration >= largest || time_s - at_s > EMERGENCY_ENDS_S {
            self.needed = (deceleration, time_s);
        }
        if deceleration > EMERGENCY_BRAKING {
            self.emergency_s = Some(time_s);
        }
    }

    /// Returns the time at which a goal was reached, s.
    pub(crate) const fn reached_s(&self) -> Option<f64> {
        self.metrics.goal_reached_s
    }

    /// Records whether the function asks the driver to take over, and whether it stops.
    pub(crate) fn function(&mut self, time_s: f64, asks: bool, stops: bool) {
        let m = &mut self.metrics;
        m.takeover_asked_s = m.takeover_asked_s.or(asks.then_some(time_s));
        m.safe_stop_s = m.safe_stop_s.or(stops.then_some(time_s));
    }

    /// Searches for overlaps; returns whether there is one now. `keeps_lane`: the ego's body is in
    /// its lane.
    pub(crate) fn collide(
        &mut self,
        time_s: f64,
        ego: &Participant,
        keeps_lane: bool,
        vehicles: &[RoadUser],
    ) -> bool {
        let mut collides = false;
        for (vehicle, last) in vehicles.iter().zip(&mut self.last_overlap) {
            let other = &vehicle.participant;
            if !vehicle.is_present() || !ego.footprint.overlaps(&other.footprint) {
                continue;
            }
            collides = true;
            if last.is_none_or(|last| time_s - last > COLLISION_APART_S) {
                let m = &mut self.metrics;
                m.collisions += 1;
                let stands = ego.speed < STANDING;
                m.hit_while_standing += u32::from(stands);
                m.collisions_by_ego += u32::from(!stands && is_cause(ego, other, keeps_lane));
            }
            *last = Some(time_s);
        }
        collides
    }

    fn standing(&mut self, sample: &Sample) {
        let end = sample.end.min(sample.domain_end);
        let excused = sample.parks || sample.gap.min(end) < STANDING_REASON_M;
        if sample.speed >= STANDING || excused {
            self.stopped_since = None;
        } else if sample.time_s - *self.stopped_since.get_or_insert(sample.time_s) > STANDING_S {
            self.metrics.standing_s += 1e-3;
        }
    }

    fn largest_jerk(&mut self, sample: &Sample) {
        let slot = self.steps % JERK_MAX_SPAN_MS;
        let change = (sample.long_acceleration - self.smooth[slot]).abs();
        self.smooth[slot] = sample.long_acceleration;
        let jerk = change / (JERK_MAX_SPAN_MS as f64 * 1e-3);
        let m = &mut self.metrics;
        let is_emergency = |since_s: f64| sample.time_s - since_s <= EMERGENCY_ENDS_S;
        let is_calm = !self.emergency_s.is_some_and(is_emergency);
        if is_calm {
            m.calm_deceleration_max = m.calm_deceleration_max.max(-sample.long_acceleration);
        }
        if self.steps < JERK_MAX_SPAN_MS {
            return;
        }
        if jerk > m.jerk_max.0 {
            m.jerk_max = (jerk, sample.time_s);
        }
        if is_calm {
            m.calm_jerk_max = m.calm_jerk_max.max(jerk);
        }
    }

    fn lateral(&mut self, sample: &Sample) {
        let offset = sample.offset.abs();
        let m = &mut self.metrics;
        let beyond = offset - sample.width / 2.0;
        if beyond > LANE_GAP {
            m.off_lane_s += 1e-3;
            m.wrong_way_s += if sample.wrong_way { 1e-3 } else { 0.0 };
        }
        self.outside_since_start = self.outside_since_start.min(sample.outside);
        let is_excursion = sample.outside > self.outside_since_start + ON_THE_LINE;
        if is_excursion && sample.outside > m.excursion_max_m {
            (m.excursion_max_m, m.excursion_at_s) = (sample.outside, sample.time_s);
        }
        if beyond > BESIDE_ROAD {
            m.lateral_error_max_m = m.lateral_error_max_m.max(offset);
        }
        let changed = self.lane.is_some_and(|lane| lane != sample.lane);
        self.lane = Some(sample.lane);
        let excursion = &mut self.excursion;
        excursion.largest = excursion.largest.max(offset);
        if changed {
            self.metrics.lane_changes += 1;
            (excursion.excused, excursion.since) = (true, sample.time_s);
        }
        let too_long = sample.time_s - excursion.since > LANE_CHANGE_S;
        if offset > IN_PLACE && !too_long {
            return;
        }
        let largest = if too_long { offset } else { excursion.largest };
        if excursion.excused && !too_long {
            let m = &mut self.metrics.lane_change_offset_max_m;
            *m = m.max(largest);
        } else {
            let m = &mut self.metrics.lateral_error_max_m;
            *m = m.max(largest);
        }
        if offset <= IN_PLACE {
            *excursion = Excursion {
                since: sample.time_s,
                largest: 0.0,
                excused: false,
            };
        }
    }

    fn jerk(&mut self, acceleration: f64) {
        let slot = self.steps % JERK_SPAN_MS;
        if self.steps >= JERK_SPAN_MS && slot == 0 {
            let change = (acceleration - self.accelerations[slot]).abs();
            let bin = (change / (JERK_SPAN_MS as f64 * 1e-3) / JERK_BIN) as usize;
            self.jerks[bin.min(JERK_BINS - 1)] += 1;
        }
        self.accelerations[slot] = acceleration;
        self.steps += 1;
    }

    /// Returns the figures so far.
    pub(crate) fn metrics(&self) -> WorldMetrics {
        let total: u64 = self.jerks.iter().map(|count| u64::from(*count)).sum();
        let mut left = total - total * 99 / 100;
        let bin = self.jerks.iter().rposition(|count| {
            left = left.saturating_sub(u64::from(*count));
            left == 0 && total > 0
        });
        let jerk_p99 = bin.map_or(0.0, |bin| (bin as f64 + 0.5) * JERK_BIN);
        let open = if self.excursion.excused {
            0.0
        } else {
            self.excursion.largest
        };
        WorldMetrics {
            jerk_p99,
            lateral_error_max_m: self.metrics.lateral_error_max_m.max(open),
            ..self.metrics
        }
    }
}

/// Returns whether the moving ego caused its collision with `other`.
///
/// It did not if it was hit from behind, or from the side while it kept its lane.
fn is_cause(ego: &Participant, other: &Participant, keeps_lane: bool) -> bool {
    let apart = ego.footprint.pose.to_local(other.footprint.pose.position);
    let own_half = ego.footprint.length / 2.0;
    let nearest = other
        .footprint
        .corners()
        .map(|c| ego.footprint.pose.to_local(c).x);
    let foremost = nearest.into_iter().fold(f64::NEG_INFINITY, f64::max);
    let rearmost = nearest.into_iter().fold(f64::INFINITY, f64::min);
    let velocity = ego
        .footprint
        .pose
        .unrotate(Vec2::from_angle(other.footprint.pose.yaw) * other.speed);
    // From behind: only the other's front reaches the ego's rear, and the other is faster.
    if apart.x < 0.0 && foremost < own_half && velocity.x > ego.speed {
        return false;
    }
    // From the side: the other is partly behind the ego's front and moves sideways towards the ego.
    let beside = rearmost < own_half - 0.5;
    let closes_in = velocity.y * apart.y < 0.0 && velocity.y.abs() > SWERVING;
    !(beside && keeps_lane && closes_in)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::Footprint;

    const CRUISING: Sample = Sample {
        time_s: 0.0,
        parks: false,
        speed: 30.0,
        long_acceleration: 0.0,
        lat_acceleration: 0.0,
        lane: LaneId(0),
        offset: 0.0,
        width: 3.5,
        wrong_way: false,
        outside: 0.0,
        pose: Pose {
            position: Vec2::new(0.0, 0.0),
            yaw: 0.0,
        },
        gap: f64::INFINITY,
        ttc: f64::INFINITY,
        beside: f64::INFINITY,
        end: f64::INFINITY,
        domain_end: f64::INFINITY,
    };

    /// A stop on a free road has no reason, unless the driver wants the vehicle parked.
    #[test]
    fn a_vehicle_that_is_to_be_parked_may_stand() {
        let standing_s = |parks: bool| {
            let mut meter = Meter::new(0, Arc::new([]));
            for ms in 0..5_000_u32 {
                meter.step(&Sample {
                    time_s: f64::from(ms) * 1e-3,
                    speed: 0.0,
                    parks,
                    ..CRUISING
                });
            }
            meter.metrics().standing_s
        };
        assert!((standing_s(false) - 2.0).abs() < 0.01);
        assert_eq!(standing_s(true), 0.0);
    }

    /// The brake builds up at 20 m/s³ to 6 m/s² at 1 s, and again at 5 s. Only the first time is an
    /// emergency.
    #[test]
    fn braking_in_an_emergency_is_told_apart() {
        let figures = |needed: f64| {
            let mut meter = Meter::new(0, Arc::new([]));
            for ms in 0..8_000_u32 {
                let time_s = f64::from(ms) * 1e-3;
                let since_s = if time_s < 4.0 {
                    time_s - 1.0
                } else {
                    time_s - 5.0
                };
                let hardest = if time_s < 4.0 { 6.0 } else { 3.0 };
                let ramp = |from_s: f64| (20.0 * (since_s - from_s)).clamp(0.0, hardest);
                let braking = ramp(0.0) - ramp(0.8);
                if braking > NOTED_BRAKING {
                    meter.needs(time_s, if time_s < 4.0 { needed } else { 2.0 });
                }
                meter.step(&Sample {
                    time_s,
                    long_acceleration: -braking,
                    ..CRUISING
                });
            }
            meter.metrics()
        };
        let near = |a: f64, b: f64| (a - b).abs() < 0.1;
        for (needed, calm) in [(3.5, 3.0), (2.5, 6.0)] {
            let it = figures(needed);
            assert!(near(it.jerk_max.0, 20.0) && near(it.deceleration_max, 6.0));
            assert!(near(it.calm_deceleration_max, calm), "{it:?}");
            assert!(near(it.calm_jerk_max, 20.0), "{it:?}");
            assert!(near(it.hard_braking.unwrap().needed, needed), "{it:?}");
        }
    }

    /// Each reason, and the order in which reasons are checked.
    #[test]
    fn the_reason_of_hard_braking_is_what_is_nearest_in_time() {
        const FREE: f64 = f64::INFINITY;
        for (ttc_s, gap_m, end_m, beside_m, reason) in [
            (
                1.4,
                13.0,
                20.0,
                9.0,
                "vehicle 13 m ahead, 1.4 s to a collision",
            ),
            (6.5, 30.0, 22.0, 9.0, "the lane ends in 22 m"),
            (FREE, 17.0, 60.0, 9.0, "vehicle 17 m ahead"),
            (
                FREE,
                55.0,
                60.0,
                9.0,
                "road user 9 m away, not in the lane yet",
            ),
            (FREE, FREE, FREE, 51.0, "nothing seen ahead"),
        ] {
            let braking = HardBraking {
                at_s: 1.0,
                ttc_s,
                gap_m,
                end_m,
                beside_m,
                needed: 4.25,
            };
            assert_eq!(braking.reason(), format!("{reason}; 4.2 m/s² needed"));
        }
    }

    /// Feeds each (offset, lane) for 100 ms, in steps of one millisecond.
    fn lateral(samples: &[(f64, usize)]) -> WorldMetrics {
        let mut meter = Meter::new(0, Arc::new([]));
        for (index, (offset, lane)) in samples.iter().enumerate() {
            for ms in 0..100 {
                meter.step(&Sample {
                    time_s: (index * 100 + ms) as f64 * 1e-3,
                    lane: LaneId(*lane),
                    offset: *offset,
                    outside: (offset.abs() + 0.9 - CRUISING.width / 2.0).max(0.0),
                    ..CRUISING
                });
            }
        }
        meter.metrics()
    }

    #[test]
    fn a_lane_change_is_no_lateral_error_but_a_swerve_is() {
        let change = [
            (0.1, 0),
            (0.9, 0),
            (1.7, 0),
            (-1.7, 1),
            (-0.8, 1),
            (-0.2, 1),
            (0.25, 1),
        ];
        let metrics = lateral(&change);
        assert_eq!(
            (metrics.lateral_error_max_m, metrics.lane_changes),
            (0.25, 1)
        );
        assert_eq!(metrics.lane_change_offset_max_m, 1.7);
        let swerve = [(0.1, 0), (0.9, 0), (1.2, 0), (0.5, 0), (0.1, 0)];
        assert_eq!(lateral(&swerve).lateral_error_max_m, 1.2);
        let never_back: Vec<_> = [(0.1, 0)].into_iter().chain([(0.8, 0); 120]).collect();
        assert_eq!(lateral(&never_back).lateral_error_max_m, 0.8);
        let start = [(-1.0, 0), (-0.5, 0), (0.1, 0)];
        assert_eq!(lateral(&start).lateral_error_max_m, 0.1);
    }

    /// An excursion counts even if the run ends before it. One that leaves the road counts even if
    /// the ego crosses lanes during it.
    #[test]
    fn an_excursion_that_is_open_at_the_end_counts() {
        let open = [(0.1, 0), (0.9, 0), (1.4, 0)];
        assert_eq!(lateral(&open).lateral_error_max_m, 1.4);
        let away = lateral(&[(0.1, 0), (1.7, 0), (-1.7, 1), (-4.0, 1), (9.0, 0), (8.0, 1)]);
        assert_eq!(away.lateral_error_max_m, 9.0);
        // The left side counts, not the centre.
        assert!((away.excursion_max_m - (9.0 + 0.9 - 1.75)).abs() < 1e-9);
        assert!((away.off_lane_s - 0.3).abs() < 2e-3, "{}", away.off_lane_s);
    }

    /// A corner over the line counts. One that begins there counts when it goes farther.
    #[test]
    fn an_excursion_is_that_of_a_corner() {
        assert_eq!(
            lateral(&[(0.0, 0), (0.94, 0)]).excursion_max_m,
            0.0,
            "9 cm over the line"
        );
        let over = lateral(&[(0.0, 0), (1.05, 0), (0.0, 0)]);
        assert!((over.excursion_max_m - 0.2).abs() < 1e-9, "{over:?}");
        assert!((over.excursion_at_s - 0.1).abs() < 1e-9, "{over:?}");
        assert_eq!(
            lateral(&[(1.4, 0), (1.2, 0), (0.5, 0)]).excursion_max_m,
            0.0
        );
        let grows = lateral(&[(1.4, 0), (1.6, 0), (0.5, 0)]);
        assert!((grows.excursion_max_m - 0.75).abs() < 1e-9, "{grows:?}");
    }

    /// A vehicle that runs into another is the cause. A vehicle that is hit from behind, or in the
    /// side while it keeps its lane, is not.
    #[test]
    fn a_collision_is_the_egos_only_if_it_caused_it() {
        let at = |x: f64, y: f64, yaw: f64, speed: f64| Participant {
            footprint: Footprint {
                pose: Pose {
                    position: Vec2::new(x, y),
                    yaw,
                },
                length: 4.5,
                width: 1.8,
            },
            speed,
            acceleration: 0.0,
        };
        let ego = at(0.0, 0.0, 0.0, 10.0);
        let cases = [
            ("into a leader", at(4.4, 0.2, 0.0, 5.0), true, true),
            ("from behind", at(-4.4, 0.2, 0.0, 15.0), true, false),
            (
                "it drives in from the side",
                at(0.5, 1.7, -0.2, 10.0),
                true,
                false,
            ),
            (
                "the ego changes lanes",
                at(0.5, 1.7, 0.0, 10.0),
                false,
                true,
            ),
            ("across, in front", at(3.0, 0.5, 1.5, 8.0), true, true),
        ];
        for (name, other, keeps_lane, expected) in cases {
            assert!(ego.footprint.overlaps(&other.footprint), "{name}");
            assert_eq!(is_cause(&ego, &other, keeps_lane), expected, "{name}");
        }
    }

    #[test]
    fn the_jerk_percentile_comes_from_steps_of_twenty_milliseconds() {
        let mut meter = Meter::new(0, Arc::new([]));
        for step in 0..20_000 {
            // The acceleration at a constant jerk of 1 m/s³.
            meter.jerk(f64::from(step) * 1e-3);
        }
        assert!((meter.metrics().jerk_p99 - 1.0).abs() < 2.0 * JERK_BIN);
    }
}
