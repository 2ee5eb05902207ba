//! Computes the scene and the trajectory from the frames on the bus, by the driving functions of
//! cores 1 and 2.
//!
//! The scenes and trajectories of the systems stay in their shared memory, which no observer may
//! read. Both systems compute them from the frames that they hear, and so does this program.

use tandem_board::{Duration, Instant};
use tandem_bus::FrameReceiver;
use tandem_cores::core1::PERIOD;
use tandem_cores::driving::perception::Perception;
use tandem_cores::driving::planning::Planner;
use tandem_cores::driving::types::{Scene, Trajectory};

/// A cycle begins without the missing lists this long after the last one: as on core 1.
const PATIENCE: Duration = Duration::from_ms(5);

/// The driving functions, on the times at which frames were on the bus.
pub(crate) struct Driving {
    receiver: FrameReceiver,
    perception: Perception,
    planner: Planner,
    last: Option<Instant>,
}

impl Driving {
    pub(crate) fn new() -> Self {
        Self {
            receiver: FrameReceiver::new(),
            perception: Perception::new(),
            planner: Planner::new(),
            last: None,
        }
    }

    /// Takes in a frame with a standard id that was on the bus at this time. Returns the scene and
    /// the trajectory if it completes a round of the sensors.
    pub(crate) fn take(
        &mut self,
        now: Instant,
        id: u32,
        data: &[u8],
    ) -> Option<(Scene, Trajectory)> {
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
