//! How well this system can drive, from what it hears. T-RED-9

use crate::driving::degraded::SCENE_MAX_AGE;
use crate::driving::types::Scene;
use crate::trace::Event;
use tandem_board::{Duration, Instant};
use tandem_redundancy::Ability;

/// Without the chassis' motion for longer than this, the system can only stop: six frames in a row
/// are missing. A master stops the vehicle after 100 ms, so the standby must drive before that.
const MOTION_LIMIT: Duration = Duration::from_ms(60);
/// What was lost counts again after this time without a loss: a receiver that loses every second
/// frame would otherwise change its ability several times a second.
const BACK_AFTER: Duration = Duration::from_ms(1_000);
/// The roles are polled each millisecond. A poll that is this late follows a pause of this system
/// or a jump of its clock, in which it could hear nothing: so nothing counts as missing.
const PAUSE: Duration = Duration::from_ms(30);
/// Bits of what is missing, beside those of the sensors.
const LANES: u8 = 1 << 6;
const MOTION: u8 = 1 << 7;

/// What this system hears, and how well it could drive in the last second.
#[derive(Default)]
pub(super) struct AbilityCheck {
    motion_at: Option<Instant>,
    scene_at: Option<Instant>,
    /// What the last scene lacks.
    lacks: u8,
    ability: Ability,
    /// When it was last as low as now.
    low_at: Instant,
    polled_at: Option<Instant>,
    /// What was not heard since the last pause. A second pause does not excuse it: a system that is
    /// held up again and again is as good as deaf.
    excused: u8,
}

impl AbilityCheck {
    pub(super) fn on_motion(&mut self, at: Instant) {
        self.motion_at = Some(at);
        self.excused &= !MOTION;
    }

    /// Takes a scene. `is_lied_to`: a sensor of lanes or motion is wrong, so there is nothing to
    /// check the others by.
    pub(super) fn on_scene(&mut self, scene: &Scene, is_lied_to: bool) {
        self.scene_at = Some(scene.at);
        self.excused &= !LANES;
        self.lacks = scene.missing | (LANES * u8::from(scene.lanes.is_none() || is_lied_to));
    }

    /// Returns what is missing now: a bit for each sensor, and those of lanes and motion.
    fn missing(&self, now: Instant) -> u8 {
        let is_fresh = |at: Option<Instant>, limit| at.is_some_and(|at| now.since(at) <= limit);
        let scene = match is_fresh(self.scene_at, SCENE_MAX_AGE) {
            true => self.lacks,
            false => LANES,
        };
        scene | (MOTION * u8::from(!is_fresh(self.motion_at, MOTION_LIMIT)))
    }

    /// Returns the ability at `now` and, if it has changed, an event. It falls at once, and rises
    /// when it was better for [`BACK_AFTER`]. Must be called at each poll of the roles.
    pub(super) fn poll(&mut self, now: Instant) -> (Ability, Option<Event>) {
        let last = self.polled_at.replace(now);
        let pause = now.since(last.unwrap_or(now));
        if pause > PAUSE {
            let times = [(MOTION, &mut self.motion_at), (LANES, &mut self.scene_at)];
            for (bit, at) in times {
                if let (0, Some(at)) = (self.excused & bit, at) {
                    *at = (*at + pause).min(now);
                }
                self.excused |= bit;
            }
        }
        let missing = self.missing(now);
        let ability = match (missing & LANES != 0, missing & MOTION != 0) {
            (true, true) => Ability::None,
            (false, false) if missing == 0 => Ability::All,
            (false, false) => Ability::Lacks,
            _ => Ability::StopOnly,
        };
        if ability <= self.ability {
            self.low_at = now;
        }
        let rises = ability > self.ability && now.since(self.low_at) >= BACK_AFTER;
        if !rises && ability >= self.ability {
            return (self.ability, None);
        }
        self.ability = ability;
        let bits = ability.bits();
        (ability, Some(Event::Ability { bits, missing }))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    extern crate std;
    use crate::driving::perception::Perception;
    use crate::driving::types::Lanes;

    const LANES_SEEN: Lanes = Lanes {
        c: [0.0; 4],
        view_range: 80.0,
        width: 3.5,
        left: None,
        right: None,
        own_end: f32::INFINITY,
        ends_domain: false,
        left_end: f32::INFINITY,
        right_end: f32::INFINITY,
        speed_limit: f32::INFINITY,
    };
    const MS: fn(u64) -> Instant = |ms| Instant::from_ns(ms * 1_000_000);

    /// Returns the changes of the ability, with their times in ms. Motions and scenes arrive until
    /// `motion_ms` and `scene_ms`, and again after 2 s; in between, the scenes lack a radar.
    fn changes(motion_ms: u64, scene_ms: u64, lacks: u8) -> std::vec::Vec<(u64, Ability)> {
        let mut check = AbilityCheck::default();
        let mut scene = Perception::new().scene().clone();
        let mut changes = std::vec![];
        for ms in 0..4_000 {
            let is_back = ms >= 2_000;
            scene.lanes = Some(LANES_SEEN);
            scene.missing = if (1_000..2_000).contains(&ms) {
                lacks
            } else {
                0
            };
            if ms % 10 == 0 && (ms <= motion_ms || is_back) {
                check.on_motion(MS(ms));
            }
            if ms % 50 == 0 && (ms <= scene_ms || is_back) {
                scene.at = MS(ms);
                check.on_scene(&scene, false);
            }
            let (ability, event) = check.poll(MS(ms));
            if event.is_some() {
                changes.push((ms, ability));
            }
        }
        changes
    }

    /// T-RED-9: each loss lowers the ability within its limit, and it is back after a second.
    #[test]
    fn the_ability_falls_at_once_and_rises_after_a_second() {
        use Ability as A;
        const NEVER: u64 = u64::MAX;
        assert_eq!(changes(NEVER, NEVER, 0), []);
        let lacks = [(1_000, A::Lacks), (2_999, A::All)];
        assert_eq!(changes(NEVER, NEVER, 4), lacks);
        let blind = [(1_061, A::StopOnly), (2_999, A::All)];
        assert_eq!(changes(1_000, NEVER, 0), blind);
        let without_scene = [(1_501, A::StopOnly), (2_999, A::All)];
        assert_eq!(changes(NEVER, 1_000, 0), without_scene);
        let both = [(1_061, A::StopOnly), (1_501, A::None), (2_999, A::All)];
        assert_eq!(changes(1_000, 1_000, 0), both);
    }

    /// T-RED-9: a clock that jumps, or a system that was held up, loses nothing. What stays silent
    /// after that is missing.
    #[test]
    fn a_pause_is_no_loss() {
        let mut check = AbilityCheck::default();
        let mut scene = Perception::new().scene().clone();
        scene.lanes = Some(LANES_SEEN);
        let mut jumped = 0;
        for ms in 0..3_000 {
            jumped += if ms % 500 == 499 { 600 } else { 0 };
            let now = MS(ms + jumped);
            if ms % 10 == 0 && ms < 2_000 {
                check.on_motion(now);
            }
            if ms % 50 == 0 {
                scene.at = now;
                check.on_scene(&scene, false);
            }
            let (ability, _) = check.poll(now);
            let expected = if ms > 2_051 {
                Ability::StopOnly
            } else {
                Ability::All
            };
            assert_eq!(ability, expected, "{ms}");
        }
    }

    /// T-RED-9: a deaf system that is held up again and again finds what is missing.
    #[test]
    fn pauses_in_succession_excuse_no_loss() {
        let mut check = AbilityCheck::default();
        let mut scene = Perception::new().scene().clone();
        scene.lanes = Some(LANES_SEEN);
        check.on_motion(MS(0));
        check.on_scene(&scene, false);
        let polled = (0..40).map(|poll| check.poll(MS(poll * 40)).0);
        let abilities: std::vec::Vec<Ability> = polled.collect();
        assert_eq!(abilities[2], Ability::All);
        assert_eq!(abilities[3], Ability::StopOnly);
        assert_eq!(abilities[20], Ability::None);
    }

    /// T-RED-9: a receiver that loses half of the frames, at random, reports no change each time.
    #[test]
    fn a_loss_now_and_then_counts_as_one() {
        let mut check = AbilityCheck::default();
        let mut scene = Perception::new().scene().clone();
        scene.lanes = Some(LANES_SEEN);
        let mut changes = 0;
        for ms in 0..10_000 {
            check.on_motion(MS(ms));
            scene.at = MS(ms);
            scene.missing = u8::from(ms % 700 < 100);
            check.on_scene(&scene, false);
            changes += u32::from(check.poll(MS(ms)).1.is_some());
        }
        assert_eq!(changes, 1);
    }
}
