//! The broadcast ring from one process to two.

use crate::clock::ticks;
use crate::harness::{Batch, Plan, give_way};
use crate::shared::Shared;
use crate::worker::{Part, Role, perform};
use std::io;
use std::sync::atomic::{AtomicU32, Ordering};
use tandem_shm::broadcast::{self, Receiver, Sender};
use tandem_shm::{LINE_WORDS, Shape};

const SHAPE: Shape = Shape::new(1024, 2);
const RING_AT: usize = LINE_WORDS;
const CHUNK: usize = 4096;

/// Both receivers share the far CPU; the sender never waits. A sample is the sender's time per
/// message; what the receivers had missed when they were late is a fact.
///
/// # Errors
/// If the processes or the shared memory cannot be had, or an end failed.
pub fn to_two(plan: &Plan) -> io::Result<Batch> {
    let shared = Shared::with_case_words(RING_AT + broadcast::words(SHAPE))?;
    let sender = Part::on(plan.cpus[0], |role| {
        let mut sender = Sender::attach(&role.shared.case()[RING_AT..], SHAPE).expect("it fits");
        role.shared.meet(3);
        let mut k = 0;
        crate::harness::time_chunks(plan, CHUNK, role, || {
            k = sender.send(&[k, !k]).wrapping_add(1);
        });
        // Release pairs with the Acquire in `receive`: all values are there.
        role.shared.case()[0].store(1, Ordering::Release);
        Ok(())
    });
    let receiver = || Part::on(plan.cpus[1], receive);
    perform(&shared, vec![sender, receiver(), receiver()])?;
    let sent = ((plan.warm_up + plan.rounds) * CHUNK) as f64;
    let share = |part| shared.log(part).noted(0) / sent;
    let batch = Batch::collect(&shared, 3, plan.rounds, 4 * broadcast::words(SHAPE) as u64);
    Ok(batch
        .per_operation(CHUNK)
        .carrying(8)
        .with_fact("share received by receiver 1", share(1))
        .with_fact("share received by receiver 2", share(2)))
}

fn receive(role: &mut Role<'_>) -> io::Result<()> {
    let done: &AtomicU32 = &role.shared.case()[0];
    let ring = &role.shared.case()[RING_AT..];
    let mut receiver = Receiver::attach(ring, SHAPE).expect("it fits");
    role.shared.meet(3);
    role.begin();
    let (mut received, mut value) = (0u32, [0; 2]);
    let mut turn = ticks();
    loop {
        // Looked at before the ring: what was sent before is then seen.
        let last = done.load(Ordering::Acquire) != 0;
        match receiver.receive_into(&mut value) {
            Ok(Some(k)) => {
                assert_eq!(value, [k, !k], "a torn value");
                received += 1;
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
