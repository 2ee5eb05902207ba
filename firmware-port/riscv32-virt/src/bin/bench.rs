//! Counts the instructions of the paths between cores.
//!
//! Hart 0 measures, hart 1 answers, hart 2 contends. Under `-icount shift=0` all harts share one
//! cycle counter, which counts the instructions of the running hart. So the difference between two
//! harts' readings is the length of the path between them. Prints `bench NAME MIN MAX` for each.
#![no_std]
#![no_main]
#![deny(unsafe_code)]

use core::cell::UnsafeCell;
use core::ffi::c_void;
use core::ptr::null_mut;
use core::sync::atomic::{AtomicBool, AtomicPtr, AtomicU32, Ordering};
use embassy_sync::blocking_mutex::raw::RawMutex;
use embassy_sync::channel::Channel;
use heapless::spsc;
use tandem_board::SystemId;
use tandem_board_riscv32_virt::measure::{self, ROUNDS, WARM_UP};
use tandem_board_riscv32_virt::{clint, doorbell, entry, exit, hart, memory, must, task, trap};
use tandem_shm::incarnation::Incarnation;
use tandem_shm::lock::Lock;
use tandem_shm::mailbox::{Call, Ring, TaskId, TaskTable};
use tandem_shm::map::{Layout, Map};
use tandem_shm::region::{Fifo, Mailbox, Newest, Region, SharedLock, SharedPool};
use tandem_shm::{fifo, newest};

entry!(main);

const MAILBOX_0_TO_1: Region<Mailbox> = Region::first("mailbox 0 to 1");
const FIFO_0_TO_1: Region<Fifo<u32, 4>> = MAILBOX_0_TO_1.then("fifo 0 to 1");
const NEWEST_0_TO_1: Region<Newest<u32>> = FIFO_0_TO_1.then("newest value 0 to 1");
const LOCK: Region<SharedLock> = NEWEST_0_TO_1.then("lock");
const POOL: Region<SharedPool<64>> = LOCK.then("pool");
const LAYOUT: Layout = POOL.end();
const PLAIN: TaskId = task(1);
const NEWEST: TaskId = task(2);
const FIFO: TaskId = task(3);
const VALUE: TaskId = task(4);
const STOP: TaskId = task(5);

/// Cycle at which hart 1 was reached last, and how often it was reached.
static SEEN_AT: AtomicU32 = AtomicU32::new(0);
static SEEN: AtomicU32 = AtomicU32::new(0);
/// The current work of harts 1 and 2.
static PART: AtomicU32 = AtomicU32::new(0);
const WFI: u32 = 1;
const DOORBELL: u32 = 2;
const MAILBOX: u32 = 3;
const CONTEND: u32 = 4;
const SPSC: u32 = 5;
const CHANNEL: u32 = 6;
const BUFFER: u32 = 7;
/// The contended lock: the current round, the number of harts that have ended it, the last cycle.
static GO: AtomicU32 = AtomicU32::new(0);
static ENDED: AtomicU32 = AtomicU32::new(0);
static LAST_AT: AtomicU32 = AtomicU32::new(0);

/// A value that hart 0 hands over to hart 1: a peer's queue, or one end of it.
struct Handed<T>(UnsafeCell<T>);

// SAFETY: hart 0 uses the value until it stores `PART` with Release; hart 1 uses it after it has
// read `PART` with Acquire; hart 0 does not use it again.
#[allow(unsafe_code)]
unsafe impl<T: Send> Sync for Handed<T> {}

impl<T> Handed<T> {
    /// Returns the value, for the hart that owns it now.
    ///
    /// # Safety
    /// Each hart calls this at most once, hart 1 only after it has read its part from `PART`.
    #[allow(unsafe_code, clippy::mut_from_ref)]
    unsafe fn value(&self) -> &mut T {
        // SAFETY: as above.
        unsafe { &mut *self.0.get() }
    }
}

static QUEUE: Handed<spsc::Queue<u32, 5>> = Handed(UnsafeCell::new(spsc::Queue::new()));
static CONSUMER: Handed<Option<spsc::Consumer<'static, u32>>> = Handed(UnsafeCell::new(None));

/// The smallest mutex for embassy-sync between several cores: a spin lock with interrupts off.
struct HartMutex(AtomicBool);

// SAFETY: one hart is inside at a time, and its interrupts are off.
#[allow(unsafe_code)]
unsafe impl RawMutex for HartMutex {
    const INIT: Self = Self(AtomicBool::new(false));

    fn lock<R>(&self, work: impl FnOnce() -> R) -> R {
        hart::without_interrupts(|| {
            // Acquire pairs with the Release below, in the hart that was inside before.
            while self.0.swap(true, Ordering::Acquire) {
                hart::yield_turn();
            }
            let result = work();
            self.0.store(false, Ordering::Release);
            result
        })
    }
}

static EMBASSY: Channel<HartMutex, u32, 4> = Channel::new();

/// Bytes of FreeRTOS's message buffer: room for each message of a run with its length, so that it
/// does not wrap around: wrapping takes 4 more instructions.
const BYTES: usize = 8 * (WARM_UP + ROUNDS + 1) as usize;
/// The memory of FreeRTOS's message buffer: for the messages, and for its state.
static MESSAGES: Handed<([u8; BYTES], [u32; 16])> = Handed(UnsafeCell::new(([0; BYTES], [0; 16])));
/// The handle of the message buffer that the kernel returned.
static BUFFER_AT: AtomicPtr<c_void> = AtomicPtr::new(null_mut());
/// The type of buffer for `xStreamBufferGenericCreateStatic`.
const MESSAGE_BUFFER: i32 = 1;

// SAFETY: as in stream_buffer.h of the kernel: `size_t`, pointers, `BaseType_t` and `TickType_t`
// have 32 bits here. One hart may send and one receive.
#[allow(unsafe_code)]
unsafe extern "C" {
    fn xStreamBufferGenericCreateStatic(
        bytes: usize,
        trigger: usize,
        kind: i32,
        memory: *mut u8,
        state: *mut u32,
        sent: *const c_void,
        received: *const c_void,
    ) -> *mut c_void;
    fn xStreamBufferSend(buffer: *mut c_void, data: *const u32, bytes: usize, ticks: u32) -> usize;
    fn xStreamBufferReceive(buffer: *mut c_void, to: *mut u32, bytes: usize, ticks: u32) -> usize;
}

fn main(hart: usize) -> ! {
    match hart {
        0 => measure_all(),
        1 => answer(),
        2 => contend(2),
        _ => hart::park(),
    }
}

/// Waits until all other harts are idle.
fn settle() {
    (0..8).for_each(|_| hart::yield_turn());
}

/// Measures `round`, which returns its number of instructions. Other harts are idle when it starts.
fn bench(name: &str, round: impl FnMut(u32) -> u32) {
    measure::repeat(name, settle, round);
}

/// Returns the number of instructions from `act` until hart 1 is reached.
fn reach(act: impl FnOnce()) -> u32 {
    let before = SEEN.load(Ordering::Relaxed);
    let begin = hart::cycles();
    act();
    hart::yield_until(|| SEEN.load(Ordering::Acquire) != before);
    SEEN_AT.load(Ordering::Relaxed).wrapping_sub(begin)
}

/// Stores the cycle. Hart 1 calls this when it is reached.
#[inline(always)]
fn reached() {
    let at = hart::cycles();
    SEEN_AT.store(at, Ordering::Relaxed);
    SEEN.store(SEEN.load(Ordering::Relaxed) + 1, Ordering::Release);
}

/// Rings hart 1, which must be asleep.
fn ring(ring: Ring) {
    match ring {
        Ring::Needed => clint::post(1),
        Ring::NotNeeded => panic!("awake: no figure of a core that sleeps"),
    }
}

fn measure_all() -> ! {
    must(Map::format(memory::lmu(SystemId::A), LAYOUT));
    let (map, own) = memory::attach(0, LAYOUT);
    let mut to = must(MAILBOX_0_TO_1.sender(&map, own));
    let mut queue = must(FIFO_0_TO_1.producer(&map, own));
    let mut newest = must(NEWEST_0_TO_1.writer(&map, own));
    let mut lock = must(LOCK.attach(&map, own));
    let pool = must(POOL.attach(&map, own));

    bench("clock/two-readings", |_| {
        let begin = hart::cycles();
        hart::cycles().wrapping_sub(begin)
    });
    bench("interrupt/floor", |_| reach(|| clint::post(1)));
    let part = |part| {
        PART.store(part, Ordering::Release);
        clint::post(1);
    };
    part(WFI);
    bench("wfi/floor", |_| reach(|| clint::post(1)));
    part(DOORBELL);
    bench("doorbell/floor", |_| reach(|| clint::post(1)));

    peers(part);
    part(MAILBOX);
    bench("mailbox/signal-to-handler", |_| {
        reach(|| ring(to.signal(PLAIN)))
    });
    bench("mailbox/4-bytes", |number| {
        reach(|| ring(to.signal_with(VALUE, number)))
    });
    bench("channel/4-bytes", |number| {
        reach(|| {
            newest.publish(&number);
            ring(to.signal(NEWEST));
        })
    });
    // The result varies: each end reads the other's index only when its own copy is too old.
    bench("fifo/4-bytes", |number| {
        reach(|| {
            must(queue.send(&number));
            ring(to.signal(FIFO));
        })
    });

    bench("lock/free", |_| {
        let begin = hart::cycles();
        drop(must(lock.lock(1, |_| ())));
        hart::cycles().wrapping_sub(begin)
    });
    ring(to.signal(STOP));
    part(CONTEND);
    clint::post(2);
    bench("lock/contended-3", |number| {
        ENDED.store(0, Ordering::Relaxed);
        let begin = hart::cycles();
        GO.store(number + 1, Ordering::Release);
        take(&mut lock);
        hart::yield_until(|| ENDED.load(Ordering::Acquire) == 3);
        LAST_AT.load(Ordering::Relaxed).wrapping_sub(begin)
    });
    bench("pool/get-give", |_| {
        let begin = hart::cycles();
        let handle = must(pool.get(16));
        must(pool.give_back(handle));
        hart::cycles().wrapping_sub(begin)
    });
    exit::exit(0)
}

/// Measures three other libraries on the same path; the board's doorbell wakes the receiver.
#[inline(never)]
#[allow(unsafe_code)]
fn peers(part: impl Fn(u32)) {
    // SAFETY: hart 0 calls this once, and has not yet stored the part of hart 1.
    let (mut producer, consumer) = unsafe { QUEUE.value() }.split();
    // SAFETY: as above.
    *unsafe { CONSUMER.value() } = Some(consumer);
    part(SPSC);
    bench("heapless/spsc-4-bytes", |number| {
        reach(|| {
            must(producer.enqueue(number));
            clint::post(1);
        })
    });
    part(CHANNEL);
    bench("embassy/channel-4-bytes", |number| {
        reach(|| {
            must(EMBASSY.try_send(number));
            clint::post(1);
        })
    });
    // SAFETY: as above; the memory has `BYTES` bytes, and the kernel's state has at most 9 words.
    let buffer = unsafe {
        let (memory, state) = MESSAGES.value();
        let (memory, state) = (memory.as_mut_ptr(), state.as_mut_ptr());
        let none = null_mut();
        xStreamBufferGenericCreateStatic(BYTES, 1, MESSAGE_BUFFER, memory, state, none, none)
    };
    BUFFER_AT.store(buffer, Ordering::Release);
    part(BUFFER);
    bench("freertos/message-buffer-4-bytes", |number| {
        reach(|| {
            // SAFETY: only this hart sends, 4 bytes from a valid address, without waiting.
            let sent = unsafe { xStreamBufferSend(buffer, &number, 4, 0) };
            assert!(sent == 4);
            clint::post(1);
        })
    });
}

/// Takes the lock, yields so that the other harts find it taken, and releases it.
fn take(lock: &mut Lock<'_>) {
    let guard = must(lock.lock(10_000, |_| hart::yield_turn()));
    hart::yield_turn();
    drop(guard);
    LAST_AT.store(hart::cycles(), Ordering::Relaxed);
    ENDED.fetch_add(1, Ordering::Release);
}

/// Hart 1: first only wakes, in three ways, then receives through three peers and the mailbox, and
/// then contends for the lock.
fn answer() -> ! {
    let (map, own) = memory::attach(1, LAYOUT);
    trap::on_doorbell(reached);
    hart::interrupts_on();
    while PART.load(Ordering::Acquire) != WFI {
        hart::sleep();
    }
    trap::on_doorbell(|| ());
    wake_by_wfi();
    wake_by_doorbell();
    wake_by_spsc();
    wake_by_embassy();
    wake_by_message_buffer();
    wake_by_mailbox(&map, own)
}

/// Measures the minimum: `wfi` wakes the hart without a trap, and the hart clears the interrupt.
#[inline(never)]
fn wake_by_wfi() {
    hart::interrupts_off();
    while PART.load(Ordering::Acquire) == WFI {
        hart::sleep();
        clint::clear(1);
        reached();
    }
    hart::interrupts_on();
}

/// Like `wake_by_wfi`, but the board's wait also checks the interrupt, a reset, and the deadline.
#[inline(never)]
fn wake_by_doorbell() {
    while PART.load(Ordering::Acquire) == DOORBELL {
        doorbell::wait(None);
        reached();
    }
}

#[inline(never)]
#[allow(unsafe_code)]
fn wake_by_spsc() {
    // SAFETY: hart 1 calls this once, after it has read its part from `PART`.
    let Some(mut consumer) = unsafe { CONSUMER.value() }.take() else {
        return;
    };
    while PART.load(Ordering::Acquire) == SPSC {
        doorbell::wait(None);
        if let Some(value) = consumer.dequeue() {
            core::hint::black_box(value);
            reached();
        }
    }
}

#[inline(never)]
fn wake_by_embassy() {
    while PART.load(Ordering::Acquire) == CHANNEL {
        doorbell::wait(None);
        if let Ok(value) = EMBASSY.try_receive() {
            core::hint::black_box(value);
            reached();
        }
    }
}

#[inline(never)]
#[allow(unsafe_code)]
fn wake_by_message_buffer() {
    let buffer = BUFFER_AT.load(Ordering::Acquire);
    while PART.load(Ordering::Acquire) == BUFFER {
        doorbell::wait(None);
        let mut value = 0;
        // SAFETY: only this hart receives, 4 bytes to a valid address, without waiting.
        if unsafe { xStreamBufferReceive(buffer, &mut value, 4, 0) } == 4 {
            core::hint::black_box(value);
            reached();
        }
    }
}

#[inline(never)]
fn wake_by_mailbox(map: &Map<'static>, own: Incarnation) -> ! {
    let mut from = must(MAILBOX_0_TO_1.receiver(map, own));
    let mut values = Values {
        queue: must(FIFO_0_TO_1.consumer(map, own)),
        newest: must(NEWEST_0_TO_1.reader(map)),
    };
    let mut tasks = TaskTable::new();
    must(tasks.add(PLAIN, |_, _, _| reached(), 0));
    must(tasks.add(VALUE, Values::signalled, 0));
    must(tasks.add(NEWEST, Values::newest, 0));
    must(tasks.add(FIFO, Values::first, 0));
    must(tasks.add(STOP, |_, _, _| contend(1), 0));
    loop {
        tasks.run(&mut from, &mut values);
        if from.prepare_sleep() {
            doorbell::wait(None);
            from.awake();
        }
    }
}

/// The receiving ends of the channels. Their tasks call `reached` after they have read the value.
struct Values {
    queue: fifo::Consumer<'static, u32, 4>,
    newest: newest::Reader<'static, u32>,
}

impl Values {
    fn signalled(&mut self, _: u32, call: Call) {
        core::hint::black_box(call.value);
        reached();
    }

    fn newest(&mut self, _: u32, _: Call) {
        if self.newest.read().is_ok() {
            reached();
        }
    }

    fn first(&mut self, _: u32, _: Call) {
        if let Ok(Some(_)) = self.queue.receive() {
            reached();
        }
    }
}

/// Harts 1 and 2: take the lock once in each round.
fn contend(hart: usize) -> ! {
    let (map, own) = memory::attach(hart, LAYOUT);
    let mut lock = must(LOCK.attach(&map, own));
    while PART.load(Ordering::Acquire) != CONTEND {
        doorbell::wait(None);
    }
    let mut round = 0;
    loop {
        hart::yield_until(|| GO.load(Ordering::Acquire) != round);
        round = GO.load(Ordering::Relaxed);
        take(&mut lock);
    }
}
