//! The scene's motion of the vehicle against the motion that core 0 hears.

use super::{Difference, REMEMBERED};
use crate::driving::types::Ego;
use heapless::Deque;
use tandem_board::{Duration, Instant};

/// Motions that are remembered: 80 ms.
const MOTIONS: usize = 8;
/// Core 1's newest motion was on the bus at most this long before the scene.
const OLDEST: Duration = Duration::from_ms(40);
/// Period of the frame with the motion.
const PERIOD: Duration = Duration::from_ms(10);
/// So many scenes in succession must differ: 150 ms.
const SCENES: u8 = 3;

/// The numbers of the values in [`Event::WrongScene`](crate::trace::Event::WrongScene).
const NUMBERS: [u8; 5] = [1, 2, 3, 4, 8];
/// Limits of the differences: speed in m/s, yaw rate in rad/s, steering angle and slip angle in
/// rad, and, only between two cores, acceleration in m/s². They hold between two systems, whose
/// motions may be of different frames: that causes at most 5 standard deviations of the noise, 0.2,
/// 0.011, 0.002 and 0.007. Between two cores, which hear the same frames, one of the remembered
/// motions must be equal to the last bit.
const LIMITS: [f32; 5] = [0.4, 0.02, 0.005, 0.012, 1.0];
/// Fastest changes of these values per second.
const CHANGES: [f32; 5] = [12.0, 1.5, 0.6, 0.5, 100.0];

pub(super) struct EgoCheck {
    /// Oldest first.
    motions: Deque<(Instant, Ego), MOTIONS>,
    agreed: Option<(Instant, Ego)>,
    different: u8,
    /// How much farther core 0's motions are from `agreed` than the scene's.
    evidence: f32,
    /// The motions of two systems are up to this much apart in time, s, besides one frame. 0 for
    /// those of two cores.
    apart_s: f32,
}

/// Returns the values that are compared. `apart_s`: as in [`difference`]; two systems do not tell
/// each other their accelerations.
const fn values(ego: &Ego, apart_s: f32) -> [f32; 5] {
    let acceleration = if apart_s == 0.0 {
        ego.acceleration
    } else {
        0.0
    };
    [
        ego.speed,
        ego.yaw_rate,
        ego.steering_angle,
        ego.slip_angle,
        acceleration,
    ]
}

/// Returns the largest difference in shares of its limit, its number from 1 on, and its amount.
/// `apart_s`: how far the motions are apart in time, s.
fn difference(one: &Ego, other: &Ego, apart_s: f32) -> (f32, u8, f32) {
    let limits = LIMITS.into_iter().zip(CHANGES);
    let [one, other] = [one, other].map(|ego| values(ego, apart_s));
    let pairs = one.into_iter().zip(other).zip(limits);
    let mut worst = (0.0, 0, 0.0);
    for (what, ((one, other), (limit, change))) in NUMBERS.into_iter().zip(pairs) {
        let (amount, limit) = (one - other, limit + change * apart_s);
        // NaN differs.
        let share = if amount.is_finite() {
            amount.abs() / limit
        } else {
            f32::MAX
        };
        if share > worst.0 {
            worst = (share, what, amount);
        }
    }
    worst
}

/// The most that one motion counts as evidence, in limits.
const FAR: f32 = 100.0;

/// Returns how far `ego` is from the motion `before`, in limits; what a vehicle does not reach in
/// `seconds` counts tenfold. Values that are equal in two motions cancel in the difference.
/// `apart_s`: as in [`difference`].
fn far(before: &Ego, ego: &Ego, seconds: f32, apart_s: f32) -> f32 {
    let limits = LIMITS.into_iter().zip(CHANGES);
    let [before, ego] = [before, ego].map(|ego| values(ego, apart_s));
    let shares = before
        .into_iter()
        .zip(ego)
        .zip(limits)
        .map(|((before, now), (limit, change))| {
            let aside = (now - before).abs();
            let beyond = (aside - change * seconds).max(0.0);
            let share = (aside + 10.0 * beyond) / limit;
            if share.is_finite() {
                share.min(FAR)
            } else {
                FAR
            }
        });
    shares.sum()
}

impl EgoCheck {
    pub(super) const fn new(apart_s: f32) -> Self {
        Self {
            motions: Deque::new(),
            agreed: None,
            different: 0,
            evidence: 0.0,
            apart_s,
        }
    }

    pub(super) fn on_ego(&mut self, at: Instant, ego: Ego) {
        if self.motions.is_full() {
            let _oldest = self.motions.pop_front();
        }
        let _fits = self.motions.push_back((at, ego));
    }

    /// Returns whether the motions are of two cores that hear the same frames.
    const fn between_cores(&self) -> bool {
        self.apart_s == 0.0
    }

    /// Returns whether the last scene's motion was one of those that were heard.
    pub(super) const fn is_same(&self) -> bool {
        self.different == 0
    }

    /// Returns the newest motion at or before this time.
    pub(super) fn newest_before(&self, at: Instant) -> Option<Ego> {
        let mut motions = self.motions.iter().rev();
        motions.find(|it| it.0 <= at).map(|it| it.1)
    }

    /// Returns whether a motion was heard shortly before this time.
    pub(super) fn is_heard(&self, at: Instant) -> bool {
        self.motions.iter().any(|it| at.since(it.0) <= OLDEST)
    }

    /// Compares a scene's motion. Returns the largest difference as a share of its limit, and the
    /// difference once it has lasted. Two cores must agree to the last bit.
    pub(super) fn check(&mut self, at: Instant, scene: &Ego) -> (f32, Option<Difference>) {
        let oldest = OLDEST + Duration::from_us((self.apart_s * 1e6) as u64);
        let near = self.motions.iter().filter(|it| at.since(it.0) <= oldest);
        let differences = near.map(|(_, own)| (difference(scene, own, self.apart_s), own));
        let Some(((share, what, amount), own)) =
            differences.min_by(|one, other| one.0.0.total_cmp(&other.0.0))
        else {
            // Core 0 hears no motion: that is found elsewhere.
            return (0.0, None);
        };
        let is_equal = |(_, own): &(Instant, Ego)| difference(scene, own, 0.0).0 == 0.0;
        let is_same = match self.between_cores() {
            true => self.motions.iter().any(is_equal),
            false => share < 1.0,
        };
        if is_same {
            (self.agreed, self.different, self.evidence) = (Some((at, *scene)), 0, 0.0);
            return (share, None);
        }
        let newest = self.motions.back().map_or(at, |it| it.0);
        if self.between_cores() && at.since(newest) >= PERIOD {
            // Core 0 has not read the newest frame yet.
            return (share, None);
        }
        let agreed = self.agreed.filter(|it| at.since(it.0) <= REMEMBERED);
        if let Some((since, before)) = agreed {
            let seconds = at.since(since).as_secs_f32();
            let far = |it| far(&before, it, seconds, self.apart_s);
            let [own, scene] = [own, scene].map(far);
            self.evidence += own - scene;
        }
        self.different = self.different.saturating_add(1);
        if self.different < SCENES {
            return (share, None);
        }
        let other = agreed.map(|_| self.evidence > 0.0);
        let found = Difference {
            what,
            other,
            amount,
        };
        (share, Some(found))
    }
}
