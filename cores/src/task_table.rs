//! The table of all tasks: what runs on which core, when, and how urgently.
//!
//! Everything that names a task reads this table: the executors of core 0, the trace, the report,
//! the response-time analysis, and the tables in `docs/`. A code that is not in the table is shown
//! as its number.

use crate::doorbell::DOORBELL_DISTANCE;
use tandem_board::{CoreId, Duration};

/// A task's number in the trace; 0 is none.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct TaskCode(pub u8);

impl TaskCode {
    /// Core 1: acquires the sensors' lists and fuses them.
    pub const PERCEPTION: Self = Self(1);
    /// Core 2: decides and plans.
    pub const PLANNING: Self = Self(2);
    /// Core 0: motion control and the control frame.
    pub const CONTROL: Self = Self(3);
    /// Core 0: the L2 functions of degraded mode, instead of [`Self::CONTROL`].
    pub const DEGRADED: Self = Self(4);
    /// Core 0: heartbeats, messages of the other system, and the state machine of the roles.
    pub const ROLES: Self = Self(5);
    /// Core 0: watchdogs and the cores' alive counters.
    pub const MONITORING: Self = Self(7);
    /// Core 0: the status frame.
    pub const STATUS: Self = Self(8);
    /// Core 0: fetches scene and trajectory when core 2 signals.
    pub const TRAJECTORY_INPUT: Self = Self(9);
    /// Core 0: topics over DDS, to and from the SoC.
    pub const TOPICS: Self = Self(10);
    /// Core 0: the time of the vehicle.
    pub const TIME: Self = Self(11);

    /// Returns whether this task runs the control cycle.
    #[must_use]
    pub const fn is_control(self) -> bool {
        matches!(self, Self::CONTROL | Self::DEGRADED)
    }

    /// Returns its name; `None` if it is in no table.
    #[must_use]
    pub fn name(self) -> Option<&'static str> {
        let mut cores = CoreId::ALL.into_iter();
        cores.find_map(|core| task(core, self).map(|info| info.name))
    }
}

/// The causes that release a task.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ReleasedBy {
    /// Its period: releases lie on a grid of absolute time.
    Period,
    /// A time that the task itself asks for at the end of each job.
    OwnDeadline,
    /// The doorbell's interrupt: a signal of another core, or an edge on a line.
    Doorbell,
    /// Another task of its core.
    Task(TaskCode),
}

/// The parts that tasks of core 0 share, each behind its own lock.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SharedPart {
    /// The redundancy, CAN, link, flash and outputs: [`SharedState`](crate::core0::SharedState).
    Shared,
    /// Scene, trajectory and the controllers' state: [`Driving`](crate::core0::Driving).
    Drive,
}

/// One task.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TaskInfo {
    /// Its code in the trace.
    pub code: TaskCode,
    /// Its name; at most 23 bytes, the limit of the kernel.
    pub name: &'static str,
    /// The causes that release it.
    pub released_by: &'static [ReleasedBy],
    /// Time between two releases. For control, a tick less while its grid follows the trajectories.
    pub period: Duration,
    /// The longest time from a release to the end of its job. `None` if the trace has no such
    /// release; the analysis then uses the period.
    pub deadline: Option<Duration>,
    /// Priority of the kernel's task, 1 to 30: a higher one pre-empts a lower one. 0 on cores
    /// without a kernel.
    pub priority: u8,
    /// The parts that it shares with other tasks of its core.
    pub uses: &'static [SharedPart],
    /// What it does, for the table in the documentation.
    pub purpose: &'static str,
}

impl TaskInfo {
    /// Returns whether its releases lie on a grid of its period.
    #[must_use]
    pub fn is_periodic(&self) -> bool {
        self.released_by.contains(&ReleasedBy::Period)
    }

    /// Returns whether the doorbell's interrupt releases it.
    #[must_use]
    pub fn is_for_interrupts(&self) -> bool {
        self.released_by.contains(&ReleasedBy::Doorbell)
    }
}

use ReleasedBy::{Doorbell, OwnDeadline, Period, Task};

/// The tasks of core 0, in falling order of priority: rate-monotonic, with the task last that
/// nothing on the way from a sensor to the actuators waits for.
pub const CORE_0: [TaskInfo; 8] = [
    TaskInfo {
        code: TaskCode::ROLES,
        name: "heartbeat and roles",
        released_by: &[OwnDeadline, Doorbell],
        // The kernel's tick.
        period: Duration::from_ms(1),
        deadline: None,
        priority: 12,
        uses: &[SharedPart::Shared],
        purpose: "reads CAN and the data link, judges the lines, sends heartbeats, changes roles, \
                  drives the flash",
    },
    TaskInfo {
        code: TaskCode::MONITORING,
        name: "monitoring",
        released_by: &[Period],
        period: Duration::from_ms(5),
        deadline: Some(Duration::from_ms(5)),
        priority: 10,
        uses: &[SharedPart::Shared],
        purpose: "window and functional watchdog, alive counters of cores 1 and 2",
    },
    TaskInfo {
        code: TaskCode::CONTROL,
        name: "control",
        // A takeover restarts the grid at once.
        released_by: &[Period, Task(TaskCode::ROLES)],
        period: Duration::from_ms(10),
        deadline: Some(Duration::from_ms(10)),
        priority: 8,
        uses: &[SharedPart::Shared, SharedPart::Drive],
        purpose: "motion control, control frame, report over the link",
    },
    TaskInfo {
        code: TaskCode::DEGRADED,
        name: "degraded mode",
        released_by: &[Task(TaskCode::CONTROL)],
        period: Duration::from_ms(10),
        deadline: None,
        priority: 7,
        uses: &[SharedPart::Shared, SharedPart::Drive],
        purpose: "the same cycle with the L2 functions, when the system drives alone",
    },
    TaskInfo {
        code: TaskCode::TRAJECTORY_INPUT,
        name: "trajectory input",
        released_by: &[Doorbell],
        // Core 2 signals every 50 ms; the doorbell may ring more often.
        period: Duration::from_ms(50),
        deadline: None,
        priority: 5,
        uses: &[SharedPart::Shared, SharedPart::Drive],
        purpose: "fetches scene and trajectory that cores 1 and 2 published",
    },
    TaskInfo {
        code: TaskCode::STATUS,
        name: "status",
        released_by: &[Period],
        period: Duration::from_ms(100),
        deadline: Some(Duration::from_ms(100)),
        priority: 3,
        uses: &[SharedPart::Shared],
        purpose: "status frame",
    },
    TaskInfo {
        code: TaskCode::TIME,
        name: "time",
        released_by: &[OwnDeadline, Task(TaskCode::ROLES)],
        period: Duration::from_ms(10),
        deadline: None,
        priority: 2,
        uses: &[SharedPart::Shared],
        purpose: "follows the grandmaster or the other system, tells the time to it and to the sensors",
    },
    TaskInfo {
        code: TaskCode::TOPICS,
        name: "topics",
        released_by: &[OwnDeadline, Task(TaskCode::ROLES)],
        period: Duration::from_ms(5),
        deadline: None,
        priority: 1,
        uses: &[SharedPart::Shared, SharedPart::Drive],
        purpose: "publishes the frames of the bus, reads the SoC's commands; only with a network",
    },
];

/// The task of core 1.
pub const CORE_1: [TaskInfo; 1] = [TaskInfo {
    code: TaskCode::PERCEPTION,
    name: "perception",
    // The sensors' round: the task polls when it is expected, and then at each frame.
    released_by: &[OwnDeadline, Doorbell],
    period: Duration::from_ms(50),
    deadline: Some(Duration::from_ms(50)),
    priority: 0,
    uses: &[],
    purpose: "acquires the sensors' lists and fuses them to a scene",
}];

/// The task of core 2. Core 1's signal releases it; the next signal follows a period later.
pub const CORE_2: [TaskInfo; 1] = [TaskInfo {
    code: TaskCode::PLANNING,
    name: "planning",
    released_by: &[Doorbell],
    period: CORE_1[0].period,
    deadline: Some(CORE_1[0].period),
    priority: 0,
    uses: &[],
    purpose: "decides and plans a trajectory",
}];

/// Returns the tasks of a core, in falling order of priority.
#[must_use]
pub const fn tasks(core: CoreId) -> &'static [TaskInfo] {
    match core {
        CoreId::CONTROL => &CORE_0,
        CoreId::PERCEPTION => &CORE_1,
        _ => &CORE_2,
    }
}

/// Returns the table row of this task of the core; `None` if there is none.
#[must_use]
pub fn task(core: CoreId, code: TaskCode) -> Option<&'static TaskInfo> {
    tasks(core).iter().find(|info| info.code == code)
}

/// An interrupt in the trace; 0 is none.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct IrqCode(pub u8);

impl IrqCode {
    /// The doorbell: another core, an edge on a line, or a CAN frame that the core asked to be
    /// woken for.
    pub const DOORBELL: Self = Self(1);
    /// The tick of the kernel.
    pub const TICK: Self = Self(2);

    /// Returns its name; `None` if it has none.
    #[must_use]
    pub fn name(self) -> Option<&'static str> {
        let info = INTERRUPTS.iter().find(|info| info.code == self);
        info.map(|info| info.name)
    }
}

/// One interrupt of core 0; its handler is more urgent than every task.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct IrqInfo {
    /// Its code in the trace.
    pub code: IrqCode,
    /// Its name.
    pub name: &'static str,
    /// Shortest time between two interrupts.
    pub period: Duration,
}

/// The interrupts of core 0.
pub const INTERRUPTS: [IrqInfo; 2] = [
    IrqInfo {
        code: IrqCode::TICK,
        name: "tick",
        period: Duration::from_ms(1),
    },
    IrqInfo {
        code: IrqCode::DOORBELL,
        name: "doorbell",
        period: DOORBELL_DISTANCE,
    },
];

#[cfg(test)]
mod tests {
    use super::*;
    use crate::core0::Core0Task;

    #[test]
    fn each_code_is_one_task_and_zero_is_none() {
        let mut codes: std::vec::Vec<u8> = CoreId::ALL
            .iter()
            .flat_map(|core| tasks(*core))
            .map(|info| info.code.0)
            .collect();
        codes.sort_unstable();
        let count = codes.len();
        codes.dedup();
        assert_eq!(codes.len(), count);
        assert!(!codes.contains(&0));
        assert_eq!(task(CoreId::PLANNING, TaskCode::CONTROL), None);
        assert_eq!(IrqCode::TICK.name(), Some("tick"));
        assert_eq!(IrqCode(9).name(), None);
    }

    /// Core 0 is scheduled rate-monotonically: the shorter the period, the more urgent. Topics are
    /// less urgent than all that drives, and so is the time. No two tasks have the same priority,
    /// so the kernel never chooses their order.
    #[test]
    fn the_priorities_of_core_0_are_rate_monotonic() {
        for pair in CORE_0.windows(2) {
            let is_monotonic = pair[0].period <= pair[1].period;
            assert!(
                is_monotonic || matches!(pair[1].code, TaskCode::TOPICS | TaskCode::TIME),
                "{}",
                pair[1].name
            );
            assert!(pair[0].priority > pair[1].priority, "{}", pair[1].name);
        }
        assert!(CORE_0.iter().all(|info| (1..=30).contains(&info.priority)));
        assert!(CORE_0.iter().all(|info| info.name.len() < 24));
        assert!(
            CORE_0
                .iter()
                .all(|info| info.deadline.unwrap_or(info.period) <= info.period)
        );
    }

    /// A task releases only less urgent ones, so one pass in order of priority runs all of them.
    #[test]
    fn a_task_is_released_only_by_more_urgent_ones() {
        for info in &CORE_0 {
            for by in info.released_by {
                if let Task(code) = by {
                    let by = task(CoreId::CONTROL, *code).unwrap();
                    assert!(by.priority > info.priority, "{}", info.name);
                }
            }
        }
    }

    #[test]
    fn the_ids_of_core_0_are_rows_of_the_table() {
        assert_eq!(Core0Task::ALL.map(|id| *id.info()), CORE_0);
        for id in Core0Task::ALL {
            assert_eq!(Core0Task::of(id.info().code), Some(id));
        }
    }
}
