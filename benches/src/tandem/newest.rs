//! What publishing a newest value costs its writer, with readers and without.

use super::lmu;
use crate::clock::{from_ns, ticks};
use crate::harness::{Batch, Plan, give_way, time_chunks};
use crate::worker::{Part, Role, perform};
use std::hint::{black_box, spin_loop};
use std::io;
use std::sync::atomic::Ordering;
use tandem_shm::map::{Layout, Map};
use tandem_shm::region::{Newest, Region};

const CHANNEL: Region<Newest<[u32; 2]>> = Region::first("channel");
const LAYOUT: Layout = CHANNEL.end();
/// Values of a sample at full speed.
const CHUNK: usize = 64;
/// Distance of the values at a fixed pace, and time between two reads of one reader.
const PACE_NS: u64 = 1_000;

/// How fast writer and readers go.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Pace {
    /// As fast as they can.
    Full,
    /// One value and one read each microsecond.
    Fixed,
}

/// The writer has the near CPU, the readers share the far one. A sample is the time of one
/// publishing: at full speed the mean of 64, at a fixed pace each by itself.
///
/// # Errors
/// If the processes or the shared memory cannot be had, or an end failed.
pub fn write(plan: &Plan, readers: usize, pace: Pace) -> io::Result<Batch> {
    let (shared, map) = lmu::shared(LAYOUT)?;
    let parts = 1 + readers as u32;
    let writer = Part::on(plan.cpus[0], move |role| {
        let writer = CHANNEL.writer(&map, lmu::announce(&map, 0, 1));
        let mut writer = writer.expect("it is free");
        writer.publish(&[0, 0]);
        role.shared.meet(parts);
        let mut k = 0u32;
        let mut publish = || {
            k = k.wrapping_add(1);
            black_box(writer.publish(&[k, k]));
        };
        match pace {
            Pace::Full => time_chunks(plan, CHUNK, role, publish),
            Pace::Fixed => paced(plan, role, &mut publish),
        }
        role.shared.flag().store(1, Ordering::Relaxed);
        Ok(())
    });
    let reader = || Part::on(plan.cpus[1], move |role| read(&map, role, parts, pace));
    let others = (0..readers).map(|_| reader());
    perform(&shared, [writer].into_iter().chain(others).collect())?;
    let mut batch = Batch::collect(&shared, 1, plan.rounds, lmu::bytes(LAYOUT)).carrying(8);
    if pace == Pace::Full {
        batch = batch.per_operation(CHUNK);
    }
    if readers > 0 {
        let reads = (1..=readers).map(|part| shared.log(part).noted(0)).sum();
        batch = batch.with_fact("reads in a batch", reads);
    }
    Ok(batch)
}

fn paced(plan: &Plan, role: &mut Role<'_>, publish: &mut impl FnMut()) {
    let period = from_ns(PACE_NS);
    let mut due = ticks();
    for round in 0..plan.warm_up + plan.rounds {
        if round == plan.warm_up {
            role.begin();
        }
        due = due.wrapping_add(period);
        while (ticks().wrapping_sub(due) as i32) < 0 {
            spin_loop();
        }
        let begin = ticks();
        publish();
        let took = ticks().wrapping_sub(begin);
        if round >= plan.warm_up {
            role.log.push(0, took);
        }
    }
    role.end();
}

fn read(map: &Map<'_>, role: &mut Role<'_>, parts: u32, pace: Pace) -> io::Result<()> {
    let done = role.shared.flag();
    let reader = CHANNEL.reader(map).expect("it fits");
    role.shared.meet(parts);
    let period = from_ns(PACE_NS);
    let (mut reads, mut turn) = (0u32, ticks());
    while done.load(Ordering::Relaxed) == 0 {
        if let Ok((_, [first, second])) = reader.read() {
            assert_eq!(first, second, "a torn value");
            reads += 1;
        }
        let now = ticks();
        // Another reader on this CPU has its turn every 100 us or so.
        if parts > 2 && now.wrapping_sub(turn) > 250_000 {
            give_way();
            turn = ticks();
        }
        while pace == Pace::Fixed && ticks().wrapping_sub(now) < period {
            spin_loop();
        }
    }
    role.log.note(0, f64::from(reads));
    Ok(())
}
