//! Tandem itself: 4 bytes with a signal of the sync mailbox, or through a newest-value channel and
//! a signal, on the host board, from the sender's call to the running handler. T-SYNC-4

pub mod broadcast;
pub mod fifo;
pub mod lock;
pub mod newest;
pub mod pool;
pub mod size;
pub mod start_up;

use crate::chain::through_three;
use crate::harness::{Batch, End, Plan, between_processes};
use crate::open_loop::at_fixed_rate;
use crate::shared::Shared;
use std::io;
use std::sync::atomic::AtomicU32;
use std::sync::atomic::Ordering::Relaxed;
use tandem_board::{Board, CoreId, Duration, Generation};
use tandem_board_host::{HostBoard, UnsupervisedSystem};
use tandem_shm::mailbox::{self, Call, Receiver, Ring, Sender, TaskId, TaskTable};
use tandem_shm::wait::{Event, WaitPolicy};
use tandem_shm::{Shape, newest as channel};

const VALUE: Shape = Shape::new(4, 1);
/// Words of one direction: the mailbox, then the channel.
const WAY_WORDS: usize = 1024;
const CHANNEL_AT: usize = 512;

fn task() -> TaskId {
    TaskId::new(1).expect("1 is a task id")
}

/// What the handler works on.
struct Inbox {
    value: channel::Reader<'static>,
    received: Option<u32>,
}

fn handle(inbox: &mut Inbox, call: Call) {
    inbox.received = Some(call.value);
}

fn handle_channel(inbox: &mut Inbox, _call: Call) {
    let value = inbox.value.read(|words| words.get(0));
    inbox.received = value.ok().map(|(_, value)| value);
}

/// By which way the 4 bytes go.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Way {
    /// As the value of the signal.
    Signal,
    /// Through a newest-value channel, with a signal.
    Channel,
}

/// What a core waits for: a signal that its handler has taken.
struct Waiting {
    board: &'static HostBoard,
    signals: Receiver<'static>,
    tasks: TaskTable<Inbox>,
    inbox: Inbox,
}

impl Event for Waiting {
    type Output = u32;

    // The waiting loop is nothing but this; called through a pointer it costs a third more.
    #[inline(always)]
    fn check(&mut self) -> Option<u32> {
        self.tasks.run(&mut self.signals, &mut self.inbox);
        self.inbox.received.take()
    }

    fn prepare_sleep(&mut self) -> bool {
        self.signals.prepare_sleep()
    }

    fn sleep(&mut self) {
        self.board.wait(self.board.now() + Duration::from_ms(100));
    }

    fn awake(&mut self) {
        self.signals.awake();
    }
}

/// One core: sends to its peer and waits for what its peer sends.
pub(crate) struct Core {
    board: &'static HostBoard,
    peer: CoreId,
    policy: WaitPolicy,
    way: Way,
    value: channel::Writer<'static>,
    signal: Sender<'static>,
    waiting: Waiting,
}

impl Core {
    pub(crate) fn start(
        system: &UnsupervisedSystem,
        core: CoreId,
        peer: CoreId,
        incarnation: u32,
        policy: WaitPolicy,
        way: Way,
    ) -> Self {
        let board = system
            .attach(core, Generation(incarnation))
            .expect("the bare system is powered");
        let board: &'static HostBoard = Box::leak(Box::new(board));
        let words_to = |to: CoreId| -> &'static [AtomicU32] {
            &board.lmu()[to.index() * WAY_WORDS..][..WAY_WORDS]
        };
        let (out, inward) = (words_to(peer), words_to(core));
        let mut tasks = TaskTable::new();
        let handler = match way {
            Way::Signal => handle,
            Way::Channel => handle_channel,
        };
        tasks.add(task(), handler, 0).expect("the table is empty");
        let value = channel::Reader::attach(&inward[CHANNEL_AT..], VALUE).expect("it fits");
        let signals = Receiver::attach(&inward[..mailbox::WORDS]).expect("it fits");
        let inbox = Inbox {
            value,
            received: None,
        };
        Self {
            board,
            peer,
            policy,
            way,
            value: channel::Writer::attach(&out[CHANNEL_AT..], VALUE).expect("it fits"),
            signal: Sender::attach(&out[..mailbox::WORDS]).expect("it fits"),
            waiting: Waiting {
                board,
                signals,
                tasks,
                inbox,
            },
        }
    }
}

impl End for Core {
    fn send(&mut self, stamp: u32) {
        let ring = match self.way {
            Way::Signal => self.signal.signal_with(task(), stamp),
            Way::Channel => {
                self.value.publish(&[stamp]);
                self.signal.signal(task())
            }
        };
        if ring == Ring::Needed {
            self.board.ring(self.peer);
        }
    }

    fn receive(&mut self) -> u32 {
        self.policy.wait(&mut self.waiting)
    }
}

/// One-way time from core 1 to core 2 and back under this waiting policy.
///
/// # Errors
/// As [`between_processes`].
pub fn sync(plan: &Plan, policy: WaitPolicy, way: Way) -> io::Result<Batch> {
    let (system, incarnation) = (plan.system(), next_incarnation());
    let (a, b) = (CoreId::PERCEPTION, CoreId::PLANNING);
    let start =
        |core, peer| move |_: &Shared| Core::start(system, core, peer, incarnation, policy, way);
    between_processes(plan, 0, start(a, b), start(b, a))
}

/// From core 1 over core 2 to core 0; each waits by its policy.
///
/// # Errors
/// As [`through_three`].
pub fn chain(plan: &Plan, policies: [WaitPolicy; 3]) -> io::Result<Batch> {
    const CHAIN: [CoreId; 3] = [CoreId::PERCEPTION, CoreId::PLANNING, CoreId::CONTROL];
    let (system, incarnation) = (plan.system(), next_incarnation());
    through_three(plan, 0, |part, _| {
        let (core, next) = (CHAIN[part], CHAIN[(part + 1) % 3]);
        Core::start(system, core, next, incarnation, policies[part], Way::Signal)
    })
}

/// From core 1 to core 2 at a fixed rate.
///
/// # Errors
/// As [`at_fixed_rate`].
pub fn at_rate(plan: &Plan, policy: WaitPolicy) -> io::Result<Batch> {
    let (system, incarnation) = (plan.system(), next_incarnation());
    let (a, b) = (CoreId::PERCEPTION, CoreId::PLANNING);
    let start = |core, peer| {
        move |_: &Shared| Core::start(system, core, peer, incarnation, policy, Way::Signal)
    };
    at_fixed_rate(plan, 0, start(a, b), start(b, a))
}

/// Incarnations rise from batch to batch, as those of a core that is reset.
pub(crate) fn next_incarnation() -> u32 {
    static INCARNATIONS: AtomicU32 = AtomicU32::new(1);
    INCARNATIONS.fetch_add(1, Relaxed)
}
