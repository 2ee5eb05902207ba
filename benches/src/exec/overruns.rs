//! Overruns of activations beside stalls of the machine, which must explain each of them.

use super::skew::{CONFIG, PERIOD_NS, follow};
use crate::shared::{Log, SharedPage};
use crate::worker::{BatchPart, perform_within, pin};
use std::io;
use std::sync::atomic::AtomicU32;
use std::sync::atomic::Ordering::Relaxed;
use std::time::Duration as Time;
use tandem_board::{Duration, Instant};
use tandem_board_host::RunName;
use tandem_board_host::clock::{now, sleep_until};
use tandem_board_host::realtime::{Claim, claim};
use tandem_exec::message::{Activation, ClientId};
use tandem_exec_client::sync::{SyncClient, SyncMaster, SyncPlace};

/// A watching thread that wakes later than this was stalled.
const LATE: Duration = Duration::from_us(200);
/// How long a watching thread sleeps.
const WATCH_PERIOD: Duration = Duration::from_us(500);
/// Priorities under SCHED_FIFO: the watch is more urgent than all that it watches.
const CLIENT: u8 = 50;
const MASTER: u8 = 60;
const WATCH: u8 = 90;
/// The part that watches. Its log has the stalls, those of clients have overruns.
const WATCHER: usize = 3;
/// Notes of a part: the activations of a client, those with an overrun, and the priority it got.
const RUNS: usize = 0;
const OVERRUNS: usize = 1;
const PRIORITY: usize = 2;
/// How long all may take besides.
const BESIDES: Time = Time::from_secs(30);

/// Runs two redundant clients at 1 kHz, each on one of the CPUs, for this time. Returns a line of
/// figures, and the number of overruns during which no CPU was stalled.
pub(crate) fn run(run: &RunName, cpus: [usize; 2], seconds: u16) -> io::Result<(String, f64)> {
    let shared = SharedPage::new()?;
    let place = SyncPlace::create(run, "sync").map_err(io::Error::other)?;
    let cycles = u64::from(seconds) * 1_000_000_000 / PERIOD_NS;
    let begin = now();
    let client = |number: usize| {
        BatchPart::on(cpus[number], move |role| {
            urgent(CLIENT, &role.log);
            let client = SyncClient::attach(place, id(number)?);
            log_overruns(
                client.map_err(io::Error::other)?,
                cycles,
                begin,
                &mut role.log,
            )?;
            role.shared.flag.fetch_add(1, Relaxed);
            Ok(())
        })
    };
    let master = BatchPart::on(cpus[0], |role| {
        urgent(MASTER, &role.log);
        let master = SyncMaster::attach(place, CONFIG, id(0)?);
        master.map_err(io::Error::other)?.run(|_| (), || false);
        Ok(())
    });
    let watch = BatchPart::on(cpus[0], |role| {
        let over = &role.shared.flag;
        let stalls = std::thread::scope(|scope| {
            let watchers = cpus.map(|cpu| scope.spawn(move || watch(cpu, over)));
            watchers.map(|thread| thread.join().unwrap_or_default())
        });
        let stalls = stalls.into_iter().flatten();
        stalls.for_each(|[from, to]| log_span(&mut role.log, begin, from, to));
        Ok(())
    });
    let limit = BESIDES + Time::from_secs(seconds.into());
    perform_within(limit, &shared, vec![client(0), client(1), master, watch])?;
    Ok(summary(&shared))
}

fn id(number: usize) -> io::Result<ClientId> {
    ClientId::new(number).ok_or(io::ErrorKind::InvalidInput.into())
}

/// Claims real time for this thread, and notes what it got.
fn urgent(priority: u8, log: &Log) {
    let granted = claim(Claim {
        priority: Some(priority),
        cpu: None,
        lock_memory: true,
    });
    log.note(PRIORITY, granted.fifo.unwrap_or(0).into());
}

/// Logs a span of time, in us since `begin`: a little longer rather than shorter.
fn log_span(log: &mut Log, begin: Instant, from: Instant, to: Instant) {
    let us = |at: Instant| u32::try_from(at.since(begin).as_us()).unwrap_or(u32::MAX);
    log.push(0, us(from));
    log.push(1, us(to).saturating_add(1));
}

/// Logs the time of each overrun: from the activation of all clients before it to the wake-up.
fn log_overruns(client: SyncClient, cycles: u64, begin: Instant, log: &mut Log) -> io::Result<()> {
    let (mut runs, mut overruns) = (0.0, 0.0);
    follow(client, cycles, |activated, at, woken| {
        if activated.code != Activation::Run {
            return;
        }
        runs += 1.0;
        if !activated.is_punctual() {
            overruns += 1.0;
            let periods = 2 + u64::from(activated.skipped) + activated.missed;
            let from = at.as_ns().saturating_sub(periods * PERIOD_NS);
            log_span(log, begin, Instant::from_ns(from), woken);
        }
    })?;
    log.note(RUNS, runs);
    log.note(OVERRUNS, overruns);
    Ok(())
}

/// Watches a CPU until both clients have ended: the times in which the most urgent thread did not
/// get it.
fn watch(cpu: usize, over: &AtomicU32) -> Vec<[Instant; 2]> {
    pin(cpu);
    claim(Claim {
        priority: Some(WATCH),
        cpu: None,
        lock_memory: false,
    });
    let mut stalls = vec![];
    while over.load(Relaxed) < 2 {
        let due = now() + WATCH_PERIOD;
        sleep_until(due);
        let woken = now();
        if woken.since(due) > LATE {
            stalls.push([due, woken]);
        }
    }
    stalls
}

fn summary(shared: &SharedPage) -> (String, f64) {
    let spans = |number| {
        let log = shared.log(number);
        let spans: Vec<(u32, u32)> = log.samples(0).zip(log.samples(1)).collect();
        spans
    };
    let stalls = spans(WATCHER);
    let is_explained = |(from, to): &(u32, u32)| stalls.iter().any(|it| it.0 < *to && it.1 > *from);
    let explained = [0, 1].map(|client| spans(client).iter().filter(|it| is_explained(it)).count());
    let sum = |note| shared.log(0).noted(note) + shared.log(1).noted(note);
    let [runs, overruns] = [RUNS, OVERRUNS].map(sum);
    // A span that found no room in its log is not explained either.
    let bare = overruns - explained.iter().sum::<usize>() as f64;
    let is_urgent = (0..WATCHER).all(|part| shared.log(part).noted(PRIORITY) > 0.0);
    let priority = if is_urgent { "under" } else { "without" };
    let text = format!(
        "{runs} activations {priority} SCHED_FIFO, {overruns} with an overrun, {} stalls, \
         {bare} not explained\n",
        stalls.len()
    );
    (text, bare)
}
