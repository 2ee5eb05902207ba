//! The redundancy never depends on the time: a lying one during a takeover changes nothing.

use crate::one_flow::OneFlow;
use crate::time::watch::{MS, Watch};
use std::cell::Cell;
use std::rc::Rc;
use tandem_board::{Board as _, CoreId, Duration, Instant, ResetCause, SystemId};
use tandem_board_sim::{Poller, SimBoard};
use tandem_bus::e2e::protect;
use tandem_cores::Config;
use tandem_cores::core0::{Core0Task, TaskSet};
use tandem_cores::layout::VEHICLE_TIME;
use tandem_cores::trace::Event;
use tandem_peripherals::memory::scribble;
use tandem_redundancy::Evidence;
use tandem_sim::drive::poller;
use tandem_sim::time_chain::{Chain, ChainConfig};
use tandem_sim::timing::Time;
use tandem_tests::bent::core_with_link;

use SystemId::{A, B};

/// What the time lies about.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Lie {
    /// Nothing.
    None,
    /// There is no grandmaster.
    NoGrandmaster,
    /// The grandmaster leaps wildly, all the time.
    GrandmasterLeaps,
    /// The word that tells the next control cycle is random in each datagram, in both directions.
    Cycles,
    /// Each such datagram comes 20 times, with words that each time ask for a later cycle.
    ManyLaterCycles,
    /// The same with earlier cycles.
    ManyEarlierCycles,
    /// The words of the time in the LMU are overwritten.
    Scribbles,
    /// Nothing, in the executor of [`Lie::Starves`].
    Runs,
    /// The task of time runs no more.
    Starves,
}

const LIES: [Lie; 7] = [
    Lie::NoGrandmaster,
    Lie::GrandmasterLeaps,
    Lie::Cycles,
    Lie::ManyLaterCycles,
    Lie::ManyEarlierCycles,
    Lie::Scribbles,
    Lie::Starves,
];

/// How the master ends.
#[derive(Clone, Copy, Debug)]
enum End {
    PowerLoss,
    Reset,
    Freeze,
    DeadPerception,
}

const ENDS: [End; 4] = [End::PowerLoss, End::Reset, End::Freeze, End::DeadPerception];

/// The lie begins, and later the master ends.
const LIES_FROM: Duration = Duration::from_ms(14_000);
const ENDS_AT: Duration = Duration::from_ms(18_000);

/// Id of the protection of a command of the other system, and its length.
const PEER_COMMAND: (u16, usize) = (0x0801, 14);

/// Makes datagrams of a peer's command lie about the next control cycle, once `lies` is set.
fn with_cycles(lie: Lie, lies: Rc<Cell<bool>>) -> impl FnMut(Instant, &[u32]) -> Vec<Vec<u32>> {
    let (mut counter, mut random) = (0_u8, 1_u32);
    move |_, words| {
        if words.len() != PEER_COMMAND.1 {
            return vec![words.to_vec()];
        }
        let mut forged = |cycle: u32| {
            let mut words = words.to_vec();
            words[13] = cycle;
            counter = counter.wrapping_add(1);
            let mut bytes: Vec<u8> = words.iter().flat_map(|word| word.to_le_bytes()).collect();
            protect(PEER_COMMAND.0, counter, &mut bytes);
            let (chunks, _) = bytes.as_chunks::<4>();
            let word = |chunk: &[u8; 4]| u32::from_le_bytes(*chunk);
            chunks.iter().map(word).collect()
        };
        random = random.wrapping_mul(0x9E37_79B9).rotate_left(7);
        match lie {
            _ if !lies.get() => vec![forged(words[13])],
            Lie::Cycles => vec![forged(random)],
            _ => {
                let sign = if lie == Lie::ManyLaterCycles {
                    1
                } else {
                    -1_i32
                };
                let many = 1..=20;
                let moved = many.map(|n| words[13].wrapping_add_signed(sign * n * 1_000_000));
                moved.map(&mut forged).collect()
            }
        }
    }
}

/// Core 0 whose tasks run one after the other, but the task of time only until it starves.
fn starved(board: &SimBoard, starves: Rc<Cell<bool>>) -> Poller {
    let board = board.clone();
    let (executor, mut tasks) = OneFlow::start(&board);
    let mut due = [board.now(); Core0Task::ALL.len()];
    Box::new(move |_| {
        executor.released.set(TaskSet::NONE);
        for (due, task) in due.iter_mut().zip(Core0Task::ALL) {
            let is_released = executor.released.get().contains(task);
            let is_due = *due <= board.now() || is_released || task.info().is_for_interrupts();
            if is_due && !(task == Core0Task::Time && starves.get()) {
                *due = tasks.poll(task, &executor);
            }
        }
        let is_starved = |task: Core0Task| task == Core0Task::Time && starves.get();
        let due = due.iter().zip(Core0Task::ALL);
        let due = due
            .filter(|(_, task)| !is_starved(*task))
            .map(|(due, _)| *due);
        due.min().unwrap_or(Instant::NEVER).min(board.now() + MS(1))
    })
}

/// Drives with this lie until after the end of the master.
fn driven(lie: Lie, end: End) -> Watch {
    let config = ChainConfig {
        time: Time::Ideal,
        grandmaster: ChainConfig::default()
            .grandmaster
            .filter(|_| lie != Lie::NoGrandmaster),
        ..ChainConfig::default()
    };
    let starves = Rc::new(Cell::new(false));
    let shared = Rc::clone(&starves);
    let chain = Chain::with("cut-in", config, move |board| {
        if board.identity().core != CoreId::CONTROL {
            return poller(board, Config::rt());
        }
        match lie {
            Lie::Cycles | Lie::ManyLaterCycles | Lie::ManyEarlierCycles => {
                let on_send = with_cycles(lie, Rc::clone(&shared));
                core_with_link(board, Config::rt(), Box::new(on_send))
            }
            Lie::Starves => starved(board, Rc::clone(&shared)),
            Lie::Runs => starved(board, Rc::default()),
            _ => poller(board, Config::rt()),
        }
    });
    let mut watch = Watch::of(chain);
    watch.run_for(LIES_FROM);
    starves.set(true);
    let mut has_ended = false;
    for turn in 0_u32..100 {
        let now = watch.chain.drive.pair.now();
        if !has_ended && now >= Instant::ORIGIN + ENDS_AT {
            has_ended = true;
            let pair = &mut watch.chain.drive.pair;
            match end {
                End::PowerLoss => pair.power_off(A),
                End::Reset => pair.reset(A, ResetCause::Software),
                End::Freeze => pair.freeze(A, MS(300)),
                End::DeadPerception => pair.kill_core(A, CoreId::PERCEPTION),
            }
        }
        lie.tells(turn, &mut watch.chain);
        watch.run_for(MS(150));
    }
    watch
}

impl Lie {
    fn tells(self, turn: u32, chain: &mut Chain) {
        let random = turn.wrapping_mul(0x9E37_79B9) ^ turn << 13;
        match self {
            Self::GrandmasterLeaps => {
                let by = i64::from(random.cast_signed()) * (1 << (turn % 24));
                chain.grandmasters[0].clock.leapt_ns = by;
            }
            Self::Scribbles => {
                // The newest conversions are in the last words of the last region.
                let end = VEHICLE_TIME.end().total_words();
                for of in SystemId::ALL {
                    scribble(&chain.drive.pair.lmu(of)[end - 32..end], random);
                }
            }
            _ => {}
        }
    }
}

/// What a system did, without its time.
#[derive(Debug, PartialEq)]
enum Deed {
    Of(Event),
    TookOver(Evidence, u32),
}

/// Returns the roles of a system, and the evidence for them, in order.
fn deeds(watch: &Watch, of: SystemId) -> Vec<Deed> {
    let events = watch.chain.drive.events.iter();
    let events = events.filter(|(_, system, ..)| *system == of);
    let deed = |(.., event): &(_, _, _, Event)| match *event {
        Event::Role { .. } | Event::Phase { .. } | Event::PeerFailed(_) => Some(Deed::Of(*event)),
        Event::TookOver { cause, term, .. } => Some(Deed::TookOver(cause, term)),
        _ => None,
    };
    events.filter_map(deed).collect()
}

/// S-1, T-RED-4, T-RED-8: whatever lies about the time, and however the master ends: the same roles
/// by the same evidence in the same terms, no gap beyond its bound, never two masters, control
/// cycles of 9 to 11 ms, no collision, and the vehicle keeps its lane.
#[test]
fn a_lying_time_changes_nothing_of_a_takeover() {
    for (nth, end) in ENDS.into_iter().enumerate() {
        let [honest, runs] = [Lie::None, Lie::Runs].map(|lie| driven(lie, end));
        honest.assert_drives_well(&[A, B]);
        runs.assert_drives_well(&[A, B]);
        // Each lie at half of the ends.
        for lie in LIES.into_iter().skip(nth % 2).step_by(2) {
            let lied = driven(lie, end);
            println!("{end:?} {lie:?}: gap {:?}", lied.chain.drive.gap_max());
            lied.assert_is_driven(&[A, B]);
            assert_eq!(lied.chain.drive.takeovers().len(), 1, "{end:?} {lie:?}");
            if lie != Lie::Scribbles {
                assert_eq!(lied.violations, [], "{end:?} {lie:?}");
            }
            let honest = if lie == Lie::Starves { &runs } else { &honest };
            for of in SystemId::ALL {
                assert_eq!(deeds(honest, of), deeds(&lied, of), "{end:?} {lie:?}: {of}");
            }
        }
    }
}
