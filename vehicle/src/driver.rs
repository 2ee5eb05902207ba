//! The person at the wheel: engages the function, overrides it, answers its takeover request, asks
//! for parking, and drives while the function does not.

use crate::actuators::Request;
use crate::geometry::Pose;
use crate::plant::BMW_320I;
use crate::road::{LaneId, Road};
use crate::route::Advice;
use crate::traffic::{self, Leader};
use tandem_bus::DriverRequest;

/// How far ahead the driver aims: a fixed distance, m, plus the distance driven in this time, s.
const AIM: (f64, f64) = (8.0, 1.0);

/// The driver's actions in a run. The default engages the function and then never acts again.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Habit {
    /// Overrides the function between these two scenario times, s.
    pub overrides_s: Option<(f64, f64)>,
    /// Time from the function's request to the driver's takeover, s.
    pub answers_after_s: Option<f64>,
    /// Asks for parking from this scenario time on, s.
    pub parks_from_s: Option<f64>,
}

/// The driver and what has happened so far.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Driver {
    habit: Habit,
    /// Scenario time at which the function's present request to take over began, s.
    asked_s: Option<f64>,
    has_taken_over: bool,
}

impl Driver {
    pub(crate) fn new(habit: Habit) -> Self {
        Self {
            habit,
            ..Self::default()
        }
    }

    /// Records whether the function's frame asks the driver to take over.
    pub(crate) fn on_request(&mut self, time_s: f64, asks: bool) {
        self.asked_s = asks.then(|| self.asked_s.unwrap_or(time_s));
    }

    /// Returns whether the driver wants the vehicle parked.
    pub(crate) fn parks(&self, time_s: f64) -> bool {
        let parks = self.habit.parks_from_s;
        !self.has_taken_over && parks.is_some_and(|from_s| time_s >= from_s)
    }

    /// Returns the content of the driver's frame.
    pub(crate) fn wish(&mut self, time_s: f64, advice: &Advice) -> DriverRequest {
        let answers = self.asked_s.zip(self.habit.answers_after_s);
        self.has_taken_over |=
            answers.is_some_and(|(since_s, after_s)| time_s >= since_s + after_s);
        let overrides = |(from_s, to_s): (f64, f64)| (from_s..to_s).contains(&time_s);
        DriverRequest {
            engage: !self.has_taken_over,
            overrides: self.has_taken_over || self.habit.overrides_s.is_some_and(overrides),
            route: advice.route,
            near_gap: advice.near_gap,
            park: self.parks(time_s),
            set_speed: advice.set_speed as f32,
            lane_offset: advice.lane_offset as f32,
        }
    }
}

/// The situation that the driver sees.
pub(crate) struct View {
    pub(crate) pose: Pose,
    /// m/s
    pub(crate) speed: f64,
    pub(crate) lane: LaneId,
    /// Arc length in that lane, m.
    pub(crate) station: f64,
    /// The next object ahead in that lane.
    pub(crate) leader: Leader,
}

/// Returns the driver's request: it keeps the lane, the set speed and the distance.
pub(crate) fn by_hand(road: &Road, now: &View, set_speed: f64) -> Request {
    let lane = road.lane(now.lane);
    let ahead = lane.at(now.station + AIM.0 + AIM.1 * now.speed);
    let aim = now.pose.to_local(ahead.centre);
    let wheelbase = BMW_320I.front_axle + BMW_320I.rear_axle;
    let driver = traffic::IdmParameters {
        desired_speed: set_speed,
        ..traffic::IdmParameters::CAR
    };
    Request {
        steering_angle: (2.0 * wheelbase * aim.y / aim.dot(aim).max(1.0)).atan(),
        acceleration: driver.follow(now.speed, &now.leader),
    }
}
