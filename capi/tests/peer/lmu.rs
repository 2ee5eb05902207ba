//! The LMU of the test: a file that both processes map, and the Rust ends of core 0.

use crate::build::peer;
use core::sync::atomic::{AtomicU32, Ordering};
use std::fs::File;
use std::os::fd::AsRawFd;
use std::process::{Child, Command, ExitStatus};
use std::time::{Duration, Instant};
use tandem_shm::incarnation::Incarnation;
use tandem_shm::lock::Lock;
use tandem_shm::map::{Layout, Map};
use tandem_shm::pool::Pool;
use tandem_shm::region::{Broadcast, Fifo, Mailbox, Newest, Region, SharedLock, SharedPool, Words};
use tandem_shm::{fifo, mailbox};
use tempfile::NamedTempFile;

/// Words of an order without its number, which follows as the last word.
pub(crate) const ORDER_WORDS: usize = 12;
pub(crate) const ANSWER_WORDS: usize = 48;
pub(crate) const NEWEST_WORDS: usize = 8;
pub(crate) const RING_WORDS: usize = 5;
const BLOCKS: usize = 8;

type OrderWords = [u32; ORDER_WORDS + 1];
type AnswerWords = [u32; ANSWER_WORDS];

// These regions must be the same as in layout.h.
const TO_C: Region<Mailbox> = Region::first("to c");
const FROM_C: Region<Mailbox> = TO_C.then("from c");
const LOCK: Region<SharedLock> = FROM_C.then("lock");
const GUARDED: Region<Words<2>> = LOCK.then("guarded");
const ORDERS: Region<Fifo<OrderWords, 4>> = GUARDED.then("orders");
const ANSWERS: Region<Fifo<AnswerWords, 4>> = ORDERS.then("answers");
pub(crate) const NEWEST: Region<Newest<[u32; NEWEST_WORDS]>> = ANSWERS.then("newest");
pub(crate) const RING: Region<Broadcast<[u32; RING_WORDS], 4>> = NEWEST.then("ring");
const POOL: Region<SharedPool<BLOCKS>> = RING.then("pool");
const LAYOUT: Layout = POOL.end();

const LMU_WORDS: usize = 8192;
const TASK_ORDERS: u8 = 1;
const TASK_ANSWERS: u8 = 2;
/// Far longer than any answer takes. It only limits the time until a failure is reported.
const PATIENCE: Duration = Duration::from_secs(60);

/// The orders to core 1, with the same numbers as in layout.h.
#[derive(Clone, Copy)]
pub(crate) enum Order {
    Echo = 1,
    Count,
    Publish,
    Broadcast,
    PoolSwap,
    DieLocked,
    Recover,
    Redundancy,
    Stop,
}

/// A process that is killed when it is dropped.
pub(crate) struct Peer(Child);

impl Peer {
    pub(crate) fn wait(&mut self) -> ExitStatus {
        self.0.wait().unwrap()
    }

    pub(crate) fn kill(&mut self) {
        self.0.kill().unwrap();
        self.0.wait().unwrap();
    }
}

impl Drop for Peer {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Maps the file until the test process ends.
fn shared(file: &File) -> &'static [AtomicU32] {
    file.set_len(4 * LMU_WORDS as u64).unwrap();
    // SAFETY: a new mapping of a file of this size, which is never unmapped; only atomics view it.
    unsafe {
        let (protection, flags) = (libc::PROT_READ | libc::PROT_WRITE, libc::MAP_SHARED);
        let base = libc::mmap(
            core::ptr::null_mut(),
            4 * LMU_WORDS,
            protection,
            flags,
            file.as_raw_fd(),
            0,
        );
        assert_ne!(base, libc::MAP_FAILED);
        core::slice::from_raw_parts(base.cast(), LMU_WORDS)
    }
}

/// Core 0 and its ends in the LMU.
pub(crate) struct Bench {
    file: NamedTempFile,
    map: Map<'static>,
    to: mailbox::Sender<'static>,
    from: mailbox::Receiver<'static>,
    orders: fifo::Producer<'static, OrderWords, 4>,
    answers: fifo::Consumer<'static, AnswerWords, 4>,
    /// Number of orders that were sent: the value of each signal, and of the answer's signal.
    sent: u32,
    since: Instant,
}

impl Bench {
    pub(crate) fn new() -> Self {
        let file = NamedTempFile::with_prefix("tandem-capi-lmu-").unwrap();
        let map = Map::format(shared(file.as_file()), LAYOUT).unwrap();
        let own = Incarnation::new(0, 1).unwrap();
        map.incarnations().announce(own).unwrap();
        Self {
            file,
            map,
            to: TO_C.sender(&map, own).unwrap(),
            from: FROM_C.receiver(&map, own).unwrap(),
            orders: ORDERS.producer(&map, own).unwrap(),
            answers: ANSWERS.consumer(&map, own).unwrap(),
            sent: 0,
            since: Instant::now(),
        }
    }

    /// Starts an incarnation of core 1.
    pub(crate) fn start(&mut self, generation: u32) -> Peer {
        self.since = Instant::now();
        let mut command = Command::new(peer());
        command.arg(self.file.path()).arg(generation.to_string());
        Peer(command.spawn().unwrap())
    }

    pub(crate) fn map(&self) -> Map<'static> {
        self.map
    }

    pub(crate) fn lock(&self, core: usize, generation: u32) -> Lock<'static> {
        let incarnation = Incarnation::new(core, generation).unwrap();
        self.map.incarnations().announce(incarnation).unwrap();
        LOCK.attach(&self.map, incarnation).unwrap()
    }

    pub(crate) fn pool(&self, core: usize, generation: u32) -> Pool<'static> {
        let incarnation = Incarnation::new(core, generation).unwrap();
        POOL.attach(&self.map, incarnation).unwrap()
    }

    pub(crate) fn guarded(&self) -> [u32; 2] {
        let words = GUARDED.attach(&self.map).unwrap();
        [0, 1].map(|at: usize| words[at].load(Ordering::Relaxed))
    }

    pub(crate) fn set_guarded(&self, values: [u32; 2]) {
        for (word, value) in GUARDED.attach(&self.map).unwrap().iter().zip(values) {
            word.store(value, Ordering::Relaxed);
        }
    }

    pub(crate) fn send(&mut self, order: &[u32]) {
        self.since = Instant::now();
        self.sent += 1;
        let mut words = [0; ORDER_WORDS + 1];
        words[..order.len()].copy_from_slice(order);
        words[ORDER_WORDS] = self.sent;
        self.orders.send(&words).unwrap();
        // C polls, so its doorbell need not be rung as on a chip.
        let task = mailbox::TaskId::new(TASK_ORDERS).unwrap();
        let _ = self.to.signal_with(task, self.sent);
    }

    /// Yields to other processes, and fails if the last order was sent too long ago.
    pub(crate) fn watch(&self) {
        assert!(self.since.elapsed() < PATIENCE, "C does not answer");
        std::thread::yield_now();
    }

    pub(crate) fn answer(&mut self) -> [u32; ANSWER_WORDS] {
        let answer = loop {
            match self.answers.receive().unwrap() {
                Some(answer) => break answer,
                None => self.watch(),
            }
        };
        // C sends the signal after the answer.
        loop {
            let mut came = Vec::new();
            self.from.poll(|signals| came.push(signals));
            if let [signals] = came[..] {
                let task = mailbox::TaskId::new(TASK_ANSWERS).unwrap();
                let (count, value) = (1, self.sent);
                assert_eq!(signals, mailbox::Signals { task, count, value });
                return answer;
            }
            assert!(came.is_empty(), "one signal an answer");
            self.watch();
        }
    }

    pub(crate) fn ask(&mut self, order: &[u32]) -> [u32; ANSWER_WORDS] {
        self.send(order);
        let answer = self.answer();
        assert_eq!(answer[0], order[0]);
        answer
    }

    /// Removes the next order, which the dead core received but did not release.
    pub(crate) fn drop_order(&self) {
        let stand_in = Incarnation::new(2, self.sent).unwrap();
        self.map.incarnations().announce(stand_in).unwrap();
        let taken = ORDERS.consumer(&self.map, stand_in).unwrap().receive();
        assert!(matches!(taken, Ok(Some(_))));
    }

    pub(crate) fn stop(mut self, mut child: Peer) {
        self.ask(&[Order::Stop as u32]);
        assert!(child.wait().success());
    }
}
