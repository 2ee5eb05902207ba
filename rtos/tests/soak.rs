//! Random task sets against a model of their schedule. T-RTOS-1, T-RTOS-2
//!
//! The model does not use the kernel: it is fixed-priority pre-emptive scheduling with a ring for
//! each priority, driven by ticks, completions and yields. The same set runs on the real kernel in
//! virtual time, where each tick is a real signal that pre-empts the running task. Order and times
//! of all completions must be the same.
//!
//! `TANDEM_RTOS_SOAK_SECONDS` and `TANDEM_RTOS_SOAK_SEED` set the length and the first seed; `cargo
//! xtask campaign rtos-soak` sets them.
#![allow(clippy::expect_used, reason = "a test may")]

mod fixture;

use chacha20::ChaCha8Rng;
use fixture::setup::Fill as _;
use fixture::{Log, run};
use rand::{RngExt, SeedableRng};
use std::collections::VecDeque;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::{Duration, Instant};
use tandem_rtos::host::{elapsed_ns, raise};
use tandem_rtos::{Interrupt, Kernel, TaskContext, TaskHandle, TickSource, Ticks};

const TICK_NS: u64 = 1_000_000;
/// The length of a set's run, in ticks.
const SPAN: u32 = 400;
/// Priority of the task that raises interrupts: above those of all checked tasks.
const RAISER: u8 = 20;

/// When a task's jobs are released.
#[derive(Clone, Debug)]
enum Release {
    /// At `offset` and then every `period` ticks; at once if the last job took longer.
    Periodic { offset: u32, period: u32 },
    /// By an interrupt at each of these ticks.
    Sporadic { at: Vec<u32> },
}

/// A task. Each of its jobs works through all bursts and yields between them.
#[derive(Clone, Debug)]
struct Spec {
    priority: u8,
    release: Release,
    bursts_ns: Vec<u64>,
}

/// A completed job: its task, its number, and the time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Done {
    task: usize,
    job: u32,
    at_ns: u64,
}

fn random_set(seed: u64) -> Vec<Spec> {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let tasks = random.random_range(2..=7);
    // With few priorities, many tasks have equal priority.
    let priorities = random.random_range(1..=5);
    let load = random.random_range(0.3..1.3) / f64::from(tasks);
    (0..tasks)
        .map(|_| {
            let period: u32 = random.random_range(2..=25);
            let release = if random.random_bool(0.75) {
                let offset = random.random_range(0..=10);
                Release::Periodic { offset, period }
            } else {
                let mut at: Vec<u32> = (0..SPAN / period)
                    .map(|_| random.random_range(1..SPAN))
                    .collect();
                at.sort_unstable();
                Release::Sporadic { at }
            };
            let work_us = f64::from(period) * 1000.0 * load * random.random_range(0.5..1.5);
            let bursts = random.random_range(1..=3);
            // Every second set works in whole ticks, so that its completions coincide with ticks.
            let grain_us = if seed.is_multiple_of(2) { 1000.0 } else { 50.0 };
            let burst_us = (work_us / f64::from(bursts) / grain_us).round().max(1.0) * grain_us;
            Spec {
                priority: random.random_range(1..=priorities),
                release,
                bursts_ns: vec![burst_us as u64 * 1000; bursts as usize],
            }
        })
        .collect()
}

/// Fixed priorities, a ring for each; time advances by work.
mod model {
    use super::{Done, Release, SPAN, Spec, TICK_NS, VecDeque};

    /// The ready tasks of one priority, in the order in which they will be served. The task that
    /// was served last stays at the back while it is ready; a new task is inserted before it.
    #[derive(Clone, Default)]
    struct Ring {
        order: VecDeque<usize>,
        back_was_served: bool,
    }

    impl Ring {
        fn arrive(&mut self, task: usize) {
            let place = self.order.len() - usize::from(self.back_was_served);
            self.order.insert(place, task);
        }

        fn serve(&mut self) -> Option<usize> {
            let task = self.order.pop_front()?;
            self.order.push_back(task);
            self.back_was_served = true;
            Some(task)
        }

        /// Removes the task that was served last: it now waits.
        fn leave(&mut self) {
            self.order.pop_back();
            self.back_was_served = false;
        }
    }

    #[derive(Clone, Copy)]
    enum Waits {
        /// Ready or running.
        No,
        /// Until a tick. The second field, the time when the wait began, orders tasks that wake.
        ForTick(u32, u64),
        ForInterrupt,
    }

    #[derive(Clone, Copy)]
    struct State {
        waits: Waits,
        begun: bool,
        /// Remaining work of the current burst.
        left_ns: u64,
        burst: usize,
        job: u32,
        /// Tick of the last release.
        release: u32,
        /// Interrupts that the task has not served yet.
        asked: u32,
    }

    /// The next step of the running task.
    enum Next {
        Works,
        Yields,
        WaitsForTick(u32),
        WaitsForInterrupt,
    }

    pub(super) struct Model<'a> {
        specs: &'a [Spec],
        states: Vec<State>,
        rings: Vec<Ring>,
        now_ns: u64,
        waits: u64,
        done: Vec<Done>,
    }

    impl<'a> Model<'a> {
        pub(super) fn new(specs: &'a [Spec]) -> Self {
            let state = |spec: &Spec| State {
                waits: Waits::No,
                begun: false,
                left_ns: spec.bursts_ns[0],
                burst: 0,
                job: 0,
                release: 0,
                asked: 0,
            };
            let mut rings = vec![Ring::default(); 32];
            for (task, spec) in specs.iter().enumerate() {
                rings[usize::from(spec.priority)].arrive(task);
            }
            Self {
                specs,
                states: specs.iter().map(state).collect(),
                rings,
                now_ns: 0,
                waits: 0,
                done: vec![],
            }
        }

        /// Returns all completions before the end.
        pub(super) fn run(mut self) -> Vec<Done> {
            let mut running = self.pick();
            while self.now_ns < u64::from(SPAN) * TICK_NS {
                let next = running.map(|task| (task, self.next(task)));
                running = match next {
                    Some((task, Next::Works)) => self.work(task),
                    Some((_, Next::Yields)) => self.pick(),
                    Some((task, Next::WaitsForTick(tick))) => {
                        self.waits += 1;
                        self.wait(task, Waits::ForTick(tick, self.waits))
                    }
                    Some((task, Next::WaitsForInterrupt)) => self.wait(task, Waits::ForInterrupt),
                    None => {
                        self.now_ns += TICK_NS - self.now_ns % TICK_NS;
                        self.tick(None)
                    }
                };
            }
            self.done
                .retain(|done| done.at_ns < u64::from(SPAN) * TICK_NS);
            self.done
        }

        fn pick(&mut self) -> Option<usize> {
            self.rings.iter_mut().rev().find_map(Ring::serve)
        }

        fn arrive(&mut self, task: usize) {
            self.states[task].waits = Waits::No;
            self.rings[usize::from(self.specs[task].priority)].arrive(task);
        }

        fn wait(&mut self, task: usize, waits: Waits) -> Option<usize> {
            self.states[task].waits = waits;
            self.rings[usize::from(self.specs[task].priority)].leave();
            self.pick()
        }

        /// Works until the end of the burst or the next tick, whichever is earlier.
        fn work(&mut self, task: usize) -> Option<usize> {
            let to_tick = TICK_NS - self.now_ns % TICK_NS;
            let step = self.states[task].left_ns.min(to_tick);
            self.states[task].left_ns -= step;
            self.now_ns += step;
            if step == to_tick {
                self.tick(Some(task))
            } else {
                Some(task)
            }
        }

        /// Processes a tick; returns the task that then runs.
        fn tick(&mut self, running: Option<usize>) -> Option<usize> {
            let tick = (self.now_ns / TICK_NS) as u32;
            let mut woken: Vec<(u64, usize)> = vec![];
            for (task, state) in self.states.iter().enumerate() {
                if let Waits::ForTick(until, since) = state.waits
                    && until == tick
                {
                    woken.push((since, task));
                }
            }
            woken.sort_unstable();
            woken.iter().for_each(|(_, task)| self.arrive(*task));
            let raised = self.raise(tick);
            let Some(running) = running else {
                return self.pick();
            };
            let own = self.specs[running].priority;
            let urgent = woken
                .iter()
                .any(|(_, task)| self.specs[*task].priority > own);
            let equals = self.rings[usize::from(own)].order.len() > 1;
            // The task that raises the interrupts is more urgent than all others.
            if urgent || equals || raised {
                self.pick()
            } else {
                Some(running)
            }
        }

        /// Raises the interrupts of this tick; returns whether there were any.
        fn raise(&mut self, tick: u32) -> bool {
            let mut any = false;
            for (task, spec) in self.specs.iter().enumerate() {
                let Release::Sporadic { at } = &spec.release else {
                    continue;
                };
                for _ in at.iter().filter(|at| **at == tick) {
                    any = true;
                    if let Waits::ForInterrupt = self.states[task].waits {
                        self.arrive(task);
                    } else {
                        self.states[task].asked += 1;
                    }
                }
            }
            any
        }

        fn next(&mut self, task: usize) -> Next {
            let (spec, now_ns) = (&self.specs[task], self.now_ns);
            let tick = (now_ns / TICK_NS) as u32;
            let state = &mut self.states[task];
            if !state.begun {
                state.begun = true;
                match spec.release {
                    Release::Periodic { offset: 0, .. } => {}
                    Release::Periodic { offset, .. } => return Self::release(state, offset, tick),
                    Release::Sporadic { .. } => return Self::answer(state),
                }
            }
            if state.left_ns > 0 {
                return Next::Works;
            }
            state.burst = (state.burst + 1) % spec.bursts_ns.len();
            state.left_ns = spec.bursts_ns[state.burst];
            if state.burst > 0 {
                return Next::Yields;
            }
            let job = state.job;
            state.job += 1;
            let next = match spec.release {
                Release::Periodic { period, .. } => Self::release(state, period, tick),
                Release::Sporadic { .. } => Self::answer(state),
            };
            self.done.push(Done {
                task,
                job,
                at_ns: now_ns,
            });
            next
        }

        /// Releases the next job; if late, it starts at once, after ready tasks of equal priority.
        fn release(state: &mut State, after: u32, tick: u32) -> Next {
            state.release += after;
            if state.release > tick {
                Next::WaitsForTick(state.release)
            } else {
                Next::Yields
            }
        }

        fn answer(state: &mut State) -> Next {
            if state.asked == 0 {
                return Next::WaitsForInterrupt;
            }
            state.asked -= 1;
            Next::Works
        }
    }
}

fn job(ctx: &TaskContext, spec: &Spec) {
    for (number, burst) in spec.bursts_ns.iter().enumerate() {
        if number > 0 {
            ctx.yield_now();
        }
        ctx.burn(Duration::from_nanos(*burst));
    }
}

fn body(ctx: &TaskContext, task: usize, spec: &Spec, log: &Log<Done>, over: &AtomicBool) {
    let mut wake = Ticks(0);
    if let Release::Periodic { offset: 1.., .. } = spec.release {
        let Release::Periodic { offset, .. } = spec.release else {
            unreachable!()
        };
        ctx.delay_until(&mut wake, Ticks(offset));
    }
    for number in 0.. {
        if let Release::Sporadic { .. } = spec.release {
            ctx.take_notification(Ticks::FOREVER);
        }
        if over.load(Ordering::Relaxed) {
            return;
        }
        job(ctx, spec);
        log.note(Done {
            task,
            job: number,
            at_ns: elapsed_ns(),
        });
        if let Release::Periodic { period, .. } = spec.release {
            ctx.delay_until(&mut wake, Ticks(period));
        }
    }
}

/// Raises the interrupts of all sporadic tasks at their ticks.
fn spawn_raiser(kernel: &Kernel, set: &[Spec]) {
    let mut raises: Vec<(u32, usize)> = vec![];
    for (task, spec) in set.iter().enumerate() {
        if let Release::Sporadic { at } = &spec.release {
            raises.extend(at.iter().map(|tick| (*tick, task)));
        }
    }
    raises.sort_unstable();
    let raiser = move |ctx: &TaskContext| {
        for (tick, task) in &raises {
            if let Some(span @ 1..) = tick.checked_sub(ctx.now().0) {
                ctx.delay(Ticks(span));
            }
            raise(source(*task));
        }
    };
    kernel.task("raiser", RAISER, raiser);
}

const fn source(task: usize) -> Interrupt {
    Interrupt::new(8 + task as u8)
}

fn run_on_kernel(set: &[Spec]) -> Vec<Done> {
    let log = Log::new();
    let over: Arc<AtomicBool> = Arc::default();
    let ended: Arc<AtomicUsize> = Arc::default();
    run(TickSource::Virtual, |kernel| {
        let mut handles: Vec<TaskHandle> = vec![];
        for (number, spec) in set.iter().cloned().enumerate() {
            let (log, over, ended) = (log.clone(), Arc::clone(&over), Arc::clone(&ended));
            let checked = move |ctx: &TaskContext| {
                body(ctx, number, &spec, &log, &over);
                ended.fetch_add(1, Ordering::Relaxed);
            };
            let handle = kernel.task("checked", set[number].priority, checked);
            if let Release::Sporadic { .. } = set[number].release {
                let asked = handle.clone();
                let handler = move |ctx: &_| asked.notify(ctx).expect("it lives");
                kernel.on(source(number), handler);
            }
            handles.push(handle);
        }
        spawn_raiser(kernel, set);
        let supervisor = move |ctx: &TaskContext| {
            ctx.delay(Ticks(SPAN));
            over.store(true, Ordering::Relaxed);
            while ended.load(Ordering::Relaxed) < handles.len() {
                // A task whose interrupt will not occur again is also notified.
                for handle in &handles {
                    let _ = handle.notify(ctx);
                }
                ctx.delay(Ticks(1));
            }
            // The scheduler ends when all tasks have returned, so no state of this run remains.
        };
        kernel.task("supervisor", 30, supervisor);
    });
    let mut done = log.take();
    done.retain(|done| done.at_ns < u64::from(SPAN) * TICK_NS);
    done
}

fn number_of(variable: &str) -> Option<u64> {
    std::env::var(variable).ok()?.parse().ok()
}

/// T-RTOS-1, T-RTOS-2: the kernel completes the jobs of random task sets in the order and at the
/// times of the model of fixed-priority pre-emptive scheduling.
#[test]
fn random_task_sets_complete_as_the_model_says() {
    let span = Duration::from_secs(number_of("TANDEM_RTOS_SOAK_SECONDS").unwrap_or(5));
    let first = number_of("TANDEM_RTOS_SOAK_SEED").unwrap_or(1);
    let (begin, mut seed, mut jobs) = (Instant::now(), first, 0);
    while begin.elapsed() < span {
        let set = random_set(seed);
        let expected = model::Model::new(&set).run();
        let done = run_on_kernel(&set);
        if let Some(at) =
            (0..expected.len().max(done.len())).find(|at| expected.get(*at) != done.get(*at))
        {
            panic!(
                "seed {seed}: completion {at} is {:?}, and the model says {:?}; {set:#?}",
                done.get(at),
                expected.get(at)
            );
        }
        jobs += done.len();
        seed += 1;
    }
    println!(
        "{} task sets from seed {first} on, {jobs} jobs, as the model says",
        seed - first
    );
    assert!(jobs > 0, "nothing was compared");
}
