//! Messages in a row, as many as possible: throughput.
//!
//! The receiver takes the time at the end of each chunk of messages; a sample is the mean time per
//! message over a chunk. Every message carries its number, and the receiver checks that none is
//! missing or out of order, so that lost messages cannot improve a result.

use crate::clock::ticks;
use crate::harness::{Batch, BatchPlan, give_way, in_threads};
use crate::shared::SharedPage;
use crate::worker::{BatchPart, PartContext, perform};
use std::hint::spin_loop;
use std::io;

/// How messages stream.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Stream {
    /// Messages of a chunk; a round of the plan is one chunk.
    pub(crate) chunk: usize,
    /// Bytes of a message.
    pub(crate) payload_bytes: usize,
}

impl Stream {
    fn messages(&self, plan: &BatchPlan) -> usize {
        (plan.warm_up + plan.rounds) * self.chunk
    }

    fn batch(&self, plan: &BatchPlan, shared: &SharedPage, parts: usize) -> Batch {
        Batch::collect(shared, parts, plan.rounds)
            .per_operation(self.chunk)
            .carrying(self.payload_bytes as u64)
    }
}

/// Sends messages by their numbers; `send` returns `false` if there is no room now.
fn pour(
    mut send: impl FnMut(u32) -> bool,
    messages: usize,
    role: &mut PartContext<'_>,
    pause: fn(),
) {
    role.begin();
    for k in 0..messages as u32 {
        while !send(k) {
            pause();
        }
    }
    role.end();
}

/// Receives all messages of the plan; when a source is empty, polls the next one. Only one place in
/// the code receives, so that the call is inlined: without that it took as long as a message.
fn drain<R: FnMut() -> Option<u32>, const WAYS: usize>(
    plan: &BatchPlan,
    chunk: usize,
    mut sources: [R; WAYS],
    role: &mut PartContext<'_>,
) {
    let (mut next, mut from) = ([0u32; WAYS], 0);
    for round in 0..plan.warm_up + plan.rounds {
        if round == plan.warm_up {
            role.begin();
        }
        let begin = ticks();
        for _ in 0..chunk {
            let k = loop {
                if let Some(k) = sources[from]() {
                    break k;
                }
                from = (from + 1) % WAYS;
                spin_loop();
            };
            assert_eq!(k, next[from], "a message was lost");
            next[from] += 1;
        }
        if round >= plan.warm_up {
            role.log.push(0, ticks().wrapping_sub(begin));
        }
    }
    role.end();
}

/// Streams from `WAYS` processes to one, each by its own way. The senders share the near CPU. Only
/// the receiver uses the far CPU; it polls all ways. Each sender sends its share of the messages.
/// `sender` creates a function that sends message `k`, or returns `false` if there is no room;
/// `receiver` creates one that returns the number of the next message, if any.
pub(crate) fn from_processes<S, R, const WAYS: usize>(
    plan: &BatchPlan,
    shared: &SharedPage,
    stream: Stream,
    sender: impl Fn(usize) -> S,
    receiver: impl Fn(usize) -> R,
) -> io::Result<Batch>
where
    S: FnMut(u32) -> bool,
    R: FnMut() -> Option<u32>,
{
    let (sender, count) = (&sender, WAYS as u32 + 1);
    let pause = if WAYS == 1 { spin_loop } else { give_way };
    let part = |way| {
        BatchPart::on(plan.cpus[0], move |role: &mut PartContext<'_>| {
            let send = sender(way);
            role.shared.meet(count);
            pour(send, stream.messages(plan) / WAYS, role, pause);
            Ok(())
        })
    };
    let mut parts: Vec<BatchPart<'_>> = (0..WAYS).map(part).collect();
    parts.push(BatchPart::on(plan.cpus[1], |role| {
        let sources: [R; WAYS] = std::array::from_fn(receiver);
        role.shared.meet(count);
        drain(plan, stream.chunk, sources, role);
        Ok(())
    }));
    perform(shared, parts)?;
    Ok(stream.batch(plan, shared, WAYS + 1))
}

/// Streams from one thread to another of the same process.
pub(crate) fn between_threads(
    plan: &BatchPlan,
    stream: Stream,
    (send, receive): (impl FnMut(u32) -> bool + Send, impl FnMut() -> Option<u32>),
) -> io::Result<Batch> {
    let [near, far] = plan.cpus;
    let receiver = |role: &mut PartContext<'_>| drain(plan, stream.chunk, [receive], role);
    let sender = |role: &mut PartContext<'_>| pour(send, stream.messages(plan), role, spin_loop);
    let shared = in_threads([far, near], receiver, sender)?;
    Ok(stream.batch(plan, &shared, 2))
}
