//! Core 1: every 50 ms acquires the sensors' lists from CAN, fuses them, and signals core 2.
//! T-CHIP-3
//!
//! The sensors release it: a cycle begins when all lists of the last cycle have arrived again. The
//! core sleeps until they are expected, and only then asks to be woken by frames. If one is
//! missing, the cycle begins 5 ms after it was expected, and the next ones no longer wait for it.

use crate::driving::knowledge::Knowledge;
use crate::driving::perception::{Perception, RefusedStamp};
use crate::driving::types::Scene;
use crate::layout::{ControllerMap, KNOWLEDGE, MAILBOX_1_TO_2, PLAN, SCENE, VEHICLE_TIME, age_ns};
use crate::release::Release;
use crate::task_table::{CORE_1, TaskCode};
use crate::trace::{Begin, Event, Leaves};
use crate::words::VehicleTime;
use crate::{Core, RETRY, ReceivedFrame, read_can};
use tandem_board::{Board, Can, CoreId, Duration, Instant};
use tandem_bus::FrameReceiver;
use tandem_shm::mailbox::{Ring, Sender};
use tandem_shm::newest::{Reader, Writer};

/// The period of the sensors.
pub const PERIOD: Duration = CORE_1[0].period;

/// The core polls this long after a round is expected: if the sensors are punctual, one poll is
/// enough.
const MARGIN: Duration = Duration::from_us(200);
/// How long a cycle waits for a late list. The sensors' clocks and the bus cause shorter delays.
const PATIENCE: Duration = Duration::from_ms(5);
/// Shortest time between two cycles, whatever the sensors send.
const SHORTEST: Duration = Duration::from_us(12_500);

/// Frames that one cycle takes from the CAN receiver: as many as a bus of 1 Mbit/s carries in a
/// period. The rest waits for the next cycle.
const CAN_FRAMES: u32 = 1_000;

/// The parts of core 1 that need the LMU.
struct Attached<'b> {
    map: ControllerMap<'b>,
    to_planning: Sender<'b>,
    scenes: Writer<'b, Scene>,
    knowledge: Reader<'b, Knowledge>,
    time: Reader<'b, VehicleTime>,
}

/// A cycle that has begun and is not completed.
#[derive(Clone, Copy)]
struct Begun {
    released: Instant,
    at: Instant,
}

/// The perception core.
pub struct Core1<'b, B: Board> {
    board: &'b B,
    attached: Option<Attached<'b>>,
    frames: FrameReceiver,
    perception: Perception,
    /// When the next round of the sensors is expected to be complete.
    expected: Instant,
    /// The cycle that has begun.
    begun: Option<Begun>,
    /// Frames that the receiver has lost, at the last cycle.
    overruns: u32,
    /// The vehicle's time, once core 0 has one.
    time: Option<VehicleTime>,
}

impl<'b, B: Board> Core1<'b, B> {
    /// Starts the core's incarnation on this board.
    #[must_use]
    pub fn new(board: &'b B) -> Self {
        let start = board.now();
        let (generation, cause) = (board.identity().generation.0, 0);
        board.trace(Event::Started { generation, cause }.encode());
        Self {
            board,
            attached: None,
            frames: FrameReceiver::new(),
            perception: Perception::new(),
            expected: start + PERIOD,
            begun: None,
            overruns: 0,
            time: None,
        }
    }

    fn attach(&mut self) {
        let Ok(map) = ControllerMap::attach(self.board) else {
            return;
        };
        let (Ok(to_planning), Ok(scenes), Ok(knowledge), Ok(time)) = (
            MAILBOX_1_TO_2.sender(&map.map, map.incarnation),
            SCENE.writer(&map.map, map.incarnation),
            KNOWLEDGE.reader(&map.map),
            VEHICLE_TIME.reader(&map.map),
        ) else {
            return;
        };
        // An earlier incarnation may have posted a signal without ringing.
        self.board.ring(CoreId::PLANNING);
        self.attached = Some(Attached {
            map,
            to_planning,
            scenes,
            knowledge,
            time,
        });
    }

    /// Reads the frames that have arrived. If they release a cycle, the cycle begins, and the next
    /// [`Core::poll`] completes it. For an executor that simulates execution time: frames that
    /// arrive during a cycle wait for the next one. Returns whether a cycle has begun. Same context
    /// as `poll`.
    pub fn begin(&mut self) -> bool {
        if self.attached.is_none() {
            self.attach();
        }
        if self.begun.is_some() {
            return true;
        }
        let Some(Release { at, missed }) = self.release() else {
            return false;
        };
        let task = TaskCode::PERCEPTION;
        if missed > 0 {
            self.board
                .trace(Event::DeadlineMiss { task, missed }.encode());
        }
        let overruns = self.board.can().overruns();
        let count = overruns.wrapping_sub(core::mem::replace(&mut self.overruns, overruns));
        if count > 0 {
            self.board.trace(Event::FramesLost { count }.encode());
        }
        let now = self.board.now();
        let begin = Begin::Released {
            late_ns: age_ns(now, at),
            missed,
        };
        self.board.trace(Event::TaskIn { task, begin }.encode());
        self.begun = Some(Begun {
            released: at,
            // After a time-out it has read all frames until now.
            at: match self.perception.is_on_vehicle_time()
                && at < self.expected + PATIENCE
                && now.since(at) < PERIOD
            {
                true => at,
                false => now,
            },
        });
        true
    }

    fn complete(&mut self, begun: Begun) {
        self.cycle(begun.at);
        let (task, leaves) = (TaskCode::PERCEPTION, Leaves::Done);
        self.board.trace(Event::TaskOut { task, leaves }.encode());
        let earliest = self.board.now() + SHORTEST;
        let next = self.perception.next_round(earliest, PERIOD);
        self.expected = next.unwrap_or(begun.released + (PERIOD - PATIENCE));
    }

    /// Fetches the vehicle's time, by which global stamps of the sensors are read.
    fn fetch_time(&mut self) {
        if let Some(attached) = &mut self.attached
            && let Ok(Some(time)) = attached.time.fetch()
        {
            self.time = Some(time);
        }
        let now = self.board.now();
        let clock = self.time.and_then(|time| time.clock(now));
        self.perception.set_global(clock);
    }

    /// Reads the frames that have arrived. Returns the time at which the frame that completed the
    /// round was on the bus; `None` if the round is not complete.
    fn receive(&mut self) -> Option<Instant> {
        self.fetch_time();
        let mut completed = None;
        let mut left = CAN_FRAMES;
        while let Some((at, frame)) = read_can(self.board, &mut self.frames, &mut left, |_| {}) {
            if let ReceivedFrame::Valid(message) = frame {
                self.perception.on_message(at, &message);
                completed = match self.perception.is_round_complete() {
                    true => completed.or(Some(at)),
                    false => None,
                };
                // In both systems the same frame is the cycle's last one. A core that was held up
                // takes all that waits, so that it is not late by a round for ever.
                if let Some(at) = completed
                    && self.perception.is_on_vehicle_time()
                    && self.board.now().since(at) < PERIOD
                {
                    break;
                }
            }
        }
        completed
    }

    /// Returns the release if it is due: the round is complete, or the wait for it has timed out.
    fn release(&mut self) -> Option<Release> {
        let completed = self.receive();
        let limit = self.expected + PATIENCE;
        let due = completed.or((self.board.now() >= limit).then_some(limit))?;
        let since_limit = self.board.now().since(limit);
        let missed = u32::try_from(since_limit.as_ns() / PERIOD.as_ns()).unwrap_or(u32::MAX);
        let at = if completed.is_some() {
            due
        } else {
            due + PERIOD.times(missed)
        };
        Some(Release { at, missed })
    }

    fn cycle(&mut self, now: Instant) {
        let Some(attached) = &mut self.attached else {
            return;
        };
        let is_starting = self.perception.is_starting();
        let knowledge = is_starting
            .then(|| attached.knowledge.fetch().ok()?)
            .flatten();
        let before = self.perception.scene().missing;
        let scene = self.perception.cycle_with(now, knowledge.as_ref());
        let (flow, missing) = (scene.cycle, scene.missing);
        if missing != before {
            self.board.trace(Event::Sensors { missing }.encode());
        }
        attached.scenes.publish(scene);
        if let Some(RefusedStamp { source, off_us }) = self.perception.take_refused() {
            let refused = Event::StampRefused {
                source,
                later: off_us < 0,
                off_us: off_us.unsigned_abs(),
            };
            self.board.trace(refused.encode());
        }
        attached.map.count_cycle();
        let (core, task) = (CoreId::PLANNING, TaskCode::PLANNING);
        self.board.trace(Event::Wake { core, task, flow }.encode());
        if attached.to_planning.signal(PLAN) == Ring::Needed {
            self.board.trace(Event::Ring { core }.encode());
            self.board.ring(core);
        }
    }
}

impl<B: Board> Core for Core1<'_, B> {
    fn poll(&mut self) -> Instant {
        let can = self.board.can();
        let mut woken = false;
        loop {
            self.begin();
            if let Some(begun) = self.begun.take() {
                self.complete(begun);
            }
            // Once a complete round is expected, each frame may complete it.
            let waits = self.board.now() >= self.expected + MARGIN;
            can.wake_on_receive(waits);
            if waits == woken {
                break;
            }
            // A frame may have arrived before the call.
            woken = waits;
        }
        let poll_at = self.expected + if woken { PATIENCE } else { MARGIN };
        match self.attached {
            Some(_) => poll_at,
            None => poll_at.min(self.board.now() + RETRY),
        }
    }
}
