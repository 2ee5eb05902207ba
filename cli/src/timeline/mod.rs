//! The timeline of a run, from its trace records: which task ran when on which core.
//!
//! The records of each core are processed in their own order. A slice is the time from when a task
//! or handler gets the CPU until it leaves the CPU. Slices of a core nest and never cross, even if
//! records are missing: a slice without a recorded end ends when its core ends.

mod jobs;
mod perfetto;
mod schema;
#[cfg(test)]
pub(crate) mod tests;

use std::collections::HashMap;

use tandem_board::{CoreId, SupplyEvent, SystemId};
use tandem_cores::task_table::{self, IrqCode, TaskCode};
use tandem_cores::trace::{Begin, Event, Leaves};
use tandem_record::RunLog;

use jobs::Jobs;
pub(crate) use jobs::{InterruptMetrics, TaskMetrics, WakeMetrics};
pub(crate) use perfetto::encode;

/// The work that occupies a core.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(crate) enum Work {
    /// A task.
    Task(TaskCode),
    /// The handler of an interrupt.
    Irq(IrqCode),
}

impl Work {
    /// Returns the name of the work on this core.
    pub(crate) fn name(self, core: CoreId) -> String {
        match self {
            Self::Task(code) => task_name(core, code),
            Self::Irq(code) => irq_name(code),
        }
    }
}

/// Returns the name of a task of this core.
pub(crate) fn task_name(core: CoreId, code: TaskCode) -> String {
    match task_table::task(core, code) {
        Some(info) => info.name.to_owned(),
        None => format!("task {}", code.0),
    }
}

/// Returns the name of an interrupt.
pub(crate) fn irq_name(code: IrqCode) -> String {
    let named = code.name().map(|name| format!("interrupt: {name}"));
    named.unwrap_or_else(|| format!("interrupt {}", code.0))
}

/// A span of time in which a core ran a task or a handler.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Slice {
    /// The task or handler.
    pub(crate) work: Work,
    /// Begin, ns on the run's clock.
    pub(crate) begin_ns: u64,
    /// End, ns; never before `begin_ns`.
    pub(crate) end_ns: u64,
    /// Number of enclosing slices.
    pub(crate) depth: usize,
    /// Number of the job that the slice belongs to; `None` for a handler. A job has one slice for
    /// each time in which its task had the CPU.
    pub(crate) job: Option<u64>,
    /// Delay after the release, ns, if the slice began a job with a known release.
    pub(crate) late_ns: Option<u32>,
    /// Number of releases without a job just before this slice.
    pub(crate) missed: u32,
    /// Whether the end was not recorded: the core died, the run ended, or records were lost.
    pub(crate) cut: bool,
}

/// An event at one moment on a core.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Mark {
    /// Time, ns.
    pub(crate) at_ns: u64,
    /// The event.
    pub(crate) event: Event,
    /// Number of the arrow that begins ([`Event::Wake`]) or ends ([`Event::Woken`]) at this mark;
    /// 0 if there is none.
    pub(crate) flow: u64,
}

/// One step in the order of events on a core. The number is an index of `slices` or `marks`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Step {
    /// A slice begins.
    Begin(usize),
    /// A slice ends.
    End(usize),
    /// A mark.
    Mark(usize),
}

/// The timeline of one core over the run.
#[derive(Clone, Debug)]
pub(crate) struct CoreLine {
    /// Its system.
    pub(crate) system: SystemId,
    /// The core.
    pub(crate) core: CoreId,
    /// The slices of the core, in order of their start times.
    pub(crate) slices: Vec<Slice>,
    /// The marks of the core, in order of time.
    pub(crate) marks: Vec<Mark>,
    /// The starts and ends of slices, and the marks, in one list with ascending times.
    pub(crate) steps: Vec<Step>,
}

impl CoreLine {
    /// Returns the time of a step, ns.
    pub(crate) fn at_ns(&self, step: Step) -> u64 {
        match step {
            Step::Begin(slice) => self.slices[slice].begin_ns,
            Step::End(slice) => self.slices[slice].end_ns,
            Step::Mark(mark) => self.marks[mark].at_ns,
        }
    }
}

/// A signal from core to core that was both sent and received.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Flow {
    /// The system.
    pub(crate) system: SystemId,
    /// Sending core and time, ns.
    pub(crate) from: (CoreId, u64),
    /// Receiving core and time, ns; never before `from`.
    pub(crate) to: (CoreId, u64),
}

/// The timeline of all cores and supplies over the run.
#[derive(Clone, Debug, Default)]
pub(crate) struct Timeline {
    /// The six cores: A0, A1, A2, B0, B1, B2.
    pub(crate) cores: Vec<CoreLine>,
    /// The events of the supplies, by time, ns.
    pub(crate) supplies: Vec<(u64, SystemId, SupplyEvent)>,
    /// Signals from core to core. [`Mark::flow`] is an index of this list plus 1.
    pub(crate) flows: Vec<Flow>,
    /// Figures of each task of each core.
    pub(crate) tasks: Vec<TaskMetrics>,
}

impl Timeline {
    /// Builds the timeline from the records of a run.
    pub(crate) fn new(log: &RunLog) -> Self {
        let supplies = log.supplies.clone();
        let mut by_core: Vec<Vec<(u64, Event)>> = vec![Vec::new(); 2 * CoreId::COUNT];
        for traced in &log.trace {
            let records = &mut by_core[place(traced.system, traced.core)];
            // Force ascending times on each core, because its records are not trusted.
            let last_ns = records.last().map_or(0, |(last_ns, _)| *last_ns);
            let event = Event::decode(traced.record);
            records.extend(event.map(|event| (traced.at.as_ns().max(last_ns), event)));
        }
        let mut wakes = Wakes::new(&by_core);
        let mut flows = Vec::new();
        let mut tasks = Vec::new();
        let mut cores = Vec::new();
        for system in SystemId::ALL {
            for core in CoreId::ALL {
                let ends = ends_of(&supplies, system, core);
                let mut line = LineBuilder::new(system, core, ends);
                for (at_ns, event) in &by_core[place(system, core)] {
                    line.take(*at_ns, *event, &mut wakes, &mut flows);
                }
                let (line, jobs) = line.finish();
                tasks.extend(jobs.metrics(system, core));
                cores.push(line);
            }
        }
        let mut timeline = Self {
            cores,
            supplies,
            flows,
            tasks,
        };
        timeline.mark_wakes(&wakes);
        timeline
    }

    /// Returns the figures of the interrupt handlers.
    pub(crate) fn interrupts(&self) -> Vec<InterruptMetrics> {
        self.cores.iter().flat_map(jobs::interrupts).collect()
    }

    /// Returns the figures of the signals from core to core.
    pub(crate) fn wakes(&self) -> Vec<WakeMetrics> {
        jobs::wakes(&self.flows)
    }

    /// Stores the number of the arrow in the mark of each received signal.
    fn mark_wakes(&mut self, wakes: &Wakes) {
        for line in &mut self.cores {
            for mark in &mut line.marks {
                if let Event::Wake { core, flow, .. } = mark.event {
                    let key = (line.system, line.core, core, flow);
                    mark.flow = wakes.flow_of(key, mark.at_ns);
                }
            }
        }
    }
}

const fn place(system: SystemId, core: CoreId) -> usize {
    system.index() * CoreId::COUNT + core.index()
}

/// Returns the times at which a core's incarnations ended, as its supply recorded them, ns.
fn ends_of(supplies: &[(u64, SystemId, SupplyEvent)], of: SystemId, core: CoreId) -> Vec<u64> {
    let ends = |event: &SupplyEvent| match event {
        SupplyEvent::CoreDied { core: died, .. } => *died == core,
        SupplyEvent::Reset(_) => true,
        SupplyEvent::CoreStarted { .. } | SupplyEvent::Suspended => false,
    };
    supplies
        .iter()
        .filter(|(_, system, event)| *system == of && ends(event))
        .map(|(at_ns, ..)| *at_ns)
        .collect()
}

/// Identifies a signal: system, sending core, receiving core, and number of the signal.
type SignalKey = (SystemId, CoreId, CoreId, u32);

/// All sent signals, each with its sending time and the number of its arrow (0: not received).
struct Wakes {
    sent: HashMap<SignalKey, Vec<(u64, u64)>>,
}

impl Wakes {
    fn new(by_core: &[Vec<(u64, Event)>]) -> Self {
        let mut sent: HashMap<SignalKey, Vec<(u64, u64)>> = HashMap::new();
        for system in SystemId::ALL {
            for from in CoreId::ALL {
                for (at_ns, event) in &by_core[place(system, from)] {
                    if let Event::Wake { core, flow, .. } = event {
                        let key = (system, from, *core, *flow);
                        sent.entry(key).or_default().push((*at_ns, 0));
                    }
                }
            }
        }
        Self { sent }
    }

    /// Finds the last signal with this key that was sent by `at_ns`. If it has no arrow yet,
    /// assigns this arrow to it and returns the time at which the signal was sent.
    fn arrive(&mut self, key: SignalKey, at_ns: u64, arrow: u64) -> Option<u64> {
        let sent = self.sent.get_mut(&key)?;
        // Numbers restart in each incarnation, so several signals may have the same number.
        let before = sent.partition_point(|(sent_ns, _)| *sent_ns <= at_ns);
        let (sent_ns, given) = sent.get_mut(before.checked_sub(1)?)?;
        (*given == 0).then(|| {
            *given = arrow;
            *sent_ns
        })
    }

    fn flow_of(&self, key: SignalKey, at_ns: u64) -> u64 {
        let sent = self.sent.get(&key);
        let found = sent.and_then(|sent| sent.iter().find(|(sent_ns, _)| *sent_ns == at_ns));
        found.map_or(0, |(_, arrow)| *arrow)
    }
}

/// Builds the timeline of one core.
struct LineBuilder {
    line: CoreLine,
    /// Ends of the current and later incarnations, by time.
    ends: std::iter::Peekable<std::vec::IntoIter<u64>>,
    /// Open slices, the innermost last, each with the total time of its inner slices, ns.
    open: Vec<(usize, u64)>,
    last_ns: u64,
    jobs: Jobs,
}

impl LineBuilder {
    fn new(system: SystemId, core: CoreId, ends: Vec<u64>) -> Self {
        Self {
            line: CoreLine {
                system,
                core,
                slices: Vec::new(),
                marks: Vec::new(),
                steps: Vec::new(),
            },
            ends: ends.into_iter().peekable(),
            open: Vec::new(),
            last_ns: 0,
            jobs: Jobs::default(),
        }
    }

    fn take(&mut self, at_ns: u64, event: Event, wakes: &mut Wakes, flows: &mut Vec<Flow>) {
        match event {
            Event::Started { .. } => {
                self.cut(at_ns);
                self.mark(at_ns, event, 0);
            }
            Event::TaskIn { task, begin } => self.task_in(at_ns, task, begin),
            Event::TaskOut { task, leaves } => self.task_out(at_ns, task, leaves),
            Event::IrqIn { irq } => {
                self.begin(at_ns, Work::Irq(irq));
            }
            Event::IrqOut { irq } => {
                self.end(at_ns, Work::Irq(irq));
            }
            Event::Ready { task } => {
                self.jobs.ready(task, at_ns);
                self.mark(at_ns, event, 0);
            }
            Event::Woken { core, flow } => {
                let key = (self.line.system, core, self.line.core, flow);
                let arrow = flows.len() as u64 + 1;
                let sent_ns = wakes.arrive(key, at_ns, arrow);
                if let Some(sent_ns) = sent_ns {
                    flows.push(Flow {
                        system: self.line.system,
                        from: (core, sent_ns),
                        to: (self.line.core, at_ns),
                    });
                    if let Some(task) = self.running() {
                        self.jobs.released(task, sent_ns);
                    }
                }
                self.mark(at_ns, event, sent_ns.map_or(0, |_| arrow));
            }
            Event::Stack { task, free_bytes } => self.jobs.stack(task, free_bytes),
            Event::Held { task, longest_ns } => self.jobs.held(task, longest_ns),
            // Perfetto shows these events as counters or as instants.
            _ => self.mark(at_ns, event, 0),
        }
        self.last_ns = at_ns;
    }

    fn task_in(&mut self, at_ns: u64, task: TaskCode, begin: Begin) {
        // If the task's slice is still open, the record of its end was lost.
        self.end(at_ns, Work::Task(task));
        let job = self.jobs.begin(task, at_ns, begin);
        let slice = self.begin(at_ns, Work::Task(task));
        slice.job = Some(job);
        if let Begin::Released { late_ns, missed } = begin {
            (slice.late_ns, slice.missed) = (Some(late_ns), missed);
        }
    }

    fn task_out(&mut self, at_ns: u64, task: TaskCode, leaves: Leaves) {
        if let Some(own_ns) = self.end(at_ns, Work::Task(task)) {
            self.jobs.ran(task, own_ns);
            match leaves {
                Leaves::Done => self.jobs.done(task, at_ns),
                Leaves::Gives => self.jobs.gave(task, at_ns),
                Leaves::Preempted => self.jobs.preempted(task),
                Leaves::Blocked => {}
            }
        }
    }

    fn running(&self) -> Option<TaskCode> {
        let tasks = self.open.iter().rev().map(|(slice, _)| *slice);
        tasks
            .map(|slice| self.line.slices[slice].work)
            .find_map(|work| match work {
                Work::Task(task) => Some(task),
                Work::Irq(_) => None,
            })
    }

    fn begin(&mut self, at_ns: u64, work: Work) -> &mut Slice {
        let slice = self.line.slices.len();
        self.line.slices.push(Slice {
            work,
            begin_ns: at_ns,
            end_ns: at_ns,
            depth: self.open.len(),
            job: None,
            late_ns: None,
            missed: 0,
            cut: false,
        });
        self.line.steps.push(Step::Begin(slice));
        self.open.push((slice, 0));
        &mut self.line.slices[slice]
    }

    /// Ends the innermost slice of this work, and the slices within it, whose ends were lost.
    /// Returns its duration without inner slices, ns; `None` if no slice of this work is open.
    fn end(&mut self, at_ns: u64, work: Work) -> Option<u64> {
        let is_it = |(slice, _): &(usize, u64)| self.line.slices[*slice].work == work;
        let from = self.open.iter().rposition(is_it)?;
        while self.open.len() > from + 1 {
            self.end_innermost(at_ns, true);
        }
        self.end_innermost(at_ns, false)
    }

    fn end_innermost(&mut self, at_ns: u64, cut: bool) -> Option<u64> {
        let (place, within_ns) = self.open.pop()?;
        let slice = &mut self.line.slices[place];
        slice.end_ns = at_ns;
        slice.cut = cut;
        let whole_ns = at_ns - slice.begin_ns;
        self.line.steps.push(Step::End(place));
        if let Some((_, around_ns)) = self.open.last_mut() {
            *around_ns += whole_ns;
        }
        Some(whole_ns - within_ns)
    }

    fn mark(&mut self, at_ns: u64, event: Event, flow: u64) {
        self.line.steps.push(Step::Mark(self.line.marks.len()));
        self.line.marks.push(Mark { at_ns, event, flow });
    }

    /// Ends all slices, because the core's incarnation ended before `until_ns`. The slices end
    /// at the supply's record of that end, or else at the core's last record.
    fn cut(&mut self, until_ns: u64) {
        let last_ns = self.last_ns;
        while self.ends.next_if(|end_ns| *end_ns < last_ns).is_some() {}
        let end_ns = self.ends.next_if(|end_ns| *end_ns <= until_ns);
        let end_ns = end_ns.unwrap_or(last_ns);
        while !self.open.is_empty() {
            self.end_innermost(end_ns, true);
        }
        self.jobs.cut();
    }

    fn finish(mut self) -> (CoreLine, Jobs) {
        self.cut(u64::MAX);
        (self.line, self.jobs)
    }
}
