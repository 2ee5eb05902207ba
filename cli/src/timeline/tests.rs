//! Tests of the timeline with synthetic records.

use std::collections::HashMap;
use std::io::Write as _;
use std::process::{Command, Stdio};

use prost::Message as _;
use tandem_board::{Instant, ResetCause, Traced};
use tandem_record::Entry;

use super::schema::event_type;
use super::*;
use crate::tests::synthetic;

const A: SystemId = SystemId::A;
const CONTROL: CoreId = CoreId::CONTROL;

fn at(us: u64, core: CoreId, event: Event) -> Entry {
    Entry::Trace(Traced {
        at: Instant::from_ns(us * 1_000),
        system: A,
        core,
        record: event.encode(),
    })
}

fn timeline_of(entries: &[Entry]) -> Timeline {
    let mut log = RunLog::default();
    entries.iter().cloned().for_each(|entry| log.push(entry));
    log.sort();
    Timeline::new(&log)
}

fn supply(us: u64, event: SupplyEvent) -> Entry {
    Entry::Supply(Instant::from_ns(us * 1_000), A, event)
}

fn goes(task: TaskCode) -> Event {
    let begin = Begin::Goes;
    Event::TaskIn { task, begin }
}

fn released(task: TaskCode, late_us: u32, missed: u32) -> Event {
    let late_ns = late_us * 1_000;
    let begin = Begin::Released { late_ns, missed };
    Event::TaskIn { task, begin }
}

fn out(task: TaskCode, leaves: Leaves) -> Event {
    Event::TaskOut { task, leaves }
}

fn done(task: TaskCode) -> Event {
    out(task, Leaves::Done)
}

fn on_core(core: CoreId, events: &[(u64, Event)]) -> Vec<Entry> {
    let entries = events.iter().map(|(us, event)| at(*us, core, *event));
    entries.collect()
}

/// Returns (name, begin, end, depth, cut) of each slice, times in µs.
fn slices(timeline: &Timeline, core: CoreId) -> Vec<(String, u64, u64, usize, bool)> {
    let line = &timeline.cores[place(A, core)];
    line.slices
        .iter()
        .map(|s| {
            let (begin, end) = (s.begin_ns / 1_000, s.end_ns / 1_000);
            (s.work.name(core), begin, end, s.depth, s.cut)
        })
        .collect()
}

fn figures<'t>(timeline: &'t Timeline, task: &str) -> &'t TaskMetrics {
    let mut found = timeline.tasks.iter().filter(|t| t.task == task);
    let figures = found.next().unwrap();
    assert!(found.next().is_none());
    figures
}

fn ms(value: Option<f64>) -> f64 {
    (value.unwrap() * 1e3).round() / 1e3
}

/// Switches of a kernel: a preempted task, an interrupt within it, and a job in two parts.
#[test]
fn a_pre_empted_task_is_not_charged_for_what_ran_instead() {
    let (low, high) = (TaskCode::STATUS, TaskCode::CONTROL);
    let irq = IrqCode::TICK;
    let timeline = timeline_of(&on_core(
        CONTROL,
        &[
            (1_000, Event::Ready { task: low }),
            (1_500, goes(low)),
            (2_000, Event::IrqIn { irq }),
            (2_100, Event::Ready { task: high }),
            (2_200, Event::IrqOut { irq }),
            (2_300, out(low, Leaves::Preempted)),
            (2_400, goes(high)),
            (5_400, done(high)),
            (5_500, goes(low)),
            (6_000, out(low, Leaves::Blocked)),
            (7_000, Event::Ready { task: low }),
            (7_100, goes(low)),
            (8_000, done(low)),
        ],
    ));
    let shown = slices(&timeline, CONTROL);
    let slice = |name: &str, from, to, depth| (name.to_owned(), from, to, depth, false);
    let expected = [
        slice("status", 1_500, 2_300, 0),
        slice("interrupt: tick", 2_000, 2_200, 1),
        slice("control", 2_400, 5_400, 0),
        slice("status", 5_500, 6_000, 0),
        slice("status", 7_100, 8_000, 0),
    ];
    assert_eq!(shown, expected);
    // Three slices have the same job number.
    let jobs: Vec<_> = timeline.cores[0].slices.iter().map(|it| it.job).collect();
    assert_eq!(jobs, [Some(1), None, Some(1), Some(1), Some(1)]);
    let status = figures(&timeline, "status");
    assert_eq!((status.jobs, status.deadline_misses, status.cut), (1, 0, 0));
    assert_eq!(ms(status.response_max_ms), 7.0);
    // 0.8 ms minus the interrupt's 0.2 ms, then 0.5 and 0.9 ms.
    assert_eq!(ms(status.execution_max_ms), 2.0);
    let control = figures(&timeline, "control");
    assert_eq!(ms(control.response_max_ms), 3.3);
    assert_eq!(ms(control.execution_p50_ms), 3.0);
}

/// FreeRTOS records that a task is switched out, but not the reason.
#[test]
fn a_task_that_gave_way_was_done_if_it_is_made_ready_again() {
    let task = TaskCode::ROLES;
    let timeline = timeline_of(&on_core(
        CONTROL,
        &[
            (1_000, Event::Ready { task }),
            (1_100, goes(task)),
            (1_300, out(task, Leaves::Gives)),
            // The task was preempted: it continues without becoming ready again.
            (1_500, goes(task)),
            (1_600, out(task, Leaves::Gives)),
            (2_000, Event::Ready { task }),
            (2_100, goes(task)),
            (2_200, out(task, Leaves::Gives)),
        ],
    ));
    let found = figures(&timeline, "heartbeat and roles");
    assert_eq!((found.jobs, found.responses, found.cut), (2, 2, 0));
    assert_eq!(ms(found.response_max_ms), 0.6);
    assert_eq!(ms(found.response_p50_ms), 0.2);
    assert_eq!(ms(found.execution_max_ms), 0.3);
}

#[test]
fn a_nested_task_pauses_the_one_around_it() {
    let timeline = timeline_of(&on_core(
        CONTROL,
        &[
            (1_000, released(TaskCode::ROLES, 100, 0)),
            (1_200, released(TaskCode::CONTROL, 0, 0)),
            (1_300, released(TaskCode::DEGRADED, 0, 0)),
            (1_700, done(TaskCode::DEGRADED)),
            (1_800, done(TaskCode::CONTROL)),
            (2_000, done(TaskCode::ROLES)),
        ],
    ));
    let depths: Vec<usize> = slices(&timeline, CONTROL).iter().map(|s| s.3).collect();
    assert_eq!(depths, [0, 1, 2]);
    let own = |task| ms(figures(&timeline, task).execution_max_ms);
    assert_eq!(own("heartbeat and roles"), 0.4);
    assert_eq!(own("control"), 0.2);
    assert_eq!(own("degraded mode"), 0.4);
    let response = figures(&timeline, "heartbeat and roles").response_max_ms;
    assert_eq!(ms(response), 1.1);
}

#[test]
fn deadlines_are_missed_by_late_jobs_and_by_releases_without_a_job() {
    let task = TaskCode::MONITORING;
    let timeline = timeline_of(&on_core(
        CONTROL,
        &[
            (10_000, released(task, 0, 0)),
            (15_000, done(task)),
            // Released at 15 ms; ends 5.001 ms later.
            (19_000, released(task, 4_000, 0)),
            (20_001, done(task)),
            (40_000, released(task, 0, 3)),
            (40_100, done(task)),
        ],
    ));
    let found = figures(&timeline, "monitoring");
    assert_eq!((found.jobs, found.missed_releases), (3, 3));
    assert_eq!(found.deadline_misses, 4);
    assert_eq!((found.period_ms, found.deadline_ms), (Some(5.0), Some(5.0)));
}

#[test]
fn what_a_core_did_when_it_was_killed_ends_when_the_supply_saw_it() {
    let died = SupplyEvent::CoreDied {
        core: CONTROL,
        signal: 9,
    };
    let started = Event::Started {
        generation: 2,
        cause: 3,
    };
    let mut entries = on_core(
        CONTROL,
        &[
            (100, released(TaskCode::ROLES, 0, 0)),
            (200, released(TaskCode::CONTROL, 0, 0)),
            (900, started),
            (1_000, goes(TaskCode::ROLES)),
        ],
    );
    entries.push(supply(250, died));
    entries.push(supply(260, SupplyEvent::Reset(ResetCause::Trap)));
    let timeline = timeline_of(&entries);
    let shown = slices(&timeline, CONTROL);
    assert_eq!(shown[1], ("control".into(), 200, 250, 1, true));
    assert_eq!(shown[0], ("heartbeat and roles".into(), 100, 250, 0, true));
    // The next incarnation has no recorded end, so it ends with its last record.
    assert_eq!((shown[2].1, shown[2].2, shown[2].4), (1_000, 1_000, true));
    assert_eq!(figures(&timeline, "control").cut, 1);
    assert_eq!(figures(&timeline, "heartbeat and roles").cut, 2);
}

#[test]
fn a_slice_whose_end_was_lost_ends_with_the_one_around_it() {
    let timeline = timeline_of(&on_core(
        CONTROL,
        &[
            (100, goes(TaskCode::CONTROL)),
            (200, goes(TaskCode::MONITORING)),
            (300, done(TaskCode::CONTROL)),
            (400, done(TaskCode::MONITORING)),
            (500, goes(TaskCode::STATUS)),
            (600, goes(TaskCode::STATUS)),
            (700, done(TaskCode::STATUS)),
        ],
    ));
    let shown = slices(&timeline, CONTROL);
    assert_eq!(shown[1], ("monitoring".into(), 200, 300, 1, true));
    assert_eq!(shown[2], ("status".into(), 500, 600, 0, false));
    assert_eq!(shown[3], ("status".into(), 600, 700, 0, false));
}

fn wake(flow: u32) -> Event {
    let (core, task) = (CoreId::PLANNING, TaskCode::PLANNING);
    Event::Wake { core, task, flow }
}

fn woken(flow: u32) -> Event {
    let core = CoreId::PERCEPTION;
    Event::Woken { core, flow }
}

/// The numbers of signals restart with each incarnation of the sender.
#[test]
fn a_signal_is_joined_to_the_last_one_of_its_number_and_only_once() {
    let mut entries = on_core(
        CoreId::PERCEPTION,
        &[(100, wake(1)), (200, wake(2)), (5_000, wake(1))],
    );
    entries.extend(on_core(
        CoreId::PLANNING,
        &[
            (150, goes(TaskCode::PLANNING)),
            (151, woken(1)),
            (160, woken(1)),
            (190, done(TaskCode::PLANNING)),
            (4_000, woken(7)),
            (5_100, goes(TaskCode::PLANNING)),
            (5_100, woken(1)),
            (5_300, done(TaskCode::PLANNING)),
        ],
    ));
    let timeline = timeline_of(&entries);
    let times: Vec<(u64, u64)> = timeline
        .flows
        .iter()
        .map(|flow| (flow.from.1 / 1_000, flow.to.1 / 1_000))
        .collect();
    assert_eq!(times, [(100, 151), (5_000, 5_100)]);
    let line = &timeline.cores[place(A, CoreId::PERCEPTION)];
    let arrows: Vec<u64> = line.marks.iter().map(|mark| mark.flow).collect();
    assert_eq!(arrows, [1, 0, 2]);
    let wakes = timeline.wakes();
    assert_eq!((wakes.len(), wakes[0].from, wakes[0].to), (1, 1, 2));
    assert_eq!((wakes[0].count, ms(wakes[0].latency_max_ms)), (2, 0.1));
    // Measured from core 1's signal to the end of the job.
    let planning = figures(&timeline, "planning");
    assert_eq!(ms(planning.response_max_ms), 0.3);
    assert_eq!((planning.jobs, planning.responses), (2, 2));
}

#[test]
fn the_fullest_stack_counts() {
    let task = TaskCode::CONTROL;
    let stack = |free_bytes| Event::Stack { task, free_bytes };
    let timeline = timeline_of(&on_core(CONTROL, &[(1, stack(900)), (2, stack(700))]));
    assert_eq!(figures(&timeline, "control").stack_free_bytes, Some(700));
}

/// Returns random records of all cores, with lost and corrupt records and killed cores.
fn random(seed: u64, count: usize) -> Vec<Entry> {
    let mut state = seed * 2 + 1;
    let mut next = |below: u64| {
        state = state
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(1);
        (state >> 33) % below
    };
    let mut us = 1_000;
    (0..count)
        .map(|_| {
            us += next(40);
            let system = SystemId::ALL[next(2) as usize];
            let core = CoreId::ALL[next(3) as usize];
            // Sometimes the time decreases, which a real clock never does.
            let at = Instant::from_ns(us * 1_000 - next(2) * next(60_000));
            let kind = [1, 17, 17, 17, 18, 18, 18, 18, 19, 20, 21, 22, 23, 24][next(14) as usize];
            let fields = (next(4) << 8) | (next(3) << 16);
            if next(50) == 0 {
                let signal = 9;
                return Entry::Supply(at, system, SupplyEvent::CoreDied { core, signal });
            }
            Entry::Trace(Traced {
                at,
                system,
                core,
                record: [kind | fields as u32, next(4) as u32, next(2) as u32, 0],
            })
        })
        .collect()
}

/// Returns a timeline with all kinds of entries, about 20 ms before and after a moment.
pub(crate) fn around(at_ns: u64) -> Timeline {
    let mut entries = random(7, 2_000);
    for entry in &mut entries {
        if let Entry::Trace(Traced { at, .. }) | Entry::Supply(at, ..) = entry {
            let ns = at_ns + at.as_ns();
            *at = Instant::from_ns(ns.saturating_sub(20_000_000));
        }
    }
    timeline_of(&entries)
}

/// What [`check`] reads of a packet.
#[derive(Clone, PartialEq, prost::Message)]
struct TracePacket {
    #[prost(uint64, optional, tag = "8")]
    timestamp: Option<u64>,
    #[prost(message, optional, tag = "11")]
    track_event: Option<TrackEvent>,
}

#[derive(Clone, PartialEq, prost::Message)]
struct TrackEvent {
    #[prost(uint64, required, tag = "9")]
    r#type: u64,
    #[prost(uint64, optional, tag = "11")]
    track_uuid: Option<u64>,
    #[prost(double, optional, tag = "44")]
    double_counter_value: Option<f64>,
    #[prost(fixed64, repeated, packed = "false", tag = "47")]
    flow_ids: Vec<u64>,
    #[prost(fixed64, repeated, packed = "false", tag = "48")]
    terminating_flow_ids: Vec<u64>,
}

/// Checks that slices of a track nest and end, times ascend, and arrows have both ends in order.
fn check(bytes: &[u8]) {
    let mut rest = bytes;
    let mut depth: HashMap<u64, i32> = HashMap::new();
    let mut last: HashMap<u64, u64> = HashMap::new();
    let (mut begun, mut ended) = (HashMap::new(), HashMap::new());
    while let Some((key, packet)) = rest.split_first() {
        assert_eq!(*key, 0x0A);
        rest = packet;
        let packet = TracePacket::decode_length_delimited(&mut rest).unwrap();
        let Some(event) = packet.track_event else {
            continue;
        };
        let (track, at_ns) = (event.track_uuid.unwrap(), packet.timestamp.unwrap());
        assert!(last.insert(track, at_ns).unwrap_or(0) <= at_ns);
        let depth = depth.entry(track).or_default();
        match event.r#type {
            event_type::SLICE_BEGIN => *depth += 1,
            event_type::SLICE_END => *depth -= 1,
            event_type::INSTANT => {}
            event_type::COUNTER => assert!(event.double_counter_value.is_some()),
            other => panic!("{other}"),
        }
        assert!(*depth >= 0, "an end without a begin");
        for flow in event.flow_ids {
            assert_eq!(
                begun.insert(flow, at_ns),
                None,
                "two begins of arrow {flow}"
            );
        }
        for flow in event.terminating_flow_ids {
            assert_eq!(ended.insert(flow, at_ns), None, "two ends of arrow {flow}");
        }
    }
    assert!(
        depth.values().all(|depth| *depth == 0),
        "a slice never ends"
    );
    assert_eq!(begun.len(), ended.len());
    for (flow, begin_ns) in begun {
        assert!(ended[&flow] >= begin_ns, "arrow {flow} goes back");
    }
}

#[test]
fn whatever_the_cores_wrote_the_trace_is_well_formed() {
    let log = synthetic::with_takeover(1.0);
    for seed in 0..100 {
        let timeline = timeline_of(&random(seed, 400));
        check(&encode(&timeline, &log).bytes);
        for line in &timeline.cores {
            for pair in line.steps.windows(2) {
                assert!(line.at_ns(pair[0]) <= line.at_ns(pair[1]));
            }
        }
    }
    check(&encode(&Timeline::default(), &RunLog::default()).bytes);
}

/// Perfetto's own description of the format decodes the trace to the values that were encoded.
#[test]
fn perfetto_oracle_reads_what_was_written() {
    const SCRIPT: &str = concat!(
        env!("CARGO_MANIFEST_DIR"),
        "/../tests/trace/perfetto_oracle.py"
    );
    let import = "from perfetto.protos.perfetto.trace import perfetto_trace_pb2";
    let python = || {
        let mut python = Command::new("python3");
        if let Some(folder) = std::env::var_os("TANDEM_PERFETTO") {
            python.env("PYTHONPATH", folder);
        }
        python
    };
    let there = python().args(["-c", import]).output();
    if !there.is_ok_and(|output| output.status.success()) {
        let required = std::env::var_os("TANDEM_REQUIRE_PERFETTO").is_some_and(|v| v == "1");
        assert!(!required, "pip install perfetto protobuf");
        // Write past the test runner's capture, so that a skipped test is visible.
        let _ = writeln!(
            std::io::stderr(),
            "perfetto_oracle_reads_what_was_written: skipped: pip install perfetto protobuf"
        );
        return;
    }
    let timeline = timeline_of(&random(7, 2_000));
    let mut child = python()
        .arg(SCRIPT)
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let mut stdin = child.stdin.take().unwrap();
    stdin
        .write_all(&encode(&timeline, &synthetic::with_takeover(1.0)).bytes)
        .unwrap();
    drop(stdin);
    let output = child.wait_with_output().unwrap();
    assert!(output.status.success());
    let found: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    let threads: usize = timeline.cores.iter().map(|line| line.slices.len()).sum();
    assert_eq!(found["slices_of_cores"], threads);
    assert_eq!(found["flows"], timeline.flows.len());
    assert!(!timeline.flows.is_empty());
    let late: usize = timeline
        .cores
        .iter()
        .flat_map(|line| &line.slices)
        .filter(|slice| slice.late_ns.is_some())
        .count();
    assert_eq!(found["late"], late);
    assert_eq!(
        found["processes"],
        serde_json::json!(["system A", "system B", "vehicle"])
    );
}
