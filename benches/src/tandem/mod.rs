//! Tandem itself: 4 bytes with a signal of the sync mailbox, or a payload through a newest-value
//! channel and a signal, on the host board, from the sender's call to the running handler. T-SYNC-4

pub(crate) mod channels;
pub(crate) mod lock;

use crate::harness::{Batch, BatchPlan, End, between_processes};
use crate::open_loop::at_fixed_rate;
use crate::payload::{sum_from, word};
use crate::shared::{PAIR, SharedPage, announce, draw};
use std::io;
use std::sync::atomic::AtomicU32;
use std::sync::atomic::Ordering::Relaxed;
use tandem_board::{Board, CoreId, Duration, Generation};
use tandem_board_host::{HostBoard, LMU_WORDS, UnsupervisedSystem};
use tandem_shm::mailbox::{Call, Receiver, Ring, TaskId, TaskTable};
use tandem_shm::map::{Layout, Map};
use tandem_shm::newest::Reader;
use tandem_shm::region::{Mailbox, Newest, Region};
use tandem_shm::wait::{Awaited, WaitPolicy};

/// The mailbox towards a core, and a channel of `WORDS` words.
type Inward<const WORDS: usize> = (Region<Mailbox>, Region<Newest<[u32; WORDS]>>);

/// The mailboxes of both directions.
struct Regions<const WORDS: usize>;

impl<const WORDS: usize> Regions<WORDS> {
    const MAILBOX: Region<Mailbox> = Region::first("mailbox");
    const THERE: Inward<WORDS> = (Self::MAILBOX, Self::MAILBOX.then("channel"));
    const BACK_MAILBOX: Region<Mailbox> = Self::THERE.1.then("mailbox");
    const BACK: Inward<WORDS> = (Self::BACK_MAILBOX, Self::BACK_MAILBOX.then("channel"));
    const WAYS: [Inward<WORDS>; 2] = [Self::THERE, Self::BACK];
    const LAYOUT: Layout = Self::BACK.1.end();
}

const TASK: TaskId = TaskId::FIRST;

/// State of the handler.
struct Inbox<const WORDS: usize> {
    payload: Reader<'static, [u32; WORDS]>,
    received: Option<u32>,
}

fn handle<const WORDS: usize>(inbox: &mut Inbox<WORDS>, _: u32, call: Call) {
    inbox.received = Some(call.value);
}

fn handle_channel<const WORDS: usize>(inbox: &mut Inbox<WORDS>, _: u32, _: Call) {
    let payload = inbox.payload.read();
    inbox.received = payload.ok().map(|(_, words)| sum_from(&words));
}

/// How the payload travels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Way {
    /// 4 bytes as the value of the signal.
    Signal,
    /// Through a newest-value channel, with a signal.
    Channel,
}

/// The condition of a waiting core: its handler has taken a signal.
struct Waiting<const WORDS: usize> {
    board: &'static HostBoard,
    signals: Receiver<'static>,
    tasks: TaskTable<Inbox<WORDS>>,
    inbox: Inbox<WORDS>,
    way: Way,
}

impl<const WORDS: usize> Awaited for Waiting<WORDS> {
    type Output = u32;

    // The waiting loop calls only this function; a call through a pointer would cost a third more.
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

/// Returns a place in the LMU for this layout, chosen at random for each batch.
fn place(layout: Layout) -> usize {
    draw((LMU_WORDS - layout.total_words()) / PAIR + 1) * PAIR
}

/// Where the cores of a batch meet: a place in the LMU of a system.
#[derive(Clone, Copy)]
pub(crate) struct Meeting {
    system: &'static UnsupervisedSystem,
    /// The incarnation of the cores. It rises with each batch, as with each reset of a core.
    pub(crate) incarnation: u32,
    place: usize,
    layout: Layout,
}

impl Meeting {
    pub(crate) fn new(plan: &BatchPlan, layout: Layout) -> Self {
        static INCARNATIONS: AtomicU32 = AtomicU32::new(1);
        Self {
            system: plan.system.expect("a system with power"),
            incarnation: INCARNATIONS.fetch_add(1, Relaxed),
            place: place(layout),
            layout,
        }
    }

    /// Attaches core 1, or core 2, which formats the LMU.
    pub(crate) fn attach(
        self,
        shared: &SharedPage,
        core: CoreId,
    ) -> (&'static HostBoard, Map<'static>) {
        let board = self.system.attach(core, Generation(self.incarnation));
        let board: &'static HostBoard = Box::leak(Box::new(board.expect("the system has power")));
        let words = &board.lmu()[self.place..];
        if core == CoreId::PLANNING {
            Map::format(words, self.layout).expect("it fits");
        }
        shared.meet(2);
        let map = Map::attach(words, self.layout).expect("it was formatted");
        (board, map)
    }
}

/// How the cores of a batch wait and send, and where.
#[derive(Clone, Copy)]
struct How {
    meeting: Meeting,
    policy: WaitPolicy,
    way: Way,
}

impl How {
    fn new<const WORDS: usize>(plan: &BatchPlan, policy: WaitPolicy, way: Way) -> Self {
        Self {
            meeting: Meeting::new(plan, Regions::<WORDS>::LAYOUT),
            policy,
            way,
        }
    }

    /// Creates core 1's end towards core 2, or core 2's towards core 1.
    fn end<const WORDS: usize>(
        self,
        shared: &SharedPage,
        ways: [usize; 2],
    ) -> impl End + use<WORDS> {
        let [core, peer] = ways.map(|way| [CoreId::PERCEPTION, CoreId::PLANNING][way]);
        let (board, map) = self.meeting.attach(shared, core);
        let own = announce(&map, core.index(), self.meeting.incarnation);
        let [out, inward] = ways.map(|way| Regions::<WORDS>::WAYS[way]);
        let mut tasks = TaskTable::new();
        let handler = match self.way {
            Way::Signal => handle,
            Way::Channel => handle_channel,
        };
        tasks.add(TASK, handler, 0).expect("the table is empty");
        let mut payload = out.1.writer(&map, own).expect("it is free");
        let mut signal = out.0.sender(&map, own).expect("it is free");
        let mut waiting = Waiting {
            board,
            signals: inward.0.receiver(&map, own).expect("it is free"),
            tasks,
            inbox: Inbox {
                payload: inward.1.reader(&map).expect("it fits"),
                received: None,
            },
            way: self.way,
        };
        let send = move |stamp| {
            let ring = match self.way {
                Way::Signal => signal.signal_with(TASK, stamp),
                Way::Channel => {
                    payload.publish(&std::array::from_fn(|at| word(stamp, at)));
                    signal.signal(TASK)
                }
            };
            if ring == Ring::Needed {
                board.ring(peer);
            }
        };
        (send, move || self.policy.wait(&mut waiting))
    }
}

/// One-way time from core 1 to core 2 and back under this waiting policy.
pub(crate) fn sync<const WORDS: usize>(
    plan: &BatchPlan,
    policy: WaitPolicy,
    way: Way,
) -> io::Result<Batch> {
    let how = How::new::<WORDS>(plan, policy, way);
    let batch = between_processes(plan, |shared, ways| how.end::<WORDS>(shared, ways))?;
    Ok(batch.carrying(4 * WORDS as u64))
}

/// From core 1 to core 2 at a fixed rate.
pub(crate) fn at_rate(plan: &BatchPlan, policy: WaitPolicy) -> io::Result<Batch> {
    let how = How::new::<1>(plan, policy, Way::Signal);
    at_fixed_rate(plan, |shared, ways| how.end::<1>(shared, ways))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_batch_has_a_place_of_its_own_in_the_lmu() {
        let words: Vec<AtomicU32> = (0..LMU_WORDS + PAIR).map(|_| AtomicU32::new(0)).collect();
        let skipped = words.as_ptr().align_offset(4 * PAIR);
        for layout in [Regions::<1>::LAYOUT, Regions::<280>::LAYOUT] {
            let places = (0..30).map(|_| place(layout));
            let places: std::collections::HashSet<usize> = places.collect();
            // All 30 draws are equal in one of 10^60 runs.
            assert!(places.len() > 1, "{places:?}");
            for place in places {
                Map::format(&words[skipped..][..LMU_WORDS][place..], layout).unwrap();
            }
        }
    }
}
