//! The driving functions in a loop with the world, in virtual time: wired as in the cores, but
//! without cores.
#![allow(clippy::unwrap_used)]

use tandem_board::{CanFrame, CanId, Duration, Instant};
use tandem_bus::{Control, FrameReceiver, FrameTransmitter, Message, ModeCode, RoleCode};
use tandem_cores::driving::control::MotionControl;
use tandem_cores::driving::degraded::DegradedControl;
use tandem_cores::driving::knowledge::Knowledge;
use tandem_cores::driving::perception::{Perception, ego_of};
use tandem_cores::driving::planning::Planner;
use tandem_cores::driving::types::{Command, Ego, Scene, Trajectory};
use tandem_vehicle::{LocalBus, Scenario, World, WorldConfig, WorldMetrics, WorldSnapshot};

/// Perception begins its cycle at this time in each 50 ms, when all sensors have reported.
const PERCEPTION_PHASE_MS: u64 = 25;
/// Time from the start of perception until core 0 has the trajectory.
const CHAIN_MS: u64 = 15;

/// Which function produces the command.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Function {
    /// Perception, planning, control.
    L3,
    /// Degraded control from the scene.
    L2,
    /// Safe stop from the chassis alone.
    SafeStop,
}

/// One system with its functions.
pub(crate) struct System {
    receiver: FrameReceiver,
    pub(crate) perception: Perception,
    planner: Planner,
    control: MotionControl,
    degraded: DegradedControl,
    ego: Ego,
    scene: Option<Scene>,
    pending: Option<(u64, Trajectory)>,
    pub(crate) trajectory: Option<Trajectory>,
    /// Trajectories no longer arrive, as if core 2 had died.
    pub(crate) planning_is_dead: bool,
    /// Knowledge of another system, delivered before the next cycle.
    pub(crate) reported: Option<Knowledge>,
}

impl System {
    pub(crate) fn new() -> Self {
        Self {
            receiver: FrameReceiver::new(),
            perception: Perception::new(),
            planner: Planner::new(),
            control: MotionControl::new(),
            degraded: DegradedControl::new(),
            ego: Ego::default(),
            scene: None,
            pending: None,
            trajectory: None,
            planning_is_dead: false,
            reported: None,
        }
    }

    /// Returns the knowledge that this system would send to another one.
    pub(crate) fn knowledge(&self) -> Knowledge {
        Knowledge::of(self.perception.scene(), self.trajectory.as_ref())
    }

    pub(crate) fn on_frame(&mut self, now: Instant, id: u16, data: &[u8]) {
        if let Ok(message) = self.receiver.receive(u32::from(id), data) {
            if let Message::EgoMotion(motion) = &message {
                self.ego = ego_of(motion);
                self.control.on_ego(now, &self.ego);
            }
            self.perception.on_message(now, &message);
        }
    }

    /// One millisecond: perception and planning when they are due.
    pub(crate) fn tick(&mut self, now_ms: u64, now: Instant) {
        if now_ms % 50 == PERCEPTION_PHASE_MS {
            let reported = self.reported.take();
            if let Some(reported) = &reported {
                self.planner.recall(reported);
            }
            let scene = self.perception.cycle_with(now, reported.as_ref()).clone();
            if !self.planning_is_dead {
                self.pending = Some((now_ms + CHAIN_MS, self.planner.plan(&scene)));
            }
            self.scene = Some(scene);
        }
        if let Some((at, _)) = self.pending
            && now_ms >= at
        {
            self.trajectory = self.pending.take().map(|(_, trajectory)| trajectory);
        }
    }

    /// The next commands continue from this one.
    pub(crate) fn resume(&mut self, last: &Command) {
        self.control.resume(last);
        self.degraded.resume(last);
    }

    /// The command of the requested function, or of the next one if that function cannot continue.
    pub(crate) fn command(
        &mut self,
        now: Instant,
        wished: Function,
    ) -> Option<(Command, Function)> {
        let mut function = wished;
        let mut command = None;
        if function == Function::L3 {
            let trajectory = self.trajectory.as_ref()?;
            match self.control.step(now, &self.ego, trajectory) {
                Ok(result) => command = Some(result),
                Err(_) => function = Function::L2,
            }
        }
        if function == Function::L2 {
            command = Some(self.degraded.step(now, &self.ego, self.scene.as_ref()?));
        }
        if function == Function::SafeStop {
            command = Some(self.degraded.safe_stop(&self.ego));
        }
        let command = command?;
        self.resume(&command);
        Some((command, function))
    }
}

/// The world with one or two systems that drive in it.
pub(crate) struct Drive {
    pub(crate) world: World,
    bus: LocalBus,
    pub(crate) now_ms: u64,
    pub(crate) systems: Vec<System>,
    pub(crate) master: usize,
    pub(crate) function: Function,
    /// The function that the master's last command came from.
    pub(crate) produced: Option<Function>,
    /// Sensors whose frames are lost, by their ids.
    pub(crate) lost: Vec<u16>,
    transmitter: FrameTransmitter,
    /// The largest changes of consecutive commands: steering rad, acceleration m/s².
    pub(crate) largest_step: Command,
    last: Option<Command>,
}

impl Drive {
    pub(crate) fn new(scenario: &Scenario, seed: u64, systems: usize) -> Self {
        Self {
            world: World::new(scenario, WorldConfig { seed }),
            bus: LocalBus::new(Instant::ORIGIN),
            now_ms: 0,
            systems: (0..systems).map(|_| System::new()).collect(),
            master: 0,
            function: Function::L3,
            produced: None,
            lost: Vec::new(),
            transmitter: FrameTransmitter::new(),
            largest_step: Command::default(),
            last: None,
        }
    }

    pub(crate) fn now(&self) -> Instant {
        Instant::ORIGIN + Duration::from_ms(self.now_ms + 1_000)
    }

    /// Runs the scenario for `seconds`.
    pub(crate) fn run(
        &mut self,
        seconds: f64,
        watch: &mut dyn FnMut(&WorldSnapshot, &System, &Command),
    ) {
        let end = self.world.snapshot().time_s + seconds;
        while self.world.snapshot().time_s < end {
            self.tick(watch);
            assert!(self.now_ms < 1_000_000, "the world does not start");
        }
    }

    fn tick(&mut self, watch: &mut dyn FnMut(&WorldSnapshot, &System, &Command)) {
        let now = self.now();
        self.bus.now = now;
        self.world.run_period(now, &mut self.bus, &mut |_| {});
        for frame in self.bus.from_vehicle.drain(..) {
            let CanId::Standard(id) = frame.id() else {
                panic!("a frame of the DBC has a standard id");
            };
            if !self.lost.contains(&id) {
                for system in &mut self.systems {
                    system.on_frame(now, id, frame.data());
                }
            }
        }
        for system in &mut self.systems {
            system.tick(self.now_ms, now);
        }
        if self.now_ms % 10 == 5 {
            self.control(now, watch);
        }
        self.now_ms += 1;
    }

    /// The master's command goes to the vehicle; the others compute silently and receive it.
    fn control(&mut self, now: Instant, watch: &mut dyn FnMut(&WorldSnapshot, &System, &Command)) {
        let function = self.function;
        let mut sent = None;
        for (index, system) in self.systems.iter_mut().enumerate() {
            let command = system.command(now, function);
            if index == self.master {
                sent = command;
            }
        }
        let Some((command, function)) = sent else {
            return;
        };
        self.produced = Some(function);
        let term = 2 * (1 + self.master as u32) + self.master as u32;
        let control = Control {
            role: RoleCode::Master,
            mode: if function == Function::L3 {
                ModeCode::L3
            } else {
                ModeCode::DegradedL2
            },
            term,
            steering_angle: command.steering_angle,
            acceleration: command.acceleration,
            ..Control::default()
        };
        let message = Message::Control {
            system: self.master as u8,
            control,
        };
        let frame = self.transmitter.encode(&message);
        let frame = CanFrame::new(CanId::Standard(frame.id), true, frame.data());
        self.bus.to_vehicle.push(frame.unwrap());
        for system in &mut self.systems {
            system.resume(&command);
        }
        if let Some(last) = self.last {
            let step = &mut self.largest_step;
            let steering = (command.steering_angle - last.steering_angle).abs();
            step.steering_angle = step.steering_angle.max(steering);
            let acceleration = (command.acceleration - last.acceleration).abs();
            step.acceleration = step.acceleration.max(acceleration);
        }
        self.last = Some(command);
        watch(self.world.snapshot(), &self.systems[self.master], &command);
    }

    pub(crate) fn metrics(&self) -> WorldMetrics {
        self.world.metrics()
    }
}
