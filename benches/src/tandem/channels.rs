//! Channels in memory of the harness, so that any payload fits: an LMU has only 32 KiB. Their code
//! is the same as in an LMU. Measures blocks of any size, FIFOs, and the broadcast ring.

use crate::clock::ticks;
use crate::harness::{Batch, BatchPlan, between_processes, give_way, polled};
use crate::payload::{fill, sum_from};
use crate::shared::{SharedPage, announce};
use crate::stream::{Stream, from_processes};
use crate::worker::{BatchPart, PartContext, perform};
use std::io;
use std::sync::atomic::Ordering::{Acquire, Release};
use tandem_shm::map::{Layout, Map};
use tandem_shm::plain::PlainMap;
use tandem_shm::region::{Broadcast, Fifo, Plain, Region};

/// The queues of both directions. Two blocks each: one may be filled while the other one is read.
struct Blocks<const BYTES: usize>;

impl<const BYTES: usize> Blocks<BYTES> {
    const THERE: Region<Plain<BYTES, 2>> = Region::first("there");
    const BACK: Region<Plain<BYTES, 2>> = Self::THERE.then("back");
    const WAYS: [Region<Plain<BYTES, 2>>; 2] = [Self::THERE, Self::BACK];
}

/// One-way time of a block of `BYTES` bytes, a multiple of 4, between cores that spin: from before
/// its first byte is written until its last byte has been read, in place.
pub(crate) fn in_place<const BYTES: usize>(plan: &BatchPlan) -> io::Result<Batch> {
    let (_blocks, map) = SharedPage::with_lmu(Blocks::<BYTES>::BACK.end())?;
    // SAFETY: only the ends below access the queues, and no end has a successor.
    let map = unsafe { PlainMap::new(map) };
    let batch = between_processes(plan, |_, [core, peer]| {
        let own = announce(&map, core, 1);
        let [out, inward] = [core, peer].map(|way| Blocks::<BYTES>::WAYS[way]);
        let mut out = out.producer(&map, own).expect("it is free");
        let mut inward = inward.consumer(&map, own).expect("it is free");
        let send = move |stamp| {
            let mut loan = out.loan().expect("the other end has released all");
            // SAFETY: any four bytes are a word, and only words are written to it.
            let (_, words, _) = unsafe { loan.bytes_mut().align_to_mut() };
            fill(words, stamp);
            loan.send();
        };
        let receive = move || {
            polled(|| {
                let block = inward.item()?;
                // SAFETY: any four bytes are a word.
                let stamp = sum_from(unsafe { block.bytes().align_to().1 });
                block.release();
                Some(stamp)
            })
        };
        (send, receive)
    })?;
    Ok(batch.carrying(BYTES as u64).without_facts())
}

/// Streams messages of `WORDS` words from one or two processes (`WAYS`) to one, each by a FIFO of
/// `SLOTS` slots. Copies them in and out, in chunks of `chunk`.
pub(crate) fn fifo<const WORDS: usize, const SLOTS: usize, const WAYS: usize>(
    plan: &BatchPlan,
    chunk: usize,
) -> io::Result<Batch> {
    let first = Region::<Fifo<[u32; WORDS], SLOTS>>::first("first");
    let ways = [first, first.then("second")];
    let (shared, map) = SharedPage::with_lmu(ways[WAYS - 1].end())?;
    let stream = Stream {
        chunk,
        payload_bytes: 4 * WORDS,
    };
    let sender = |way: usize| {
        let producer = ways[way].producer(&map, announce(&map, way, 1));
        let (mut producer, mut message) = (producer.expect("it is free"), [7; WORDS]);
        move |k| {
            message[0] = k;
            producer.send(&message).is_ok()
        }
    };
    let receiver = |way: usize| {
        let consumer = ways[way].consumer(&map, announce(&map, 2, 1));
        let mut consumer = consumer.expect("it is free");
        move || Some(std::hint::black_box(&consumer.receive().ok()??)[0])
    };
    from_processes::<_, _, WAYS>(plan, &shared, stream, sender, receiver)
}

const RING: Region<Broadcast<[u32; 2], 1024>> = Region::first("ring");
const RING_LAYOUT: Layout = RING.end();
/// Messages per sample.
const CHUNK: usize = 256;
/// Messages per round.
const SENT: usize = 4096;

/// The broadcast ring from one process to two, which share the far CPU; the writer never waits. A
/// sample is a receiver's time per message that it received. The share that it received is a fact:
/// a late receiver misses messages.
pub(crate) fn broadcast(plan: &BatchPlan) -> io::Result<Batch> {
    let (shared, map) = SharedPage::with_lmu(RING_LAYOUT)?;
    let sent = (plan.warm_up + plan.rounds) * SENT;
    let writer = BatchPart::on(plan.cpus[0], |role| {
        let writer = RING.writer(&map, announce(&map, 0, 1));
        let mut writer = writer.expect("it is free");
        role.shared.meet(3);
        let mut k = 0;
        role.begin();
        for _ in 0..sent {
            k = writer.publish(&[k, !k]).0.wrapping_add(1);
        }
        role.end();
        // Release pairs with the Acquire in `receive`: all values are published.
        role.shared.flag.store(1, Release);
        Ok(())
    });
    let receiver = || BatchPart::on(plan.cpus[1], |role| receive(&map, role));
    perform(&shared, vec![writer, receiver(), receiver()])?;
    let share = |part| shared.log(part).noted(0) / sent as f64;
    Ok(Batch::collect(&shared, 3, plan.rounds)
        .per_operation(CHUNK)
        .carrying(8)
        .with_fact("share received by receiver 1", share(1))
        .with_fact("share received by receiver 2", share(2)))
}

fn receive(map: &Map<'_>, role: &mut PartContext<'_>) -> io::Result<()> {
    let mut receiver = RING.receiver(map).expect("it fits");
    role.shared.meet(3);
    role.begin();
    let mut received = 0u32;
    let mut turn = ticks();
    let mut begin = turn;
    loop {
        // Read this before the ring, so that all earlier messages are visible.
        let last = role.shared.flag.load(Acquire) != 0;
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
        // Yields to the other receiver about every 100 us.
        if ticks().wrapping_sub(turn) > 250_000 {
            give_way();
            turn = ticks();
        }
    }
    role.end();
    role.log.note(0, f64::from(received));
    Ok(())
}
