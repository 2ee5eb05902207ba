//! Litmus tests of the emulator's memory: which reorderings do two harts see?
//!
//! Hart 0 and 1 run with a host thread each. In a round they go through [`PLACES`] places at the
//! same time, each with a pair of words of its own on two lines; then the outcomes are counted.
//! Prints for each test how often the outcome was seen that no sequentially consistent memory
//! shows. Fails if one was seen that the orderings forbid.
#![no_std]
#![no_main]
#![deny(unsafe_code)]

use core::sync::atomic::Ordering::{AcqRel, Acquire, Relaxed, Release, SeqCst};
use core::sync::atomic::{AtomicU32, Ordering, fence};
use tandem_board_riscv32_virt::{entry, exit, hart, log};

entry!(main);

const PLACES: usize = 512;
const ROUNDS: u32 = 2_000;

/// A word on a line of its own.
#[repr(align(64))]
struct Word(AtomicU32);

impl Word {
    const fn new() -> Self {
        Self(AtomicU32::new(0))
    }
}

static X: [Word; PLACES] = [const { Word::new() }; PLACES];
static Y: [Word; PLACES] = [const { Word::new() }; PLACES];
/// What the harts read at each place: bits 0 and 1, or 1 for both.
static READ: [[AtomicU32; PLACES]; 2] = [const { [const { AtomicU32::new(0) }; PLACES] }; 2];
/// Harts that have come to the barrier, ever.
static ARRIVED: Word = Word::new();

/// One test: what each hart does at a place, and the pair of readings that is weak.
struct Litmus {
    name: &'static str,
    harts: [fn(&AtomicU32, &AtomicU32) -> u32; 2],
    weak: [u32; 2],
    /// A pair of readings that shows that the harts were at the place at the same time.
    at_once: [u32; 2],
    is_forbidden: bool,
}

/// Stores to the first word, then loads the second one.
fn store_load(x: &AtomicU32, y: &AtomicU32) -> u32 {
    x.store(1, Relaxed);
    y.load(Relaxed)
}

fn store_fence_load(x: &AtomicU32, y: &AtomicU32) -> u32 {
    x.store(1, Relaxed);
    fence(SeqCst);
    y.load(Relaxed)
}

/// Stores the data, then the flag.
fn send(flag: Ordering, data: &AtomicU32, to: &AtomicU32) -> u32 {
    data.store(1, Relaxed);
    to.store(1, flag);
    0
}

/// The flag in bit 0, the data in bit 1.
fn receive(flag: Ordering, data: &AtomicU32, from: &AtomicU32) -> u32 {
    let flag = from.load(flag);
    flag | data.load(Relaxed) << 1
}

/// Loads the second word, then stores to the first one.
fn load_store(x: &AtomicU32, y: &AtomicU32) -> u32 {
    let seen = y.load(Relaxed);
    x.store(1, Relaxed);
    seen
}

const TESTS: [Litmus; 5] = [
    Litmus {
        name: "store buffering, relaxed",
        harts: [store_load, |x, y| store_load(y, x)],
        weak: [0, 0],
        at_once: [1, 1],
        is_forbidden: false,
    },
    Litmus {
        name: "store buffering, fences",
        harts: [store_fence_load, |x, y| store_fence_load(y, x)],
        weak: [0, 0],
        at_once: [1, 1],
        is_forbidden: true,
    },
    Litmus {
        name: "message passing, relaxed",
        harts: [|x, y| send(Relaxed, x, y), |x, y| receive(Relaxed, x, y)],
        weak: [0, 1],
        at_once: [0, 2],
        is_forbidden: false,
    },
    Litmus {
        name: "message passing, release and acquire",
        harts: [|x, y| send(Release, x, y), |x, y| receive(Acquire, x, y)],
        weak: [0, 1],
        at_once: [0, 2],
        is_forbidden: true,
    },
    Litmus {
        name: "load buffering, relaxed",
        harts: [load_store, |x, y| load_store(y, x)],
        weak: [1, 1],
        at_once: [0, 0],
        is_forbidden: false,
    },
];

fn main(hart: usize) -> ! {
    if hart > 1 {
        loop {
            hart::sleep();
        }
    }
    let mut failed = false;
    let mut barriers = 0;
    let mut barrier = || {
        barriers += 2;
        ARRIVED.0.fetch_add(1, AcqRel);
        while ARRIVED.0.load(Acquire) < barriers {}
    };
    for litmus in TESTS {
        let (mut weak, mut at_once) = (0, 0);
        for _ in 0..ROUNDS {
            barrier();
            for place in 0..PLACES {
                let read = litmus.harts[hart](&X[place].0, &Y[place].0);
                READ[hart][place].store(read, Relaxed);
            }
            barrier();
            if hart == 0 {
                for place in 0..PLACES {
                    let read = [0, 1].map(|hart| READ[hart][place].load(Relaxed));
                    weak += u32::from(read == litmus.weak);
                    at_once += u32::from(read == litmus.at_once);
                    X[place].0.store(0, Relaxed);
                    Y[place].0.store(0, Relaxed);
                }
            }
        }
        if hart == 0 {
            let all = ROUNDS * PLACES as u32;
            let name = litmus.name;
            log!("{name}: {weak} weak outcomes of {all}; at least {at_once} met");
            failed |= litmus.is_forbidden && weak != 0;
        }
    }
    if hart == 0 {
        exit::exit(u16::from(failed));
    }
    loop {
        hart::sleep();
    }
}
