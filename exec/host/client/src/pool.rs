//! The worker pool: one function over the elements of a list, in parallel (E-2).
//!
//! The elements are cut into blocks. A run moves each block into a slot of the pool, workers take
//! the slots in order, and the run moves the elements back. So a worker owns what it works on:
//! there is no borrowed closure, no `unsafe`, and no allocation in a run. What an element becomes
//! depends on the element, its index and the seed of the run, and on nothing else: the result is
//! that of one loop over the list, whatever the number of workers.
//!
//! A run locks one mutex once for each block. The calling thread does not compute. It is the
//! watchdog: if no block ends for the `patience` of the pool, it names the elements and aborts the
//! process, because safe code cannot stop a thread.

use std::io;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::Duration;

use tandem_exec::client::Random;

/// Blocks for each worker: a worker that has finished early takes over a part of the others' work.
const BLOCKS_PER_WORKER: usize = 8;
/// The largest number of workers.
pub const MAX_WORKERS: usize = 64;

/// Why a run has no result. The pool stays usable.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum PoolError {
    /// The function panicked for this element, and perhaps for later ones. All other elements were
    /// processed; this one is as the panic left it.
    #[error("the function of the worker pool panicked for element {index}")]
    Panicked {
        /// The first element for which it panicked.
        index: usize,
    },
    /// The list is longer than the pool was made for. Nothing was processed.
    #[error("a list of {len} elements for a worker pool of {capacity}")]
    TooMany {
        /// Its length.
        len: usize,
        /// The longest list that this pool takes.
        capacity: usize,
    },
}

/// A run, as its workers see it. Between runs all its blocks are taken.
#[derive(Clone, Copy, Debug, Default)]
struct Run {
    seed: u64,
    /// Elements in a block; the last one may have fewer.
    block_len: usize,
    blocks: usize,
    /// The next block that no worker has taken.
    next: usize,
    done: usize,
    panicked: Option<usize>,
    is_closing: bool,
}

struct Shared<E, W> {
    work: W,
    slots: Box<[Mutex<Vec<E>>]>,
    run: Mutex<Run>,
    begun: Condvar,
    ended: Condvar,
}

/// A pool of worker threads for one function, which gets each element with a generator of its own.
/// Dropping it ends the threads.
pub struct WorkerPool<E, W> {
    shared: Arc<Shared<E, W>>,
    workers: Vec<JoinHandle<()>>,
    capacity: usize,
    patience: Duration,
}

impl<E: Send + 'static, W: Fn(&mut E, &mut Random) + Send + Sync + 'static> WorkerPool<E, W> {
    /// Starts the workers (1 ..= [`MAX_WORKERS`]; other numbers are cut) for lists of at most
    /// `capacity` elements. A block that takes longer than `patience` ends the process.
    ///
    /// # Errors
    /// If the operating system refuses a thread.
    pub fn new(workers: usize, capacity: usize, patience: Duration, work: W) -> io::Result<Self> {
        let workers = workers.clamp(1, MAX_WORKERS);
        let blocks = workers * BLOCKS_PER_WORKER;
        let slot = || Mutex::new(Vec::with_capacity(capacity.div_ceil(blocks)));
        let shared = Arc::new(Shared {
            work,
            slots: (0..blocks).map(|_| slot()).collect(),
            run: Mutex::new(Run::default()),
            begun: Condvar::new(),
            ended: Condvar::new(),
        });
        let mut pool = Self {
            shared,
            workers: Vec::with_capacity(workers),
            capacity,
            patience,
        };
        for number in 0..workers {
            let shared = Arc::clone(&pool.shared);
            let thread = std::thread::Builder::new().name(format!("worker {number}"));
            pool.workers.push(thread.spawn(move || shared.serve())?);
        }
        Ok(pool)
    }

    /// Calls the function once for each element, in parallel, and returns when all are done.
    /// Blocks; does not allocate.
    ///
    /// # Errors
    /// [`PoolError`]
    pub fn run(&mut self, elements: &mut Vec<E>, seed: u64) -> Result<(), PoolError> {
        let (len, capacity) = (elements.len(), self.capacity);
        if len > capacity {
            return Err(PoolError::TooMany { len, capacity });
        }
        let slots = &self.shared.slots;
        let block_len = len.div_ceil(slots.len()).max(1);
        let blocks = len.div_ceil(block_len);
        let mut rest = elements.drain(..);
        for slot in slots.iter().take(blocks) {
            lock(slot).extend(rest.by_ref().take(block_len));
        }
        drop(rest);
        let mut run = lock(&self.shared.run);
        *run = Run {
            seed,
            block_len,
            blocks,
            ..Run::default()
        };
        if blocks >= self.workers.len() {
            self.shared.begun.notify_all();
        } else {
            (0..blocks).for_each(|_| self.shared.begun.notify_one());
        }
        while run.done < run.blocks {
            let (done, timeout) = (run.done, self.patience);
            let waited = self.shared.ended.wait_timeout(run, timeout);
            let (guard, waited) = waited.unwrap_or_else(PoisonError::into_inner);
            run = guard;
            if waited.timed_out() && run.done == done {
                hung(&run, timeout);
            }
        }
        let panicked = run.panicked;
        drop(run);
        for slot in slots.iter().take(blocks) {
            elements.append(&mut lock(slot));
        }
        panicked.map_or(Ok(()), |index| Err(PoolError::Panicked { index }))
    }
}

/// Tells which elements were not done in time, and ends the process.
fn hung(run: &Run, patience: Duration) -> ! {
    let end = run.next * run.block_len;
    eprintln!(
        "worker pool: no block of {} elements ended in {patience:?}; {} of {} blocks are done, \
         one of the elements below {end} hangs",
        run.block_len, run.done, run.blocks
    );
    std::process::abort()
}

impl<E, W: Fn(&mut E, &mut Random)> Shared<E, W> {
    /// Processes blocks until the pool closes.
    fn serve(&self) {
        let mut run = lock(&self.run);
        loop {
            if run.is_closing {
                return;
            }
            if run.next == run.blocks {
                run = self.begun.wait(run).unwrap_or_else(PoisonError::into_inner);
                continue;
            }
            let (block, seen) = (run.next, *run);
            run.next += 1;
            drop(run);
            let panicked = self.process(block, &seen);
            run = lock(&self.run);
            run.done += 1;
            // The first one, whichever worker was first.
            run.panicked = run.panicked.into_iter().chain(panicked).min();
            if run.done == run.blocks {
                self.ended.notify_one();
            }
        }
    }

    /// Processes the elements of a block in order. Returns the first for which the work panicked.
    fn process(&self, block: usize, run: &Run) -> Option<usize> {
        let mut elements = lock(self.slots.get(block)?);
        let mut panicked = None;
        for (index, element) in (block * run.block_len..).zip(elements.iter_mut()) {
            let mut random = Random::of_element(run.seed, index as u64);
            // Each on its own: what becomes of the others must not depend on the blocks.
            let done = catch_unwind(AssertUnwindSafe(|| (self.work)(element, &mut random)));
            if done.is_err() {
                panicked = panicked.or(Some(index));
            }
        }
        panicked
    }
}

impl<E, W> Drop for WorkerPool<E, W> {
    fn drop(&mut self) {
        lock(&self.shared.run).is_closing = true;
        self.shared.begun.notify_all();
        for worker in self.workers.drain(..) {
            // It has no result, and its panics were caught.
            let _ = worker.join();
        }
    }
}

/// No lock is held while a panic unwinds, except that of elements, which stay what they are.
fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
