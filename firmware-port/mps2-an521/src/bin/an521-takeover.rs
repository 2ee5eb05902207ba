//! The redundancy on two processors, with the limits of a chip: core 0 of system A drives and
//! hangs; core 0 of B takes over.
//!
//! The board connects them by lines, link and CAN. `Redundancy` and the protected frames are those
//! of the host. The level line does not fall: a processor that hangs keeps its supply. Strap 0: A
//! hangs 1 s plus this time (us) after its start. Strap 1: shift (us) of B's polls before that. The
//! log shows the times from A's hang, and from A's last control frame, to B's first control frame.
//! The status is 0 if both are within bounds and B sent none before the hang.
#![no_std]
#![no_main]
#![deny(unsafe_code)]

use core::sync::atomic::{AtomicU32, Ordering};
use tandem_board::{
    Board, Can, CanFrame, CanId, CoreAddress, Duration, Instant, Lines, Link, ResetCause, SystemId,
};
use tandem_board_mps2_an521::board::An521Board;
use tandem_board_mps2_an521::straps::strap;
use tandem_board_mps2_an521::{cpu, entry, exit, log, timers};
use tandem_bus::{Control, FrameReceiver, FrameTransmitter, Message};
use tandem_redundancy::{
    Action, Actions, Config, ControlHeader, Input, LineSnapshot, LinkReport, Loaded, Mode,
    Redundancy, RedundancyEvent, Role, Takeover, Term,
};

entry!(main);

const CONFIG: Config = Config::chip();
/// Time from the start of system A until it hangs; strap 0 is added.
const HANGS_AFTER: Duration = Duration::from_ms(1_000);
/// Time from the start of B until it shifts its polls. By then both systems have their roles.
const MOVES_AFTER: Duration = Duration::from_ms(800);
/// Bounds of the times from A's hang, and from A's last control frame, to B's first control frame.
/// Both include 0.2 ms of execution, about 6,000 instructions of B.
const BOUNDS: [Duration; 2] = [Duration::from_ms(4), Duration::from_ms(14)];
/// End of the test: start and takeover take less time.
const LIMIT: Duration = Duration::from_ms(3_000);

/// Length of a turn, in ticks. While both processors sleep, the emulator can let two timers expire
/// before it runs an instruction. With longer turns, an alarm was late by the whole waiting time.
const TURN: u32 = 400;

/// Time at which A hung, in microseconds since the start of the machine; 0 while it runs.
static HUNG_US: AtomicU32 = AtomicU32::new(0);

fn main(own: usize) -> ! {
    let cast = [Some(CoreAddress::A0), Some(CoreAddress::B0)];
    let Some(board) = An521Board::new(cast) else {
        exit::exit(1)
    };
    match own {
        0 => drive_and_hang(&board),
        _ => {
            let status = match take_over(&board) {
                Ok(()) => 0,
                Err(what) => {
                    log!("FAILED  {what}");
                    1
                }
            };
            exit::exit(status)
        }
    }
}

/// The redundancy on core 0 of one system.
struct Core<'b> {
    board: &'b An521Board,
    machine: Redundancy,
    transmitter: FrameTransmitter,
    receiver: FrameReceiver,
    next_frame: Instant,
    takeover: Option<Takeover>,
    /// Time at which the newest control frame of the other system was on the bus.
    heard_at: Option<Instant>,
}

impl<'b> Core<'b> {
    fn new(board: &'b An521Board) -> Self {
        let now = board.now();
        let system = board.identity().system;
        let machine = Redundancy::new(CONFIG, system, ResetCause::PowerOn, Loaded::Blank, now);
        Self {
            board,
            machine,
            transmitter: FrameTransmitter::new(),
            receiver: FrameReceiver::new(),
            next_frame: now,
            takeover: None,
            heard_at: None,
        }
    }

    /// Runs one cycle. Returns the time of the next one, and whether a control frame was sent.
    fn cycle(&mut self) -> (Instant, bool) {
        let now = self.board.now();
        while let Some(received) = self.board.can().try_receive() {
            if let Some(frame) = self.heard(&received.frame) {
                self.heard_at = Some(received.at);
                let actions = self.machine.on(now, Input::ControlFrame(frame));
                self.carry_out(&actions);
            }
        }
        let mut words = [0; LinkReport::WORDS];
        while let Some(length) = self.board.link().try_receive(&mut words) {
            let words = words.get(..length).unwrap_or_default();
            if let Some(report) = LinkReport::from_words(words) {
                let actions = self.machine.on(now, Input::LinkReport(report));
                self.carry_out(&actions);
            }
        }
        let lines = self.board.lines();
        let received = |line, edge| lines.received(line, edge);
        // There are no third parties on this bus.
        let snapshot = LineSnapshot::new(received, lines.peer_powered(), 0);
        let actions = self.machine.on(now, Input::Poll(snapshot));
        self.carry_out(&actions);
        // Reports at each poll, every millisecond, as in a chip's profile. The link may be full: a
        // processor that hangs does not empty it.
        let report = self.machine.link_report(now);
        let _full = self.board.link().try_send(&report.to_words());
        if actions.contains(Action::Transmit) {
            self.next_frame = now;
        }
        let sent = now >= self.next_frame && self.machine.may_transmit(self.board.now());
        if sent {
            self.next_frame += CONFIG.control_period;
            self.send_control();
        }
        let drives = self.machine.phase().is_driving();
        let next_frame = if drives {
            self.next_frame
        } else {
            Instant::NEVER
        };
        (actions.deadline().min(next_frame), sent)
    }

    /// Returns the content of a control frame, if the frame passes its end-to-end protection.
    fn heard(&mut self, frame: &CanFrame) -> Option<ControlHeader> {
        let CanId::Standard(id) = frame.id() else {
            return None;
        };
        match self.receiver.receive(id.into(), frame.data()) {
            Ok(Message::Control { system, control }) => Some(ControlHeader {
                system: SystemId::from_index(system.into())?,
                term: Term::from_bits(control.term),
                role: Role::from_repr(control.role as u8)?,
                mode: Mode::from_repr(control.mode as u8)?,
            }),
            _ => None,
        }
    }

    fn send_control(&mut self) {
        let driven = if self.machine.mode() == Mode::L3 {
            tandem_bus::ModeCode::L3
        } else {
            tandem_bus::ModeCode::DegradedL2
        };
        let message = Message::Control {
            system: self.board.identity().system.index() as u8,
            control: Control {
                role: tandem_bus::RoleCode::Master,
                mode: driven,
                takeover_request: false,
                term: self.machine.term().bits(),
                steering_angle: 0.0,
                acceleration: 0.0,
                command_age: 0.0,
                sent_at: 0,
            },
        };
        let encoded = self.transmitter.encode(&message);
        let frame = CanFrame::new(CanId::Standard(encoded.id), true, encoded.data());
        // The transmit buffer of this board is never full.
        let sent = frame.is_ok_and(|frame| self.board.can().try_send(&frame).is_ok());
        assert!(sent, "a control frame is one that the bus carries");
    }

    fn carry_out(&mut self, actions: &Actions) {
        for action in actions.iter() {
            match action {
                Action::SendEdge(line, edge) => self.board.lines().send(line, edge),
                Action::DiscardUnsent => self.board.can().discard_unsent(),
                // `cycle` sends at once, and has no fixed cycle to align.
                Action::Transmit | Action::AlignControl => {}
                // These processors have no flash and no supply.
                Action::Persist(_) | Action::Reset(_) => {}
                Action::Record(event) => {
                    if let RedundancyEvent::Takeover(takeover) = event {
                        self.takeover.get_or_insert(takeover);
                    }
                }
            }
        }
    }
}

fn us(at: Instant) -> u32 {
    (at.as_ns() / 1_000) as u32
}

fn drive_and_hang(board: &An521Board) -> ! {
    timers::set_turns(TURN);
    let mut core = Core::new(board);
    let end = board.now() + HANGS_AFTER + Duration::from_us(strap(0).into());
    while board.now() < end {
        let (deadline, _) = core.cycle();
        board.wait(deadline.min(end));
    }
    if core.machine.role() != Role::Master {
        log!("FAILED  A is {:?} when it hangs", core.machine.role());
        exit::exit(1);
    }
    HUNG_US.store(us(board.now()), Ordering::Release);
    loop {
        cpu::without_interrupts(cpu::sleep);
    }
}

fn take_over(board: &An521Board) -> Result<(), &'static str> {
    let mut core = Core::new(board);
    let mut moves_at = board.now() + MOVES_AFTER;
    let end = board.now() + LIMIT;
    loop {
        let (deadline, sent) = core.cycle();
        let now = board.now();
        let hung = HUNG_US.load(Ordering::Acquire);
        if sent && hung == 0 {
            return Err("B transmits while A drives");
        }
        if let (true, Some(takeover)) = (sent, core.takeover) {
            let after = us(now) - hung;
            let gap = core.heard_at.map_or(u32::MAX, |at| us(now) - us(at));
            let [bound, gap_bound] = BOUNDS.map(|bound| bound.as_us() as u32);
            log!(
                "takeover: {:?} {after} us after A hung (bound {bound}), {gap} us after its last \
                 control frame (bound {gap_bound})",
                takeover.cause
            );
            return if after <= bound && gap <= gap_bound {
                Ok(())
            } else {
                Err("the takeover is late")
            };
        }
        if now > end {
            return Err("B takes over");
        }
        if now >= moves_at {
            // Shifts the polls: after a pause of two periods, the heartbeats restart with a poll.
            moves_at = Instant::NEVER;
            let resumes =
                now + CONFIG.heartbeat_period.times(2) + Duration::from_us(strap(1).into());
            while board.now() < resumes {}
        } else {
            board.wait(deadline);
        }
    }
}
