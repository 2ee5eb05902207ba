//! The gateway of the SoC: takes the bus frames that both systems publish, and gives each one once.
//!
//! Both systems publish each frame that they hear, so one of them may lag, lose frames, restart or
//! die. A frame is **dropped** if the other system gave the same frame before, and this system has
//! not published it since. Otherwise it is **given**. Two samples are the same frame if id, length
//! and all bytes are equal, and one of these holds:
//!
//! - The frame is protected end to end, and less than 128 of its shortest intervals have passed.
//!   Its counter comes back after 256 of them.
//! - It is protected, its values have not occurred in any other frame of its id that is kept, and
//!   less than [`KEEPS`] have passed.
//! - It is not protected, and less than half of its period has passed; if it states none, 10 ms.
//!
//! In doubt a frame is given twice, and never lost: a frame whose values do not change is given
//! again if a system is more than 128 intervals behind the other one. Its counter shows that. One
//! case is taken for the same frame by mistake: each system has published only one of two frames
//! that equal each other in values and counter, 256 frames apart, and no other frame has these.
//!
//! A frame that only one system hears, as the control frame of the other one, is given too.

use std::collections::{BTreeMap, VecDeque};

use tandem_board::{Duration, Instant, SystemId};
use tandem_bus::e2e::{Check, Checker, HEADER_LEN, MAX_DELTA_COUNTER};
use tandem_bus::{FRAMES, FrameInfo, SensorObject};
use tandem_topics::{CanFrame, Guid, endpoints};

/// How long a given frame is remembered.
pub const KEEPS: Duration = Duration::from_ms(10_000);
/// How many given frames of an id are remembered at most.
const MOST: usize = 1_024;
/// More ids than a vehicle has. Frames of others are counted and not given.
const IDS: usize = 512;
/// A frame without counter and period is the same as an equal one within this time.
const UNPROTECTED: Duration = Duration::from_ms(10);
/// A counter tells ahead from behind within half of its range.
const HALF: u8 = 128;
/// Objects that a sensor sends at most in its period: it sends the frames of one list at once.
const OBJECTS: u32 = 32;

/// A frame that was given.
#[derive(Clone, Copy, Debug)]
struct Given {
    at: Instant,
    from: SystemId,
    /// The other system has published it too.
    is_matched: bool,
    frame: CanFrame,
}

/// A frame as the gateway gives it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Passed {
    /// It is newer than all of its id before, or has no counter.
    InOrder,
    /// It is an older one, which the faster system had lost.
    Late,
}

/// What was heard of an id.
#[derive(Clone, Debug)]
pub struct IdReport {
    /// Its frame in the DBC, if it has one.
    pub info: Option<FrameInfo>,
    /// Period, ms: of the DBC, or else what the sample states; 0 if there is none.
    pub period_ms: u32,
    /// Frames that were given.
    pub frames: u64,
    /// Samples of system A and of system B.
    pub samples: [u64; 2],
    /// Frames that neither system has published, as the counter tells.
    pub lost: u64,
    /// The counter went back, or further ahead than the time allows: the sender restarted, or more
    /// than 127 frames were lost.
    pub jumps: u64,
    /// Samples with a wrong CRC, which have no valid counter.
    pub damaged: u64,
    /// When the first one was given.
    pub first: Instant,
    /// When the newest one was given.
    pub last: Instant,
    /// The longest time between two of them.
    pub longest: Duration,
}

/// An id: its frames, and the counters that are missing.
#[derive(Debug)]
struct Id {
    given: VecDeque<Given>,
    /// Counter of the newest frame.
    newest: Option<u8>,
    /// Counters of the last frames that neither system has given.
    skipped: [bool; 256],
    report: IdReport,
}

/// Gives each frame of both systems once, and supervises each id.
#[derive(Debug, Default)]
pub struct Gateway {
    ids: BTreeMap<u32, Id>,
    /// The writers, and when each was heard.
    writers: [Option<(Guid, Instant)>; 2],
    /// Samples with an id for which there was no room.
    pub refused: u64,
}

fn after(now: Instant, before: Instant, time: Duration) -> bool {
    now.since(before) >= time
}

impl Id {
    fn new(now: Instant, frame: &CanFrame) -> Self {
        let info = FRAMES
            .into_iter()
            .find(|info| u32::from(info.id) == frame.id);
        let report = IdReport {
            info,
            period_ms: info.map_or(frame.period_ms.into(), |info| info.cycle_ms),
            frames: 0,
            samples: [0; 2],
            lost: 0,
            jumps: 0,
            damaged: 0,
            first: now,
            last: now,
            longest: Duration::ZERO,
        };
        Self {
            given: VecDeque::new(),
            newest: None,
            skipped: [false; 256],
            report,
        }
    }

    /// The shortest time between two frames of this id.
    fn interval(&self) -> Duration {
        let id = self.report.info.map(|info| info.id);
        let is_object = id.is_some_and(|id| SensorObject::IDS.contains(&id));
        let each = if is_object { OBJECTS } else { 1 };
        let period = Duration::from_ms(self.report.period_ms.max(1).into());
        Duration::from_ns(period.as_ns() / u64::from(each))
    }

    /// Returns the counter of a frame that is protected end to end.
    fn counter(&mut self, frame: &CanFrame) -> Option<u8> {
        let info = self.report.info.filter(|info| info.has_e2e)?;
        let data = content(frame);
        if data.len() == info.len && Checker::new(info.id).check(data) == Check::Initial {
            return Some(data[HEADER_LEN - 1]);
        }
        self.report.damaged += 1;
        None
    }

    /// Returns the place of the same frame, if the other system gave it.
    fn same(&self, now: Instant, from: SystemId, frame: &CanFrame, counter: bool) -> Option<usize> {
        let window = match (counter, self.report.period_ms) {
            (true, _) => self.interval().times(HALF.into()),
            (false, 0) => UNPROTECTED,
            (false, period_ms) => Duration::from_us(500 * u64::from(period_ms)),
        };
        let is_same = |given: &Given| {
            given.from != from
                && !given.is_matched
                && content(&given.frame) == content(frame)
                && (!after(now, given.at, window) || counter && self.is_unique(frame))
        };
        self.given.iter().rposition(is_same)
    }

    /// Returns whether the values of a frame stand in one frame that is kept.
    fn is_unique(&self, frame: &CanFrame) -> bool {
        let mut same = self.given.iter();
        let is_same = |given: &&Given| values(&given.frame) == values(frame);
        same.by_ref().any(|given| is_same(&given)) && !same.any(|given| is_same(&given))
    }

    fn hear(&mut self, now: Instant, from: SystemId, frame: &CanFrame) -> Option<Passed> {
        while let Some(oldest) = self.given.front()
            && (after(now, oldest.at, KEEPS) || self.given.len() >= MOST)
        {
            self.given.pop_front();
        }
        self.report.samples[from.index()] += 1;
        let counter = self.counter(frame);
        if let Some(place) = self.same(now, from, frame, counter.is_some()) {
            self.given[place].is_matched = true;
            return None;
        }
        let passed = counter.map_or(Passed::InOrder, |counter| self.order(now, counter));
        self.given.push_back(Given {
            at: now,
            from,
            is_matched: false,
            frame: *frame,
        });
        let report = &mut self.report;
        if report.frames == 0 {
            report.first = now;
        } else {
            report.longest = report.longest.max(now.since(report.last));
        }
        report.frames += 1;
        report.last = now;
        Some(passed)
    }

    /// Judges the counter of a frame that is given.
    fn order(&mut self, now: Instant, counter: u8) -> Passed {
        let place = usize::from(counter);
        let Some(newest) = self.newest else {
            self.newest = Some(counter);
            return Passed::InOrder;
        };
        let ahead = counter.wrapping_sub(newest);
        // Half of the shortest time in which this many frames arrive.
        let takes = self.interval().times(u32::from(ahead / 2));
        let is_plausible = ahead <= MAX_DELTA_COUNTER || after(now, self.report.last, takes);
        if (1..HALF).contains(&ahead) && is_plausible {
            for step in 1..ahead {
                self.skipped[usize::from(newest.wrapping_add(step))] = true;
            }
            self.report.lost += u64::from(ahead - 1);
        } else if std::mem::take(&mut self.skipped[place]) {
            self.report.lost = self.report.lost.saturating_sub(1);
            return Passed::Late;
        } else if !after(now, self.report.first, self.interval().times(HALF.into())) {
            // It is older than the first one.
            return Passed::Late;
        } else {
            self.report.jumps += 1;
            self.skipped = [false; 256];
        }
        self.skipped[place] = false;
        self.newest = Some(counter);
        Passed::InOrder
    }
}

/// Returns the data of a frame.
pub fn content(frame: &CanFrame) -> &[u8] {
    &frame.data[..usize::from(frame.length).min(frame.data.len())]
}

/// Returns the data behind counter and CRC.
fn values(frame: &CanFrame) -> Option<&[u8]> {
    content(frame).get(HEADER_LEN..)
}

impl Gateway {
    /// Takes a sample. Returns how the frame passes; `None` if it was given before.
    pub fn hear(&mut self, now: Instant, writer: Guid, frame: &CanFrame) -> Option<Passed> {
        let from = self.system(now, writer);
        let is_full = |it: &Self| it.ids.len() >= IDS && !it.ids.contains_key(&frame.id);
        if is_full(self) {
            // Ids that are silent make room: a sender of nonsense may have filled all places.
            self.ids.retain(|_, id| !after(now, id.report.last, KEEPS));
        }
        if is_full(self) {
            self.refused += 1;
            return None;
        }
        let id = self.ids.entry(frame.id);
        id.or_insert_with(|| Id::new(now, frame))
            .hear(now, from, frame)
    }

    /// Returns the system that a writer belongs to. A writer that is no controller of ours gets the
    /// place that was silent for the longest time.
    fn system(&mut self, now: Instant, writer: Guid) -> SystemId {
        let known = endpoints::system_of(writer.prefix).map(usize::from);
        let is = |place: &Option<(Guid, Instant)>| place.is_some_and(|(guid, _)| guid == writer);
        let known = known.or_else(|| self.writers.iter().position(is));
        let heard = |place: usize| self.writers[place].map(|(_, at)| at);
        let place = known.unwrap_or(usize::from(heard(1) < heard(0)));
        self.writers[place] = Some((writer, now));
        SystemId::ALL[place]
    }

    /// Returns what was heard of each id, by id.
    pub fn reports(&self) -> impl Iterator<Item = (u32, &IdReport)> {
        self.ids.iter().map(|(number, id)| (*number, &id.report))
    }
}
