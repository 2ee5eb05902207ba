//! One tracked object: filters of both axes, its class, and the confidence in its existence.

use tandem_bus::{ClassCode, SensorId, SensorObject};

use super::kalman::{Axis, Innovation, Measured, Motion, Settled, Span};
use crate::driving::knowledge::Known;
use crate::driving::math::{abs, clamp, lerp, max, min};
use crate::driving::odometry::{Axes, EgoPose};
use crate::driving::types::Ego;
use crate::driving::vehicle::WIDTH_M;

/// Motion along the road: vehicles brake with up to 8 m/s² within half a second.
const ALONG: Motion = Motion {
    acceleration_noise: 9.0,
    fading_s: 1.5,
};
/// Motion across the road: vehicles change lanes gently.
const ACROSS: Motion = Motion {
    acceleration_noise: 1.0,
    fading_s: 0.5,
};
/// Variances of a track from another system.
const ALONG_SETTLED: Settled = Settled {
    position: 0.03,
    velocity: 0.012,
    acceleration: 1.0,
    both: 0.08,
};
const ACROSS_SETTLED: Settled = Settled {
    position: 0.03,
    velocity: 0.03,
    acceleration: 0.3,
    both: 0.05,
};
/// 99.9 % of the chi-squared distribution with four degrees of freedom.
const GATE: f32 = 18.5;
/// A detection farther away than this is another object, even if the track is uncertain, m.
const MAX_JUMP_X_M: f32 = 8.0;
/// The same across the road: less than the distance between two lanes, m.
const MAX_JUMP_Y_M: f32 = 2.5;

/// Confirmed by this many detections of one sensor …
const CONFIRMING_HITS: u16 = 3;
/// … or by this many different sensors.
const CONFIRMING_SENSORS: u32 = 2;
/// An unconfirmed track ends when it was not seen for this long, s.
const TENTATIVE_COAST_S: f32 = 0.12;
/// A confirmed track is kept for this long while no sensor sees it, s: short occlusions, dropouts.
const COAST_S: f32 = 0.8;
/// The same for a track close beside the ego vehicle, where the fields of view may leave a gap, s.
const BESIDE_COAST_S: f32 = 2.0;
/// A confirmed track that may be where no radar sees it is kept for this long, s.
const HIDDEN_COAST_S: f32 = 10.0;
/// On either side, the fields of view of the corner radars leave out a triangle: half of it along
/// the vehicle's middle line, and how far aside they meet, m. `vehicle/tests/sensing.rs` tests it.
const HIDDEN_M: (f32, f32) = (2.4, 4.2);
/// However uncertain its place is: it may be this much farther along, m.
const HIDDEN_DEVIATION_M: f32 = 1.0;
/// Of a longer object, at least this share reaches out of there, and it is seen.
const SEEN_SHARE: f32 = 0.25;
/// Detections of one round lie within this time, s.
const ROUND_S: f32 = 0.03;

/// A detection in the vehicle frame, with velocities over ground.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Detection {
    sensor: SensorId,
    class: ClassCode,
    x: Measured,
    y: Measured,
    length: f32,
    width: f32,
}

impl Detection {
    /// Converts a sensor's object, with the ego's motion at the time of the measurement.
    pub(crate) fn new(sensor: SensorId, object: &SensorObject, ego: &Ego) -> Self {
        let (along, across) = velocity_variances(sensor, object.x, object.y);
        let deviation = |value: f32| clamp(value, 0.1, 5.0);
        let (dx, dy) = (deviation(object.x_deviation), deviation(object.y_deviation));
        Self {
            sensor,
            class: object.class,
            x: Measured {
                position: object.x,
                velocity: object.vx + ego.speed,
                position_variance: dx * dx,
                velocity_variance: along,
            },
            y: Measured {
                position: object.y,
                velocity: object.vy + ego.speed * ego.slip_angle,
                position_variance: dy * dy,
                velocity_variance: across,
            },
            length: object.length,
            width: object.width,
        }
    }

    /// The object after `lag_s` at its speed, in the frame of the ego vehicle after `step`.
    pub(crate) fn carried(mut self, lag_s: f32, step: EgoPose) -> Self {
        let along = self.x.position + self.x.velocity * lag_s;
        let across = self.y.position + self.y.velocity * lag_s;
        (self.x.position, self.y.position) = step.to_local(along, across);
        self
    }
}

/// Variances of the measured velocities along x and y, (m/s)²: a radar measures the velocity along
/// the line of sight by Doppler and guesses the one across it; for a camera it is the other way
/// round.
fn velocity_variances(sensor: SensorId, x: f32, y: f32) -> (f32, f32) {
    let (radial, tangential) = match sensor {
        SensorId::RadarFront => (0.12, 0.6),
        SensorId::CameraFront => (0.8, 0.4),
        _ => (0.17, 0.7),
    };
    let (radial, tangential) = (radial * radial, tangential * tangential);
    let share = x * x / max(x * x + y * y, 0.1);
    (
        lerp(tangential, radial, share),
        lerp(radial, tangential, share),
    )
}

/// A pair of track and detection within the gate.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Match {
    x: Innovation,
    y: Innovation,
}

impl Match {
    /// Negative logarithm of the likelihood, without constants.
    pub(crate) fn cost(&self) -> f32 {
        let volume = max(self.x.determinant * self.y.determinant, 1e-12);
        self.x.distance + self.y.distance + libm::logf(volume)
    }
}

/// Time that passes for all tracks, while the vehicle moves.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Passage {
    dt: f32,
    along: Span,
    across: Span,
    /// The vehicle's pose at the end, as seen from its pose at the start.
    axes: Axes,
}

impl Passage {
    /// A passage of `dt` seconds in which the vehicle moves by `step`.
    pub(crate) fn new(dt: f32, step: &EgoPose) -> Self {
        Self {
            dt,
            along: ALONG.over(dt),
            across: ACROSS.over(dt),
            axes: step.axes(),
        }
    }
}

/// A tracked object.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Track {
    pub(crate) id: u32,
    pub(crate) x: Axis,
    pub(crate) y: Axis,
    pub(crate) class: ClassCode,
    pub(crate) length: f32,
    pub(crate) width: f32,
    pub(crate) confirmed: bool,
    /// Cycles in a row in which it moved into the ego lane.
    pub(crate) approaching: u8,
    hits: u16,
    sensors: u8,
    unseen_s: f32,
    /// Another system has tracked it: this system's first detection confirms it.
    received: bool,
}

impl Track {
    pub(crate) fn new(id: u32, detection: &Detection) -> Self {
        let mut track = Self {
            id,
            x: Axis::new(&detection.x),
            y: Axis::new(&detection.y),
            class: ClassCode::Unknown,
            length: if detection.length > 0.3 {
                detection.length
            } else {
                4.5
            },
            width: if detection.width > 0.3 {
                detection.width
            } else {
                1.8
            },
            confirmed: false,
            approaching: 0,
            hits: 0,
            sensors: 0,
            unseen_s: 0.0,
            received: false,
        };
        track.seen(detection);
        track
    }

    /// A track that another system sent, `dt` seconds old; the vehicle has moved by `step` since.
    pub(crate) fn received(id: u32, known: &Known, dt: f32, step: &EgoPose) -> Self {
        let mut track = Self {
            id,
            x: Axis::received(known.x, &ALONG_SETTLED),
            y: Axis::received(known.y, &ACROSS_SETTLED),
            class: known.class,
            length: known.length,
            width: known.width,
            confirmed: false,
            approaching: known.approaching,
            hits: 0,
            sensors: 0,
            unseen_s: 0.0,
            received: true,
        };
        track.predict(&Passage::new(dt, step));
        track.unseen_s = 0.0;
        track
    }

    /// Called if another system has tracked this object for longer: its track, `dt` seconds old,
    /// becomes the prediction that newer detections correct. Works once, and only if these fit.
    pub(crate) fn recall(&mut self, known: &Self, dt: f32) {
        if self.received && self.hits > 0 {
            return;
        }
        let (mut x, mut y) = (known.x, known.y);
        if self.hits > 0 {
            let own = (self.x.measured(), self.y.measured());
            let fit = (x.innovation(&own.0), y.innovation(&own.1));
            if fit.0.distance + fit.1.distance >= GATE {
                return;
            }
            // Older detections are part of the other system's track, so they must not count twice.
            if self.unseen_s < dt {
                x.update(&fit.0);
                y.update(&fit.1);
            }
            self.confirmed = true;
        }
        let class = match self.class {
            ClassCode::Unknown => known.class,
            own => own,
        };
        *self = Self {
            x,
            y,
            class,
            length: known.length,
            width: known.width,
            approaching: max_of(self.approaching, known.approaching),
            received: true,
            ..*self
        };
    }

    /// Moves the object by this passage, into the frame of the vehicle at its end.
    pub(crate) fn predict(&mut self, passage: &Passage) {
        self.x.predict(&passage.along);
        self.y.predict(&passage.across);
        self.unseen_s += passage.dt;
        let Passage { axes, .. } = passage;
        let (x, y) = axes.to_local(self.x.position(), self.y.position());
        let (vx, vy) = axes.turn(self.x.velocity(), self.y.velocity());
        let (ax, ay) = axes.turn(self.x.acceleration(), self.y.acceleration());
        self.x.set(x, vx, ax);
        self.y.set(y, vy, ay);
    }

    /// Returns how the detection fits, if it lies within the gate.
    pub(crate) fn fit(&self, detection: &Detection) -> Option<Match> {
        if abs(detection.x.position - self.x.position()) > MAX_JUMP_X_M
            || abs(detection.y.position - self.y.position()) > MAX_JUMP_Y_M
        {
            return None;
        }
        let x = self.x.innovation(&detection.x);
        let y = self.y.innovation(&detection.y);
        (x.distance + y.distance < GATE).then_some(Match { x, y })
    }

    /// Updates the track with the detection.
    pub(crate) fn update(&mut self, fit: &Match, detection: &Detection) {
        self.x.update(&fit.x);
        self.y.update(&fit.y);
        self.seen(detection);
    }

    fn seen(&mut self, detection: &Detection) {
        self.hits = self.hits.saturating_add(1);
        self.sensors |= 1 << detection.sensor.index();
        self.unseen_s = 0.0;
        self.confirmed |= self.received
            || self.hits >= CONFIRMING_HITS
            || self.sensors.count_ones() >= CONFIRMING_SENSORS;
        if detection.class != ClassCode::Unknown {
            self.class = detection.class;
        }
        if detection.length > 0.3 {
            self.length = lerp(self.length, detection.length, 0.2);
        }
        if detection.width > 0.3 {
            self.width = lerp(self.width, detection.width, 0.2);
        }
    }

    /// Returns whether the track ends, because no sensor has seen it for too long.
    pub(crate) fn is_lost(&self) -> bool {
        let beside = abs(self.x.position()) < 8.0 && abs(self.y.position()) < 8.0;
        let patience = match (self.confirmed, beside) {
            (false, _) => TENTATIVE_COAST_S,
            (true, _) if self.may_be_hidden() => HIDDEN_COAST_S,
            (true, false) => COAST_S,
            (true, true) => BESIDE_COAST_S,
        };
        self.unseen_s > patience
    }

    /// Returns whether it may be where no radar sees it, as far as its place is known: beside the
    /// vehicle, and so small that it fits there.
    fn may_be_hidden(&self) -> bool {
        let (along, aside) = HIDDEN_M;
        let y = abs(self.y.position());
        let half = along * (1.0 - y / aside);
        let fits = 0.5 * (1.0 - SEEN_SHARE) * self.length < half && y > 0.5 * WIDTH_M;
        fits && abs(self.x.position()) < half + min(self.x.deviation(), HIDDEN_DEVIATION_M)
    }

    /// Returns whether both tracks are the same object: two vehicles cannot be in one place.
    pub(crate) fn is_same(&self, other: &Self) -> bool {
        let reach = clamp(0.6 * max(self.length, other.length), 1.0, 6.0);
        let width = clamp(0.7 * max(self.width, other.width), 0.6, 1.6);
        abs(self.x.position() - other.x.position()) < reach
            && abs(self.y.position() - other.y.position()) < width
            && abs(self.x.velocity() - other.x.velocity()) < 4.0
    }

    /// Returns whether this track is to be kept rather than `other`, which is the same object.
    pub(crate) fn is_better_than(&self, other: &Self) -> bool {
        (self.confirmed, self.hits, other.id) > (other.confirmed, other.hits, self.id)
    }

    /// Takes over the data of the duplicate. If only the duplicate was seen in this round, the
    /// object has left this track's gate by a sudden manoeuvre: it continues from the duplicate.
    pub(crate) fn absorb(&mut self, double: &Self) {
        if self.unseen_s > double.unseen_s + ROUND_S {
            (self.x, self.y) = (double.x, double.y);
        }
        self.sensors |= double.sensors;
        self.hits = self.hits.saturating_add(double.hits);
        self.confirmed |= double.confirmed || self.sensors.count_ones() >= CONFIRMING_SENSORS;
        self.unseen_s = min(self.unseen_s, double.unseen_s);
        if self.class == ClassCode::Unknown {
            self.class = double.class;
        }
    }
}

const fn max_of(a: u8, b: u8) -> u8 {
    if a > b { a } else { b }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn seen(vx: f32) -> Detection {
        let object = SensorObject {
            x: 50.0,
            vx,
            x_deviation: 0.2,
            y_deviation: 0.2,
            ..SensorObject::default()
        };
        Detection::new(SensorId::RadarFront, &object, &Ego::default())
    }

    /// A road user that no radar sees stays in the scene while it fits into the triangle between
    /// the fields of view: 10 s abreast, 2 s beside it, 0.8 s far away.
    #[test]
    fn a_track_stays_where_no_radar_sees() {
        let unseen_s = |length: f32, x: f32, y: f32| {
            let object = SensorObject {
                x,
                y,
                length,
                width: 0.6,
                x_deviation: 0.2,
                y_deviation: 0.2,
                ..SensorObject::default()
            };
            let seen = Detection::new(SensorId::RadarRearLeft, &object, &Ego::default());
            let mut track = Track::new(1, &seen);
            track.confirmed = true;
            let passage = Passage::new(0.05, &EgoPose::default());
            let mut cycles = 0.0;
            while !track.is_lost() {
                track.predict(&passage);
                cycles += 1.0;
            }
            0.05 * cycles
        };
        for (length, x, y, expected_s) in [
            (0.6, 0.0, 2.0, 10.0),
            (1.8, -0.5, -2.0, 10.0),
            (0.6, 0.0, 5.0, 2.0),
            (0.6, 0.0, 20.0, 0.8),
            // A car is too long; within the vehicle there is no place; the front radar sees ahead.
            (4.5, 0.0, 2.0, 2.0),
            (0.6, 0.3, 0.5, 2.0),
            (0.6, 4.5, 0.0, 2.0),
        ] {
            let lasted_s = unseen_s(length, x, y);
            assert!(
                abs(lasted_s - expected_s) < 0.11,
                "{length} {x} {y}: {lasted_s}"
            );
        }
    }

    /// A vehicle brakes so hard that its detections leave the gate of its track. They begin another
    /// track at the same place: the confirmed one continues from it and keeps its identity.
    #[test]
    fn a_track_continues_from_detections_that_left_its_gate() {
        let step = EgoPose::default();
        for (passed_s, speed) in [(0.05, -2.0), (0.01, 0.0)] {
            let mut track = Track::new(1, &seen(0.0));
            track.predict(&Passage::new(passed_s, &step));
            let double = Track::new(2, &seen(-2.0));
            assert!(track.fit(&seen(-2.0)).is_none() && track.is_same(&double));
            track.absorb(&double);
            assert_eq!((track.id, track.x.velocity()), (1, speed));
        }
    }
}
