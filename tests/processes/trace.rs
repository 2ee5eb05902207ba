//! Decodes the Perfetto trace of a run with a kill. The decoder shares no code with the encoder.

use std::collections::HashMap;

use crate::deaths::dual_master;
use crate::fixture::{Fixture, kill};
use crate::observers::until_driven_for;

/// One field of a protobuf message: its number and its value.
enum Field<'b> {
    Number(u64, u64),
    Bytes(u64, &'b [u8]),
}

/// Splits a message into fields, by the protobuf wire format alone.
fn fields(mut bytes: &[u8]) -> Vec<Field<'_>> {
    fn varint(bytes: &mut &[u8]) -> u64 {
        let mut value = 0;
        for shift in (0..64).step_by(7) {
            let (first, rest) = bytes.split_first().unwrap();
            *bytes = rest;
            value |= u64::from(first & 0x7F) << shift;
            if first & 0x80 == 0 {
                return value;
            }
        }
        panic!("an endless number");
    }
    let mut found = Vec::new();
    while !bytes.is_empty() {
        let key = varint(&mut bytes);
        let (number, length) = match key & 7 {
            0 => {
                found.push(Field::Number(key >> 3, varint(&mut bytes)));
                continue;
            }
            1 => (key >> 3, 8),
            2 => (key >> 3, varint(&mut bytes) as usize),
            other => panic!("wire type {other}"),
        };
        let (content, rest) = bytes.split_at(length);
        bytes = rest;
        found.push(Field::Bytes(number, content));
    }
    found
}

fn number(message: &[u8], wanted: u64) -> Option<u64> {
    fields(message).iter().find_map(|field| match field {
        Field::Number(number, value) if *number == wanted => Some(*value),
        _ => None,
    })
}

fn all(message: &[u8], wanted: u64) -> Vec<&[u8]> {
    let found = fields(message).into_iter().filter_map(|field| match field {
        Field::Bytes(number, bytes) if number == wanted => Some(bytes),
        _ => None,
    });
    found.collect()
}

fn text(message: &[u8], wanted: u64) -> Option<String> {
    let bytes = all(message, wanted).first()?.to_vec();
    Some(String::from_utf8(bytes).unwrap())
}

/// An event of the trace: its time (ns), thread ("pid/name"), type and name.
struct Moment {
    at_ns: u64,
    thread: String,
    kind: u64,
    name: String,
    /// The number of the job that a slice belongs to.
    job: Option<u64>,
}

const BEGIN: u64 = 1;
const END: u64 = 2;

/// Identifiers of frames on the bus.
const CONTROL: [u16; 2] = [0x0A0, 0x0A1];
const LISTS: std::ops::Range<u16> = 0x200..0x260;

fn events(trace: &[u8]) -> Vec<Moment> {
    let (mut names, mut threads) = (HashMap::new(), HashMap::new());
    let mut figures = HashMap::new();
    let mut events = Vec::new();
    for packet in all(trace, 1) {
        for name in all(packet, 12).iter().flat_map(|interned| all(interned, 2)) {
            names.insert(number(name, 1).unwrap(), text(name, 2).unwrap());
        }
        for name in all(packet, 12).iter().flat_map(|interned| all(interned, 3)) {
            figures.insert(number(name, 1).unwrap(), text(name, 2).unwrap());
        }
        if let Some(track) = all(packet, 60).first() {
            let thread = all(track, 4).first().map(|thread| {
                let pid = number(thread, 1).unwrap();
                format!("{pid}/{}", text(thread, 5).unwrap())
            });
            threads.insert(number(track, 1).unwrap(), thread.unwrap_or_default());
        }
        if let Some(event) = all(packet, 11).first() {
            let mut annotations = all(event, 4).into_iter();
            let job = annotations.find(|it| figures[&number(it, 1).unwrap()] == "job");
            events.push(Moment {
                at_ns: number(packet, 8).unwrap(),
                thread: threads[&number(event, 11).unwrap()].clone(),
                kind: number(event, 9).unwrap(),
                name: number(event, 10).map_or(String::new(), |name| names[&name].clone()),
                job: job.map(|job| {
                    let bytes = all(job, 5)[0].try_into().unwrap();
                    f64::from_le_bytes(bytes) as u64
                }),
            });
        }
    }
    events
}

/// Returns the time from the time stamp in an object list's header to the frame on the bus, ms.
/// After a stall the vehicle sends overdue lists. The sensors use the machine's clock, in µs.
fn waited_ms(at_ms: f64, header: &str) -> f64 {
    let measured_us = u32::from_str_radix(&header[8..16], 16)
        .unwrap()
        .swap_bytes();
    let at_us = (at_ms * 1e3).round() as u64 as u32;
    // The result may be negative, because the log rounds the time down.
    f64::from(at_us.wrapping_sub(measured_us) as i32) * 1e-3
}

/// Returns the sorted ages in ms of the oldest object list behind each accepted control frame.
/// Only the trace and the bus log are used, not the age that a frame contains.
fn sensor_ages_ms(events: &[Moment], candump: &str) -> Vec<f64> {
    let frames: Vec<(f64, u16, &str)> = candump
        .lines()
        .filter_map(|line| {
            let (time, frame) = line.split_once(") can0 ").unwrap();
            // The applications tell their releases in classic frames.
            let (id, data) = frame.split_once("##1")?;
            let seconds: f64 = time[1..].parse().unwrap();
            Some((seconds * 1e3, u16::from_str_radix(id, 16).unwrap(), data))
        })
        .collect();
    let obeyed = |e: &&Moment| e.name.ends_with(" obeyed");
    let ms = |e: &Moment| e.at_ns as f64 * 1e-6;
    // The log contains the time of day; the trace contains the machine's clock.
    let first_control = frames
        .iter()
        .find(|(_, id, _)| CONTROL.contains(id))
        .unwrap()
        .0;
    let shift = ms(events.iter().find(obeyed).unwrap()) - first_control;
    // The lists of each sensor: time of the measurement, and of its last frame on the bus.
    let mut lists: HashMap<u16, Vec<(f64, f64)>> = HashMap::new();
    let of_lists = frames.into_iter().filter(|(_, id, _)| LISTS.contains(id));
    for (at, id, data) in of_lists {
        let lists = lists.entry(id >> 4).or_default();
        if id & 0xF == 0 {
            lists.push((at + shift - waited_ms(at + shift, data), at + shift));
        } else if let Some(last) = lists.last_mut() {
            last.1 = at + shift;
        }
    }
    let times = |thread: String, kind| {
        let here = events
            .iter()
            .filter(move |e| e.thread == thread && e.kind == kind);
        here.map(ms).collect::<Vec<_>>()
    };
    let mut ages = Vec::new();
    let of_both = [("A obeyed", 1), ("B obeyed", 2)];
    for (name, pid) in of_both {
        let perceives = times(format!("{pid}/core 1: perception"), BEGIN);
        let planned = times(format!("{pid}/core 2: planning"), END);
        for acts in events.iter().filter(|e| e.name == name).map(ms) {
            // The last plan before this frame, and the last perception cycle before it.
            let plan = planned.iter().rfind(|end| **end < acts);
            let look = plan.and_then(|plan| perceives.iter().rfind(|begin| *begin < plan));
            let Some(look) = look else { continue };
            let of_sensor = |lists: &Vec<(f64, f64)>| {
                lists
                    .iter()
                    .rfind(|(_, end)| end < look)
                    .map(|(begin, _)| *begin)
            };
            let oldest = lists.values().filter_map(of_sensor).reduce(f64::min);
            ages.extend(oldest.map(|oldest| acts - oldest));
        }
    }
    ages.sort_by(f64::total_cmp);
    ages
}

/// The trace of a killed core is kept up to the kill, and the whole trace is well-formed. The ages
/// of sensor data in the metrics match the trace and the bus log.
#[test]
fn a_killed_core_leaves_its_trace_up_to_the_kill() {
    let fixture = Fixture::new();
    let mut run = fixture.run(&["--duration", "60"]);
    let master = dual_master(&run);
    until_driven_for(&run, 1.0);
    let victim = run.core(&master, 0);
    kill(victim);
    run.until("core 0 again", |processes| {
        let is_it = |p: &&crate::fixture::Process| {
            p.core == Some(0) && p.system.as_deref() == Some(&*master) && p.pid != victim
        };
        processes.iter().find(is_it).map(|_| ())
    });
    until_driven_for(&run, 2.0);
    let metrics = run.interrupt();
    let lost = metrics["lost_trace"].as_u64().unwrap() as usize;
    let report = fixture.folder().join("tandem-report");
    let events = events(&std::fs::read(report.join("trace.perfetto-trace")).unwrap());

    let pid = if master == "A" { 1 } else { 2 };
    let (core, supply) = (format!("{pid}/core 0: control"), format!("{pid}/supply"));
    let died = "core 0 died of signal 9";
    let death = events
        .iter()
        .position(|e| e.thread == supply && e.name == died);
    let death_ns = events[death.unwrap()].at_ns;
    let reborn = events
        .iter()
        .find(|e| e.thread == core && e.name.starts_with("starts, incarnation 2"));
    let reborn_ns = reborn.unwrap().at_ns;
    assert!(death_ns < reborn_ns);

    // Each accepted frame was sent in a cycle of the first incarnation, and the trace contains
    // these cycles.
    let cycles = events
        .iter()
        .filter(|e| e.thread == core && e.kind == BEGIN && e.name == "control");
    // A preempted cycle has one slice for each time in which it had the CPU.
    let mut slices: Vec<(u64, u64)> = cycles.map(|e| (e.job.unwrap(), e.at_ns)).collect();
    slices.dedup_by_key(|(job, _)| *job);
    let cycles: Vec<u64> = slices.iter().map(|(_, at_ns)| *at_ns).collect();
    let obeyed = events
        .iter()
        .filter(|e| e.name == format!("{master} obeyed"));
    let obeyed = obeyed.filter(|e| e.at_ns < reborn_ns).count();
    assert!(obeyed > 0);
    let before = cycles.iter().filter(|at_ns| **at_ns <= death_ns).count();
    assert!(before + lost >= obeyed, "{before} cycles, {obeyed} frames");
    // No cycle lies between the incarnations.
    assert!(
        !cycles
            .iter()
            .any(|at_ns| (death_ns + 1..reborn_ns).contains(at_ns))
    );

    let mut depth: HashMap<&str, (i32, u64)> = HashMap::new();
    for event in events.iter().filter(|event| !event.thread.is_empty()) {
        let (depth, last_ns) = depth.entry(&event.thread).or_default();
        assert!(
            *last_ns <= event.at_ns,
            "time goes back on {}",
            event.thread
        );
        *last_ns = event.at_ns;
        match event.kind {
            BEGIN => *depth += 1,
            END => *depth -= 1,
            _ => {}
        }
        assert!(*depth >= 0, "an end without a begin on {}", event.thread);
    }
    assert!(depth.values().all(|(depth, _)| *depth == 0));
    // The trace contains all six cores, both supplies and the bus.
    assert_eq!(depth.len(), 9, "{:?}", depth.keys());
    let woken = events
        .iter()
        .filter(|e| e.name == "woken by core 2")
        .count();
    assert!(woken > 0);

    let control = metrics["tasks"].as_array().unwrap().iter();
    let mut control = control.filter(|t| t["task"] == "control" && t["system"] == *master);
    let jobs = control.next().unwrap()["jobs"].as_u64().unwrap();
    assert_eq!(jobs, cycles.len() as u64);

    let candump = std::fs::read_to_string(report.join("candump.log")).unwrap();
    let ages_ms = sensor_ages_ms(&events, &candump);
    let reported = metrics["sensor_age_p50_ms"].as_f64().unwrap();
    // The metrics include some frames that the trace lacks, so the medians are only close in rank.
    let [low, high] = [45, 55].map(|percent| ages_ms[ages_ms.len() * percent / 100]);
    assert!(
        (low - 0.5..high + 0.5).contains(&reported),
        "{low} to {high} ms by trace and bus, {reported} reported"
    );
}
