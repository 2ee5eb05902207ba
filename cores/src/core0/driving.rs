//! Which function drives: trajectory control, the degraded L2 functions, or the safe stop.

use super::plan_check::{Known, PlanCheck};
use crate::driving::control::{MotionControl, Shaper};
use crate::driving::degraded::{DegradedControl, SCENE_MAX_AGE};
use crate::driving::function::{Domain, Driver, Function, FunctionState, Inputs};
use crate::driving::knowledge::Knowledge;
use crate::driving::parking::{BodyRequest, BodyState, Parking, SocSample};
use crate::driving::types::{Command, ControlStep, Ego, Maneuver, Scene, Trajectory};
use crate::trace::Event;
use tandem_board::{Duration, Instant};
use tandem_redundancy::Mode;
use tandem_topics::endpoints::SocTopic;

/// The content of a control frame. It is sent only if the output is open.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Output {
    pub(crate) command: Command,
    /// The function that produced it; a lower mode than requested if inputs were missing.
    pub(crate) mode: Mode,
    /// Age of the oldest measurement that it uses; `None` if it uses none.
    pub(crate) age: Option<Duration>,
    /// The command that this system would give if it had driven all the time.
    pub(crate) standalone: Command,
    /// m/s
    pub(crate) speed: f32,
    /// The step that gave the command, if this system drives.
    pub(crate) step: Option<ControlStep>,
    pub(crate) state: FunctionState,
    /// What to ask of gear and parking brake; `None` if the function has nothing to do with them.
    pub(crate) body: Option<BodyRequest>,
    /// The topic whose silence has ended parking in this cycle.
    pub(crate) silent: Option<SocTopic>,
}

/// The motion control of core 0 with its inputs.
pub struct Driving {
    ego: Option<(Instant, Ego)>,
    trajectory: Option<Trajectory>,
    check: PlanCheck,
    scene: Option<Scene>,
    motion: MotionControl,
    degraded: DegradedControl,
    parking: Parking,
    /// The last command of this system; while it does not drive, the command that the vehicle
    /// obeys.
    last: Command,
    /// Limits the command that this system would give if it had driven all the time.
    standalone: Shaper,
    /// Remaining control cycles for which the vehicle counts as obeying the other system.
    follows: u8,
    function: Function,
    driver: Driver,
    /// The vehicle stays within the operational design domain, as far as is known.
    domain: Domain,
    /// The SoC has brought the vehicle to a place to which no trajectory led, and nothing has
    /// followed one since.
    off_plan: bool,
}

/// A motion of the chassis older than this cannot be used for control.
const EGO_MAX_AGE: Duration = Duration::from_ms(100);

/// An echo of the vehicle is valid for this many control cycles.
const FOLLOWS_CYCLES: u8 = 5;

impl Driving {
    pub(crate) fn new() -> Self {
        Self {
            ego: None,
            trajectory: None,
            check: PlanCheck::default(),
            scene: None,
            motion: MotionControl::new(),
            degraded: DegradedControl::new(),
            parking: Parking::new(),
            last: Command::default(),
            standalone: Shaper::new(),
            follows: 0,
            function: Function::default(),
            driver: Driver::Unheard,
            domain: Domain::default(),
            off_plan: false,
        }
    }

    pub(crate) fn on_ego(&mut self, at: Instant, ego: Ego) {
        let last = self.ego.map(|(last, _)| last);
        if last.is_none_or(|last| at.since(last) > EGO_MAX_AGE) {
            self.check.interrupt();
        }
        self.motion.on_ego(at, &ego);
        self.ego = Some((at, ego));
    }

    /// Takes a trajectory if it is right. Returns an event to trace.
    pub(super) fn on_trajectory(&mut self, new: Trajectory) -> Option<Event> {
        let moves = self
            .ego
            .is_some_and(|(at, _)| new.at.since(at) <= EGO_MAX_AGE);
        let last = self.trajectory.as_ref();
        let moved = last.map(|last| self.motion.moved(last.at, new.at));
        let known = Known {
            scene: self.scene.as_ref().filter(|scene| scene.at == new.at),
            moves,
            last,
            moved: moved.unwrap_or_default(),
        };
        let (is_right, event) = self.check.check(&new, &known, self.off_plan);
        if is_right {
            self.trajectory = Some(new);
        }
        event
    }

    pub(crate) fn on_scene(&mut self, scene: Scene) {
        self.scene = Some(scene);
    }

    /// Returns this system's knowledge, for a system that joins; `None` before the first scene.
    pub(crate) fn knowledge(&self) -> Option<Knowledge> {
        Some(Knowledge::of(
            self.scene.as_ref()?,
            self.trajectory.as_ref(),
        ))
    }

    /// The command that the vehicle obeys while this system does not drive. A takeover continues
    /// from it without a jerk, whatever the other system sent.
    pub(crate) fn on_obeyed(&mut self, command: Command) {
        self.last = command;
        self.follows = FOLLOWS_CYCLES;
    }

    /// The driver's request from the latest frame. It holds until the next frame.
    pub(crate) fn on_driver(&mut self, driver: Driver) {
        self.driver = driver;
    }

    /// Takes a sample of the SoC that arrived at `at`, decoded and checked end to end. It acts only
    /// while the function parks. D-3
    pub fn on_soc(&mut self, at: Instant, sample: SocSample) {
        self.parking.on_sample(at, sample);
    }

    pub(crate) fn on_body(&mut self, body: BodyState) {
        self.parking.on_body(body);
    }

    /// Returns the state of the driving function, with what is known at `now`.
    fn state(&mut self, now: Instant, permitted: Mode, moves: bool, ego: &Ego) -> FunctionState {
        let fresh = |scene: &&Scene| now.since(scene.at) <= SCENE_MAX_AGE;
        let scene = self.scene.as_ref().filter(fresh);
        let lanes = scene.and_then(|scene| Some((scene.lanes.as_ref()?, scene.ego.speed)));
        let is_new = |plan: &&Trajectory| now.since(plan.at) <= SCENE_MAX_AGE;
        // Only one that is followed changes lanes.
        let followed = self.trajectory.as_ref().filter(is_new);
        let followed = followed.filter(|_| self.function.state().mode(permitted) == Mode::L3);
        let maneuver = followed.map_or(Maneuver::Follow, |plan| plan.maneuver);
        // What was near while the driver drove is no end that the function has come to.
        if !self.function.state().is_driving() {
            self.domain = Domain::default();
        }
        // Missing lanes change nothing here: the function is then blind and stops.
        if let Some((lanes, speed)) = lanes {
            self.domain.cycle(now, lanes, speed, maneuver);
        }
        self.function.cycle(
            now,
            &Inputs {
                permitted,
                driver: self.driver,
                sees: moves && lanes.is_some(),
                // The vehicle also leaves the domain if a sensor is lost.
                in_domain: self.domain.stays()
                    && self.scene.as_ref().is_none_or(|it| it.missing == 0),
                parks: self.driver == Driver::Parks && self.parking.may_begin(now, ego),
                soc_silent: self.parking.silent(now).is_some(),
            },
        )
    }

    /// Returns the command for `now` by the best function that `permitted`, the state of the
    /// driving function and the inputs allow.
    pub(crate) fn cycle(&mut self, now: Instant, permitted: Mode) -> Output {
        let fresh = self.ego.filter(|(at, _)| now.since(*at) <= EGO_MAX_AGE);
        let ego = self.ego.map(|(_, ego)| ego).unwrap_or_default();
        let before = self.function.state();
        let state = self.state(now, permitted, fresh.is_some(), &ego);
        let stopped = (before, state) == (FunctionState::Parking, FunctionState::MinimalRisk);
        let silent = self.parking.silent(now).filter(|_| stopped);
        let body = self.parking.body(now, state, ego.speed);
        self.off_plan = body.is_some() || self.off_plan && !state.is_driving();
        let mode = state.mode(permitted);
        if mode == Mode::None {
            // The driver drives: the function begins from the vehicle's present motion.
            self.last = Command {
                steering_angle: ego.steering_angle,
                acceleration: ego.acceleration,
            };
        }
        self.motion.resume(&self.last);
        self.degraded.resume(&self.last);
        self.parking.resume(&self.last);
        let mode = match mode {
            Mode::L3 | Mode::DegradedL2 if fresh.is_none() => Mode::SafeStop,
            mode => mode,
        };
        let stops = fresh.is_some() && mode == Mode::SafeStop;
        let parks = state == FunctionState::Parking && !matches!(mode, Mode::None | Mode::SafeStop);
        let (command, mode, age) = match &self.scene {
            // A parked vehicle is held by its own report.
            _ if parks => {
                let heard = fresh.map(|(at, _)| now.since(at));
                let age = self.parking.age(now).or(heard);
                (self.parking.step(now, &ego), mode, age)
            }
            Some(scene) if stops => {
                let command = self.degraded.stop(now, &ego, scene);
                (command, mode, Some(now.since(scene.measured)))
            }
            _ => self.by_best_function(now, mode, &ego),
        };
        if self.follows == 0 {
            self.standalone.resume(&self.last);
        }
        let standalone = match mode {
            Mode::None => command,
            _ if parks => self.standalone.shape(&self.parking.wish(), &ego),
            Mode::L3 => self.standalone.shape(&self.motion.wish(), &ego),
            Mode::DegradedL2 | Mode::SafeStop => self.standalone.shape(&self.degraded.wish(), &ego),
        };
        self.follows = self.follows.saturating_sub(1);
        self.last = command;
        Output {
            command,
            mode,
            age,
            standalone,
            speed: ego.speed,
            step: match mode {
                Mode::None => None,
                _ if parks => Some(*self.parking.last_step()),
                Mode::L3 => Some(*self.motion.last_step()),
                Mode::DegradedL2 | Mode::SafeStop => Some(*self.degraded.last_step()),
            },
            state,
            body,
            silent,
        }
    }

    /// The command, the function that gave it, and the age of the sensor data that it rests on.
    fn by_best_function(
        &mut self,
        now: Instant,
        mode: Mode,
        ego: &Ego,
    ) -> (Command, Mode, Option<Duration>) {
        if mode == Mode::None {
            return (self.last, mode, None);
        }
        if let (Mode::L3, Some(trajectory)) = (mode, &self.trajectory)
            && let Ok(command) = self.motion.step(now, ego, trajectory)
        {
            return (command, Mode::L3, Some(now.since(trajectory.measured)));
        }
        if let (false, Some(scene)) = (mode == Mode::SafeStop, &self.scene) {
            let command = self.degraded.step(now, ego, scene);
            return (command, Mode::DegradedL2, Some(now.since(scene.measured)));
        }
        (self.degraded.safe_stop(ego), Mode::SafeStop, None)
    }
}

#[cfg(test)]
mod tests;
