//! Perception (core 1, every 50 ms): fuses five radars and a camera into one scene. T-CHIP-3,
//! T-CHIP-4
//!
//! [`Perception::on_message`] takes bus frames at any time; [`Perception::cycle`] does the work:
//! predict the tracks to each list's time, assign, update, begin and end tracks, then analyse
//! motion and scene. All data are in the frame of the vehicle and are moved with it.

mod assignment;
mod kalman;
mod lane;
mod lists;
mod round;
mod scene;
mod sensor_time;
mod timeline;
mod track;

use heapless::Vec;
use tandem_board::{Duration, Instant};
use tandem_bus::{CameraLanes, DriverRequest, EgoMotion, Message, SensorId, SensorObject};

use super::control::driven_curvature;
use super::knowledge::{KNOWLEDGE_MAX_AGE, Knowledge, STARTING_CYCLES};
use super::odometry::{Odometry, motion};
use super::road::shifted;
use super::types::{CameraLine, Ego, Object, RouteCode, Scene};
use assignment::{Costs, IMPOSSIBLE, assign};
pub(crate) use lane::LaneFilter;
use lists::Lists;
use round::{LANES, Round};
use scene::RoadView;
pub use sensor_time::GlobalClock;
pub(crate) use sensor_time::{RefusedStamp, SensorClocks};
use timeline::Timeline;
use track::{Detection, Passage, Track};

/// Largest number of tracks, confirmed or not.
const MAX_TRACKS: usize = 32;
/// Largest number of detections in one list: the limit of the header.
const MAX_DETECTIONS: usize = 32;

/// A sensor is lost, or late, if its newest list was measured longer ago than this: six of its
/// periods. Predictions over a longer time are of no use.
pub const SENSOR_LIMIT: Duration = Duration::from_ms(300);

/// Lanes that no cycle has used.
#[derive(Clone, Copy, Debug)]
struct NewLanes {
    /// When their frame was on the bus, on this system's clock.
    heard: Instant,
    /// The same on the timeline.
    arrived: Instant,
    measured: Instant,
    lanes: CameraLanes,
}

/// The perception function with all its memory: about 14 KiB, without allocation.
///
/// All times that it is given and returns are on this system's clock, all that it stores on the
/// timeline; the sensors' clocks are learned on this system's clock.
#[derive(Clone, Debug)]
pub struct Perception {
    timeline: Timeline,
    odometry: Odometry,
    clocks: SensorClocks,
    lists: Lists,
    camera_lanes: Option<NewLanes>,
    lanes: LaneFilter,
    tracks: Vec<Track, MAX_TRACKS>,
    /// The time up to which tracks and lanes are predicted.
    time: Option<Instant>,
    /// The inputs of the last cycle.
    round: Round,
    /// When each sensor measured its newest list, by [`SensorId::index`]; before the first list,
    /// the time of the first cycle.
    measured: [Option<Instant>; SensorId::ALL.len()],
    next_id: u32,
    /// The request of the driver.
    request: DriverRequest,
    scene: Scene,
}

impl Default for Perception {
    fn default() -> Self {
        Self::new()
    }
}

impl Perception {
    /// Creates a perception that has received nothing yet.
    #[must_use]
    pub fn new() -> Self {
        Self {
            timeline: Timeline::default(),
            odometry: Odometry::new(),
            clocks: SensorClocks::default(),
            lists: Lists::default(),
            camera_lanes: None,
            lanes: LaneFilter::new(),
            tracks: Vec::new(),
            time: None,
            round: Round::default(),
            measured: [None; SensorId::ALL.len()],
            next_id: 1,
            request: DriverRequest::default(),
            scene: Scene {
                at: Instant::ORIGIN,
                moment: None,
                measured: Instant::ORIGIN,
                cycle: 0,
                missing: 0,
                ego: Ego::default(),
                lanes: None,
                camera: CameraLine::default(),
                set_speed: None,
                route: RouteCode::Free,
                near_gap: false,
                lane_offset: 0.0,
                objects: Vec::new(),
            },
        }
    }

    /// Sets the global time of this system; `None` if it has none that is good enough. It is used
    /// for the stamps of the frames that follow.
    pub fn set_global(&mut self, global: Option<GlobalClock>) {
        self.clocks.set_global(global);
        if let Some(by_ns) = self.timeline.follow(global.as_ref()) {
            self.shift(by_ns);
        }
    }

    /// Returns whether it computes on the vehicle's time. Then a cycle is at the time of the frame
    /// that completed the round, and uses no frame that was on the bus after it.
    #[must_use]
    pub const fn is_on_vehicle_time(&self) -> bool {
        self.timeline.is_shared()
    }

    /// The timeline has leapt: all stored times leap with it, so nothing ages by that.
    fn shift(&mut self, by_ns: i64) {
        self.odometry.shift(by_ns);
        self.lists.shift(by_ns);
        self.lanes.shift(by_ns);
        self.round.shift(by_ns);
        if let Some(new) = &mut self.camera_lanes {
            (new.arrived, new.measured) = (new.arrived.moved(by_ns), new.measured.moved(by_ns));
        }
        for at in self.measured.iter_mut().chain([&mut self.time]).flatten() {
            *at = at.moved(by_ns);
        }
    }

    /// Returns the newest stamp in global time that was refused after others were used, once.
    pub(crate) const fn take_refused(&mut self) -> Option<RefusedStamp> {
        self.clocks.take_refused()
    }

    /// Takes in a frame that was on the bus at `now`. Ignores frames that no sensor, chassis or
    /// driver sends.
    ///
    /// The time of a list and of lanes is their sensor's time stamp.
    pub fn on_message(&mut self, now: Instant, message: &Message) {
        let arrived = self.timeline.of(now);
        match message {
            Message::EgoMotion(motion) => self.odometry.update(arrived, &ego_of(motion)),
            Message::DriverRequest(request) => self.request = *request,
            Message::SensorHeader(sensor, header) => {
                let at = self.clocks.time_of(now, *sensor, header.into());
                let at = self.timeline.of_stamp(at, header.measured_at);
                self.lists.begin((arrived, at), *sensor, header);
            }
            Message::SensorObject(sensor, object) => self.lists.add(arrived, *sensor, object),
            Message::CameraLanes(lanes) => {
                let at = self.clocks.time_of_lanes(now, lanes.into());
                self.camera_lanes = Some(NewLanes {
                    heard: now,
                    arrived,
                    measured: self.timeline.of_stamp(at, lanes.measured_at),
                    lanes: *lanes,
                });
            }
            _ => {}
        }
    }

    /// Returns whether all inputs that the last cycle used have arrived again. A sensor that missed
    /// the last cycle is not waited for, so a lost sensor delays one cycle.
    #[must_use]
    pub fn is_round_complete(&self) -> bool {
        self.round.is_next_complete(|member| match member {
            LANES => self.camera_lanes.map(|new| new.arrived),
            sensor => self.lists.completed(sensor),
        })
    }

    /// Returns the time after `now` at which all these inputs are next expected, if they arrive
    /// every `period`; `None` if nothing arrived for the last cycle.
    pub fn next_round(&mut self, now: Instant, period: Duration) -> Option<Instant> {
        let next = self.round.next_end(self.timeline.of(now), period)?;
        Some(self.timeline.local(next))
    }

    /// The scene at `now`, from everything that has arrived. Called every 50 ms; time is bounded.
    pub fn cycle(&mut self, now: Instant) -> &Scene {
        self.cycle_with(now, None)
    }

    /// Returns whether [`Perception::cycle_with`] still accepts knowledge.
    #[must_use]
    pub const fn is_starting(&self) -> bool {
        self.scene.cycle < STARTING_CYCLES
    }

    /// [`Perception::cycle`] with knowledge of another system. It makes the tracks and lanes of
    /// this system more precise; it adds nothing to the scene and removes nothing. Knowledge is
    /// ignored if it is old, or after the first [`STARTING_CYCLES`] cycles.
    pub fn cycle_with(&mut self, now: Instant, received: Option<&Knowledge>) -> &Scene {
        let now = self.timeline.of(now);
        if self.timeline.is_shared() {
            self.odometry.rebase();
        }
        self.round = Round::default();
        let mut oldest: Option<Instant> = None;
        // At most one list of each sensor is pending.
        for _ in SensorId::ALL {
            let Some((sensor, at, done, objects)) = self.lists.take(now) else {
                break;
            };
            self.round.add(sensor.index(), done);
            self.measured[sensor.index()] = Some(at);
            // Oldest first.
            oldest = oldest.or(Some(at));
            self.advance(at);
            self.fuse(sensor, at, &objects);
        }
        if let Some(new) = self.camera_lanes.take() {
            self.round.add(LANES, new.arrived);
            let at = new.measured;
            oldest = Some(oldest.map_or(at, |oldest| oldest.min(at)));
            self.advance(at);
            self.lanes.update(at, &self.carried(&new));
            let line = CameraLine::of(new.heard, &new.lanes);
            self.scene.camera = line.unwrap_or(self.scene.camera);
        }
        self.scene.measured = oldest.map_or(self.scene.measured, |at| self.timeline.local(at));
        // The grid may place the last frame before the measurement that it belongs to.
        let newest = self.time.filter(|_| self.timeline.is_shared());
        let now = newest.map_or(now, |newest| now.max(newest));
        self.scene.missing = self.missing(now);
        self.advance(now);
        let known_at = |it: &Knowledge| self.timeline.of(it.at);
        if let Some((received, at)) = received
            .map(|received| (received, known_at(received)))
            .filter(|(_, at)| now.since(*at) <= KNOWLEDGE_MAX_AGE)
            && self.is_starting()
        {
            self.recall((now, at), received);
        }
        self.tidy();
        self.lanes.expire(now);
        self.analyse(now);
        &self.scene
    }

    /// Returns the last scene.
    #[must_use]
    pub fn scene(&self) -> &Scene {
        &self.scene
    }

    /// Returns the sensors whose newest measurement is too old.
    fn missing(&mut self, now: Instant) -> u8 {
        let mut missing = 0;
        for (index, measured) in self.measured.iter_mut().enumerate() {
            let is_missing = now.since(*measured.get_or_insert(now)) > SENSOR_LIMIT;
            missing |= u8::from(is_missing) << index;
        }
        missing
    }

    /// Predicts tracks and lanes to `to`, if that is later.
    fn advance(&mut self, to: Instant) {
        let from = *self.time.get_or_insert(to);
        if to <= from {
            return;
        }
        let dt = to.since(from).as_secs_f32();
        let step = self.odometry.between(from, to);
        let passage = Passage::new(dt, &step);
        for track in &mut self.tracks {
            track.predict(&passage);
        }
        self.lanes.predict(dt, &step);
        self.time = Some(to);
    }

    /// Returns the lanes in the frame of the vehicle at the time up to which the tracks are
    /// predicted.
    fn carried(&self, new: &NewLanes) -> CameraLanes {
        let lanes = new.lanes;
        let Some(to) = self.time.filter(|time| *time > new.measured) else {
            return lanes;
        };
        let step = self.odometry.between(new.measured, to);
        let [c0, c1, c2, c3] = shifted(&[lanes.c0, lanes.c1, lanes.c2, lanes.c3], &step);
        CameraLanes {
            c0,
            c1,
            c2,
            c3,
            ..lanes
        }
    }

    /// Takes in the list of one sensor, measured at or before the time up to which the tracks are
    /// predicted. Older objects are moved to that time.
    fn fuse(&mut self, sensor: SensorId, at: Instant, objects: &[SensorObject]) {
        let ego = *self.odometry.ego();
        let to = self.time.unwrap_or(at).max(at);
        let lag_s = to.since(at).as_secs_f32();
        let moved = (lag_s > 0.0).then(|| self.odometry.between(at, to));
        let mut detections: Vec<Detection, MAX_DETECTIONS> = Vec::new();
        for object in objects {
            // Cannot be full: a list is no longer than this.
            let detection = Detection::new(sensor, object, &ego);
            let _ = detections.push(match moved {
                Some(step) => detection.carried(lag_s, step),
                None => detection,
            });
        }
        let mut costs = Costs::new();
        for track in &self.tracks {
            let mut row = [IMPOSSIBLE; MAX_DETECTIONS];
            for (cost, detection) in row.iter_mut().zip(&detections) {
                *cost = track.fit(detection).map_or(IMPOSSIBLE, |fit| fit.cost());
            }
            // Cannot be full: one row for each track.
            let _ = costs.push(row);
        }
        let assigned = assign(&costs, detections.len());
        let mut used = [false; MAX_DETECTIONS];
        for (t, track) in self.tracks.iter_mut().enumerate() {
            if let Some(d) = assigned[t]
                && let Some(fit) = track.fit(&detections[d])
            {
                track.update(&fit, &detections[d]);
                used[d] = true;
            }
        }
        for (d, detection) in detections.iter().enumerate() {
            if !used[d] {
                self.begin_track(detection);
            }
        }
    }

    /// Uses the knowledge of another system as the prediction, which detections then correct.
    fn recall(&mut self, (now, at): (Instant, Instant), received: &Knowledge) {
        let dt = now.since(at).as_secs_f32();
        let step = motion(&received.ego, self.odometry.ego(), dt);
        if let Some(line) = &received.line {
            self.lanes.recall(now, &line.c, dt, &step);
        }
        for known in received.objects.iter().filter_map(|object| object.unpack()) {
            let known = Track::received(self.next_id, &known, dt, &step);
            match self.tracks.iter_mut().find(|own| own.is_same(&known)) {
                Some(own) => own.recall(&known, dt),
                // Not confirmed: it is not in the scene until a sensor of this system sees it.
                None => {
                    self.next_id = self.next_id.wrapping_add(1);
                    let _full = self.tracks.push(known);
                }
            }
        }
    }

    /// Begins a track. If there is no place, it replaces the farthest unconfirmed one.
    fn begin_track(&mut self, detection: &Detection) {
        let track = Track::new(self.next_id, detection);
        self.next_id = self.next_id.wrapping_add(1);
        if let Err(track) = self.tracks.push(track) {
            let farthest = self.tracks.iter_mut().max_by(|a, b| {
                (!a.confirmed, distance(a))
                    .partial_cmp(&(!b.confirmed, distance(b)))
                    .unwrap_or(core::cmp::Ordering::Equal)
            });
            if let Some(farthest) = farthest
                && distance(&track) < distance(farthest)
            {
                *farthest = track;
            }
        }
    }

    /// Ends lost tracks and merges duplicates.
    fn tidy(&mut self) {
        self.tracks.retain(|track| !track.is_lost());
        let mut first = 0;
        while first < self.tracks.len() {
            let mut second = first + 1;
            while second < self.tracks.len() {
                if self.tracks[first].is_same(&self.tracks[second]) {
                    if self.tracks[second].is_better_than(&self.tracks[first]) {
                        self.tracks.swap(first, second);
                    }
                    let double = self.tracks.swap_remove(second);
                    self.tracks[first].absorb(&double);
                } else {
                    second += 1;
                }
            }
            first += 1;
        }
    }

    fn analyse(&mut self, now: Instant) {
        let ego = *self.odometry.ego();
        let lanes = self.lanes.lanes(now);
        let road = RoadView::new(lanes.as_ref(), driven_curvature(&ego));
        self.scene.at = self.timeline.local(now);
        self.scene.moment = self.timeline.is_shared().then_some(now);
        self.scene.cycle = self.scene.cycle.wrapping_add(1);
        self.scene.ego = ego;
        self.scene.lanes = lanes;
        let asked = &self.request;
        // A driver who wants the vehicle parked wants it to stop where the SoC can begin. D-3
        let set_speed = if asked.park { 0.0 } else { asked.set_speed };
        self.scene.set_speed = asked.engage.then_some(set_speed);
        self.scene.route = asked.route;
        self.scene.near_gap = asked.near_gap;
        self.scene.lane_offset = asked.lane_offset;
        self.scene.objects.clear();
        self.tracks.sort_unstable_by(|a, b| {
            distance(a)
                .partial_cmp(&distance(b))
                .unwrap_or(core::cmp::Ordering::Equal)
        });
        for track in &mut self.tracks {
            let place = road.place(track);
            if !track.confirmed {
                continue;
            }
            let object = Object {
                id: track.id,
                class: track.class,
                x: track.x.position(),
                y: track.y.position(),
                vx: track.x.velocity(),
                vy: track.y.velocity(),
                ax: track.x.acceleration(),
                ay: track.y.acceleration(),
                length: track.length,
                width: track.width,
                lane: place.lane,
                cuts_in: place.cuts_in,
                approaching: track.approaching,
            };
            if self.scene.objects.push(object).is_err() {
                break;
            }
        }
    }
}

/// Squared distance from the ego vehicle, m².
fn distance(track: &Track) -> f32 {
    let (x, y) = (track.x.position(), track.y.position());
    x * x + y * y
}

/// Returns the ego's motion in a bus message.
#[must_use]
pub fn ego_of(motion: &EgoMotion) -> Ego {
    Ego {
        speed: motion.speed,
        yaw_rate: motion.yaw_rate,
        acceleration: motion.long_acceleration,
        steering_angle: motion.steering_angle,
        slip_angle: motion.slip_angle,
    }
}
