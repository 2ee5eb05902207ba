//! Runs the driving functions on recorded frames, and computes a digest of all their outputs.
//!
//! The same code runs on a host and as firmware. The digest covers the bits of every number that
//! perception, planning, control and the degraded function return, so two digests are equal if and
//! only if the outputs are bit-identical (except for collisions of a 32-bit hash, one for each
//! function).
#![no_std]
#![forbid(unsafe_code)]

use tandem_board::{CanId, Duration, Instant};
use tandem_bus::{FrameReceiver, Message};
use tandem_cores::driving::control::MotionControl;
use tandem_cores::driving::degraded::DegradedControl;
use tandem_cores::driving::perception::{Perception, ego_of};
use tandem_cores::driving::planning::Planner;
use tandem_cores::driving::types::{Command, Ego, Scene, Trajectory};
use tandem_cores::words::Payload;
use tandem_peripherals::codec::{BusFrame, FRAME_WORDS};

/// Period of perception and planning, ms.
const PLAN_MS: u64 = 50;
/// Time in the period at which all sensors have reported, ms.
const PLAN_PHASE_MS: u64 = 25;
/// Period of control, ms.
const CONTROL_MS: u64 = 10;
const CONTROL_PHASE_MS: u64 = 5;

/// FNV-1a hash of words.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Hash(pub u32);

impl Hash {
    const EMPTY: Self = Self(0x811C_9DC5);

    fn add(&mut self, word: u32) {
        for byte in word.to_le_bytes() {
            self.0 = (self.0 ^ u32::from(byte)).wrapping_mul(0x0100_0193);
        }
    }

    fn add_all(&mut self, value: &impl Payload) {
        value.store(&mut |word| self.add(word));
    }

    fn add_command(&mut self, command: &Command) {
        self.add(command.steering_angle.to_bits());
        self.add(command.acceleration.to_bits());
    }
}

/// The digest of the outputs so far.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Digest {
    /// Scenes of perception.
    pub scenes: Hash,
    /// Trajectories of planning.
    pub trajectories: Hash,
    /// Commands of control.
    pub commands: Hash,
    /// Commands of the degraded function and of the safe stop.
    pub degraded: Hash,
    /// Number of commands of the degraded function and of the safe stop.
    pub cycles: u32,
}

/// One system's functions. Their clock follows the frames that they receive.
pub struct Functions {
    receiver: FrameReceiver,
    perception: Perception,
    planner: Planner,
    control: MotionControl,
    degraded: DegradedControl,
    ego: Ego,
    scene: Option<Scene>,
    trajectory: Option<Trajectory>,
    digest: Digest,
}

impl Default for Functions {
    fn default() -> Self {
        Self::new()
    }
}

impl Functions {
    /// Creates functions that have not received a frame.
    #[must_use]
    pub fn new() -> Self {
        Self {
            receiver: FrameReceiver::new(),
            perception: Perception::new(),
            planner: Planner::new(),
            control: MotionControl::new(),
            degraded: DegradedControl::new(),
            ego: Ego::default(),
            scene: None,
            trajectory: None,
            digest: Digest {
                scenes: Hash::EMPTY,
                trajectories: Hash::EMPTY,
                commands: Hash::EMPTY,
                degraded: Hash::EMPTY,
                cycles: 0,
            },
        }
    }

    /// Returns the digest of the outputs so far.
    #[must_use]
    pub const fn digest(&self) -> Digest {
        self.digest
    }

    /// Processes a frame of the vehicle.
    pub fn on_frame(&mut self, at: Instant, id: u16, data: &[u8]) {
        if let Ok(message) = self.receiver.receive(u32::from(id), data) {
            if let Message::EgoMotion(motion) = &message {
                self.ego = ego_of(motion);
                self.control.on_ego(at, &self.ego);
            }
            self.perception.on_message(at, &message);
        }
    }

    /// Runs the functions that are due in this millisecond. Returns the command, if any.
    pub fn tick(&mut self, ms: u64) -> Option<Command> {
        let now = instant(ms);
        if ms % PLAN_MS == PLAN_PHASE_MS {
            let scene = self.perception.cycle(now).clone();
            let trajectory = self.planner.plan(&scene);
            self.digest.scenes.add_all(&scene);
            self.digest.trajectories.add_all(&trajectory);
            (self.scene, self.trajectory) = (Some(scene), Some(trajectory));
        }
        if ms % CONTROL_MS != CONTROL_PHASE_MS {
            return None;
        }
        let (scene, trajectory) = (self.scene.as_ref()?, self.trajectory.as_ref()?);
        let degraded = self.degraded.step(now, &self.ego, scene);
        self.digest.degraded.add_command(&degraded);
        self.digest
            .degraded
            .add_command(&self.degraded.safe_stop(&self.ego));
        let command = self
            .control
            .step(now, &self.ego, trajectory)
            .unwrap_or(degraded);
        self.digest.commands.add_command(&command);
        self.digest.cycles += 1;
        self.control.resume(&command);
        self.degraded.resume(&command);
        Some(command)
    }
}

/// Returns the instant `ms` + 1 s after the origin, because a board's clock does not start at 0.
#[must_use]
pub fn instant(ms: u64) -> Instant {
    Instant::ORIGIN + Duration::from_ms(ms + 1_000)
}

/// Plays recorded frames in order for `end_ms` milliseconds. Each frame has [`FRAME_WORDS`] words,
/// in the form of [`BusFrame::encode`] with its time.
#[must_use]
pub fn play(recording: &[u32], end_ms: u64) -> Digest {
    let mut functions = Functions::new();
    let mut ms = 0;
    for words in recording.chunks_exact(FRAME_WORDS) {
        let Some(BusFrame { received, .. }) = words.try_into().ok().and_then(BusFrame::decode)
        else {
            continue;
        };
        while instant(ms) < received.at {
            functions.tick(ms);
            ms += 1;
        }
        if let CanId::Standard(id) = received.frame.id() {
            functions.on_frame(received.at, id, received.frame.data());
        }
    }
    while ms < end_ms {
        functions.tick(ms);
        ms += 1;
    }
    functions.digest()
}
