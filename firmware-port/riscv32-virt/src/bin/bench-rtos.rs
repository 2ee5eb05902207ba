//! Counts the instructions from a task of FreeRTOS on core 0 to core 1 and back to the task.
//!
//! Hart 0 runs the kernel, hart 1 has none. The task signals core 1 through a mailbox and waits for
//! a notification; core 1's handler signals back; core 0's doorbell interrupt notifies the task.
//! Each round starts directly after a tick, so that no tick occurs within it.
#![no_std]
#![no_main]
#![deny(unsafe_code)]

use core::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use tandem_board::SystemId;
use tandem_board_riscv32_virt::{clint, doorbell, entry, exit, hart, measure, memory, must, task};
use tandem_rtos::{
    Interrupt, InterruptPriority, Kernel, LONGEST_SHIFT_NS, Priority, TaskContext, TaskOptions,
    TickSource, TickTime, Ticks,
};
use tandem_shm::mailbox::{Ring, Sender, TaskId, TaskTable};
use tandem_shm::map::{Layout, Map};
use tandem_shm::region::{Mailbox, Region};

entry!(main);

/// True when the LMU is formatted and hart 1 may attach.
static READY: AtomicBool = AtomicBool::new(false);
/// Number of signals that hart 1 has returned.
static BACK: AtomicU32 = AtomicU32::new(0);
/// The cycle at which hart 1 began to wake the task.
static BEGAN_AT: AtomicU32 = AtomicU32::new(0);
/// Whether the next doorbell rings without a signal.
static BARE: AtomicBool = AtomicBool::new(false);

/// The task of hart 1 that signals hart 0 at once.
const ANSWER: TaskId = task(1);
/// The task of hart 1 that waits until hart 0 is idle, and signals it.
const SIGNAL: TaskId = task(2);
/// The task of hart 1 that waits until hart 0 is idle, and interrupts it without a signal.
const INTERRUPT: TaskId = task(3);

fn main(hart: usize) -> ! {
    match hart {
        0 => control(),
        1 => answer(),
        _ => hart::park(),
    }
}

const MAILBOX_0_TO_1: Region<Mailbox> = Region::first("mailbox 0 to 1");
const MAILBOX_1_TO_0: Region<Mailbox> = MAILBOX_0_TO_1.then("mailbox 1 to 0");
const LAYOUT: Layout = MAILBOX_1_TO_0.end();

/// Hart 0: runs the kernel with one task.
fn control() -> ! {
    tandem_rtos::riscv32::on_fatal(|message| panic!("{message}"));
    let kernel = must(Kernel::take());
    let options = TaskOptions::new("measure", Priority::new(5)).stack_bytes(16 << 10);
    let measuring = must(kernel.spawn(&options, measure_all));
    must(Map::format(memory::lmu(SystemId::A), LAYOUT));
    let (map, own) = memory::attach(0, LAYOUT);
    let mut back = must(MAILBOX_1_TO_0.receiver(&map, own));
    // From now on core 1 rings core 0's doorbell for every signal: the interrupt is the only poll.
    back.poll(|_| ());
    assert!(back.prepare_sleep());
    let on_doorbell = move |ctx: &_| {
        if BARE.load(Ordering::Relaxed) {
            must(measuring.notify(ctx));
            return;
        }
        back.poll(|_| {
            BACK.store(BACK.load(Ordering::Relaxed) + 1, Ordering::Relaxed);
            must(measuring.notify(ctx));
        });
    };
    must(kernel.attach(Interrupt::DOORBELL, InterruptPriority::LOWEST, on_doorbell));
    READY.store(true, Ordering::Release);
    clint::post(1);
    must(kernel.start(TickSource::Wall));
    panic!("the kernel has stopped")
}

fn measure_all(ctx: &TaskContext) {
    let (map, own) = memory::attach(0, LAYOUT);
    let mut to = must(MAILBOX_0_TO_1.sender(&map, own));
    bench(ctx, "rtos/yield", || {
        // No other task is ready, so this measures one call of the kernel.
        let begin = hart::cycles();
        ctx.yield_now();
        hart::cycles().wrapping_sub(begin)
    });
    let mut expected = None;
    let mut by_ns = LONGEST_SHIFT_NS;
    bench(ctx, "rtos/shift-ticks", || {
        // Each tick is when the last round moved it to, and its interrupt within 10 µs of that.
        let (last, now_ns) = (ctx.last_tick(), hart::time() * clint::TICK_NS);
        assert!(
            expected.is_none_or(|it| it == last),
            "{expected:?} {last:?}"
        );
        assert!(now_ns - last.due_ns < 10_000, "{last:?} at {now_ns}");
        by_ns = -by_ns;
        let begin = hart::cycles();
        let is_moved = ctx.shift_ticks(by_ns);
        let took = hart::cycles().wrapping_sub(begin);
        assert!(is_moved && !ctx.shift_ticks(by_ns) && ctx.last_tick() == last);
        expected = Some(TickTime {
            count: last.count.after(Ticks(1)),
            due_ns: (last.due_ns + 1_000_000).saturating_add_signed(by_ns.into()),
        });
        took
    });
    bench(ctx, "rtos/round-trip", || {
        let before = BACK.load(Ordering::Relaxed);
        let begin = hart::cycles();
        ask(&mut to, ANSWER);
        ctx.take_notifications(Ticks::FOREVER);
        let took = hart::cycles().wrapping_sub(begin);
        assert!(BACK.load(Ordering::Relaxed) == before + 1);
        took
    });
    for (name, what) in [("task/floor", INTERRUPT), ("task/signal", SIGNAL)] {
        BARE.store(what == INTERRUPT, Ordering::Relaxed);
        bench(ctx, name, || {
            ask(&mut to, what);
            ctx.take_notifications(Ticks::FOREVER);
            hart::cycles().wrapping_sub(BEGAN_AT.load(Ordering::Relaxed))
        });
    }
    exit::exit(0)
}

fn ask(to: &mut Sender<'_>, what: TaskId) {
    if to.signal(what) == Ring::Needed {
        clint::post(1);
    }
}

/// Measures `round`, which returns its number of instructions. Each round starts after a tick.
fn bench(ctx: &TaskContext, name: &str, mut round: impl FnMut() -> u32) {
    measure::repeat(name, || ctx.delay(Ticks(1)), |_| round());
}

/// Hart 1: answers each signal.
fn answer() -> ! {
    hart::interrupts_on();
    while !READY.load(Ordering::Acquire) {
        doorbell::wait(None);
    }
    let (map, own) = memory::attach(1, LAYOUT);
    let mut from = must(MAILBOX_0_TO_1.receiver(&map, own));
    let mut to = must(MAILBOX_1_TO_0.sender(&map, own));
    let mut tasks = TaskTable::new();
    must(tasks.add(ANSWER, |to, _, _| signal(to), 0));
    must(tasks.add(SIGNAL, |to, _, _| when_idle(|| signal(to)), 0));
    must(tasks.add(INTERRUPT, |_, _, _| when_idle(|| clint::post(0)), 0));
    loop {
        tasks.run(&mut from, &mut to);
        if from.prepare_sleep() {
            doorbell::wait(None);
            from.awake();
        }
    }
}

fn signal(to: &mut Sender<'static>) {
    if to.signal(task(1)) == Ring::Needed {
        clint::post(0);
    }
}

/// Waits until hart 0 is idle, and wakes it.
fn when_idle(wake: impl FnOnce()) {
    (0..8).for_each(|_| hart::yield_turn());
    BEGAN_AT.store(hart::cycles(), Ordering::Relaxed);
    wake();
}
