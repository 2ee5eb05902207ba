//! The controller's layout of the LMU: who talks to whom through which words.

use crate::driving::types::{Scene, Trajectory};
use crate::words::{Corrupt, Words};
use core::sync::atomic::AtomicU32;
use core::sync::atomic::Ordering::Relaxed;
use tandem_board::{Board, CoreId, Instant};
use tandem_shm::life::Life;
use tandem_shm::mailbox::{self, TaskId};
use tandem_shm::map::{AttachError, Layout, Map, Region};
use tandem_shm::newest::{self, ReadError};
use tandem_shm::{LINE_WORDS, Shape};

/// Task of core 2: plan for the newest scene.
pub const PLAN: TaskId = task(1);
/// Task of core 0: a new trajectory is there.
pub const TRAJECTORY_READY: TaskId = task(1);

const fn task(number: u8) -> TaskId {
    match TaskId::new(number) {
        Some(task) => task,
        None => panic!("not a task number"),
    }
}

/// Four slots: a reader that has begun with the newest value has three further cycles to finish.
const SLOTS: usize = 4;
const SCENE: Shape = Shape::new(SLOTS, Scene::WORDS);
const TRAJECTORY: Shape = Shape::new(SLOTS, Trajectory::WORDS);

const MAILBOX_1_TO_2: usize = 0;
const MAILBOX_2_TO_0: usize = 1;
const ALIVE: usize = 2;
const SCENE_AT: usize = 3;
const TRAJECTORY_AT: usize = 4;

/// All regions. Their order is that of the constants above.
const LAYOUT: Layout = Layout::new(&[
    Region::new("mailbox 1 to 2", mailbox::WORDS),
    Region::new("mailbox 2 to 0", mailbox::WORDS),
    Region::new("alive counters", CoreId::COUNT * LINE_WORDS),
    Region::new("scene", newest::words(SCENE)),
    Region::new("trajectory", newest::words(TRAJECTORY)),
]);

const _: () = assert!(
    LAYOUT.total_words() <= 8192,
    "the LMU of a TC297 has 32 KiB"
);

/// The LMU as one core of the controller sees it.
#[derive(Clone, Copy)]
pub struct ControllerMap<'a> {
    map: Map<'a>,
    core: CoreId,
}

impl<'a> ControllerMap<'a> {
    /// Attaches this core, and announces its life. Core 0 formats an LMU that is not formatted, as
    /// it is after power-on, or that holds anything else.
    ///
    /// # Errors
    /// [`AttachError`]: not formatted yet (try again), or formatted for another image.
    ///
    /// # Panics
    /// If the board's LMU is smaller than the layout or does not begin at a boundary of 64 bytes.
    pub fn attach<B: Board>(board: &'a B) -> Result<Self, AttachError> {
        let identity = board.identity();
        let map = match Map::attach(board.lmu(), LAYOUT) {
            Ok(map) => map,
            Err(error @ (AttachError::TooSmall | AttachError::Misaligned)) => {
                panic!("this board's LMU breaks its contract: {error:?}")
            }
            Err(_) if identity.core == CoreId::CONTROL => Map::format(board.lmu(), LAYOUT)?,
            Err(error) => return Err(error),
        };
        if let Some(life) = Life::new(identity.core.index(), identity.generation.0) {
            // A life that is announced as over cannot be this one: its supply gives out
            // generations.
            let _outdated = map.lives().announce(life);
        }
        Ok(Self {
            map,
            core: identity.core,
        })
    }

    /// Where core 1 signals core 2.
    #[must_use]
    pub fn mailbox_1_to_2(&self) -> &'a [AtomicU32] {
        self.map.region(MAILBOX_1_TO_2)
    }

    /// Where core 2 signals core 0.
    #[must_use]
    pub fn mailbox_2_to_0(&self) -> &'a [AtomicU32] {
        self.map.region(MAILBOX_2_TO_0)
    }

    /// Counts one cycle of this core, for the alive supervision.
    pub fn count_cycle(&self) {
        // Relaxed: the count itself is the message.
        let word = &self.map.region(ALIVE)[self.core.index() * LINE_WORDS];
        word.store(word.load(Relaxed).wrapping_add(1), Relaxed);
    }

    /// Cycles of a core so far; wraps around.
    #[must_use]
    pub fn cycles(&self, core: CoreId) -> u32 {
        self.map.region(ALIVE)[core.index() * LINE_WORDS].load(Relaxed)
    }

    /// The scene channel's writing end, for core 1.
    #[must_use]
    pub fn scene_writer(&self) -> Option<Writer<'a, Scene>> {
        Writer::attach(self.map.region(SCENE_AT), SCENE)
    }

    /// A reading end of the scene channel, for cores 2 and 0.
    #[must_use]
    pub fn scene_reader(&self) -> Option<Reader<'a, Scene>> {
        Reader::attach(self.map.region(SCENE_AT), SCENE)
    }

    /// The trajectory channel's writing end, for core 2.
    #[must_use]
    pub fn trajectory_writer(&self) -> Option<Writer<'a, Trajectory>> {
        Writer::attach(self.map.region(TRAJECTORY_AT), TRAJECTORY)
    }

    /// A reading end of the trajectory channel, for core 0.
    #[must_use]
    pub fn trajectory_reader(&self) -> Option<Reader<'a, Trajectory>> {
        Reader::attach(self.map.region(TRAJECTORY_AT), TRAJECTORY)
    }
}

/// Publishes values of one type in a newest-value channel, written in place.
pub struct Writer<'a, T> {
    channel: newest::Writer<'a>,
    of: core::marker::PhantomData<T>,
}

impl<'a, T: Words> Writer<'a, T> {
    fn attach(words: &'a [AtomicU32], shape: Shape) -> Option<Self> {
        let channel = newest::Writer::attach(words, shape).ok()?;
        Some(Self {
            channel,
            of: core::marker::PhantomData,
        })
    }

    /// Makes `value` the newest.
    pub fn publish(&mut self, value: &T) {
        let mut loan = self.channel.loan();
        let mut at = 0;
        value.store(&mut |word| {
            loan.words().set(at, word);
            at += 1;
        });
        let _stamp = loan.send();
    }
}

/// Reads the newest value of one type from its channel.
pub struct Reader<'a, T> {
    channel: newest::Reader<'a>,
    seen: Option<newest::Stamp>,
    of: core::marker::PhantomData<T>,
}

impl<'a, T: Words> Reader<'a, T> {
    fn attach(words: &'a [AtomicU32], shape: Shape) -> Option<Self> {
        let channel = newest::Reader::attach(words, shape).ok()?;
        Some(Self {
            channel,
            seen: None,
            of: core::marker::PhantomData,
        })
    }

    /// The newest value if there is one that was not fetched before.
    ///
    /// # Errors
    /// [`Corrupt`] if the channel's words hold no such value.
    pub fn fetch(&mut self) -> Result<Option<T>, Corrupt> {
        if self.channel.newest() == self.seen {
            return Ok(None);
        }
        let read = self.channel.read(|words| {
            let mut at = 0;
            T::load(&mut || {
                at += 1;
                words.get(at - 1)
            })
        });
        match read {
            Ok((stamp, value)) => {
                self.seen = Some(stamp);
                value.map(Some)
            }
            Err(ReadError::Empty | ReadError::Overrun) => Ok(None),
        }
    }
}

/// Time as it crosses the LMU inside scene and trajectory is on the clock that all cores of a
/// system share; the span since then, in ns, saturated.
#[must_use]
pub fn age_ns(now: Instant, at: Instant) -> u32 {
    u32::try_from(now.since(at).as_ns()).unwrap_or(u32::MAX)
}
