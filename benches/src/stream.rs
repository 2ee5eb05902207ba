//! Messages in a row, as many as go: throughput.
//!
//! The receiver takes the time at the end of each chunk of messages; a sample is the mean time per
//! message over a chunk. Every message carries its number, and the receiver checks that none is
//! missing or out of order, so that nothing can be fast by losing messages.

use crate::clock::ticks;
use crate::harness::{Batch, Plan, give_way};
use crate::shared::Shared;
use crate::worker::{Part, Role, perform, pin};
use std::hint::spin_loop;
use std::io;

/// The sending end.
pub trait Source {
    /// Sends message number `k`; `false` if there is no room now.
    fn send(&mut self, k: u32) -> bool;
}

/// The receiving end.
pub trait Sink {
    /// The number of the next message; `None` if there is none now.
    fn receive(&mut self) -> Option<u32>;
}

/// How messages stream.
#[derive(Clone, Copy, Debug)]
pub struct Stream {
    /// Messages of a chunk, the plan's round.
    pub chunk: usize,
    /// Bytes of a message.
    pub payload_bytes: u64,
    /// Bytes that the case uses of the memory that the harness shares.
    pub own_bytes: u64,
}

impl Stream {
    fn messages(&self, plan: &Plan) -> usize {
        (plan.warm_up + plan.rounds) * self.chunk
    }

    fn batch(&self, plan: &Plan, shared: &Shared, parts: usize) -> Batch {
        Batch::collect(shared, parts, plan.rounds, self.own_bytes)
            .per_operation(self.chunk)
            .carrying(self.payload_bytes)
    }
}

/// Sends all messages of the plan.
pub fn pour(source: &mut impl Source, messages: usize, role: &mut Role<'_>, pause: fn()) {
    role.begin();
    for k in 0..messages as u32 {
        while !source.send(k) {
            pause();
        }
    }
    role.end();
}

/// Receives all messages of the plan, from one sink after the other when one has none.
///
/// # Panics
/// If a message is missing or comes out of order.
pub fn drain<S: Sink>(plan: &Plan, chunk: usize, sinks: &mut [S], role: &mut Role<'_>) {
    let mut next = vec![0u32; sinks.len()];
    let mut from = 0;
    let mut one = || {
        loop {
            if let Some(k) = sinks[from].receive() {
                assert_eq!(k, next[from], "a message was lost");
                next[from] += 1;
                return;
            }
            from = (from + 1) % sinks.len();
            spin_loop();
        }
    };
    (0..plan.warm_up * chunk).for_each(|_| one());
    role.begin();
    for _ in 0..plan.rounds {
        let begin = ticks();
        (0..chunk).for_each(|_| one());
        role.log.push(0, ticks().wrapping_sub(begin));
    }
    role.end();
}

/// From `WAYS` processes to one, each by a way of its own: the senders share the near CPU, the
/// receiver has the far one to itself and polls all ways. Each sender sends its share of the
/// messages.
///
/// # Errors
/// If the processes cannot be had, or an end failed.
pub fn from_processes<F: Source, T: Sink, const WAYS: usize>(
    plan: &Plan,
    shared: &Shared,
    stream: Stream,
    source: impl Fn(usize) -> F,
    sink: impl Fn(usize) -> T,
) -> io::Result<Batch> {
    let (source, count) = (&source, WAYS as u32 + 1);
    let pause = if WAYS == 1 { spin_loop } else { give_way };
    let sender = |way| {
        Part::on(plan.cpus[0], move |role: &mut Role<'_>| {
            let mut source = source(way);
            role.shared.meet(count);
            pour(&mut source, stream.messages(plan) / WAYS, role, pause);
            Ok(())
        })
    };
    let mut parts: Vec<Part<'_>> = (0..WAYS).map(sender).collect();
    parts.push(Part::on(plan.cpus[1], |role| {
        let mut sinks: [T; WAYS] = std::array::from_fn(sink);
        role.shared.meet(count);
        drain(plan, stream.chunk, &mut sinks, role);
        Ok(())
    }));
    perform(shared, parts)?;
    Ok(stream.batch(plan, shared, WAYS + 1))
}

/// From one thread to another of the same process.
///
/// # Errors
/// As [`from_processes`].
pub fn between_threads<F: Source + Send, T: Sink + Send>(
    plan: &Plan,
    stream: Stream,
    ends: impl FnOnce() -> (F, T),
) -> io::Result<Batch> {
    let shared = Shared::new()?;
    let part = Part::on(plan.cpus[1], |role| {
        let (mut source, mut sink) = ends();
        let mut source_role = role.beside(1);
        std::thread::scope(|scope| {
            scope.spawn(|| {
                pin(plan.cpus[0]);
                source_role.shared.meet(2);
                let messages = stream.messages(plan);
                pour(&mut source, messages, &mut source_role, spin_loop);
            });
            role.shared.meet(2);
            drain(plan, stream.chunk, std::slice::from_mut(&mut sink), role);
        });
        Ok(())
    });
    perform(&shared, vec![part])?;
    Ok(stream.batch(plan, &shared, 2))
}
