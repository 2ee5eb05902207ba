//! The sync mailbox: one core names tasks of another core by id; no signal is lost. T-SYNC-1..3
//!
//! One for each ordered pair of cores. For each id (1 ..= 15; 0 is none) the sender counts the
//! signals it has sent and the receiver those it has handled; the difference is what is open. A
//! word with one *pending* bit for each id tells the receiver where to look. The sender counts
//! first and then sets the bit; the receiver takes all bits at once and then reads the counters:
//! whatever it does not see, it finds with a later bit.
//!
//! Order: signals with the same id are handled together, with their number. Of different ids that
//! are open at one look the lower is handled first: the id is a priority; the order of sending is
//! not kept.
//!
//! The doorbell need be rung only when the receiver may be asleep. Sender: set the bit, fence, look
//! at `asleep`. Receiver: set `asleep`, fence, look at the bits. With sequentially consistent
//! fences at least one of them sees the other (E. W. Dijkstra, "Cooperating sequential processes",
//! 1965, section 2.1).
//!
//! A successor of either end goes on with the counters: a signal that was sent and whose handler
//! had not returned when the receiver died is handled by its successor, so handlers run at least
//! once a signal.

use crate::region::{FitError, LINE_WORDS, fit};
use crate::sync::{AtomicU32, Ordering, fence};

/// Words of a mailbox.
pub const WORDS: usize = 3 * LINE_WORDS;

/// The largest task id.
pub const MAX_TASK: u8 = 15;

const IDS: usize = MAX_TASK as usize + 1;

/// Line 0, written by the sender: word i counts the signals to task i.
const SENT_AT: usize = 0;
/// Line 1, written by both: the pending bits.
const PENDING_AT: usize = LINE_WORDS;
/// Line 2, written by the receiver: word 0 says whether it may be asleep, word i counts the signals
/// to task i that were handled.
const RECEIVER_AT: usize = 2 * LINE_WORDS;

/// A task of the receiving core: 1 ..= 15. T-SYNC-1
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct TaskId(u8);

impl TaskId {
    /// The task with this number; `None` for 0 and above [`MAX_TASK`].
    #[must_use]
    pub const fn new(number: u8) -> Option<Self> {
        if number >= 1 && number <= MAX_TASK {
            Some(Self(number))
        } else {
            None
        }
    }

    /// 1 ..= 15.
    #[must_use]
    pub const fn index(self) -> usize {
        self.0 as usize
    }
}

/// Whether the receiver's doorbell must be rung now.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[must_use = "a receiver that sleeps must be rung"]
pub enum Ring {
    /// The receiver may be asleep.
    Needed,
    /// The receiver is awake and will look before it sleeps.
    NotNeeded,
}

/// The sending end. Several tasks and handlers of the one sending core may share it.
#[derive(Clone, Copy, Debug)]
pub struct Sender<'a> {
    words: &'a [AtomicU32],
}

impl<'a> Sender<'a> {
    /// Attaches to the mailbox. What an earlier life of the sending core had counted but not yet
    /// shown is shown; ring the receiver's doorbell once afterwards, that life may not have come so
    /// far.
    ///
    /// # Errors
    /// [`FitError`] if the words are too few or not at a line boundary.
    pub fn attach(words: &'a [AtomicU32]) -> Result<Self, FitError> {
        let words = fit(words, WORDS)?;
        // Release pairs with the Acquire in `poll`.
        words[PENDING_AT].fetch_or(ALL_TASKS, Ordering::Release);
        Ok(Self { words })
    }

    /// Signals a task of the receiving core (`task_sync`). What was written to the LMU before is
    /// visible to the task. Never blocks; task or handler context.
    #[inline]
    pub fn signal(&self, task: TaskId) -> Ring {
        // Release pairs with the Acquire of the count in `poll`: who counts it sees the payload.
        self.words[SENT_AT + task.index()].fetch_add(1, Ordering::Release);
        // Release pairs with the Acquire of the bits in `poll`: who sees the bit sees the count.
        self.words[PENDING_AT].fetch_or(1 << task.index(), Ordering::Release);
        // SeqCst pairs with the fence in `prepare_sleep`: either this sees `asleep`, or that the
        // bit.
        fence(Ordering::SeqCst);
        if self.words[RECEIVER_AT].load(Ordering::Relaxed) == 0 {
            Ring::NotNeeded
        } else {
            Ring::Needed
        }
    }

    /// How many signals to this task are not handled yet.
    #[must_use]
    pub fn open(&self, task: TaskId) -> u32 {
        let sent = self.words[SENT_AT + task.index()].load(Ordering::Relaxed);
        sent.wrapping_sub(self.words[RECEIVER_AT + task.index()].load(Ordering::Relaxed))
    }
}

/// Bits 1 ..= 15.
const ALL_TASKS: u32 = (1 << IDS) - 2;

/// The receiving end. There is one at a time.
#[derive(Debug)]
pub struct Receiver<'a> {
    words: &'a [AtomicU32],
    /// How many signals to each task were handled.
    handled: [u32; IDS],
    /// Tasks to look at besides the pending ones.
    look: u32,
}

impl<'a> Receiver<'a> {
    /// Attaches to the mailbox (`init_sync_mailbox`). Signals that an earlier life of the receiving
    /// core left open come with the first [`Receiver::poll`].
    ///
    /// # Errors
    /// [`FitError`] if the words are too few or not at a line boundary.
    pub fn attach(words: &'a [AtomicU32]) -> Result<Self, FitError> {
        let words = fit(words, WORDS)?;
        words[RECEIVER_AT].store(0, Ordering::Relaxed);
        let mut handled = [0; IDS];
        for (copy, word) in handled.iter_mut().zip(&words[RECEIVER_AT..]) {
            *copy = word.load(Ordering::Relaxed);
        }
        Ok(Self {
            words,
            handled,
            look: ALL_TASKS,
        })
    }

    /// Hands each task with open signals, and their number (at least 1), to `handle`, the lowest id
    /// first, and counts them as handled when it returns. Returns how many signals there were
    /// (wrapping). One look and bounded: what comes meanwhile is left to the next call. Never
    /// blocks.
    pub fn poll(&mut self, mut handle: impl FnMut(TaskId, u32)) -> u32 {
        let pending = &self.words[PENDING_AT];
        // A plain look first: while nothing comes, the line stays shared and is not written.
        if pending.load(Ordering::Relaxed) != 0 {
            // Acquire pairs with the Release of the bit in `signal`.
            self.look |= pending.swap(0, Ordering::Acquire) & ALL_TASKS;
        }
        let mut signals = 0u32;
        while self.look != 0 {
            let id = self.look.trailing_zeros() as usize;
            // Acquire pairs with the Release of the count in `signal`: it may be ahead of the bit.
            let sent = self.words[SENT_AT + id].load(Ordering::Acquire);
            let count = sent.wrapping_sub(self.handled[id]);
            if count != 0 {
                handle(TaskId(id as u8), count);
                self.handled[id] = sent;
                self.words[RECEIVER_AT + id].store(sent, Ordering::Relaxed);
                signals = signals.wrapping_add(count);
            }
            self.look &= !(1 << id);
        }
        signals
    }

    /// Says that this core is going to sleep: from now on signals want the doorbell. `false` if
    /// signals are there already: do not sleep, poll. After the sleep call [`Receiver::awake`].
    #[inline]
    #[must_use = "if signals are there, sleeping would miss them"]
    pub fn prepare_sleep(&mut self) -> bool {
        self.words[RECEIVER_AT].store(1, Ordering::Relaxed);
        // SeqCst pairs with the fence in `signal`.
        fence(Ordering::SeqCst);
        if self.look == 0 && self.words[PENDING_AT].load(Ordering::Relaxed) == 0 {
            return true;
        }
        self.awake();
        false
    }

    /// Says that this core is awake: signals need no doorbell.
    #[inline]
    pub fn awake(&mut self) {
        self.words[RECEIVER_AT].store(0, Ordering::Relaxed);
    }
}

/// What a task is called with.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Call {
    /// The task.
    pub task: TaskId,
    /// The argument that it was added with.
    pub arg: u32,
    /// How many signals this call handles; at least 1.
    pub count: u32,
}

/// A task: runs to completion in the receiver's context `C`.
pub type Task<C> = fn(&mut C, Call);

/// The id has a task already.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Taken;

/// The receiver's table of tasks. It holds function pointers, so it lives in private memory; only
/// ids cross the LMU. T-SYNC-3
#[derive(Debug)]
pub struct TaskTable<C> {
    tasks: [Option<(Task<C>, u32)>; IDS],
    unknown: u32,
}

impl<C> Default for TaskTable<C> {
    fn default() -> Self {
        Self::new()
    }
}

impl<C> TaskTable<C> {
    /// A table without tasks.
    #[must_use]
    pub const fn new() -> Self {
        Self {
            tasks: [None; IDS],
            unknown: 0,
        }
    }

    /// Gives the id a task and its argument, for example a handle of the pool (`sync_task_add`).
    ///
    /// # Errors
    /// [`Taken`] if it has one.
    pub fn add(&mut self, id: TaskId, task: Task<C>, arg: u32) -> Result<(), Taken> {
        match &mut self.tasks[id.index()] {
            Some(_) => Err(Taken),
            free => {
                *free = Some((task, arg));
                Ok(())
            }
        }
    }

    /// Polls the mailbox and runs the tasks that were signalled. Returns how many signals there
    /// were.
    pub fn run(&mut self, receiver: &mut Receiver<'_>, context: &mut C) -> u32 {
        receiver.poll(|task, count| match self.tasks[task.index()] {
            Some((run, arg)) => run(context, Call { task, arg, count }),
            None => self.unknown = self.unknown.wrapping_add(count),
        })
    }

    /// How many signals named an id without a task.
    #[must_use]
    pub const fn unknown(&self) -> u32 {
        self.unknown
    }
}

#[cfg(test)]
#[cfg(not(loom))]
mod tests {
    use super::*;
    use crate::step::{kill_at, zeroed};
    use std::vec::Vec;

    fn task(number: u8) -> TaskId {
        TaskId::new(number).unwrap()
    }

    fn poll(receiver: &mut Receiver<'_>) -> Vec<(u8, u32)> {
        let mut all = Vec::new();
        receiver.poll(|task, count| all.push((task.0, count)));
        all
    }

    /// T-SYNC-1: id 0 means none.
    #[test]
    fn task_ids_are_1_to_15() {
        assert_eq!(TaskId::new(0), None);
        assert_eq!(TaskId::new(16), None);
        assert_eq!(task(15).index(), 15);
    }

    /// T-SYNC-3: a second signal before the first is handled is not lost; lower ids come first.
    #[test]
    fn signals_are_counted_and_come_in_order_of_their_ids() {
        let words = zeroed(WORDS);
        let sender = Sender::attach(words).unwrap();
        let mut receiver = Receiver::attach(words).unwrap();
        assert_eq!(poll(&mut receiver), []);
        for number in [15, 2, 15, 1, 15] {
            assert_eq!(sender.signal(task(number)), Ring::NotNeeded);
        }
        assert_eq!(sender.open(task(15)), 3);
        assert_eq!(poll(&mut receiver), [(1, 1), (2, 1), (15, 3)]);
        assert_eq!(sender.open(task(15)), 0);
        assert_eq!(poll(&mut receiver), []);
    }

    #[test]
    fn the_doorbell_is_needed_only_while_the_receiver_may_be_asleep() {
        let words = zeroed(WORDS);
        let sender = Sender::attach(words).unwrap();
        let mut receiver = Receiver::attach(words).unwrap();
        assert!(!receiver.prepare_sleep(), "not before the first poll");
        poll(&mut receiver);
        assert!(receiver.prepare_sleep());
        assert_eq!(sender.signal(task(1)), Ring::Needed);
        receiver.awake();
        assert_eq!(sender.signal(task(1)), Ring::NotNeeded);
        assert!(!receiver.prepare_sleep(), "signals are there");
        assert_eq!(
            sender.signal(task(1)),
            Ring::NotNeeded,
            "it did not go to sleep"
        );
        assert_eq!(poll(&mut receiver), [(1, 3)]);
    }

    /// T-SYNC-2: `init_sync_mailbox`, `sync_task_add`, `task_sync`.
    #[test]
    fn the_table_runs_the_named_task_with_its_argument() {
        let words = zeroed(WORDS);
        let sender = Sender::attach(words).unwrap();
        let mut receiver = Receiver::attach(words).unwrap();
        let mut table = TaskTable::<Vec<Call>>::new();
        table
            .add(task(3), |calls, call| calls.push(call), 77)
            .unwrap();
        assert_eq!(table.add(task(3), |_, _| (), 0), Err(Taken));
        for number in [3, 4, 3] {
            let _ = sender.signal(task(number));
        }
        let mut calls = Vec::new();
        assert_eq!(table.run(&mut receiver, &mut calls), 3);
        assert_eq!(
            calls,
            [Call {
                task: task(3),
                arg: 77,
                count: 2
            }]
        );
        assert_eq!(table.unknown(), 1);
    }

    /// T-SYNC-3: killed at any step, what `signal` has counted is handled when the successor is
    /// there.
    #[test]
    fn a_sender_killed_at_every_step_loses_nothing_that_it_has_counted() {
        for at in 0.. {
            let words = zeroed(WORDS);
            let sender = Sender::attach(words).unwrap();
            let mut receiver = Receiver::attach(words).unwrap();
            assert_eq!(poll(&mut receiver), []);
            let done = kill_at(at, || sender.signal(task(5))).is_some();
            let sender = Sender::attach(words).unwrap();
            let counted = sender.open(task(5));
            assert!(counted == 1 || at == 0);
            let handled = receiver.poll(|task, _| assert_eq!(task.0, 5));
            assert_eq!(handled, counted, "killed at {at}");
            if done {
                break;
            }
        }
    }

    /// T-SYNC-3: killed at any step, the receiver's successor handles what it left open.
    #[test]
    fn a_receiver_killed_at_every_step_leaves_the_open_signals_to_its_successor() {
        for at in 0.. {
            let words = zeroed(WORDS);
            let sender = Sender::attach(words).unwrap();
            let mut receiver = Receiver::attach(words).unwrap();
            for number in [1, 2, 2] {
                let _ = sender.signal(task(number));
            }
            let mut seen = Vec::new();
            let done = kill_at(at, || {
                receiver.poll(|task, count| seen.push((task.0, count)));
                receiver.prepare_sleep()
            });
            seen.extend(poll(&mut Receiver::attach(words).unwrap()));
            seen.sort_unstable();
            seen.dedup();
            assert_eq!(seen, [(1, 1), (2, 2)], "killed at {at}");
            if done.is_some() {
                break;
            }
        }
    }

    #[test]
    fn scribbled_words_name_no_other_tasks() {
        let words = zeroed(WORDS);
        let mut receiver = Receiver::attach(words).unwrap();
        for word in words {
            word.store(u32::MAX, Ordering::Relaxed);
        }
        assert_eq!(poll(&mut receiver).len(), 15);
        assert!(
            receiver.prepare_sleep(),
            "the bits that mean nothing keep nobody awake"
        );
    }
}
