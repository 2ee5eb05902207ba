//! Sources send without pause: core 0 limits its input, reports the sources, and drives on.

use std::cell::Cell;
use std::rc::Rc;
use tandem_board::{
    Board, Can, CanErrors, CanFrame, CanId, CoreId, Duration, Edge, Identity, Instant, Line, Lines,
    Link, LinkFull, Received, SystemId, TransmitFull,
};
use tandem_board_sim::{Poller, SimBoard};
use tandem_cores::core0::{CAN_FRAMES, Core0, LINK_DATAGRAMS};
use tandem_cores::doorbell::DOORBELL_DISTANCE;
use tandem_cores::task_table::TaskCode;
use tandem_cores::trace::{Event, FloodSource};
use tandem_cores::{Config, Core};
use tandem_sim::drive::{Drive, poller};
use tandem_tests::around::Around;

const MS: fn(u64) -> Duration = Duration::from_ms;
/// Virtual times at which the flood begins and ends, ms.
const FLOOD: core::ops::Range<u64> = 10_000..12_000;
/// Time between two bursts of the source.
const PAUSE: Duration = Duration::from_us(50);
/// Number of messages in a burst. In a millisecond more are sent than any buffer holds.
const BURST: u32 = 20;

/// Returns true during the flood. The time is on the clock of the board's system: the clocks of
/// the simulator begin at 1 ms (A) and 7 s (B).
fn is_flooding(board: &SimBoard) -> bool {
    let origin_ms = [1, 7_000][board.identity().system.index()];
    let ms = board.now().as_ns() / 1_000_000 - origin_ms;
    FLOOD.contains(&ms)
}

/// Creates a core that works as usual and also calls `burst` during the flood.
fn babbler(board: &SimBoard, burst: fn(&SimBoard)) -> Poller {
    let mut core = poller(board, Config::rt());
    let mut due = Instant::ORIGIN;
    Box::new(move |board| {
        let now = board.now();
        if is_flooding(board) {
            burst(board);
            if now >= due {
                due = core(board);
            }
            due.min(now + PAUSE)
        } else {
            due = core(board);
            due.min(now + MS(1))
        }
    })
}

/// Starts a drive in which one core of a system floods.
fn drive(of: (SystemId, CoreId), burst: fn(&SimBoard)) -> Drive {
    let mut drive = Drive::with("cut-in", 3, move |board| {
        let Identity { system, core, .. } = board.identity();
        if (system, core) == of {
            babbler(board, burst)
        } else {
            poller(board, Config::rt())
        }
    });
    drive.run_for(MS(20_000));
    drive
}

/// Returns the sources that this system's core 0 reported, with the time of the first report, ms.
fn reported(drive: &Drive, by: SystemId) -> Vec<(u64, FloodSource)> {
    let mut reported: Vec<(u64, FloodSource)> = vec![];
    for (at, system, _, event) in &drive.events {
        if let Event::Flood { source, .. } = event
            && *system == by
            && reported.iter().all(|(_, known)| known != source)
        {
            reported.push((at.as_ns() / 1_000_000, *source));
        }
    }
    reported
}

/// Returns how often the roles task of a system ran during the flood.
fn polls(drive: &Drive, of: SystemId) -> usize {
    let roles = drive.events.iter().filter(|(at, system, _, event)| {
        let begins = matches!(event, Event::TaskIn { task, .. } if *task == TaskCode::ROLES);
        begins && *system == of && FLOOD.contains(&(at.as_ns() / 1_000_000))
    });
    roles.count()
}

/// Checks that the flood does not affect the vehicle, and that system `by` reports it.
fn assert_unimpressed(drive: &Drive, by: SystemId, source: FloodSource) {
    assert_eq!(drive.masters(), [SystemId::A]);
    assert!(drive.gap_max() <= MS(11), "{:?}", drive.gap_max());
    assert_eq!(drive.collisions(), 0);
    assert!(drive.takeovers().is_empty());
    let reported = reported(drive, by);
    let [(at, first)] = reported[..] else {
        panic!("{reported:?} instead of {source:?}");
    };
    assert_eq!(first, source);
    assert!((FLOOD.start..FLOOD.start + 300).contains(&at), "{at} ms");
    // One poll for each tick, and the polls that interrupts may cause.
    let span = MS(FLOOD.end - FLOOD.start);
    let most = span.as_ns() / MS(1).as_ns() + span.as_ns() / DOORBELL_DISTANCE.as_ns() + 2;
    let polls = polls(drive, by);
    assert!(polls as u64 <= most, "{polls} polls, at most {most}");
}

/// T-CHIP-5: the source sends datagrams without pause.
#[test]
fn a_flooded_link_is_told_and_changes_nothing() {
    let drive = drive((SystemId::B, CoreId::CONTROL), |board| {
        for _ in 0..BURST {
            let _ = board.link().try_send(&[0xDEAD_BEEF; 4]);
        }
    });
    assert_unimpressed(&drive, SystemId::A, FloodSource::Link);
}

/// T-CHIP-5: the source sends edges on the start line. Each edge is an interrupt.
#[test]
fn a_flooded_start_line_is_told_and_changes_nothing() {
    let drive = drive((SystemId::B, CoreId::CONTROL), |board| {
        for _ in 0..BURST {
            board.lines().send(Line::Start, Edge::Falling);
        }
    });
    let reported_of: Vec<_> = reported(&drive, SystemId::A)
        .iter()
        .map(|(_, it)| *it)
        .collect();
    assert!(
        reported_of.contains(&FloodSource::StartLine),
        "{reported_of:?}"
    );
    assert!(
        reported_of.contains(&FloodSource::Doorbell),
        "{reported_of:?}"
    );
    let mut line = drive;
    line.events.retain(|(.., event)| {
        !matches!(
            event,
            Event::Flood {
                source: FloodSource::Doorbell,
                ..
            }
        )
    });
    assert_unimpressed(&line, SystemId::A, FloodSource::StartLine);
}

/// T-RED-3: the source sends edges on both heartbeat lines.
#[test]
fn flooded_heartbeat_lines_are_told_and_change_nothing() {
    let drive = drive((SystemId::B, CoreId::CONTROL), |board| {
        for line in [Line::Heartbeat1, Line::Heartbeat2] {
            for _ in 0..BURST {
                board.lines().send(line, Edge::Rising);
            }
        }
    });
    assert_unimpressed(&drive, SystemId::A, FloodSource::HeartbeatLines);
}

/// T-SYNC-3: another core of the same system rings the doorbell of core 0.
#[test]
fn a_flooded_doorbell_is_told_and_changes_nothing() {
    let drive = drive((SystemId::A, CoreId::PERCEPTION), |board| {
        board.ring(CoreId::CONTROL);
    });
    assert_unimpressed(&drive, SystemId::A, FloodSource::Doorbell);
}

/// T-CHIP-5: the source sends meaningless CAN frames. The bus limits each core to its share.
#[test]
fn a_core_that_floods_the_bus_leaves_it_to_the_others() {
    let drive = drive((SystemId::B, CoreId::PLANNING), |board| {
        let frame = CanFrame::new(CanId::Standard(0x0A0), true, &[0; 16]).expect("a frame");
        for _ in 0..BURST {
            let _ = board.can().try_send(&frame);
        }
    });
    assert_eq!(drive.masters(), [SystemId::A]);
    assert!(drive.gap_max() <= MS(11), "{:?}", drive.gap_max());
    assert_eq!(drive.collisions(), 0);
}

/// Drives while a node outside the systems sends `a_ms` frames in each of 1000 ms.
fn forge_frames(a_ms: u32) -> Drive {
    let mut drive = Drive::new("cut-in", 3);
    drive.run_for(MS(10_000));
    let frame = CanFrame::new(CanId::Standard(0x0A0), true, &[0; 16]).expect("a frame");
    for _ in 0..1_000 {
        drive.seen.borrow_mut().forged = vec![frame; a_ms as usize];
        drive.run_for(MS(1));
    }
    drive.run_for(MS(9_000));
    assert_eq!(drive.collisions(), 0);
    assert_eq!(drive.two_masters_ns(), 0);
    drive
}

/// T-CHIP-5: a busy bus delays no control frame, causes no takeover and no report of a flood.
#[test]
fn a_busy_bus_changes_nothing() {
    let drive = forge_frames(CAN_FRAMES / 2);
    assert!(drive.gap_max() <= MS(11), "{:?}", drive.gap_max());
    assert_eq!(drive.masters(), [SystemId::A]);
    assert_eq!(reported(&drive, SystemId::A), []);
}

/// T-CHIP-5: more frames than a bus can carry are reported. They hide the master's frames from the
/// standby, which may take over once. No gap exceeds the limit for a mute master.
#[test]
fn more_frames_than_a_bus_carries_are_told() {
    let drive = forge_frames(2 * CAN_FRAMES);
    for system in SystemId::ALL {
        let reported = reported(&drive, system);
        assert_eq!(reported.len(), 1, "{system}: {reported:?}");
        assert_eq!(reported[0].1, FloodSource::Can);
    }
    assert!(drive.gap_max() < MS(30), "{:?}", drive.gap_max());
    assert!(drive.masters().len() <= 2, "{:?}", drive.masters());
}

/// T-RED-4, T-RED-9: the master fails: it stops driving and floods all inputs of the other system,
/// which takes over in time.
#[test]
fn the_standby_takes_over_from_a_master_that_floods_it() {
    let mut drive = Drive::with("cut-in", 3, |board| {
        let of = board.identity();
        if (of.system, of.core) != (SystemId::A, CoreId::CONTROL) {
            return poller(board, Config::rt());
        }
        let mut core = poller(board, Config::rt());
        Box::new(move |board| {
            if !is_flooding(board) {
                let now = board.now();
                return core(board).min(now + MS(1));
            }
            for _ in 0..BURST {
                let _ = board.link().try_send(&[0xDEAD_BEEF; 4]);
                board.lines().send(Line::Start, Edge::Rising);
                let frame = CanFrame::new(CanId::Standard(0x0A0), true, &[0; 16]);
                let _ = board.can().try_send(&frame.expect("a frame"));
            }
            board.now() + PAUSE
        })
    });
    drive.run_for(MS(20_000));
    assert_eq!(drive.masters(), [SystemId::A, SystemId::B]);
    assert!(drive.gap_max() < MS(20), "{:?}", drive.gap_max());
    assert_eq!(drive.collisions(), 0);
    assert!(reported(&drive, SystemId::B).len() >= 3);
}

/// Number of frames or datagrams taken since the poll began. None follow after [`ALL_OF_THEM`], so
/// that a core that reads without limit fails the test instead of hanging.
#[derive(Clone, Default)]
struct Taken(Rc<Cell<u32>>);

const ALL_OF_THEM: u32 = 5_000;

impl Taken {
    fn one_more(&self) -> bool {
        self.0.set(self.0.get() + 1);
        self.0.get() < ALL_OF_THEM
    }
}

/// A CAN controller and a link that always have another message.
struct EndlessCan(SimBoard, Taken);
struct EndlessLink(SimBoard, Taken);

impl Can for EndlessCan {
    fn try_send(&self, frame: &CanFrame) -> Result<(), TransmitFull> {
        self.0.can().try_send(frame)
    }

    fn try_send_stamped(&self, frame: &CanFrame) -> Result<(), TransmitFull> {
        self.0.can().try_send_stamped(frame)
    }

    fn stamp(&self) -> Option<Instant> {
        self.0.can().stamp()
    }

    fn discard_unsent(&self) {
        self.0.can().discard_unsent();
    }

    fn try_receive(&self) -> Option<Received> {
        let frame = CanFrame::new(CanId::Standard(0x0A0), true, &[0; 16]).ok()?;
        let at = self.0.now();
        self.1.one_more().then_some(Received { frame, at })
    }

    fn wake_on_receive(&self, on: bool) {
        self.0.can().wake_on_receive(on);
    }

    fn overruns(&self) -> u32 {
        self.0.can().overruns()
    }

    fn errors(&self) -> CanErrors {
        self.0.can().errors()
    }
}

impl Link for EndlessLink {
    const MAX_WORDS: usize = <SimBoard as Board>::Link::MAX_WORDS;

    fn try_send(&self, words: &[u32]) -> Result<(), LinkFull> {
        self.0.link().try_send(words)
    }

    fn try_receive(&self, words: &mut [u32]) -> Option<usize> {
        words.fill(0);
        self.1.one_more().then_some(words.len())
    }
}

/// One poll takes a constant number of messages, even if others send faster than it reads.
#[test]
fn one_poll_takes_no_more_than_its_limits() {
    let most = Rc::new(Cell::new([0; 2]));
    let seen = Rc::clone(&most);
    let mut pair =
        tandem_board_sim::SimPair::new(tandem_board_sim::Config::default(), move |board| {
            let of = board.identity();
            if (of.system, of.core) != (SystemId::A, CoreId::CONTROL) {
                return poller(board, Config::rt());
            }
            let (frames, datagrams) = (Taken::default(), Taken::default());
            let can = EndlessCan(board.clone(), frames.clone());
            let link = EndlessLink(board.clone(), datagrams.clone());
            let endless = Around::leaked(board, can, link, board.supply().clone());
            let (mut core, most) = (Core0::new(endless, Config::rt()), Rc::clone(&seen));
            Box::new(move |_| {
                let deadline = core.poll();
                let taken = [&frames, &datagrams].map(|taken| taken.0.take());
                let [can, link] = most.get();
                most.set([can.max(taken[0]), link.max(taken[1])]);
                deadline
            })
        });
    pair.power_on(SystemId::A);
    pair.run_for(MS(4_000));
    assert_eq!(most.get(), [CAN_FRAMES, LINK_DATAGRAMS]);
}
