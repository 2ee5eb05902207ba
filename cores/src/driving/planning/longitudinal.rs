//! Candidates for the motion along the road, and their costs.
//!
//! Velocity-keeping quartics of Werling et al. (see `polynomial`) plus braking ramps. The target
//! speed is that of a distance keeper whose deceleration towards the leader stays bounded; gaps
//! below the safe distance of S. Shalev-Shwartz, S. Shammah, A. Shashua, "On a Formal Model of Safe
//! and Scalable Self-driving Cars", arXiv:1708.06374, 2017 (RSS), cost so much that comfort has no
//! effect.

use super::polynomial::{Jet, Quartic};
use crate::driving::math::{abs, clamp, max, min, sqrt};

/// Steps of the evaluation.
pub(crate) const STEPS: usize = 32;
/// Seconds between two of them: the evaluation looks 8 s ahead.
pub(crate) const STEP_S: f32 = 0.25;
/// All steps, in eight passes. A pass takes every eighth step; the first pass begins with the last
/// step.
const COARSE_TO_FINE: [usize; STEPS] = {
    let (mut order, mut index) = ([0; STEPS], 0);
    while index < STEPS {
        order[index] = [7, 3, 5, 1, 6, 4, 2, 0][index / 4] + 8 * (3 - index % 4);
        index += 1;
    }
    order
};

/// Time gap to the leader at low speed and at 60 km/h and above, s, and its change by speed, s²/m:
/// the distances of UN Regulation 157, 5.2.3.3.
const TIME_GAP_S: (f32, f32) = (1.0, 1.6);
const TIME_GAP_RISE: f32 = 0.036;
/// A slower vehicle counts as standing, m/s.
const STANDING: f32 = 0.1;
/// Distance to the leader at standstill, m.
const STANDSTILL_GAP_M: f32 = 3.5;
/// The shorter distance that a driver may ask for: at standstill, m, and the time gap, s. The least
/// that ISO 15622 permits is 0.8 s.
const NEAR_STANDSTILL_GAP_M: f32 = 2.0;
const NEAR_TIME_GAP_S: f32 = 0.9;
/// Share of the shorter distance that is kept while a gap in the next lane is sought, so that the
/// vehicle draws level with the gap.
const SEEKING_SHARE: f32 = 0.7;
/// Share of the usual distance that is kept to a vehicle behind which a gap is sought.
const SOUGHT_SHARE: f32 = 0.35;
/// Deceleration with which a slower leader is approached, m/s².
const APPROACH_BRAKING: f32 = 1.2;
/// Time constant of keeping the distance, s.
const DISTANCE_S: f32 = 3.0;
/// Time constant of keeping the shorter distance, s.
const NEAR_DISTANCE_S: f32 = 1.5;
/// Time constant of regaining a distance that is too short but not dangerous, s.
const REGAIN_S: f32 = 6.0;
/// While the gap grows at least this fast, m/s, the vehicle does not brake to regain a distance.
const OPENING: f32 = 1.5;
/// Time constant of falling back to a gap that is sought, s.
const SEEK_S: f32 = 2.0;
/// Deceleration towards the end of the lane, m/s².
const END_BRAKING: f32 = 1.6;
/// Time constant of the last metres before the end, s.
const END_S: f32 = 1.0;
/// Greatest acceleration, m/s².
const MAX_ACCELERATION: f32 = 2.0;
/// Strongest braking of candidates without an emergency, m/s².
const MAX_BRAKING: f32 = 8.0;
/// Beyond this braking, m/s², a motion is not comfortable: it is chosen only if the danger of each
/// comfortable one exceeds `TOLERABLE_DANGER`.
pub(crate) const COMFORTABLE_BRAKING: f32 = 4.0;
const TOLERABLE_DANGER: f32 = 40.0;
/// Beyond this jerk, m/s³, a motion is an emergency: it is chosen only if the cheapest other one
/// touches what is ahead, and its danger exceeds `EMERGENCY_DANGER`.
const SMOOTH_JERK: f32 = 8.0;
const EMERGENCY_DANGER: f32 = 100.0;
/// Full braking, m/s².
pub(crate) const EMERGENCY_BRAKING: f32 = 9.0;
/// Jerk of smooth braking ramps and of those of an emergency, m/s³.
const RAMP_JERK: f32 = 6.0;
const EMERGENCY_JERK: f32 = 40.0;

const WEIGHT_JERK: f32 = 0.15;
const WEIGHT_ACCELERATION: f32 = 0.8;
const WEIGHT_SPEED: f32 = 0.4;
/// Speed errors beyond this weigh linearly: a large error must not cause hard acceleration, m/s.
const SPEED_ERROR_KNEE: f32 = 4.0;
const WEIGHT_UNSAFE: f32 = 400.0;
/// It counts in full if the vehicle closes in with this speed, m/s, and with this share if the gap
/// opens.
const CLOSING: f32 = 2.0;
const OPENING_SHARE: f32 = 0.1;
const WEIGHT_CONTACT: f32 = 5_000.0;
/// A smaller gap counts as contact, m, and so does driving farther than this beyond the lane's end,
/// m.
const CONTACT_M: f32 = 1.0;
const OVERRUN_M: f32 = 0.5;
/// Cost per metre driven into the margin before the end of a lane, and the limit of that distance,
/// m.
const WEIGHT_MARGIN: f32 = 10.0;
const MARGIN_MAX_M: f32 = 15.0;

/// A sum in another order may differ by this factor.
const ROUNDING: f32 = 1.001;

/// Limits of the motion along the road, for each step of the evaluation.
#[derive(Clone, Debug)]
pub(crate) struct Corridor {
    /// Speed to drive when nothing is ahead, at each step, m/s.
    pub(crate) desired: [f32; STEPS],
    /// How far the ego's centre may go before it touches what is ahead, m.
    pub(crate) bound: [f32; STEPS],
    /// Speed of what is ahead, m/s.
    pub(crate) bound_speed: [f32; STEPS],
    /// The same for a vehicle of the next lane behind which a gap is sought: it adds no danger.
    sought: [(f32, f32); STEPS],
    /// The last place for the ego's centre to stop, m: with a margin before the lane's end, …
    pub(crate) stop: [f32; STEPS],
    /// … and with the least margin.
    pub(crate) end: [f32; STEPS],
    /// Deceleration towards `stop`, m/s².
    pub(crate) end_braking: f32,
    /// The driver asks for the shorter distance to what is ahead.
    pub(crate) near_gap: bool,
    /// A gap in the next lane is sought.
    pub(crate) seeks: bool,
}

impl Corridor {
    /// Nothing ahead.
    pub(crate) fn free(desired_speed: f32) -> Self {
        Self {
            desired: [desired_speed; STEPS],
            bound: [f32::INFINITY; STEPS],
            bound_speed: [0.0; STEPS],
            sought: [(f32::INFINITY, 0.0); STEPS],
            stop: [f32::INFINITY; STEPS],
            end: [f32::INFINITY; STEPS],
            end_braking: END_BRAKING,
            near_gap: false,
            seeks: false,
        }
    }

    /// Adds an object ahead at this step that must not be touched.
    pub(crate) fn limit(&mut self, step: usize, bound: f32, speed: f32) {
        if bound < self.bound[step] {
            self.bound[step] = bound;
            self.bound_speed[step] = speed;
        }
    }

    /// Adds an object at this step behind which a gap is sought.
    pub(crate) fn seek(&mut self, step: usize, bound: f32, speed: f32) {
        if bound < self.sought[step].0 {
            self.sought[step] = (bound, speed);
        }
    }

    /// Returns the speed that a good driver would have at this step and place, m/s.
    fn target_speed(&self, step: usize, motion: &Jet) -> f32 {
        let mut target = self.desired[step];
        if self.bound[step] < f32::INFINITY {
            let (wanted, distance_s) = if self.near_gap {
                let share = if self.seeks { SEEKING_SHARE } else { 1.0 };
                (share * near_gap(motion.first), NEAR_DISTANCE_S)
            } else {
                (wanted_gap(motion.first), DISTANCE_S)
            };
            let spare = self.bound[step] - motion.value - wanted;
            let ahead = max(self.bound_speed[step], 0.0);
            let keeping = ahead + closing(spare, APPROACH_BRAKING, distance_s, REGAIN_S);
            // If the gap is already opening, wait instead of braking.
            let opening = motion.first - 2.0 * max(motion.first + OPENING - ahead, 0.0);
            target = min(target, max(keeping, opening));
        }
        let (bound, speed) = self.sought[step];
        if bound < f32::INFINITY {
            let wanted = SOUGHT_SHARE * wanted_gap(motion.first);
            let spare = bound - motion.value - wanted;
            target = min(
                target,
                max(speed, 0.0) + max(closing(spare, APPROACH_BRAKING, DISTANCE_S, SEEK_S), -3.0),
            );
        }
        if self.stop[step] < f32::INFINITY {
            target = min(
                target,
                closing(
                    self.stop[step] - motion.value,
                    self.end_braking,
                    END_S,
                    END_S,
                ),
            );
        }
        max(target, 0.0)
    }

    /// Returns the cost of danger at this step, per second.
    fn danger(&self, step: usize, motion: &Jet) -> f32 {
        let speed = max(motion.first, 0.0);
        let mut cost = 0.0;
        // A standing vehicle cannot avoid one that drives towards it.
        let waits = speed < STANDING && self.bound_speed[step] < 0.0;
        if self.bound[step] < f32::INFINITY && !waits {
            let gap = self.bound[step] - motion.value;
            let ahead = max(self.bound_speed[step], 0.0);
            let braking = speed * speed / 14.0 - ahead * ahead / 16.0;
            let safe = 1.0 + 0.3 * speed + max(braking, 0.0);
            if gap < safe {
                // A gap that opens will be safe soon, so it needs no hard braking.
                let closing = clamp((speed - ahead) / CLOSING, OPENING_SHARE, 1.0);
                let lack = (safe - gap) / (safe + 4.0);
                cost += WEIGHT_UNSAFE * closing * lack * lack;
            }
            if gap < CONTACT_M {
                cost += WEIGHT_CONTACT * (CONTACT_M - max(gap, -10.0));
            }
        }
        let beyond = motion.value - self.end[step];
        if beyond > 0.0 {
            cost += WEIGHT_UNSAFE * min(beyond, 5.0);
        }
        cost
    }

    /// Returns whether the motion touches what is ahead, or overruns the lane's end.
    fn is_touched_by(&self, profile: &Profile) -> bool {
        (0..STEPS).any(|step| {
            let way = profile.at((step + 1) as f32 * STEP_S).value;
            self.bound[step] - way < CONTACT_M || way - self.end[step] > OVERRUN_M
        })
    }

    /// Returns the cost per second of using the margin before the end of the lane at this step.
    fn margin(&self, step: usize, motion: &Jet) -> f32 {
        WEIGHT_MARGIN * clamp(motion.value - self.stop[step], 0.0, MARGIN_MAX_M)
    }
}

/// Returns the distance to keep at this speed, m.
fn wanted_gap(speed: f32) -> f32 {
    let speed = max(speed, 0.0);
    let (low, high) = TIME_GAP_S;
    STANDSTILL_GAP_M + min(low + TIME_GAP_RISE * speed, high) * speed
}

/// The shorter distance at this speed, m.
fn near_gap(speed: f32) -> f32 {
    NEAR_STANDSTILL_GAP_M + NEAR_TIME_GAP_S * max(speed, 0.0)
}

/// Returns the speed relative to the leader for this spare distance, m/s: linear near the wanted
/// gap; farther away, a constant deceleration closes the distance.
fn closing(spare: f32, braking: f32, time_constant: f32, regain_s: f32) -> f32 {
    if spare <= 0.0 {
        return spare / regain_s;
    }
    let linear = braking * time_constant;
    sqrt(2.0 * braking * spare + linear * linear) - linear
}

/// A motion along the road.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Profile {
    /// Change to a speed, then keep it.
    Keep(Quartic),
    /// Braking with a ramp of constant jerk and then constantly, to standstill.
    Brake(Ramp),
}

/// The phases of a braking ramp.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Ramp {
    speed: f32,
    acceleration: f32,
    jerk: f32,
    ramp_s: f32,
    stop_s: f32,
    goal: f32,
}

impl Ramp {
    /// From this speed and acceleration to a deceleration of `braking` > 0.
    pub(crate) fn new(speed: f32, acceleration: f32, braking: f32, jerk: f32) -> Self {
        let goal = -braking;
        let jerk = if acceleration > goal { -jerk } else { jerk };
        let ramp_s = (goal - acceleration) / jerk;
        let mut ramp = Self {
            speed: max(speed, 0.0),
            acceleration,
            jerk,
            ramp_s,
            stop_s: f32::INFINITY,
            goal,
        };
        let after = ramp.moving(ramp_s).first;
        if after > 0.0 {
            ramp.stop_s = ramp_s + after / braking;
        } else {
            // The vehicle stands before the ramp ends: find the time by bisection.
            let (mut low, mut high) = (0.0, ramp_s);
            for _ in 0..16 {
                let middle = 0.5 * (low + high);
                if ramp.moving(middle).first > 0.0 {
                    low = middle
                } else {
                    high = middle
                }
            }
            ramp.stop_s = high;
        }
        ramp
    }

    fn moving(&self, t: f32) -> Jet {
        let r = min(t, self.ramp_s);
        let second = self.acceleration + self.jerk * r;
        let first = self.speed + r * (self.acceleration + 0.5 * self.jerk * r);
        let value = r * (self.speed + r * (0.5 * self.acceleration + self.jerk * r / 6.0));
        if t <= self.ramp_s {
            return Jet {
                value,
                first,
                second,
                third: self.jerk,
            };
        }
        let h = t - self.ramp_s;
        Jet {
            value: value + h * (first + 0.5 * self.goal * h),
            first: first + self.goal * h,
            second: self.goal,
            third: 0.0,
        }
    }

    fn at(&self, t: f32) -> Jet {
        if t >= self.stop_s {
            let value = self.moving(self.stop_s).value;
            return Jet {
                value,
                ..Jet::default()
            };
        }
        self.moving(t)
    }
}

impl Profile {
    /// Distance in m, speed, acceleration and jerk after `t` seconds.
    #[inline]
    pub(crate) fn at(&self, t: f32) -> Jet {
        match self {
            Self::Keep(quartic) => quartic.at(t),
            Self::Brake(ramp) => ramp.at(t),
        }
    }

    /// Returns full braking from this start.
    pub(crate) fn emergency(start: &Jet) -> Self {
        Self::Brake(Ramp::new(
            start.first,
            start.second,
            EMERGENCY_BRAKING,
            EMERGENCY_JERK,
        ))
    }

    /// Returns how rough this motion is if it begins with `acceleration` (m/s²).
    fn manner(&self, acceleration: f32) -> Manner {
        // The jerk of a quartic is linear in time.
        let (hardest, jerk) = match self {
            Self::Brake(ramp) => (ramp.goal, abs(ramp.jerk)),
            Self::Keep(quartic) => {
                let at = |share: f32| quartic.at(share * quartic.end());
                let jerk = max(abs(at(0.0).third), abs(at(1.0).third));
                let hardest = [0.25, 0.5, 0.75].map(|share| at(share).second);
                (hardest.into_iter().fold(0.0, min), jerk)
            }
        };
        if jerk > SMOOTH_JERK {
            Manner::Emergency
        } else if hardest < min(-COMFORTABLE_BRAKING, acceleration) {
            Manner::Firm
        } else {
            Manner::Comfortable
        }
    }

    /// Cost of this motion in the corridor, total and of danger alone; `None` if the vehicle cannot
    /// or must not move like this, or if the cost exceeds `best`. `least`: what the motion costs on
    /// any road.
    fn cost(&self, corridor: &Corridor, best: f32, least: f32) -> Option<(f32, f32)> {
        let mut steps = [(0.0, 0.0); STEPS];
        // No cost is negative, so a few steps that are far apart show that most candidates cost too
        // much. The factor allows for rounding, which differs from that of the sum below.
        let mut so_far = least;
        for &step in &COARSE_TO_FINE {
            let (cost, danger, of_road) = self.cost_at(corridor, step)?;
            steps[step] = (cost, danger);
            so_far += of_road;
            if so_far > ROUNDING * best {
                return None;
            }
        }
        let sum = |(cost, danger), (more, danger_of_it)| (cost + more, danger + danger_of_it);
        let (cost, danger) = steps.into_iter().fold((0.0, 0.0), sum);
        (cost <= best && cost.is_finite()).then_some((cost, danger))
    }

    /// Returns the cost of one step of [`Profile::cost`]: total, of danger, and without what
    /// [`least_cost`] contains.
    #[inline]
    fn cost_at(&self, corridor: &Corridor, step: usize) -> Option<(f32, f32, f32)> {
        let motion = self.at((step + 1) as f32 * STEP_S);
        if motion.first < -0.05 || motion.second < -EMERGENCY_BRAKING - 0.5 {
            return None;
        }
        if let Self::Keep(_) = self
            && (motion.second > MAX_ACCELERATION || motion.second < -MAX_BRAKING)
        {
            return None;
        }
        let error = abs(motion.first - corridor.target_speed(step, &motion));
        let error = if error < SPEED_ERROR_KNEE {
            error * error
        } else {
            SPEED_ERROR_KNEE * (2.0 * error - SPEED_ERROR_KNEE)
        };
        let danger = STEP_S * corridor.danger(step, &motion);
        let roughness = WEIGHT_JERK * motion.third * motion.third
            + WEIGHT_ACCELERATION * motion.second * motion.second;
        let (speed, margin) = (WEIGHT_SPEED * error, corridor.margin(step, &motion));
        let comfort = STEP_S * (roughness + speed + margin);
        let of_road = match self {
            Self::Keep(_) => danger + STEP_S * (speed + margin),
            Self::Brake(_) => danger + comfort,
        };
        Some((danger + comfort, danger, of_road))
    }
}

/// Changes of speed that candidates make, m/s.
const SPEED_CHANGES: [f32; 19] = [
    0.0, -0.25, 0.25, -0.6, 0.6, -1.2, 1.2, -2.0, 2.0, -3.5, 3.5, -5.0, 5.0, -7.5, 7.5, -10.0,
    -14.0, -19.0, -25.0,
];
/// Durations of these changes, s.
const DURATIONS_S: [f32; 5] = [7.0, 5.0, 3.5, 2.2, 1.2];
/// Decelerations of smooth braking ramps and of those of an emergency, m/s².
const SMOOTH_BRAKINGS: [f32; 5] = [1.5, 2.5, 3.5, 5.0, 7.0];
const EMERGENCY_BRAKINGS: [f32; 3] = [5.0, 7.0, 9.0];

/// How rough a motion is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Manner {
    /// Neither brakes hard nor jerks.
    Comfortable,
    /// Brakes hard, but does not jerk.
    Firm,
    /// Jerks: brakes as hard as needed, at once.
    Emergency,
}

/// Speeds at the end of candidates of one duration: changed ones, standstill, the desired one.
const SPEEDS: usize = SPEED_CHANGES.len() + 2;
/// How many candidates change the speed, and how many there are.
const KEEPING: usize = DURATIONS_S.len() * SPEEDS;
const CANDIDATES: usize = KEEPING + SMOOTH_BRAKINGS.len() + EMERGENCY_BRAKINGS.len();

/// Returns the candidate from this start and what it costs at least; `None` if another one is
/// equal.
#[inline]
fn candidate(index: usize, start: &Jet, desired_speed: f32) -> Option<(Profile, f32)> {
    if let Some(braking) = index.checked_sub(KEEPING) {
        let (braking, jerk) = match SMOOTH_BRAKINGS.get(braking) {
            Some(&braking) => (braking, RAMP_JERK),
            None => (
                EMERGENCY_BRAKINGS[braking - SMOOTH_BRAKINGS.len()],
                EMERGENCY_JERK,
            ),
        };
        let ramp = Ramp::new(start.first, start.second, braking, jerk);
        return Some((Profile::Brake(ramp), 0.0));
    }
    let speed = match SPEED_CHANGES.get(index % SPEEDS) {
        Some(change) => {
            let speed = start.first + change;
            // Speeds at or below 0 are replaced by the standstill candidate.
            if speed > 0.0 {
                min(speed, 60.0)
            } else {
                return None;
            }
        }
        None if index % SPEEDS == SPEED_CHANGES.len() => 0.0,
        None => desired_speed,
    };
    let duration = index / SPEEDS;
    let quartic = Quartic::new(start, speed, DURATIONS_S[duration]);
    let least = least_cost(&quartic, &SPREADS[duration]);
    Some((Profile::Keep(quartic), least))
}

/// The steps of the evaluation up to a time: how many, their mean, the mean square of the distances
/// from it, and the variance of these squares.
struct Spread {
    steps: f32,
    mean: f32,
    square: f32,
    variance: f32,
}

/// One for each duration.
const SPREADS: [Spread; DURATIONS_S.len()] = {
    let mut spreads = [const { Spread::new(0) }; DURATIONS_S.len()];
    let mut index = 0;
    while index < spreads.len() {
        spreads[index] = Spread::new((DURATIONS_S[index] / STEP_S) as usize);
        index += 1;
    }
    spreads
};

impl Spread {
    const fn new(steps: usize) -> Self {
        let count = steps as f32;
        let mean = 0.5 * (count + 1.0) * STEP_S;
        let (mut square, mut fourth, mut step) = (0.0, 0.0, 1);
        while step <= steps {
            let aside = step as f32 * STEP_S - mean;
            square += aside * aside / count;
            fourth += aside * aside * aside * aside / count;
            step += 1;
        }
        Self {
            steps: count,
            mean,
            square,
            variance: fourth - square * square,
        }
    }
}

/// Returns what jerk and acceleration of all steps cost, whatever else they cost. These are
/// polynomials of the time whose squares are summed as means and deviations, of which none is
/// negative. So the relative error is that of rounding.
#[inline]
fn least_cost(quartic: &Quartic, spread: &Spread) -> f32 {
    let ([s0, s1, s2], [t0, t1]) = quartic.derivatives();
    let Spread {
        steps,
        mean,
        square,
        variance,
    } = *spread;
    let jerk = t0 + t1 * mean;
    let jerk = jerk * jerk + t1 * t1 * square;
    let level = s0 + mean * s1 + s2 * (mean * mean + square);
    let slope = s1 + 2.0 * mean * s2;
    let acceleration = level * level + slope * slope * square + s2 * s2 * variance;
    STEP_S * steps * (WEIGHT_JERK * jerk + WEIGHT_ACCELERATION * acceleration)
}

/// Returns the candidate of the longest duration whose speed is the nearest to the one wanted
/// halfway, if the vehicle keeps its speed until then.
fn likely(start: &Jet, corridor: &Corridor) -> usize {
    let step = STEPS / 2 - 1;
    let kept = Jet {
        value: start.first * (step + 1) as f32 * STEP_S,
        first: start.first,
        ..Jet::default()
    };
    let change = corridor.target_speed(step, &kept) - start.first;
    let (mut nearest, mut least) = (0, f32::INFINITY);
    for (index, candidate) in SPEED_CHANGES.iter().enumerate() {
        let error = abs(candidate - change);
        if error < least {
            (nearest, least) = (index, error);
        }
    }
    nearest
}

/// Returns a profile from this start (at 0 m) and its manner: the cheapest comfortable one if it is
/// not dangerous, else the cheapest without jerk if it keeps a distance, else the cheapest of all.
pub(crate) fn cheapest(start: &Jet, corridor: &Corridor) -> (Profile, Manner) {
    let none = (Profile::emergency(start), f32::INFINITY, f32::INFINITY);
    // The cheapest of each manner, with its cost and its danger. Of equal costs the first counts.
    let mut best = [none; 3];
    let mut first = [CANDIDATES; 3];
    // Other manners are not evaluated if a comfortable one is not dangerous.
    let mut manners = [None; CANDIDATES];
    let likely = likely(start, corridor);
    for comfortable in [true, false] {
        // The more a cheap candidate comes first, the fewer steps the others need.
        for index in core::iter::once(likely).chain(0..CANDIDATES) {
            let known = manners[index];
            if known.is_some_and(|manner| (manner == Manner::Comfortable) != comfortable) {
                continue;
            }
            let candidate = candidate(index, start, corridor.desired[STEPS / 2]);
            let Some((profile, least)) = candidate else {
                continue;
            };
            if comfortable && least > ROUNDING * best[0].1 {
                continue;
            }
            let manner = known.unwrap_or_else(|| profile.manner(start.second));
            manners[index] = Some(manner);
            if (manner == Manner::Comfortable) != comfortable {
                continue;
            }
            let (best, first) = (&mut best[manner as usize], &mut first[manner as usize]);
            if index != *first
                && let Some((cost, danger)) = profile.cost(corridor, best.1, least)
                && (cost < best.1 || index < *first)
            {
                (*best, *first) = ((profile, cost, danger), index);
            }
        }
        if best[0].2 < TOLERABLE_DANGER {
            break;
        }
    }
    let [comfortable, firm, emergency] = best;
    if comfortable.2 < TOLERABLE_DANGER {
        return (comfortable.0, Manner::Comfortable);
    }
    let (smooth, manner) = if firm.1 < comfortable.1 {
        (firm, Manner::Firm)
    } else {
        (comfortable, Manner::Comfortable)
    };
    let is_calm = smooth.2 < EMERGENCY_DANGER
        || smooth.1 <= emergency.1
        || !corridor.is_touched_by(&smooth.0);
    if is_calm && smooth.1.is_finite() {
        (smooth.0, manner)
    } else {
        (emergency.0, Manner::Emergency)
    }
}

#[cfg(test)]
mod oracle;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_ramp_stops_and_stays() {
        for (speed, acceleration) in [(20.0, 1.0), (0.5, 1.0), (0.0, 0.0), (10.0, -9.5)] {
            let ramp = Ramp::new(speed, acceleration, 4.0, 6.0);
            let mut way = -1e-3;
            for step in 0..200 {
                let motion = ramp.at(step as f32 * 0.1);
                assert!(motion.first >= -1e-3, "{speed} {step} {motion:?}");
                assert!(motion.value >= way - 1e-3);
                way = motion.value;
            }
            assert_eq!(ramp.at(20.0).first, 0.0);
        }
    }

    #[test]
    fn free_road_is_driven_at_the_desired_speed() {
        let start = Jet {
            first: 30.0,
            ..Jet::default()
        };
        let (profile, _) = cheapest(&start, &Corridor::free(30.0));
        assert!((profile.at(4.0).first - 30.0).abs() < 0.3);
        let (profile, _) = cheapest(&start, &Corridor::free(33.0));
        let motion = profile.at(4.0);
        assert!(motion.first > 30.5, "{motion:?}");
    }

    #[test]
    fn a_standing_obstacle_is_not_touched() {
        let mut corridor = Corridor::free(30.0);
        for step in 0..STEPS {
            corridor.limit(step, 60.0, 0.0);
        }
        let start = Jet {
            first: 25.0,
            ..Jet::default()
        };
        let (profile, _) = cheapest(&start, &corridor);
        let end = profile.at(8.0);
        assert!(end.value < 60.0, "{end:?}");
    }

    /// A standing object ahead may need hard braking, but no jerk while there is room to build
    /// braking up. It is an emergency only when it is too near for that.
    #[test]
    fn braking_jerks_only_where_a_ramp_comes_too_late() {
        let start = Jet {
            first: 20.0,
            ..Jet::default()
        };
        let manner = |gap: f32| {
            let mut corridor = Corridor::free(20.0);
            for step in 0..STEPS {
                corridor.limit(step, gap, 0.0);
            }
            cheapest(&start, &corridor).1
        };
        assert_eq!(manner(95.0), Manner::Comfortable);
        assert_eq!(manner(55.0), Manner::Firm);
        assert_eq!(manner(30.0), Manner::Emergency);
    }

    /// A vehicle cuts in 4 m ahead, a little slower. Softer braking opens the gap, so it is no
    /// emergency, however much sooner hard braking would make the distance safe.
    #[test]
    fn a_near_cut_in_that_is_not_touched_is_no_emergency() {
        let manner = |gap: f32, slower: f32| {
            let start = Jet {
                first: 25.0,
                second: -1.3,
                ..Jet::default()
            };
            let mut corridor = Corridor::free(25.0);
            for step in 0..STEPS {
                let (t, speed) = ((step + 1) as f32 * STEP_S, 25.0 - slower);
                corridor.limit(step, gap + speed * t, speed);
            }
            cheapest(&start, &corridor).1
        };
        for (gap, slower) in [(4.0, 1.8), (3.0, 1.0), (6.0, 3.0)] {
            assert_ne!(manner(gap, slower), Manner::Emergency, "{gap} {slower}");
        }
        assert_eq!(manner(4.0, 8.0), Manner::Emergency);
    }

    /// The vehicle waits for another that turns across the lane ahead. The prediction that the
    /// other then hits the standing vehicle does not cause harder braking.
    #[test]
    fn who_drives_towards_a_standing_vehicle_is_no_emergency() {
        let start = Jet {
            first: 3.5,
            second: -1.0,
            ..Jet::default()
        };
        let mut corridor = Corridor::free(14.0);
        for step in 4..STEPS {
            let t = (step + 1) as f32 * STEP_S;
            corridor.limit(step, 16.4 - 6.7 * t, -6.7);
        }
        let (profile, manner) = cheapest(&start, &corridor);
        assert_ne!(manner, Manner::Emergency, "{profile:?}");
        assert!(profile.at(1.8).first < 0.3, "{profile:?}");
    }

    /// The vehicle falls back comfortably from a leader that is near but not dangerous. It brakes
    /// as hard as needed for a standing one, but not to keep the margin before a lane's end.
    #[test]
    fn comfort_ends_where_danger_begins() {
        let hardest = |profile: Profile| {
            let all = (0..40).map(|step| profile.at(step as f32 * 0.1));
            all.fold((0.0_f32, 0.0_f32), |(braking, jerk), motion| {
                (braking.max(-motion.second), jerk.max(motion.third.abs()))
            })
        };
        let start = Jet {
            first: 15.0,
            ..Jet::default()
        };
        let behind = |bound: f32, speed: f32| {
            let mut corridor = Corridor::free(15.0);
            for step in 0..STEPS {
                let t = (step + 1) as f32 * STEP_S;
                corridor.limit(step, bound + speed * t, speed);
            }
            hardest(cheapest(&start, &corridor).0)
        };
        let near = behind(11.0, 14.0);
        assert!(near.0 > 0.2 && near.0 <= 4.0 && near.1 <= 8.0, "{near:?}");
        let standing = behind(19.0, 0.0);
        assert!(standing.0 > 5.0, "{standing:?}");
        let mut margin = Corridor::free(15.0);
        margin.stop = [20.0; STEPS];
        margin.end = [45.0; STEPS];
        let margin = hardest(cheapest(&start, &margin).0);
        assert!(margin.0 <= 4.0 && margin.1 <= 8.0, "{margin:?}");
    }
}
