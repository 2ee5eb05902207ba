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
    /// Words that the case needs of the memory that the harness shares.
    pub case_words: usize,
}

impl Stream {
    fn messages(&self, plan: &Plan) -> usize {
        (plan.warm_up + plan.rounds) * self.chunk
    }

    fn batch(&self, plan: &Plan, shared: &Shared, parts: usize) -> Batch {
        let own_bytes = 4 * self.case_words as u64;
        Batch::collect(shared, parts, plan.rounds, own_bytes)
            .per_operation(self.chunk)
            .carrying(self.payload_bytes)
    }
}

/// What an end does when it cannot go on.
pub type Pause = fn();

/// The end has a CPU of its own.
pub fn on_own_cpu() {
    spin_loop();
}

/// The end shares its CPU with another.
pub fn on_shared_cpu() {
    give_way();
}

/// Sends all messages of the plan.
pub fn pour(source: &mut impl Source, messages: usize, role: &mut Role<'_>, pause: Pause) {
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

/// From one process to another.
///
/// # Errors
/// If the processes or the shared memory cannot be had, or an end failed.
pub fn between_processes<F: Source, T: Sink>(
    plan: &Plan,
    stream: Stream,
    source: impl FnOnce(&Shared) -> F,
    sink: impl FnOnce(&Shared) -> T,
) -> io::Result<Batch> {
    let shared = Shared::with_case_words(stream.case_words.max(16))?;
    let source = Part::on(plan.cpus[0], |role| {
        let mut source = source(role.shared);
        role.shared.meet(2);
        pour(&mut source, stream.messages(plan), role, on_own_cpu);
        Ok(())
    });
    let sink = Part::on(plan.cpus[1], |role| {
        let mut sink = sink(role.shared);
        role.shared.meet(2);
        drain(plan, stream.chunk, std::slice::from_mut(&mut sink), role);
        Ok(())
    });
    perform(&shared, vec![source, sink])?;
    Ok(stream.batch(plan, &shared, 2))
}

/// From one thread to another of the same process.
///
/// # Errors
/// As [`between_processes`].
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
                pour(&mut source, messages, &mut source_role, on_own_cpu);
            });
            role.shared.meet(2);
            drain(plan, stream.chunk, std::slice::from_mut(&mut sink), role);
        });
        Ok(())
    });
    perform(&shared, vec![part])?;
    Ok(stream.batch(plan, &shared, 2))
}

/// From two processes to a third: the senders share the near CPU, the receiver has the far one to
/// itself and polls both ways. Each sender sends half of the messages.
///
/// # Errors
/// As [`between_processes`].
pub fn two_to_one<F: Source, T: Sink>(
    plan: &Plan,
    stream: Stream,
    source: impl Fn(&Shared, usize) -> F,
    sink: impl Fn(&Shared, usize) -> T,
) -> io::Result<Batch> {
    let shared = Shared::with_case_words(stream.case_words)?;
    let source = &source;
    let mut parts: Vec<Part<'_>> = [0, 1]
        .map(|way| {
            Part::on(plan.cpus[0], move |role| {
                let mut source = source(role.shared, way);
                role.shared.meet(3);
                let messages = stream.messages(plan) / 2;
                pour(&mut source, messages, role, on_shared_cpu);
                Ok(())
            })
        })
        .into();
    parts.push(Part::on(plan.cpus[1], |role| {
        let mut sinks = [0, 1].map(|way| sink(role.shared, way));
        role.shared.meet(3);
        drain(plan, stream.chunk, &mut sinks, role);
        Ok(())
    }));
    perform(&shared, parts)?;
    Ok(stream.batch(plan, &shared, 3))
}
