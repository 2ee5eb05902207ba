//! Computes the scene and the trajectory from the frames on the bus, by the driving functions of
//! cores 1 and 2.
//!
//! The scenes and trajectories of the systems stay in their shared memory, which no observer may
//! read. Both systems compute them from the frames that they hear, and so do observers.

use tandem_board::{Duration, Instant};
use tandem_bus::FrameReceiver;
use tandem_cores::core1::PERIOD;
use tandem_cores::driving::perception::Perception;
use tandem_cores::driving::planning::Planner;
use tandem_cores::driving::road::CentreLine;
use tandem_cores::driving::types::{Lanes, Object, Scene, Trajectory};

/// A cycle begins without the missing lists this long after the last one: as on core 1.
const PATIENCE: Duration = Duration::from_ms(5);
/// Distance between the points of a lane's border, m.
const STEP_M: f32 = 4.0;
/// No lane is drawn further than this, m.
const FARTHEST_M: f32 = 300.0;
/// The direction of a slower object is not known from its velocity, m/s.
const MOVES_M_S: f32 = 1.0;

/// The driving functions, on the times at which frames were on the bus.
pub struct DrivingView {
    receiver: FrameReceiver,
    perception: Perception,
    planner: Planner,
    last: Option<Instant>,
}

impl Default for DrivingView {
    fn default() -> Self {
        Self::new()
    }
}

impl DrivingView {
    /// Returns them before the first frame.
    #[must_use]
    pub fn new() -> Self {
        Self {
            receiver: FrameReceiver::new(),
            perception: Perception::new(),
            planner: Planner::new(),
            last: None,
        }
    }

    /// Takes in a frame with a standard id that was on the bus at this time. Returns the scene and
    /// the trajectory if it completes a round of the sensors.
    pub fn take(&mut self, now: Instant, id: u32, data: &[u8]) -> Option<(Scene, Trajectory)> {
        let message = self.receiver.receive(id, data).ok()?;
        self.perception.on_message(now, &message);
        let last = *self.last.get_or_insert(now);
        if !self.perception.is_round_complete() && now.since(last) < PERIOD + PATIENCE {
            return None;
        }
        self.last = Some(now);
        let scene = self.perception.cycle(now).clone();
        let trajectory = self.planner.plan(&scene);
        Some((scene, trajectory))
    }
}

/// Returns the borders of the perceived lanes, as points (x, y) in the vehicle frame, m, from
/// `from_m` to `to_m` ahead, as far as the camera sees them. The leftmost border is the first.
#[must_use]
pub fn borders(lanes: &Lanes, from_m: f32, to_m: f32) -> Vec<Vec<(f32, f32)>> {
    let half = lanes.width / 2.0;
    let own = [half, -half];
    let left = lanes.left.map(|width| half + width);
    let right = lanes.right.map(|width| -half - width);
    let centre = CentreLine::new(lanes);
    let to_m = to_m.min(lanes.view_range).clamp(0.0, FARTHEST_M);
    let steps = ((to_m - from_m).max(0.0) / STEP_M) as u16;
    let border = |aside: f32| {
        let points = (0..=steps).map(|step| {
            let x = from_m + f32::from(step) * STEP_M;
            let (sin, cos) = centre.heading(x).sin_cos();
            (x - aside * sin, centre.y(x) + aside * cos)
        });
        points.collect()
    };
    let all = left.into_iter().chain(own).chain(right);
    all.map(border).collect()
}

/// Returns the direction in which an object moves, rad, left positive; 0 if it stands.
#[must_use]
pub fn yaw(object: &Object) -> f64 {
    match object.vx.hypot(object.vy) > MOVES_M_S {
        true => f64::from(object.vy.atan2(object.vx)),
        false => 0.0,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_lane_has_two_borders_and_neighbours_share_one() {
        let alone = Lanes::alone(3.5, 80.0);
        let found = borders(&alone, -12.0, 60.0);
        let ends = |border: &Vec<(f32, f32)>| (border[0], border[border.len() - 1]);
        assert_eq!(ends(&found[0]), ((-12.0, 1.75), (60.0, 1.75)));
        assert_eq!(ends(&found[1]), ((-12.0, -1.75), (60.0, -1.75)));
        let between = Lanes {
            left: Some(3.0),
            right: Some(4.0),
            ..alone
        };
        let found = borders(&between, 0.0, f32::INFINITY);
        let asides: Vec<f32> = found.iter().map(|border| border[0].1).collect();
        assert_eq!(asides, [4.75, 1.75, -1.75, -5.75]);
        assert!(found.iter().all(|it| it[it.len() - 1].0 == 80.0));
    }
}
