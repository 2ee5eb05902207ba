//! Measures activations of redundant clients as processes. `skew SECONDS SPIN_US`: how far apart
//! two clients wake, beside plain `clock_nanosleep` in the same cycles. `overruns SECONDS`: 1 kHz;
//! fails if an overrun is not explained by a stall of the machine.
#![allow(clippy::print_stdout, reason = "its output is its purpose")]
#![allow(clippy::unwrap_used, reason = "a measurement that cannot start ends")]

use std::collections::HashMap;
use std::process::{Child, Command, ExitCode, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use rustix::process::{Signal, set_parent_process_death_signal};
use tandem_board::{Duration, Instant};
use tandem_board_host::realtime::{Claim, claim};
use tandem_board_host::{clock, isolation};
use tandem_exec::master::Config;
use tandem_exec::message::{Activation, ClientId};
use tandem_exec_host::sync::{SyncClient, SyncMaster, SyncPlace, Wait};

const CLIENTS: usize = 2;
/// A watching thread that wakes later than this was stalled.
const LATE: Duration = Duration::from_us(200);
/// A watching thread sleeps for so long.
const WATCH_PERIOD: Duration = Duration::from_us(500);

fn config(period_us: u64) -> Config {
    let period = Duration::from_us(period_us);
    Config {
        clients: CLIENTS,
        quorum: CLIENTS,
        candidates: 1,
        period,
        lead: Duration::from_us(200),
        wait: Duration::from_us(period_us - 400),
        patience: Duration::from_ms(10_000),
        takeover: Duration::from_ms(50),
    }
}

fn main() -> ExitCode {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let args: Vec<&str> = args.iter().map(String::as_str).collect();
    let number = |text: &str| text.parse::<u64>().unwrap();
    match args[..] {
        ["skew", seconds, spin_us] => skew(number(seconds), spin_us),
        ["overruns", seconds] => return overruns(number(seconds)),
        ["--master", run, period_us] => {
            bind(60, None);
            let place = SyncPlace::open(&run.parse().unwrap(), "sync").unwrap();
            let first = ClientId::new(0).unwrap();
            let mut master = SyncMaster::attach(place, config(number(period_us)), first).unwrap();
            master.run(|_| {}, || false);
        }
        ["--client", run, id, period_us, cycles, spin_us] => {
            client(
                run,
                number(id),
                [number(period_us), number(cycles), number(spin_us)],
            );
        }
        _ => {
            println!("usage: activation skew SECONDS SPIN_US | activation overruns SECONDS");
            return ExitCode::FAILURE;
        }
    }
    ExitCode::SUCCESS
}

fn bind(priority: u8, cpu: Option<usize>) {
    set_parent_process_death_signal(Some(Signal::KILL)).unwrap();
    let granted = claim(Claim {
        priority: Some(priority),
        cpu,
        lock_memory: true,
    });
    eprintln!("{granted}");
}

/// Prints `cycle activation woken floor_at floor_woken overrun skipped missed` for each `Run`.
fn client(run: &str, id: u64, [period_us, cycles, spin_us]: [u64; 3]) {
    bind(50, Some(id as usize));
    let place = SyncPlace::open(&run.parse().unwrap(), "sync").unwrap();
    let wait = match spin_us {
        0 => Wait::Sleep,
        span => Wait::SpinLast(Duration::from_us(span)),
    };
    let mut client = SyncClient::attach(place, ClientId::new(id as usize).unwrap(), wait).unwrap();
    let mut rows = Vec::with_capacity(cycles as usize + 8);
    while let Ok(now) = client.wait_for_activation(0, Duration::from_ms(10_000)) {
        let woken = clock::now();
        let at = client.client().activation_time();
        // The floor needs half of the period: only where there is time for it.
        let floor_at = at + Duration::from_us(period_us / 2);
        if period_us >= 4_000 {
            wait.until(floor_at);
        }
        rows.push((now, at, woken, floor_at, clock::now()));
        if rows.len() as u64 >= cycles {
            client.client().set_done();
        }
        if now.code == Activation::Terminate {
            break;
        }
    }
    for (now, at, woken, floor_at, floor_woken) in rows {
        if now.code == Activation::Run {
            let times = [at, woken, floor_at, floor_woken].map(Instant::as_ns);
            let [at, woken, floor_at, floor_woken] = times;
            let (overrun, skipped, missed) = (now.overrun.as_ns(), now.skipped, now.missed);
            let cycle = now.cycle;
            println!("{cycle} {at} {woken} {floor_at} {floor_woken} {overrun} {skipped} {missed}");
        }
    }
}

/// Runs one master and the clients. Returns the rows of each client by cycle.
fn run(period_us: u64, cycles: u64, spin_us: &str) -> Vec<HashMap<u64, [u64; 7]>> {
    let isolation = isolation::enter_shared().unwrap();
    let _place = SyncPlace::create(isolation.run(), "sync").unwrap();
    let (run, period, cycles) = (
        isolation.run().as_str(),
        period_us.to_string(),
        cycles.to_string(),
    );
    let start = |args: &[&str]| -> Child {
        let mut command = Command::new(std::env::current_exe().unwrap());
        command
            .args(args)
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .spawn()
            .unwrap()
    };
    let mut master = start(&["--master", run, &period]);
    let ids = [0, 1].map(|id: usize| id.to_string());
    let clients = ids
        .each_ref()
        .map(|id| start(&["--client", run, id, &period, &cycles, spin_us]));
    let rows = clients.map(|client| {
        let told = client.wait_with_output().unwrap().stdout;
        let told = String::from_utf8(told).unwrap();
        let row = |line: &str| {
            let mut numbers = line.split(' ').map(|number| number.parse::<u64>().unwrap());
            (
                numbers.next().unwrap(),
                core::array::from_fn(|_| numbers.next().unwrap()),
            )
        };
        told.lines().map(row).collect()
    });
    let _ = master.kill();
    master.wait().unwrap();
    isolation.wipe();
    rows.into()
}

fn skew(seconds: u64, spin_us: &str) {
    let period_us = 4_000;
    let rows = run(period_us, seconds * 1_000_000 / period_us, spin_us);
    let [zero, one] = &rows[..] else { return };
    for (name, at) in [("skew", 1), ("floor", 3)] {
        let both = zero
            .iter()
            .filter_map(|(cycle, row)| Some((row[at], one.get(cycle)?[at])));
        let mut apart: Vec<u64> = both.map(|(one, two)| one.abs_diff(two)).collect();
        apart.sort_unstable();
        let of = |part: f64| apart[((apart.len() - 1) as f64 * part) as usize] as f64 * 1e-3;
        let [p50, p90, p99, p999, max] = [0.5, 0.9, 0.99, 0.999, 1.0].map(of);
        println!(
            "{name:5} spin {spin_us} µs: p50 {p50:.1} p90 {p90:.1} p99 {p99:.1} p99.9 {p999:.1} max {max:.1} µs, {} cycles",
            apart.len()
        );
    }
}

/// Watches one CPU: the times in which a thread that is more urgent than all got no CPU.
fn watch(cpu: usize, over: &AtomicBool) -> Vec<[u64; 2]> {
    claim(Claim {
        priority: Some(90),
        cpu: Some(cpu),
        lock_memory: false,
    });
    let mut stalls = vec![];
    while !over.load(Ordering::Relaxed) {
        let due = clock::now() + WATCH_PERIOD;
        clock::sleep_until(due);
        let woken = clock::now();
        if woken.since(due) > LATE {
            stalls.push([due.as_ns(), woken.as_ns()]);
        }
    }
    stalls
}

fn overruns(seconds: u64) -> ExitCode {
    let over = Arc::new(AtomicBool::new(false));
    let watchers: Vec<_> = (0..2)
        .map(|cpu| {
            let over = Arc::clone(&over);
            std::thread::spawn(move || watch(cpu, &over))
        })
        .collect();
    let rows = run(1_000, seconds * 1_000, "0");
    over.store(true, Ordering::Relaxed);
    let stalls: Vec<_> = watchers
        .into_iter()
        .flat_map(|thread| thread.join().unwrap())
        .collect();
    let (mut cycles, mut all, mut bare) = (0, 0, 0);
    for (id, rows) in rows.iter().enumerate() {
        cycles += rows.len();
        for (cycle, &[at, woken, _, _, overrun, skipped, missed]) in rows {
            if overrun == 0 && skipped == 0 && missed == 0 {
                continue;
            }
            all += 1;
            // From the activation before, of all clients, to this one.
            let from = at - 1_000_000 * (2 + skipped + missed);
            if !stalls
                .iter()
                .any(|&[begin, end]| begin < woken && end > from)
            {
                bare += 1;
                println!(
                    "not explained: client {id} cycle {cycle}: overrun {overrun} ns, skipped {skipped}, missed {missed}"
                );
            }
        }
    }
    println!(
        "{cycles} activations, {all} with an overrun, {} stalls, {bare} not explained",
        stalls.len()
    );
    if bare == 0 {
        ExitCode::SUCCESS
    } else {
        ExitCode::FAILURE
    }
}
