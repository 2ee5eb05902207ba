//! Core 2: woken by core 1, decides and plans, and signals core 0. T-CHIP-3

use crate::driving::control::is_right;
use crate::driving::degraded::is_right_by_scene;
use crate::driving::knowledge::Knowledge;
use crate::driving::parking::is_right_parking;
use crate::driving::planning::Planner;
use crate::driving::types::{ControlStep, Scene, StepFunction, Trajectory};
use crate::layout::{
    CONTROL_STEP, ControllerMap, KNOWLEDGE, MAILBOX_1_TO_2, MAILBOX_2_TO_0, PLAN, SCENE,
    TRAJECTORY, TRAJECTORY_READY,
};
use crate::release::Cycles;
use crate::task_table::TaskCode;
use crate::tester_desk::{DeskSeat, Unguarded};
use crate::trace::{Begin, Event, Leaves};
use crate::{Core, RETRY};
use tandem_board::{Board, CoreId, Duration, Instant, TesterDesk};
use tandem_shm::mailbox::{Call, Receiver, Ring, Sender, TaskTable};
use tandem_shm::newest::{Reader, Writer};

/// Period of polls without a doorbell: a lost doorbell costs one cycle.
const LOOK: Duration = Duration::from_ms(50);

/// The planning task with all that it uses. Core 1's signal runs it.
struct Planning<'b, B: Board> {
    board: &'b B,
    map: ControllerMap<'b>,
    scenes: Reader<'b, Scene>,
    /// The last scene.
    scene: Option<Scene>,
    planner: Planner,
    cycles: Cycles,
    trajectories: Writer<'b, Trajectory>,
    control_steps: Reader<'b, ControlStep>,
    knowledge: Reader<'b, Knowledge>,
    to_control: Sender<'b>,
}

impl<B: Board> Planning<'_, B> {
    fn run(&mut self, _arg: u32, _call: Call) {
        let (task, begin, leaves) = (TaskCode::PLANNING, Begin::Goes, Leaves::Done);
        self.trace(Event::TaskIn { task, begin });
        self.plan();
        self.trace(Event::TaskOut { task, leaves });
    }

    /// Computes core 0's newest step again, from this core's copy of the trajectory or the scene.
    fn judge_control(&mut self) {
        let Ok(Some(step)) = self.control_steps.fetch() else {
            return;
        };
        let is_right = match (step.function, self.planner.last(), &self.scene) {
            (StepFunction::Trajectory, Some((trajectory, ego)), _)
                if trajectory.cycle == step.cycle =>
            {
                is_right(&step, trajectory, ego)
            }
            (StepFunction::Keep | StepFunction::Stop, _, Some(scene))
                if scene.cycle == step.cycle =>
            {
                is_right_by_scene(&step, scene)
            }
            (StepFunction::Blind, _, Some(scene)) => is_right_by_scene(&step, scene),
            (StepFunction::Parking, ..) => is_right_parking(&step),
            _ => return,
        };
        self.map.judge_control(is_right);
    }

    fn plan(&mut self) {
        self.judge_control();
        if self.planner.is_starting()
            && let Ok(Some(knowledge)) = self.knowledge.fetch()
        {
            self.planner.recall(&knowledge);
        }
        match self.scenes.fetch() {
            Ok(Some(scene)) => {
                let flow = scene.cycle;
                let missed = self.cycles.missed(flow);
                if missed > 0 {
                    let task = TaskCode::PLANNING;
                    self.trace(Event::DeadlineMiss { task, missed });
                }
                self.trace(Event::Woken {
                    core: CoreId::PERCEPTION,
                    flow,
                });
                let trajectory = self.planner.plan(&scene);
                self.scene = Some(scene);
                self.trajectories.publish(&trajectory);
                self.map.count_cycle();
                let (core, task) = (CoreId::CONTROL, TaskCode::TRAJECTORY_INPUT);
                self.trace(Event::Wake { core, task, flow });
                if self.to_control.signal(TRAJECTORY_READY) == Ring::Needed {
                    self.trace(Event::Ring { core });
                    self.board.ring(core);
                }
            }
            Ok(None) => {}
            Err(_) => self.trace(Event::Refused { id: 0 }),
        }
    }

    fn trace(&self, event: Event) {
        self.board.trace(event.encode());
    }
}

/// The planning core.
pub struct Core2<'b, B: Board, D = Unguarded> {
    board: &'b B,
    tasks: TaskTable<Planning<'b, B>>,
    attached: Option<(Receiver<'b>, Planning<'b, B>, DeskSeat<'b>)>,
    desk: D,
}

impl<'b, B: Board> Core2<'b, B> {
    /// Starts the core's incarnation on this board. Every tester may have the system leave for a
    /// download.
    #[must_use]
    pub fn new(board: &'b B) -> Self {
        Self::with_desk(board, Unguarded(board.identity().system))
    }
}

impl<'b, B: Board, D: TesterDesk> Core2<'b, B, D> {
    /// Starts the core's incarnation on this board, with a desk that answers testers.
    #[must_use]
    pub fn with_desk(board: &'b B, desk: D) -> Self {
        let (generation, cause) = (board.identity().generation.0, 0);
        board.trace(Event::Started { generation, cause }.encode());
        let mut tasks = TaskTable::new();
        // The table is new, so the id is free.
        let _taken = tasks.add(PLAN, Planning::run, 0);
        Self {
            board,
            tasks,
            attached: None,
            desk,
        }
    }

    fn attach(&mut self) -> Option<()> {
        let lmu = ControllerMap::attach(self.board).ok()?;
        let (map, incarnation) = (lmu.map, lmu.incarnation);
        let planning = Planning {
            board: self.board,
            map: lmu,
            scenes: SCENE.reader(&map).ok()?,
            scene: None,
            planner: Planner::new(),
            cycles: Cycles::default(),
            trajectories: TRAJECTORY.writer(&map, incarnation).ok()?,
            control_steps: CONTROL_STEP.reader(&map).ok()?,
            knowledge: KNOWLEDGE.reader(&map).ok()?,
            to_control: MAILBOX_2_TO_0.sender(&map, incarnation).ok()?,
        };
        lmu.judge_control(true);
        // An earlier incarnation may have posted a signal without ringing.
        self.board.ring(CoreId::CONTROL);
        let receiver = MAILBOX_1_TO_2.receiver(&map, incarnation).ok()?;
        self.attached = Some((receiver, planning, DeskSeat::attach(&lmu)?));
        Some(())
    }
}

impl<B: Board, D: TesterDesk> Core for Core2<'_, B, D> {
    fn poll(&mut self) -> Instant {
        if self.attached.is_none() {
            self.attach();
        }
        let Some((receiver, planning, seat)) = &mut self.attached else {
            return self.board.now() + RETRY;
        };
        receiver.awake();
        loop {
            self.tasks.run(receiver, planning);
            // A plan goes first: the desk may be busy for as long as a signature takes.
            let (now, has_role) = (self.board.now(), planning.map.has_role());
            if seat.poll(&mut self.desk, now, has_role) {
                return now;
            }
            if receiver.prepare_sleep() {
                return self.board.now() + LOOK;
            }
        }
    }
}
