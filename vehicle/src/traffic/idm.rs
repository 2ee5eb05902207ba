//! Car-following: the Intelligent Driver Model (Treiber, Hennecke, Helbing, "Congested traffic states
//! in empirical observations and microscopic simulations", Phys. Rev. E 62, 2000).

/// One driver's parameters.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Driver {
    /// Desired speed on a free road, m/s.
    pub desired_speed: f64,
    /// Desired time gap, s.
    pub time_gap: f64,
    /// Gap at standstill, m.
    pub standstill_gap: f64,
    /// Acceleration on a free road from standstill, m/s².
    pub acceleration: f64,
    /// Comfortable deceleration, m/s².
    pub deceleration: f64,
}

impl Driver {
    /// A car's driver.
    pub const CAR: Self = Self {
        desired_speed: 30.0,
        time_gap: 1.2,
        standstill_gap: 2.0,
        acceleration: 1.4,
        deceleration: 2.0,
    };
    /// A truck's driver.
    pub const TRUCK: Self = Self {
        time_gap: 1.6,
        acceleration: 0.8,
        ..Self::CAR
    };

    /// Acceleration at `speed` behind a leader with `leader_speed` at a bumper distance of `gap`
    /// (m/s, m); `gap` is infinite on a free road. Not below -8 m/s².
    #[must_use]
    pub fn follow(&self, speed: f64, gap: f64, leader_speed: f64) -> f64 {
        let brake = 2.0 * (self.acceleration * self.deceleration).sqrt();
        let dynamic = speed * self.time_gap + speed * (speed - leader_speed) / brake;
        let wanted = self.standstill_gap + dynamic.max(0.0);
        let free = 1.0 - (speed / self.desired_speed.max(0.1)).powi(4);
        let close = if gap.is_finite() {
            (wanted / gap.max(0.1)).powi(2)
        } else {
            0.0
        };
        // Above the desired speed the free term alone would brake without bound.
        (self.acceleration * (free.max(-2.0) - close)).max(-8.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Drives 300 s behind a leader whose speed is `leader(t)`; the smallest gap.
    fn smallest_gap(leader: impl Fn(f64) -> f64) -> f64 {
        let (mut gap, mut speed, mut smallest) = (40.0, leader(0.0), f64::INFINITY);
        for step in 0..30_000 {
            let ahead = leader(f64::from(step) * 0.01);
            speed = (speed + Driver::CAR.follow(speed, gap, ahead) * 0.01).max(0.0);
            gap += (ahead - speed) * 0.01;
            smallest = gap.min(smallest);
        }
        smallest
    }

    #[test]
    fn it_stops_behind_a_leader_that_brakes_hard_and_settles_at_the_desired_gap() {
        assert!(smallest_gap(|t| (25.0 - 7.0 * (t - 20.0).max(0.0)).max(0.0)) > 1.0);
        let settled = 2.0 + 20.0 * 1.2;
        let free = (1.0_f64 - (20.0_f64 / 30.0).powi(4)).sqrt();
        assert!((smallest_gap(|_| 20.0) - settled / free).abs() < 0.1);
    }

    #[test]
    fn on_a_free_road_it_reaches_its_desired_speed() {
        let mut speed = 0.0;
        for _ in 0..10_000 {
            speed += Driver::CAR.follow(speed, f64::INFINITY, 0.0) * 0.01;
        }
        assert!((speed - 30.0).abs() < 0.1, "{speed}");
    }
}
