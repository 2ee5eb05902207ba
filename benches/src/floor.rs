//! The floors: the cost of the hardware and the kernel alone.

use crate::harness::{
    Batch, BatchPlan, End, between_processes, give_way, median, polled, repeated, timed_between,
};
use crate::mutual_exclusion::{Exclusion, contended};
use crate::open_loop::at_fixed_rate;
use crate::payload::{sum_from, word};
use crate::shared::{LINE, PAIR, SharedPage};
use crate::stream::{Stream, from_processes};
use std::hint::{black_box, spin_loop};
use std::io;
use std::sync::atomic::AtomicU32;
use std::sync::atomic::Ordering::{Acquire, Relaxed, Release};

/// Ends on two cache lines that spin on the value itself.
fn line_ends(shared: &SharedPage, ways: [usize; 2]) -> impl End + use<> {
    let [out, inward] = ways.map(|way| shared.line(2 * way));
    let mut last = 0;
    // Zero means "nothing yet". Release pairs with the Acquire of the other end.
    let send = |stamp| out.store(stamp | 1, Release);
    let receive = move || {
        let new = |stamp: &u32| *stamp != last;
        last = polled(|| Some(inward.load(Acquire)).filter(new));
        last
    };
    (send, receive)
}

/// One-way time of a cache line between two CPUs.
pub(crate) fn cache_line(plan: &BatchPlan) -> io::Result<Batch> {
    between_processes(plan, line_ends)
}

/// Returns the time that a cache line takes now, one way, in ps: the median of 2000, within
/// a millisecond.
pub(crate) fn line_now(cpus: [usize; 2]) -> io::Result<u64> {
    let plan = BatchPlan {
        rounds: 1000,
        warm_up: 100,
        cpus,
        system: None,
    };
    let [near, far] = [[0, 1], [1, 0]].map(|ways| move |at: &SharedPage| line_ends(at, ways));
    timed_between(&plan, near, far, false).map(|mut batch| median(&mut batch.samples_ps))
}

/// One-way time of a payload of `WORDS` words and a line that announces it, in memory as the LMU:
/// words of 32 bits, each written once and read once, in four slots in turn. A word of each line is
/// touched first, so that all lines move at the same time. There is no check for torn values.
pub(crate) fn words<const WORDS: usize>(plan: &BatchPlan) -> io::Result<Batch> {
    const SLOTS: usize = 4;
    let slot_words = WORDS.next_multiple_of(LINE);
    let way_words = (LINE + SLOTS * slot_words).next_multiple_of(PAIR);
    let shared = SharedPage::with_case_words(2 * way_words)?;
    let way = |way: usize| &shared.case()[way * way_words..][..way_words];
    let slot =
        |way: &'static [AtomicU32], k: u32| &way[LINE + k as usize % SLOTS * slot_words..][..WORDS];
    let batch = between_processes(plan, |_, ways| {
        let [out, inward] = ways.map(way);
        let (mut sent, mut received) = (0, 0);
        let send = move |stamp| {
            let words = slot(out, sent);
            for place in words.iter().step_by(LINE) {
                place.store(0, Relaxed);
            }
            for (at, place) in words.iter().enumerate() {
                place.store(word(stamp, at), Relaxed);
            }
            sent += 1;
            // Release pairs with the Acquire below: the words are there.
            out[0].store(sent, Release);
        };
        let receive = move || {
            polled(|| (inward[0].load(Acquire) != received).then_some(()));
            let words = slot(inward, received);
            received += 1;
            for place in words.iter().step_by(LINE) {
                black_box(place.load(Relaxed));
            }
            let words: [u32; WORDS] = std::array::from_fn(|at| words[at].load(Relaxed));
            sum_from(&words)
        };
        (send, receive)
    })?;
    Ok(batch.carrying(4 * WORDS as u64))
}

/// Ends on two cache lines; the receiver sleeps in the kernel until the word changes.
fn futex_ends(shared: &SharedPage, ways: [usize; 2]) -> impl End + use<> {
    let [out, inward] = ways.map(|way| shared.line(2 * way));
    let mut last = 0;
    let send = |stamp| {
        out.store(stamp | 1, Release);
        // SAFETY: FUTEX_WAKE on a word of the shared mapping; it reads no further argument.
        unsafe { libc::syscall(libc::SYS_futex, out.as_ptr(), libc::FUTEX_WAKE, 1) };
    };
    let receive = move || {
        loop {
            let stamp = inward.load(Acquire);
            if stamp != last {
                last = stamp;
                return stamp;
            }
            let (word, forever) = (inward.as_ptr(), std::ptr::null::<libc::timespec>());
            // SAFETY: FUTEX_WAIT on a word of the shared mapping, without a time limit.
            unsafe { libc::syscall(libc::SYS_futex, word, libc::FUTEX_WAIT, stamp, forever) };
        }
    };
    (send, receive)
}

/// One-way time of a futex wake to a sleeping process.
pub(crate) fn futex(plan: &BatchPlan) -> io::Result<Batch> {
    between_processes(plan, futex_ends)
}

/// The time of a futex wake at a fixed rate.
pub(crate) fn futex_at_rate(plan: &BatchPlan) -> io::Result<Batch> {
    at_fixed_rate(plan, futex_ends)
}

const PER_LINE: u32 = 8;
const LINES: u32 = 64;

/// The floor of throughput: a ring that passes only full cache lines. A line holds eight messages
/// of 8 bytes, and the producer publishes it when it is full. This measures the cost of the cache
/// lines alone. It delays each message until its line is full, so it is not a practical channel.
pub(crate) fn full_lines(plan: &BatchPlan) -> io::Result<Batch> {
    let shared = SharedPage::with_case_words((2 + LINES as usize) * LINE)?;
    // The producer's count of lines, the consumer's, and the lines.
    let (made, taken) = (shared.line(0), shared.line(1));
    let lines = &shared.case()[2 * LINE..];
    let message = |k: u32| {
        let line = (k / PER_LINE % LINES) as usize;
        let at = line * LINE + 2 * (k % PER_LINE) as usize;
        [&lines[at], &lines[at + 1]]
    };
    let stream = Stream {
        chunk: 4096,
        payload_bytes: 8,
    };
    let sender = |_| {
        let (mut mine, mut theirs) = (0u32, 0);
        move |k: u32| {
            if k.is_multiple_of(PER_LINE) && mine - theirs == LINES {
                // Acquire pairs with the receiver's Release: the line has been read.
                theirs = taken.load(Acquire);
                if mine - theirs == LINES {
                    return false;
                }
            }
            let [low, high] = message(k);
            low.store(k, Relaxed);
            high.store(!k, Relaxed);
            if k % PER_LINE == PER_LINE - 1 {
                mine += 1;
                // Release pairs with the receiver's Acquire: the line is full.
                made.store(mine, Release);
            }
            true
        }
    };
    let receiver = |_| {
        let (mut k, mut theirs) = (0u32, 0);
        move || {
            if k.is_multiple_of(PER_LINE) && k / PER_LINE == theirs {
                // Acquire pairs with the sender's Release.
                theirs = made.load(Acquire);
                if k / PER_LINE == theirs {
                    return None;
                }
            }
            let [low, high] = message(k).map(|word| word.load(Relaxed));
            assert_eq!(low, !high);
            k += 1;
            if k.is_multiple_of(PER_LINE) {
                // Release pairs with the sender's Acquire.
                taken.store(k / PER_LINE, Release);
            }
            Some(low)
        }
    };
    from_processes::<_, _, 1>(plan, &shared, stream, sender, receiver)
}

/// Operations of a lock per sample.
pub(crate) const CHUNK: usize = 64;

/// A compare-and-swap that locks a free word and a store that unlocks it: the least work of a lock.
pub(crate) fn lock(plan: &BatchPlan) -> io::Result<Batch> {
    let shared = SharedPage::new()?;
    let word = shared.line(0);
    repeated(plan, &shared, CHUNK, || {
        || {
            let taken = word.compare_exchange(0, 1, Acquire, Relaxed);
            black_box(taken.is_ok());
            word.store(0, Release);
        }
    })
}

/// Polls of a word that another process holds, before this process yields the CPU.
const POLLS: u32 = 1000;

/// A word that is 1 while one process is inside.
struct Word(&'static AtomicU32);

impl Exclusion for Word {
    fn inside(&mut self, stay: impl FnOnce()) {
        let mut polls = 0;
        // Acquire pairs with the Release of the process that was inside before.
        while self.0.swap(1, Acquire) == 1 {
            while self.0.load(Relaxed) == 1 {
                polls += 1;
                if polls % POLLS == 0 {
                    give_way();
                } else {
                    spin_loop();
                }
            }
        }
        stay();
        self.0.store(0, Release);
    }
}

/// One word that several processes contend for, without turns: the process that unlocks it often
/// locks it again.
pub(crate) fn contended_word(plan: &BatchPlan, processes: usize) -> io::Result<Batch> {
    let shared = SharedPage::new()?;
    contended(plan, &shared, processes, |_| Word(shared.line(0)))
}
