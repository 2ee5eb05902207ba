//! The plain search: every candidate in order, every step of it, and nothing left out.

extern crate std;

use super::*;
use proptest::prelude::*;
use std::{format, vec, vec::Vec};

/// Returns all candidates from this start, in the order in which the first of equal ones wins.
fn all(start: &Jet, desired_speed: f32) -> Vec<Profile> {
    let mut all = vec![];
    for duration in DURATIONS_S {
        let changed = SPEED_CHANGES.iter().map(|change| start.first + change);
        let moving = changed.filter(|speed| *speed > 0.0);
        let speeds = moving.map(|speed| min(speed, 60.0));
        let speeds = speeds.chain([0.0, desired_speed]);
        all.extend(speeds.map(|speed| Profile::Keep(Quartic::new(start, speed, duration))));
    }
    let smooth = SMOOTH_BRAKINGS.map(|braking| (braking, RAMP_JERK));
    let hard = EMERGENCY_BRAKINGS.map(|braking| (braking, EMERGENCY_JERK));
    for (braking, jerk) in smooth.into_iter().chain(hard) {
        let ramp = Ramp::new(start.first, start.second, braking, jerk);
        all.push(Profile::Brake(ramp));
    }
    all
}

/// Returns cost and danger of a motion; `None` if it is impossible.
fn cost(profile: &Profile, corridor: &Corridor) -> Option<(f32, f32)> {
    let (mut cost, mut of_danger) = (0.0, 0.0);
    for step in 0..STEPS {
        let motion = profile.at((step + 1) as f32 * STEP_S);
        let hardest = match profile {
            Profile::Keep(_) => MAX_BRAKING,
            Profile::Brake(_) => EMERGENCY_BRAKING + 0.5,
        };
        let keeps = matches!(profile, Profile::Keep(_));
        let too_fast = keeps && motion.second > MAX_ACCELERATION;
        if motion.first < -0.05 || motion.second < -hardest || too_fast {
            return None;
        }
        let error = abs(motion.first - corridor.target_speed(step, &motion));
        let error = if error < SPEED_ERROR_KNEE {
            error * error
        } else {
            SPEED_ERROR_KNEE * (2.0 * error - SPEED_ERROR_KNEE)
        };
        let danger = STEP_S * corridor.danger(step, &motion);
        let comfort = STEP_S
            * (WEIGHT_JERK * motion.third * motion.third
                + WEIGHT_ACCELERATION * motion.second * motion.second
                + WEIGHT_SPEED * error
                + corridor.margin(step, &motion));
        (cost, of_danger) = (cost + (danger + comfort), of_danger + danger);
    }
    cost.is_finite().then_some((cost, of_danger))
}

/// Returns the first of the cheapest with this manner, with its cost and its danger.
fn first(start: &Jet, corridor: &Corridor, manner: Manner) -> (Profile, f32, f32) {
    let mut best = (Profile::emergency(start), f32::INFINITY, f32::INFINITY);
    for profile in all(start, corridor.desired[STEPS / 2]) {
        if profile.manner(start.second) == manner
            && let Some((cost, danger)) = cost(&profile, corridor)
            && cost < best.1
        {
            best = (profile, cost, danger);
        }
    }
    best
}

fn plain(start: &Jet, corridor: &Corridor) -> (Profile, Manner) {
    let of = |manner| first(start, corridor, manner);
    let comfortable = of(Manner::Comfortable);
    if comfortable.2 < TOLERABLE_DANGER {
        return (comfortable.0, Manner::Comfortable);
    }
    let (firm, emergency) = (of(Manner::Firm), of(Manner::Emergency));
    let (smooth, manner) = match firm.1 < comfortable.1 {
        true => (firm, Manner::Firm),
        false => (comfortable, Manner::Comfortable),
    };
    let helps = corridor.is_touched_by(&smooth.0);
    let is_dear = smooth.1 <= emergency.1 || !helps;
    if smooth.1.is_finite() && (smooth.2 < EMERGENCY_DANGER || is_dear) {
        (smooth.0, manner)
    } else {
        (emergency.0, Manner::Emergency)
    }
}

/// A free road, a leader, one behind whom a gap is sought, an end of the lane: any of them.
fn corridor() -> impl Strategy<Value = Corridor> {
    let other = || prop::option::of((-5.0_f32..150.0, -15.0_f32..40.0, 0_usize..STEPS));
    let end = prop::option::of((-10.0_f32..200.0, prop::bool::ANY));
    (0.0_f32..60.0, other(), other(), end, prop::bool::ANY).prop_map(
        |(desired, leader, sought, end, near_gap)| {
            let mut corridor = Corridor::free(desired);
            (corridor.near_gap, corridor.seeks) = (near_gap, sought.is_some());
            for step in 0..STEPS {
                let t = (step + 1) as f32 * STEP_S;
                if let Some((bound, speed, from)) = leader
                    && step >= from
                {
                    corridor.limit(step, bound + speed * t, speed);
                }
                if let Some((bound, speed, from)) = sought
                    && step >= from
                {
                    corridor.seek(step, bound + speed * t, speed);
                }
                if let Some((end, always)) = end
                    && (always || t < 2.0)
                {
                    (corridor.stop[step], corridor.end[step]) = (end - 14.0, end);
                }
            }
            corridor
        },
    )
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(2_000))]

    /// The search that leaves out steps and candidates chooses the same motion to the last bit.
    /// Whole speeds make equal candidates likely, of which the first wins.
    #[test]
    fn nothing_that_counts_is_left_out(
        corridor in corridor(),
        speed in prop_oneof![0.0_f32..40.0, (0_u8..40).prop_map(f32::from)],
        second in prop_oneof![Just(0.0_f32), -9.0_f32..3.0],
        keeps in prop::bool::ANY, falls in 0.0_f32..1.0,
    ) {
        let start = Jet { first: speed, second, ..Jet::default() };
        let first = if keeps { speed } else { corridor.desired[0] };
        let fall = falls / STEPS as f32;
        let desired = core::array::from_fn(|step| first * (1.0 - fall * step as f32));
        let corridor = Corridor { desired, ..corridor };
        let (profile, manner) = cheapest(&start, &corridor);
        let expected = plain(&start, &corridor);
        prop_assert_eq!(manner, expected.1);
        // Shows each float with all its digits.
        prop_assert_eq!(format!("{profile:?}"), format!("{:?}", expected.0));
    }

    /// What jerk and acceleration cost at least is what they cost, but for rounding.
    #[test]
    fn the_least_cost_is_that_of_jerk_and_acceleration(
        speed in 0.0_f32..60.0, second in -9.0_f32..3.0, index in 0..KEEPING,
    ) {
        let start = Jet { first: speed, second, ..Jet::default() };
        if let Some((profile, least)) = candidate(index, &start, 20.0) {
            let squares = (1..=STEPS).map(|step| {
                let motion = profile.at(step as f32 * STEP_S);
                let (second, third) = (f64::from(motion.second), f64::from(motion.third));
                0.25 * (0.15 * third * third + 0.8 * second * second)
            });
            let expected: f64 = squares.sum();
            let error = (f64::from(least) - expected).abs();
            prop_assert!(error <= 1e-4 * expected + 1e-9, "{} {}", least, expected);
        }
    }
}
