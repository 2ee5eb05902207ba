//! Cores in virtual time. On core 0 a more urgent task pre-empts a less urgent one; a cycle of core
//! 1 or 2 is never interrupted.
//!
//! Core 0 has an executor over the task table that schedules as FreeRTOS does: fixed priorities, a
//! tick of 1 ms, a doorbell whose interrupts have a minimum spacing. The body of a job runs when
//! the job first gets the processor, and its messages leave when the job ends. So a job uses the
//! oldest inputs and produces the latest outputs that its execution permits. Locks take no time.
//!
//! Cores 1 and 2 have no kernel. Other cores see at once what a cycle writes to shared memory, so
//! its body runs when its execution ends. Core 1 takes its frames when the cycle begins. Core 2
//! reads the scene at the end: it is still the same, as planning ends before the next scene.

use crate::timing::{DOORBELL, TICK, Time};
use std::cell::{Cell, RefCell};
use tandem_board::{Board, Duration, Instant};
use tandem_board_sim::{Poller, SimBoard};
use tandem_cores::core0::{
    Core0Task, Driving, Executor, Parts, SharedState, TaskBody, TaskSet, Tasks,
};
use tandem_cores::core1::Core1;
use tandem_cores::core2::Core2;
use tandem_cores::doorbell::{DoorbellThrottle, RingOutcome};
use tandem_cores::release::TickGrid;
use tandem_cores::task_table::TaskCode;
use tandem_cores::trace::{Begin, Event, Leaves};
use tandem_cores::{Config, Core};

const TASKS: usize = Core0Task::ALL.len();

struct Flow {
    board: &'static SimBoard,
    shared: RefCell<SharedState<'static, SimBoard>>,
    drive: RefCell<Driving>,
    released: Cell<TaskSet>,
    doorbell: DoorbellThrottle,
    /// Whether the running body has reported the start of a job.
    has_begun: Cell<bool>,
}

impl Executor<'static, SimBoard> for Flow {
    fn shared<R>(&self, body: impl FnOnce(&mut SharedState<'static, SimBoard>) -> R) -> R {
        body(&mut self.shared.borrow_mut())
    }

    fn drive<R>(&self, body: impl FnOnce(&mut Driving) -> R) -> R {
        body(&mut self.drive.borrow_mut())
    }

    fn release(&self, tasks: TaskSet) {
        self.released.set(self.released.get() | tasks);
    }

    fn held_back(&self) -> u32 {
        self.doorbell.held_back()
    }

    fn begins(&self, task: Core0Task, begin: Begin) {
        self.has_begun.set(true);
        trace_in(self.board, task.info().code, begin);
    }

    /// Does nothing: the job ends when its execution time has passed.
    fn ends(&self, _: Core0Task) {}
}

fn trace_in(board: &SimBoard, task: TaskCode, begin: Begin) {
    board.trace(Event::TaskIn { task, begin }.encode());
}

fn trace_out(board: &SimBoard, task: TaskCode, leaves: Leaves) {
    board.trace(Event::TaskOut { task, leaves }.encode());
}

/// The ticks of the kernel, in virtual time.
#[derive(Clone, Copy)]
struct KernelTicks {
    /// With the last tick.
    grid: TickGrid,
    /// When the next one is due.
    next: Instant,
}

impl KernelTicks {
    fn new(now: Instant) -> Self {
        let (number, period) = (0, Duration::from_ms(1));
        Self {
            grid: TickGrid {
                number,
                origin: now,
                period,
            },
            next: now + period,
        }
    }

    /// Counts the ticks that are due; returns whether there is one.
    fn advance(&mut self, now: Instant) -> bool {
        if now < self.next {
            return false;
        }
        let late = TickGrid {
            origin: self.next,
            ..self.grid
        };
        let due = 1 + late.before(now) as u32;
        self.grid.number = self.grid.number.saturating_add(due);
        self.grid.origin = late.floor(now);
        self.next = self.grid.origin + self.grid.period;
        true
    }

    /// Moves the next tick and all later ones, as the kernel's port does: by at most 100 µs, once a
    /// tick, and not a tick that is less than 50 µs away before or after that.
    fn shift(&mut self, now: Instant, by_ns: i32) {
        let by_ns = by_ns.clamp(-100_000, 100_000);
        let moved = Instant::from_ns(self.next.as_ns().saturating_add_signed(by_ns.into()));
        let is_near = now + Duration::from_us(50) > self.next.min(moved);
        if !is_near && self.next == self.grid.origin + self.grid.period {
            self.next = moved;
        }
    }
}

/// The scheduler's state of a task.
#[derive(Clone, Copy)]
struct State {
    /// The number of the tick that releases it.
    due: u64,
    /// The ticks as it has last read them.
    ticks: TickGrid,
    /// Whether it was released and its job has not begun.
    ready: bool,
    /// The remaining execution time of its job, ns.
    left_ns: Option<u64>,
}

struct TimedCore0 {
    time: Time,
    flow: Flow,
    tasks: Tasks<'static, SimBoard>,
    ticks: KernelTicks,
    /// The tick after which the shared state has corrected the ticks.
    steered: Option<u32>,
    states: [State; TASKS],
    /// The remaining execution time of the interrupt handlers, ns.
    handlers_ns: u64,
    running: Option<Core0Task>,
    last: Instant,
}

/// Creates core 0 of this board, whose jobs take `time`.
#[must_use]
pub fn core_0(board: &'static SimBoard, config: Config, time: Time) -> Poller {
    let mut core = TimedCore0::new(board, config, time);
    Box::new(move |_| core.poll())
}

impl TimedCore0 {
    fn new(board: &'static SimBoard, config: Config, time: Time) -> Self {
        let Parts {
            shared,
            drive,
            mut tasks,
        } = Parts::new(board, config);
        let now = board.now();
        let ticks = KernelTicks::new(now);
        tasks.monitoring.start(now);
        tasks.control.start(now);
        tasks.status.start(now);
        let mut shared = shared;
        shared.set_ticks(ticks.grid);
        Self {
            time,
            flow: Flow {
                board,
                shared: RefCell::new(shared),
                drive: RefCell::new(drive),
                released: Cell::new(TaskSet::NONE),
                doorbell: DoorbellThrottle::default(),
                has_begun: Cell::new(false),
            },
            tasks,
            ticks,
            steered: None,
            states: [State {
                due: 0,
                ticks: ticks.grid,
                ready: false,
                left_ns: None,
            }; TASKS],
            handlers_ns: 0,
            running: None,
            last: now,
        }
    }

    fn poll(&mut self) -> Instant {
        let now = self.flow.board.now();
        self.spend(now);
        self.interrupts(now);
        for state in &mut self.states {
            state.ready |= state.left_ns.is_none() && state.due <= self.ticks.grid.number.into();
        }
        self.dispatch(now);
        self.next(now)
    }

    /// Subtracts the time since the last call from the handlers, then from the running job.
    fn spend(&mut self, now: Instant) {
        let passed_ns = now.since(core::mem::replace(&mut self.last, now)).as_ns();
        let handled_ns = passed_ns.min(self.handlers_ns);
        self.handlers_ns -= handled_ns;
        let Some(task) = self.running else { return };
        let state = &mut self.states[task as usize];
        let left_ns = state.left_ns.unwrap_or(0);
        let left_ns = left_ns.saturating_sub(passed_ns - handled_ns);
        state.left_ns = Some(left_ns);
        if left_ns == 0 {
            self.end(task);
        }
    }

    fn end(&mut self, task: Core0Task) {
        self.states[task as usize].left_ns = None;
        self.running = None;
        self.flow.board.let_go(task as u8);
        trace_out(self.flow.board, task.info().code, Leaves::Done);
    }

    /// Processes the tick and the doorbell.
    fn interrupts(&mut self, now: Instant) {
        let (board, time) = (self.flow.board, self.time);
        let draw = |limit| board.draw_below(limit);
        if self.ticks.advance(now) {
            self.handlers_ns += time.of(TICK, draw);
        }
        let doorbell = &self.flow.doorbell;
        let passes = if board.is_interrupted() {
            self.handlers_ns += time.of(DOORBELL, draw);
            doorbell.ring(now) == RingOutcome::Passes
        } else {
            doorbell.pass_if_due(now)
        };
        if passes {
            for task in Core0Task::ALL {
                self.states[task as usize].ready |= task.info().is_for_interrupts();
            }
        }
    }

    /// Runs the most urgent task that is ready or has a job.
    fn dispatch(&mut self, now: Instant) {
        if self.handlers_ns > 0 {
            return;
        }
        loop {
            let wants = |task: &Core0Task| {
                let state = self.states[*task as usize];
                state.ready || state.left_ns.is_some()
            };
            let Some(task) = Core0Task::ALL.into_iter().find(wants) else {
                return;
            };
            if self.running == Some(task) {
                return;
            }
            if let Some(before) = self.running.take() {
                trace_out(self.flow.board, before.info().code, Leaves::Preempted);
            }
            if self.states[task as usize].left_ns.is_some() {
                trace_in(self.flow.board, task.info().code, Begin::Goes);
                self.running = Some(task);
                return;
            }
            self.begin(task, now);
        }
    }

    fn begin(&mut self, task: Core0Task, now: Instant) {
        let (board, flow, tasks) = (self.flow.board, &self.flow, &mut self.tasks);
        let ticks = self.ticks.grid;
        let moved_ns = self.states[task as usize].ticks.moved_ns(&ticks);
        if moved_ns != 0 {
            tasks.shift(task, flow, moved_ns);
        }
        flow.released.set(TaskSet::NONE);
        flow.has_begun.set(false);
        board.hold(Some(task as u8));
        let deadline = tasks.poll(task, flow);
        board.hold(None);
        let released = flow.released.get();
        for (index, state) in self.states.iter_mut().enumerate() {
            state.ready |= released.contains(Core0Task::ALL[index]);
        }
        self.states[task as usize] = State {
            due: u64::from(ticks.number) + task.wakes(&ticks, deadline),
            ticks,
            ready: false,
            left_ns: None,
        };
        if task == Core0Task::Roles && self.steered.replace(ticks.number) != Some(ticks.number) {
            let by_ns = flow.shared.borrow_mut().tick_correction(ticks);
            self.ticks.shift(now, by_ns);
        }
        if self.flow.has_begun.get() {
            let draw = |limit| board.draw_below(limit);
            let left_ns = self.time.execution(task.info().code, draw);
            self.states[task as usize].left_ns = Some(left_ns);
            self.running = Some(task);
        } else {
            board.let_go(task as u8);
        }
    }

    /// Returns the time of the next event.
    fn next(&self, now: Instant) -> Instant {
        let mut next = self.ticks.next.min(self.flow.doorbell.due().max(now));
        let left_ns = self
            .running
            .and_then(|task| self.states[task as usize].left_ns);
        let busy_ns = self.handlers_ns + left_ns.unwrap_or(0);
        if busy_ns > 0 || self.running.is_some() {
            let ends = if self.handlers_ns > 0 {
                self.handlers_ns
            } else {
                busy_ns
            };
            next = next.min(now + Duration::from_ns(ends));
        }
        next
    }
}

/// Creates core 1 of this board, whose cycles take `time`.
#[must_use]
pub fn core_1(board: &'static SimBoard, time: Time) -> Poller {
    let mut core = Core1::new(board);
    let mut job = Job::new(board, time, TaskCode::PERCEPTION);
    Box::new(move |_| match job.ends(|| core.begin()) {
        Some(ends) => ends,
        None => core.poll(),
    })
}

/// Creates core 2 of this board, whose cycles take `time`. A signal of core 1 releases each cycle.
#[must_use]
pub fn core_2(board: &'static SimBoard, time: Time) -> Poller {
    let mut core = Core2::new(board);
    let mut job = Job::new(board, time, TaskCode::PLANNING);
    Box::new(move |_| {
        let was_busy = job.ends.is_some();
        let ends = job.ends(|| board.is_interrupted());
        match (was_busy, ends) {
            // The body traces the same job again when it runs.
            (false, Some(_)) => trace_in(board, TaskCode::PLANNING, Begin::Goes),
            (true, None) => trace_out(board, TaskCode::PLANNING, Leaves::Blocked),
            _ => {}
        }
        ends.unwrap_or_else(|| core.poll())
    })
}

/// A job of a core without a kernel. It is not interrupted.
struct Job {
    board: &'static SimBoard,
    time: Time,
    task: TaskCode,
    ends: Option<Instant>,
}

impl Job {
    fn new(board: &'static SimBoard, time: Time, task: TaskCode) -> Self {
        let ends = None;
        Self {
            board,
            time,
            task,
            ends,
        }
    }

    /// Returns the time at which the job's execution ends; `None` if it has ended or there is none.
    /// `begins` returns whether a job begins now.
    fn ends(&mut self, begins: impl FnOnce() -> bool) -> Option<Instant> {
        let now = self.board.now();
        let ends = self.ends.or_else(|| {
            let draw = |limit| self.board.draw_below(limit);
            begins().then(|| now + Duration::from_ns(self.time.execution(self.task, draw)))
        });
        self.ends = ends.filter(|ends| *ends > now);
        self.ends
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tandem_board::{CoreId, SystemId};
    use tandem_board_sim::{Config as BoardConfig, SimPair};

    /// The rules of the kernel's port: `TaskContext::shift_ticks` in `tandem-rtos`.
    #[test]
    fn ticks_move_once_and_not_when_they_are_near() {
        let at = |us| Instant::ORIGIN + Duration::from_us(us);
        let mut ticks = KernelTicks::new(at(5_000));
        assert!(!ticks.advance(at(5_999)));
        ticks.shift(at(5_851), -100_000);
        assert_eq!(ticks.next, at(6_000), "it would be less than 50 µs away");
        ticks.shift(at(5_851), -99_000);
        ticks.shift(at(5_851), 1_000);
        assert_eq!(ticks.next, at(5_901), "moved once");
        assert!(ticks.advance(at(7_950)));
        assert_eq!((ticks.grid.number, ticks.grid.origin), (3, at(7_901)));
        ticks.shift(at(7_950), i32::MAX);
        assert_eq!(ticks.next, at(9_001));
    }

    /// S-5: a core whose every tick is later than its clock wants runs each periodic task in its
    /// ticks: each release is in time, and none is missed.
    #[test]
    fn releases_follow_ticks_that_move() {
        let config = BoardConfig {
            trace_records: 1 << 16,
            ..BoardConfig::default()
        };
        let mut pair = SimPair::new(config, |board| {
            if board.identity().core != CoreId::CONTROL {
                return Box::new(|_| Instant::NEVER);
            }
            let board: &'static SimBoard = Box::leak(Box::new(board.clone()));
            let mut core = TimedCore0::new(board, Config::rt(), Time::Typical);
            Box::new(move |_| {
                let later_ns = 20_000 + board.draw_below(80_000) as i32;
                core.ticks.shift(board.now(), later_ns);
                core.poll()
            })
        });
        pair.power_on(SystemId::A);
        pair.run_for(Duration::from_ms(1_000));
        let (traced, lost) = pair.take_trace();
        assert_eq!(lost, 0);
        let mut releases = [0; TASKS];
        for record in traced {
            if let Some(Event::TaskIn {
                task,
                begin: Begin::Released { late_ns, missed },
            }) = Event::decode(record.record)
                && let Some(task) = Core0Task::of(task).filter(|task| task.info().is_periodic())
            {
                assert_eq!(missed, 0, "{task:?} at {:?}", record.at);
                assert!(late_ns < 100_000, "{task:?} {late_ns} ns late");
                releases[task as usize] += 1;
            }
        }
        let of = |task: Core0Task| releases[task as usize];
        // A tick is 1.06 ms long on average, so 5 of them are 5.3 ms.
        let monitoring = of(Core0Task::Monitoring);
        assert!((185..193).contains(&monitoring), "{releases:?}");
        assert!((92..97).contains(&of(Core0Task::Control)), "{releases:?}");
    }
}
