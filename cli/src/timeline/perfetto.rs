//! Encodes the timeline as a trace that <https://ui.perfetto.dev> opens.
//!
//! Each system and the vehicle is a process, and each core and supply a thread. All times are on
//! the run's clock. All packets form one sequence, whose first packet defines all names.

use std::collections::HashMap;

use tandem_board::{CoreId, SupplyEvent, SystemId};
use tandem_cores::trace::Event;

use super::schema::{
    Message, NEEDS_STATE, PACKET, STATE_CLEARED, event, event_type, names, packet, track,
};
use super::{CoreLine, Step, Timeline, irq_name, task_name};
use tandem_record::roles::RoleState;
use tandem_record::{RunLog, description, takeovers};
use tandem_vehicle::Ruling;

const SEQUENCE: u64 = 1;
const VEHICLE_PID: u64 = 3;

/// A trace.
pub(crate) struct Encoded {
    /// The file.
    pub(crate) bytes: Vec<u8>,
    /// Time of its first event, ns. <https://ui.perfetto.dev> shows times since then.
    pub(crate) begin_ns: u64,
}

/// Encodes the whole trace.
pub(crate) fn encode(timeline: &Timeline, log: &RunLog) -> Encoded {
    let mut trace = Trace::default();
    let markers = trace.track(None, "events");
    for system in SystemId::ALL {
        let process = trace.process(pid(system), &format!("system {system}"));
        for line in timeline.cores.iter().filter(|line| line.system == system) {
            trace.core(line);
        }
        trace.supply(timeline, system, markers);
        trace.roles(log, system, process);
        trace.control(timeline, system, process);
    }
    trace.vehicle(log, markers);
    let times = trace.events.iter().map(|(at_ns, _)| *at_ns);
    Encoded {
        begin_ns: times.min().unwrap_or_default(),
        bytes: trace.into_bytes(),
    }
}

const fn pid(system: SystemId) -> u64 {
    system.index() as u64 + 1
}

const fn core_name(core: CoreId) -> &'static str {
    match core {
        CoreId::CONTROL => "core 0: control",
        CoreId::PERCEPTION => "core 1: perception",
        _ => "core 2: planning",
    }
}

/// Assigns numbers to names, from 1.
#[derive(Debug, Default)]
struct Names {
    numbers: HashMap<String, u64>,
}

impl Names {
    fn number(&mut self, name: &str) -> u64 {
        if let Some(number) = self.numbers.get(name) {
            return *number;
        }
        let number = self.numbers.len() as u64 + 1;
        self.numbers.insert(name.to_owned(), number);
        number
    }

    /// Adds all names to the message's `field`, in order of their numbers.
    fn define(&self, message: &mut Message, field: u32) {
        let mut list: Vec<(&String, &u64)> = self.numbers.iter().collect();
        list.sort_by_key(|(_, number)| **number);
        for (name, number) in list {
            let mut entry = Message::default();
            entry.number(names::NUMBER, *number).text(names::NAME, name);
            message.message(field, &entry);
        }
    }
}

#[derive(Debug, Default)]
struct Trace {
    tracks: Vec<Message>,
    /// Time, ns, and event; the events of each track are in order of time.
    events: Vec<(u64, Message)>,
    names: Names,
    categories: Names,
    figures: Names,
}

impl Trace {
    /// Adds a row; returns its number and its descriptor.
    fn add_track(&mut self) -> (u64, &mut Message) {
        let place = self.tracks.len();
        let uuid = place as u64 + 1;
        let mut descriptor = Message::default();
        descriptor.number(track::UUID, uuid);
        self.tracks.push(descriptor);
        (uuid, &mut self.tracks[place])
    }

    fn process(&mut self, pid: u64, name: &str) -> u64 {
        let mut process = Message::default();
        process
            .number(track::process::PID, pid)
            .text(track::process::NAME, name);
        let (uuid, descriptor) = self.add_track();
        descriptor.message(track::PROCESS, &process);
        uuid
    }

    fn thread(&mut self, pid: u64, number: u64, name: &str) -> u64 {
        let mut thread = Message::default();
        // The thread's id is unique over all processes, and different from every process id.
        thread
            .number(track::thread::PID, pid)
            .number(track::thread::TID, 100 * pid + number);
        thread.text(track::thread::NAME, name);
        let (uuid, descriptor) = self.add_track();
        descriptor.message(track::THREAD, &thread);
        uuid
    }

    fn track(&mut self, parent: Option<u64>, name: &str) -> u64 {
        let (uuid, descriptor) = self.add_track();
        descriptor.text(track::NAME, name);
        if let Some(parent) = parent {
            descriptor.number(track::PARENT_UUID, parent);
        }
        uuid
    }

    fn counter(&mut self, parent: u64, name: &str, unit: &str) -> u64 {
        let mut counter = Message::default();
        counter.text(track::UNIT_NAME, unit);
        let (uuid, descriptor) = self.add_track();
        descriptor
            .number(track::PARENT_UUID, parent)
            .text(track::NAME, name);
        descriptor.message(track::COUNTER, &counter);
        uuid
    }

    /// Adds an event of this kind, see [`event_type`]. An empty name means no name.
    fn event(&mut self, track: u64, at_ns: u64, kind: u64, name: &str) -> &mut Message {
        let place = self.events.len();
        let mut message = Message::default();
        message
            .number(event::TYPE, kind)
            .number(event::TRACK, track);
        if !name.is_empty() {
            message.number(event::NAME, self.names.number(name));
        }
        self.events.push((at_ns, message));
        &mut self.events[place].1
    }

    fn instant(&mut self, track: u64, at_ns: u64, name: &str) {
        self.event(track, at_ns, event_type::INSTANT, name);
    }

    fn value(&mut self, track: u64, at_ns: u64, value: f64) {
        if value.is_finite() {
            let message = self.event(track, at_ns, event_type::COUNTER, "");
            message.double(event::COUNTER_VALUE, value);
        }
    }

    fn core(&mut self, line: &CoreLine) {
        let number = line.core.index() as u64;
        let track = self.thread(pid(line.system), number, core_name(line.core));
        let late = self.figures.number("late (µs)");
        let missed = self.figures.number("missed releases");
        let job = self.figures.number("job");
        let category = self.categories.number("task");
        for step in &line.steps {
            let at_ns = line.at_ns(*step);
            match *step {
                Step::Begin(slice) => {
                    let slice = &line.slices[slice];
                    let name = slice.work.name(line.core);
                    let message = self.event(track, at_ns, event_type::SLICE_BEGIN, &name);
                    message.number(event::CATEGORY, category);
                    let late_us = slice.late_ns.map(|late_ns| f64::from(late_ns) * 1e-3);
                    let missed_releases = (slice.missed > 0).then(|| slice.missed.into());
                    let number = slice.job.map(|job| job as f64);
                    for (name, value) in [(late, late_us), (missed, missed_releases), (job, number)]
                    {
                        let Some(value) = value else { continue };
                        let mut figure = Message::default();
                        figure.number(event::FIGURE_NAME, name);
                        message.message(event::FIGURE, figure.double(event::FIGURE_VALUE, value));
                    }
                }
                Step::End(_) => {
                    self.event(track, at_ns, event_type::SLICE_END, "");
                }
                Step::Mark(mark) => {
                    let mark = &line.marks[mark];
                    let Some((category, name)) = mark_name(line, mark.event) else {
                        continue;
                    };
                    let category = self.categories.number(category);
                    let message = self.event(track, at_ns, event_type::INSTANT, &name);
                    message.number(event::CATEGORY, category);
                    match mark.event {
                        Event::Wake { .. } if mark.flow != 0 => {
                            message.fixed(event::FLOW, mark.flow);
                        }
                        Event::Woken { .. } if mark.flow != 0 => {
                            message.fixed(event::TERMINATING_FLOW, mark.flow);
                        }
                        _ => {}
                    }
                }
            }
        }
    }

    fn supply(&mut self, timeline: &Timeline, system: SystemId, markers: u64) {
        let track = self.thread(pid(system), 9, "supply");
        let mine = timeline.supplies.iter().filter(|(_, of, _)| *of == system);
        for (at_ns, _, event) in mine {
            let is_marker = !matches!(event, SupplyEvent::CoreStarted { .. });
            let name = description::supply_event(*event);
            self.instant(track, *at_ns, &name);
            if is_marker {
                let name = format!("{system}: {name}");
                self.instant(markers, *at_ns, &name);
            }
        }
    }

    /// Adds the roles as slices. Each lasts until the next change, or until the core's incarnation
    /// ends.
    fn roles(&mut self, log: &RunLog, system: SystemId, process: u64) {
        let track = self.track(Some(process), "role");
        let mine = log
            .events
            .iter()
            .filter(|event| event.core == CoreId::CONTROL && event.system == system);
        let mut open = false;
        let mut last_ns = 0;
        let mut change = |trace: &mut Self, at_ns: u64, name: Option<&str>| {
            let at_ns = at_ns.max(last_ns);
            last_ns = at_ns;
            if std::mem::replace(&mut open, name.is_some()) {
                trace.event(track, at_ns, event_type::SLICE_END, "");
            }
            if let Some(name) = name {
                trace.event(track, at_ns, event_type::SLICE_BEGIN, name);
            }
        };
        let off = log
            .power
            .iter()
            .filter(|power| !power.on && power.system == system)
            .map(|power| (power.at_ns, None));
        let roles = mine.filter_map(|event| match event.event {
            Event::Role { role, mode, .. } => {
                let state = RoleState::of_codes(role, mode)?;
                Some((event.at_ns, Some(state.name())))
            }
            Event::Started { .. } => Some((event.at_ns, None)),
            _ => None,
        });
        let mut changes: Vec<(u64, Option<&str>)> = off.chain(roles).collect();
        changes.sort_by_key(|(at_ns, _)| *at_ns);
        for (at_ns, name) in &changes {
            change(self, *at_ns, *name);
        }
        let end_ns = log.end_ns.unwrap_or(0);
        change(self, end_ns, None);
    }

    /// Adds the counters of core 0.
    fn control(&mut self, timeline: &Timeline, system: SystemId, process: u64) {
        let period = self.counter(process, "control period", "ms");
        let lateness = self.counter(process, "control lateness", "µs");
        let execution = self.counter(process, "control execution", "µs");
        let chain = self.counter(process, "chain 1 → 2 → 0", "ms");
        let is_it = |line: &&CoreLine| line.system == system && line.core == CoreId::CONTROL;
        let Some(line) = timeline.cores.iter().find(is_it) else {
            return;
        };
        let mut last_ns = None;
        for mark in &line.marks {
            match mark.event {
                Event::Started { .. } => last_ns = None,
                Event::ControlCycle {
                    lateness_ns,
                    execution_ns,
                    ..
                } => {
                    let begin_ns = mark.at_ns.saturating_sub(execution_ns.into());
                    if let Some(last_ns) = last_ns.replace(begin_ns) {
                        let span_ms = begin_ns.saturating_sub(last_ns) as f64 * 1e-6;
                        self.value(period, mark.at_ns, span_ms);
                    }
                    self.value(lateness, mark.at_ns, f64::from(lateness_ns) * 1e-3);
                    self.value(execution, mark.at_ns, f64::from(execution_ns) * 1e-3);
                }
                Event::Chain { latency_ns, .. } => {
                    self.value(chain, mark.at_ns, f64::from(latency_ns) * 1e-6);
                }
                _ => {}
            }
        }
    }

    fn vehicle(&mut self, log: &RunLog, markers: u64) {
        let process = self.process(VEHICLE_PID, "vehicle");
        let bus = self.thread(VEHICLE_PID, 0, "control frames");
        for frame in &log.control {
            let word = match frame.ruling {
                Ruling::Accepted => "obeyed",
                Ruling::Fenced => "fenced off",
                Ruling::NotMaster => "not from a master",
                Ruling::Invalid => "invalid",
                Ruling::Stale => "too old",
                Ruling::Implausible => "implausible",
                Ruling::Unexplained => "of an unexplained term",
            };
            let name = format!("{} {word}", frame.system);
            self.instant(bus, frame.at_ns, &name);
        }
        let gap = self.counter(process, "gap between obeyed frames", "ms");
        let obeyed: Vec<u64> = log.accepted().map(|frame| frame.at_ns).collect();
        for pair in obeyed.windows(2) {
            let span_ms = pair[1].saturating_sub(pair[0]) as f64 * 1e-6;
            self.value(gap, pair[1], span_ms);
        }
        let speed = self.counter(process, "speed", "m/s");
        let lateral = self.counter(process, "lateral error", "m");
        for sample in &log.samples {
            self.value(speed, sample.at_ns, sample.speed);
            self.value(lateral, sample.at_ns, sample.lateral_error);
        }
        let mut events: Vec<(u64, String)> = Vec::new();
        events.extend(takeovers(log).iter().map(|takeover| {
            let (from, to) = (takeover.from, takeover.to);
            let cause = takeover.cause_in_words();
            (
                takeover.at_ns,
                format!("{to} drives in place of {from}: {cause}"),
            )
        }));
        events.extend(log.power.iter().map(|power| {
            let state = if power.on { "has power" } else { "is off" };
            (power.at_ns, format!("{} {state}", power.system))
        }));
        let collisions = log.collisions_ns.iter();
        events.extend(collisions.map(|at_ns| (*at_ns, "collision".to_owned())));
        events.extend(
            log.start_ns
                .map(|at_ns| (at_ns, "the drive begins".to_owned())),
        );
        events.sort();
        for (at_ns, name) in &events {
            self.instant(markers, *at_ns, name);
        }
    }

    fn into_bytes(mut self) -> Vec<u8> {
        let mut trace = Message::default();
        let mut put = |flags: u64, field: u32, content: &Message, at_ns: Option<u64>| {
            let mut packet = Message::default();
            if let Some(at_ns) = at_ns {
                packet.number(packet::TIMESTAMP, at_ns);
            }
            packet
                .number(packet::SEQUENCE_ID, SEQUENCE)
                .message(field, content);
            trace.message(PACKET, packet.number(packet::SEQUENCE_FLAGS, flags));
        };
        let mut interned = Message::default();
        self.categories.define(&mut interned, names::CATEGORY);
        self.names.define(&mut interned, names::EVENT);
        self.figures.define(&mut interned, names::FIGURE);
        put(STATE_CLEARED, packet::INTERNED_DATA, &interned, None);
        for track in &self.tracks {
            put(NEEDS_STATE, packet::TRACK_DESCRIPTOR, track, None);
        }
        // The sort is stable: events of one track with the same time keep their order.
        self.events.sort_by_key(|(at_ns, _)| *at_ns);
        for (at_ns, event) in &self.events {
            put(NEEDS_STATE, packet::TRACK_EVENT, event, Some(*at_ns));
        }
        trace.into_bytes()
    }
}

/// Returns category and name of a mark on a core; `None` if counters show it.
fn mark_name(line: &CoreLine, event: Event) -> Option<(&'static str, String)> {
    Some(match event {
        Event::Interrupted { irq } => ("interrupt", irq_name(irq)),
        Event::Wake { core, task, .. } => {
            let task = task_name(core, task);
            ("wake", format!("wakes core {}: {task}", core.index()))
        }
        Event::Woken { core, .. } => ("wake", format!("woken by core {}", core.index())),
        Event::Ring { core } => ("interrupt", format!("rings core {}", core.index())),
        Event::Ready { task } => ("ready", format!("{} is ready", task_name(line.core, task))),
        other => ("event", description::core_event(other)?),
    })
}
