//! The broadcast ring from one process to two.

use super::lmu;
use crate::clock::ticks;
use crate::harness::{Batch, Plan, give_way};
use crate::worker::{Part, Role, perform};
use std::io;
use std::sync::atomic::Ordering;
use tandem_shm::map::{Layout, Map};
use tandem_shm::region::{Broadcast, Region};

const RING: Region<Broadcast<[u32; 2], 1024>> = Region::first("ring");
const LAYOUT: Layout = RING.end();
/// Messages of a sample.
const CHUNK: usize = 256;
/// Messages of a round.
const SENT: usize = 4096;

/// Both receivers share the far CPU; the writer never waits. A sample is a receiver's time per
/// message that it received; what it had missed when it was late is a fact.
///
/// # Errors
/// If the processes or the shared memory cannot be had, or an end failed.
pub fn to_two(plan: &Plan) -> io::Result<Batch> {
    let (shared, map) = lmu::shared(LAYOUT)?;
    let writer = Part::on(plan.cpus[0], |role| {
        let writer = RING.writer(&map, lmu::announce(&map, 0, 1));
        let mut writer = writer.expect("it is free");
        role.shared.meet(3);
        let mut k = 0;
        role.begin();
        for _ in 0..(plan.warm_up + plan.rounds) * SENT {
            k = writer.publish(&[k, !k]).0.wrapping_add(1);
        }
        role.end();
        // Release pairs with the Acquire in `receive`: all values are there.
        role.shared.flag().store(1, Ordering::Release);
        Ok(())
    });
    let receiver = || Part::on(plan.cpus[1], |role| receive(&map, role));
    perform(&shared, vec![writer, receiver(), receiver()])?;
    let sent = ((plan.warm_up + plan.rounds) * SENT) as f64;
    let share = |part| shared.log(part).noted(0) / sent;
    let batch = Batch::collect(&shared, 3, plan.rounds, lmu::bytes(LAYOUT));
    Ok(batch
        .per_operation(CHUNK)
        .carrying(8)
        .with_fact("share received by receiver 1", share(1))
        .with_fact("share received by receiver 2", share(2)))
}

fn receive(map: &Map<'_>, role: &mut Role<'_>) -> io::Result<()> {
    let mut receiver = RING.receiver(map).expect("it fits");
    role.shared.meet(3);
    role.begin();
    let mut received = 0u32;
    let mut turn = ticks();
    let mut begin = turn;
    loop {
        // Read before the ring: what was sent before is then seen.
        let last = role.shared.flag().load(Ordering::Acquire) != 0;
        match receiver.receive() {
            Ok(Some((k, value))) => {
                assert_eq!(value, [k.0, !k.0], "a torn value");
                received += 1;
                if received.is_multiple_of(CHUNK as u32) {
                    let now = ticks();
                    role.log.push(0, now.wrapping_sub(begin));
                    begin = now;
                }
            }
            Ok(None) if last => break,
            Ok(None) => give_way(),
            Err(_lost) => {}
        }
        // The other receiver's turn, every 100 us or so.
        if ticks().wrapping_sub(turn) > 250_000 {
            give_way();
            turn = ticks();
        }
    }
    role.end();
    role.log.note(0, f64::from(received));
    Ok(())
}
