//! Checks core 1's scene against the frames of camera and chassis that core 0 hears itself. T-RED-9
//!
//! A value that only one of the two cores hears wrongly is found here, whichever core it is. What
//! continues the values on which both agreed last is right: by it, a system that drives alone
//! stops. The limits and their reasons are in `docs/decisions/0030-scene-check.md`.

mod ego;
mod lanes;
mod objects;
mod peer;
mod sensors;

use crate::driving::odometry::motion;
use crate::driving::perception::{GlobalClock, SensorClocks};
use crate::driving::road::shifted;
use crate::driving::types::{CameraLine, Ego, Scene};
use crate::trace::Event;
use ego::EgoCheck;
use lanes::LaneCheck;
use objects::ObjectCheck;
use peer::PeerCheck;
pub(super) use peer::PeerScene;
use sensors::SensorCheck;
use tandem_board::{Duration, Instant};
use tandem_bus::{CameraLanes, SensorHeader, SensorId, SensorObject};

/// The values on which two sources agreed are carried on for this long at most.
const REMEMBERED: Duration = Duration::from_ms(2_000);

/// A value of the scene that differs from another source for too long.
struct Difference {
    /// As in [`Event::WrongScene`].
    what: u8,
    /// The other source is wrong: the scene continues the value on which both agreed. `None` if
    /// they did not agree in the last [`REMEMBERED`].
    other: Option<bool>,
    /// m, m/s, rad/s or rad.
    amount: f32,
}

impl Difference {
    fn between_cores(self) -> Finding {
        Finding {
            what: self.what,
            hearing: self.other == Some(true),
            is_located: self.other.is_some(),
            amount: self.amount,
        }
    }
}

/// Something that the two cores do not hear alike.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Finding {
    /// 0 the lanes, else a value of motion or objects, as in [`Event::WrongScene`].
    what: u8,
    /// Core 0 hears wrong values; otherwise the scene is wrong.
    pub(super) hearing: bool,
    /// The values on which both agreed tell which core is wrong.
    is_located: bool,
    /// The difference: m, m/s, rad/s or rad.
    amount: f32,
}

impl Finding {
    /// Returns the finding with the core that hears wrongly by the newest evidence: a difference
    /// that is small at first does not tell at once which core it is.
    fn relocated(self, again: Option<Self>) -> Self {
        let is_motion = |what| matches!(what, 1..=4 | 8);
        let same = |it: &Self| it.what == self.what || is_motion(it.what) && is_motion(self.what);
        let located = again.filter(|it| it.is_located && same(it));
        Self {
            hearing: located.map_or(self.hearing, |it| it.hearing),
            ..self
        }
    }

    pub(super) fn event(self) -> Event {
        Event::WrongScene {
            what: self.what,
            hearing: self.hearing,
            thousandths: (self.amount.abs() * 1e3) as u32,
        }
    }
}

/// The system to suspect if two scenes differ and none is known to have jumped.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Suspect {
    /// This system has left recently because it was wrong.
    Own,
    /// The other system has left.
    Peer,
}

/// All checks and what they have found. Costs about 600 multiplications in 50 ms, most of them for
/// the filter of the lanes.
pub(super) struct SceneCheck {
    clocks: SensorClocks,
    ego: EgoCheck,
    lanes: LaneCheck,
    objects: ObjectCheck,
    peer: PeerCheck,
    sensors: SensorCheck,
    /// What the newest scene said before it was corrected.
    own: Option<PeerScene>,
    found: Option<Finding>,
    /// The newest scene is not that of core 1: it was corrected or completed.
    is_changed: bool,
    /// The motion in the last scene.
    last_ego: Ego,
    /// The largest share that was traced, in tenths.
    worst_tenths: u8,
}

impl SceneCheck {
    pub(super) fn new() -> Self {
        Self {
            clocks: SensorClocks::default(),
            ego: EgoCheck::new(0.0),
            lanes: LaneCheck::new(),
            objects: ObjectCheck::new(),
            peer: PeerCheck::new(),
            sensors: SensorCheck::new(),
            own: None,
            found: None,
            is_changed: false,
            last_ego: Ego::default(),
            worst_tenths: 0,
        }
    }

    /// Sets the global time of this system; `None` if it has none that is good enough.
    pub(super) const fn set_global(&mut self, global: Option<GlobalClock>) {
        self.clocks.set_global(global);
    }

    /// Takes the chassis' motion that core 0 has heard.
    pub(super) fn on_ego(&mut self, at: Instant, ego: Ego) {
        self.ego.on_ego(at, ego);
    }

    /// Takes the camera's lanes that core 0 has heard.
    pub(super) fn on_lanes(&mut self, at: Instant, camera: &CameraLanes) {
        if let Some(line) = CameraLine::of(at, camera) {
            self.lanes.on_line(line);
        }
        let measured = self.clocks.time_of_lanes(at, camera.into());
        // No motion: that is found elsewhere.
        if let (true, Some(ego)) = (camera.valid, self.ego.newest_before(measured)) {
            self.lanes.on_camera(measured, camera, &ego);
        }
    }

    /// Takes the header of a sensor's list that core 0 has heard.
    pub(super) fn on_header(&mut self, at: Instant, sensor: SensorId, header: &SensorHeader) {
        let measured = self.clocks.time_of(at, sensor, header.into());
        self.objects.on_header(measured, sensor);
    }

    /// Takes an object of a sensor's list that core 0 has heard.
    pub(super) fn on_object(&mut self, sensor: SensorId, object: &SensorObject) {
        self.objects.on_object(sensor, object);
    }

    /// Takes the other system's scene.
    pub(super) fn on_peer(&mut self, scene: PeerScene) {
        self.peer.on_peer(scene);
    }

    /// Returns what the newest scene says, for the other system.
    pub(super) const fn own(&self) -> Option<PeerScene> {
        self.own
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

    /// Returns whether a sensor is wrong for all: then the vehicle stops.
    pub(super) fn is_lied_to(&self) -> bool {
        self.sensors.liar().is_some()
    }

    /// Returns the motion that was heard, with what the other sensors say in the place of one that
    /// is wrong for all.
    pub(super) fn corrected(&self, ego: Ego) -> Ego {
        self.sensors.corrected(ego)
    }

    /// Returns whether core 2 has another scene than core 0: this one was corrected or completed.
    pub(super) const fn is_changed(&self) -> bool {
        self.is_changed
    }

    /// Returns the scene's motion if core 0 hears none of its own, but core 1 does.
    pub(super) fn heard_by_scene(&self, scene: &Scene) -> Option<Ego> {
        let is_needed = self.is_deceived() || !self.ego.is_heard(scene.at);
        (is_needed && scene.ego != self.last_ego).then_some(scene.ego)
    }

    /// Checks a new scene. Once it was found wrong, puts core 0's values in the place of the
    /// scene's. Returns an event to trace.
    pub(super) fn on_scene(
        &mut self,
        scene: &mut Scene,
        suspect: Option<Suspect>,
    ) -> Option<Event> {
        self.last_ego = scene.ego;
        // Without motion, the scene keeps its last one.
        let hears_motion = self.ego.is_heard(scene.at);
        self.own = PeerScene::of(scene).filter(|_| hears_motion);
        let (of_cores, found) = self.check(scene);
        let again = found;
        let (of_systems, event) = match self.found.or(found) {
            None => self.compare(scene, suspect),
            found => {
                let is_new = self.found.is_none();
                self.found = found.map(|it| it.relocated(again));
                (0.0, found.filter(|_| is_new).map(Finding::event))
            }
        };
        let lie = match self.found {
            None if hears_motion && self.hears_alike() => self.sensors.on_scene(scene),
            _ => None,
        };
        let event = lie.or(event);
        self.is_changed = self.found.is_some_and(|found| !found.hearing);
        if self.is_changed {
            self.correct(scene);
        } else if self.sensors.liar().is_some() {
            self.sensors.correct(scene);
            self.is_changed = true;
        } else if scene.lanes.is_none() && hears_motion {
            // Core 1 does not hear the camera, but core 0 does.
            scene.lanes = self.lanes.lanes(scene.at, &scene.ego);
            self.is_changed = scene.lanes.is_some();
        }
        let percent = (of_cores.max(of_systems) * 100.0) as u8;
        let is_worst = percent / 10 > self.worst_tenths;
        self.worst_tenths = self.worst_tenths.max(percent / 10);
        let event = event.or_else(|| self.objects.contradiction());
        event.or(is_worst.then_some(Event::SceneCheck { percent }))
    }

    /// Returns whether both cores hear the same motion and the same line.
    const fn hears_alike(&self) -> bool {
        self.ego.is_same() && self.lanes.is_same()
    }

    /// Compares the scene with the other system's. A system whose own scene jumped leaves, unless
    /// the other one has just left. If neither is known to have jumped, a system that has just left
    /// for such a fault leaves again; otherwise the comparison of commands decides.
    fn compare(&mut self, scene: &Scene, suspect: Option<Suspect>) -> (f32, Option<Event>) {
        if self.own.is_none() {
            self.peer = PeerCheck::new();
            return (0.0, None);
        }
        let (share, difference) = self.peer.check(scene);
        let Some(difference) = difference else {
            return (share, None);
        };
        let jumped = difference.other.map(|other| !other);
        let own = suspect != Some(Suspect::Peer) && jumped.unwrap_or(suspect == Some(Suspect::Own));
        let event = Event::PeerScene {
            what: difference.what,
            own,
            thousandths: (difference.amount.abs() * 1e3) as u32,
        };
        let is_new = self.peer.is_new();
        if own {
            let found = difference.between_cores();
            self.found = Some(Finding {
                hearing: false,
                ..found
            });
        }
        (share, is_new.then_some(event))
    }

    /// Returns the largest difference as a share of what is tolerated, and what was found.
    fn check(&mut self, scene: &Scene) -> (f32, Option<Finding>) {
        let (share, found) = self.ego.check(scene.at, &scene.ego);
        if share >= 1.0 || found.is_some() {
            // A wrong motion also bends the lanes of the scene: it is judged first.
            return (share, found.map(Difference::between_cores));
        }
        let (of_lanes, found) = self.lanes.check(scene);
        let found = found.map(Difference::between_cores);
        let view = self.lanes.view(scene.at, &scene.ego);
        let (of_objects, other) = self.objects.check(scene, view);
        (share.max(of_lanes).max(of_objects), found.or(other))
    }

    fn correct(&self, scene: &mut Scene) {
        if let Some(own) = self.ego.newest_before(scene.at) {
            scene.ego = own;
        }
        if let (Some(lanes), Some(c)) = (&mut scene.lanes, self.lanes.line(scene.at, &scene.ego)) {
            lanes.c = c;
        }
        self.objects.correct(scene);
    }
}

/// A line that is moved along with the vehicle, scene by scene: so the noise of the motion averages
/// out.
#[derive(Clone, Copy)]
struct MovedLine {
    line: CameraLine,
    /// The motion at that time.
    ego: Ego,
}

impl MovedLine {
    /// Moves the line to this time.
    fn to(&mut self, at: Instant, ego: &Ego) {
        let step = motion(&self.ego, ego, at.since(self.line.at).as_secs_f32());
        let c = shifted(&self.line.c, &step);
        (self.line, self.ego) = (CameraLine { at, c }, *ego);
    }
}

/// Returns the coefficients of a line, seen `from` a time, in the vehicle's frame at `to`, earlier
/// or later. The vehicle moves by `ego`.
fn carried(c: &[f32; 4], from: Instant, to: Instant, ego: &Ego) -> [f32; 4] {
    let seconds = to.since(from).as_secs_f32() - from.since(to).as_secs_f32();
    shifted(c, &motion(ego, ego, seconds))
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
                    let _ = check.on_scene(&mut last, None);
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

    /// T-RED-9: a difference of one bit is found too: both cores hear the same frames.
    #[test]
    fn the_smallest_difference_is_found() {
        let faults: [(u8, Alter); 4] = [
            (0, |_, lanes| lanes.c1 = -lanes.c1),
            (0, |_, lanes| {
                lanes.c2 = f32::from_bits(lanes.c2.to_bits() + 1)
            }),
            (4, |motion, _| motion.slip_angle += 1e-6),
            (1, |motion, _| motion.speed += 1e-3),
        ];
        for (what, fault) in faults {
            for (scene, own) in [(SOUND, fault), (fault, SOUND)] {
                let (found, _) = drive(scene, own);
                let (scenes, found) = found.expect("a finding");
                assert!(scenes <= 3, "{what}: {scenes} scenes");
                assert_eq!(found.what, what);
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

    /// Runs 10 s of scenes of two systems; from 5 s on, `alter` alters this system's, and `peers`
    /// the other's. Returns what is reported: whether this system leaves.
    fn compared(
        alter: impl Fn(&mut PeerScene),
        peers: impl Fn(&mut PeerScene),
        suspect: Option<Suspect>,
        from: u32,
    ) -> Option<bool> {
        let mut check = SceneCheck::new();
        let ms = |ms: u32| Instant::ORIGIN + Duration::from_ms(ms.into());
        let mut reported = None;
        for cycle in 0..200_u32 {
            let wave = |phase: f32| 0.02 * (cycle as f32 + phase).sin();
            let said = |at, phase| PeerScene {
                at,
                c: [0.2 + wave(phase), 0.001, 0.0005, 0.0],
                ego: Ego {
                    speed: 30.0 + wave(phase),
                    yaw_rate: 0.03,
                    ..Ego::default()
                },
            };
            let (mut own, mut peer) = (said(ms(cycle * 50 + 30), 0.0), said(ms(cycle * 50), 0.7));
            if cycle >= from {
                alter(&mut own);
                peers(&mut peer);
            }
            check.on_peer(peer);
            check.on_ego(own.at, own.ego);
            let lanes = crate::driving::types::Lanes {
                c: own.c,
                ..crate::driving::types::Lanes::alone(3.5, 80.0)
            };
            let mut scene = Scene {
                at: own.at,
                ego: own.ego,
                lanes: Some(lanes),
                ..Perception::new().scene().clone()
            };
            if let Some(Event::PeerScene { own, .. }) = check.on_scene(&mut scene, suspect) {
                reported.get_or_insert(own);
                assert_eq!(check.found().is_some(), own);
            }
        }
        reported
    }

    /// T-RED-9: the system whose scene jumps finds it by the other's scene, and leaves; the other
    /// stays. A difference from the start cannot be located, unless a system left for it before.
    #[test]
    fn the_system_whose_scene_jumps_leaves() {
        let same = |_: &mut PeerScene| {};
        let faults: [fn(&mut PeerScene); 5] = [
            |it| it.c[0] += 1.0,
            |it| it.c[1] -= 0.05,
            |it| it.ego.speed *= 0.4,
            |it| it.ego.yaw_rate += 0.2,
            |it| it.c[0] = f32::NAN,
        ];
        assert_eq!(compared(same, same, Some(Suspect::Own), 0), None);
        for (number, fault) in faults.into_iter().enumerate() {
            assert_eq!(compared(fault, same, None, 100), Some(true), "{number}");
            assert_eq!(compared(same, fault, None, 100), Some(false), "{number}");
            for suspect in [None, Some(Suspect::Own), Some(Suspect::Peer)] {
                let reported = compared(fault, same, suspect, 0);
                assert_eq!(reported, Some(suspect == Some(Suspect::Own)), "{number}");
            }
            // A system that has just left does not make the other one leave.
            let reported = compared(fault, same, Some(Suspect::Peer), 100);
            assert_eq!(reported, Some(false), "{number}");
        }
    }
}
