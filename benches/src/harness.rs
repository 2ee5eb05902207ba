//! Two ends that pass a stamp to each other, in two processes or two threads, and time every way.
//!
//! Each message carries the sender's time stamp as its 4 bytes of data; the receiver subtracts it
//! from its own when the value has reached its code. Both directions of a ping-pong are samples of
//! one-way latency. All cases of a run use this loop, so that floor, peers and Tandem differ in
//! nothing else.

use crate::clock::ticks;
use std::io;
use std::sync::atomic::{AtomicU32, Ordering};

/// One end of a way of passing 4 bytes in both directions.
pub trait End {
    /// Sends a stamp to the other end.
    fn send(&mut self, stamp: u32);
    /// Waits for the next stamp of the other end.
    fn receive(&mut self) -> u32;
}

/// What a batch is to do.
#[derive(Clone, Copy, Debug)]
pub struct Plan {
    /// Round trips that count.
    pub rounds: usize,
    /// Round trips before them that do not.
    pub warm_up: usize,
    /// CPUs of the near and the far end.
    pub cpus: [usize; 2],
}

/// Memory that the two ends share, zero at first. A batch has its own.
#[derive(Clone, Copy)]
pub struct Shared {
    words: &'static [AtomicU32],
}

/// Words before the samples that belong to the case.
const CASE_WORDS: usize = 1 << 16;
/// Words for the samples of one end; more rounds overwrite the first ones.
const SAMPLE_WORDS: usize = 1 << 19;
const TOTAL_WORDS: usize = CASE_WORDS + 2 * SAMPLE_WORDS;
/// Words in a cache line.
const LINE: usize = 16;

impl Shared {
    fn new() -> io::Result<Self> {
        let bytes = TOTAL_WORDS * 4;
        // SAFETY: a fresh anonymous mapping, not at a fixed address, touches no other memory.
        let base = unsafe {
            libc::mmap(
                std::ptr::null_mut(),
                bytes,
                libc::PROT_READ | libc::PROT_WRITE,
                libc::MAP_SHARED | libc::MAP_ANONYMOUS | libc::MAP_POPULATE,
                -1,
                0,
            )
        };
        if base == libc::MAP_FAILED {
            return Err(io::Error::last_os_error());
        }
        // SAFETY: the mapping has this many zeroed bytes, is aligned to a page, and is unmapped
        // only by `free`, after which its batch uses no word of it any more.
        let words = unsafe { std::slice::from_raw_parts(base.cast(), TOTAL_WORDS) };
        Ok(Self { words })
    }

    fn free(self) {
        let base = self.words.as_ptr().cast_mut().cast();
        // SAFETY: `base` and the length are those of the mapping made in `new`; the batch is over.
        unsafe { libc::munmap(base, size_of_val(self.words)) };
    }

    /// The words that belong to the case, aligned to a page.
    pub fn case(&self) -> &'static [AtomicU32] {
        &self.words[LINE..CASE_WORDS]
    }

    /// One word on a cache line of its own.
    pub fn line(&self, number: usize) -> &'static AtomicU32 {
        &self.case()[number * LINE]
    }

    fn meet(&self, ends: u32) {
        // Release pairs with the Acquire below: what an end prepared is visible to the other.
        self.words[0].fetch_add(1, Ordering::AcqRel);
        while self.words[0].load(Ordering::Acquire) < ends {
            std::thread::yield_now();
        }
    }

    fn samples(&self, end: usize) -> &'static [AtomicU32] {
        &self.words[CASE_WORDS + end * SAMPLE_WORDS..][..SAMPLE_WORDS]
    }
}

/// Pins the calling thread to a CPU.
pub fn pin(cpu: usize) {
    core_affinity::set_for_current(core_affinity::CoreId { id: cpu });
}

fn near_end(end: &mut impl End, plan: &Plan, samples: &[AtomicU32]) {
    for round in 0..plan.warm_up + plan.rounds {
        end.send(ticks());
        let stamp = end.receive();
        let way = ticks().wrapping_sub(stamp);
        if let Some(place) = round.checked_sub(plan.warm_up) {
            samples[place % samples.len()].store(way, Ordering::Relaxed);
        }
    }
}

fn far_end(end: &mut impl End, plan: &Plan, samples: &[AtomicU32]) {
    for round in 0..plan.warm_up + plan.rounds {
        let stamp = end.receive();
        let way = ticks().wrapping_sub(stamp);
        if let Some(place) = round.checked_sub(plan.warm_up) {
            samples[place % samples.len()].store(way, Ordering::Relaxed);
        }
        end.send(ticks());
    }
}

/// Passes a stamp to and fro between two processes; returns all one-way times in ticks.
///
/// Each end is made in a process of its own, which lives for this batch only: it inherits nothing
/// from earlier batches but what the caller had opened before.
///
/// # Errors
/// If the processes or the shared memory cannot be had, or an end died.
pub fn between_processes<N: End, F: End>(
    plan: &Plan,
    near: impl FnOnce(&Shared) -> N,
    far: impl FnOnce(&Shared) -> F,
) -> io::Result<Vec<u32>> {
    let shared = Shared::new()?;
    let near = fork(plan.cpus[0], || {
        let mut end = near(&shared);
        shared.meet(2);
        near_end(&mut end, plan, shared.samples(0));
    })?;
    let far = fork(plan.cpus[1], || {
        let mut end = far(&shared);
        shared.meet(2);
        far_end(&mut end, plan, shared.samples(1));
    });
    let far = far.inspect_err(|_| kill(near))?;
    let outcome = wait_for_both([near, far]);
    let samples = collect(&shared, plan);
    shared.free();
    outcome.map(|()| samples)
}

/// Runs `end` in a child process on this CPU.
fn fork(cpu: usize, end: impl FnOnce()) -> io::Result<libc::pid_t> {
    // SAFETY: this program has no other thread at this point that could hold a lock; the child runs
    // only its end and leaves by `_exit`.
    let child = unsafe { libc::fork() };
    if child < 0 {
        return Err(io::Error::last_os_error());
    }
    if child == 0 {
        // SAFETY: only sets this process's own death signal: it dies with its parent.
        unsafe { libc::prctl(libc::PR_SET_PDEATHSIG, libc::SIGKILL) };
        pin(cpu);
        let ended = std::panic::catch_unwind(std::panic::AssertUnwindSafe(end));
        // SAFETY: ends the child without running the parent's exit handlers.
        unsafe { libc::_exit(i32::from(ended.is_err())) };
    }
    Ok(child)
}

fn kill(child: libc::pid_t) {
    // SAFETY: `child` is our child and not yet waited for.
    unsafe {
        libc::kill(child, libc::SIGKILL);
        libc::waitpid(child, std::ptr::null_mut(), 0);
    }
}

/// Waits until both have ended; if one dies, the other would wait for it for ever and is killed.
fn wait_for_both(mut children: [libc::pid_t; 2]) -> io::Result<()> {
    for _ in 0..2 {
        let mut status = 0;
        // SAFETY: waits for any child, of which there are just these; `status` is a valid place.
        let ended = unsafe { libc::waitpid(-1, &mut status, 0) };
        children = children.map(|child| if child == ended { 0 } else { child });
        if status != 0 {
            children
                .into_iter()
                .filter(|child| *child != 0)
                .for_each(kill);
            return Err(io::Error::other("one end of the measurement died"));
        }
    }
    Ok(())
}

/// The same between two threads of this process, for peers that only work there.
///
/// # Errors
/// If the shared memory cannot be had.
pub fn between_threads<N: End + Send, F: End + Send>(
    plan: &Plan,
    mut near: N,
    mut far: F,
) -> io::Result<Vec<u32>> {
    let shared = Shared::new()?;
    std::thread::scope(|scope| {
        scope.spawn(|| {
            pin(plan.cpus[1]);
            shared.meet(2);
            far_end(&mut far, plan, shared.samples(1));
        });
        scope.spawn(|| {
            pin(plan.cpus[0]);
            shared.meet(2);
            near_end(&mut near, plan, shared.samples(0));
        });
    });
    let samples = collect(&shared, plan);
    shared.free();
    Ok(samples)
}

fn collect(shared: &Shared, plan: &Plan) -> Vec<u32> {
    let of = |end| shared.samples(end).iter().take(plan.rounds);
    of(0)
        .chain(of(1))
        .map(|way| way.load(Ordering::Relaxed))
        .collect()
}

/// A number for names that no other batch of this machine uses at the same time.
pub fn next_run() -> u32 {
    static RUNS: AtomicU32 = AtomicU32::new(0);
    (std::process::id() << 8) | (RUNS.fetch_add(1, Ordering::Relaxed) & 0xFF)
}
