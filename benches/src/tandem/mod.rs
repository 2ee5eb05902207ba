//! Tandem itself: 4 bytes with a signal of the sync mailbox, or a payload through a newest-value
//! channel and a signal, on the host board, from the sender's call to the running handler. T-SYNC-4

pub mod broadcast;
pub mod fifo;
mod lmu;
pub mod lock;
pub mod size;

use crate::harness::{Batch, End, Plan, between_processes};
use crate::open_loop::at_fixed_rate;
use crate::shared::Shared;
use crate::tandem::size::{sum_from, word};
use std::io;
use std::sync::atomic::AtomicU32;
use std::sync::atomic::Ordering::Relaxed;
use tandem_board::{Board, CoreId, Duration, Generation};
use tandem_board_host::{HostBoard, UnsupervisedSystem};
use tandem_shm::mailbox::{Call, Receiver, Ring, Sender, TaskId, TaskTable};
use tandem_shm::map::{Layout, Map};
use tandem_shm::newest::{Reader, Writer};
use tandem_shm::region::{Mailbox, Newest, Region};
use tandem_shm::wait::{Event, WaitPolicy};

/// The mailbox towards each core, and a channel of `WORDS` words.
type Inward<const WORDS: usize> = (Region<Mailbox>, Region<Newest<[u32; WORDS]>>);

struct Regions<const WORDS: usize>;

impl<const WORDS: usize> Regions<WORDS> {
    const INWARD: [Inward<WORDS>; CoreId::COUNT] = {
        let mailbox = Region::first("mailbox");
        let to_0 = (mailbox, mailbox.then("channel"));
        let to_1 = Self::after(to_0);
        [to_0, to_1, Self::after(to_1)]
    };
    const LAYOUT: Layout = Self::INWARD[CoreId::COUNT - 1].1.end();

    const fn after((_, channel): Inward<WORDS>) -> Inward<WORDS> {
        let mailbox = channel.then("mailbox");
        (mailbox, mailbox.then("channel"))
    }
}

const TASK: TaskId = TaskId::FIRST;

/// What the handler works on.
struct Inbox<const WORDS: usize> {
    payload: Reader<'static, [u32; WORDS]>,
    received: Option<u32>,
}

fn handle<const WORDS: usize>(inbox: &mut Inbox<WORDS>, _: u32, call: Call) {
    inbox.received = Some(call.value);
}

fn handle_channel<const WORDS: usize>(inbox: &mut Inbox<WORDS>, _: u32, _: Call) {
    let payload = inbox.payload.read();
    inbox.received = payload.ok().map(|(_, words)| sum_from(words.into_iter()));
}

/// By which way the payload goes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Way {
    /// 4 bytes as the value of the signal.
    Signal,
    /// Through a newest-value channel, with a signal.
    Channel,
}

/// How a core waits, by which way it sends, and in which company.
#[derive(Clone, Copy, Debug)]
pub(crate) struct How {
    pub(crate) policy: WaitPolicy,
    pub(crate) way: Way,
    /// Cores of the case.
    pub(crate) parts: u32,
    pub(crate) incarnation: u32,
}

impl How {
    /// By signals, in the next incarnation.
    fn new(policy: WaitPolicy, parts: u32) -> Self {
        Self {
            policy,
            way: Way::Signal,
            parts,
            incarnation: next_incarnation(),
        }
    }
}

/// What a core waits for: a signal that its handler has taken.
struct Waiting<const WORDS: usize> {
    board: &'static HostBoard,
    signals: Receiver<'static>,
    tasks: TaskTable<Inbox<WORDS>>,
    inbox: Inbox<WORDS>,
    way: Way,
}

impl<const WORDS: usize> Event for Waiting<WORDS> {
    type Output = u32;

    // The waiting loop is nothing but this; called through a pointer it costs a third more.
    #[inline(always)]
    fn check(&mut self) -> Option<u32> {
        if self.way == Way::Channel {
            self.inbox.payload.prefetch();
        }
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
pub(crate) struct Core<const WORDS: usize> {
    board: &'static HostBoard,
    peer: CoreId,
    how: How,
    payload: Writer<'static, [u32; WORDS]>,
    signal: Sender<'static>,
    waiting: Waiting<WORDS>,
}

impl<const WORDS: usize> Core<WORDS> {
    /// The planning core, which takes part in each case, formats the LMU.
    pub(crate) fn start(
        system: &UnsupervisedSystem,
        shared: &Shared,
        [core, peer]: [CoreId; 2],
        how: How,
    ) -> Self {
        let board = system
            .attach(core, Generation(how.incarnation))
            .expect("the bare system is powered");
        let board: &'static HostBoard = Box::leak(Box::new(board));
        if core == CoreId::PLANNING {
            Map::format(board.lmu(), Regions::<WORDS>::LAYOUT).expect("it fits");
        }
        shared.meet(how.parts);
        let map = Map::attach(board.lmu(), Regions::<WORDS>::LAYOUT).expect("it was formatted");
        let own = lmu::announce(&map, core.index(), how.incarnation);
        let [out, inward] = [peer, core].map(|core| Regions::<WORDS>::INWARD[core.index()]);
        let mut tasks = TaskTable::new();
        let handler = match how.way {
            Way::Signal => handle,
            Way::Channel => handle_channel,
        };
        tasks.add(TASK, handler, 0).expect("the table is empty");
        let inbox = Inbox {
            payload: inward.1.reader(&map).expect("it fits"),
            received: None,
        };
        let signals = inward.0.receiver(&map, own).expect("it is free");
        Self {
            board,
            peer,
            how,
            payload: out.1.writer(&map, own).expect("it is free"),
            signal: out.0.sender(&map, own).expect("it is free"),
            waiting: Waiting {
                board,
                signals,
                tasks,
                inbox,
                way: how.way,
            },
        }
    }
}

impl<const WORDS: usize> End for Core<WORDS> {
    fn send(&mut self, stamp: u32) {
        let ring = match self.how.way {
            Way::Signal => self.signal.signal_with(TASK, stamp),
            Way::Channel => {
                self.payload
                    .publish(&std::array::from_fn(|at| word(stamp, at)));
                self.signal.signal(TASK)
            }
        };
        if ring == Ring::Needed {
            self.board.ring(self.peer);
        }
    }

    fn receive(&mut self) -> u32 {
        self.how.policy.wait(&mut self.waiting)
    }
}

/// Core 1 towards core 2, and core 2 towards core 1.
fn both<const WORDS: usize>(plan: &Plan, how: How) -> [impl FnOnce(&Shared) -> Core<WORDS>; 2] {
    let system = plan.system();
    let ways = [CoreId::PERCEPTION, CoreId::PLANNING];
    [ways, [ways[1], ways[0]]]
        .map(|ways| move |shared: &Shared| Core::start(system, shared, ways, how))
}

/// One-way time from core 1 to core 2 and back under this waiting policy.
///
/// # Errors
/// As [`between_processes`].
pub fn sync<const WORDS: usize>(plan: &Plan, policy: WaitPolicy, way: Way) -> io::Result<Batch> {
    let how = How {
        way,
        ..How::new(policy, 2)
    };
    let [near, far] = both::<WORDS>(plan, how);
    Ok(between_processes(plan, 0, near, far)?.carrying(4 * WORDS as u64))
}

/// From core 1 to core 2 at a fixed rate.
///
/// # Errors
/// As [`at_fixed_rate`].
pub fn at_rate(plan: &Plan, policy: WaitPolicy) -> io::Result<Batch> {
    let [near, far] = both::<1>(plan, How::new(policy, 2));
    at_fixed_rate(plan, 0, near, far)
}

/// Incarnations rise from batch to batch, as those of a core that is reset.
fn next_incarnation() -> u32 {
    static INCARNATIONS: AtomicU32 = AtomicU32::new(1);
    INCARNATIONS.fetch_add(1, Relaxed)
}
