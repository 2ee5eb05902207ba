//! The sync mailbox: one core signals tasks of another core by id; no signal is lost. T-SYNC-1..3
//!
//! Each ordered pair of cores has one mailbox, so each word has one writer and no operation is a
//! read-modify-write. For each id (1 ..= 15; 0 means none) the sender counts the signals that it
//! has sent and the receiver those that it has handled; the difference is the number of open
//! signals. One word, *posted*, holds the number of all signals so far and the id of the last one.
//! The sender posts a signal, passes the fence that the sleeper's flag needs, and then counts
//! it. So a count that the receiver reads includes only posted signals. After a post all counts
//! include the signals before that one; only the last signal may be posted and not yet counted.
//!
//! The receiver compares that number with the number of signals that it has handled. If it is
//! higher by one, exactly one signal is open, and its id is the posted one: the receiver handles it
//! without reading a count. Otherwise it compares all counts, and then reads the posted word again.
//! If it is the same, the counts include no later signal, so the number of handled signals shows
//! whether they include the last one; its id is the posted one. If the word has changed, the next
//! poll compares again.
//!
//! A signal may carry a value of 32 bits, which lies beside its count: [`Sender::signal_with`]. The
//! task gets the newest value. Count and value of the ids 1 ..= 7 lie in the same cache line as the
//! posted word, so such a signal with its value moves only *one* line from core to core, the
//! minimum on this hardware.
//!
//! Order: the receiver handles all open signals of one id together and passes their number. If
//! several ids are open at one poll, it handles the lower id first: the id is a priority; the order
//! of sending is not kept.
//!
//! The doorbell is rung only when the receiver may be asleep. Sender: post, fence, read `asleep`.
//! Receiver: set `asleep`, fence, read what is posted. With sequentially consistent fences at least
//! one of them sees the other's write (E. W. Dijkstra, "Cooperating sequential processes", 1965,
//! section 2.1). While the receiver is awake its flag does not change, so the sender reads it from
//! its own cache.
//!
//! A successor of either end continues with the counters: if the receiver dies before a handler has
//! returned, its successor handles that signal, so a handler runs at least once for each signal.
//!
//! Limit: a sender keeps private copies of its counters and only stores. If an incarnation that was
//! declared dead still runs and signals beside its successor, it stores an old count: a signal of
//! the successor may be handled only after the next signal to that task, or a handler gets a wrong
//! count. A board must end an incarnation (host: kill it, chip: reset) before the next one starts.

use crate::shape::{FitError, LINE_WORDS, fit_exactly};
use crate::sync::{AtomicU32, Ordering, fence};

/// Words of a mailbox.
pub const WORDS: usize = 4 * LINE_WORDS;

/// The largest task id.
pub const MAX_TASK: u8 = 15;

/// Number of tasks. The index of a task is its id - 1, so it is below this number.
const TASKS: usize = MAX_TASK as usize;
/// Length of tables by task index: a power of two, so that a mask keeps an index in range.
const SLOTS: usize = TASKS + 1;

/// The sender writes lines 0 and 1: the posted word, the claim of the sending end, and for each
/// task the number of signals sent and their newest value.
const POSTED_AT: usize = 0;
pub(crate) const SENDER_CLAIM_AT: usize = 1;
/// The receiver writes line 2: whether it may be asleep.
const ASLEEP_AT: usize = 2 * LINE_WORDS;
/// The receiver writes line 3: for each task the number of handled signals, and the claim of the
/// receiving end.
const HANDLED_AT: usize = 3 * LINE_WORDS;
pub(crate) const RECEIVER_CLAIM_AT: usize = handled_at(TASKS);

/// Returns the index of the word that counts the signals sent to this task.
#[inline]
const fn sent_at(index: usize) -> usize {
    2 * index + 2
}

/// Returns the index of the word with the newest value sent to this task.
#[inline]
const fn value_at(index: usize) -> usize {
    sent_at(index) + 1
}

/// Returns the index of the word that counts the handled signals of this task.
#[inline]
const fn handled_at(index: usize) -> usize {
    HANDLED_AT + index
}

/// The posted word, from the lowest bit: the index of the last signal's task (4 bits), a bit that
/// is always 0, the number of signals (27 bits).
const NUMBER_SHIFT: u32 = 5;
/// The index in the first post of a new sender: it posts no signal.
const NO_TASK: u32 = TASKS as u32;
/// The counts do not add up to the post: words were overwritten, or the last signal is posted and
/// not yet counted. Which one cannot be told, so each poll compares.
const DIFFERS: usize = TASKS + 1;

/// Returns the next posted word, without an index.
#[inline]
const fn next_post(posted: u32) -> u32 {
    (posted | ((1 << NUMBER_SHIFT) - 1)).wrapping_add(1)
}

/// Returns the index in a posted word. It may be [`NO_TASK`].
#[inline]
const fn index_of(posted: u32) -> usize {
    posted as usize % SLOTS
}

/// Returns whether this count of open signals shows that the last signal was handled and is not yet
/// counted.
const fn is_late(index: usize, open: u32, posted: u32) -> bool {
    open == u32::MAX && index == index_of(posted)
}

/// Differs from every posted word, whatever its index: the bit that is always 0 is set.
const NO_POST: u32 = 1 << (NUMBER_SHIFT - 1);

/// Returns the posted word, without an index, for these counts.
fn post_of(counts: &[u32; SLOTS]) -> u32 {
    let sum = counts[..TASKS]
        .iter()
        .fold(0, |sum: u32, &n| sum.wrapping_add(n));
    sum << NUMBER_SHIFT
}

/// Every 65,536 polls the receiver compares all counts, because the 27-bit number may have wrapped.
/// If the receiver was stopped for n × 2^27 signals, the posted word shows no new signal, and one
/// more signal looks like the only one.
#[cfg(not(loom))]
const POLLS_UNTIL_SURE: u32 = 1 << 16;
/// Disabled under loom, so that comparing all counts cannot hide a lost post.
#[cfg(loom)]
const POLLS_UNTIL_SURE: u32 = 1 << 31;

/// A task of the receiving core: 1 ..= 15. T-SYNC-1
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct TaskId {
    index: u8,
}

impl core::fmt::Debug for TaskId {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        write!(f, "TaskId({})", self.index())
    }
}

impl TaskId {
    /// Task 1, which has priority over all others.
    pub const FIRST: Self = Self { index: 0 };

    /// Returns the task with this number, or `None` for 0 and above [`MAX_TASK`].
    #[must_use]
    pub const fn new(number: u8) -> Option<Self> {
        if number >= 1 && number <= MAX_TASK {
            Some(Self { index: number - 1 })
        } else {
            None
        }
    }

    /// Returns the id, 1 ..= 15.
    #[must_use]
    pub const fn index(self) -> usize {
        self.index as usize + 1
    }

    /// Returns the index in tables, from 0.
    const fn at(self) -> usize {
        self.index as usize % SLOTS
    }
}

/// The result of a signal: whether the caller must ring the receiver's doorbell now.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[must_use = "a receiver that sleeps must be rung"]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Ring {
    /// The receiver may be asleep.
    Needed,
    /// The receiver is awake and will poll before it sleeps.
    NotNeeded,
}

/// The sending end. Each mailbox has one; tasks and handlers that share it must exclude each other,
/// for example by a critical section of their kernel.
#[derive(Debug)]
pub struct Sender<'a> {
    words: &'a [AtomicU32; WORDS],
    /// Copies of the words that only this end writes. On Intel, a core that loads its own words
    /// waits if the receiver has just fetched the line; a core that only stores does not.
    posted: u32,
    sent: [u32; SLOTS],
}

impl<'a> Sender<'a> {
    /// Attaches to the mailbox. Counts the signal that an earlier incarnation of the sending core
    /// had posted but not counted. Ring the receiver's doorbell once afterwards: that incarnation
    /// may have died before it rang.
    ///
    /// # Errors
    /// [`FitError`] if the words are too few or not at a line boundary.
    pub(crate) fn attach(words: &'a [AtomicU32]) -> Result<Self, FitError> {
        let words: &[AtomicU32; WORDS] = fit_exactly(words)?;
        let mut sent = [0; SLOTS];
        for (index, copy) in sent.iter_mut().enumerate().take(TASKS) {
            *copy = words[sent_at(index)].load(Ordering::Relaxed);
        }
        // Acquire pairs with the Release in `send`: what the signal announces is seen.
        let posted = words[POSTED_AT].load(Ordering::Acquire);
        let last = index_of(posted);
        if last < TASKS && next_post(post_of(&sent)) == posted - last as u32 {
            sent[last] = sent[last].wrapping_add(1);
            // Release pairs with the Acquire in `compare`.
            words[sent_at(last)].store(sent[last], Ordering::Release);
        }
        let posted = post_of(&sent) | NO_TASK;
        // Release pairs with the Acquire in `poll`, as in `send`.
        words[POSTED_AT].store(posted, Ordering::Release);
        Ok(Self {
            words,
            posted,
            sent,
        })
    }

    /// Signals a task of the receiving core (`task_sync`). Earlier writes to the LMU are visible to
    /// the task. Never blocks; task or handler context.
    #[inline]
    pub fn signal(&mut self, task: TaskId) -> Ring {
        self.send(task.at())
    }

    /// Signals a task and passes it a value. If several values are sent before the task runs, it
    /// gets the newest. Never blocks; task or handler context.
    #[inline]
    pub fn signal_with(&mut self, task: TaskId, value: u32) -> Ring {
        // Store it before the post: a core that sees this post sees this value or a newer one.
        self.words[value_at(task.at())].store(value, Ordering::Relaxed);
        self.send(task.at())
    }

    #[inline]
    fn send(&mut self, index: usize) -> Ring {
        self.posted = next_post(self.posted).wrapping_add(index as u32);
        // Release pairs with the Acquire in `poll`: a receiver that sees the post sees the payload,
        // and the counts of all earlier signals.
        self.words[POSTED_AT].store(self.posted, Ordering::Release);
        // SeqCst pairs with the fence in `prepare_sleep`: either this core sees `asleep`, or the
        // receiver sees the post. It also pairs with the Acquire of the count in `compare`: a
        // receiver that sees the count sees the post and the payload.
        fence(Ordering::SeqCst);
        let sent = &mut self.sent[index];
        *sent = sent.wrapping_add(1);
        self.words[sent_at(index)].store(*sent, Ordering::Relaxed);
        if self.words[ASLEEP_AT].load(Ordering::Relaxed) == 0 {
            Ring::NotNeeded
        } else {
            Ring::Needed
        }
    }

    /// Returns the number of signals to this task that are not yet handled. If it is 0, the handler
    /// has returned, and its writes to the LMU are visible.
    #[must_use]
    pub fn open(&self, task: TaskId) -> u32 {
        let sent = self.sent[task.at()];
        // Acquire pairs with the Release in `handled`.
        sent.wrapping_sub(self.words[handled_at(task.at())].load(Ordering::Acquire))
    }
}

/// The open signals of one task.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Signals {
    /// The task.
    pub task: TaskId,
    /// Number of signals; at least 1.
    pub count: u32,
    /// The newest value that was sent to the task; 0 if none was sent.
    pub value: u32,
}

#[inline]
fn signals(words: &[AtomicU32; WORDS], index: usize, count: u32) -> Signals {
    Signals {
        task: TaskId { index: index as u8 },
        count,
        value: words[value_at(index)].load(Ordering::Relaxed),
    }
}

/// The receiving end. Each mailbox has one.
#[derive(Debug)]
pub struct Receiver<'a> {
    words: &'a [AtomicU32; WORDS],
    /// The posted word at the last poll.
    posted: u32,
    /// The next posted word, without an index, if exactly the signals up to `posted` are handled;
    /// otherwise [`NO_POST`].
    next: u32,
    /// Number of polls until all counts are compared.
    polls_left: u32,
    /// The next poll compares the counts from this task on, even without a post; [`TASKS`]: none,
    /// [`DIFFERS`]: all.
    compare_from: usize,
    /// Number of handled signals of each task.
    handled: [u32; SLOTS],
}

impl<'a> Receiver<'a> {
    /// Attaches to the mailbox (`init_sync_mailbox`). The first [`Receiver::poll`] returns the
    /// signals that an earlier incarnation of the receiving core left open.
    ///
    /// # Errors
    /// [`FitError`] if the words are too few or not at a line boundary.
    pub(crate) fn attach(words: &'a [AtomicU32]) -> Result<Self, FitError> {
        let words: &[AtomicU32; WORDS] = fit_exactly(words)?;
        words[ASLEEP_AT].store(0, Ordering::Relaxed);
        let mut handled = [0; SLOTS];
        for (index, copy) in handled.iter_mut().enumerate().take(TASKS) {
            *copy = words[handled_at(index)].load(Ordering::Relaxed);
        }
        Ok(Self {
            words,
            posted: words[POSTED_AT].load(Ordering::Relaxed),
            next: NO_POST,
            polls_left: POLLS_UNTIL_SURE,
            compare_from: 0,
            handled,
        })
    }

    /// Passes the open signals of each task to `handle`, the lowest id first, and counts them as
    /// handled when `handle` returns. Returns the number of signals (wrapping). Bounded: a signal
    /// that arrives after its task was handled is left to the next call. Never blocks.
    #[inline]
    pub fn poll(&mut self, mut handle: impl FnMut(Signals)) -> u32 {
        let words = self.words;
        // Acquire pairs with the Release of the post in `send`.
        let posted = words[POSTED_AT].load(Ordering::Acquire);
        let index = posted ^ self.next;
        if index < u32::from(MAX_TASK) {
            // Exactly one signal is open, and it is for this task.
            handle(signals(words, index as usize, 1));
            self.handled(index as usize, 1);
            self.posted = posted;
            self.next = next_post(posted);
            self.count_poll();
            return 1;
        }
        if posted == self.posted && self.compare_from == TASKS {
            self.count_poll();
            return 0;
        }
        let mut sum = 0u32;
        if self.compare_from == DIFFERS {
            self.compare_from = 0;
        }
        while let Some(open) = self.compare(posted) {
            handle(open);
            self.handled(open.task.at(), open.count);
            // Not back, or counts that always change would keep this call.
            self.compare_from = self.compare_from.max(open.task.at() + 1);
            sum = sum.wrapping_add(open.count);
        }
        sum
    }

    /// Counts these signals as handled.
    #[inline]
    fn handled(&mut self, index: usize, count: u32) {
        let handled = &mut self.handled[index];
        *handled = handled.wrapping_add(count);
        // Release pairs with the Acquire in `open`.
        self.words[handled_at(index)].store(*handled, Ordering::Release);
    }

    /// Returns the open signals of the first task that has any. Not inlined, so that the loop
    /// around `poll` keeps its registers for the usual case, one signal.
    #[inline(never)]
    fn compare(&mut self, posted: u32) -> Option<Signals> {
        if posted != self.posted {
            self.compare_all();
            self.posted = posted;
        }
        for index in self.compare_from..TASKS {
            // Acquire pairs with the fence in `send`: all signals in this count are posted.
            let sent = self.words[sent_at(index)].load(Ordering::Acquire);
            let count = sent.wrapping_sub(self.handled[index]);
            if count != 0 && !is_late(index, count, posted) {
                return Some(signals(self.words, index, count));
            }
        }
        self.compare_from = TASKS;
        let handled = post_of(&self.handled);
        let last = index_of(posted);
        // Relaxed: the Acquire of each count orders it after the counts.
        if self.words[POSTED_AT].load(Ordering::Relaxed) == posted {
            // No later signal is handled.
            if next_post(handled) == posted - last as u32 && last < TASKS {
                return Some(signals(self.words, last, 1));
            }
            if handled == posted - last as u32 {
                self.next = next_post(posted);
            } else {
                self.compare_from = DIFFERS;
            }
        }
        None
    }

    #[inline]
    fn count_poll(&mut self) {
        self.polls_left -= 1;
        if self.polls_left == 0 {
            self.compare_all();
        }
    }

    /// Makes this poll or the next one compare all counts.
    #[cold]
    #[inline(never)]
    fn compare_all(&mut self) {
        self.polls_left = POLLS_UNTIL_SURE;
        self.compare_from = 0;
        self.next = NO_POST;
    }

    /// Announces that this core is going to sleep: from now on a signal needs the doorbell. Returns
    /// `false` if signals are open: then poll instead. After the sleep, call [`Receiver::awake`].
    /// A receiver that polls only in the handler of its doorbell calls this once, never `awake`.
    #[inline]
    #[must_use = "if signals are there, sleeping would miss them"]
    pub fn prepare_sleep(&mut self) -> bool {
        self.words[ASLEEP_AT].store(1, Ordering::Relaxed);
        // SeqCst pairs with the fence in `send`.
        fence(Ordering::SeqCst);
        let posted = self.words[POSTED_AT].load(Ordering::Relaxed);
        if self.compare_from >= TASKS && posted == self.posted {
            // A sleep may be long, so compare all counts first. Disabled under loom, as above.
            if cfg!(loom) || !self.is_any_open() || self.is_last_late(posted) {
                return true;
            }
            self.compare_all();
        }
        self.awake();
        false
    }

    /// Returns whether any count differs from that of the handled signals.
    fn is_any_open(&self) -> bool {
        (0..TASKS).any(|index| self.count(index) != 0)
    }

    /// Returns whether the only such count is late.
    #[cold]
    #[inline(never)]
    fn is_last_late(&self, posted: u32) -> bool {
        (0..TASKS).all(|index| {
            let count = self.count(index);
            count == 0 || is_late(index, count, posted)
        })
    }

    /// Returns how many counted signals of a task are not handled.
    fn count(&self, index: usize) -> u32 {
        let sent = self.words[sent_at(index)].load(Ordering::Relaxed);
        sent.wrapping_sub(self.handled[index])
    }

    /// Announces that this core is awake: a signal does not need the doorbell.
    #[inline]
    pub fn awake(&mut self) {
        self.words[ASLEEP_AT].store(0, Ordering::Relaxed);
    }
}

/// The arguments of a task: two words, passed in registers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Call {
    /// Number of signals that this call handles; at least 1.
    pub count: u32,
    /// The newest value that was sent to the task; 0 if none was sent.
    pub value: u32,
}

/// A task. It runs to completion in the receiver's context `C`. The number is the argument that was
/// passed to [`TaskTable::add`].
pub type TaskFn<C> = fn(&mut C, u32, Call);

/// The id already has a task.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Taken;

impl core::fmt::Display for Taken {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str("the id already has a task")
    }
}

impl core::error::Error for Taken {}

/// The receiver's table of tasks. It holds function pointers, so it stays in private memory; only
/// ids are passed through the LMU. T-SYNC-3
#[derive(Debug)]
pub struct TaskTable<C> {
    /// The function and the argument of each id. An id without a task has an empty function.
    tasks: [(TaskFn<C>, u32); SLOTS],
    /// One bit for each id that has a task.
    known: u32,
}

impl<C> Default for TaskTable<C> {
    fn default() -> Self {
        Self::new()
    }
}

impl<C> TaskTable<C> {
    /// Returns a table without tasks.
    #[must_use]
    pub const fn new() -> Self {
        Self {
            tasks: [(|_, _, _| (), 0); SLOTS],
            known: 0,
        }
    }

    /// Adds a task for the id, with its argument, for example a handle of the pool
    /// (`sync_task_add`).
    ///
    /// # Errors
    /// [`Taken`] if the id already has a task.
    pub fn add(&mut self, id: TaskId, task: TaskFn<C>, arg: u32) -> Result<(), Taken> {
        if self.known & 1 << id.at() != 0 {
            return Err(Taken);
        }
        self.known |= 1 << id.at();
        self.tasks[id.at()] = (task, arg);
        Ok(())
    }

    /// Polls the mailbox and runs the tasks that were signalled. Returns the number of signals.
    #[inline]
    pub fn run(&mut self, receiver: &mut Receiver<'_>, context: &mut C) -> u32 {
        receiver.poll(|Signals { task, count, value }| {
            let (run, arg) = self.tasks[task.at()];
            run(context, arg, Call { count, value });
        })
    }
}

#[cfg(not(loom))]
#[cfg(test)]
mod tests;
