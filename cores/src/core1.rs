//! Core 1: every 50 ms acquires the sensors' lists from CAN, fuses them, and signals core 2.
//! T-CHIP-3

use crate::driving::perception::Perception;
use crate::driving::types::Scene;
use crate::layout::{ControllerMap, MAILBOX_1_TO_2, PLAN, SCENE, age_ns};
use crate::schedule::{Grid, Release};
use crate::task_table::{CORE_1, TaskCode};
use crate::trace::{Begin, Event, Leaves};
use crate::{Core, Heard, RETRY, read_can};
use tandem_board::{Board, CoreId, Duration, Instant};
use tandem_bus::Receiver;
use tandem_shm::mailbox::{Ring, Sender};
use tandem_shm::typed::Writer;

/// The period of the sensors.
pub const PERIOD: Duration = CORE_1[0].period;

/// Frames that one cycle takes from the CAN receiver: as many as a bus of 1 Mbit/s carries in a
/// period. The rest waits for the next cycle.
const CAN_FRAMES: u32 = 1_000;

/// What core 1 has once it is attached to the LMU.
struct Attached<'b> {
    map: ControllerMap<'b>,
    to_planning: Sender<'b>,
    scenes: Writer<'b, Scene>,
}

/// The perception core.
pub struct Core1<'b, B: Board> {
    board: &'b B,
    attached: Option<Attached<'b>>,
    frames: Receiver,
    perception: Perception,
    grid: Grid,
}

impl<'b, B: Board> Core1<'b, B> {
    /// Starts the core's incarnation on this board.
    #[must_use]
    pub fn new(board: &'b B) -> Self {
        let start = board.now();
        let generation = board.identity().generation.0;
        board.trace(
            Event::Started {
                generation,
                cause: 0,
            }
            .encode(),
        );
        Self {
            board,
            attached: None,
            frames: Receiver::new(),
            perception: Perception::new(),
            grid: Grid::new(start + PERIOD, PERIOD),
        }
    }

    fn attach(&mut self) {
        let Ok(map) = ControllerMap::attach(self.board) else {
            return;
        };
        let (Ok(to_planning), Ok(scenes)) = (
            MAILBOX_1_TO_2.sender(&map.map, map.incarnation),
            SCENE.writer(&map.map, map.incarnation),
        ) else {
            return;
        };
        // What an earlier incarnation has counted, but not rung for.
        self.board.ring(CoreId::PLANNING);
        self.attached = Some(Attached {
            map,
            to_planning,
            scenes,
        });
    }

    /// The task of this core.
    fn run(&mut self, release: Release) {
        let task = TaskCode::PERCEPTION;
        let begin = Begin::Released {
            late_ns: age_ns(self.board.now(), release.at),
            missed: release.missed,
        };
        self.board.trace(Event::TaskIn { task, begin }.encode());
        self.cycle();
        let leaves = Leaves::Done;
        self.board.trace(Event::TaskOut { task, leaves }.encode());
    }

    fn cycle(&mut self) {
        let mut left = CAN_FRAMES;
        while let Some((at, heard)) = read_can(self.board, &mut self.frames, &mut left) {
            if let Heard::Valid(message) = heard {
                self.perception.on_message(at, &message);
            }
        }
        let Some(attached) = &mut self.attached else {
            return;
        };
        let scene = self.perception.cycle(self.board.now());
        let flow = scene.cycle;
        attached.scenes.publish(scene);
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
        if self.attached.is_none() {
            self.attach();
        }
        while let Some(release) = self.grid.release(self.board.now()) {
            self.run(release);
        }
        if self.attached.is_some() {
            self.grid.next()
        } else {
            self.board.now() + RETRY
        }
    }
}
