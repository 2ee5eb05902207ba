//! Checks core 1's scene against the frames of camera and chassis that core 0 hears itself. T-RED-9
//!
//! A value that only one of the two cores hears wrongly is found here, whichever core it is. What
//! continues the values on which both agreed last is right: by it, a system that drives alone
//! stops. The limits and their reasons are in `docs/decisions/0030-scene-check.md`.

mod ego;
mod lanes;

use crate::driving::odometry::motion;
use crate::driving::types::{Ego, Scene};
use crate::trace::Event;
use ego::EgoCheck;
use lanes::LaneCheck;
use tandem_board::Instant;
use tandem_bus::CameraLanes;

/// Something that the two cores do not hear alike.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Finding {
    /// 0 the lanes, else the motion's value, as in [`Event::WrongScene`].
    what: u8,
    /// Core 0 hears wrong values; otherwise the scene is wrong.
    pub(super) hearing: bool,
    /// The difference: m, m/s, rad/s or rad.
    amount: f32,
}

impl Finding {
    pub(super) fn event(self) -> Event {
        Event::WrongScene {
            what: self.what,
            hearing: self.hearing,
            thousandths: (self.amount.abs() * 1e3) as u32,
        }
    }
}

/// Both checks and what they have found. Costs about 400 multiplications in 50 ms, most of them for
/// the filter of the lanes.
pub(super) struct SceneCheck {
    ego: EgoCheck,
    lanes: LaneCheck,
    found: Option<Finding>,
    /// The largest share that was traced, in tenths.
    worst_tenths: u8,
}

impl SceneCheck {
    pub(super) fn new() -> Self {
        Self {
            ego: EgoCheck::new(),
            lanes: LaneCheck::new(),
            found: None,
            worst_tenths: 0,
        }
    }

    /// Takes the chassis' motion that core 0 has heard.
    pub(super) fn on_ego(&mut self, at: Instant, ego: Ego) {
        self.ego.on_ego(at, ego);
    }

    /// Takes the camera's lanes that core 0 has heard.
    pub(super) fn on_lanes(&mut self, at: Instant, camera: &CameraLanes) {
        // No motion: that is found elsewhere.
        if let (true, Some(ego)) = (camera.valid, self.ego.newest_before(at)) {
            self.lanes.on_camera(at, camera, &ego);
        }
    }

    /// Returns what was found. It stays until the next start.
    pub(super) const fn found(&self) -> Option<Finding> {
        self.found
    }

    /// Returns whether core 0 hears wrong motions: then only those of the scene are used.
    pub(super) fn is_deceived(&self) -> bool {
        self.found
            .is_some_and(|found| found.hearing && found.what != 0)
    }

    /// Checks a new scene. Once it was found wrong, puts core 0's values in the place of the
    /// scene's. Returns an event to trace.
    pub(super) fn on_scene(&mut self, scene: &mut Scene) -> Option<Event> {
        let (share, found) = self.check(scene);
        let is_new = self.found.is_none() && found.is_some();
        self.found = self.found.or(found);
        if self.found.is_some_and(|found| !found.hearing) {
            self.correct(scene);
        }
        if is_new {
            return found.map(Finding::event);
        }
        let percent = (share * 100.0) as u8;
        let is_worst = percent / 10 > self.worst_tenths;
        self.worst_tenths = self.worst_tenths.max(percent / 10);
        is_worst.then_some(Event::SceneCheck { percent })
    }

    /// Returns the largest difference as a share of what is tolerated, and what was found.
    fn check(&mut self, scene: &Scene) -> (f32, Option<Finding>) {
        let (share, found) = self.ego.check(scene.at, &scene.ego);
        if share >= 1.0 {
            // A wrong motion also bends the lanes of the scene: it is judged first.
            return (share, found);
        }
        let (of_lanes, found) = self.lanes.check(scene);
        (share.max(of_lanes), found)
    }

    fn correct(&self, scene: &mut Scene) {
        if let Some(own) = self.ego.newest_before(scene.at) {
            scene.ego = own;
        }
        if let (Some(lanes), Some(c)) = (&mut scene.lanes, self.lanes.line(scene.at, &scene.ego)) {
            lanes.c = c;
        }
    }
}

/// Returns the coefficients of a line, seen `from` a time, in the vehicle's frame at `to`, earlier
/// or later. The vehicle moves by `ego`.
fn carried(c: &[f32; 4], from: Instant, to: Instant, ego: &Ego) -> [f32; 4] {
    let seconds = to.since(from).as_secs_f32() - from.since(to).as_secs_f32();
    crate::driving::road::shifted(c, &motion(ego, ego, seconds))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::driving::perception::{Perception, ego_of};
    use tandem_board::Duration;
    use tandem_bus::{EgoMotion, Message};

    /// Alters what a core hears from the time of the fault on.
    type Alter = fn(&mut EgoMotion, &mut CameraLanes);

    const SOUND: Alter = |_, _| {};

    /// Drives 10 s; the fault begins after 5 s. `scene`: alters what core 1 hears, `own`: what
    /// core 0 hears. Returns the scenes from the fault to the finding, and the last scene.
    fn drive(scene: Alter, own: Alter) -> (Option<(u32, Finding)>, Scene) {
        let (mut perception, mut check) = (Perception::new(), SceneCheck::new());
        let mut found = None;
        let mut last = perception.scene().clone();
        for cycle in 0..200_u32 {
            for step in 0..5 {
                let at = Instant::ORIGIN + Duration::from_ms(u64::from(cycle * 50 + step * 10));
                let motion = EgoMotion {
                    speed: 30.0,
                    yaw_rate: 0.03,
                    ..EgoMotion::default()
                };
                let lanes = CameraLanes {
                    valid: true,
                    c0: 0.2 + 0.02 * (cycle as f32).sin(),
                    c1: 0.001 * (cycle as f32 * 1.3).sin(),
                    c2: 0.0005,
                    view_range: 80,
                    width: 3.5,
                    ..CameraLanes::default()
                };
                let heard = |alter: Alter| {
                    let (mut motion, mut lanes) = (motion, lanes);
                    if cycle >= 100 {
                        alter(&mut motion, &mut lanes);
                    }
                    (motion, lanes)
                };
                let ((motion, lanes), (own_motion, own_lanes)) = (heard(scene), heard(own));
                perception.on_message(at, &Message::EgoMotion(motion));
                check.on_ego(at, ego_of(&own_motion));
                if step == 4 {
                    perception.on_message(at, &Message::CameraLanes(lanes));
                    check.on_lanes(at, &own_lanes);
                    last = perception.cycle(at + Duration::from_ms(1)).clone();
                    let _ = check.on_scene(&mut last);
                    let new = check.found().map(|it| (cycle.saturating_sub(100), it));
                    found = found.or(new);
                }
            }
        }
        (found, last)
    }

    const FAULTS: [(u8, Alter); 7] = [
        (0, |_, lanes| lanes.c0 += 0.3),
        (0, |_, lanes| lanes.c1 -= 0.05),
        (0, |_, lanes| lanes.c2 += 0.01),
        (1, |motion, _| motion.speed *= 0.4),
        (2, |motion, _| motion.yaw_rate += 0.1),
        (3, |motion, _| motion.steering_angle -= 0.01),
        (4, |motion, _| motion.slip_angle += 0.05),
    ];

    /// T-RED-9: what only one core hears wrongly is found within half a second, and the core that
    /// hears it is named. The system then has the right values.
    #[test]
    fn a_value_that_one_core_hears_wrongly_is_found() {
        let (none, right) = drive(SOUND, SOUND);
        assert_eq!(none, None);
        for (what, fault) in FAULTS {
            for hearing in [false, true] {
                let (scene, own) = if hearing {
                    (SOUND, fault)
                } else {
                    (fault, SOUND)
                };
                let (found, last) = drive(scene, own);
                let Some((scenes, found)) = found else {
                    panic!("{what} {hearing} is not found")
                };
                assert!(scenes < 10, "{what} {hearing}: {scenes} scenes");
                assert_eq!((found.what, found.hearing), (what, hearing));
                let lines = last
                    .lanes
                    .zip(right.lanes)
                    .map(|(is, right)| (is.c, right.c));
                let aside = lines.map(|(is, right)| (is[0] - right[0]).abs());
                assert!(aside.is_some_and(|aside| aside < 0.06), "{what}: {aside:?}");
                assert!((last.ego.speed - right.ego.speed).abs() < 0.1, "{what}");
            }
        }
    }

    /// T-RED-9: what both cores hear is no contradiction, even if the sensor itself jumps.
    #[test]
    fn a_sensor_that_is_wrong_for_both_cores_is_no_finding() {
        for (what, fault) in FAULTS {
            let (found, _) = drive(fault, fault);
            assert_eq!(found, None, "{what}");
        }
    }
}
