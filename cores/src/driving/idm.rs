//! Intelligent Driver Model: how a good driver keeps speed and distance.
//!
//! M. Treiber, A. Hennecke, D. Helbing, "Congested traffic states in empirical observations and
//! microscopic simulations", Phys. Rev. E 62 (2000), in the improved form of M. Treiber, A.
//! Kesting, "Traffic Flow Dynamics", 2nd ed., section 12.4 (IIDM): the steady gap does not shrink
//! near the desired speed, and the reaction above it is bounded. [`adaptive`] is its extension to a
//! cruise control that stays calm when a gap is short but not dangerous: A. Kesting, M. Treiber, D.
//! Helbing, "Enhanced Intelligent Driver Model to Access the Impact of Driving Strategies on
//! Traffic Capacity", Phil. Trans. R. Soc. A 368 (2010).

use super::math::{clamp, exp, max, min, sqrt};

/// The request of the driver.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Driver {
    /// m/s
    pub(crate) desired_speed: f32,
    /// s
    pub(crate) time_gap: f32,
    /// Bumper to bumper at standstill, m.
    pub(crate) standstill_gap: f32,
    /// m/s²
    pub(crate) max_acceleration: f32,
    /// Deceleration that is still comfortable, m/s², positive.
    pub(crate) comfortable_braking: f32,
}

/// The vehicle, or the end of the lane, to which a distance is kept.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Leader {
    /// Bumper to bumper, m.
    pub(crate) gap: f32,
    /// Along the road, m/s.
    pub(crate) speed: f32,
}

/// The strongest braking that the model returns, m/s².
pub(crate) const MAX_BRAKING: f32 = 9.0;

/// The coolness factor of the cruise control: 0 is the plain model, 1 trusts the leader not to
/// brake suddenly.
const COOLNESS: f32 = 0.99;

/// Acceleration in m/s² of a cruise control behind a leader with this acceleration in m/s².
pub(crate) fn adaptive(
    driver: &Driver,
    speed: f32,
    leader: Leader,
    leader_acceleration: f32,
) -> f32 {
    let plain = acceleration(driver, speed, Some(leader));
    let constant = constant_acceleration(driver, speed, leader, leader_acceleration);
    if plain >= constant {
        return plain;
    }
    let braking = driver.comfortable_braking;
    let calm = constant + braking * tanh((plain - constant) / braking);
    clamp(
        (1.0 - COOLNESS) * plain + COOLNESS * calm,
        -MAX_BRAKING,
        driver.max_acceleration,
    )
}

/// Returns the acceleration that avoids a collision if both vehicles then keep their accelerations.
fn constant_acceleration(driver: &Driver, speed: f32, leader: Leader, accelerates: f32) -> f32 {
    let gap = max(leader.gap, 0.1);
    let accelerates = min(accelerates, driver.max_acceleration);
    let closing = speed - leader.speed;
    // Excludes a standing leader, for which both sides are zero.
    if leader.speed * closing < -2.0 * gap * accelerates {
        let divisor = leader.speed * leader.speed - 2.0 * gap * accelerates;
        return speed * speed * accelerates / max(divisor, 0.01);
    }
    let closing = max(closing, 0.0);
    accelerates - closing * closing / (2.0 * gap)
}

fn tanh(x: f32) -> f32 {
    let e = exp(2.0 * clamp(x, -10.0, 10.0));
    (e - 1.0) / (e + 1.0)
}

/// Acceleration in m/s².
pub(crate) fn acceleration(driver: &Driver, speed: f32, leader: Option<Leader>) -> f32 {
    let free = free_acceleration(driver, speed);
    let Some(leader) = leader else { return free };
    let gap = max(leader.gap, 0.1);
    let ratio = desired_gap(driver, speed, leader.speed) / gap;
    let wish = driver.max_acceleration * (1.0 - ratio * ratio);
    let combined = if ratio >= 1.0 {
        min(wish, free)
    } else if free > 0.0 {
        // Near the desired gap the interaction takes over smoothly from the free acceleration.
        let power = 2.0 * driver.max_acceleration / max(free, 0.05);
        free * (1.0 - libm::powf(ratio, clamp(power, 2.0, 40.0)))
    } else {
        free
    };
    clamp(combined, -MAX_BRAKING, driver.max_acceleration)
}

/// Returns the gap that the driver wants at this speed behind a leader with that speed, m.
pub(crate) fn desired_gap(driver: &Driver, speed: f32, leader_speed: f32) -> f32 {
    let closing = speed - leader_speed;
    let comfort = 2.0 * sqrt(driver.max_acceleration * driver.comfortable_braking);
    driver.standstill_gap + max(0.0, speed * driver.time_gap + speed * closing / comfort)
}

fn free_acceleration(driver: &Driver, speed: f32) -> f32 {
    let desired = max(driver.desired_speed, 0.1);
    let ratio = speed / desired;
    if ratio <= 1.0 {
        let squared = ratio * ratio;
        driver.max_acceleration * (1.0 - squared * squared)
    } else {
        // Above the desired speed it slows down gently, in proportion to the excess.
        max(-driver.comfortable_braking, -0.4 * (speed - desired))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const DRIVER: Driver = Driver {
        desired_speed: 30.0,
        time_gap: 1.5,
        standstill_gap: 3.0,
        max_acceleration: 1.5,
        comfortable_braking: 2.0,
    };

    #[test]
    fn settles_at_the_desired_gap() {
        let (mut gap, mut speed) = (80.0_f32, 28.0_f32);
        for _ in 0..20_000 {
            let leader = Leader { gap, speed: 20.0 };
            let a = acceleration(&DRIVER, speed, Some(leader));
            speed = (speed + a * 0.01).max(0.0);
            gap += (20.0 - speed) * 0.01;
            assert!(gap > 2.0);
        }
        assert!((gap - 33.0).abs() < 1.0, "{gap}");
        assert!((speed - 20.0).abs() < 0.05);
    }

    #[test]
    fn stops_before_an_obstacle() {
        let (mut gap, mut speed) = (150.0_f32, 30.0_f32);
        let mut hardest: f32 = 0.0;
        for _ in 0..6_000 {
            let a = acceleration(&DRIVER, speed, Some(Leader { gap, speed: 0.0 }));
            hardest = hardest.min(a);
            speed = (speed + a * 0.01).max(0.0);
            gap -= speed * 0.01;
        }
        assert!(speed < 0.1 && gap > 1.0, "{speed} {gap}");
        assert!(hardest > -5.0, "{hardest}");
    }

    #[test]
    fn a_short_gap_without_danger_is_met_calmly() {
        let leader = Leader {
            gap: 8.0,
            speed: 10.0,
        };
        assert!(acceleration(&DRIVER, 10.0, Some(leader)) < -4.0);
        let calm = adaptive(&DRIVER, 10.0, leader, 0.0);
        assert!((-2.1..-0.3).contains(&calm), "{calm}");
        // In real danger, it brakes as hard as needed.
        let hard = adaptive(
            &DRIVER,
            20.0,
            Leader {
                gap: 12.0,
                speed: 10.0,
            },
            -3.0,
        );
        assert!(hard < -6.0, "{hard}");
        let stands = Leader {
            gap: 25.0,
            speed: 0.0,
        };
        let hard = adaptive(&DRIVER, 20.0, stands, 0.0);
        assert!(hard < -6.0, "what stands: {hard}");
    }

    #[test]
    fn slows_down_gently_above_the_desired_speed() {
        let a = acceleration(&DRIVER, 40.0, None);
        assert!((-2.0..0.0).contains(&a), "{a}");
    }
}
