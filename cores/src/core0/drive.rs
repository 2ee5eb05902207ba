//! Which function drives: trajectory control, the degraded L2 functions, or the safe stop.

use crate::driving::control::MotionControl;
use crate::driving::degraded::DegradedControl;
use crate::driving::types::{Command, Ego, Scene, Trajectory};
use tandem_board::{Duration, Instant};
use tandem_redundancy::Mode;

/// A control frame that is to be sent, or would be if the output were open.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Output {
    pub(crate) command: Command,
    /// The function that produced it: below the mode asked for if its inputs were missing.
    pub(crate) mode: Mode,
    /// Age of the oldest measurement it rests on; `None` if it rests on none.
    pub(crate) age: Option<Duration>,
}

/// The motion control of core 0 with its inputs.
pub struct Drive {
    ego: Option<(Instant, Ego)>,
    trajectory: Option<Trajectory>,
    scene: Option<Scene>,
    motion: MotionControl,
    degraded: DegradedControl,
    /// What was commanded last: by this system, or by the other while this one is standby.
    last: Command,
}

/// Without the chassis' own motion for this long there is nothing to control by.
const EGO_MAX_AGE: Duration = Duration::from_ms(100);

impl Drive {
    pub(crate) fn new() -> Self {
        Self {
            ego: None,
            trajectory: None,
            scene: None,
            motion: MotionControl::new(),
            degraded: DegradedControl::new(),
            last: Command::default(),
        }
    }

    pub(crate) fn on_ego(&mut self, at: Instant, ego: Ego) {
        self.motion.on_ego(at, &ego);
        self.ego = Some((at, ego));
    }

    pub(crate) fn on_trajectory(&mut self, trajectory: Trajectory) {
        self.trajectory = Some(trajectory);
    }

    pub(crate) fn on_scene(&mut self, scene: Scene) {
        self.scene = Some(scene);
    }

    /// The other system's command was heard: a takeover starts from it without a jerk.
    pub(crate) fn on_command_of_master(&mut self, command: Command) {
        self.last = command;
    }

    /// The command for `now` by the best function that `mode` permits and the inputs allow.
    pub(crate) fn cycle(&mut self, now: Instant, mode: Mode) -> Output {
        let output = self.by_best_function(now, mode);
        self.last = output.command;
        output
    }

    fn by_best_function(&mut self, now: Instant, mode: Mode) -> Output {
        self.motion.resume(&self.last);
        self.degraded.resume(&self.last);
        let ego = self
            .ego
            .filter(|(at, _)| now.since(*at) <= EGO_MAX_AGE)
            .map(|(_, ego)| ego);
        let Some(ego) = ego.filter(|_| mode != Mode::SafeStop) else {
            let ego = self.ego.map(|(_, ego)| ego).unwrap_or_default();
            return Output {
                command: self.degraded.safe_stop(&ego),
                mode: Mode::SafeStop,
                age: None,
            };
        };
        if let (Mode::L3, Some(trajectory)) = (mode, &self.trajectory)
            && let Ok(command) = self.motion.step(now, &ego, trajectory)
        {
            return Output {
                command,
                mode: Mode::L3,
                age: Some(now.since(trajectory.measured)),
            };
        }
        if let Some(scene) = &self.scene {
            let command = self.degraded.step(now, &ego, scene);
            return Output {
                command,
                mode: Mode::DegradedL2,
                age: Some(now.since(scene.measured)),
            };
        }
        Output {
            command: self.degraded.safe_stop(&ego),
            mode: Mode::SafeStop,
            age: None,
        }
    }
}
