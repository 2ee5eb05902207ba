//! Behaviour decision: keep the lane or change it, by the criteria of MOBIL, with a way to abort.
//!
//! A. Kesting, M. Treiber, D. Helbing, "General Lane-Changing Model MOBIL for Car-Following
//! Models", Transportation Research Record 1999 (2007): a change must be safe for the new follower
//! and must gain the vehicle more acceleration than it costs the follower. Accelerations come from
//! the IDM.

use super::prediction::Predicted;
use crate::driving::function::CONTINUES_M;
use crate::driving::idm::{self, Driver, Leader};
use crate::driving::math::{abs, lerp, max, min};
use crate::driving::types::{Lanes, Memory, RouteCode};
use crate::driving::vehicle::{LENGTH_M, WIDTH_M};

/// The least gain in acceleration for a change, m/s².
const CHANGING_THRESHOLD: f32 = 0.45;
/// The same for a vehicle that is slow behind a standing object: the object will not move soon.
const PULL_OUT_THRESHOLD: f32 = 0.1;
/// How much the follower's loss counts (politeness).
const POLITENESS: f32 = 0.3;
/// Braking that a change may ask of the new follower, m/s²; more when the ego lane ends.
const SAFE_BRAKING: f32 = 2.0;
const SAFE_BRAKING_AT_END: f32 = 3.5;
/// A vehicle that may drive this much faster than its follower leaves it behind, m/s.
const LEAVES_BEHIND: f32 = 1.0;
/// Time after which the follower reacts to a change, s.
const REACTION_S: f32 = 0.4;
/// No change begins while the leader makes the ego brake harder than this, m/s².
const CALM_BRAKING: f32 = 1.5;
/// A wish must hold for this long before it is acted on, in cycles of 50 ms.
const WISH_CYCLES: u16 = 16;
/// The same when the ego lane ends.
const FORCED_WISH_CYCLES: u16 = 4;
/// A change begins within this distance of the ego lane's centre, m; the second value if forced.
const CENTRED_M: f32 = 0.6;
const CENTRED_FORCED_M: f32 = 1.3;
/// Pause after a change or an attempt, in cycles.
const REST_CYCLES: u16 = 100;
const REST_CYCLES_AT_END: u16 = 20;
/// A change takes this long …
const CHANGE_S: f32 = 5.0;
/// … or this, when the ego lane ends, …
const FORCED_CHANGE_S: f32 = 3.5;
/// … but at least this distance, m.
const CHANGE_MIN_M: f32 = 18.0;
/// The remainder of a change always takes at least this time, s.
const REST_MIN_S: f32 = 2.0;
/// In a jam, a vehicle slower than this does not change lanes, m/s, except around an object that
/// stands (slower than the second, m/s) at least this far ahead, m.
const SLOW: f32 = 3.0;
const STANDS: f32 = 0.3;
const PULL_OUT_M: f32 = 6.0;
/// The vehicle does not change to a lane that ends within this time, s.
const LANE_WORTH_S: f32 = 20.0;
/// The vehicle leaves a lane that ends within this time, s, or within this distance, m: before the
/// driver would be asked.
const LEAVE_BEFORE_S: f32 = 17.0;
const LEAVE_BEFORE_M: f32 = 200.0;

/// A side of the ego lane.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Side {
    Left,
    Right,
}

impl Side {
    const ALL: [Self; 2] = [Self::Left, Self::Right];

    fn sign(self) -> f32 {
        match self {
            Self::Left => 1.0,
            Self::Right => -1.0,
        }
    }

    /// Offset of the lane's centre and distance to its end, if there is a lane.
    fn lane(self, lanes: &Lanes) -> Option<(f32, f32)> {
        let (width, end) = match self {
            Self::Left => (lanes.left?, lanes.left_end),
            Self::Right => (lanes.right?, lanes.right_end),
        };
        Some((self.sign() * 0.5 * (lanes.width + width), end))
    }
}

/// The manoeuvre: keep the lane or change it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Intent {
    /// Keep the lane.
    Keep,
    /// Change the lane; `crossed` once the new lane is the ego lane.
    Change {
        side: Side,
        crossed: bool,
        rest_m: f32,
    },
}

/// The inputs of the decision.
#[derive(Clone, Debug)]
pub(crate) struct Situation<'a> {
    pub(crate) lanes: &'a Lanes,
    pub(crate) objects: &'a [Predicted],
    /// m/s
    pub(crate) speed: f32,
    /// Speed expected soon with the present braking, m/s.
    pub(crate) next_speed: f32,
    /// m/s
    pub(crate) desired_speed: f32,
    /// Offset from the ego lane's centre, m.
    pub(crate) offset: f32,
    /// Where the driver's route leads.
    pub(crate) route: RouteCode,
}

/// The task of planning.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Goal {
    /// Target offset, m.
    pub(crate) offset: f32,
    /// Distance in which to reach it, m; `None` while the lane is kept.
    pub(crate) rest_m: Option<f32>,
    /// Distance to the end of the target lane, m.
    pub(crate) end: f32,
    /// Centre of the lane in which a gap is sought, m, and from which place along the road on, m:
    /// it is the gap behind the first vehicle from there on.
    pub(crate) sought: Option<(f32, f32)>,
}

/// Decides on the lane; holds the intent and counters between cycles.
#[derive(Clone, Debug)]
pub(crate) struct Behaviour {
    pub(crate) intent: Intent,
    wishes: [u16; 2],
    rest: u16,
}

impl Behaviour {
    pub(crate) fn new() -> Self {
        Self {
            intent: Intent::Keep,
            wishes: [0; 2],
            rest: 0,
        }
    }

    /// Returns the memory of this decision.
    pub(crate) fn memory(&self) -> Memory {
        let [left, right] = self.wishes.map(|wish| u32::from(wish.min(31)));
        let intent = match self.intent {
            Intent::Keep => 0,
            Intent::Change {
                side,
                crossed,
                rest_m,
            } => {
                let half_metres = min(2.0 * rest_m, 1023.0) as u32;
                (1 + side as u32) | u32::from(crossed) << 2 | half_metres << 20
            }
        };
        Memory(intent | left << 3 | right << 8 | u32::from(self.rest) << 13)
    }

    /// A decision that continues from this memory.
    pub(crate) fn recall(memory: Memory) -> Self {
        let bits = memory.bits();
        let field = |shift: u32, width: u32| (bits >> shift & ((1 << width) - 1)) as u16;
        let change = |side| Intent::Change {
            side,
            crossed: field(2, 1) == 1,
            rest_m: 0.5 * f32::from(field(20, 10)),
        };
        Self {
            intent: match field(0, 2) {
                1 => change(Side::Left),
                2 => change(Side::Right),
                _ => Intent::Keep,
            },
            wishes: [field(3, 5), field(8, 5)],
            rest: field(13, 7).min(REST_CYCLES),
        }
    }

    /// Reports that the ego lane is now the one to the left (+1) or right (-1) of the old one.
    pub(crate) fn crossed_line(&mut self, direction: f32) {
        self.wishes = [0; 2];
        if let Intent::Change { side, crossed, .. } = &mut self.intent {
            *crossed = side.sign() == direction;
        }
    }

    /// Returns whether a change is under way and its line not crossed yet.
    pub(crate) fn is_leaving(&self) -> bool {
        matches!(self.intent, Intent::Change { crossed: false, .. })
    }

    /// Ends a dangerous change if the vehicle is still in its old lane.
    pub(crate) fn abort(&mut self) -> bool {
        if let Intent::Change { crossed: false, .. } = self.intent {
            self.intent = Intent::Keep;
            self.rest = REST_CYCLES / 2;
            self.wishes = [0; 2];
            return true;
        }
        false
    }

    /// Returns the goal for this cycle; `moved` is the distance driven since the last cycle, m.
    pub(crate) fn decide(&mut self, now: &Situation<'_>, moved: f32) -> Goal {
        self.rest = self.rest.saturating_sub(1);
        if let Intent::Change { rest_m, .. } = &mut self.intent {
            *rest_m = max(*rest_m - moved, 0.0);
        }
        match self.intent {
            Intent::Change {
                side,
                crossed: false,
                ..
            } => {
                let tight = now.past_the_middle(side);
                let gone = side.lane(now.lanes).is_none_or(|(centre, _)| {
                    !tight && !now.is_possible(centre, 1.5 * SAFE_BRAKING_AT_END, 0.2)
                });
                if gone {
                    self.abort();
                }
            }
            Intent::Change {
                crossed: true,
                rest_m,
                ..
            } => {
                if abs(now.offset) < 0.3 || rest_m <= 0.0 {
                    self.intent = Intent::Keep;
                    self.rest = REST_CYCLES;
                }
            }
            Intent::Keep => self.consider(now),
        }
        self.goal(now)
    }

    fn goal(&self, now: &Situation<'_>) -> Goal {
        let keep = Goal {
            offset: 0.0,
            rest_m: None,
            end: now.lanes.own_end,
            sought: None,
        };
        match self.intent {
            Intent::Keep => Goal {
                sought: now
                    .forced()
                    .map(|(_, centre)| (centre, now.seeks_from(centre))),
                ..keep
            },
            Intent::Change {
                side,
                crossed,
                rest_m,
            } => {
                let rest_m = Some(max(rest_m, max(REST_MIN_S * now.speed, 0.5 * CHANGE_MIN_M)));
                match side.lane(now.lanes) {
                    Some((offset, end)) if !crossed => Goal {
                        offset,
                        rest_m,
                        end,
                        sought: None,
                    },
                    _ => Goal { rest_m, ..keep },
                }
            }
        }
    }

    /// Counts for how long a change has been wanted, and begins it.
    fn consider(&mut self, now: &Situation<'_>) {
        let forced = now.forced().map(|(side, _)| side);
        let needed = if forced.is_some() {
            FORCED_WISH_CYCLES
        } else {
            WISH_CYCLES
        };
        if forced.is_some() {
            self.rest = self.rest.min(REST_CYCLES_AT_END);
        }
        for side in Side::ALL {
            let wish = &mut self.wishes[side as usize];
            *wish = if now.wishes(side, forced) {
                wish.saturating_add(1)
            } else {
                0
            };
        }
        let centred = if forced.is_some() {
            CENTRED_FORCED_M
        } else {
            CENTRED_M
        };
        if self.rest > 0 || abs(now.offset) > centred {
            return;
        }
        let [left, right] = self.wishes;
        let side = if left >= right {
            Side::Left
        } else {
            Side::Right
        };
        if max_of(left, right) >= needed {
            let time = if forced.is_some() {
                FORCED_CHANGE_S
            } else {
                CHANGE_S
            };
            let rest_m = max(time * now.speed, CHANGE_MIN_M);
            self.intent = Intent::Change {
                side,
                crossed: false,
                rest_m,
            };
            self.wishes = [0; 2];
        }
    }
}

/// Returns the way by which a vehicle comes nearer that closes in with this speed, m/s, until it
/// has reacted and braked that off, m.
fn closing_way(closing: f32, braking: f32) -> f32 {
    closing * (REACTION_S + 0.5 * closing / braking)
}

fn max_of(a: u16, b: u16) -> u16 {
    if a > b { a } else { b }
}

impl Situation<'_> {
    /// Returns the IDM driver of the ego vehicle, with a share of the usual time gap.
    fn driver(&self, share: f32) -> Driver {
        Driver {
            desired_speed: self.desired_speed,
            time_gap: 1.5 * share,
            standstill_gap: 4.0 * share,
            max_acceleration: 1.5,
            comfortable_braking: 2.0,
        }
    }

    /// Returns the side to change to because the ego lane ends soon or the route leads there, and
    /// that lane's centre.
    fn forced(&self) -> Option<(Side, f32)> {
        let end = self.lanes.own_end;
        let soon = max(LEAVE_BEFORE_S * self.speed, LEAVE_BEFORE_M);
        if end > soon {
            let side = match self.route {
                RouteCode::Left => Side::Left,
                RouteCode::Right => Side::Right,
                RouteCode::Free | RouteCode::Keep => return None,
            };
            let (centre, other) = side.lane(self.lanes)?;
            return (other > soon).then_some((side, centre));
        }
        let worth = |side: &Side| {
            side.lane(self.lanes)
                .is_some_and(|(_, other)| other > end + CONTINUES_M)
        };
        let side = Side::ALL.into_iter().find(worth)?;
        side.lane(self.lanes).map(|(centre, _)| (side, centre))
    }

    /// Whether the body is so far over the line that going back is no better than continuing.
    fn past_the_middle(&self, side: Side) -> bool {
        side.sign() * self.offset > 0.5 * self.lanes.width - 0.25 * WIDTH_M
    }

    /// Returns the nearest objects ahead and behind in the lane with this centre.
    fn neighbours(&self, centre: f32) -> (Option<&Predicted>, Option<&Predicted>) {
        let half = 0.5 * self.lanes.width;
        let (mut leader, mut follower): (Option<&Predicted>, Option<&Predicted>) = (None, None);
        for object in self.objects {
            let reach = half + 0.3 * object.half_width;
            let inside = abs(object.d - centre) < reach || abs(object.across(2.5) - centre) < half;
            if !inside {
                continue;
            }
            if object.s > 0.0 {
                if leader.is_none_or(|nearest| object.s < nearest.s) {
                    leader = Some(object);
                }
            } else if follower.is_none_or(|nearest| object.s > nearest.s) {
                follower = Some(object);
            }
        }
        (leader, follower)
    }

    fn own_acceleration(&self, leader: Option<&Predicted>, share: f32) -> f32 {
        let leader = leader.map(|object| {
            let gap = object.s - object.half_length - 0.5 * LENGTH_M;
            Leader {
                gap,
                speed: max(object.along(1.0).1, 0.0),
            }
        });
        idm::acceleration(&self.driver(share), self.speed, leader)
    }

    fn follower_acceleration(&self, follower: &Predicted) -> f32 {
        let driver = Driver {
            desired_speed: max(follower.speed, 5.0),
            time_gap: 1.0,
            standstill_gap: 2.0,
            max_acceleration: 1.5,
            comfortable_braking: 2.0,
        };
        let gap = -follower.s - follower.half_length - 0.5 * LENGTH_M;
        let speed = self.next_speed;
        idm::acceleration(&driver, follower.speed, Some(Leader { gap, speed }))
    }

    /// Returns whether a slow vehicle has a reason and the room to steer out of its lane: the
    /// object ahead stands, and is not so near that the vehicle would have to turn on the spot.
    fn can_pull_out(&self, leader: Option<&Predicted>) -> bool {
        leader.is_some_and(|object| {
            let gap = object.s - object.half_length - 0.5 * LENGTH_M;
            object.speed < STANDS && gap > PULL_OUT_M
        })
    }

    /// Whether the lane with this centre has a gap so large that the ego vehicle and the follower
    /// could both stop in it, and would not have to brake harder than [`SAFE_BRAKING`] at once.
    fn is_calm(&self, centre: f32) -> bool {
        let (leader, follower) = self.neighbours(centre);
        let leaves_room = leader.is_none_or(|leader| {
            let gap = leader.s - leader.half_length - 0.5 * LENGTH_M;
            let (own, ahead) = (self.speed, max(leader.along(2.0).1, 0.0));
            let closing = max((own * own - ahead * ahead) / 10.0, 0.0);
            gap >= 3.0 + 0.5 * own + closing
                && self.own_acceleration(Some(leader), 1.0) >= -SAFE_BRAKING
        });
        leaves_room
            && follower.is_none_or(|follower| {
                let (own, behind) = (self.next_speed, max(follower.speed, 0.0));
                let gap = -follower.s - follower.half_length - 0.5 * LENGTH_M;
                let closing = max((behind * behind - own * own) / 5.0, 0.0);
                gap >= 3.0 + 0.6 * behind + closing
                    && self.follower_acceleration(follower) >= -SAFE_BRAKING
            })
    }

    /// Returns whether the lane with this centre has a gap for a vehicle that must change: the one
    /// that closes in, the ego vehicle or the follower, has to brake by no more than `braking` to
    /// keep `share` of the usual distance. The form is that of UN Regulation 79, 5.6.4.7: the
    /// distance in the reaction time plus that of braking off the speed difference.
    fn is_possible(&self, centre: f32, braking: f32, share: f32) -> bool {
        let (leader, follower) = self.neighbours(centre);
        let leaves_room = leader.is_none_or(|leader| {
            let gap = leader.s - leader.half_length - 0.5 * LENGTH_M;
            let closing = max(self.speed - max(leader.along(1.0).1, 0.0), 0.0);
            gap >= 2.0 + share * (1.0 + 0.5 * self.speed) + closing_way(closing, braking)
        });
        leaves_room && follower.is_none_or(|it| self.is_ahead_of(it, braking, share))
    }

    /// Returns whether this follower leaves room for a vehicle that must change, in that form.
    fn is_ahead_of(&self, follower: &Predicted, braking: f32, share: f32) -> bool {
        let (own, behind) = (self.next_speed, max(follower.speed, 0.0));
        // The gap grows until the vehicle reaches the line.
        let growth = 1.5 * (1.0 - share) * max(own - behind, 0.0);
        let gap = growth - follower.s - follower.half_length - 0.5 * LENGTH_M;
        let way = closing_way(max(behind - own, 0.0), braking);
        gap >= 2.0 + share * (1.0 + 0.6 * behind) + way
    }

    /// Returns how much of the follower's braking and of the usual distance a change may take at
    /// this distance to the end of the lane.
    fn forced_terms(&self) -> (f32, f32) {
        let near = 1.0 - min(max(self.lanes.own_end, 0.0) / LEAVE_BEFORE_M, 1.0);
        (
            lerp(SAFE_BRAKING, SAFE_BRAKING_AT_END, near),
            lerp(0.4, 0.3, near),
        )
    }

    /// Returns from which place along the road on a gap is sought, m: behind a follower that is too
    /// near and that the vehicle cannot leave behind.
    fn seeks_from(&self, centre: f32) -> f32 {
        let (braking, share) = self.forced_terms();
        let lets_pass = |it: &&Predicted| {
            self.desired_speed < it.speed + LEAVES_BEHIND && !self.is_ahead_of(it, braking, share)
        };
        let follower = self.neighbours(centre).1.filter(lets_pass);
        follower.map_or(0.0, |it| it.s)
    }

    fn wishes(&self, side: Side, forced: Option<Side>) -> bool {
        let Some((centre, end)) = side.lane(self.lanes) else {
            return false;
        };
        if let Some(forced) = forced {
            let (braking, share) = self.forced_terms();
            return side == forced && self.is_possible(centre, braking, share);
        }
        if end < max(LANE_WORTH_S * self.speed, 400.0) || self.route == RouteCode::Keep {
            return false;
        }
        let (leader, follower) = self.neighbours(centre);
        let (own_leader, _) = self.neighbours(0.0);
        let kept = self.own_acceleration(own_leader, 1.0);
        let is_slow = self.speed < SLOW;
        if kept < -CALM_BRAKING || is_slow && !self.can_pull_out(own_leader) {
            return false;
        }
        let threshold = if is_slow {
            PULL_OUT_THRESHOLD
        } else {
            CHANGING_THRESHOLD
        };
        let gain = self.own_acceleration(leader, 1.0) - kept;
        let loss = follower.map_or(0.0, |object| max(-self.follower_acceleration(object), 0.0));
        gain - POLITENESS * loss > threshold && self.is_calm(centre)
    }
}
