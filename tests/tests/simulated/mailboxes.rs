//! Tests of the sync mailboxes between the three cores of a system, over the board's doorbells.

use std::cell::RefCell;
use std::rc::Rc;

use tandem_board::{Board, CoreId, Duration, Instant, SystemId};
use tandem_board_sim::{Config, Poller, SimBoard, SimPair};
use tandem_shm::incarnation::Incarnation;
use tandem_shm::mailbox::{Receiver, Ring, Sender, TaskId};
use tandem_shm::map::Map;
use tandem_shm::region::{Mailbox, Region};

const FIRST: Region<Mailbox> = Region::first("0 to 1");
const SECOND: Region<Mailbox> = FIRST.then("1 to 2");
const THIRD: Region<Mailbox> = SECOND.then("2 to 0");
const FOURTH: Region<Mailbox> = THIRD.then("0 to 2");
const FIFTH: Region<Mailbox> = FOURTH.then("2 to 1");
const SIXTH: Region<Mailbox> = FIFTH.then("1 to 0");
/// Every ordered pair of cores (from, to) once. Each receiver is the sender of the next pair.
const PAIRS: [(usize, usize, Region<Mailbox>); 6] = [
    (0, 1, FIRST),
    (1, 2, SECOND),
    (2, 0, THIRD),
    (0, 2, FOURTH),
    (2, 1, FIFTH),
    (1, 0, SIXTH),
];

/// The received signals: index of the pair, named task, and number of signals.
type Heard = Rc<RefCell<Vec<(usize, usize, u32)>>>;

/// The mailbox ends of one core.
struct Ends {
    receivers: Vec<(usize, Receiver<'static>)>,
    senders: Vec<(usize, Sender<'static>)>,
}

impl Ends {
    /// Attaches to the mailboxes. Returns `None` until core 0 has formatted the LMU.
    fn attach(board: &'static SimBoard) -> Option<Self> {
        let identity = board.identity();
        let own = identity.core.index();
        let map = match Map::attach(board.lmu(), SIXTH.end()) {
            Ok(map) => map,
            Err(_) if own == 0 => Map::format(board.lmu(), SIXTH.end()).expect("fits"),
            Err(_) => return None,
        };
        let here = Incarnation::new(own, identity.generation.0).expect("valid");
        let _outdated = map.incarnations().announce(here);
        let (mut receivers, mut senders) = (vec![], vec![]);
        for (pair, (from, to, region)) in PAIRS.iter().enumerate() {
            if *to == own {
                receivers.push((pair, region.receiver(&map, here).expect("fits")));
            }
            if *from == own {
                senders.push((pair, region.sender(&map, here).expect("fits")));
            }
        }
        Some(Self { receivers, senders })
    }

    /// Signals task `pair + 1` through this pair's mailbox, and interrupts the receiving core.
    fn signal(&mut self, board: &SimBoard, pair: usize) {
        let sender = self.senders.iter_mut().find(|(of, _)| *of == pair);
        let (_, sender) = sender.expect("its own pair");
        let task = TaskId::new(pair as u8 + 1).expect("1 to 6");
        assert_eq!(
            sender.signal(task),
            Ring::Needed,
            "the core of {pair} sleeps"
        );
        board.ring(CoreId::ALL[PAIRS[pair].1]);
    }

    fn sleep(&mut self) -> Instant {
        for (_, receiver) in &mut self.receivers {
            // A new receiver checks for signals that an earlier receiver left.
            receiver.poll(|of| panic!("{of:?} without an interrupt"));
            assert!(receiver.prepare_sleep(), "nothing is open");
        }
        Instant::NEVER
    }
}

/// After attaching, the core polls only when it is interrupted: it has no deadline.
fn core(board: &SimBoard, heard: &Heard) -> Poller {
    let board: &'static SimBoard = Box::leak(Box::new(board.clone()));
    let heard = Rc::clone(heard);
    let begins = board.now() + Duration::from_ms(10);
    let mut ends: Option<Ends> = None;
    Box::new(move |_| {
        let now = board.now();
        let Some(ends) = &mut ends else {
            ends = Ends::attach(board);
            return match &mut ends {
                // Core 0 begins after the others have attached.
                Some(ends) if board.identity().core == CoreId::CONTROL => {
                    ends.sleep();
                    board.release_core(CoreId::PERCEPTION);
                    board.release_core(CoreId::PLANNING);
                    begins
                }
                Some(ends) => ends.sleep(),
                None => now + Duration::from_ms(1),
            };
        };
        if heard.borrow().is_empty() && board.identity().core == CoreId::CONTROL {
            ends.signal(board, 0);
        }
        let mut came = vec![];
        for (pair, receiver) in &mut ends.receivers {
            receiver.awake();
            receiver.poll(|of| came.push((*pair, of.task.index(), of.count)));
        }
        for (pair, ..) in &came {
            if *pair + 1 < PAIRS.len() {
                ends.signal(board, *pair + 1);
            }
        }
        heard.borrow_mut().extend(came);
        ends.sleep()
    })
}

/// T-SYNC-1: for each ordered pair of cores, a signal interrupts only the receiving core. It
/// arrives once, through the mailbox of this pair, with the id of the named task.
#[test]
fn each_core_wakes_the_named_task_of_each_other_core_by_an_interrupt() {
    let heard = Heard::default();
    let of_cores = Rc::clone(&heard);
    let mut pair = SimPair::new(Config::default(), move |board| core(board, &of_cores));
    pair.power_on(SystemId::A);
    pair.run_for(Duration::from_ms(50));
    let expected: Vec<_> = (0..PAIRS.len()).map(|pair| (pair, pair + 1, 1)).collect();
    assert_eq!(*heard.borrow(), expected);
}
