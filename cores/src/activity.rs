//! What runs on which core, as the trace names it: tasks and interrupts with their codes.
//!
//! The codes are the same whoever schedules: the executor of [`crate::schedule`], an RTOS, or a
//! board's main loop. A code that is in no table is shown by its number, so an RTOS may trace tasks
//! that nobody has named here.

use crate::{core0, core1};
use tandem_board::{CoreId, Duration};

/// A task in the trace; 0 is none.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct TaskCode(pub u8);

impl TaskCode {
    /// Core 1: acquires the sensors' lists and fuses them.
    pub const PERCEPTION: Self = Self(1);
    /// Core 2: decides and plans.
    pub const PLANNING: Self = Self(2);
    /// Core 0: motion control and the control frame.
    pub const CONTROL: Self = Self(3);
    /// Core 0: the L2 functions of degraded mode, within or instead of [`Self::CONTROL`].
    pub const DEGRADED: Self = Self(4);
    /// Core 0: heartbeats, what has come from the other system, and the state machine of the roles.
    pub const REDUNDANCY: Self = Self(5);
    /// Core 0: heartbeats, where they are a task of their own.
    pub const HEARTBEAT: Self = Self(6);
    /// Core 0: watchdogs and the cores' alive counters.
    pub const MONITORING: Self = Self(7);
    /// Core 0: the status frame.
    pub const STATUS: Self = Self(8);
    /// Core 0: the handler of core 2's signal, which fetches the trajectory.
    pub const FOLLOW: Self = Self(9);
    /// An RTOS's idle task.
    pub const IDLE: Self = Self(10);
    /// An RTOS's timer task.
    pub const TIMERS: Self = Self(11);
}

/// An interrupt in the trace; 0 is none.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct IrqCode(pub u8);

impl IrqCode {
    /// The doorbell: another core, an edge on a line, or a CAN frame that the core asked to be
    /// woken for.
    pub const DOORBELL: Self = Self(1);
    /// The tick of an RTOS.
    pub const TICK: Self = Self(2);
    /// The CAN controller.
    pub const CAN: Self = Self(3);
    /// An edge on a line from the other system.
    pub const EDGE: Self = Self(4);

    /// Its name; `None` if it has none.
    #[must_use]
    pub const fn name(self) -> Option<&'static str> {
        Some(match self {
            Self::DOORBELL => "doorbell",
            Self::TICK => "tick",
            Self::CAN => "CAN",
            Self::EDGE => "edge",
            _ => return None,
        })
    }
}

/// A task as reports show it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TaskInfo {
    /// Its code.
    pub code: TaskCode,
    /// Its name.
    pub name: &'static str,
    /// Time between two releases; `None` if it is released by an event.
    pub period: Option<Duration>,
    /// A job must be done so long after its release; `None` if nobody says.
    pub deadline: Option<Duration>,
}

const fn periodic(code: TaskCode, name: &'static str, period: Duration) -> TaskInfo {
    TaskInfo {
        code,
        name,
        period: Some(period),
        // A job must be done when the next one is released.
        deadline: Some(period),
    }
}

const fn sporadic(code: TaskCode, name: &'static str, deadline: Option<Duration>) -> TaskInfo {
    TaskInfo {
        code,
        name,
        period: None,
        deadline,
    }
}

const CONTROL: [TaskInfo; 9] = [
    periodic(TaskCode::CONTROL, "control", core0::CONTROL_PERIOD),
    sporadic(TaskCode::DEGRADED, "degraded mode", None),
    sporadic(TaskCode::REDUNDANCY, "heartbeat and roles", None),
    sporadic(TaskCode::HEARTBEAT, "heartbeat", None),
    periodic(TaskCode::MONITORING, "monitoring", core0::MONITORING_PERIOD),
    periodic(TaskCode::STATUS, "status", core0::STATUS_PERIOD),
    sporadic(TaskCode::FOLLOW, "follow", None),
    sporadic(TaskCode::IDLE, "idle", None),
    sporadic(TaskCode::TIMERS, "timers", None),
];
const PERCEPTION: [TaskInfo; 1] = [periodic(TaskCode::PERCEPTION, "perception", core1::PERIOD)];
// Released by core 1's signal; the next one comes a period later.
const PLANNING: [TaskInfo; 1] = [sporadic(
    TaskCode::PLANNING,
    "planning",
    Some(core1::PERIOD),
)];

/// The tasks of a core, in falling order of importance to a reader.
#[must_use]
pub const fn tasks(core: CoreId) -> &'static [TaskInfo] {
    match core {
        CoreId::CONTROL => &CONTROL,
        CoreId::PERCEPTION => &PERCEPTION,
        _ => &PLANNING,
    }
}

/// What is known of a task of this core; `None` if it has no name.
#[must_use]
pub fn task(core: CoreId, code: TaskCode) -> Option<&'static TaskInfo> {
    tasks(core).iter().find(|info| info.code == code)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_code_means_two_tasks_and_none_means_nothing() {
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
    }
}
