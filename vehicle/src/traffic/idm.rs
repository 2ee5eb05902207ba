//! Car-following: the Intelligent Driver Model in a variant for real traffic.
//!
//! Base: Treiber, Hennecke, Helbing, "Congested traffic states in empirical observations and
//! microscopic simulations", Phys. Rev. E 62 (2000). Adds the improved free term and the "constant
//! acceleration heuristic" of Kesting, Treiber, Helbing, "Enhanced Intelligent Driver Model to
//! assess the impact of adaptive cruise control", Phil. Trans. R. Soc. A 368 (2010): when a vehicle
//! cuts in, the base model brakes as in an emergency, although human drivers see that gentle
//! braking is enough.

/// Share of the heuristic in the model ("coolness"); the published value.
const COOLNESS: f64 = 0.99;
/// Hardest braking, m/s².
const DECELERATION_MAX: f64 = 9.0;

/// The next object ahead in the lane.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Leader {
    /// Bumper to bumper, m; infinite on a free road.
    pub gap: f64,
    /// m/s
    pub speed: f64,
    /// m/s²
    pub acceleration: f64,
}

impl Leader {
    /// No vehicle ahead.
    pub const NONE: Self = Self {
        gap: f64::INFINITY,
        speed: 0.0,
        acceleration: 0.0,
    };

    /// A standing object at this distance, m.
    #[must_use]
    pub const fn standing(gap: f64) -> Self {
        Self { gap, ..Self::NONE }
    }
}

/// One driver's parameters.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct IdmParameters {
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

impl IdmParameters {
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

    /// Returns the acceleration that this driver chooses at `speed` (m/s), in m/s², not below -9.
    #[must_use]
    pub fn follow(&self, speed: f64, leader: &Leader) -> f64 {
        let careful = self.improved(speed, leader);
        if !leader.gap.is_finite() {
            return careful;
        }
        let calm = self.constant_acceleration(speed, leader);
        let chosen = if careful >= calm {
            careful
        } else {
            let blend = calm + self.deceleration * ((careful - calm) / self.deceleration).tanh();
            (1.0 - COOLNESS) * careful + COOLNESS * blend
        };
        chosen.max(-DECELERATION_MAX)
    }

    /// Returns the acceleration with a free term that keeps the desired gap at the desired speed.
    fn improved(&self, speed: f64, leader: &Leader) -> f64 {
        let (a, b) = (self.acceleration, self.deceleration);
        let ratio = speed / self.desired_speed.max(0.1);
        let free = if ratio <= 1.0 {
            a * (1.0 - ratio.powi(4))
        } else {
            -b * (1.0 - ratio.powf(-a * 4.0 / b))
        };
        let closing = speed * (speed - leader.speed) / (2.0 * (a * b).sqrt());
        let wanted = self.standstill_gap + (speed * self.time_gap + closing).max(0.0);
        // Zero on a free road.
        let tight = wanted / leader.gap.max(0.1);
        if tight >= 1.0 {
            a * (1.0 - tight * tight) + free.min(0.0)
        } else if ratio <= 1.0 && free > 1e-6 {
            free * (1.0 - tight.powf(2.0 * a / free))
        } else {
            free.min(0.0)
        }
    }

    /// Returns the acceleration that just avoids a collision if the leader's does not change.
    fn constant_acceleration(&self, speed: f64, leader: &Leader) -> f64 {
        let gap = leader.gap.max(0.1);
        let ahead = leader.acceleration.min(self.acceleration);
        let closing = speed - leader.speed;
        if leader.speed * closing <= -2.0 * gap * ahead && ahead < 0.0 {
            speed * speed * ahead / (leader.speed * leader.speed - 2.0 * gap * ahead)
        } else {
            ahead - closing.max(0.0).powi(2) / (2.0 * gap)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Drives 300 s behind a leader whose speed is `leader(t)`. Returns the smallest gap, the final
    /// one, and the hardest braking.
    fn drive(mut gap: f64, leader: impl Fn(f64) -> f64) -> (f64, f64, f64) {
        let (mut speed, mut smallest, mut hardest) = (leader(0.0), f64::INFINITY, 0.0_f64);
        for step in 0..30_000 {
            let t = f64::from(step) * 0.01;
            let acceleration = (leader(t + 0.01) - leader(t)) / 0.01;
            let leader = Leader {
                gap,
                speed: leader(t),
                acceleration,
            };
            let chosen = IdmParameters::CAR.follow(speed, &leader);
            hardest = hardest.min(chosen);
            speed = (speed + chosen * 0.01).max(0.0);
            gap += (leader.speed - speed) * 0.01;
            smallest = gap.min(smallest);
        }
        (smallest, gap, hardest)
    }

    #[test]
    fn it_stops_behind_a_leader_that_brakes_hard() {
        for brake in [2.0, 4.0, 7.0, 8.5] {
            let (smallest, _, hardest) =
                drive(32.0, |t| (25.0 - brake * (t - 20.0).max(0.0)).max(0.0));
            assert!(smallest > 1.0, "{brake}: {smallest} {hardest}");
        }
    }

    #[test]
    fn it_settles_at_the_desired_gap() {
        let (_, settled, _) = drive(60.0, |_| 20.0);
        assert!((settled - (2.0 + 20.0 * 1.2)).abs() < 0.5, "{settled}");
        let (smallest, _, hardest) = drive(34.0, |_| 30.0);
        assert!(
            smallest > 33.0 && hardest > -0.5,
            "at its desired speed it stays where it is"
        );
    }

    #[test]
    fn it_stays_calm_when_somebody_cuts_in_at_equal_speed() {
        let cut_in = Leader {
            gap: 12.0,
            speed: 28.0,
            acceleration: 0.0,
        };
        let braking = IdmParameters::CAR.follow(28.0, &cut_in);
        assert!((-2.5..-1.0).contains(&braking), "{braking}");
    }

    #[test]
    fn on_a_free_road_it_reaches_its_desired_speed() {
        for start in [0.0, 45.0] {
            let mut speed = start;
            for _ in 0..20_000 {
                speed += IdmParameters::CAR.follow(speed, &Leader::NONE) * 0.01;
            }
            assert!((speed - 30.0).abs() < 0.1, "{speed}");
        }
    }
}
