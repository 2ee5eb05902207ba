//! The controller's layout of the LMU: which core communicates with which through which words.

use crate::driving::knowledge::Knowledge;
use crate::driving::types::{ControlStep, Scene, Trajectory};
use crate::words::VehicleTime;
use core::sync::atomic::Ordering::Relaxed;
use tandem_board::{Board, CoreId, Instant, LmuWord};
use tandem_shm::LINE_WORDS;
use tandem_shm::incarnation::Incarnation;
use tandem_shm::mailbox::TaskId;
use tandem_shm::map::{Layout, Map, MapError};
use tandem_shm::region::{Fifo, Mailbox, Newest, Region, Words};

/// Task of core 2: plan for the newest scene.
pub const PLAN: TaskId = task(1);
/// Task of core 0: fetch the new trajectory.
pub const TRAJECTORY_READY: TaskId = task(1);

const fn task(number: u8) -> TaskId {
    match TaskId::new(number) {
        Some(task) => task,
        None => panic!("not a task number"),
    }
}

/// Core 1 signals core 2.
pub const MAILBOX_1_TO_2: Region<Mailbox> = Region::first("mailbox 1 to 2");
/// Core 2 signals core 0.
pub const MAILBOX_2_TO_0: Region<Mailbox> = MAILBOX_1_TO_2.then("mailbox 2 to 0");
/// Each core counts its cycles here, on its own cache line, for the alive supervision.
const ALIVE: Region<Words<{ CoreId::COUNT * LINE_WORDS }>> = MAILBOX_2_TO_0.then("alive counters");
/// Core 1 publishes, cores 2 and 0 read.
pub const SCENE: Region<Newest<Scene>> = ALIVE.then("scene");
/// Core 2 publishes, core 0 reads.
pub const TRAJECTORY: Region<Newest<Trajectory>> = SCENE.then("trajectory");
/// Core 0 publishes, core 2 reads and computes again.
pub const CONTROL_STEP: Region<Newest<ControlStep>> = TRAJECTORY.then("control step");

/// Core 0 publishes the knowledge of another system; cores 1 and 2 read it when newly started.
pub const KNOWLEDGE: Region<Newest<Knowledge>> = CONTROL_STEP.then("knowledge");
/// A frame for the desk or a wish of the desk: what it is, and eight bytes.
pub(crate) type DeskWords = [u32; 3];
/// Core 0 passes frames to the desk on core 2.
pub(crate) const TO_DESK: Region<Fifo<DeskWords, 16>> = KNOWLEDGE.then("to the desk");
/// What the desk wants of core 0.
pub(crate) const FROM_DESK: Region<Fifo<DeskWords, 8>> = TO_DESK.then("from the desk");

/// Core 0 publishes how its clock becomes the vehicle's time; core 1 reads.
pub const VEHICLE_TIME: Region<Newest<VehicleTime>> = FROM_DESK.then("vehicle time");

const LAYOUT: Layout = VEHICLE_TIME.end();

const _: () = assert!(
    LAYOUT.total_words() <= 8192,
    "the LMU of a TC297 has 32 KiB"
);

/// The view that one incarnation of one core of the controller has of the LMU.
#[derive(Clone, Copy)]
pub struct ControllerMap<'a> {
    /// Where the regions are.
    pub map: Map<'a>,
    /// This announced incarnation.
    pub incarnation: Incarnation,
    alive: &'a [LmuWord],
}

impl<'a> ControllerMap<'a> {
    /// Attaches this core, and announces its incarnation. Core 0 formats an LMU that is
    /// unformatted, as after power-on, or that has other content.
    ///
    /// # Errors
    /// [`MapError`]: not formatted yet (try again), or formatted for another image.
    ///
    /// # Panics
    /// If the board breaks its contract: its LMU is smaller than the layout or does not begin at a
    /// boundary of 64 bytes, or its generation is 0 or above 2^30 - 1.
    pub fn attach<B: Board>(board: &'a B) -> Result<Self, MapError> {
        let identity = board.identity();
        let map = match Map::attach(board.lmu(), LAYOUT) {
            Ok(map) => map,
            Err(error @ (MapError::TooSmall | MapError::Misaligned)) => {
                panic!("this board's LMU breaks its contract: {error:?}")
            }
            Err(_) if identity.core == CoreId::CONTROL => Map::format(board.lmu(), LAYOUT)?,
            Err(error) => return Err(error),
        };
        let Some(incarnation) = Incarnation::new(identity.core.index(), identity.generation.0)
        else {
            panic!("this board's generation breaks its contract")
        };
        // Never `Outdated`: the supply assigns the generations, so this incarnation is the latest
        // one.
        let _outdated = map.incarnations().announce(incarnation);
        let alive = ALIVE.attach(&map)?;
        Ok(Self {
            map,
            incarnation,
            alive,
        })
    }

    /// Counts one cycle of this core, for the alive supervision.
    pub fn count_cycle(&self) {
        // Relaxed: the count itself is the message.
        let word = &self.alive[self.incarnation.core() * LINE_WORDS];
        word.store(word.load(Relaxed).wrapping_add(1), Relaxed);
    }

    /// Stores whether core 2 found a step of core 0 right. Core 0 reads the number of successive
    /// wrong steps.
    pub fn judge_control(&self, right: bool) {
        let word = &self.alive[CoreId::PLANNING.index() * LINE_WORDS + 1];
        let wrong = if right {
            0
        } else {
            word.load(Relaxed).saturating_add(1)
        };
        // Relaxed: the count itself is the message.
        word.store(wrong, Relaxed);
    }

    /// Returns how many successive steps of core 0 were wrong according to core 2.
    #[must_use]
    pub fn wrong_steps(&self) -> u32 {
        self.alive[CoreId::PLANNING.index() * LINE_WORDS + 1].load(Relaxed)
    }

    /// Tells the other cores whether this system is master or standby.
    pub fn show_role(&self, has_role: bool) {
        // Relaxed: the word itself is the message.
        self.alive[CoreId::CONTROL.index() * LINE_WORDS + 1].store(has_role.into(), Relaxed);
    }

    /// Returns whether this system is master or standby, as core 0 last told.
    #[must_use]
    pub fn has_role(&self) -> bool {
        self.alive[CoreId::CONTROL.index() * LINE_WORDS + 1].load(Relaxed) == 1
    }

    /// Cycles of a core so far; wraps around.
    #[must_use]
    pub fn cycles(&self, core: CoreId) -> u32 {
        self.alive[core.index() * LINE_WORDS].load(Relaxed)
    }
}

/// Returns the age in ns, saturated. Times of scene and trajectory in the LMU are on the clock that
/// all cores of a system share.
#[must_use]
pub fn age_ns(now: Instant, at: Instant) -> u32 {
    u32::try_from(now.since(at).as_ns()).unwrap_or(u32::MAX)
}
