//! Encodes the timeline as a trace that <https://ui.perfetto.dev> opens.
//!
//! Each system and the vehicle is a process, and each core and supply a thread. All times are on
//! the run's clock. All packets form one sequence, whose first packet defines all names.

use std::collections::HashMap;

use prost::Message as _;
use tandem_board::{CoreId, SupplyEvent, SystemId};
use tandem_cores::trace::Event;

use super::schema::{
    CounterDescriptor, DebugAnnotation, InternedData, NEEDS_STATE, Name, ProcessDescriptor,
    STATE_CLEARED, ThreadDescriptor, TracePacket, TrackDescriptor, TrackEvent, event_type,
};
use super::{CoreLine, Step, Timeline, irq_name, task_name};
use tandem_record::roles::RoleState;
use tandem_record::{RunLog, description, takeovers};
use tandem_vehicle::Ruling;

const SEQUENCE: u32 = 1;
/// Key byte of a packet in a trace: field 1, prefixed with its length.
const PACKET_KEY: u8 = 0x0A;
const VEHICLE_PID: i32 = 3;

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

const fn pid(system: SystemId) -> i32 {
    system.index() as i32 + 1
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

    fn list(&self) -> Vec<Name> {
        let mut list: Vec<Name> = self
            .numbers
            .iter()
            .map(|(name, number)| Name {
                iid: Some(*number),
                name: Some(name.clone()),
            })
            .collect();
        list.sort_by_key(|name| name.iid);
        list
    }
}

#[derive(Debug, Default)]
struct Trace {
    tracks: Vec<TrackDescriptor>,
    /// Time, ns, and event; the events of each track are in order of time.
    events: Vec<(u64, TrackEvent)>,
    names: Names,
    categories: Names,
    figures: Names,
}

impl Trace {
    fn add_track(&mut self, descriptor: TrackDescriptor) -> u64 {
        let uuid = self.tracks.len() as u64 + 1;
        self.tracks.push(TrackDescriptor {
            uuid: Some(uuid),
            ..descriptor
        });
        uuid
    }

    fn process(&mut self, pid: i32, name: &str) -> u64 {
        self.add_track(TrackDescriptor {
            process: Some(ProcessDescriptor {
                pid: Some(pid),
                process_name: Some(name.to_owned()),
            }),
            ..TrackDescriptor::default()
        })
    }

    fn thread(&mut self, pid: i32, number: i32, name: &str) -> u64 {
        self.add_track(TrackDescriptor {
            thread: Some(ThreadDescriptor {
                pid: Some(pid),
                // Unique over all processes, and different from every process id.
                tid: Some(i64::from(100 * pid + number)),
                thread_name: Some(name.to_owned()),
            }),
            ..TrackDescriptor::default()
        })
    }

    fn track(&mut self, parent: Option<u64>, name: &str) -> u64 {
        self.add_track(TrackDescriptor {
            parent_uuid: parent,
            name: Some(name.to_owned()),
            ..TrackDescriptor::default()
        })
    }

    fn counter(&mut self, parent: u64, name: &str, unit: &str) -> u64 {
        self.add_track(TrackDescriptor {
            parent_uuid: Some(parent),
            name: Some(name.to_owned()),
            counter: Some(CounterDescriptor {
                unit_name: Some(unit.to_owned()),
            }),
            ..TrackDescriptor::default()
        })
    }

    /// Adds an event of this kind, see [`event_type`]. An empty name means no name.
    fn event(&mut self, track: u64, at_ns: u64, kind: i32, name: &str) -> &mut TrackEvent {
        let place = self.events.len();
        let event = TrackEvent {
            r#type: Some(kind),
            track_uuid: Some(track),
            name_iid: (!name.is_empty()).then(|| self.names.number(name)),
            ..TrackEvent::default()
        };
        self.events.push((at_ns, event));
        &mut self.events[place].1
    }

    fn instant(&mut self, track: u64, at_ns: u64, name: &str) {
        self.event(track, at_ns, event_type::INSTANT, name);
    }

    fn value(&mut self, track: u64, at_ns: u64, value: f64) {
        if value.is_finite() {
            let event = self.event(track, at_ns, event_type::COUNTER, "");
            event.double_counter_value = Some(value);
        }
    }

    fn core(&mut self, line: &CoreLine) {
        let number = line.core.index() as i32;
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
                    let event = self.event(track, at_ns, event_type::SLICE_BEGIN, &name);
                    event.category_iids.push(category);
                    let late_us = slice.late_ns.map(|late_ns| f64::from(late_ns) * 1e-3);
                    let missed_releases = (slice.missed > 0).then(|| slice.missed.into());
                    let number = slice.job.map(|job| job as f64);
                    let figures = [(late, late_us), (missed, missed_releases), (job, number)];
                    let known = figures.iter().filter(|(_, value)| value.is_some());
                    let annotation = |(name, value): &(u64, Option<f64>)| DebugAnnotation {
                        name_iid: Some(*name),
                        double_value: *value,
                    };
                    event.debug_annotations.extend(known.map(annotation));
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
                    let event = self.event(track, at_ns, event_type::INSTANT, &name);
                    event.category_iids.push(category);
                    match mark.event {
                        Event::Wake { .. } if mark.flow != 0 => event.flow_ids.push(mark.flow),
                        Event::Woken { .. } if mark.flow != 0 => {
                            event.terminating_flow_ids.push(mark.flow);
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
        let mut bytes = Vec::new();
        let mut put = |packet: &TracePacket| {
            bytes.push(PACKET_KEY);
            // Encoding into a vector cannot fail.
            let _ = packet.encode_length_delimited(&mut bytes);
        };
        let packet = |flags: u32| TracePacket {
            trusted_packet_sequence_id: Some(SEQUENCE),
            sequence_flags: Some(flags),
            ..TracePacket::default()
        };
        put(&TracePacket {
            interned_data: Some(InternedData {
                event_categories: self.categories.list(),
                event_names: self.names.list(),
                debug_annotation_names: self.figures.list(),
            }),
            ..packet(STATE_CLEARED)
        });
        for track in self.tracks {
            put(&TracePacket {
                track_descriptor: Some(track),
                ..packet(NEEDS_STATE)
            });
        }
        // The sort is stable: events of one track with the same time keep their order.
        self.events.sort_by_key(|(at_ns, _)| *at_ns);
        for (at_ns, event) in self.events {
            put(&TracePacket {
                timestamp: Some(at_ns),
                track_event: Some(event),
                ..packet(NEEDS_STATE)
            });
        }
        bytes
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
