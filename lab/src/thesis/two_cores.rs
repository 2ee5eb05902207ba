//! Two experiments with two cores, which are processes on two CPUs: a core sends 4 bytes to a task
//! that polls, and both increment a counter without and with the lock. T-SYNC-4, T-LOCK-2
#![allow(
    clippy::expect_used,
    reason = "a core that cannot start panics; its process dies, and the experiment fails"
)]

use std::io;
use std::sync::atomic::{AtomicU32, Ordering};

use tandem_shm::mailbox::{Call, Ring, TaskId, TaskTable};
use tandem_shm::map::Layout;
use tandem_shm::region::{Mailbox, Region, SharedLock};
use tandem_shm::sync::spin;
use tandem_two_cores::clock::{from_ns, ticks, to_ps};
use tandem_two_cores::shared::{Log, SharedPage, announce};
use tandem_two_cores::worker::{BatchPart, PartContext, perform};

pub(super) const MAILBOX: Region<Mailbox> = Region::first("mailbox 0 to 1");
pub(super) const LOCK: Region<SharedLock> = MAILBOX.then("lock");
pub(super) const LAYOUT: Layout = LOCK.end();
/// Time between two messages, ns. The receiver already polls when one is sent.
const PAUSE_NS: u64 = 20_000;
/// After this many polls without a message the receiver yields the CPU.
const POLLS: u32 = 1 << 16;

/// One message of 4 bytes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Exchange {
    /// The value that core 0 sent.
    pub(super) sent: u32,
    /// The value that the task on core 1 received.
    pub(super) received: u32,
    /// Time from the sender's call to the first line of the task, ns.
    pub(super) took_ns: f64,
}

/// Returns the data of a message: the number in the lowest byte, as in the thesis.
pub(super) fn payload(number: u32) -> u32 {
    u32::from_le_bytes([number as u8, 1, 2, 3])
}

/// Sends `count` different messages from core 0, each received by a task of core 1. The cores are
/// processes on these CPUs and wait by spinning.
pub(super) fn exchanges(cpus: [usize; 2], count: u32) -> io::Result<Vec<Exchange>> {
    let (shared, map) = SharedPage::with_lmu(LAYOUT)?;
    let sender = BatchPart::on(cpus[0], |role: &mut PartContext<'_>| {
        let mut to = MAILBOX.sender(&map, announce(&map, 0, 1)).expect("it fits");
        role.shared.meet(2);
        for number in 1..=count {
            pause(PAUSE_NS);
            let data = payload(number);
            let at = ticks();
            // The receiver spins, so no doorbell is needed.
            let _: Ring = to.signal_with(TaskId::FIRST, data);
            role.log.push(0, data);
            role.log.push(1, at);
            // Acquire pairs with the receiver's release.
            while role.shared.flag.load(Ordering::Acquire) != number {
                spin(1);
            }
        }
        Ok(())
    });
    let receiver = BatchPart::on(cpus[1], |role: &mut PartContext<'_>| {
        let mut from = MAILBOX
            .receiver(&map, announce(&map, 1, 1))
            .expect("it fits");
        let mut table = TaskTable::new();
        let task = |log: &mut Log, _, call: Call| {
            log.push(1, ticks());
            log.push(0, call.value);
        };
        table.add(TaskId::FIRST, task, 0).expect("it is free");
        from.awake();
        role.shared.meet(2);
        for number in 1..=count {
            let mut polls = 0;
            while table.run(&mut from, &mut role.log) == 0 {
                polls += 1;
                if polls % POLLS == 0 {
                    std::thread::yield_now();
                }
            }
            role.shared.flag.store(number, Ordering::Release);
        }
        Ok(())
    });
    perform(&shared, vec![sender, receiver])?;
    let of = |part: usize, track: usize| shared.log(part).samples(track).collect::<Vec<_>>();
    let (sent, received) = (
        of(0, 0).into_iter().zip(of(0, 1)),
        of(1, 0).into_iter().zip(of(1, 1)),
    );
    Ok(sent
        .zip(received)
        .map(|((sent, from), (received, to))| Exchange {
            sent,
            received,
            took_ns: to_ps(to.wrapping_sub(from)) as f64 * 1e-3,
        })
        .collect())
}

fn pause(ns: u64) {
    let since = ticks();
    while ticks().wrapping_sub(since) < from_ns(ns) {
        spin(1);
    }
}

/// The result of two cores incrementing one counter.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Counted {
    /// Increments of both cores together.
    pub(super) increments: u32,
    /// The counter at the end.
    pub(super) counter: u32,
    /// The first values that core 0 and core 1 read from the counter after their increments.
    pub(super) seen: [Vec<u32>; 2],
}

impl Counted {
    /// Returns the number of lost increments.
    pub(super) const fn lost(&self) -> u32 {
        self.increments - self.counter
    }
}

/// Makes two cores, which are processes on these CPUs, increment one counter `each` times, with or
/// without the lock.
pub(super) fn counter(cpus: [usize; 2], each: u32, locked: bool) -> io::Result<Counted> {
    let (shared, map) = SharedPage::with_lmu(LAYOUT)?;
    let part = |core: usize| {
        BatchPart::on(cpus[core], move |role: &mut PartContext<'_>| {
            let mut lock = LOCK.attach(&map, announce(&map, core, 1)).expect("it fits");
            let counter = &role.shared.guarded;
            role.shared.meet(2);
            for _ in 0..each {
                let guard = locked.then(|| lock.lock(u32::MAX, spin).expect("it waits for ever"));
                let value = increment(counter);
                drop(guard);
                role.log.push(0, value);
            }
            Ok(())
        })
    };
    perform(&shared, (0..2).map(part).collect())?;
    Ok(Counted {
        increments: 2 * each,
        counter: shared.guarded.load(Ordering::Relaxed),
        seen: [0, 1].map(|core| shared.log(core).samples(0).take(10).collect()),
    })
}

/// Reads, increments and writes back in separate steps, as in the thesis.
fn increment(counter: &AtomicU32) -> u32 {
    let value = counter.load(Ordering::Relaxed) + 1;
    spin(8);
    counter.store(value, Ordering::Relaxed);
    value
}
