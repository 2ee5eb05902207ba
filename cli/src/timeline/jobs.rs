//! Figures of each task: number of jobs, execution times, and missed deadlines.

use std::collections::BTreeMap;

use serde::Serialize;
use tandem_board::{CoreId, Duration, SystemId};
use tandem_cores::task_table::{self, IrqCode, TaskCode};
use tandem_cores::trace::Begin;

use super::{CoreLine, Flow, Work, task_name};
use tandem_processes::percentiles::Spans;

/// Figures of one task over the run, as `metrics.json` has them.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(crate) struct TaskMetrics {
    /// The system: `A` or `B`.
    pub(crate) system: String,
    /// The core: 0, 1 or 2.
    pub(crate) core: u8,
    /// Name of the task.
    pub(crate) task: String,
    /// Time between two releases, ms; `None` if events release it.
    pub(crate) period_ms: Option<f64>,
    /// Time from release to deadline, ms; `None` without a deadline.
    pub(crate) deadline_ms: Option<f64>,
    /// Number of jobs that have begun.
    pub(crate) jobs: u64,
    /// Releases without a job, because the task was late by one or more whole periods.
    pub(crate) missed_releases: u64,
    /// Jobs that ended after their deadline, plus missed releases of tasks with a deadline.
    pub(crate) deadline_misses: u64,
    /// Jobs whose end was not recorded: the core died, the run ended, or records were lost.
    pub(crate) cut: u64,
    /// Number of preemptions by more urgent tasks within jobs.
    pub(crate) preemptions: u64,
    /// Number of jobs with a known release. Each of them has a response time.
    pub(crate) responses: u64,
    /// Median time from the release of a job to its end, ms.
    pub(crate) response_p50_ms: Option<f64>,
    /// 99th percentile of the same time, ms.
    pub(crate) response_p99_ms: Option<f64>,
    /// Maximum of the same time, ms.
    pub(crate) response_max_ms: Option<f64>,
    /// Median time on the CPU, without the time of tasks and handlers that preempted it, ms. On
    /// the host it includes time that the machine's own scheduler took away.
    pub(crate) execution_p50_ms: Option<f64>,
    /// 99th percentile of the same time, ms.
    pub(crate) execution_p99_ms: Option<f64>,
    /// Maximum of the same time, ms.
    pub(crate) execution_max_ms: Option<f64>,
    /// Bytes of the task's stack that were never used; `None` where not measured.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) stack_free_bytes: Option<u32>,
    /// Longest time for which the task held a lock that other tasks may wait for, including
    /// interruptions, ms; `None` where not measured.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) lock_held_max_ms: Option<f64>,
}

/// Figures of the signals between two cores, as `metrics.json` has them.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(crate) struct WakeMetrics {
    /// The system: `A` or `B`.
    pub(crate) system: String,
    /// The sending core.
    pub(crate) from: u8,
    /// The receiving core.
    pub(crate) to: u8,
    /// Number of signals that a task received.
    pub(crate) count: u64,
    /// Median time from just before the sending of the signal until the woken task runs, ms.
    pub(crate) latency_p50_ms: Option<f64>,
    /// 99th percentile of the same time, ms.
    pub(crate) latency_p99_ms: Option<f64>,
    /// Maximum of the same time, ms.
    pub(crate) latency_max_ms: Option<f64>,
}

/// Figures of the handler of one interrupt, as `metrics.json` has them.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(crate) struct InterruptMetrics {
    /// The system: `A` or `B`.
    pub(crate) system: String,
    /// The core: 0, 1 or 2.
    pub(crate) core: u8,
    /// Name of the interrupt.
    pub(crate) interrupt: String,
    /// Number of runs of the handler.
    pub(crate) count: u64,
    /// Median time in the handler, ms.
    pub(crate) execution_p50_ms: Option<f64>,
    /// 99th percentile of the same time, ms.
    pub(crate) execution_p99_ms: Option<f64>,
    /// Maximum of the same time, ms.
    pub(crate) execution_max_ms: Option<f64>,
}

/// Returns the figures of all interrupt handlers of a core.
pub(super) fn interrupts(line: &CoreLine) -> Vec<InterruptMetrics> {
    let mut by_code: BTreeMap<IrqCode, Vec<f64>> = BTreeMap::new();
    for slice in line.slices.iter().filter(|slice| !slice.cut) {
        if let Work::Irq(code) = slice.work {
            let span_ns = slice.end_ns - slice.begin_ns;
            by_code.entry(code).or_default().push(span_ns as f64 * 1e-6);
        }
    }
    let one = |(code, spans_ms): (IrqCode, Vec<f64>)| {
        let execution = Spans::from_ms(spans_ms);
        InterruptMetrics {
            system: line.system.to_string(),
            core: line.core.index() as u8,
            interrupt: code
                .name()
                .map_or_else(|| code.0.to_string(), str::to_owned),
            count: execution.count(),
            execution_p50_ms: execution.percentile_ms(50.0),
            execution_p99_ms: execution.percentile_ms(99.0),
            execution_max_ms: execution.max_ms(),
        }
    };
    by_code.into_iter().map(one).collect()
}

/// Returns the figures of all pairs of cores that signal each other.
pub(super) fn wakes(flows: &[Flow]) -> Vec<WakeMetrics> {
    let mut pairs: BTreeMap<[usize; 3], Vec<f64>> = BTreeMap::new();
    for flow in flows {
        let pair = [flow.system.index(), flow.from.0.index(), flow.to.0.index()];
        let latency_ns = flow.to.1.saturating_sub(flow.from.1);
        pairs
            .entry(pair)
            .or_default()
            .push(latency_ns as f64 * 1e-6);
    }
    let one = |([system, from, to], latencies_ms): ([usize; 3], Vec<f64>)| {
        let latency = Spans::from_ms(latencies_ms);
        WakeMetrics {
            system: ["A", "B"][system].to_owned(),
            from: from as u8,
            to: to as u8,
            count: latency.count(),
            latency_p50_ms: latency.percentile_ms(50.0),
            latency_p99_ms: latency.percentile_ms(99.0),
            latency_max_ms: latency.max_ms(),
        }
    };
    pairs.into_iter().map(one).collect()
}

/// The jobs of one task.
#[derive(Debug, Default)]
struct Task {
    /// The job that has begun or is released.
    job: Option<Job>,
    begun: u64,
    missed: u64,
    cut: u64,
    preemptions: u64,
    response_ms: Vec<f64>,
    execution_ms: Vec<f64>,
    stack_free_bytes: Option<u32>,
    held_ns: Option<u32>,
}

#[derive(Clone, Copy, Debug, Default)]
struct Job {
    release_ns: Option<u64>,
    own_ns: u64,
    begun: bool,
    /// Time at which the task left the CPU, if the kernel did not record the reason.
    gave_ns: Option<u64>,
}

/// The jobs of all tasks of one core.
#[derive(Debug, Default)]
pub(super) struct Jobs {
    tasks: BTreeMap<TaskCode, Task>,
}

impl Jobs {
    fn task(&mut self, code: TaskCode) -> &mut Task {
        self.tasks.entry(code).or_default()
    }

    /// Records the release of a job. Has no effect while an earlier job is unfinished.
    pub(super) fn ready(&mut self, code: TaskCode, at_ns: u64) {
        self.done_if_it_gave(code);
        let job = &mut self.task(code).job;
        job.get_or_insert(Job {
            release_ns: Some(at_ns),
            ..Job::default()
        });
    }

    /// Records that the task got the CPU. Returns the number of its job, counted from 1.
    pub(super) fn begin(&mut self, code: TaskCode, at_ns: u64, begin: Begin) -> u64 {
        let task = self.task(code);
        if let Begin::Released { late_ns, missed } = begin {
            task.missed += u64::from(missed);
            if task.job.is_some_and(|job| job.begun) {
                // The end of the earlier job is missing in the records.
                task.cut += 1;
            }
            task.job = Some(Job {
                release_ns: Some(at_ns.saturating_sub(late_ns.into())),
                ..Job::default()
            });
        }
        let job = task.job.get_or_insert_default();
        job.gave_ns = None;
        if !job.begun {
            job.begun = true;
            task.begun += 1;
        }
        task.begun
    }

    /// Records that a signal, sent at `sent_ns`, released the running job.
    pub(super) fn released(&mut self, code: TaskCode, sent_ns: u64) {
        if let Some(job) = &mut self.task(code).job
            && job.release_ns.is_none()
        {
            job.release_ns = Some(sent_ns);
        }
    }

    /// Adds CPU time to the running job.
    pub(super) fn ran(&mut self, code: TaskCode, own_ns: u64) {
        if let Some(job) = &mut self.task(code).job {
            job.own_ns += own_ns;
        }
    }

    /// Records that the task left the CPU, for a reason that the kernel did not record.
    pub(super) fn gave(&mut self, code: TaskCode, at_ns: u64) {
        if let Some(job) = &mut self.task(code).job {
            job.gave_ns = Some(at_ns);
        }
    }

    /// Ends the job of a task that left the CPU for an unrecorded reason. The job was finished,
    /// because the task became ready again or did not run again.
    fn done_if_it_gave(&mut self, code: TaskCode) {
        if let Some(gave_ns) = self.task(code).job.and_then(|job| job.gave_ns) {
            self.done(code, gave_ns);
        }
    }

    /// Records the end of a job.
    pub(super) fn done(&mut self, code: TaskCode, at_ns: u64) {
        let task = self.task(code);
        let Some(job) = task.job.take() else { return };
        task.execution_ms.push(job.own_ns as f64 * 1e-6);
        let response_ns = job
            .release_ns
            .map(|release_ns| at_ns.saturating_sub(release_ns));
        task.response_ms
            .extend(response_ns.map(|response_ns| response_ns as f64 * 1e-6));
    }

    /// Cuts all jobs, because the core's incarnation has ended.
    pub(super) fn cut(&mut self) {
        let codes: Vec<TaskCode> = self.tasks.keys().copied().collect();
        codes
            .into_iter()
            .for_each(|code| self.done_if_it_gave(code));
        for task in self.tasks.values_mut() {
            if task.job.take().is_some_and(|job| job.begun) {
                task.cut += 1;
            }
        }
    }

    /// Records the unused part of a task's stack.
    pub(super) fn stack(&mut self, code: TaskCode, free_bytes: u32) {
        let least = &mut self.task(code).stack_free_bytes;
        *least = Some(least.map_or(free_bytes, |least| least.min(free_bytes)));
    }

    /// Records a preemption.
    pub(super) fn preempted(&mut self, code: TaskCode) {
        self.task(code).preemptions += 1;
    }

    /// Records the longest time for which the task held a lock.
    pub(super) fn held(&mut self, code: TaskCode, longest_ns: u32) {
        let longest = &mut self.task(code).held_ns;
        *longest = Some(longest.map_or(longest_ns, |longest| longest.max(longest_ns)));
    }

    /// Returns the figures, in the order of the core's task table.
    pub(super) fn metrics(&self, system: SystemId, core: CoreId) -> Vec<TaskMetrics> {
        let rank = |code: TaskCode| {
            let known = task_table::tasks(core);
            known.iter().position(|info| info.code == code)
        };
        let mut tasks: Vec<(&TaskCode, &Task)> = self.tasks.iter().collect();
        tasks.sort_by_key(|(code, _)| (rank(**code).unwrap_or(usize::MAX), **code));
        let one = |(code, task): (&TaskCode, &Task)| task.metrics(system, core, *code);
        tasks.into_iter().map(one).collect()
    }
}

impl Task {
    fn metrics(&self, system: SystemId, core: CoreId, code: TaskCode) -> TaskMetrics {
        let info = task_table::task(core, code);
        let ms = |span: Option<Duration>| span.map(Duration::as_ms_f64);
        let deadline_ms = ms(info.and_then(|info| info.deadline));
        let late = deadline_ms.map_or(0, |deadline_ms| {
            let too_long = |response_ms: &&f64| **response_ms > deadline_ms;
            self.response_ms.iter().filter(too_long).count() as u64 + self.missed
        });
        let response = Spans::from_ms(self.response_ms.iter().copied());
        let execution = Spans::from_ms(self.execution_ms.iter().copied());
        TaskMetrics {
            system: system.to_string(),
            core: core.index() as u8,
            task: task_name(core, code),
            period_ms: ms(info
                .filter(|info| info.is_periodic())
                .map(|info| info.period)),
            deadline_ms,
            jobs: self.begun,
            missed_releases: self.missed,
            deadline_misses: late,
            cut: self.cut,
            preemptions: self.preemptions,
            responses: response.count(),
            response_p50_ms: response.percentile_ms(50.0),
            response_p99_ms: response.percentile_ms(99.0),
            response_max_ms: response.max_ms(),
            execution_p50_ms: execution.percentile_ms(50.0),
            execution_p99_ms: execution.percentile_ms(99.0),
            execution_max_ms: execution.max_ms(),
            stack_free_bytes: self.stack_free_bytes,
            lock_held_max_ms: self.held_ns.map(|ns| f64::from(ns) * 1e-6),
        }
    }
}
