//! Figures of a run, kept up to date in each tick.

use crate::geometry::Footprint;
use crate::road::LaneId;
use crate::traffic::Vehicle;

/// A collision with the same vehicle counts again after so much time apart, s.
const COLLISION_APART_S: f64 = 1.0;
/// Within this distance of a lane's centre the ego counts as being in place, m.
const IN_PLACE: f64 = 0.3;
/// An offset from the lane's centre that lasts longer than this counts as no change of lane, s.
const LANE_CHANGE_S: f64 = 10.0;
/// Width and number of the jerk histogram's bins, m/s³; what is beyond counts as the last.
const JERK_BIN: f64 = 0.02;
const JERK_BINS: usize = 5_000;
/// Time over which the jerk is taken, in milliseconds.
const JERK_SPAN_MS: usize = 20;

/// Figures of a run so far. Time runs only while the world does.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Metrics {
    /// Distinct collisions: the ego's rectangle overlapped another vehicle's.
    pub collisions: u32,
    /// Largest distance to the centre of the own lane, m, while no lane change was under way.
    ///
    /// A lane change is an excursion of more than 0.3 m from the centre of the nearest lane that
    /// ends in the middle of another lane. One that leads back counts in full, as does one that
    /// lasts longer than 10 s. The way from the start to the centre of the first lane does not
    /// count.
    pub lateral_error_max_m: f64,
    /// The same within lane changes, to the nearest lane's centre, m: about half a lane's width.
    pub lane_change_offset_max_m: f64,
    /// How often the ego went to another lane.
    pub lane_changes: u32,
    /// Smallest bumper distance to the leader in the own lane, m; infinite if there was none.
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
    /// Distance driven, m.
    pub distance_m: f64,
}

/// What [`Meter::step`] is told of the ego.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Sample {
    pub(crate) time_s: f64,
    pub(crate) speed: f64,
    pub(crate) long_acceleration: f64,
    pub(crate) lat_acceleration: f64,
    pub(crate) lane: LaneId,
    pub(crate) offset: f64,
    pub(crate) gap: f64,
    pub(crate) ttc: f64,
}

/// Collects the figures.
#[derive(Debug)]
pub(crate) struct Meter {
    metrics: Metrics,
    /// When the ego last overlapped each vehicle.
    last_overlap: Vec<Option<f64>>,
    excursion: Excursion,
    lane: Option<LaneId>,
    accelerations: [f64; JERK_SPAN_MS],
    steps: usize,
    jerks: Vec<u32>,
}

/// The time since the ego left the centre of a lane.
#[derive(Clone, Copy, Debug)]
struct Excursion {
    since: f64,
    largest: f64,
    /// It is not an error: the ego is changing lanes, or has not yet reached its first one.
    excused: bool,
}

impl Meter {
    pub(crate) fn new(vehicles: usize) -> Self {
        Self {
            metrics: Metrics {
                collisions: 0,
                lateral_error_max_m: 0.0,
                lane_change_offset_max_m: 0.0,
                lane_changes: 0,
                gap_min_m: f64::INFINITY,
                ttc_min_s: f64::INFINITY,
                acceleration_max: 0.0,
                deceleration_max: 0.0,
                lateral_acceleration_max: 0.0,
                jerk_p99: 0.0,
                distance_m: 0.0,
            },
            last_overlap: vec![None; vehicles],
            excursion: Excursion {
                since: 0.0,
                largest: 0.0,
                excused: true,
            },
            lane: None,
            accelerations: [0.0; JERK_SPAN_MS],
            steps: 0,
            jerks: vec![0; JERK_BINS],
        }
    }

    /// One millisecond of the running world.
    pub(crate) fn step(&mut self, sample: &Sample) {
        self.lateral(sample);
        self.jerk(sample.long_acceleration);
        let m = &mut self.metrics;
        m.gap_min_m = m.gap_min_m.min(sample.gap);
        m.ttc_min_s = m.ttc_min_s.min(sample.ttc);
        m.acceleration_max = m.acceleration_max.max(sample.long_acceleration);
        m.deceleration_max = m.deceleration_max.max(-sample.long_acceleration);
        m.lateral_acceleration_max = m
            .lateral_acceleration_max
            .max(sample.lat_acceleration.abs());
        m.distance_m += sample.speed * 1e-3;
    }

    /// Looks for overlaps; whether there is one now.
    pub(crate) fn collide(&mut self, time_s: f64, ego: &Footprint, vehicles: &[Vehicle]) -> bool {
        let mut collides = false;
        for (vehicle, last) in vehicles.iter().zip(&mut self.last_overlap) {
            if !vehicle.is_present() || !ego.overlaps(&vehicle.participant.footprint) {
                continue;
            }
            collides = true;
            if last.is_none_or(|last| time_s - last > COLLISION_APART_S) {
                self.metrics.collisions += 1;
            }
            *last = Some(time_s);
        }
        collides
    }

    fn lateral(&mut self, sample: &Sample) {
        let offset = sample.offset.abs();
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

    /// The figures so far.
    pub(crate) fn metrics(&self) -> Metrics {
        let total: u64 = self.jerks.iter().map(|count| u64::from(*count)).sum();
        let mut left = total - total * 99 / 100;
        let bin = self.jerks.iter().rposition(|count| {
            left = left.saturating_sub(u64::from(*count));
            left == 0 && total > 0
        });
        let jerk_p99 = bin.map_or(0.0, |bin| (bin as f64 + 0.5) * JERK_BIN);
        Metrics {
            jerk_p99,
            ..self.metrics
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Feeds (offset, lane) every 100 ms, each for 100 steps of a millisecond.
    fn lateral(samples: &[(f64, usize)]) -> Metrics {
        let mut meter = Meter::new(0);
        for (index, (offset, lane)) in samples.iter().enumerate() {
            for ms in 0..100 {
                meter.step(&Sample {
                    time_s: (index * 100 + ms) as f64 * 1e-3,
                    speed: 30.0,
                    long_acceleration: 0.0,
                    lat_acceleration: 0.0,
                    lane: LaneId(*lane),
                    offset: *offset,
                    gap: f64::INFINITY,
                    ttc: f64::INFINITY,
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

    #[test]
    fn the_jerk_percentile_comes_from_steps_of_twenty_milliseconds() {
        let mut meter = Meter::new(0);
        for step in 0..20_000 {
            // 1 m/s³ for ever, in a saw tooth without edges inside a span.
            meter.jerk(f64::from(step) * 1e-3);
        }
        assert!((meter.metrics().jerk_p99 - 1.0).abs() < 2.0 * JERK_BIN);
    }
}
