//! Activation skew: how far apart two processes on two CPUs begin the same cycle.

use crate::clock::{monotonic_ns, sleep_until};
use crate::harness::{Batch, BatchPlan, next_run};
use crate::shared::{Log, SharedPage};
use crate::worker::{BatchPart, ask_for_fifo, perform};
use std::hint::spin_loop;
use std::io;
use std::ops::Range;
use tandem_board::{Duration, Instant};
use tandem_board_host::clock::now;
use tandem_exec::client::Activated;
use tandem_exec::master::Config;
use tandem_exec::message::{Activation, ClientId};
use tandem_exec_client::sync::{SyncClient, SyncMaster, SyncPlace};

/// Period of the cycles, ns.
pub(super) const PERIOD_NS: u64 = 1_000_000;
/// The last part of a wait that may be spent spinning, ns.
pub(crate) const SPIN_NS: u64 = 100_000;
pub(super) const CONFIG: Config = Config {
    clients: 2,
    quorum: 2,
    candidates: 1,
    period: Duration::from_ns(PERIOD_NS),
    lead: Duration::from_us(200),
    wait: Duration::from_us(500),
    patience: Duration::from_ms(5_000),
    takeover: Duration::from_ms(100),
};
/// The first activations are not of the kind `Run`.
const FIRST_CYCLE: u64 = 10;
const GIVE_UP: Duration = Duration::from_ms(5_000);
/// In the log, of a cycle that the client did not run.
const MISSED: u32 = u32::MAX;

/// Two processes that sleep with `clock_nanosleep` until the same instants, and spin for the last
/// `spin_ns`: what no synchronisation can improve.
pub(crate) fn floor(plan: &BatchPlan, spin_ns: u64) -> io::Result<Batch> {
    let shared = SharedPage::new()?;
    let begin_ns = monotonic_ns() + 20 * PERIOD_NS;
    let part = |cpu: usize| {
        BatchPart::on(plan.cpus[cpu], move |role| {
            ask_for_fifo();
            for cycle in 0..(plan.warm_up + plan.rounds) as u64 {
                let due_ns = begin_ns + cycle * PERIOD_NS;
                sleep_until(due_ns - spin_ns);
                while monotonic_ns() < due_ns {
                    spin_loop();
                }
                let late_ns = monotonic_ns() - due_ns;
                if cycle >= plan.warm_up as u64 {
                    role.log.push(0, u32::try_from(late_ns).unwrap_or(u32::MAX));
                }
            }
            Ok(())
        })
    };
    perform(&shared, vec![part(0), part(1)])?;
    Ok(skew_of(&shared))
}

/// Two deterministic clients of a sync master, which spin for the last `spin_ns` of a wait; the
/// master runs beside them.
/// A sample is the difference of their lateness in a cycle that both ran.
pub(crate) fn clients(plan: &BatchPlan, spin_ns: u64) -> io::Result<Batch> {
    let shared = SharedPage::new()?;
    let system = plan.system.ok_or(io::ErrorKind::NotFound)?;
    let place = SyncPlace::create(system.run(), &format!("sync-{}", next_run()));
    let place = place.map_err(io::Error::other)?;
    let first = FIRST_CYCLE + plan.warm_up as u64;
    let cycles = first..first + plan.rounds as u64;
    let client = |number: usize| {
        let cycles = cycles.clone();
        BatchPart::on(plan.cpus[number], move |role| {
            ask_for_fifo();
            let id = ClientId::new(number).ok_or(io::ErrorKind::InvalidInput)?;
            let mut client = SyncClient::attach(place, id).map_err(io::Error::other)?;
            client.spin = Duration::from_ns(spin_ns);
            log_cycles(client, cycles, &mut role.log)
        })
    };
    let master = BatchPart::on(plan.cpus[0], move |_| {
        ask_for_fifo();
        let id = ClientId::new(0).ok_or(io::ErrorKind::InvalidInput)?;
        let mut master = SyncMaster::attach(place, CONFIG, id).map_err(io::Error::other)?;
        master.run(|_| (), || false);
        Ok(())
    });
    perform(&shared, vec![client(0), client(1), master])?;
    Ok(skew_of(&shared))
}

/// Logs the lateness in each of these cycles, and ends when all clients do.
fn log_cycles(client: SyncClient, cycles: Range<u64>, log: &mut Log) -> io::Result<()> {
    follow(client, cycles.end, |activated, at, woken| {
        let missed = activated.cycle - activated.missed..activated.cycle;
        missed
            .filter(|cycle| cycles.contains(cycle))
            .for_each(|_| log.push(0, MISSED));
        if cycles.contains(&activated.cycle) {
            let late_ns = woken.since(at).as_ns();
            log.push(0, u32::try_from(late_ns).unwrap_or(u32::MAX - 1));
        }
    })
}

/// Tells each activation with its time and the time after the wake-up, until all clients end; from
/// cycle `last` on, this client is done.
pub(super) fn follow(
    mut client: SyncClient,
    last: u64,
    mut tell: impl FnMut(&Activated, Instant, Instant),
) -> io::Result<()> {
    loop {
        let activated = client.wait_for_activation(0, GIVE_UP);
        let woken = now();
        let activated = activated.map_err(io::Error::other)?;
        tell(&activated, client.client().activation_time(), woken);
        if activated.cycle >= last {
            client.client().set_done();
        }
        if activated.code == Activation::Terminate {
            return Ok(());
        }
    }
}

/// The difference between both processes' lateness in each cycle; parts 0 and 1 have logged it, ns.
pub(crate) fn skew_of(shared: &SharedPage) -> Batch {
    let [first, second] = [0, 1].map(|number| shared.log(number));
    let both = first.samples(0).zip(second.samples(0));
    let (mut samples_ps, mut late_ns) = (vec![], 0);
    for (a, b) in both.filter(|(a, b)| *a != MISSED && *b != MISSED) {
        // 0 would be below the clock's resolution.
        samples_ps.push(u64::from(a.abs_diff(b)).max(1) * 1000);
        late_ns = a.max(b).max(late_ns);
    }
    Batch {
        samples_ps,
        ..Batch::default()
    }
    .with_fact("longest lateness, us", f64::from(late_ns) / 1e3)
}
