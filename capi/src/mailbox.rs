//! The sync mailbox, with handlers in C.

use crate::cell::{self, opaque};
use crate::map::{self, TandemMap};
use crate::status::{TandemStatus, TandemStatus as S, status};
use core::ffi::c_void;
use tandem_shm::bare;
use tandem_shm::mailbox::{MAX_TASK, Receiver, Ring, Sender, Signals, TaskId, WORDS};

/// Words of a mailbox.
pub const TANDEM_MAILBOX_WORDS: usize = 64;
/// The largest task id. Ids start at 1; 0 means none.
pub const TANDEM_MAX_TASK: u32 = 15;

const _: () = assert!(TANDEM_MAILBOX_WORDS == WORDS && TANDEM_MAX_TASK == MAX_TASK as u32);

/// The sending end of a mailbox; each has one. Tasks and handlers of the sending core that share it
/// must exclude each other, for example with interrupts off. Must be static and initially zero.
#[repr(C)]
#[derive(Debug)]
pub struct TandemMailboxSender {
    /// Private.
    pub opaque: [usize; 20],
}

/// Receiving end of a mailbox with the handlers of its tasks. Must be static and initially zero.
#[repr(C)]
#[derive(Debug)]
pub struct TandemMailboxReceiver {
    /// Private.
    pub opaque: [usize; 56],
}

/// The function of a task. `tandem_mailbox_poll` calls it with the number of signals (`count`, at
/// least 1) and the newest value that was sent to the task (`value`, 0 if none was sent).
pub type TandemTask =
    Option<unsafe extern "C" fn(context: *mut c_void, task: u32, count: u32, value: u32)>;

#[derive(Clone, Copy)]
struct Entry {
    run: TandemTask,
    context: *mut c_void,
}

pub(crate) struct Table {
    receiver: Receiver<'static>,
    tasks: [Entry; TANDEM_MAX_TASK as usize + 1],
    unknown: u32,
}

opaque!(TandemMailboxSender, Sender<'static>, 0x04);
opaque!(TandemMailboxReceiver, Table, 0x05);

fn task_id(task: u32) -> Result<TaskId, S> {
    u8::try_from(task)
        .ok()
        .and_then(TaskId::new)
        .ok_or(S::OutOfRange)
}

/// Attaches to the mailbox in region `region` as the sending core. Then ring the receiver's
/// doorbell once: an earlier incarnation may have died before it rang. Tasks only; does not block.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_mailbox_sender_attach(
    sender: *mut TandemMailboxSender,
    map: *const TandemMap,
    region: usize,
) -> TandemStatus {
    map::attach(sender, map, region, |words, _| {
        Ok(bare::mailbox_sender(words)?)
    })
}

/// Signals task `task` (1 ..= 15) of the receiving core. Its handler sees everything that was
/// written to the LMU before; no signal is lost. Tasks and handlers, one at a time: a task that
/// shares the sender with a handler must disable the handler during the call. Does not block.
///
/// `TANDEM_STATUS_RING_NEEDED`: signalled; ring the receiver's doorbell now.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_mailbox_signal(
    sender: *mut TandemMailboxSender,
    task: u32,
) -> TandemStatus {
    cell::with(sender, |sender| Ok(sender.signal(task_id(task)?)))
}

/// Signals a task and passes it a value. If several values are sent before the task runs, it gets
/// the newest. Otherwise like `tandem_mailbox_signal`.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_mailbox_signal_with(
    sender: *mut TandemMailboxSender,
    task: u32,
    value: u32,
) -> TandemStatus {
    cell::with(sender, |sender| {
        Ok(sender.signal_with(task_id(task)?, value))
    })
}

impl From<Ring> for S {
    fn from(ring: Ring) -> Self {
        match ring {
            Ring::Needed => Self::RingNeeded,
            Ring::NotNeeded => Self::Ok,
        }
    }
}

/// Returns the number of signals to a task that were not handled yet; 0 if an argument is not
/// valid. Any context; does not block.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_mailbox_open(sender: *mut TandemMailboxSender, task: u32) -> u32 {
    let sender = cell::get(sender);
    match (sender, task_id(task)) {
        (Ok(sender), Ok(task)) => sender.open(task),
        _ => 0,
    }
}

/// Attaches to the mailbox in region `region` as the receiving core, without handlers. The first
/// poll handles the signals that an earlier incarnation of this core did not handle. Tasks only;
/// does not block.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_mailbox_receiver_attach(
    receiver: *mut TandemMailboxReceiver,
    map: *const TandemMap,
    region: usize,
) -> TandemStatus {
    const NONE: Entry = Entry {
        run: None,
        context: core::ptr::null_mut(),
    };
    map::attach(receiver, map, region, |words, _| {
        Ok(Table {
            receiver: bare::mailbox_receiver(words)?,
            tasks: [NONE; TANDEM_MAX_TASK as usize + 1],
            unknown: 0,
        })
    })
}

/// Adds a handler, called with `context`, for task `task` (1 ..= 15). Tasks only; does not block.
///
/// `TANDEM_STATUS_TAKEN` if the task already has one, `TANDEM_STATUS_BAD_POINTER` if `run` is NULL.
///
/// # Safety
/// Rules 1 and 3 of the caller's contract apply. `run` may be called with `context` as long as the
/// receiver is polled.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_mailbox_add_task(
    receiver: *mut TandemMailboxReceiver,
    task: u32,
    run: TandemTask,
    context: *mut c_void,
) -> TandemStatus {
    cell::with(receiver, |table| {
        let entry = &mut table.tasks[task_id(task)?.index()];
        match (run, entry.run) {
            (None, _) => Err(S::BadPointer),
            (_, Some(_)) => Err(S::Taken),
            _ => {
                *entry = Entry { run, context };
                Ok(())
            }
        }
    })
}

/// Runs the handlers of the tasks that were signalled, the lowest id first, and writes the number
/// of signals to `signals` (may be NULL). Polls once and is bounded; a signal that arrives after
/// its task was handled is left to the next call. One task or handler only; does not block.
///
/// `TANDEM_STATUS_EMPTY` if there was no signal.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_mailbox_poll(
    receiver: *mut TandemMailboxReceiver,
    signals: *mut u32,
) -> TandemStatus {
    let poll = |table: &mut Table| {
        let Table {
            receiver,
            tasks,
            unknown,
        } = table;
        receiver.poll(|Signals { task, count, value }| match tasks[task.index()] {
            Entry {
                run: Some(run),
                context,
            } => {
                let number = task.index() as u32;
                // SAFETY: a function of C with this signature, called with its own context.
                unsafe { run(context, number, count, value) }
            }
            Entry { run: None, .. } => *unknown = unknown.wrapping_add(count),
        })
    };
    status(|| {
        let count = cell::occupy(receiver, poll)?;
        // SAFETY: rule 1 of the caller's contract.
        unsafe { cell::write_if_wanted(signals, count) }?;
        if count == 0 { Err(S::Empty) } else { Ok(S::Ok) }
    })
}

/// Returns the number of signals to tasks without a handler. They count as handled. Tasks only;
/// does not block.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_mailbox_unknown(receiver: *mut TandemMailboxReceiver) -> u32 {
    cell::get(receiver).map_or(0, |table| table.unknown)
}

/// Announces that this core is going to sleep: from now on signals need the doorbell. Disable
/// interrupts, call this, sleep if it returns `TANDEM_STATUS_OK`, enable interrupts, and call
/// `tandem_mailbox_awake`. Does not block.
///
/// `TANDEM_STATUS_DO_NOT_SLEEP` if signals are not handled yet: poll instead.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_mailbox_prepare_sleep(
    receiver: *mut TandemMailboxReceiver,
) -> TandemStatus {
    cell::with(receiver, |table| match table.receiver.prepare_sleep() {
        true => Ok(()),
        false => Err(S::DoNotSleep),
    })
}

/// Announces that this core is awake: from now on signals do not need the doorbell. Does not block.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn tandem_mailbox_awake(
    receiver: *mut TandemMailboxReceiver,
) -> TandemStatus {
    status(|| cell::get(receiver).map(|table| table.receiver.awake()))
}
