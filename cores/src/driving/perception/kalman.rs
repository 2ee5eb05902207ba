//! Kalman filter of one axis of a moving object: position, velocity, acceleration.
//!
//! The acceleration fades with a time constant, driven by white noise: R. A. Singer, "Estimating
//! Optimal Tracking Filter Performance for Manned Maneuvering Targets", IEEE Trans. AES-6 (1970).

use nalgebra::{Matrix2, Matrix2x3, Matrix3, Vector2, Vector3};

use crate::driving::math::{exp, sqrt};

/// How an axis moves between measurements.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Motion {
    /// Density of the noise that drives the acceleration, (m/s²)²/s.
    pub(crate) acceleration_noise: f32,
    /// Time constant with which an acceleration fades, s.
    pub(crate) fading_s: f32,
}

/// The effect of a span of time on each axis that moves in the same way.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Span {
    dt: f32,
    /// The share of an acceleration that remains at the end of the span.
    fade: f32,
    noise: Matrix3<f32>,
}

impl Motion {
    /// Returns the effect of `dt` seconds.
    pub(crate) fn over(&self, dt: f32) -> Span {
        let q = self.acceleration_noise * dt;
        let (q1, q2) = (q * dt, q * dt * dt);
        #[rustfmt::skip]
        let noise = Matrix3::new(
            q2 * dt * dt / 20.0, q2 * dt / 8.0, q2 / 6.0,
            q2 * dt / 8.0, q2 / 3.0, q1 / 2.0,
            q2 / 6.0, q1 / 2.0, q,
        );
        Span {
            dt,
            fade: exp(-dt / self.fading_s),
            noise,
        }
    }
}

impl Span {
    /// Returns position, velocity and acceleration at the end of the span.
    fn end(&self, begin: Vector3<f32>) -> Vector3<f32> {
        let Self { dt, fade, .. } = *self;
        let [position, velocity, acceleration] = begin.into();
        Vector3::new(
            position + dt * velocity + 0.5 * dt * dt * acceleration,
            velocity + dt * acceleration,
            fade * acceleration,
        )
    }

    /// [`Span::end`] of each column.
    fn end_of_each(&self, columns: &Matrix3<f32>) -> Matrix3<f32> {
        let end = |index| self.end(columns.column(index).into_owned());
        Matrix3::from_columns(&[end(0), end(1), end(2)])
    }
}

/// Variances of a filter that has settled, in SI units, and the covariance of velocity and
/// acceleration. With noise of density q that drives the acceleration, and measured velocities of
/// variance r each second, the variances are √2 q^¼ r^¾ and √2 q^¾ r^¼, and the covariance is
/// √(q r).
#[derive(Clone, Copy, Debug)]
pub(crate) struct Settled {
    pub(crate) position: f32,
    pub(crate) velocity: f32,
    pub(crate) acceleration: f32,
    pub(crate) both: f32,
}

/// A measurement of position and velocity with their variances.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Measured {
    pub(crate) position: f32,
    pub(crate) velocity: f32,
    pub(crate) position_variance: f32,
    pub(crate) velocity_variance: f32,
}

/// The difference of a measurement from its prediction.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Innovation {
    residual: Vector2<f32>,
    inverse: Matrix2<f32>,
    /// Determinant of the residual's covariance.
    pub(crate) determinant: f32,
    /// Squared Mahalanobis distance.
    pub(crate) distance: f32,
}

/// State and covariance of one axis.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Axis {
    pub(crate) state: Vector3<f32>,
    covariance: Matrix3<f32>,
}

/// Variance of the acceleration of an object that was never seen before, (m/s²)².
const FIRST_ACCELERATION_VARIANCE: f32 = 2.0;
/// Without measurements a covariance grows only to this limit.
const MAX_VARIANCE: f32 = 400.0;

impl Axis {
    pub(crate) fn new(measured: &Measured) -> Self {
        Self {
            state: Vector3::new(measured.position, measured.velocity, 0.0),
            covariance: Matrix3::from_diagonal(&Vector3::new(
                measured.position_variance,
                measured.velocity_variance,
                FIRST_ACCELERATION_VARIANCE,
            )),
        }
    }

    /// An axis that another system has tracked.
    pub(crate) fn received(state: [f32; 3], settled: &Settled) -> Self {
        let Settled {
            position,
            velocity,
            acceleration,
            both,
        } = *settled;
        #[rustfmt::skip]
        let covariance = Matrix3::new(
            position, 0.0, 0.0,
            0.0, velocity, both,
            0.0, both, acceleration,
        );
        Self {
            state: Vector3::from(state),
            covariance,
        }
    }

    /// Returns this axis as a measurement, for an independent filter.
    pub(crate) fn measured(&self) -> Measured {
        Measured {
            position: self.state.x,
            velocity: self.state.y,
            position_variance: self.covariance.m11,
            velocity_variance: self.covariance.m22,
        }
    }

    pub(crate) fn position(&self) -> f32 {
        self.state.x
    }

    /// Returns the standard deviation of the position.
    pub(crate) fn deviation(&self) -> f32 {
        sqrt(self.covariance.m11)
    }

    pub(crate) fn velocity(&self) -> f32 {
        self.state.y
    }

    pub(crate) fn acceleration(&self) -> f32 {
        self.state.z
    }

    pub(crate) fn predict(&mut self, span: &Span) {
        self.state = span.end(self.state);
        if self.covariance.m11 > MAX_VARIANCE {
            return;
        }
        // First the rows, then the columns.
        let half = span.end_of_each(&self.covariance).transpose();
        self.covariance = span.end_of_each(&half).transpose() + span.noise;
    }

    pub(crate) fn innovation(&self, measured: &Measured) -> Innovation {
        let residual = Vector2::new(
            measured.position - self.state.x,
            measured.velocity - self.state.y,
        );
        let p = &self.covariance;
        let a = p.m11 + measured.position_variance;
        let b = p.m12;
        let d = p.m22 + measured.velocity_variance;
        let determinant = a * d - b * b;
        let inverse = Matrix2::new(d, -b, -b, a) / determinant;
        let distance = (residual.transpose() * inverse * residual).x;
        Innovation {
            residual,
            inverse,
            determinant,
            distance,
        }
    }

    pub(crate) fn update(&mut self, innovation: &Innovation) {
        let p = &self.covariance;
        let cross = Matrix2x3::new(p.m11, p.m12, p.m13, p.m21, p.m22, p.m23).transpose();
        let gain = cross * innovation.inverse;
        self.state += gain * innovation.residual;
        let covariance = self.covariance - gain * cross.transpose();
        // Rounding must not make the covariance asymmetric.
        self.covariance = (covariance + covariance.transpose()) * 0.5;
    }

    /// Changes the state but not the covariance: for the turn and move of the frame.
    pub(crate) fn set(&mut self, position: f32, velocity: f32, acceleration: f32) {
        self.state = Vector3::new(position, velocity, acceleration);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    impl Axis {
        fn position_variance(&self) -> f32 {
            self.covariance.m11
        }
    }

    const MOTION: Motion = Motion {
        acceleration_noise: 8.0,
        fading_s: 2.0,
    };

    fn measured(position: f32, velocity: f32) -> Measured {
        Measured {
            position,
            velocity,
            position_variance: 0.09,
            velocity_variance: 0.04,
        }
    }

    #[test]
    fn finds_the_acceleration_of_a_braking_object() {
        let mut axis = Axis::new(&measured(50.0, 20.0));
        for step in 1..=20 {
            let t = step as f32 * 0.05;
            axis.predict(&MOTION.over(0.05));
            let z = measured(50.0 + 20.0 * t - 3.0 * t * t, 20.0 - 6.0 * t);
            let innovation = axis.innovation(&z);
            assert!(innovation.distance < 9.2, "{step}: {}", innovation.distance);
            axis.update(&innovation);
        }
        assert!(
            (axis.acceleration() + 6.0).abs() < 1.0,
            "{}",
            axis.acceleration()
        );
        assert!((axis.velocity() - 14.0).abs() < 0.3);
        assert!((axis.position() - 67.0).abs() < 0.2);
    }

    #[test]
    fn covariance_shrinks_with_measurements_and_grows_without() {
        let mut axis = Axis::new(&measured(0.0, 0.0));
        for _ in 0..40 {
            axis.predict(&MOTION.over(0.05));
            axis.update(&axis.innovation(&measured(0.0, 0.0)));
        }
        let settled = axis.position_variance();
        assert!(settled < 0.05);
        for _ in 0..20 {
            axis.predict(&MOTION.over(0.05));
        }
        assert!(axis.position_variance() > 2.0 * settled);
        for _ in 0..100_000 {
            axis.predict(&MOTION.over(0.05));
        }
        assert!(axis.position_variance().is_finite());
    }
}
