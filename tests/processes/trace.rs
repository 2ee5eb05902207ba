//! The Perfetto trace of a run with a kill, read by a decoder that shares nothing with its writer.

use std::collections::HashMap;

use crate::fixture::{Fixture, kill};

/// One field of a protobuf message: its number, and its content.
enum Field<'b> {
    Number(u64, u64),
    Bytes(u64, &'b [u8]),
}

/// Field by field, by the protobuf wire format alone.
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

/// A moment of the trace: when (ns), on which thread ("pid/name"), of which type, its name.
struct Moment {
    at_ns: u64,
    thread: String,
    kind: u64,
    name: String,
}

const BEGIN: u64 = 1;
const END: u64 = 2;

fn events(trace: &[u8]) -> Vec<Moment> {
    let (mut names, mut threads) = (HashMap::new(), HashMap::new());
    let mut events = Vec::new();
    for packet in all(trace, 1) {
        for name in all(packet, 12).iter().flat_map(|interned| all(interned, 2)) {
            names.insert(number(name, 1).unwrap(), text(name, 2).unwrap());
        }
        if let Some(track) = all(packet, 60).first() {
            let thread = all(track, 4).first().map(|thread| {
                let pid = number(thread, 1).unwrap();
                format!("{pid}/{}", text(thread, 5).unwrap())
            });
            threads.insert(number(track, 1).unwrap(), thread.unwrap_or_default());
        }
        if let Some(event) = all(packet, 11).first() {
            events.push(Moment {
                at_ns: number(packet, 8).unwrap(),
                thread: threads[&number(event, 11).unwrap()].clone(),
                kind: number(event, 9).unwrap(),
                name: number(event, 10).map_or(String::new(), |name| names[&name].clone()),
            });
        }
    }
    events
}

/// A core that is killed leaves its trace up to the kill, and the trace of all stays well-formed.
#[test]
fn a_killed_core_leaves_its_trace_up_to_the_kill() {
    let fixture = Fixture::new();
    let mut run = fixture.run(&["--duration", "5"]);
    run.until_dual();
    let master = run.master_supply().system.unwrap();
    let victim = run.until("core 0", |processes| {
        let is_it = |p: &&crate::fixture::Process| {
            p.core == Some(0) && p.system.as_deref() == Some(&*master)
        };
        processes.iter().find(is_it).map(|p| p.pid)
    });
    kill(victim);
    let metrics = run.metrics();
    assert_eq!(metrics["lost_trace"], 0, "{metrics:#}");
    let path = fixture.folder().join("tandem-report/trace.perfetto-trace");
    let events = events(&std::fs::read(path).unwrap());

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

    // Each frame that the vehicle obeyed was sent in a cycle of the first incarnation, which was
    // traced.
    let cycles = events
        .iter()
        .filter(|e| e.thread == core && e.kind == BEGIN && e.name == "control");
    let cycles: Vec<u64> = cycles.map(|e| e.at_ns).collect();
    let obeyed = events
        .iter()
        .filter(|e| e.name == format!("{master} obeyed"));
    let obeyed = obeyed.filter(|e| e.at_ns < reborn_ns).count();
    assert!(obeyed > 0);
    let before = cycles.iter().filter(|at_ns| **at_ns <= death_ns).count();
    assert!(before >= obeyed, "{before} cycles, {obeyed} frames");
    // And nothing between the incarnations.
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
    // All six cores, both supplies and the bus were heard of.
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
}
