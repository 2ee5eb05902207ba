//! The experiments in virtual time: both systems and the vehicle in one process.

use std::cell::RefCell;
use std::rc::Rc;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Instant as Wall;

use anyhow::ensure;
use tandem_board::{Board, CoreId, Duration, Generation, Instant, ResetCause, RoleLamp, SystemId};
use tandem_board_sim::{Config, Poller, SimBoard, SimPair, blocking};
use tandem_record::{Entry, RunLog};
use tandem_shm::incarnation::Incarnation;
use tandem_shm::mailbox::{Call, TaskId, TaskTable};
use tandem_shm::map::Map;
use tandem_sim::drive::poller;
use tandem_vehicle::{Scenario, World};

use super::outputs::Done;
use super::two_cores::{Counted, Exchange, LAYOUT, LOCK, MAILBOX, payload};

/// Index of the LMU word that both cores increment. It is after the regions.
const COUNTER_AT: usize = 8191;
/// Delay of switching A on after B, as in the thesis.
const STAGGER: Duration = Duration::from_ms(40);
const STEP: Duration = Duration::from_ms(10);

/// Runs the pair until `reached` returns true. Fails after `limit`.
fn until(
    pair: &mut SimPair,
    log: &Rc<RefCell<RunLog>>,
    limit: Duration,
    reached: impl Fn(&SimPair) -> bool,
) -> anyhow::Result<()> {
    let end = pair.now() + limit;
    while !reached(pair) {
        ensure!(
            pair.now() < end,
            "the systems did not reach the state within {limit:?}"
        );
        pair.run_for(STEP);
        keep(pair, log);
    }
    Ok(())
}

fn keep(pair: &mut SimPair, log: &Rc<RefCell<RunLog>>) {
    let (traced, _) = pair.take_trace();
    let mut log = log.borrow_mut();
    traced
        .into_iter()
        .for_each(|traced| log.push(Entry::Trace(traced)));
    pair.take_bus_log();
}

/// Records a staggered start and two takeovers. A is reset. After it has returned as standby, B
/// loses its power.
pub(super) fn takeovers() -> anyhow::Result<(RunLog, Done)> {
    let mut config = tandem_cores::Config::rt();
    config.redundancy.reintegrate = true;
    let scenario = Scenario::load("free-lane")?;
    let mut world = World::new(&scenario, tandem_vehicle::WorldConfig { seed: 1 });
    let log = Rc::new(RefCell::new(RunLog::default()));
    let mut pair = SimPair::new(Config::default(), move |board| poller(board, config));
    let shared = Rc::clone(&log);
    pair.set_world(move |tick| {
        let mut log = shared.borrow_mut();
        world.run_period(tick.at, tick, &mut |frame| log.push(Entry::Frame(frame)));
    });
    pair.power_on(SystemId::B);
    pair.run_for(STAGGER);
    pair.power_on(SystemId::A);

    let lamps = |pair: &SimPair| SystemId::ALL.map(|system| pair.lamp(system));
    let limit = Duration::from_ms(10_000);
    let second = Duration::from_ms(1_000);
    let dual = [Some(RoleLamp::Master), Some(RoleLamp::Standby)];
    until(&mut pair, &log, limit, |pair| lamps(pair) == dual)?;
    // Use a time that is not aligned to the periodic tasks.
    pair.run_for(second + Duration::from_us(3_700));
    keep(&mut pair, &log);
    let reset_ns = pair.now().as_ns();
    pair.reset(SystemId::A, ResetCause::Trap);
    let swapped = [Some(RoleLamp::Standby), Some(RoleLamp::Master)];
    until(&mut pair, &log, limit, |pair| lamps(pair) == swapped)?;
    pair.run_for(second + Duration::from_us(6_100));
    keep(&mut pair, &log);
    let off_ns = pair.now().as_ns();
    pair.power_off(SystemId::B);
    pair.run_for(second);
    keep(&mut pair, &log);
    let mut log = log.take();
    log.sort();
    Ok((log, Done { reset_ns, off_ns }))
}

/// Builds a pair in which only cores 0 and 1 of system A run, with these programs.
fn two_cores(core_0: impl FnMut(&SimBoard) -> Poller + 'static) -> SimPair {
    let config = Config {
        watchdog: false,
        ..Config::default()
    };
    let mut make = core_0;
    let mut pair = SimPair::new(config, move |board| {
        let identity = board.identity();
        if identity.core == CoreId::CONTROL {
            board.release_core(CoreId::PERCEPTION);
        }
        if identity.system == SystemId::A && identity.core != CoreId::PLANNING {
            make(board)
        } else {
            Box::new(|_| Instant::NEVER)
        }
    });
    pair.power_on(SystemId::A);
    pair
}

/// Attaches a core of system A to its LMU. Core 0 formats the LMU.
fn attach(board: &SimBoard) -> Option<(Map<'_>, Incarnation)> {
    let identity = board.identity();
    let map = match Map::attach(board.lmu(), LAYOUT) {
        Ok(map) => map,
        Err(_) if identity.core == CoreId::CONTROL => Map::format(board.lmu(), LAYOUT).ok()?,
        Err(_) => return None,
    };
    let Generation(generation) = identity.generation;
    let incarnation = Incarnation::new(identity.core.index(), generation)?;
    map.incarnations().announce(incarnation).ok()?;
    Some((map, incarnation))
}

#[derive(Default)]
struct Messages {
    sent: Vec<(u32, f64)>,
    received: Vec<(u32, f64)>,
}

/// Makes core 0 send 4 bytes every millisecond and ring the doorbell. This wakes core 1, whose task
/// receives the bytes. The time of an exchange is the execution time of both ends on this machine,
/// because virtual time does not advance while a core computes.
pub(super) fn exchanges(count: u32) -> anyhow::Result<Vec<Exchange>> {
    let messages = Arc::new(Mutex::new(Messages::default()));
    let shared = Arc::clone(&messages);
    let mut pair = two_cores(move |board| {
        let board: &'static SimBoard = Box::leak(Box::new(board.clone()));
        let notes = Arc::clone(&shared);
        let note = move |act: &dyn Fn(&mut Messages)| {
            act(&mut notes.lock().unwrap_or_else(PoisonError::into_inner));
        };
        if board.identity().core == CoreId::CONTROL {
            let ends = attach(board).and_then(|(map, own)| MAILBOX.sender(&map, own).ok());
            let (mut to, mut number) = (ends, 0);
            return Box::new(move |board| {
                let Some(to) = to.as_mut().filter(|_| number <= count) else {
                    return Instant::NEVER;
                };
                // Skip the first poll, in which core 0 starts: core 1 does not run yet.
                if number > 0 {
                    let data = payload(number);
                    let begin = Wall::now();
                    if to.signal_with(TaskId::FIRST, data) == tandem_shm::mailbox::Ring::Needed {
                        board.ring(CoreId::PERCEPTION);
                    }
                    let took_ns = begin.elapsed().as_nanos() as f64;
                    note(&|notes| notes.sent.push((data, took_ns)));
                }
                number += 1;
                board.now() + Duration::from_ms(1)
            });
        }
        let mut table = TaskTable::<Vec<u32>>::new();
        let task = |got: &mut Vec<u32>, _, call: Call| got.push(call.value);
        let added = table.add(TaskId::FIRST, task, 0).is_ok();
        let mut from = attach(board)
            .filter(|_| added)
            .and_then(|(map, own)| MAILBOX.receiver(&map, own).ok());
        let mut got = Vec::new();
        Box::new(move |board| {
            if let Some(from) = &mut from {
                let begin = Wall::now();
                from.awake();
                table.run(from, &mut got);
                let took_ns = begin.elapsed().as_nanos() as f64;
                for value in got.drain(..) {
                    note(&|notes| notes.received.push((value, took_ns)));
                }
                if !from.prepare_sleep() {
                    return board.now();
                }
            }
            Instant::NEVER
        })
    });
    pair.run_for(Duration::from_ms(u64::from(count) + 5));
    let messages = messages.lock().unwrap_or_else(PoisonError::into_inner);
    let pairs = messages.sent.iter().zip(&messages.received);
    Ok(pairs
        .map(|((sent, first_ns), (received, then_ns))| Exchange {
            sent: *sent,
            received: *received,
            took_ns: first_ns + then_ns,
        })
        .collect())
}

/// Makes cores 0 and 1 increment one counter `each` times. Between reading and writing back, each
/// core reads its clock, during which the other core can run.
pub(super) fn counter(each: u32, locked: bool) -> anyhow::Result<Counted> {
    let seen = Arc::new(Mutex::new([Vec::new(), Vec::new()]));
    let shared = Arc::clone(&seen);
    let mut pair = two_cores(move |board| {
        let seen = Arc::clone(&shared);
        blocking(board, move |board| {
            let Some((map, own)) = attach(board) else {
                return;
            };
            let Ok(mut lock) = LOCK.attach(&map, own) else {
                return;
            };
            let counter = &board.lmu()[COUNTER_AT];
            for _ in 0..each {
                let read_clock = |_pauses| {
                    board.now();
                };
                let guard = locked.then(|| lock.lock(u32::MAX, read_clock));
                let value = counter.load(std::sync::atomic::Ordering::Relaxed) + 1;
                board.now();
                counter.store(value, std::sync::atomic::Ordering::Relaxed);
                drop(guard);
                let mut seen = seen.lock().unwrap_or_else(PoisonError::into_inner);
                seen[board.identity().core.index()].push(value);
                drop(seen);
                board.now();
            }
        })
    });
    pair.run_for(Duration::from_ms(100));
    let counter = pair.lmu(SystemId::A)[COUNTER_AT].load(std::sync::atomic::Ordering::Relaxed);
    let seen = seen.lock().unwrap_or_else(PoisonError::into_inner).clone();
    ensure!(
        seen.iter().all(|seen| seen.len() == each as usize),
        "a core did not finish its increments: {seen:?}"
    );
    Ok(Counted {
        increments: 2 * each,
        counter,
        seen: seen.map(|seen| seen.into_iter().take(10).collect()),
    })
}
