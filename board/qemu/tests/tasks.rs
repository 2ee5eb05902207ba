//! Core 0's tasks in the controller's image: FreeRTOS runs them by priority, in every incarnation
//! of the core. Needs QEMU and the images, so only `cargo xtask firmware test` runs it.
#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    reason = "all of it is a test"
)]

use std::net::Ipv4Addr;
use std::path::PathBuf;

use tandem_board::{CoreId, Instant, RoleLamp, SystemId, VehiclePort};
use tandem_board_qemu::{EmulatedWorld, MachineOptions, WorldLayout};
use tandem_board_udp::UdpPlace;
use tandem_cores::core0::Core0Task;
use tandem_cores::task_table::{CORE_0, TaskCode};
use tandem_cores::trace::{Begin, Event, Leaves};

/// Virtual time of a run, ms. Without sensors a system waits two seconds before it begins.
const RUN_MS: u64 = 6_000;

/// Encodes strap `Third` of the image: every `every`-th job of `task` takes `ms` longer.
fn overload(task: Core0Task, ms: u8, every: u16) -> u32 {
    let [low, high] = every.to_le_bytes();
    u32::from_le_bytes([task as u8 + 1, ms, low, high])
}

/// Runs with this overload; returns the trace of core 0 of system A and its firmware's log.
fn run(overload: u32) -> (Vec<(Instant, Event)>, String) {
    let images = std::env::var_os("TANDEM_IMAGES").expect("cargo xtask firmware test sets it");
    let image = PathBuf::from(images).join("controller");
    let layout = WorldLayout::Two;
    let options = MachineOptions {
        reintegrate: true,
        overload,
        ..MachineOptions::default()
    };
    let mut world = EmulatedWorld::start(&image, layout, options).unwrap();
    // The topics task works only with a network. The address is of these tests alone.
    let place = UdpPlace::new(226, Ipv4Addr::new(127, 77, 3, 2)).unwrap();
    world.connect_network(place).unwrap();
    world.step().unwrap();
    world.set_ignition(true);
    let mut events = vec![];
    for _ in 0..RUN_MS {
        world.step().unwrap();
        let lost = world.drain_trace(&mut |traced| {
            if traced.system == SystemId::A && traced.core == CoreId::CONTROL {
                let event = Event::decode(traced.record).expect("core 0 writes events");
                events.push((traced.at, event));
            }
        });
        assert_eq!(lost, 0, "the trace has gaps");
    }
    for info in &CORE_0 {
        let free = events.iter().filter_map(|(_, event)| match event {
            Event::Stack { task, free_bytes } if *task == info.code => Some(*free_bytes),
            _ => None,
        });
        // The stack has 16 KiB; each task reports its free bytes once per second.
        let free = free.min().expect("a report");
        assert!(free > 4 << 10, "{}: {free} bytes of stack left", info.name);
    }
    assert_ne!(world.role(SystemId::B), RoleLamp::Starting);
    (events, world.end().unwrap())
}

/// A job, from start to end.
struct Job {
    task: TaskCode,
    from: Instant,
    to: Instant,
    /// Tasks that ran during the job.
    within: Vec<TaskCode>,
}

/// Returns all jobs that have ended, in the order in which they started.
fn jobs(events: &[(Instant, Event)]) -> Vec<Job> {
    let mut open: Vec<Job> = vec![];
    let mut done = vec![];
    for (at, event) in events {
        match *event {
            Event::TaskIn { task, begin } => {
                let goes_on = begin == Begin::Goes && open.iter().any(|job| job.task == task);
                for job in open.iter_mut().filter(|job| job.task != task) {
                    job.within.push(task);
                }
                if !goes_on {
                    let (from, to, within) = (*at, *at, vec![]);
                    open.push(Job {
                        task,
                        from,
                        to,
                        within,
                    });
                }
            }
            Event::TaskOut {
                task,
                leaves: Leaves::Done,
            } => {
                let at_end = |job: &mut Job| job.task == task;
                done.extend(
                    open.extract_if(.., at_end)
                        .map(|job| Job { to: *at, ..job }),
                );
            }
            // A job of the previous incarnation never ends.
            Event::Started { .. } => open.clear(),
            _ => {}
        }
    }
    done
}

/// T-RTOS-4: a task that works for 20 ms delays all less urgent tasks, but none that is more
/// urgent. Here it is the controller's control task: every 20th job takes 20 ms longer.
#[test]
#[ignore = "needs QEMU and the images: cargo xtask firmware test"]
fn a_burning_control_task_holds_up_only_what_is_less_urgent() {
    let (events, _) = run(overload(Core0Task::Control, 20, 20));
    let jobs = jobs(&events);
    let control = Core0Task::Control.info();
    let burning = |job: &&Job| job.task == control.code && job.to.since(job.from).as_us() >= 20_000;
    let burned: Vec<&Job> = jobs.iter().filter(burning).collect();
    assert!(burned.len() >= 10, "only {} jobs burned", burned.len());
    for job in &burned {
        let ran = |info: &&tandem_cores::task_table::TaskInfo| {
            job.within.iter().filter(|task| **task == info.code).count()
        };
        for info in &CORE_0 {
            if info.priority < control.priority {
                assert_eq!(ran(&info), 0, "{} ran at {:?}", info.name, job.from);
            } else if info.priority > control.priority {
                // More urgent tasks run as often as without the load: monitoring every 5 ms, the
                // roles at least every 2 ms.
                let least = if info.code == TaskCode::ROLES { 10 } else { 3 };
                assert!(ran(&info) >= least, "{}: {} times", info.name, ran(&info));
            }
        }
    }
    // Some less urgent tasks were released in that time and had to wait.
    let waited = events.iter().filter(|(at, event)| match event {
        Event::Ready { task } => {
            let within = |job: &&&Job| job.from < *at && *at < job.to;
            let info = Core0Task::of(*task).map(Core0Task::info);
            info.is_some_and(|info| info.priority < control.priority)
                && burned.iter().find(within).is_some()
        }
        _ => false,
    });
    assert!(waited.count() > 0, "nothing less urgent was released");
    // The less urgent tasks run between the long jobs.
    for task in [TaskCode::STATUS, TaskCode::MONITORING, TaskCode::ROLES] {
        assert!(jobs.iter().any(|job| job.task == task));
    }
}

/// A reset of the core does not end FreeRTOS: the kernel starts again in each incarnation. Here
/// every 600th job of monitoring takes 100 ms longer, so the watchdog is serviced too late.
#[test]
#[ignore = "needs QEMU and the images: cargo xtask firmware test"]
fn the_kernel_runs_again_after_a_reset_of_the_core() {
    let (events, log) = run(overload(Core0Task::Monitoring, 100, 600));
    let incarnations: Vec<(Instant, u32)> = events
        .iter()
        .filter_map(|(at, event)| match event {
            Event::Started { generation, .. } => Some((*at, *generation)),
            _ => None,
        })
        .collect();
    let numbers: Vec<u32> = incarnations.iter().map(|(_, number)| *number).collect();
    assert_eq!(numbers, [1, 2], "incarnations of core 0: {log}");
    let jobs = jobs(&events);
    for (incarnation, (begin, number)) in incarnations.iter().enumerate() {
        let end = incarnations
            .get(incarnation + 1)
            .map_or(Instant::NEVER, |next| next.0);
        let of_incarnation = |job: &&Job| *begin <= job.from && job.from < end;
        for task in [
            Core0Task::Roles,
            Core0Task::Monitoring,
            Core0Task::Control,
            Core0Task::Status,
        ] {
            let code = task.info().code;
            let count = jobs
                .iter()
                .filter(of_incarnation)
                .filter(|job| job.task == code)
                .count();
            assert!(
                count > 5,
                "{count} jobs of {task:?} in incarnation {number}"
            );
        }
        // Only the kernel makes tasks ready.
        let of_kernel = |(at, event): &&(Instant, Event)| {
            *begin <= *at && *at < end && matches!(event, Event::Ready { .. })
        };
        let ready = events.iter().filter(of_kernel).count();
        assert!(
            ready > 100,
            "{ready} releases by the kernel in incarnation {number}"
        );
        let says = format!("core 0 of A runs its tasks under FreeRTOS, incarnation {number}");
        assert!(log.contains(&says), "{log}");
    }
}
