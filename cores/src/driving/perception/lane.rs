//! The lanes as the camera sees them, filtered over time and moved with the ego vehicle.
//!
//! The coefficients of the centre line are the state of a Kalman filter whose transition is the
//! Taylor shift of the polynomial by the distance driven: E. D. Dickmanns, B. D. Mysliwetz,
//! "Recursive 3-D Road and Relative Ego-State Recognition", IEEE PAMI 14 (1992).

use nalgebra::{Matrix4, Vector4};
use tandem_board::{Duration, Instant};
use tandem_bus::CameraLanes;

use crate::driving::math::{abs, clamp};
use crate::driving::odometry::EgoPose;
use crate::driving::road::DEFAULT_LANE_WIDTH_M;
use crate::driving::types::Lanes;

/// Lanes are carried along without the camera for this long.
const COAST: Duration = Duration::from_ms(300);

/// The camera's longest range, m. At a shorter range, the coefficients are equally uncertain at the
/// same share of the range.
const LONGEST_RANGE_M: f32 = 80.0;
/// Standard deviations of the camera's coefficients at that range: m, 1, 1/m, 1/m².
const MEASUREMENT: [f32; 4] = [0.025, 0.001_5, 3e-5, 4e-7];
/// How fast the true coefficients deviate from the model, per square root of a second.
const DRIFT: [f32; 4] = [0.05, 0.006, 3e-4, 4e-6];

/// Standard deviations of a filter that has settled.
const SETTLED: [f32; 4] = [0.015, 0.001, 2e-5, 3e-7];
/// A received line must not differ by more than this from the first lines that the camera sees: 5
/// sigma.
const GATE: [f32; 4] = [0.12, 0.008, 2e-4, 2.5e-6];

/// The filter.
#[derive(Clone, Debug)]
pub(crate) struct LaneFilter {
    seen: Option<Instant>,
    lanes: Lanes,
    state: Vector4<f32>,
    covariance: Matrix4<f32>,
    /// Knowledge of another system has been used.
    received: bool,
}

impl LaneFilter {
    pub(crate) fn new() -> Self {
        Self {
            seen: None,
            lanes: Lanes::alone(DEFAULT_LANE_WIDTH_M, 0.0),
            state: Vector4::zeros(),
            covariance: Matrix4::zeros(),
            received: false,
        }
    }

    /// Carries the lanes into the frame of the vehicle that has moved by `step` in `dt` seconds.
    pub(crate) fn predict(&mut self, dt: f32, step: &EgoPose) {
        if self.seen.is_none() {
            return;
        }
        let d = step.x;
        #[rustfmt::skip]
        let shift = Matrix4::new(
            1.0, d, d * d, d * d * d,
            0.0, 1.0, 2.0 * d, 3.0 * d * d,
            0.0, 0.0, 1.0, 3.0 * d,
            0.0, 0.0, 0.0, 1.0,
        );
        self.state = shift * self.state;
        let slope = self.state.y;
        self.state.x -= step.y;
        self.state.y -= step.heading * (1.0 + slope * slope);
        self.covariance = shift * self.covariance * shift.transpose();
        // In 32 bits, an asymmetry would grow exponentially, to a wrong line after some minutes.
        self.covariance = (self.covariance + self.covariance.transpose()) * 0.5;
        for (index, drift) in scaled(&DRIFT, self.lanes.view_range).iter().enumerate() {
            self.covariance[(index, index)] += drift * drift * dt;
        }
        for end in [
            &mut self.lanes.own_end,
            &mut self.lanes.left_end,
            &mut self.lanes.right_end,
        ] {
            *end -= d;
        }
    }

    /// Takes the camera's lanes at `at`, the time up to which the filter was predicted.
    pub(crate) fn update(&mut self, at: Instant, camera: &CameraLanes) {
        if !camera.valid {
            return;
        }
        let measured = Vector4::new(camera.c0, camera.c1, camera.c2, camera.c3);
        if self.seen.is_none() {
            self.state = measured;
            let deviations = scaled(&MEASUREMENT, f32::from(camera.view_range));
            self.covariance = Matrix4::from_diagonal(&Vector4::from(deviations.map(|s| s * s)));
        } else {
            // When the vehicle crosses a line, its own lane becomes another one of the same shape.
            let aside = measured.x - self.state.x;
            if abs(aside) > 0.4 * self.lanes.width {
                self.state.x = measured.x;
            }
            self.correct(&measured, f32::from(camera.view_range));
        }
        self.seen = Some(at);
        let end = |end: f32| {
            if end >= CameraLanes::NO_END {
                f32::INFINITY
            } else {
                end
            }
        };
        let width = |width: f32| {
            if width > 1.5 {
                width
            } else {
                DEFAULT_LANE_WIDTH_M
            }
        };
        let limit = camera.speed_limit;
        self.lanes = Lanes {
            c: self.lanes.c,
            view_range: f32::from(camera.view_range),
            width: width(camera.width),
            left: camera.left_exists.then(|| width(camera.left_width)),
            right: camera.right_exists.then(|| width(camera.right_width)),
            own_end: end(camera.own_end),
            ends_domain: camera.ends_domain,
            left_end: end(camera.left_end),
            right_end: end(camera.right_end),
            speed_limit: if limit >= CameraLanes::NO_SPEED_LIMIT {
                f32::INFINITY
            } else {
                limit
            },
        };
    }

    /// Uses another system's line, `dt` seconds old, as the prediction that the camera's lines
    /// correct; the vehicle has moved by `step` since. Works once, and only if the camera has lines
    /// that fit.
    pub(crate) fn recall(&mut self, now: Instant, c: &[f32; 4], dt: f32, step: &EgoPose) {
        let Some(seen) = self.seen.filter(|_| !self.received) else {
            return;
        };
        let mut known = self.clone();
        known.state = Vector4::from(*c);
        known.covariance = Matrix4::from_diagonal(&Vector4::from(SETTLED.map(|s| s * s)));
        known.predict(dt, step);
        let residual = self.state - known.state;
        let fits = residual.iter().zip(GATE).all(|(r, gate)| abs(*r) < gate);
        if fits {
            // Older camera lines are part of the other system's line, so they must not count twice.
            if now.since(seen).as_secs_f32() < dt {
                known.correct(&self.state, self.lanes.view_range);
            }
            *self = Self {
                state: known.state,
                covariance: known.covariance,
                received: true,
                ..self.clone()
            };
        }
    }

    /// One scalar update for each coefficient: their noises are independent, so no matrix is
    /// inverted.
    fn correct(&mut self, measured: &Vector4<f32>, range_m: f32) {
        for (index, deviation) in scaled(&MEASUREMENT, range_m).iter().enumerate() {
            let column = self.covariance.column(index).into_owned();
            let variance = column[index] + deviation * deviation;
            let residual = measured[index] - self.state[index];
            self.state += column * (residual / variance);
            self.covariance -= column * column.transpose() / variance;
        }
    }

    /// Returns the lanes in the frame up to which the filter was predicted; `None` if the camera
    /// has been blind for too long.
    pub(crate) fn lanes(&self, now: Instant) -> Option<Lanes> {
        let seen = self.seen?;
        if now.since(seen) > COAST {
            return None;
        }
        let s = &self.state;
        Some(Lanes {
            c: [s.x, s.y, clamp(s.z, -0.033, 0.033), clamp(s.w, -4e-4, 4e-4)],
            ..self.lanes
        })
    }

    /// Moves all times by this many nanoseconds.
    pub(super) fn shift(&mut self, by_ns: i64) {
        self.seen = self.seen.map(|seen| seen.moved(by_ns));
    }

    /// Forgets lanes that are too old, so that the next ones are used unfiltered.
    pub(crate) fn expire(&mut self, now: Instant) {
        if self.seen.is_some_and(|seen| now.since(seen) > COAST) {
            self.seen = None;
        }
    }
}

/// Deviations of the coefficients over `range_m` instead of the longest range.
fn scaled(deviations: &[f32; 4], range_m: f32) -> [f32; 4] {
    let factor = LONGEST_RANGE_M / clamp(range_m, 8.0, LONGEST_RANGE_M);
    let [a, b, c, d] = *deviations;
    [
        a,
        b * factor,
        c * factor * factor,
        d * factor * factor * factor,
    ]
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The covariance of a filter stays symmetric and positive for hours, though it is computed in
    /// 32 bits.
    #[test]
    fn an_hour_of_updates_leaves_the_covariance_sound() {
        let mut filter = LaneFilter::new();
        let camera = CameraLanes {
            valid: true,
            view_range: 80,
            width: 3.5,
            ..CameraLanes::default()
        };
        for cycle in 0..72_000_u32 {
            let at = Instant::ORIGIN + Duration::from_ms(u64::from(cycle) * 50);
            let step = EgoPose {
                x: 1.65 + 0.02 * ((cycle * 7 % 13) as f32 - 6.0) / 6.0,
                ..EgoPose::default()
            };
            filter.predict(0.05, &step);
            filter.update(at, &camera);
            let p = &filter.covariance;
            for index in 0..4 {
                assert!(p[(index, index)] > 0.0, "{cycle}: {p}");
                for other in 0..index {
                    let (one, two) = (p[(index, other)], p[(other, index)]);
                    let scale = (p[(index, index)] * p[(other, other)]).sqrt();
                    assert!(
                        (one - two).abs() <= 1e-3 * scale,
                        "{cycle} {index} {other}: {p}"
                    );
                    assert!(one.abs() <= scale, "{cycle} {index} {other}: {p}");
                }
            }
        }
    }
}
